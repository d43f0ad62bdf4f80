"""States and units: as many as there are, told through drift and gaps; none from noise."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linear_sum_assignment
from switching_cases import case, power_law, switched

from inflight.dual import Readings, correction_by_states, train
from inflight.dual.segments import DriftFilter, DriftRate, segments_of
from inflight.dual.states import find_states, find_units
from inflight.simulate.dual import DualSettings, simulate_dual_day


def told(made):
    segments = segments_of(made.readings)
    states = find_states(segments)
    middle = (segments.first + segments.last) // 2
    return segments, states, made.code[middle]


@pytest.mark.parametrize(
    "options", [{}, {"drift": 1.0}, {"noise": 0.3}, {"gaps": 8}, {"rate": 10.0}], ids=str
)
@pytest.mark.parametrize("seed", [301, 302])
def test_the_states_are_those_that_are_there(seed, options):
    _segments, states, true = told(case(seed, **options))
    steady = states.label >= 0
    pairs = set(zip(states.label[steady].tolist(), true[steady].tolist(), strict=True))
    assert len(states) == len(np.unique(true)) == len(pairs)


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_is_one_state(seed):
    _segments, states, _ = told(case(400 + seed, units=1, switches=0))
    assert len(states) == 1


@pytest.mark.parametrize("seed", range(3))
def test_a_drifting_difference_without_switching_is_one_state(seed):
    _segments, states, _ = told(case(420 + seed, units=1, switches=0, drift=3.0))
    assert len(states) == 1


@pytest.mark.parametrize("seed", [311, 312, 313])
def test_units_are_told_from_states_some_of_which_several_make(seed):
    made = case(seed, together=0.4)
    _segments, states, _ = told(made)
    units = find_units(states)
    assert units.consistent
    assert len(units) == 4
    for vector in made.unit_difference:
        apart = np.minimum(
            np.abs(units.vector - vector).max(axis=1), np.abs(units.vector + vector).max(axis=1)
        )
        assert apart.min() < 0.03


def test_units_that_always_switch_together_are_one():
    random = np.random.default_rng(5)
    on = switched(random, 40_000, 3, 60, 0.0)
    made = case(321, on=np.column_stack([on, on[:, 0]]), units=4)
    units = find_units(told(made)[1])
    assert len(units) == 3
    both = made.unit_difference[0] + made.unit_difference[3]
    assert min(np.abs(np.abs(units.vector) - np.abs(both)).max(axis=1)) < 0.03


def test_a_combination_that_was_never_seen_is_predicted():
    on = switched(np.random.default_rng(8), 40_000, 3, 60, 0.2)
    # All three together never happens.
    on[:, 2] *= ~(on[:, 0] & on[:, 1]).astype(bool)
    made = case(322, on=on, units=3)
    units = find_units(told(made)[1])
    unseen = units.unseen()
    assert len(unseen) == 1
    predicted, spread = units.centre(unseen)
    seen, _ = units.centre(units.occupancy)
    wanted = made.unit_difference.sum(axis=0)
    # The sensors' difference is zero with all units off: the base is one of the states.
    found = predicted[0] - seen[np.argmin(np.linalg.norm(seen, axis=1))]
    assert_allclose(found, wanted, atol=0.02)
    assert np.sqrt(np.einsum("ii->i", spread[0])).max() < 0.02


def test_without_proof_of_separate_units_none_are_claimed():
    on = np.zeros((6_000, 2), dtype=int)
    on[2_000:4_000, 0] = 1
    on[4_000:, 1] = 1
    units = find_units(told(case(323, on=on, units=2, count=6_000))[1])
    assert not units.consistent
    assert "no sum" in units.reason


@pytest.mark.parametrize("seed", range(821, 825))
def test_states_are_not_split_where_offsets_wander_by_many_errors(seed):
    # Each level is known to a few picotesla, and the offset wanders by a hundred.
    settings = DualSettings(days=1, seed=seed, overrides={"cadence": 4.0})
    day = simulate_dual_day(settings, "2006-05-14")
    stamps = day.instruments["ob"]["Epoch"].values.astype(np.int64)
    turned = day.instruments["ib"]["B_RAW"].values @ np.array(
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    )
    found = find_states(segments_of(Readings(stamps, turned, day.instruments["ob"]["B_RAW"].values)))
    assert abs(len(found) - np.unique(day.truth["STATE"].values).size) <= 1


@pytest.mark.parametrize("drift", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("units", [2, 5])
def test_states_are_those_that_are_there_however_the_offset_drifts(units, drift):
    _segments, states, true = told(case(7_000 + units, units=units, drift=drift))
    steady = states.label >= 0
    pairs = set(zip(states.label[steady].tolist(), true[steady].tolist(), strict=True))
    assert len(states) == len(np.unique(true)) == len(pairs)


@pytest.mark.parametrize("walk", [0.3, 1.0])
def test_states_said_with_confidence_are_right_where_the_offset_wanders(walk):
    right, said = 0, 0
    for seed in range(7_100, 7_103):
        made = case(seed, units=2 + seed % 4)
        away = power_law(np.random.default_rng(seed), len(made.readings), walk, 2.0)
        readings = Readings(made.readings.stamps, made.readings.inboard + away, made.readings.outboard)
        found = correction_by_states(readings, train(readings))
        segments = segments_of(readings)
        middle = ((segments.first + segments.last) // 2)[~segments.transient]
        state, true = found.state[middle], made.code[middle]
        sure = (state >= 0) & (found.probability[middle] >= 0.95)
        table = np.zeros((found.state.max() + 1, made.code.max() + 1), dtype=int)
        np.add.at(table, (state[sure], true[sure]), 1)
        # One state of the training for each that there is.
        right += int(table[linear_sum_assignment(-table)].sum())
        said += int(sure.sum())
    assert right >= 0.95 * said


def test_a_drift_that_nobody_looks_at_keeps_a_covariance():
    rate = DriftRate(*(np.full(3, one) for one in (1e-2, 1e-2, 0.0)))
    track = DriftFilter.start(rate)
    for _ in range(200):
        track.forward(10.0)
        assert (np.linalg.eigvalsh(track.covariance) >= -1e-9 * track.covariance[:, 0, 0].max()).all()
