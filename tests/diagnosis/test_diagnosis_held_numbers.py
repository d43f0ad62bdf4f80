"""A number that the model holds in an option, or the mission in its file, is told instead of a new effect."""

from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import NOISE_NT, POLAR, case_of, flight_of, read

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


@lru_cache(maxsize=None)
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
