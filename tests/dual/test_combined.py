"""States and gradiometer together: each where it knows more."""

import numpy as np

from inflight.dual import Readings, correction_by_states, train
from inflight.dual.candidates import combined_correction, state_fields, state_rows
from inflight.dual.gradiometer import fit_gradiometer
from inflight.time import SECOND

COUNT = 8000


def world(seed):
    """Two units of different factors that switch, and a current that follows a load."""
    random = np.random.default_rng(seed)
    time = np.arange(COUNT)
    on = [
        (np.searchsorted(np.cumsum(random.exponential(250, 200)), time) % 2).astype(float) for _ in range(2)
    ]
    load = np.sin(2 * np.pi * time / 700.0)
    difference = on[0][:, None] * [3.0, -1.0, 0.5] + on[1][:, None] * [-0.5, 2.0, 1.0]
    stray = on[0][:, None] * [1.2, -0.5, 0.1] + on[1][:, None] * [-0.1, 0.9, 0.6]
    difference = difference + load[:, None] * [0.3, -0.1, 0.05]
    stray = stray + load[:, None] * [0.12, -0.05, 0.01]
    ambient = np.cumsum(random.normal(0, 0.02, (COUNT, 3)), axis=0)
    outboard = ambient + stray + random.normal(0, 0.03, (COUNT, 3))
    inboard = ambient + stray + difference + random.normal(0, 0.03, (COUNT, 3))
    return Readings(time * SECOND, inboard, outboard), stray


def error(field, stray):
    known = np.isfinite(field).all(axis=1)
    return float((field - stray)[known].std(axis=0).mean())


def test_a_current_within_a_state_is_taken_off_too():
    readings, stray = world(1)
    training = train(readings)
    states = correction_by_states(readings, training)
    gradiometer = fit_gradiometer(readings)
    both = combined_correction(readings, training, states, gradiometer)
    assert error(both.field, stray) < error(states.field, stray)
    load = np.sin(2 * np.pi * np.arange(COUNT) / 700.0)
    kept = [np.abs(load @ (one.field - stray - (one.field - stray).mean(axis=0))) for one in (both, states)]
    assert kept[0].sum() < 0.3 * kept[1].sum()
    assert both.method == "combined"
    assert np.array_equal(both.state, states.state)


def test_reference_state_stays_zero_and_the_others_are_surer_than_from_steps_alone():
    readings, _ = world(2)
    training = train(readings)
    value, covariance = state_fields(training, fit_gradiometer(readings))
    reference = np.flatnonzero(training.number == training.reference)
    assert np.all(value[reference] == training.correction[reference])
    size = np.einsum("sii->s", covariance)
    assert np.all(size <= 1.0001 * np.einsum("sii->s", training.covariance))


def test_unknown_states_have_no_place():
    readings, _ = world(3)
    training = train(readings)
    numbers = np.append(training.number[::-1], [-1, -2, 10_000])
    place = state_rows(training, numbers)
    assert np.array_equal(training.number[place[: len(training)]], numbers[: len(training)])
    assert np.all(place[len(training) :] == -1)
