"""A number that the model holds in an option, or the mission in its file, is told instead of a new effect."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, case_of, flight_of, read
from scipy.spatial.transform import Rotation

from inflight.design import HeldNumber, design_matrix
from inflight.diagnosis.model_numbers import difference_of, line_of, words_of
from inflight.effects import panel_illumination

#: nT per unit of the channel.
FIELD = np.array([0.9, -0.6, 1.2])
DAYS, CHANNELS = 40, ("heater_current", "boom_temperature", "coil_temperature")


def entry(channel, **options):
    value = {"value": FIELD.tolist(), "free": False, "unit": "nT"}
    return {"effect": "channel_field", "name": "known", "channel": channel, "coefficient": value} | options


#: What the model holds, the channel as it acts, the number, its true value, what is missing in sigmas.
CASES = {
    "lag": (entry("heater_current@lag=400s"), "heater_current@lag=600s", "known.lag", 600.0),
    "lag as an option": (entry("heater_current", lag="400 s"), "heater_current@lag=600s", "known.lag", 600.0),
    "width": (entry("boom_temperature@width=4"), "boom_temperature@width=7", "known.width", 7.0),
    "delay": (entry("heater_current"), "heater_current@delay=150s", "heater_current.lag", 150.0),
    "about": (
        entry("heater_current*coil_temperature@about=9"),
        "heater_current*coil_temperature@about=7.5",
        "known.about[coil_temperature]",
        7.5,
    ),
}


@cache
def told_of(name):
    held, true, _, _ = CASES[name]
    flight = flight_of(POLAR, DAYS)
    noise = np.random.default_rng(7).normal(0, NOISE_NT, (flight.tt2000.size, 1))
    channel = str(held["channel"]) + (f"@lag={held['lag'].replace(' ', '')}" if "lag" in held else "")
    missing = flight.channel(true) - flight.channel(channel)
    noise[:, 0] += flight.along(missing[:, None] * FIELD)
    case = case_of(flight, [read(flight)], noise, channels=CHANNELS, held=[held])
    return case.diagnose(1, draws=500)


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_number_is_told_with_its_value_and_what_mends_it(name):
    told, (_, _, number, true) = told_of(name), CASES[name]
    (effect,) = told.effects
    assert effect.name.startswith(f"{number}@"), told.sentence
    (value,) = effect.coefficients
    held = float(effect.said.split(" is ")[1].split()[0].rstrip(","))
    assert abs(held + value.value - true) < 4 * value.sigma
    assert value.sigma < 0.1 * abs(true - held)
    assert number in effect.command or number.split(".")[0] in effect.command
    assert told.residual["held_out_after_nT"] < 1.02 * NOISE_NT


NORMALS = np.array([[0.0, 0.6, -0.8], [0.0, -0.6, -0.8]])
PANELS = np.array([0.8, -0.5, 0.3, -0.6, 0.4, 0.9])


def test_panels_that_are_turned_have_a_column_of_what_the_turn_does():
    """The column is the field of the turned panels less that of those the model holds, along the field."""
    flight = flight_of(POLAR, 10)
    held = {
        "effect": "solar_array",
        "name": "array",
        "normals": NORMALS.tolist(),
        "panels": {"value": PANELS.tolist(), "unit": "nT/A", "free": False},
    }
    noise = np.random.default_rng(8).normal(0, NOISE_NT, (flight.tt2000.size, 1))
    case = case_of(flight, [read(flight)], noise, channels=("solar_current",), held=[held])
    number = case.library.terms["array.turn_x"].difference.number
    term = difference_of(number, case.model, case.mission, 8.0)
    turned = Rotation.from_euler("x", 8.0, degrees=True).apply(NORMALS)
    after, before = (panel_illumination(flight["sun_direction"], one) for one in (turned, NORMALS))
    field = (flight["solar_current"][:, None] * (after - before)) @ PANELS.reshape(2, 3)
    column = design_matrix([term], case.rows)[:, 0, 0]
    wanted = -np.einsum("ta,ta->t", case.rows.directions["fgm"][:, 0], field)
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(column, wanted, atol=1e-9)
    assert line_of(number, 8.0, 0.3) == 'inflight set "array.turn_x=8"'


TEMPERATURE = {
    "effect": "temperature",
    "channel": "coil_temperature",
    "linear": {"value": [1e-5] * 3, "unit": "1/K", "sigma": [1e-6] * 3},
    "reference": {"value": 20.0, "unit": "degC", "free": False},
}


def test_a_reference_value_that_scale_factors_take_up_is_not_claimed():
    flight = flight_of(POLAR, 20)
    noise = np.random.default_rng(9).normal(0, NOISE_NT, (flight.tt2000.size, 1))
    case = case_of(flight, [read(flight)], noise, channels=("coil_temperature",), held=[TEMPERATURE])
    assert "temperature.reference" in case.library.terms
    search = case.search(1)
    assert "temperature.reference" not in [option.name for option in search.options]
    assert "temperature.reference" in [one["name"] for one in search.unscorable]


def test_nothing_is_called_wrong_in_a_model_that_is_right():
    flight = flight_of(POLAR, 20)
    noise = np.random.default_rng(10).normal(0, NOISE_NT, (flight.tt2000.size, 3))
    held = [entry("heater_current", lag="400 s"), TEMPERATURE]
    case = case_of(flight, [read(flight)], noise, channels=CHANNELS, held=held)
    for residual in (1, 2, 3):
        assert case.diagnose(residual, draws=500).verdict == "NOTHING_LEFT"


def test_another_field_of_its_channel_is_no_wrong_number():
    """A second coil that follows the same heater at once, elsewhere, is neither its lag nor its delay."""
    flight = flight_of(POLAR, DAYS)
    noise = np.random.default_rng(11).normal(0, NOISE_NT, (flight.tt2000.size, 1))
    noise[:, 0] += flight.along(flight["heater_current"][:, None] * np.array([0.4, 0.5, -0.3]))
    held = [entry("heater_current", lag="400 s")]
    case = case_of(flight, [read(flight)], noise, channels=CHANNELS, held=held)
    (effect,) = case.diagnose(1, draws=500).effects
    assert effect.name == "channel_field(heater_current)"


def test_a_number_that_the_model_holds_without_a_sigma_is_told_by_its_value():
    flight = flight_of(POLAR, DAYS)
    noise = np.random.default_rng(12).normal(0, NOISE_NT, (flight.tt2000.size, 1))
    noise[:, 0] += flight.along(flight["heater_current"][:, None] * np.array([0.4, 0.0, 0.0]))
    held = [
        entry("heater_current") | {"coefficient": {"value": FIELD.tolist(), "unit": "nT/A", "free": False}}
    ]
    case = case_of(flight, [read(flight)], noise, channels=CHANNELS, held=held)
    (effect,) = case.diagnose(1, draws=500).effects
    assert effect.said.startswith(
        "numbers that known of the model holds are wrong (coefficient[x] is 0.9 nT/A"
    )
    given = re.search(r"known.coefficient\[x\]=([\d.]+)", effect.command)
    assert abs(float(given[1]) - 1.3) < 4 * effect.coefficients[0].sigma


NUMBER = HeldNumber(
    name="known.lag",
    key="lag",
    effects=(("known", 0),),
    channel="heater_current",
    value=240.0,
    unit="s",
    step=12.0,
    bounds=(0.0, 8000.0),
)


def test_words_give_both_values_and_the_line_that_mends_it():
    said = words_of(NUMBER, 409.6, 12.0, "s")
    assert said == "the lag of heater_current in known is 240 s, the data say 410 +- 12 s (known.lag)"
    assert line_of(NUMBER, 409.6, 12.0) == 'inflight set "known.lag=410s"'
    mission = replace(NUMBER, name="heater_current.lag", path="instruments.house.channels.heater_current.lag")
    assert line_of(mission, 409.6, 12.0) == (
        "mission.yaml: instruments.house.channels.heater_current.lag: 410 s"
    )
