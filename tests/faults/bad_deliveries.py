"""The tiny mission as CDF files, one kind of fault a day, good days before and after."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cdflib.cdfwrite import CDF
from tiny_mission import tiny_readings

from inflight.time import to_tt2000

BAD_YAML = """\
mission: faulty
instruments:
  turning:
    role: vector
    cadence: 60 s
    files: {pattern: "turning_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels:
      field: {variable: B, unit: nT, axes: [x, y, z], fill: -1.0e+31}
      temperature: {variable: T, unit: degC, kind: temperature}
  absolute:
    role: scalar
    cadence: 60 s
    files: {pattern: "absolute_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels: {field: {variable: F, unit: nT}}
comparisons: {main: {kind: scalar, vector: turning, scalar: absolute}}
"""
FIRST = np.datetime64("2024-05-01", "D")


@dataclass(frozen=True)
class Fault:
    """One kind of bad delivery: how it is made, and what the complaint about it must name."""

    name: str
    make: Callable[[Path, str], None]
    instrument: str
    file: str
    channel: str
    found: str
    remedy: str


def write(path: Path, day: str, times=None, **values) -> Path:
    """Write a CDF of variables given as values, or as (values, attributes)."""
    path.unlink(missing_ok=True)
    stamps = to_tt2000(tiny_readings(day)[0] if times is None else times)
    file = CDF(path, delete=True)
    for name, given in {"Epoch": (stamps, {}), **values}.items():
        data, attributes = given if isinstance(given, tuple) else (np.asarray(given), {})
        text = data.dtype.kind == "U"
        description = {
            "Variable": name,
            "Data_Type": CDF.CDF_TIME_TT2000 if name == "Epoch" else CDF.CDF_CHAR if text else CDF.CDF_DOUBLE,
            "Num_Elements": data.dtype.itemsize // 4 if text else 1,
            "Rec_Vary": True,
            "Dim_Sizes": list(data.shape[1:]),
        }
        file.write_var(description, var_attrs=attributes, var_data=data.tolist() if text else data)
    file.close()
    return path


def deliver(folder: Path, day: str) -> None:
    """Write a good day."""
    _, reading, scalar = tiny_readings(day)
    write(vector_file(folder, day), day, B=(reading, {"UNITS": "nT"}), T=np.full(1440, 20.0))
    write(scalar_file(folder, day), day, F=(scalar, {"UNITS": "nT"}))


def vector_file(folder: Path, day: str) -> Path:
    return folder / f"turning_{day.replace('-', '')}.cdf"


def scalar_file(folder: Path, day: str) -> Path:
    return folder / f"absolute_{day.replace('-', '')}.cdf"


def _vector(**changed) -> Callable[[Path, str], None]:
    def make(folder: Path, day: str) -> None:
        given = {"B": (tiny_readings(day)[1], {"UNITS": "nT"}), "T": np.full(1440, 20.0), **changed}
        write(
            vector_file(folder, day), day, **{key: value for key, value in given.items() if value is not None}
        )

    return make


def _two_values(folder: Path, day: str) -> None:
    """Let the file of the day before run on past midnight, with other values than the day's own file has."""
    before = str(np.datetime64(day, "D") - 1)
    parts = [tiny_readings(before)[:2], [part[:10] for part in tiny_readings(day)[:2]]]
    times, reading = (np.concatenate(both) for both in zip(*parts, strict=True))
    reading[1440:] += 5.0
    write(vector_file(folder, before), day, times, B=reading, T=np.full(times.size, 20.0))


def _clock_backwards(folder: Path, day: str) -> None:
    times, reading, _ = tiny_readings(day)
    stepped = np.where(np.arange(1440) < 700, times, times - np.timedelta64(6000, "s"))
    write(vector_file(folder, day), day, stepped, B=reading, T=np.full(1440, 20.0))


def _truncated(folder: Path, day: str) -> None:
    path = vector_file(folder, day)
    path.write_bytes(path.read_bytes()[:-3000])


def _zero_length(folder: Path, day: str) -> None:
    scalar_file(folder, day).write_bytes(b"")


def _text(folder: Path, day: str) -> None:
    write(scalar_file(folder, day), day, F=np.array(["calm", "rain"] * 720))


def _zero_scalar(folder: Path, day: str) -> None:
    write(scalar_file(folder, day), day, F=np.zeros(1440))


FAULTS = [
    Fault("missing variable", _vector(T=None), "turning", "turning_{}.cdf", "temperature", "'T'", "variable"),
    Fault(
        "wrong unit",
        _vector(B=(np.ones((1440, 3)), {"UNITS": "mA"})),
        "turning",
        "turning_{}.cdf",
        "field",
        "'mA'",
        "unit",
    ),
    Fault(
        "swapped axes",
        _vector(B=np.ones((1440, 2))),
        "turning",
        "turning_{}.cdf",
        "field",
        "(1440, 2)",
        "axes",
    ),
    Fault(
        "all fill",
        _vector(B=np.full((1440, 3), -1e31)),
        "turning",
        "turning_{}.cdf",
        "field",
        "missing",
        "fill",
    ),
    Fault("text", _text, "absolute", "absolute_{}.cdf", "field", "text where numbers belong", "repair"),
    Fault(
        "two values",
        _two_values,
        "turning",
        "turning_{}.cdf",
        "field",
        "two different values",
        "wrong delivery",
    ),
    Fault(
        "clock backwards",
        _clock_backwards,
        "turning",
        "turning_{}.cdf",
        "field",
        "clock ran backwards",
        "delivery",
    ),
    Fault("truncated", _truncated, "turning", "turning_{}.cdf", "", "truncated", "again"),
    Fault("zero length", _zero_length, "absolute", "absolute_{}.cdf", "", "zero length", "again"),
]
#: A scalar field of zero can be read; it cannot be calibrated with.
ZERO_SCALAR = Fault(
    "zero scalar", _zero_scalar, "absolute", "absolute_{}.cdf", "absolute.field", "0 of 1440", "deliveries"
)
BAD_DAYS = {str(FIRST + 1 + index): fault for index, fault in enumerate([*FAULTS, ZERO_SCALAR])}
GOOD_DAYS = [str(FIRST), str(FIRST + len(BAD_DAYS) + 1)]
