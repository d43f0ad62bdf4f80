import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inflight.catalog.readers import RawTable, assemble_day, split_days
from inflight.catalog.readers.day_assembly import coverage
from inflight.errors import ClashError, ContentError
from inflight.flags import Flag
from inflight.instruments import Channel, Files, Instrument
from inflight.time import day_bounds, day_of, to_tt2000

SECOND = 10**9
DAY = np.datetime64("2016-12-31", "D")
START = day_bounds(DAY)[0]
SCALAR = Instrument(
    role="scalar",
    cadence="10 s",
    files=Files(pattern="x", reader="cdf"),
    channels={"field": Channel(variable="F", unit="nT"), "t": Channel(variable="T", unit="degC")},
)


def table(seconds, values=None, file="a", t=None) -> RawTable:
    times = START + np.asarray(seconds, dtype=np.int64) * SECOND
    values = np.asarray(seconds if values is None else values, dtype=float)
    t = np.zeros(times.size) if t is None else np.asarray(t, dtype=float)
    rows = np.arange(1, times.size + 1)
    return RawTable(
        file=file,
        times=times,
        channels={"field": values, "t": t},
        flag=np.zeros(times.size, dtype=np.uint32),
        rows=rows,
    )


def assemble(*parts):
    return assemble_day(DAY, parts, "ovm", SCALAR)


def seconds_of(dataset):
    return ((dataset.tt2000.values - START) // SECOND).tolist()


@given(
    st.lists(st.integers(min_value=-3 * 86400, max_value=3 * 86400), max_size=60),
    st.sampled_from(["2016-12-31T12:00:00", "2005-12-31T23:59:59", "2011-09-01T00:00:00"]),
)
def test_splitting_by_day_loses_no_row_and_doubles_none(offsets, about):
    times = to_tt2000(np.datetime64(about)) + np.array(offsets, dtype=np.int64) * SECOND
    count = times.size
    rows = np.arange(1, count + 1)
    whole = RawTable(
        file="a",
        times=times,
        channels={"field": rows.astype(float)},
        flag=np.zeros(count, dtype=np.uint32),
        rows=rows,
    )
    days = split_days(whole)
    assert sorted(row for part in days.values() for row in part.rows) == rows.tolist()
    for day, part in days.items():
        first, last = day_bounds(day)
        assert ((part.times >= first) & (part.times < last)).all()
        assert (day_of(part.times) == day).all()
        assert (np.diff(part.rows) > 0).all()
        np.testing.assert_array_equal(part.channels["field"], part.rows)


def test_the_leap_second_belongs_to_the_day_it_ends_and_is_flagged():
    dataset, report = assemble(table([86390, 86400]))
    assert dataset.flag.values.tolist() == [0, int(Flag.LEAP_SECOND)]
    assert report["channels"]["field"]["expected"] == 8640


@given(st.permutations(list(range(0, 200, 10))))
def test_rows_in_any_order_give_the_same_day(order):
    dataset, report = assemble(table(order))
    assert seconds_of(dataset) == list(range(0, 200, 10))
    assert dataset.field.values.tolist() == list(range(0, 200, 10))
    assert report["unsorted"] == sum(b < a for a, b in itertools.pairwise(order))


@given(st.integers(min_value=0, max_value=19), st.integers(min_value=0, max_value=19))
def test_files_that_overlap_with_equal_values_are_one_series(first, second):
    low, high = sorted((first, second))
    dataset, report = assemble(
        table(range(0, 10 * (high + 1), 10), file="a"), table(range(10 * low, 200, 10), file="b")
    )
    assert seconds_of(dataset) == list(range(0, 200, 10))
    assert report["dropped"].get("repeated", 0) == high - low + 1


def test_a_missing_value_agrees_with_any_and_the_value_is_kept():
    dataset, _ = assemble(table([0, 10], [np.nan, 2.0], "a"), table([0, 10], [1.0, np.nan], "b"))
    assert dataset.field.values.tolist() == [1.0, 2.0]
    assert dataset.flag.values.tolist() == [0, 0]


def test_two_values_for_one_time_refuse_the_day_and_name_everything():
    with pytest.raises(ClashError) as caught:
        assemble(table([0, 10, 20], file="a.cdf"), table([10], [10.5], file="b.cdf"))
    text = str(caught.value)
    for part in ("a.cdf", "b.cdf", "2016-12-31T00:00:10", "10.0", "10.5", "row 2", "row 1", "'field'"):
        assert part in text


def test_a_clock_that_ran_back_over_equal_rows_is_repaired_and_flagged():
    dataset, report = assemble(table([0, 10, 20, 30, 10, 20, 30, 40]))
    assert seconds_of(dataset) == [0, 10, 20, 30, 40]
    repaired = int(Flag.CLOCK_REPAIRED)
    assert dataset.flag.values.tolist() == [0, repaired, repaired, repaired, 0]
    assert report["dropped"] == {"repeated": 3}


@pytest.mark.parametrize("shift", [0, 3, 5])
def test_a_clock_that_ran_back_over_other_rows_refuses_the_day_with_the_place(shift):
    seconds = [0, 10, 20, 30, 10 + shift, 20 + shift, 30 + shift, 40 + shift]
    with pytest.raises(ClashError, match="clock ran backwards") as caught:
        assemble(table(seconds, range(8), file="a.cdf"))
    assert "a.cdf" in str(caught.value)
    assert "row 5" in str(caught.value)


def test_a_clock_that_went_elsewhere_and_came_back_loses_only_those_rows():
    seconds = [*range(0, 500, 10), 3, 13, 23, *range(530, 800, 10)]
    dataset, report = assemble(table(seconds, range(len(seconds))))
    assert report["dropped"] == {"clock_excursion": 3}
    assert seconds_of(dataset) == [*range(0, 500, 10), *range(530, 800, 10)]
    assert report["channels"]["field"]["gap_count"] == 2


def test_reports_delivered_late_are_only_sorted():
    seconds = [0, 10, 20, 60, 30, 40, 50, 70, 90, 80]
    dataset, report = assemble(table(seconds))
    assert seconds_of(dataset) == sorted(seconds)
    assert report["dropped"] == {}
    assert report["unsorted"] == 2


def test_missing_values_are_flagged_by_what_is_missing():
    dataset, _ = assemble(table([0, 10, 20], [1, np.nan, 3], t=[1, 1, np.nan]))
    assert dataset.flag.values.tolist() == [0, int(Flag.SCALAR_MISSING), int(Flag.CHANNEL_MISSING)]


def test_a_day_without_one_field_value_is_refused_and_a_dead_housekeeping_channel_is_not():
    with pytest.raises(ContentError, match="all 2 values are missing") as caught:
        assemble(table([0, 10], [np.nan, np.nan]))
    assert caught.value.channel == "field"
    assert caught.value.day == "2016-12-31"
    _, report = assemble(table([0, 10], t=[np.nan, np.nan]))
    assert report["channels"]["t"]["valid"] == 0


@given(st.sets(st.integers(min_value=0, max_value=8640), max_size=40))
def test_valid_and_missing_samples_add_up_to_the_expected_ones(missing):
    start = START
    slots = np.setdiff1d(np.arange(8641), list(missing))
    told = coverage(start + slots * 10 * SECOND, DAY, 10 * SECOND)
    # The leap day has 86 401 s: a sample in its last second is one more than 86 400 / 10.
    assert told["gap_samples"] in (len(missing), len(missing) - 1)
    assert told["valid"] == slots.size
    listed = sum(count for _, _, count in told["gaps"])
    assert listed == told["gap_samples"]


def test_gaps_are_listed_with_start_end_and_count():
    told = coverage(START + np.array([0, 10, 50, 60]) * SECOND, DAY, 10 * SECOND)
    assert told["gap_count"] == 2
    assert told["gaps"][0] == ["2016-12-31T00:00:20.000000000", "2016-12-31T00:00:50.000000000", 3]
    assert told["gaps"][1][0] == "2016-12-31T00:01:10.000000000"
    assert told["gaps"][1][1] == "2017-01-01T00:00:00.000000000"


def test_channels_carry_what_a_reader_of_the_archive_needs():
    vector = Instrument(
        role="vector",
        cadence="1 s",
        files=Files(pattern="x", reader="cdf"),
        channels={
            "field": Channel(variable="B", unit="nT", axes=["x", "y", "z"], resolution=0.01, lag="2 s"),
            "attitude": Channel(variable="q", unit="1", axes=["x", "y", "z", "w"], frame="gcrf"),
        },
    )
    raw = RawTable(
        file="a",
        times=START + np.arange(2) * SECOND,
        channels={"field": np.ones((2, 3)), "attitude": np.ones((2, 4))},
        flag=np.zeros(2, dtype=np.uint32),
        rows=np.arange(1, 3),
    )
    dataset, _ = assemble_day(DAY, [raw], "fgm", vector)
    assert dataset.field.dims == ("time", "axis")
    assert dataset.attitude.dims == ("time", "attitude_axis")
    assert dataset.field.attrs["units"] == "nT"
    assert dataset.field.attrs["frame"] == "sensor"
    assert dataset.field.attrs["resolution"] == 0.01
    assert dataset.field.attrs["lag_ns"] == 2 * SECOND
    assert "resolution" not in dataset.attitude.attrs
    assert dataset.tt2000.dtype == np.int64
    assert dataset.flag.dtype == np.uint32
