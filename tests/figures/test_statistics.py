"""Size, noise floor and dependences of a residual against what is known of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from inflight.statistics import dependence, joined, size_of, spectrum, strongest

finite = st.floats(-1e4, 1e4, allow_nan=False)
values = arrays(np.float64, st.integers(1, 60), elements=finite | st.just(float("nan")))


@given(st.lists(values, min_size=1, max_size=5))
def test_sizes_joined_are_the_size_of_everything_together(parts):
    whole, together = size_of(np.concatenate(parts)), joined([size_of(part) for part in parts])
    assert together.count == whole.count
    for name in ("mean", "std", "rms", "least", "largest"):
        assert getattr(together, name) == pytest.approx(getattr(whole, name), abs=1e-9, rel=1e-9, nan_ok=True)


def test_the_size_of_nothing_is_not_a_number_and_joins_as_nothing():
    nothing, something = size_of(np.full(5, np.nan)), size_of(np.array([3.0, 4.0]))
    assert nothing.count == 0
    assert np.isnan(nothing.rms)
    assert joined([nothing, something]) == something
    assert joined([]).count == 0


def test_the_robust_sigma_is_that_of_normal_noise_and_outliers_do_not_move_it():
    noise = np.random.default_rng(0).normal(5.0, 2.0, 100_000)
    noise[::100] = 1e4
    assert size_of(noise).robust == pytest.approx(2.0, rel=0.03)
    assert size_of(noise).std > 500


def test_segments_with_a_gap_are_left_out_of_the_spectrum():
    residual = np.random.default_rng(1).normal(0.0, 1.0, 40_000)
    residual[10_000:10_050] = np.nan
    frequency, power = spectrum(residual, 1.0)
    assert np.isfinite(power).all()
    assert frequency[-1] == 0.5
    assert np.trapezoid(power, frequency) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("residual", [np.empty(0), np.zeros(10), np.full(5000, np.nan)])
def test_too_little_has_no_spectrum(residual):
    frequency, power = spectrum(residual, 1.0)
    assert frequency.size == power.size == 0


COUNT, BLOCKS = 14_400, 80
BLOCK = np.repeat(np.arange(BLOCKS), COUNT // BLOCKS)


def correlated(generator, level=0.05):
    """Noise that is the same for a while: samples of a block are not independent, blocks are."""
    slow = np.repeat(generator.normal(0, level / 2, COUNT // 30), 30)
    return slow + generator.normal(0, level, COUNT)


def test_an_injected_dependence_is_found_with_its_size_and_an_honest_sigma():
    found, coordinate = [], 3.0 * np.sin(np.arange(COUNT) / 211.0)
    injected = 0.02 * coordinate
    for seed in range(60):
        noise = correlated(np.random.default_rng(seed))
        found.append(dependence("current", "A", coordinate, 7.0 + injected + noise, BLOCK))
    amplitude = np.array([one.amplitude for one in found])
    sigma = np.array([one.sigma_amplitude for one in found])
    # Within a bin of the coordinate the dependence is averaged: of its rms a percent is lost.
    assert amplitude.mean() == pytest.approx(injected.std(), rel=0.02)
    assert sigma.mean() == pytest.approx(amplitude.std(), rel=0.35)
    pulls = np.abs(amplitude - injected.std()) / sigma
    assert np.mean(pulls < 2.0) > 0.85
    assert all(one.coordinate == "current" for one in strongest(found))
    assert "follows current" in found[0].sentence
    assert " A" in found[0].sentence


def test_the_error_bars_of_the_bins_cover_the_truth():
    coordinate = 3.0 * np.sin(np.arange(COUNT) / 211.0)
    inside = []
    for seed in range(30):
        noise = correlated(np.random.default_rng(1000 + seed))
        one = dependence("current", "A", coordinate, noise, BLOCK)
        inside.append(np.abs(one.mean) < one.sigma)
    assert np.mean(inside) == pytest.approx(0.68, abs=0.08)


def test_pure_noise_is_called_a_dependence_in_fewer_than_one_of_twenty_seeds():
    coordinate = 3.0 * np.sin(np.arange(COUNT) / 211.0)
    alarms = 0
    for seed in range(100):
        noise = correlated(np.random.default_rng(2000 + seed))
        alarms += bool(strongest([dependence("current", "A", coordinate, noise, BLOCK)]))
    assert alarms < 5


@pytest.mark.parametrize(
    ("coordinate", "block"),
    [
        (np.ones(100), np.arange(100)),
        (np.full(100, np.nan), np.arange(100)),
        (np.arange(100.0), np.zeros(100, dtype=int)),
    ],
)
def test_a_coordinate_that_says_nothing_gives_no_dependence(coordinate, block):
    assert dependence("constant", "", coordinate, np.random.default_rng(0).normal(size=100), block) is None


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_missing_values_do_not_change_what_the_others_say(seed):
    generator = np.random.default_rng(seed)
    coordinate, residual = generator.normal(size=600), generator.normal(size=600)
    block = np.repeat(np.arange(10), 60)
    keep = generator.random(600) > 0.3
    some = dependence("c", "", coordinate[keep], residual[keep], block[keep])
    holes = dependence("c", "", np.where(keep, coordinate, np.nan), residual, block)
    np.testing.assert_allclose(some.mean, holes.mean)
    np.testing.assert_allclose(some.sigma, holes.sigma)
