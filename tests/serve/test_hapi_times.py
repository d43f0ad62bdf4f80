"""Times of HAPI are read and written exactly."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inflight.serve.times import duration_text, parse_time, time_texts
from inflight.time import SECOND, day_bounds, to_tt2000

LEAP_DAYS = ["1978-12-31", "2005-12-31", "2012-06-30", "2016-12-31"]


def written(tt2000):
    return time_texts(np.array([tt2000], dtype=np.int64)).tobytes().decode()


@given(st.integers(int(to_tt2000("1975-01-01")), int(to_tt2000("2100-01-01"))))
def test_what_is_written_reads_back(tt2000):
    assert parse_time(written(tt2000)) == tt2000


@pytest.mark.parametrize("day", LEAP_DAYS)
def test_around_a_leap_second_times_read_back_in_order(day):
    _, end = day_bounds(day)
    stamps = np.arange(end - 3 * SECOND, end, SECOND // 4)
    texts = [bytes(row).decode() for row in time_texts(stamps)]
    assert texts == sorted(texts)
    assert len(set(texts)) == len(texts)
    assert texts[-1] == f"{day}T23:59:60.750000000Z"
    assert [parse_time(text) for text in texts] == stamps.tolist()


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("2005", "2005-01-01T00:00:00Z"),
        ("2005Z", "2005-01-01"),
        ("2005-02Z", "2005-02-01"),
        ("2005-032", "2005-02-01"),
        ("2004-366T23Z", "2004-12-31T23:00"),
        ("2005-01-31T24:00:00.000Z", "2005-02-01"),
        ("2016-12-31T24Z", "2017-01-01"),
        ("2005-02-01T01:02:03.Z", "2005-02-01T01:02:03"),
        ("2005-02-01T01:02:03.0000000001", "2005-02-01T01:02:03.000000001"),
        ("2005-02-01T01:02:03.9999999999", "2005-02-01T01:02:04"),
    ],
)
def test_what_is_left_out_is_smallest_and_parts_of_nanoseconds_are_rounded_up(text, same):
    assert parse_time(text) == parse_time(same)


@pytest.mark.parametrize(
    "text",
    [
        "", "now", "05-01-01", "2005-1-1", "2005-13", "2005-02-30", "2005-000", "2005-366", "2005T12",
        "2005-01T12", "2005-01-01 12:00", "2005-01-01T", "2005-01-01T1", "2005-01-01T12:60",
        "2005-01-01T24:00:01", "2005-01-01T24:00:00.1", "2005-12-31T23:58:60", "2005-12-31T22:59:60",
        "2005-12-30T23:59:60", "2005-12-31T23:59:61", "2005-01-01T12:00z", "2005-01-01T12:00+00:00",
        "2005-01-01ZZ", "0000-01-01",
        "٢٠٠٥-01-01", "2005-01-01T12:00:00.1e3", " 2005-01-01", "2005-01-01\n",
    ],
)  # fmt: skip
def test_what_is_no_time_of_the_standard_is_refused(text):
    with pytest.raises(ValueError, match=r"."):
        parse_time(text)


def test_years_beyond_the_clock_are_before_or_after_everything():
    assert (
        parse_time("0001-01-01")
        < parse_time("1720-01-01")
        < parse_time("2280-01-01")
        < parse_time("9999-12-31")
    )


def test_durations_are_written_without_needless_digits():
    assert [duration_text(ns) for ns in (SECOND, 600 * SECOND, 10**8, 125, 1_500_000_000)] == [
        "PT1S",
        "PT600S",
        "PT0.1S",
        "PT0.000000125S",
        "PT1.5S",
    ]
