"""Each kind of bad file gives a clear error that names file, channel, what was found and what to do."""

import cdflib
import h5py
import numpy as np
import pytest
import scipy.io
from reader_cases import CHAR, DOUBLE, FLOAT, TT2000, day_times, field_of, mission_with, write_cdf, write_fgm

from inflight.catalog.readers import read_file
from inflight.errors import ContentError, ReadError
from inflight.instruments import Channel, Files, Instrument

DAY = "2020-05-01"
COUNT = 1440


def read(path, *pairs):
    mission = mission_with(*pairs)
    return read_file(path, mission.files("fgm"), mission.instruments["fgm"], name=path.name)


def refuses(error, path, *told, pairs=(), channel=""):
    with pytest.raises(error) as caught:
        read(path, *pairs)
    text = str(caught.value)
    assert path.name in text
    for part in told:
        assert part in text
    assert caught.value.remedy
    assert caught.value.channel == channel
    return text


def test_the_good_file_reads(tmp_path):
    table = read(write_fgm(tmp_path, DAY))
    assert table.times.size == COUNT
    np.testing.assert_array_equal(table.channels["field"], field_of(day_times(DAY)))


def test_zero_length(tmp_path):
    path = tmp_path / "fgm_20200501_v01.cdf"
    path.touch()
    refuses(ReadError, path, "zero length")


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_cdf(tmp_path, keep, compress):
    times = day_times(DAY)
    path = write_cdf(
        tmp_path / "fgm_20200501_v01.cdf",
        {"Epoch": (times, TT2000, {}), "B": (field_of(times), DOUBLE, {}), "T": (times * 0.0, DOUBLE, {})},
        compress=compress,
    )
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    refuses(ReadError, path)


def test_cdflib_alone_would_not_notice_every_truncation(tmp_path):
    path = write_fgm(tmp_path, DAY)
    whole = path.read_bytes()
    path.write_bytes(whole[:-200])
    cdflib.CDF(path).cdf_info()
    refuses(ReadError, path, "truncated")


@pytest.mark.parametrize("size", [8, 20, 27, 40, 300])
def test_a_cdf_cut_within_its_header(tmp_path, size):
    path = write_fgm(tmp_path, DAY)
    path.write_bytes(path.read_bytes()[:size])
    refuses(ReadError, path)


def test_a_file_of_another_format(tmp_path):
    path = tmp_path / "fgm_20200501_v01.cdf"
    path.write_text("<html>404 Not Found, and some more text</html>")
    refuses(ReadError, path, "no CDF file")


def test_flipped_bytes_never_end_in_anything_but_our_errors(tmp_path):
    path = write_fgm(tmp_path, DAY)
    whole = path.read_bytes()
    chosen = np.random.default_rng(1)
    for _ in range(60):
        damaged = bytearray(whole)
        for place in chosen.integers(0, min(3000, len(whole)), size=6):
            damaged[place] = chosen.integers(0, 256)
        path.write_bytes(damaged)
        try:
            table = read(path)
        except (ReadError, ContentError):
            continue
        assert table.channels["field"].shape[1:] == (3,)


def test_a_missing_variable_lists_what_there_is(tmp_path):
    refuses(ContentError, write_fgm(tmp_path, DAY, T=None), "'T'", "Epoch, B", channel="temperature")


def test_a_wrong_unit_names_both(tmp_path):
    path = write_fgm(tmp_path, DAY, T=(np.zeros(COUNT), DOUBLE, {"UNITS": "nT"}))
    refuses(ContentError, path, "'nT'", "'degC'", channel="temperature")


def test_a_unit_nobody_knows(tmp_path):
    path = write_fgm(tmp_path, DAY, T=(np.zeros(COUNT), DOUBLE, {"UNITS": "flurbs"}))
    refuses(ContentError, path, "'flurbs'", "file_unit", channel="temperature")
    stated = ("{variable: T, unit: degC", "{variable: T, unit: degC, file_unit: degC")
    assert read(path, stated).times.size == COUNT


@pytest.mark.parametrize("shape", [(COUNT, 2), (COUNT, 4), (COUNT,), (3, COUNT)])
def test_a_wrong_count_or_order_of_axes(tmp_path, shape):
    path = write_fgm(tmp_path, DAY, B=(np.zeros(shape), DOUBLE, {"UNITS": "nT"}))
    text = refuses(ContentError, path, str((COUNT, 3)), channel="field")
    assert str(shape) in text


def test_a_vector_where_a_number_belongs(tmp_path):
    path = write_fgm(tmp_path, DAY, T=(np.zeros((COUNT, 3)), DOUBLE, {}))
    refuses(ContentError, path, "(1440, 3)", "column", channel="temperature")


def test_text_where_numbers_belong(tmp_path):
    path = tmp_path / "a.cdf"
    times = day_times(DAY)[:3]
    write_cdf(path, {"Epoch": (times, TT2000, {}), "B": (np.zeros((3, 3)), FLOAT, {})})
    target = cdflib.cdfwrite.CDF(tmp_path / "b.cdf", delete=True)
    for name, kind, elements, dims, data in (
        ("Epoch", TT2000, 1, [], times),
        ("B", DOUBLE, 1, [3], np.zeros((3, 3))),
        ("T", CHAR, 4, [], ["warm", "cold", "hot "]),
    ):
        target.write_var(
            {
                "Variable": name,
                "Data_Type": kind,
                "Num_Elements": elements,
                "Rec_Vary": True,
                "Dim_Sizes": dims,
            },
            var_data=data,
        )
    target.close()
    refuses(ContentError, tmp_path / "b.cdf", "text where numbers belong", channel="temperature")


def instrument(files: dict, channel: dict):
    options = Files.model_validate({"pattern": "x", **files})
    told = Instrument(role="housekeeping", cadence="60 s", files=options, channels={"t": Channel(**channel)})
    return options, told


def test_text_in_a_table_names_row_and_text(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,T\n2020-05-01T00:00:00,1.5\n2020-05-01T00:01:00,n.a.!\n")
    with pytest.raises(ContentError, match=r"column 'T', row 2: 'n.a.!' is no number"):
        read_file(path, *instrument({"reader": "table", "time": "time"}, {"variable": "T", "unit": "degC"}))


def test_text_that_is_no_time_names_row_and_text(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,T\n01/05/2020 00:00,1.5\nyesterday,2\n")
    options = {"reader": "table", "time": "time", "time_format": "%d/%m/%Y %H:%M"}
    with pytest.raises(ContentError, match=r"row 2: 'yesterday'"):
        read_file(path, *instrument(options, {"variable": "T", "unit": "degC"}))
    options = {"reader": "table", "time": "time"}
    with pytest.raises(ContentError, match="not ISO 8601"):
        read_file(path, *instrument(options, {"variable": "T", "unit": "degC"}))


def test_plain_numbers_as_times_need_a_unit(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(3.0), T=np.zeros(3))
    with pytest.raises(ContentError, match="time_unit"):
        read_file(
            tmp_path / "a.npz", *instrument({"reader": "npz", "time": "t"}, {"variable": "T", "unit": "degC"})
        )


def test_an_expression_over_a_variable_that_is_not_there(tmp_path):
    refuses(
        ContentError,
        write_fgm(tmp_path, DAY),
        "'Q'",
        pairs=[("time: Epoch", "time: Epoch, good_when: Q == 0")],
    )


def test_reports_of_samples_without_flatten_say_what_to_do(tmp_path):
    with h5py.File(tmp_path / "a.nc", "w") as file:
        file["t"], file["T"] = np.arange(6.0).reshape(3, 2), np.zeros((3, 2))
    options = {"reader": "netcdf", "time": "t", "time_unit": "s since 2020-05-01"}
    with pytest.raises(ContentError, match="flatten"):
        read_file(tmp_path / "a.nc", *instrument(options, {"variable": "T", "unit": "degC"}))


@pytest.mark.parametrize("reader", ["cdf", "netcdf", "iaga2002", "parquet", "npz", "mat"])
def test_noise_is_a_read_error_in_every_format(tmp_path, reader):
    path = tmp_path / "noise"
    path.write_bytes(np.random.default_rng(2).integers(0, 256, 5000, dtype=np.uint8).tobytes())
    with pytest.raises(ReadError, match="noise"):
        read_file(path, *instrument({"reader": reader, "time": "t"}, {"variable": "T", "unit": "degC"}))


def test_a_truncated_gzip(tmp_path):
    import gzip

    path = tmp_path / "a.csv.gz"
    packed = gzip.compress(b"time,T\n" + b"2020-05-01T00:00:00,1.5\n" * 5000)
    path.write_bytes(packed[: len(packed) // 2])
    with pytest.raises(ReadError, match=r"a\.csv\.gz"):
        read_file(path, *instrument({"reader": "table", "time": "time"}, {"variable": "T", "unit": "degC"}))


def test_a_pickle_in_an_npz_is_not_run(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.array([{"a": 1}], dtype=object), T=np.zeros(1))
    with pytest.raises(ReadError, match="cannot be read"):
        read_file(
            tmp_path / "a.npz", *instrument({"reader": "npz", "time": "t"}, {"variable": "T", "unit": "degC"})
        )


def test_a_dropped_variable_is_never_read(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"t": np.arange(3.0), "T": np.zeros(3)})
    options = {"reader": "mat", "time": "t", "time_unit": "s since 2020-05-01", "drop": ["T"]}
    with pytest.raises(ContentError, match="listed under 'drop'"):
        read_file(tmp_path / "a.mat", *instrument(options, {"variable": "T", "unit": "degC"}))
