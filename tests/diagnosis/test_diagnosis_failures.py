"""Cases in which searches like this one have gone wrong: a hidden effect each, on a small orbit."""

from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import CHANNELS, DAWN_DUSK, POLAR, STEP_S, case_of, flight_of, read, with_channels

from inflight.samples import slow_response
from inflight.samples.derived import play

#: A switch nobody recorded: 41 minutes, on for two fifths of them.
SWITCH_S, DUTY = 2460.0, 0.4
LAG_S, HEATER = 360.0, np.array([1.0, 0.0, -0.8])
BIAS_NT = 0.4
USED = ("battery_current", "boom_temperature", "heater_current")


@lru_cache(maxsize=1)
def polar():
    """Forty days of a polar orbit; residuals of a lag, a hysteresis, a switch and a bias."""
    flight = flight_of(POLAR, 40)
    seconds = STEP_S * np.arange(flight.tt2000.size)
    slow = slow_response(flight["heater_current"], STEP_S, LAG_S)
    loop = play(flight["boom_temperature"], 10.0)
    switch = 0.35 * (seconds % SWITCH_S < DUTY * SWITCH_S)
    hidden = [
        read(flight, 1, slow[:, None] * HEATER),
        read(flight, 6, (loop - loop.mean())[:, None] * np.array([0.03, 0.0, 0.06])),
        read(flight, 3, switch[:, None] * np.array([0.0, 0.0, 1.0])),
        read(flight, 4, 0.0, BIAS_NT),
    ]
    return case_of(flight, hidden, channels=USED)


@lru_cache(maxsize=1)
def in_full_sun():
    """Seven days in which the Sun never sets; residuals of a steady field and of a coil's temperature."""
    flight = flight_of(DAWN_DUSK, 7)
    warm = (flight["coil_temperature"] - 5.0)[:, None] * np.array([0.1, 0.0, 0.1])
    hidden = [read(flight, 0, np.array([0.2, 0.0, 0.3])), read(flight, 1, warm)]
    return case_of(flight, hidden, channels=CHANNELS[1:4], block_days=1 / 14)


@lru_cache(maxsize=1)
def with_thermometer():
    """Ten days in which a heater warms the boom; residuals of the boom's temperature and of the current."""
    flight = flight_of(POLAR, 10)
    current = flight["heater_current"] / np.std(flight["heater_current"])
    warm = 10.0 * slow_response(current, STEP_S, 1800.0)
    reading = warm + np.random.default_rng(5).normal(0.0, 0.3, warm.size)
    flight = with_channels(flight, boom_temperature=reading)
    along = np.array([0.5, 0.0, 0.8])
    hidden = [read(flight, 0, 0.1 * warm[:, None] * along), read(flight, 1, 0.5 * current[:, None] * along)]
    return case_of(flight, hidden, channels=USED, block_days=0.25)


@lru_cache(maxsize=8)
def told_of(case, residual, *without):
    cases = {"polar": polar, "in_full_sun": in_full_sun, "with_thermometer": with_thermometer}
    return cases[case]().diagnose(residual, without, draws=500)


def families(told):
    return {one.family for one in told.effects}


# F1: a hysteresis that the library has not.

PLAYS = tuple(f"hysteresis({name})" for name in CHANNELS)


def test_a_hysteresis_that_the_library_has_not_is_not_called_a_battery():
    told = told_of("polar", 1, *PLAYS)
    assert not (told.verdict == "FOUND" and "battery" in families(told))


def test_a_hysteresis_that_the_library_has_not_is_not_found_under_other_names():
    told = told_of("polar", 1, *PLAYS)
    assert told.verdict != "FOUND" or families(told) <= {"temperature", "hysteresis"}
    # What several stand in for is a play of the channel that does it.
    for one in told.effects:
        assert one.status != "sure" or set(one.channels) == {"boom_temperature"}
        assert one.instead.startswith("channel_field(boom_temperature@width=") or one.status != "stand-in"


def test_a_hysteresis_that_the_library_has_is_found_with_its_width():
    told = told_of("polar", 1)
    assert (told.verdict, families(told)) == ("FOUND", {"hysteresis"})
    (one,) = told.effects
    assert float(one.name.split("width=")[1]) == pytest.approx(10.0, rel=0.05)
    assert one.channels == ("boom_temperature",)
    assert told.residual["held_out_after_nT"] < 1.05 * told.residual["noise_floor_nT"]


# F2: seven days in full Sun.


def test_in_full_sun_nobody_speaks_of_day_and_night():
    told = told_of("in_full_sun", 0)
    assert "day_night" in {one["name"] for one in told.unscorable}
    assert not told.effects
    assert told.verdict in ("NOTHING_LEFT", "NOT_IDENTIFIABLE")


def test_in_full_sun_no_wrong_name_is_given_with_confidence():
    told = told_of("in_full_sun", 1)
    assert told.verdict != "FOUND" or families(told) == {"temperature"}
    if told.verdict == "FOUND":
        assert {name for one in told.effects for name in one.channels} == {"coil_temperature"}


# F3: a lag between those of the bank.


def test_a_lag_between_those_of_the_bank_brings_no_companions():
    told = told_of("polar", 0)
    assert told.verdict == "FOUND"
    (one,) = told.effects
    assert one.channels == ("heater_current",)
    assert abs(one.lag_s - LAG_S) < max(3 * one.lag_sigma_s, 0.03 * LAG_S)
    for coefficient, truth in zip(one.coefficients, HEATER, strict=True):
        assert abs(coefficient.value - truth) < 3 * coefficient.sigma + 0.02
    assert told.residual["held_out_after_nT"] < 1.05 * told.residual["noise_floor_nT"]


# F4: an effect without a channel.


def test_an_effect_without_a_channel_is_never_called_nothing():
    told = told_of("polar", 2)
    assert told.verdict == told.remaining["verdict"] == "UNKNOWN_EFFECT"
    assert not told.effects
    assert told.signature.period_s == pytest.approx(SWITCH_S, rel=0.002)
    assert (told.signature.axis, told.signature.shape) == ("z", "square")
    assert told.signature.duty == pytest.approx(DUTY, abs=0.05)


# F5: a bias that scale factors imitate.


def test_a_bias_is_found():
    told = told_of("polar", 3)
    (one,) = told.effects
    assert one.family == "bias"
    (bias,) = one.coefficients
    assert abs(bias.value - BIAS_NT) < 3 * bias.sigma


def test_a_bias_is_found_but_said_to_be_weakly_known():
    told = told_of("polar", 3)
    (one,) = told.effects
    assert told.verdict == "CONFOUNDED" or one.retained < 0.02
    named = {rival["name"] for rival in told.confusion_set}
    assert any("scale_factor" in name for name in named)


# F6: a temperature that is read with noise, and the current that makes it, which is not.


def test_a_noisy_thermometer_stays_a_rival_of_the_current_that_warms_it():
    (one,) = told_of("with_thermometer", 0).effects
    # The slow response of the current leaves less, for it has no noise: that makes it no cause.
    assert one.status == "rivals"
    assert {name.split("@")[0] for name in (one.name, *one.rivals)} == {
        "channel_field(boom_temperature)",
        "channel_field(heater_current)",
    }


def test_a_thermometer_is_no_rival_of_a_current_that_acts_at_once():
    (one,) = told_of("with_thermometer", 1).effects
    assert (one.name, one.status, one.rivals) == ("channel_field(heater_current)", "sure", ())
