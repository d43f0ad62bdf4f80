"""Steps that are left at switchings are measured, and told with what they go."""

import numpy as np
import pytest

from inflight.dual import (
    quiet_steps,
    regress_steps,
    residual_steps_by_state,
    rms_of_steps,
    steps_across,
    switchings,
)
from inflight.dual.correction import TRANSIENT
from inflight.time import SECOND

LENGTH = 400


def scene(seed, left=0.0, wander=0.01, noise=0.02, states=40):
    """States of 400 s, the last two seconds of each in none; `left` nT a state number remain."""
    random = np.random.default_rng(seed)
    number = np.cumsum(random.integers(1, 4, states)) % 4
    state = np.repeat(number, LENGTH)
    field = np.cumsum(wander * random.normal(size=(state.size, 3)), axis=0)
    field += noise * random.normal(size=field.shape) + left * state[:, None] * np.array([1.0, 0.0, -0.5])
    state = state.copy()
    state[LENGTH - 2 :: LENGTH] = state[LENGTH - 1 :: LENGTH] = TRANSIENT
    stamps = np.arange(state.size, dtype=np.int64) * SECOND
    return state, stamps, field, number


def test_every_change_of_state_is_a_switching_and_a_gap_is_none():
    state, stamps, *_, number = scene(1)
    at = switchings(state, stamps, SECOND)
    assert len(at) == number.size - 1
    assert at.before.tolist() == number[:-1].tolist()
    assert at.after.tolist() == number[1:].tolist()
    late = stamps.copy()
    late[5 * LENGTH :] += 900 * SECOND
    assert len(switchings(state, late, SECOND)) == number.size - 2


def test_a_state_seen_again_after_a_transient_is_no_switching():
    state = np.zeros(100, dtype=np.int64)
    state[50:52] = TRANSIENT
    assert len(switchings(state, np.arange(100, dtype=np.int64) * SECOND, SECOND)) == 0


def test_without_a_stray_field_steps_at_switchings_are_those_of_anywhere():
    ratios = []
    for seed in range(20):
        state, stamps, field, _ = scene(seed)
        at = switchings(state, stamps, SECOND)
        ratios.append(rms_of_steps(steps_across(field, at)) / rms_of_steps(quiet_steps(field, at)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.08)


def test_a_field_left_in_a_state_shows_with_its_size():
    state, stamps, field, _ = scene(2, left=1.0)
    at = switchings(state, stamps, SECOND)
    steps = steps_across(field, at)
    found = regress_steps("number", steps, (at.after - at.before).astype(float))
    assert found is not None
    assert found.is_clear
    assert np.all(np.abs(found.value - [1.0, 0.0, -0.5]) < 4 * found.sigma)
    assert any(one.is_clear for one in residual_steps_by_state(at, steps))


def test_nothing_is_told_where_nothing_is_left():
    told = 0
    for seed in range(60):
        state, stamps, field, _ = scene(seed)
        at = switchings(state, stamps, SECOND)
        told += sum(one.is_clear for one in residual_steps_by_state(at, steps_across(field, at)))
    # 60 records of four states and three axes each.
    assert told <= 4


def test_short_states_and_missing_readings_give_no_step():
    state = np.repeat([0, 1, 2], [50, 3, 50])
    field = np.zeros((state.size, 3))
    stamps = np.arange(state.size, dtype=np.int64) * SECOND
    at = switchings(state, stamps, SECOND)
    assert len(at) == 2
    assert np.isnan(steps_across(field, at)).all()
    state = np.repeat([0, 1], 50)
    field[44:50] = np.nan
    at = switchings(state, stamps[:100], SECOND)
    assert np.isnan(steps_across(field[:100], at)).all()
