"""TT2000 against the reference library, across every leap second since 1972."""

import datetime as dt
from itertools import pairwise

import cdflib
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from inflight.time import (
    DAY,
    SECOND,
    TT2000_FILL,
    TT2000_PAD,
    as_day,
    day_bounds,
    day_of,
    day_range,
    in_leap_second,
    parse_duration,
    parse_utc,
    to_tt2000,
    to_utc,
    usual_step,
)

#: UTC days that ended with an inserted second (IERS Bulletin C).
_LEAP_DAYS = """1972-06-30 1972-12-31 1973-12-31 1974-12-31 1975-12-31 1976-12-31 1977-12-31 1978-12-31
1979-12-31 1981-06-30 1982-06-30 1983-06-30 1985-06-30 1987-12-31 1989-12-31 1990-12-31 1992-06-30
1993-06-30 1994-06-30 1995-12-31 1997-06-30 1998-12-31 2005-12-31 2008-12-31 2012-06-30 2015-06-30
2016-12-31"""
LEAP_DAYS = _LEAP_DAYS.split()
FIRST, LAST = np.datetime64("1972-01-01", "ns"), np.datetime64("2030-01-01", "ns")
stamps = st.integers(int(FIRST.astype(int)), int(LAST.astype(int)) - 1).map(
    lambda ns: np.datetime64(ns, "ns")
)


def reference_tt2000(stamp: np.datetime64) -> int:
    """TT2000 by cdflib, from broken-down UTC."""
    text = str(stamp.astype("datetime64[ns]"))
    date, clock = text.split("T")
    whole, fraction = clock.split(".")
    parts = [int(part) for part in (*date.split("-"), *whole.split(":"))]
    return int(
        cdflib.cdfepoch.compute_tt2000([*parts, int(fraction[:3]), int(fraction[3:6]), int(fraction[6:])])
    )


@given(stamps)
@example(np.datetime64("1972-01-01T00:00:00", "ns"))
@example(np.datetime64("2000-01-01T12:00:00", "ns"))
@example(np.datetime64("2029-12-31T23:59:59.999999999", "ns"))
def test_tt2000_equals_that_of_the_cdf_library(stamp):
    assert int(to_tt2000(stamp)) == reference_tt2000(stamp)


@given(stamps)
def test_utc_and_back_is_exact_to_the_nanosecond(stamp):
    assert to_utc(to_tt2000(stamp)) == stamp
    assert not in_leap_second(to_tt2000(stamp))


@pytest.mark.parametrize("day", LEAP_DAYS)
def test_a_leap_second_makes_a_day_of_86401_seconds(day):
    start, end = day_bounds(day)
    assert end - start == 86_401 * SECOND
    assert day_bounds(np.datetime64(day, "D") + 1)[0] == end, "days leave no hole between them"
    midnight = np.datetime64(day, "D") + 1
    assert end == reference_tt2000(midnight.astype("datetime64[ns]"))


@pytest.mark.parametrize("day", LEAP_DAYS)
def test_samples_of_the_inserted_second_are_marked_and_belong_to_the_day_it_ends(day):
    _, end = day_bounds(day)
    inside = end - SECOND + np.array([0, 1, SECOND // 2, SECOND - 1])
    before, after = np.array([end - SECOND - 1]), np.array([end])
    assert in_leap_second(inside).all()
    assert not in_leap_second(before).any()
    assert not in_leap_second(after).any()
    assert (day_of(inside) == np.datetime64(day, "D")).all()
    assert day_of(after)[0] == np.datetime64(day, "D") + 1
    last_second = (np.datetime64(day, "D") + np.timedelta64(86_399, "s")).astype("datetime64[ns]")
    assert (to_utc(inside) == last_second + np.array([0, 1, SECOND // 2, SECOND - 1])).all()


def test_the_table_of_leap_seconds_holds_no_other_day():
    days = np.arange("1972-01-01", "2030-01-01", dtype="datetime64[D]")
    lengths = np.diff(to_tt2000(days.astype("datetime64[ns]")))
    assert [str(day) for day in days[:-1][lengths != DAY]] == LEAP_DAYS


@given(st.lists(stamps, min_size=2, max_size=6))
def test_tt2000_keeps_the_order_of_time(some):
    ordered = np.sort(np.array(some))
    assert (np.diff(to_tt2000(ordered)) >= 0).all()


def test_missing_times_stay_missing():
    assert to_tt2000(np.datetime64("NaT")) == TT2000_FILL
    assert np.isnat(to_utc(np.array([TT2000_FILL, TT2000_PAD]))).all()


@given(st.dates(dt.date(1972, 1, 1), dt.date(2029, 12, 1)), st.integers(0, 40))
def test_a_range_of_days_is_half_open_and_covers_time_without_holes(first, count):
    days = day_range(first, first + dt.timedelta(days=count))
    assert len(days) == count
    bounds = [day_bounds(day) for day in days]
    assert all(one[1] == other[0] for one, other in pairwise(bounds))
    assert as_day(first) == np.datetime64(first, "D")


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("2005-01-31", "2005-01-31T00:00:00"),
        ("2005-01-31T12:00:00Z", "2005-01-31T12:00:00"),
        ("2005-01-31T12:00:00+00:00", "2005-01-31T12:00:00"),
        (" 2005-01-31T12:00:00.25 ", "2005-01-31T12:00:00.250"),
        (dt.datetime(2005, 1, 31, 14, tzinfo=dt.timezone(dt.timedelta(hours=2))), "2005-01-31T12:00:00"),
        (dt.date(2005, 1, 31), "2005-01-31T00:00:00"),
    ],
)
def test_utc_is_read_as_people_write_it(text, meant):
    assert parse_utc(text) == np.datetime64(meant, "ns")


@pytest.mark.parametrize(
    "text",
    [
        "31.01.2005",
        "2005-13-01",
        "2005-02-30",
        "yesterday",
        "2005-01-31T12:00:00+02:00",
        "",
        "NaT",
        "now",
        "today",
    ],
)
def test_what_is_no_utc_time_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="2005-01-31T12:00:00"):
        parse_utc(text)


@given(
    st.integers(-(10**6), 10**6),
    st.sampled_from([("ns", 1), ("ms", 10**6), ("s", SECOND), ("h", 3600 * SECOND)]),
)
def test_durations_of_whole_units_are_exact(number, unit):
    name, ns = unit
    assert parse_duration(f"{number} {name}") == number * ns


@pytest.mark.parametrize(
    ("text", "ns"), [("260.5 d", 22_507_200 * SECOND), ("15 ms", 15_000_000), ("1e-3s", 10**6)]
)
def test_durations_may_have_fractions_and_no_blank(text, ns):
    assert parse_duration(text) == ns


@pytest.mark.parametrize("text", ["10", "ten s", "10 weeks", "", "1.2.3 s", "s"])
def test_what_is_no_duration_is_refused_with_the_known_units(text):
    with pytest.raises(ValueError, match="ns"):
        parse_duration(text)


@given(st.lists(st.integers(1, 4), min_size=1, max_size=60))
def test_the_usual_step_is_the_median_one(steps):
    stamps = np.cumsum(np.array([0, *steps], dtype=np.int64))
    assert usual_step(stamps) == int(np.median(steps))


def test_one_stamp_has_no_step():
    assert usual_step(np.array([5]), 7) == 7
