"""Every reader gives what the archive relies on; the suite finds what does not."""

import importlib.util
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from reader_cases import DOUBLE, TT2000, write_cdf
from scipy.io import netcdf_file

from inflight.catalog.readers import ReadOptions, Source, Variable, check_reader, require_content
from inflight.catalog.readers.raw import FORMATS
from inflight.errors import ConformanceError

TEMPLATE = Path(__file__).parents[2] / "docs" / "templates" / "reader.py"
BOTH = {"field": {"variable": "B", "axes": ["x", "y", "z"]}, "temperature": {"variable": "T"}}
EPOCH = np.datetime64("2000-01-01T12:00:00")


def seconds(example):
    return (example.times - EPOCH) / np.timedelta64(1, "s")


def cdf(path, example):
    temperature = np.where(np.isnan(example.temperature), -1e31, example.temperature)
    variables = {
        "Epoch": (example.tt2000, TT2000, {}),
        "B": (example.field, DOUBLE, {"UNITS": "nT", "FILLVAL": -1e31}),
        "T": (temperature, DOUBLE, {"UNITS": "degC", "FILLVAL": -1e31}),
    }
    write_cdf(path, variables)
    return ReadOptions(**BOTH, files={"time": "Epoch"})


def netcdf4(path, example):
    with h5py.File(path, "w") as file:
        file["time"] = seconds(example)
        file["time"].attrs["units"] = "seconds since 2000-01-01 12:00:00"
        file["B"] = example.field
        file["B"].attrs["units"] = "nT"
        file["T"] = np.where(np.isnan(example.temperature), -999, 1000 * example.temperature).astype(np.int32)
        file["T"].attrs.update({"units": "degC", "scale_factor": 0.001, "_FillValue": np.int32(-999)})
    return ReadOptions(**BOTH, files={"time": "time"})


def netcdf3(path, example):
    with netcdf_file(path, "w") as file:
        file.createDimension("row", len(example.times))
        file.createDimension("axis", 3)
        rows = {"time": (seconds(example), ("row",)), "B": (example.field, ("row", "axis"))}
        rows["T"] = (np.where(np.isnan(example.temperature), 9999.0, example.temperature), ("row",))
        for name, (values, dims) in rows.items():
            variable = file.createVariable(name, "d", dims)
            variable[:] = values
        file.variables["time"].units = "seconds since 2000-01-01 12:00:00"
        file.variables["T"].missing_value = 9999.0
    return ReadOptions(**BOTH, files={"time": "time"})


def iaga2002(path, example):
    temperature = np.where(np.isnan(example.temperature), 99999.0, example.temperature)
    frame = np.column_stack([example.field, temperature])
    stamps = pd.DatetimeIndex(example.times)
    lines = [" Format                 IAGA-2002                                    |\n"]
    lines += ["DATE       TIME         DOY     EXAX      EXAY      EXAZ      EXAT   |\n"]
    for stamp, row in zip(stamps, frame, strict=True):
        day = f"{stamp:%Y-%m-%d %H:%M:%S}.{stamp.microsecond // 1000:03d} {stamp:%j}"
        lines.append(f"{day}    {' '.join(f'{number:.3f}' for number in row)}\n")
    path.write_text("".join(lines))
    return ReadOptions(
        field={"variables": ["EXAX", "EXAY", "EXAZ"]},
        temperature={"variable": "EXAT", "file_unit": "degC"},
        files={"time": "time"},
    )


def table(path, example):
    frame = pd.DataFrame(example.field, columns=["x", "y", "z"])
    frame.insert(0, "time", np.datetime_as_string(example.times))
    frame["t"] = example.temperature
    frame.to_csv(path, index=False)
    return ReadOptions(
        field={"variables": ["x", "y", "z"]}, temperature={"variable": "t"}, files={"time": "time"}
    )


def parquet(path, example):
    columns = {"time": example.times, "B": list(example.field), "T": example.temperature}
    pq.write_table(pa.table(columns), path)
    return ReadOptions(**BOTH, files={"time": "time"})


def npz(path, example):
    with path.open("wb") as stream:
        np.savez(stream, time=example.tt2000, B=example.field, T=example.temperature)
    return ReadOptions(**BOTH, files={"time": "time", "time_unit": "tt2000"})


def mat(path, example):
    scipy.io.savemat(path, {"time": example.tt2000, "B": example.field, "T": example.temperature})
    return ReadOptions(**BOTH, files={"time": "time", "time_unit": "tt2000"})


WRITERS = {
    "cdf": [cdf],
    "netcdf": [netcdf4, netcdf3],
    "iaga2002": [iaga2002],
    "table": [table],
    "parquet": [parquet],
    "npz": [npz],
    "mat": [mat],
}


def test_every_reader_has_an_example():
    assert set(WRITERS) == set(FORMATS)


@pytest.mark.parametrize(
    "write", [one for each in WRITERS.values() for one in each], ids=lambda one: one.__name__
)
def test_a_reader_conforms(write):
    name = next(name for name, each in WRITERS.items() if write in each)
    check_reader(FORMATS[name], write, f"example.{name}")


def test_the_template_conforms():
    spec = importlib.util.spec_from_file_location("reader_template", TEMPLATE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    check_reader(module.open_source, module.write)


def faulty(fault):
    """A reader of .npz files with one fault."""

    @contextmanager
    def open_source(path, files):
        """Open an archive of arrays."""
        if fault != "unguarded":
            require_content(path)
        archive = np.load(path)
        held = path.open("rb") if fault == "open" else None
        arrays = {name: archive[name] for name in archive.files}
        kept.append(held)
        if fault == "rows":
            arrays = {name: values[1:] for name, values in arrays.items()}
        if fault == "times":
            arrays["time"] = arrays["time"] + 1
        if fault == "fill":
            arrays["T"] = np.nan_to_num(arrays["T"])
        if fault == "order":
            arrays["B"] = arrays["B"][:, ::-1]
        if fault == "state":
            arrays["T"] = arrays["T"] + 1e-9 * len(kept)
        unit = "flurbs" if fault == "unit" else None
        dropped = () if fault == "drop" else tuple(files.drop)
        names = ("time",) if fault == "names" else tuple(arrays)
        yield Source(path, names, lambda name: Variable(arrays[name], unit=unit), dropped)

    kept = []
    return open_source


FAULTS = {
    "unguarded": "raises .*wrap the library's calls in reading",
    "open": "the file stays open",
    "rows": "59 rows of 60",
    "times": "exact to the nanosecond",
    "fill": "'temperature' is missing in the wrong rows",
    "order": "'field' has other values",
    "state": "the second reading gives other numbers",
    "unit": "flurbs.*give None where the file states no unit",
    "drop": "a variable under 'drop' is read",
    "names": "Source.names lacks B",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_with_a_reader_is_said(fault):
    with pytest.raises(ConformanceError, match=FAULTS[fault]):
        check_reader(faulty(fault), npz, "example.npz")
