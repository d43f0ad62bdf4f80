"""What is too fast for the search is measured, and its periods are told when they stand out."""

import numpy as np
import pytest

from inflight.diagnosis import Features, Series
from inflight.diagnosis.residual import structure_of
from inflight.diagnosis.signature import fast_part
from inflight.time import DAY, SECOND

STEP_S, NOISE, DAYS = 8.0, 0.06, 3
SECONDS = STEP_S * np.arange(int(DAYS * 86_400 / STEP_S))


def seen(values, floor=NOISE, weight=None, native=None):
    """Return what is said of a residual (sample,) of a span; `native` is its size at the samples' cadence."""
    weight = np.ones(values.size) if weight is None else weight
    features = Features(("seconds", "residual", "weight"), (1, 1, 1), ("s", "nT", "1"), ("fgm",), 1)
    stamps = (SECONDS * SECOND).astype(np.int64)
    table = np.stack([SECONDS, values, weight], axis=1)
    series = Series(stamps, table, stamps * 8 // DAY, features)
    left = np.where(weight > 0, values, 0.0)[:, None]
    size = float(np.sqrt(np.mean(values[weight > 0] ** 2))) if native is None else native
    return fast_part(series, left, size, floor, structure_of(series, left))


def noise(seed=0):
    return np.random.default_rng(seed).normal(0, NOISE, SECONDS.size)


def wheel(first_s=47.4, last_s=44.0, size=0.25):
    """A wheel whose speed drifts over the span."""
    rate = np.linspace(1.0 / first_s, 1.0 / last_s, SECONDS.size)
    return size * np.sin(2 * np.pi * np.cumsum(rate) * STEP_S)


@pytest.mark.parametrize("ends", [(47.4, 44.0), (30.0, 25.0), (70.0, 64.0)])
def test_a_wheel_whose_speed_drifts_is_told_by_its_periods_and_its_size(ends):
    said = seen(wheel(*ends) + noise())
    assert said.rms_nT == pytest.approx(0.25 / np.sqrt(2.0), rel=0.05)
    short, long = said.periods_s
    assert short <= min(ends) * 1.03
    assert long >= max(ends) * 0.97
    assert short > min(ends) * 0.85
    assert long < max(ends) * 1.15


def test_a_gap_does_not_hide_it():
    weight = np.ones(SECONDS.size)
    weight[9000:14_000] = 0.0
    short, long = seen(wheel() + noise(), weight=weight).periods_s
    assert 40.0 < short < 46.0
    assert 45.0 < long < 52.0


def test_noise_has_nothing_fast():
    assert all(seen(noise(seed)) is None for seed in range(20))


def test_slow_structure_is_not_fast():
    assert seen(0.3 * np.sin(2 * np.pi * SECONDS / 5600.0) + noise()) is None


def test_what_is_inside_the_bins_has_a_size_and_no_periods():
    """A tone faster than the search's means shows in the native residual alone."""
    said = seen(noise(), native=0.3)
    assert said.rms_nT == pytest.approx(np.sqrt(0.3**2 - NOISE**2), rel=0.05)
    assert said.periods_s is None
    assert said.faster_than_s == 6 * STEP_S


def test_white_residual_above_a_floor_that_is_too_low_has_no_periods():
    assert seen(noise(), floor=0.5 * NOISE).periods_s is None


def test_an_unknown_floor_says_nothing():
    assert seen(wheel() + noise(), floor=float("nan")) is None
