"""The compiled loops give what their formulas say, whether stamps are regular or not."""

import numpy as np
import pytest

from inflight.samples.interpolation import running_means, sinc

LOBES, BETA = 16.0, 10.0


def windowed_sinc(stamps, values, target, cadence, cutoff):
    """The formula, one target after the other: the line through the window's ends is kept as it is."""
    half, out = LOBES / cutoff * cadence, np.full((target.size, values.shape[1]), np.nan)
    for row, at in enumerate(target):
        inside = np.flatnonzero(np.abs(stamps - at) < half)
        own = stamps[inside]
        whole = own.size >= int(2 * half / cadence) - 1 and np.diff(own).max() <= 1.5 * cadence
        if not whole or min(at - own[0], own[-1] - at) < half - 1.5 * cadence:
            continue
        x = (at - own) / cadence
        weights = np.sinc(cutoff * x) * np.i0(BETA * np.sqrt(1 - (x * cadence / half) ** 2))
        first, last = values[inside[0]], values[inside[-1]]
        slope = (last - first) / (own[-1] - own[0])
        above = values[inside] - first - slope * (own - own[0])[:, None]
        out[row] = weights @ above / weights.sum() + first + slope * (at - own[0])
    return out


@pytest.mark.parametrize("jitter", [0, 1000, 3_000_000])
@pytest.mark.parametrize(
    ("cadence", "step"), [(10**9, 10**9), (20_000_000, 10**9), (20_000_000, 333_333_333)]
)
@pytest.mark.parametrize("gap", [False, True])
def test_weights_from_the_table_are_those_of_the_formula(jitter, cadence, step, gap):
    random = np.random.default_rng(3)
    stamps = np.arange(0, 200 * step, cadence) + random.integers(
        -jitter, jitter + 1, -(-200 * step // cadence)
    )
    seconds = stamps / 1e9
    values = 4e4 * np.sin(2 * np.pi * seconds / 5600)[:, None] + random.normal(0, 5, (stamps.size, 2))
    values[stamps.size // 5, 1] = np.nan
    if gap:
        there = np.arange(stamps.size) // 3 != stamps.size // 6
        stamps, values = stamps[there], values[there]
    target = np.arange(0, 200 * step, step) - 123_456
    cutoff = cadence / step
    found = sinc(stamps, values, target, float(cadence), cutoff, LOBES, BETA)
    asked = windowed_sinc(stamps, values, target, cadence, cutoff)
    assert 60 < np.isfinite(asked[:, 0]).sum() < target.size
    np.testing.assert_allclose(found, asked, rtol=0, atol=1e-8)


@pytest.mark.parametrize("jitter", [0, 400])
def test_a_running_mean_has_as_many_samples_on_either_side(jitter):
    random = np.random.default_rng(4)
    stamps = np.arange(300) * 1000 + random.integers(0, jitter + 1, 300)
    stamps[150:] += 7000
    values = random.normal(1e4, 1, (300, 2))
    found = running_means(stamps, values, 5500)
    for row in range(300):
        near = np.flatnonzero(np.abs(stamps - stamps[row]) <= 5500)
        each = min(row - near[0], near[-1] - row)
        np.testing.assert_allclose(found[row], values[row - each : row + each + 1].mean(axis=0), rtol=1e-12)
