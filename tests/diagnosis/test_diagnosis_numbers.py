"""A number that the model holds is tried before an effect is added."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from diagnosis_cases import NOISE_NT, POLAR, case_of, flight_of, read

from inflight.design import design_matrix
from inflight.diagnosis import Search
from inflight.diagnosis.stepwise import best_passing, number_that_explains, rivals_of_number

HELD = "channel_scale(coil_temperature)"
#: What the model states of its number, and by how many of it the number is off.
SIGMA, OFF = 3e-8, 25.0


@lru_cache(maxsize=1)
def searches():
    """Two searches over a model of how a scale follows a temperature: it is wrong; a field is hidden."""
    flight = flight_of(POLAR, 40)
    noise = np.random.default_rng(5).normal(0, NOISE_NT, (flight.tt2000.size, 2))
    case = case_of(flight, [read(flight)], noise, every=6, channels=("heater_current", "coil_temperature"))
    held = case.library.by_key[HELD]
    scaled = OFF * SIGMA / np.array(held.scale)
    noise[:, 0] -= design_matrix([held], case.rows)[:, 0] @ (scaled * np.array([1.0, 0.0, 1.0]))
    noise[:, 1] += flight.along(flight["heater_current"][:, None] * np.array([0.5, -0.4, -0.8]))
    case = case_of(flight, [read(flight)], noise, every=6, channels=("heater_current", "coil_temperature"))
    library = replace(
        case.library,
        refined=(replace(held, sigma=(SIGMA,) * 3),),
        candidates=[one for one in case.library.candidates if one.mechanism != HELD],
    )
    begun = case.search()
    every = Search.begin(
        case.raw, case.white, library, begun.intervals, begun.shared.days, time_variable=begun.time_variable
    )
    return tuple(replace(every, residual=residual) for residual in (1, 2))


def test_a_wrong_number_is_freed_instead_of_adding_what_does_the_same():
    search = searches()[0]
    option, _ = best_passing(search.table(), search)
    number = number_that_explains(search, option)
    assert number == f"{HELD}.coefficient"
    free = search.with_freed(number, option)
    assert best_passing(free.table(), free) is None
    assert free.freed == {number: option.name}


def test_an_effect_that_no_number_explains_is_added():
    search = searches()[1]
    option, _ = best_passing(search.table(), search)
    assert option.name == "channel_field(heater_current)"
    assert number_that_explains(search, option) is None


def test_a_number_that_had_to_be_further_off_explains_its_own_channel_only(monkeypatch):
    search = searches()[0]
    option, _ = best_passing(search.table(), search)
    known = number_that_explains.__globals__
    monkeypatch.setitem(
        known, "SELECTION_SETTINGS", replace(known["SELECTION_SETTINGS"], most_sigmas=0.5 * OFF)
    )
    assert number_that_explains(search, option) == f"{HELD}.coefficient"
    monkeypatch.setitem(known, "uses_channel_of", lambda *_: False)
    assert number_that_explains(search, option) is None


def test_what_does_as_well_as_a_held_number_is_its_rival():
    """Of the data that a field of another channel made, the number is no better explanation than that."""
    freed = searches()[1].with_freed(f"{HELD}.coefficient", searches()[1].options[0])
    assert "channel_field(heater_current)" in rivals_of_number(freed, f"{HELD}.coefficient")
    wrong = searches()[0].with_freed(f"{HELD}.coefficient", searches()[0].options[0])
    assert rivals_of_number(wrong, f"{HELD}.coefficient") == ()
