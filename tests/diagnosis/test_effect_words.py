"""An effect told as a physicist would say it: what it is, its numbers in fitting units and digits."""

import pytest

from inflight.diagnosis.result import Coefficient
from inflight.diagnosis.words import numbers_text, quantity, what_it_is
from inflight.effects import known_effects


@pytest.mark.parametrize(
    ("value", "sigma", "unit", "text"),
    [
        (-6.80e-4, 2.9e-6, "nT/mA", "-0.6800 +- 0.0029 nT/A"),
        (9.744e-7, 2.4e-9, "nT/mA^2", "+0.9744 +- 0.0024 nT/A^2"),
        (1.791e-7, 1.1e-9, "1/d", "+0.1791 +- 0.0011 ppm/d"),
        (0.0146, 0.0004, "s", "+14.60 +- 0.40 ms"),
        (1.25, 0.021, "nT", "+1.250 +- 0.021 nT"),
        (0.031, 0.0042, "nT", "+31.0 +- 4.2 pT"),
        (2.0e-4, 1.1e-5, "deg", "+0.720 +- 0.040 arcsec"),
        (1234.5, 120.0, "nT/A", "+1234 +- 120 nT/A"),
        (3.0, 0.0, "1", "+3"),
    ],
)
def test_numbers_have_two_digits_of_their_error_and_a_fitting_unit(value, sigma, unit, text):
    assert quantity(value, sigma, unit) == text


def test_only_numbers_that_stand_out_are_told():
    axes = [("x", 0.5, 0.01), ("y", 0.004, 0.01), ("z", -1.0, 0.01)]
    numbers = [Coefficient(f"coefficient[{axis}]", v, s, "nT/A", "fgm") for axis, v, s in axes]
    assert numbers_text(numbers) == "+0.500 +- 0.010 nT/A on x, -1.000 +- 0.010 nT/A on z"
    assert numbers_text([numbers[1]]) == ""
    assert numbers_text([Coefficient("seconds", 0.012, 0.001, "s", "ovm")]) == "+12.0 +- 1.0 ms"


@pytest.mark.parametrize(
    ("name", "channels", "text"),
    [
        ("channel_field(heater)", ("heater",), "a field that follows heater"),
        ("channel_field(heater)@lag=240s", ("heater",), "a field that follows heater"),
        ("channel_field(a*b)", ("a", "b"), "a field that follows the product of a and b"),
        ("offset_step@2005-01-03", (), "offsets that step"),
        ("day_night", (), "a field that is there in sunlight only"),
        ("cold_heater", ("heater",), "a current effect that follows heater"),
    ],
)
def test_an_effect_is_told_by_what_it_does(name, channels, text):
    assert what_it_is(name, channels, "current") == text


def test_every_effect_of_the_library_has_words_of_its_own():
    sensors = {"vector_sensor", "spinning_sensor", "wander"}
    for name, kind in known_effects().items():
        if name not in sensors:
            assert "effect" not in what_it_is(name, ("channel",), kind.family), name
