"""One zero among several: offsets far apart are held against each other, and a tie is said to be one."""

from dataclasses import replace

import numpy as np
import pytest
from nature import magnetosheath, solar_wind, stamps
from weather import sheath, wind

from inflight.simulate.spinning import SPACECRAFT_PRESETS
from inflight.simulate.spinning import solar_wind as turbulent
from inflight.zero_level import Intervals, OffsetSearch, combine_methods, minimum_correlation
from inflight.zero_level.combination import (
    LIKELIHOOD_SETTINGS,
    compare_estimates,
    likelihood_ratio,
    log_likelihood,
    most_likely_offset,
    without_ambiguous_axes,
)
from inflight.zero_level.methods import mirror_mode

#: Despun axes, and a ground value that says little.
AXIAL = OffsetSearch(free=(False, False, True), bound=30.0)


def along_axis(times, field, offset, length=900.0):
    return Intervals.of(times, field + np.array([0.0, 0.0, offset]), length)


def half_minutes(hours, seed, size):
    seconds = np.arange(0.0, hours * 3600.0, 30.0)
    return stamps(seconds.size, 30.0), turbulent(
        seconds, seed, 0, replace(SPACECRAFT_PRESETS["imp8"], field=size)
    )


@pytest.mark.parametrize("offset", [-9.0, -3.8, 6.5])
@pytest.mark.parametrize(
    ("nature", "length"),
    [
        (lambda: half_minutes(24.0, 41, 6.0), 900.0),
        (lambda: solar_wind(np.random.default_rng(42), cadence=30.0, size=6.0), 900.0),
        (lambda: wind(43, cadence=30.0, size=6.0), 900.0),
        (lambda: magnetosheath(np.random.default_rng(44), hours=6.0), 300.0),
        (lambda: sheath(45, hours=6.0), 300.0),
    ],
)
def test_the_most_evident_offset_lies_near_the_truth_in_rotations_and_in_compressions(nature, length, offset):
    intervals = along_axis(*nature(), offset, length)
    found = most_likely_offset(intervals, np.zeros(3), AXIAL)
    assert abs(found[2] - offset) < 1.5
    said = log_likelihood(intervals, found)
    for far in (-25.0, 25.0):
        assert (
            likelihood_ratio(said, log_likelihood(intervals, np.array([0.0, 0.0, far])))
            > LIKELIHOOD_SETTINGS.rejected
        )


def test_two_methods_that_agree_on_a_false_zero_are_not_believed():
    """Far from the truth mirror mode and minimum correlation share a zero: turning looks compressional."""
    seen = 0
    for seed in range(8):
        intervals = along_axis(*half_minutes(24.0, 50 + seed, 6.0), -3.8)
        near = replace(AXIAL, near=(0.0, 0.0, 8.0))
        for method in (mirror_mode, minimum_correlation):
            one = method(intervals, None, near)
            if one.determined[2] and abs(one.value[2] + 3.8) > 5.0 * one.sigma[2]:
                seen += 1
                held = without_ambiguous_axes(intervals, one, AXIAL)
                assert not held.determined[2]
                assert "the readings refuse it" in held.reasons[-1]
        found = combine_methods(intervals, AXIAL).estimate
        assert not found.determined[2] or abs(found.value[2] + 3.8) < 4.0 * found.sigma[2]
    assert seen


def test_a_field_that_fluctuates_alike_in_all_directions_tells_no_offset():
    """Nothing in it belongs to any direction of the mean field: each offset does as well as another."""
    generator = np.random.default_rng(46)
    field = np.array([3.0, -2.0, 1.0]) + 0.4 * generator.normal(size=(2880, 3))
    intervals = along_axis(stamps(2880, 30.0), field, 2.0)
    own = log_likelihood(intervals, np.array([0.0, 0.0, 2.0]))
    assert (
        abs(likelihood_ratio(own, log_likelihood(intervals, np.array([0.0, 0.0, 12.0]))))
        < LIKELIHOOD_SETTINGS.rejected
    )
    estimate = minimum_correlation(intervals, None, AXIAL)
    claimed = replace(estimate, determined=np.array([False, False, True]), solution=np.array([0.0, 0.0, 2.0]))
    held = without_ambiguous_axes(intervals, claimed, AXIAL)
    assert not held.determined.any()
    assert held.solution[2] == 0.0
    assert np.isinf(held.sigma[2])
    assert "cannot tell z" in held.reasons[-1]


def test_the_sign_of_intervals_counts_and_not_how_strong_the_wind_was():
    generator = np.random.default_rng(47)
    strength = np.repeat(np.exp(generator.normal(size=12)), 8)
    nothing = np.zeros(96)
    assert likelihood_ratio(strength, nothing) > 2 * LIKELIHOOD_SETTINGS.rejected
    tossed = [
        abs(likelihood_ratio(strength * generator.choice([-1.0, 1.0], 96), nothing)) for _ in range(400)
    ]
    assert np.mean(np.array(tossed) < LIKELIHOOD_SETTINGS.rejected) > 0.98
    # Four intervals cannot refuse anything, were they never so sure.
    assert likelihood_ratio(np.ones(4), np.zeros(4)) < LIKELIHOOD_SETTINGS.rejected


def test_two_roads_to_one_zero_agree():
    """Two answers from the same intervals differ by nothing, or by what a solution is settled to."""
    times, field = solar_wind(np.random.default_rng(48), hours=12.0)
    found = minimum_correlation(along_axis(times, field, 1.0), None, AXIAL)
    assert compare_estimates(found, found).agrees
    assert compare_estimates(found, replace(found, solution=found.solution + 5e-5)).agrees
