"""Every format gives the same rows; times are exact to the nanosecond."""

import gzip

import cdflib
import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from reader_cases import DOUBLE, EPOCH, EPOCH16, FLOAT, INT4, TT2000, day_times, write_cdf

from inflight.catalog.readers import NameSpan, read_file
from inflight.catalog.readers.cdf import from_epoch, from_epoch16
from inflight.catalog.readers.times import from_cf
from inflight.errors import ContentError, ReadError
from inflight.flags import Flag
from inflight.instruments import Channel, Files, Instrument
from inflight.time import TT2000_FILL, day_bounds, parse_utc, to_tt2000, to_utc

#: 18 to 23 h; the day's 86 401st second would be a row of its own.
TIMES = day_times("2016-12-31", 3600)[18:24]
FIELD = np.array([[1.5, -2.25, 3.0]]) * np.arange(1, 7)[:, None]
DAY = NameSpan(*day_bounds("2016-12-31"))


def vector(**files) -> tuple[Files, Instrument]:
    channel = files.pop("channel", {"variable": "B", "axes": ["x", "y", "z"], "unit": "nT"})
    options = Files.model_validate({"pattern": "x", **files})
    instrument = Instrument(
        role="housekeeping",
        cadence="3600 s",
        files=options,
        channels={"field": Channel.model_validate(channel)},
    )
    return options, instrument


def assert_rows(table):
    assert table.times.tolist() == TIMES.tolist()
    np.testing.assert_array_equal(table.channels["field"], FIELD)


@pytest.mark.parametrize("compress", [False, True])
def test_cdf_with_tt2000(tmp_path, compress):
    path = write_cdf(
        tmp_path / "a.cdf", {"Epoch": (TIMES, TT2000, {}), "B": (FIELD, DOUBLE, {})}, compress=compress
    )
    assert_rows(read_file(path, *vector(reader="cdf", time="Epoch")))


def test_cdf_with_epoch_and_epoch16(tmp_path):
    labels = to_utc(TIMES).astype("datetime64[ms]").astype(np.int64) + 62_167_219_200_000
    path = write_cdf(
        tmp_path / "a.cdf", {"Epoch": (labels.astype(float), EPOCH, {}), "B": (FIELD, DOUBLE, {})}
    )
    assert_rows(read_file(path, *vector(reader="cdf", time="Epoch")))
    pairs = np.stack([labels // 1000, (labels % 1000) * 10**9], axis=1).astype(float)
    path = write_cdf(
        tmp_path / "b.cdf", {"Epoch": (pairs.view(complex)[:, 0], EPOCH16, {}), "B": (FIELD, DOUBLE, {})}
    )
    assert_rows(read_file(path, *vector(reader="cdf", time="Epoch")))


@given(st.integers(min_value=-(10**9), max_value=2 * 10**9), st.integers(min_value=0, max_value=999))
def test_cdf_epochs_agree_with_cdflib_to_the_nanosecond(second, millisecond):
    label = np.datetime64(second * 1000 + millisecond, "ms")
    if label < np.datetime64("1972-01-01"):
        label = np.datetime64("1972-01-01", "ms")
    epoch = float(label.astype(np.int64) + 62_167_219_200_000)
    parts = [int(part) for part in cdflib.cdfepoch.breakdown_epoch(epoch)]
    expected = int(cdflib.cdfepoch.compute_tt2000([*parts, 0, 0]))
    assert int(from_epoch(np.array([epoch]))[0]) == expected


def test_epoch16_keeps_nanoseconds_and_fill_has_no_time():
    seconds = 62_167_219_200.0 + 946_684_800
    values = np.array([[seconds, 123_456_789_000.0], [-1e31, -1e31]])
    got = from_epoch16(values)
    assert got[0] == to_tt2000(np.datetime64("2000-01-01T00:00:00.123456789"))
    assert got[1] == TT2000_FILL


def test_tt2000_runs_through_a_leap_second_without_a_jump(tmp_path):
    start = int(to_tt2000(np.datetime64("2016-12-31T23:59:57")))
    times = start + np.arange(6) * 10**9
    path = write_cdf(tmp_path / "a.cdf", {"Epoch": (times, TT2000, {}), "B": (FIELD, DOUBLE, {})})
    table = read_file(path, *vector(reader="cdf", time="Epoch"))
    assert np.diff(table.times).tolist() == [10**9] * 5
    assert str(to_utc(table.times[-1])) == "2017-01-01T00:00:01.000000000"


def test_netcdf4_with_packing_fill_and_cf_time(tmp_path):
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        seconds = (to_utc(TIMES) - np.datetime64("2000-01-01T12:00:00")) / np.timedelta64(1, "s")
        file["time"] = seconds
        file["time"].attrs["units"] = np.bytes_(b"seconds since 2000-01-01 12:00:00")
        packed = np.round((FIELD - 1.0) / 0.25).astype(np.int16)
        packed[2, 1] = -32768
        file["B"] = packed
        file["B"].attrs.update({"scale_factor": 0.25, "add_offset": 1.0, "_FillValue": np.int16(-32768)})
        file["B"].attrs["units"] = "nT"
    table = read_file(path, *vector(reader="netcdf", time="time"))
    expected = FIELD.copy()
    expected[2, 1] = np.nan
    assert table.times.tolist() == TIMES.tolist()
    np.testing.assert_array_equal(table.channels["field"], expected)


def test_netcdf_reports_of_samples_flatten_and_a_dimension_may_share_its_name(tmp_path):
    path = tmp_path / "a.nc"
    with h5py.File(path, "w") as file:
        file["time"] = ((TIMES - TIMES[0]) / 1e9).reshape(3, 2)
        file["B"] = FIELD.reshape(3, 2, 3).astype(np.float32)
        file["report"] = np.int32(3)
        file["DQF"] = np.array([[0, 0], [0, 7], [0, 0]])
        file["mode"] = np.array([1, 1, 0])
    unit = f"seconds since {to_utc(TIMES[0])}"
    options = {"reader": "netcdf", "time": "time", "time_unit": unit, "drop": ["report"]}
    table = read_file(path, *vector(flatten=True, good_when="DQF == 0 and mode == 1", **options))
    assert_rows(table)
    assert table.channels["field"].dtype == np.float32
    assert table.flag.tolist() == [0, 0, 0, int(Flag.INSTRUMENT_FLAG), *[int(Flag.INSTRUMENT_FLAG)] * 2]


def test_classic_netcdf(tmp_path):
    path = tmp_path / "a.nc"
    with scipy.io.netcdf_file(path, "w") as file:
        file.createDimension("row", 6)
        file.createDimension("axis", 3)
        time = file.createVariable("time", "f8", ("row",))
        time[:] = (TIMES - TIMES[0]) / 1e9
        time.units = f"seconds since {to_utc(TIMES[0])}"
        file.createVariable("B", "f8", ("row", "axis"))[:] = FIELD
    assert_rows(read_file(path, *vector(reader="netcdf", time="time")))


IAGA = """ Format                 IAGA-2002                                    |
 IAGA CODE              TST                                          |
DATE       TIME         DOY     TSTH      TSTE      TSTZ      TSTF   |
2016-12-31 23:58:00.000 366      1.50     -2.25      3.00  99999.00
2016-12-31 23:59:00.000 366      3.00     -4.50      6.00  88888.00
2016-12-31 23:59:60.000 366      3.10     -4.60      6.10     10.00
"""


@pytest.mark.parametrize("packed", [False, True])
def test_iaga2002_plain_and_gzipped_with_a_leap_second(tmp_path, packed):
    path = tmp_path / "a.min"
    path.write_bytes(gzip.compress(IAGA.encode()) if packed else IAGA.replace("\n", "\r\n").encode())
    channel = {"variables": ["TSTH", "TSTE", "TSTZ"], "unit": "nT"}
    table = read_file(path, *vector(reader="iaga2002", time="time", channel=channel))
    np.testing.assert_array_equal(table.channels["field"], [[1.5, -2.25, 3], [3, -4.5, 6], [3.1, -4.6, 6.1]])
    assert np.diff(table.times).tolist() == [60 * 10**9, 60 * 10**9]
    assert table.times[-1] == day_bounds("2016-12-31")[1] - 10**9
    total = vector(reader="iaga2002", time="time", channel={"variable": "TSTF", "unit": "nT"})
    np.testing.assert_array_equal(read_file(path, *total).channels["field"], [np.nan, np.nan, 10.0])


def test_a_german_table(tmp_path):
    path = tmp_path / "a.txt"
    rows = "".join(
        f"{str(stamp)[11:19]}\t{f'{x:.2f}'.replace('.', ',')}\t0123\n"
        for stamp, x in zip(to_utc(TIMES), FIELD[:, 0], strict=True)
    )
    path.write_bytes("Gerät Wärme\n".encode("latin-1") + rows.encode())
    options = {
        "reader": "table",
        "delimiter": "\t",
        "decimal": ",",
        "encoding": "latin-1",
        "skip": 1,
        "columns": ["clock", "Größe", "code"],
        "time": "clock",
        "time_format": "%H:%M:%S",
        "channel": {"variable": "Größe", "unit": "nT"},
    }
    table = read_file(path, *vector(**options), DAY)
    assert table.times.tolist() == TIMES.tolist()
    np.testing.assert_array_equal(table.channels["field"], FIELD[:, 0])


TABLE = {"reader": "table", "time": "t", "channel": {"variable": "B", "unit": "nT"}}
ROWS = "{t}00:00:00Z{d}1{d}2{e}\n{t}00:00:10Z{d}3{d}4{e}\n"


def test_text_of_another_encoding_is_told_with_the_key_that_states_it(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("t,B,Güte\n".encode("latin-1") + ROWS.format(t="2024-03-01T", d=",", e="").encode())
    with pytest.raises(ReadError, match="utf-8") as told:
        read_file(path, *vector(**TABLE))
    assert "encoding" in told.value.remedy
    table = read_file(path, *vector(**TABLE, encoding="latin-1"))
    np.testing.assert_array_equal(table.channels["field"], [1.0, 3.0])


def test_a_delimiter_that_closes_every_row_is_no_column(tmp_path, recwarn):
    path = tmp_path / "a.txt"
    path.write_text("t,B,q\n" + ROWS.format(t="2024-03-01T", d=",", e=","))
    np.testing.assert_array_equal(read_file(path, *vector(**TABLE)).channels["field"], [1.0, 3.0])
    assert not recwarn.list


@pytest.mark.parametrize("before", ["", "Station; run 3\n"])
def test_rows_with_more_columns_than_names_are_refused_not_cut(tmp_path, before):
    path = tmp_path / "a.txt"
    path.write_text(before + "t,B\n" + ROWS.format(t="2024-03-01T", d=",", e=""))
    with pytest.raises(ContentError) as told:
        read_file(path, *vector(**TABLE))
    assert "skip" in told.value.remedy


def test_times_of_day_before_the_first_midnight_belong_to_the_day_before(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("t,B\n23:59:47,1\n23:59:57,2\n00:00:07,3\n00:00:17,4\n00:00:27,5\n")
    options = {
        "reader": "table",
        "time": "t",
        "time_format": "%H:%M:%S",
        "channel": {"variable": "B", "unit": "nT"},
    }
    table = read_file(path, *vector(**options), NameSpan(*day_bounds("2011-09-22")))
    assert [str(stamp)[:19] for stamp in to_utc(table.times)] == [
        "2011-09-21T23:59:47",
        "2011-09-21T23:59:57",
        "2011-09-22T00:00:07",
        "2011-09-22T00:00:17",
        "2011-09-22T00:00:27",
    ]


def test_times_without_a_year_take_the_nearest_one(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("t,B\n1231235950,1\n0101000000,2\n0101000010,3\n")
    options = {
        "reader": "table",
        "time": "t",
        "time_format": "%m%d%H%M%S",
        "channel": {"variable": "B", "unit": "nT"},
    }
    table = read_file(path, *vector(**options), NameSpan(*day_bounds("2012-01-01")))
    assert [str(stamp)[:19] for stamp in to_utc(table.times)] == [
        "2011-12-31T23:59:50",
        "2012-01-01T00:00:00",
        "2012-01-01T00:00:10",
    ]


def test_date_and_clock_columns_are_joined_and_parquet_lists_are_axes(tmp_path):
    stamps = to_utc(TIMES)
    frame = pd.DataFrame({"d": [str(one)[:10] for one in stamps], "c": [str(one)[11:19] for one in stamps]})
    frame["B"] = [list(row) for row in FIELD]
    frame.to_parquet(tmp_path / "a.parquet")
    assert_rows(read_file(tmp_path / "a.parquet", *vector(reader="parquet", time=["d", "c"])))
    frame["when"] = pd.to_datetime(stamps).tz_localize("UTC").tz_convert("Europe/Vienna")
    frame.to_parquet(tmp_path / "b.parquet")
    assert_rows(read_file(tmp_path / "b.parquet", *vector(reader="parquet", time="when")))


def test_npz_and_mat(tmp_path):
    unix = to_utc(TIMES).astype(np.int64)
    np.savez(tmp_path / "a.npz", t=unix, B=FIELD)
    options = {"time": "t", "time_unit": "ns since 1970-01-01"}
    assert_rows(read_file(tmp_path / "a.npz", *vector(reader="npz", **options)))
    np.savez(tmp_path / "c.npz", t=TIMES, B=FIELD)
    assert_rows(read_file(tmp_path / "c.npz", *vector(reader="npz", time="t", time_unit="tt2000")))
    scipy.io.savemat(tmp_path / "a.mat", {"s": {"t": unix[:, None], "B": FIELD}})
    channel = {"variable": "s.B", "axes": ["x", "y", "z"], "unit": "nT"}
    options = {"time": "s.t", "time_unit": "ns since 1970-01-01", "channel": channel}
    assert_rows(read_file(tmp_path / "a.mat", *vector(reader="mat", **options)))


def test_files_without_times_count_from_a_stated_start(tmp_path):
    np.savez(tmp_path / "a.npz", B=FIELD)
    options = vector(reader="npz", time_start="2016-12-31T18:00:00Z")
    assert_rows(read_file(tmp_path / "a.npz", *options))


def test_units_are_converted_and_lost_digits_are_not_invented(tmp_path):
    values = np.array([0.1, 26.97], dtype=np.float32)
    times = TIMES[:2]
    path = write_cdf(
        tmp_path / "a.cdf",
        {
            "Epoch": (times, TT2000, {}),
            "K": (values + 273, FLOAT, {"UNITS": "K"}),
            "I": (values, FLOAT, {"UNITS": "mA"}),
        },
    )
    kelvin = vector(reader="cdf", time="Epoch", channel={"variable": "K", "unit": "degC"})
    got = read_file(path, *kelvin).channels["field"]
    np.testing.assert_allclose(got, (values + np.float32(273)).astype(float) - 273.15, rtol=0, atol=1e-12)
    same = vector(reader="cdf", time="Epoch", channel={"variable": "I", "unit": "mA"})
    got = read_file(path, *same).channels["field"]
    assert got.dtype == np.float32
    assert got.tobytes() == values.tobytes()
    ampere = vector(reader="cdf", time="Epoch", channel={"variable": "I", "unit": "A"})
    np.testing.assert_allclose(
        read_file(path, *ampere).channels["field"], values.astype(float) / 1000, rtol=1e-15
    )
    stated = vector(reader="cdf", time="Epoch", channel={"variable": "I", "unit": "nT", "file_unit": "uT"})
    np.testing.assert_allclose(
        read_file(path, *stated).channels["field"], values.astype(float) * 1000, rtol=1e-15
    )


def test_fill_range_column_and_clock_offset(tmp_path):
    counts = np.array([[1, 10], [-9, 20], [3, 30], [4, 999]], dtype=np.int32)
    path = write_cdf(
        tmp_path / "a.cdf",
        {"Epoch": (TIMES[:4], TT2000, {}), "C": (counts, INT4, {"UNITS": "counts", "FILLVAL": np.int32(-9)})},
    )
    first = {"variable": "C", "column": 0, "unit": "count", "fill": 3}
    table = read_file(path, *vector(reader="cdf", time="Epoch", clock_offset="13 s", channel=first))
    np.testing.assert_array_equal(table.channels["field"], [1, np.nan, np.nan, 4])
    assert table.times.tolist() == (TIMES[:4] + 13 * 10**9).tolist()
    second = {"variable": "C", "column": 1, "unit": "count", "range": [0, 100]}
    table = read_file(path, *vector(reader="cdf", time="Epoch", channel=second))
    np.testing.assert_array_equal(table.channels["field"], [10, 20, 30, np.nan])
    assert table.flag.tolist() == [0, 0, 0, int(Flag.OUT_OF_RANGE)]


def test_a_clock_that_was_set_anew_has_an_offset_for_each_part(tmp_path):
    path = write_cdf(tmp_path / "a.cdf", {"Epoch": (TIMES, TT2000, {}), "B": (FIELD, DOUBLE, {})})
    steps = [{"since": "2016-12-31T20:00:00Z", "offset": "-8 s"}, {"offset": "13 s"}]
    table = read_file(path, *vector(reader="cdf", time="Epoch", clock_offset=steps))
    assert ((table.times - TIMES) // 10**9).tolist() == [13, 13, -8, -8, -8, -8]


def test_rows_without_a_time_or_far_from_the_name_are_dropped_and_counted(tmp_path):
    times = TIMES.copy()
    times[1], times[4] = np.int64(-(2**63)), 0
    path = write_cdf(tmp_path / "a.cdf", {"Epoch": (times, TT2000, {}), "B": (FIELD, DOUBLE, {})})
    table = read_file(path, *vector(reader="cdf", time="Epoch"), DAY)
    assert table.rows.tolist() == [1, 3, 4, 6]
    assert table.dropped == {"no_time": 1, "outside_span_of_file_name": 1}


@given(
    st.integers(min_value=0, max_value=4 * 10**9),
    st.sampled_from(["seconds", "s", "milliseconds", "microseconds", "days", "hours", "minutes"]),
)
def test_whole_counts_are_exact_in_every_cf_unit(count, unit):
    length = {
        "s": "s",
        "seconds": "s",
        "milliseconds": "ms",
        "microseconds": "us",
        "days": "D",
        "hours": "h",
        "minutes": "m",
    }
    count = count % 20000 if unit == "days" else count % 400000 if unit == "hours" else count
    if unit == "minutes":
        count %= 30_000_000
    got = from_cf(np.array([count]), f"{unit} since 1980-01-06T00:00:00Z")
    expected = to_tt2000(parse_utc("1980-01-06") + np.timedelta64(count, length[unit]))
    assert got[0] == expected
    assert from_cf(np.array([float(count)]), f"{unit} since 1980-01-06")[0] == expected


def test_fractions_of_a_second_keep_what_the_double_says():
    value = 540183599.900905
    got = int(from_cf(np.array([value]), "seconds since 2000-01-01 12:00:00")[0])
    exact = int(to_tt2000(np.datetime64("2000-01-01T12:00:00"))) + 540183599 * 10**9 + 5 * 10**9
    assert abs(got - exact - round((value - 540183599) * 1e9)) <= 1
