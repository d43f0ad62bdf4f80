"""Units as delivered files spell them, and the conversions of channels."""

import itertools

import pytest

from inflight.units import COMMON_UNITS, factor_and_offset, is_same_unit, parse_unit, registry


@pytest.mark.parametrize(
    ("one", "other"),
    [("Celsius", "degC"), ("deg C", "degC"), ("NT", "nT"), ("gamma", "nT"), ("counts", "count"), ("", "1")],
)
def test_spellings_found_in_delivered_files_name_the_same_unit(one, other):
    assert parse_unit(one) == parse_unit(other)


@pytest.mark.parametrize(
    ("source", "target", "factor", "offset"),
    [
        ("mA", "A", 1e-3, 0.0),
        ("degC", "K", 1.0, 273.15),
        ("degF", "degC", 5 / 9, -160 / 9),
        ("T", "nT", 1e9, 0.0),
        ("ppm", "1", 1e-6, 0.0),
    ],
)
def test_values_are_converted_by_factor_and_offset(source, target, factor, offset):
    assert factor_and_offset(source, target) == pytest.approx((factor, offset))


def test_units_known_without_the_registry_convert_as_it_does():
    for source, target in itertools.product(COMMON_UNITS, repeat=2):
        one, other = parse_unit(source), parse_unit(target)
        if one.dimensionality != other.dimensionality:
            with pytest.raises(ValueError, match="cannot become"):
                factor_and_offset(source, target)
            continue
        zero, unity = (registry().Quantity(number, one).to(other).magnitude for number in (0.0, 1.0))
        assert factor_and_offset(source, target) == (unity - zero, zero), (source, target)


def test_units_known_without_the_registry_are_the_same_where_it_says_so():
    for one, other in itertools.product([*COMMON_UNITS, "Celsius", "counts"], repeat=2):
        assert is_same_unit(one, other) == (parse_unit(one) == parse_unit(other)), (one, other)


def test_units_of_different_things_are_refused_naming_both():
    with pytest.raises(ValueError, match=r"'nT'.*'degC'"):
        factor_and_offset("nT", "degC")


@pytest.mark.parametrize("text", ["nanoteslas!", "12", "nT/"])
def test_what_is_no_unit_is_refused_with_the_text(text):
    with pytest.raises(ValueError, match="unit"):
        parse_unit(text)
