"""What other blocks, folds or wider bins turn over is told fragile; what they merely show less of is not."""

from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import POLAR, STEP_S, case_of, flight_of, read, slow_noise, with_channels

from inflight.diagnosis import Native
from inflight.diagnosis.choices import turned_over
from inflight.diagnosis.stepwise import RivalCheck
from inflight.samples import slow_response

SIZE = np.array([0.15, -0.1, 0.12])
#: Noise of the channel that is the cause, and by how much another one differs from it; its own size is 1.
NOISY, UNLIKE, SEEDS = 0.09, 0.062, 4
CAUSE, LIKE = "channel_field(battery_current)", "channel_field(payload_current)"


@lru_cache(maxsize=2)
def alike(noisy=NOISY):
    """A battery current is the cause, and recorded with noise; the load's is nearly the same, without any."""
    flight = flight_of(POLAR, 40)
    generator = np.random.default_rng(3)
    count = flight.tt2000.size
    cause = slow_noise(generator, count, 12_000.0, 1.0)
    flight = with_channels(
        flight,
        battery_current=cause + generator.normal(0.0, noisy, count),
        payload_current=cause + slow_noise(generator, count, 12_000.0, UNLIKE),
    )
    readings = [read(flight, seed, field=cause[:, None] * SIZE) for seed in range(SEEDS)]
    return case_of(flight, readings, channels=("battery_current", "payload_current"))


@pytest.mark.parametrize("seed", range(SEEDS))
def test_an_effect_that_another_one_beats_in_wider_bins_is_fragile(seed):
    """Row by row the quiet channel does better, and in means of ten rows the right one."""
    found = alike().diagnose(seed)
    (effect,) = found.effects
    assert effect.name == LIKE
    assert effect.t > 3.0
    # Row by row it is the noise of the right one that makes the difference.
    assert [name.split("@")[0] for name in effect.rivals] == [CAUSE]
    assert effect.status == "fragile"
    assert found.verdict == "CONFOUNDED"
    (turn,) = effect.turned_over_by
    assert (turn.choice, turn.rival) == (f"in means of {10 * STEP_S:g} s", CAUSE)
    assert f"fragile: in means of 1200 s {CAUSE} explains more (t = {turn.t:.1f})" in found.sentence
    assert found.as_json()["effects"][0]["turned_over_by"] == [turn.as_json()]


def test_each_choice_turns_over_what_should_never_have_been_taken():
    case = alike(0.0)
    search, data = case.search(), case.material()
    options = {one.name: one for one in search.options}
    search = search.add(options[LIKE])
    check = RivalCheck(
        option=options[LIKE],
        gain=0.5,
        t=9.0,
        p=0.0,
        placebo_t=9.0,
        form="raw",
        rivals=(),
        near=(options[CAUSE],),
    )
    turns = turned_over(search, data, [check], {LIKE: np.zeros(3)}, Native(search, STEP_S))[LIKE]
    assert {one.rival for one in turns} == {CAUSE}
    assert [one.choice for one in turns] == [
        "with blocks of twice the length",
        "with blocks of twice the length, begun half of one later",
        "with every 13th block held out",
        "with 6 folds",
        "at the samples' own cadence of 120 s",
        "in means of 360 s",
        "in means of 1200 s",
    ]


@lru_cache(maxsize=1)
def clear():
    """Effects of every kind beside noise, and nothing."""
    flight = flight_of(POLAR, 20)
    size = np.linalg.norm(flight["field"], axis=1)
    step = (np.arange(size.size) > 0.4 * size.size)[:, None] * np.array([1.0, -0.8, 0.9])
    hidden = {
        "field": {"field": flight["heater_current"][:, None] * np.array([0.5, -0.4, -0.8])},
        "lag": {"field": slow_response(flight["solar_current"], STEP_S, 1100.0)[:, None] * 5.0 * SIZE},
        "clock": {"scalar": 0.05 * np.gradient(size, STEP_S)},
        "step": {"field": step},
        "two": {
            "field": flight["payload_current"][:, None] * np.array([0.5, 0.4, -0.8])
            + flight["boom_temperature"][:, None] * np.array([0.02, 0.04, -0.08])
        },
        "small": {"field": flight["heater_current"][:, None] * np.array([0.05, -0.06, 0.06])},
        "nothing": {},
    }
    readings = [read(flight, 50 + seed, **one) for seed, one in enumerate(hidden.values())]
    return list(hidden), case_of(flight, readings)


@pytest.mark.parametrize("name", ["field", "lag", "clock", "step", "two", "small"])
def test_no_choice_turns_over_a_right_answer(name):
    names, case = clear()
    effects = case.diagnose(names.index(name)).effects
    assert len(effects) >= (2 if name == "two" else 1)
    assert [one.turned_over_by for one in effects] == [()] * len(effects)
    assert "fragile" not in {one.status for one in effects}


def test_of_nothing_nothing_turns_over():
    names, case = clear()
    found = case.diagnose(names.index("nothing"))
    assert found.verdict == "NOTHING_LEFT"
    assert not found.effects


def test_values_that_move_beyond_their_errors_turn_over():
    """The effect is another one in the quick part than in the slow: wider bins show the slow one alone."""
    flight = flight_of(POLAR, 20)
    quick = np.random.default_rng(8).normal(0.0, 1.0, flight.tt2000.size)
    slow = slow_noise(np.random.default_rng(9), flight.tt2000.size, 20_000.0, 1.0)
    flight = with_channels(flight, payload_current=quick + slow)
    reading = read(flight, 3, field=(quick + 0.4 * slow)[:, None] * SIZE)
    case = case_of(flight, [reading], channels=("payload_current",))
    search, data = case.search(), case.material()
    option = next(one for one in search.options if one.name == LIKE)
    search = search.add(option)
    check = RivalCheck(option=option, gain=0.5, t=9.0, p=0.0, placebo_t=9.0, form="raw", rivals=())
    turns = turned_over(search, data, [check], {LIKE: np.full(3, 1e-3)})[LIKE]
    assert [(one.choice, one.rival) for one in turns] == [
        ("in means of 360 s", ""),
        ("in means of 1200 s", ""),
    ]
    assert all(one.t > 3.0 for one in turns)
    # Where the errors that are told reach so far it is no other answer.
    assert not turned_over(search, data, [check], {LIKE: np.full(3, 0.5)})[LIKE]
