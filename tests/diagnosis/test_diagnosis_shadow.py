"""A field in sunlight where the Earth's shadow ends some kilometres from where the geometry has it."""

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, case_of, flight_of, read

from inflight.diagnosis import run_search
from inflight.frames import EARTH_RADIUS, days_since_j2000, rotate_with_earth, sun_direction

#: nT, by day.
FIELD = np.array([2.0, -3.0, 1.5])
DAYS = 20


def light(flight, height):
    """Return the light behind an Earth with a sharp edge, so many km beyond its radius; (time,)."""
    days = days_since_j2000(flight.tt2000)
    place, sun = rotate_with_earth(flight["position"], days, 1), sun_direction(days)
    away = np.einsum("ta,ta->t", place, sun)
    across = np.linalg.norm(place - away[:, None] * sun, axis=1)
    return np.where((away < 0) & (across < EARTH_RADIUS + height), 0.0, 1.0)


@pytest.fixture(scope="module")
def flight():
    return flight_of(POLAR, DAYS)


@pytest.mark.parametrize("height", [-12.0, 0.0, 24.0])
def test_a_field_by_day_is_told_as_that_and_nothing_beside_it(flight, height):
    case = case_of(flight, [read(flight, field=light(flight, height)[:, None] * FIELD)])
    told = case.diagnose()
    (one,) = told.effects
    assert (told.verdict, one.name) == ("FOUND", "day_night")
    found = np.array([number.value for number in one.coefficients])
    error = np.array([number.sigma for number in one.coefficients])
    assert np.abs(found - FIELD) == pytest.approx(np.zeros(3), abs=4.0 * error.max())
    assert told.residual["held_out_after_nT"] < 1.1 * NOISE_NT


def test_what_lies_at_the_edges_is_told_where_it_is_more_than_noise(flight):
    sizes = []
    for height in (0.0, 24.0):
        case = case_of(flight, [read(flight, field=light(flight, height)[:, None] * FIELD)])
        sizes.append(case.diagnose().residual["shadow_edges_nT"])
    assert sizes[1] > max(sizes[0], 0.1 * NOISE_NT)


def test_a_slow_response_to_light_keeps_its_lag(flight):
    """The edges take up what a few kilometres make, not what goes on for minutes."""
    current = flight.channel("solar_current@lag=300s")
    case = case_of(flight, [read(flight, field=current[:, None] * np.array([0.3, -0.4, 0.2]))])
    told, search = run_search(case.search(), case.material())
    (one,) = told.effects
    assert one.channels == ("solar_current",)
    assert one.lag_s == pytest.approx(300.0, rel=0.05)
    assert not {term.key for term in search.fitted_terms}
