"""Dependences of a residual on a coordinate: sizes, honest uncertainties, branches, the axis behind them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.residual.dependence import axis_response, dependence

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
    assert all(one.coordinate == "current" and one.is_clear for one in found)


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
        alarms += dependence("current", "A", coordinate, noise, BLOCK).is_clear
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


TIME = np.arange(COUNT)
SLOW = 3.0 * np.sin(TIME / 211.0)


def test_a_field_that_lags_its_coordinate_has_two_branches():
    lagged = 0.1 * np.sin((TIME - 60) / 211.0)
    opened, closed = [], []
    for seed in range(20):
        noise = correlated(np.random.default_rng(seed))
        rising = np.gradient(SLOW)
        opened.append(dependence("warmth", "K", SLOW, lagged + noise, BLOCK, rising).loop)
        closed.append(dependence("warmth", "K", SLOW, 0.03 * SLOW + noise, BLOCK, rising).loop)
    # Branches of an ellipse: 2 sin(lag) cos(phase) apart, weighted by where the coordinate stays.
    expected = 2 * 0.1 * np.sin(60 / 211.0) * np.sqrt(0.5)
    assert np.mean([loop.opening for loop in opened]) == pytest.approx(expected, rel=0.05)
    assert all(loop.is_open for loop in opened)
    assert opened[0].rising.mean[12] < opened[0].falling.mean[12]
    assert sum(loop.is_open for loop in closed) <= 1


def test_a_bin_that_only_one_block_meets_has_no_error_bar():
    coordinate = BLOCK.astype(float)
    found = dependence("time", "d", coordinate, correlated(np.random.default_rng(0)), BLOCK, bins=80)
    assert found is None
    found = dependence("time", "d", coordinate, correlated(np.random.default_rng(0)), BLOCK, bins=20)
    assert np.isfinite(found.sigma).all()
    assert (found.sigma > 0).all()


def test_two_states_are_two_bins():
    switch = (TIME // 90 % 2).astype(float)
    found = dependence("switch", "", switch, 0.2 * switch + correlated(np.random.default_rng(1)), BLOCK)
    assert found.centre == pytest.approx([0.0, 1.0])
    assert np.diff(found.mean)[0] == pytest.approx(0.2, abs=4 * found.sigma.max())


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_axis_of_a_field_is_told(axis):
    """A field along one axis that follows the coordinate, seen through a direction that turns."""
    turn, tilt = TIME / 37.0, 0.9 * np.sin(TIME / 1013.0)
    direction = np.stack([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)], axis=1)
    inside, amplitudes = [], []
    for seed in range(20):
        noise = correlated(np.random.default_rng(seed))
        found = axis_response(
            "current", "A", SLOW, 0.05 * SLOW * direction[:, axis] + noise, direction, BLOCK
        )
        assert found.axis == "xyz"[axis]
        truth = np.zeros((found.centre.size, 3))
        truth[:, axis] = 0.05 * (found.centre - found.centre.mean())
        inside.append(np.abs(found.field - truth)[:, axis] < 3 * found.sigma[:, axis])
        amplitudes.append(found.amplitude[axis])
    assert np.mean(inside) > 0.9
    assert np.mean(amplitudes) == pytest.approx(0.05 * SLOW.std(), rel=0.06)


def test_a_direction_that_does_not_turn_tells_no_axis():
    direction = np.tile([0.6, 0.0, 0.8], (COUNT, 1))
    assert axis_response("current", "A", SLOW, 0.05 * SLOW, direction, BLOCK) is None


def test_noise_along_no_axis_is_called_one_in_few_seeds():
    turn = TIME / 37.0
    direction = np.stack([np.cos(turn), np.sin(turn) * 0.8, np.sin(turn) * 0.6 + 0.0 * turn], axis=1)
    direction[:, 2] = np.sin(TIME / 91.0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    called = 0
    for seed in range(40):
        noise = correlated(np.random.default_rng(seed))
        called += bool(axis_response("current", "A", SLOW, noise, direction, BLOCK).axis)
    assert called <= 4
