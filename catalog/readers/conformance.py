"""`check_reader`: whether a reader gives what the archive relies on.

It takes the reader (a function that opens a file, see `inflight.catalog.readers.source.Source`) and a
function that writes an example in the format, has the example read as an ingest would, and reads damaged
copies of it. All failures are reported together, each with what to mend.
"""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.catalog.readers.day_assembly import assemble_day, split_days
from inflight.catalog.readers.patterns import NameSpan
from inflight.catalog.readers.raw import FORMATS, Open, RawTable, read_file, read_times
from inflight.conformance import Faults
from inflight.errors import ContentError, InflightError, ReadError
from inflight.instruments import Channel, Files, Instrument
from inflight.time import SECOND, Int64, day_bounds, to_tt2000, to_utc
from inflight.units import parse_unit

_DAY = np.datetime64("2005-01-31", "D")


_PHASE = np.linspace(0.0, 1.0, 60)
_FIELD = np.stack([20e3 * np.sin(_PHASE), 4e3 * np.cos(_PHASE), -48e3 + 100.0 * _PHASE], axis=1).round(2)
_TEMPERATURE = np.linspace(-5.0, 25.0, 60).round(3)
_TEMPERATURE[[7, 31]] = np.nan


@dataclass(frozen=True)
class Example:
    """What a writer is given: sixty rows, the last two of the next UTC day.

    Attributes
    ----------
    times : ndarray of datetime64[ns], shape (row,)
        UTC, every 10 s.
    field : ndarray, shape (row, 3)
        nT, hundredths.
    temperature : ndarray, shape (row,)
        degC, thousandths; NaN in two rows, which the format may write as its fill value.
    """

    times: npt.NDArray[np.datetime64] = dataclasses.field(
        default_factory=lambda: to_utc(day_bounds(_DAY)[1] + 10 * SECOND * np.arange(-58, 2))
    )
    field: Floats = dataclasses.field(default_factory=_FIELD.copy)
    temperature: Floats = dataclasses.field(default_factory=_TEMPERATURE.copy)

    @property
    def tt2000(self) -> Int64:
        """The times as TT2000, ns."""
        return to_tt2000(self.times)


@dataclass(frozen=True)
class ReadOptions:
    """How an example that was written is to be read: entries of the mission YAML.

    Attributes
    ----------
    field, temperature : mapping
        The channels, such as ``{"variable": "B", "axes": ["x", "y", "z"]}``; units are added.
    files : mapping
        Options of the files, such as ``{"time": "Epoch"}``.
    """

    field: Mapping[str, Any]
    temperature: Mapping[str, Any]
    files: Mapping[str, Any]


Write = Callable[[Path, Example], ReadOptions]


def check_reader(open_source: Open, write: Write, name: str = "example") -> None:
    """Check that a reader keeps its contract.

    Parameters
    ----------
    open_source : callable
        The reader: from path and `Files` to a context manager of a `Source`.
    write : callable
        Writes an `Example` to a path in the reader's format; returns how it is to be read.
    name : str
        File name of the example, where the format wants a suffix.

    Raises
    ------
    ConformanceError
        Listing every check that failed and what to mend.
    """
    faults = Faults()
    with tempfile.TemporaryDirectory() as folder, _registered(open_source) as reader:
        path = Path(folder) / name
        example = Example()
        try:
            written = write(path, example)
            files = Files.model_validate({"pattern": "*", "reader": "npz", **written.files})
            files = files.model_copy(update={"reader": reader})
            channels = {
                "field": Channel.model_validate({"unit": "nT", **written.field}),
                "temperature": Channel.model_validate({"unit": "degC", **written.temperature}),
            }
            instrument = Instrument(role="vector", cadence="10 s", files=files, channels=channels)
            case = _Case(open_source, path, example, files, instrument)
        except (InflightError, ValueError, OSError) as error:
            faults.found.append(f"writing the example: {error}; correct 'write'")
        else:
            for check in _CHECKS:
                faults.collect(check, case)
    faults.require_none(str(getattr(open_source, "__module__", "reader")), "docs/templates/reader.py")


@contextmanager
def _registered(open_source: Open) -> Iterator[str]:
    """Make a reader known by a name for a while."""
    known, name = dict(FORMATS), "reader under check"
    FORMATS[name] = open_source
    try:
        yield name
    finally:
        FORMATS.clear()
        FORMATS.update(known)


@dataclass(frozen=True)
class _Case:
    """The example on disk, and how it is read."""

    open_source: Open
    path: Path
    example: Example
    files: Files
    instrument: Instrument

    def read(self, path: Path | None = None, instrument: Instrument | None = None) -> RawTable:
        """Read a file as an ingest does."""
        return read_file(path or self.path, self.files, instrument or self.instrument, NameSpan())

    @property
    def variables(self) -> list[str]:
        """Names of the variables of both channels."""
        return [name for channel in self.instrument.channels.values() for name in channel.sources]


_CHECKS: list[Callable[[_Case], Iterator[str]]] = []


def _check(function: Callable[[_Case], Iterator[str]]) -> Callable[[_Case], Iterator[str]]:
    """Add a check; checks run in the order they stand in."""
    _CHECKS.append(function)
    return function


@_check
def _has_docstring(case: _Case) -> Iterator[str]:
    if not (case.open_source.__doc__ or "").strip():
        yield "the function has no docstring; name the format and what its variables are"


@_check
def _gives_every_row(case: _Case) -> Iterator[str]:
    table, example = case.read(), case.example
    if table.times.shape != example.times.shape:
        yield f"{table.times.size} rows of {example.times.size} are read; give the file's rows in order"
        return
    if (late := np.flatnonzero(table.times != example.tt2000)).size:
        row = int(late[0])
        yield (
            f"row {row + 1} has time {to_utc(table.times[row])}, written was {example.times[row]}; give "
            "times exact to the nanosecond, as TT2000 in Variable.times, or numbers with 'time_unit'"
        )
    if not np.array_equal(read_times(case.path, case.files, case.instrument), table.times):
        yield "the times alone are others than those of the rows; read every variable the same way"


@_check
def _gives_the_values(case: _Case) -> Iterator[str]:
    table, example = case.read(), case.example
    for name, expected in (("field", example.field), ("temperature", example.temperature)):
        found = table.channels[name]
        if found.shape != expected.shape:
            yield f"'{name}' has shape {found.shape}, written was {expected.shape}; put rows first"
        elif found.dtype.kind != "f":
            yield f"'{name}' comes as {found.dtype}; numbers are needed"
        elif (missing := np.isnan(found) != np.isnan(expected)).any():
            row = int(np.argwhere(missing)[0][0]) + 1
            yield f"'{name}' is missing in the wrong rows (row {row}); state the fill value in Variable.fill"
        elif not np.allclose(found, expected, rtol=1e-7, atol=0.0, equal_nan=True):
            yield f"'{name}' has other values than were written; check scaling and order"


@_check
def _states_known_units(case: _Case) -> Iterator[str]:
    """A stated unit is a unit, and leads to the same values whatever unit the mission asks for."""
    with case.open_source(case.path, case.files) as source:
        for name in case.variables:
            unit = source.read(name).unit
            if unit is None:
                continue
            try:
                parse_unit(unit)
            except ValueError as error:
                yield f"variable {name!r}: {error}; give None where the file states no unit"
    if case.instrument.channels["field"].file_unit is None:
        micro = case.instrument.channels["field"].model_copy(update={"unit": "uT", "file_unit": "nT"})
        other = case.instrument.model_copy(update={"channels": {**case.instrument.channels, "field": micro}})
        found = case.read(instrument=other).channels["field"]
        if not np.allclose(found, 1e-3 * case.example.field, rtol=1e-6, atol=0.0):
            yield "in another unit the field has other values; leave conversions to the archive"


@_check
def _keeps_days_apart(case: _Case) -> Iterator[str]:
    days = split_days(case.read())
    if list(days) != [_DAY, _DAY + 1]:
        yield f"the rows fall on days {', '.join(map(str, days))}, written were {_DAY} and {_DAY + 1}"
        return
    for day, part in days.items():
        dataset, _ = assemble_day(day, [part], "example", case.instrument)
        stamps, (start, end) = dataset["tt2000"].values, day_bounds(day)
        if not (np.all(np.diff(stamps) > 0) and start <= stamps[0] and stamps[-1] < end):
            yield f"times of {day} do not rise within the day; give each row its own time"


@_check
def _reads_the_same_twice(case: _Case) -> Iterator[str]:
    before = hashlib.sha256(case.path.read_bytes()).hexdigest()
    first, second = case.read(), case.read()
    same = first.times.tobytes() == second.times.tobytes() and all(
        first.channels[name].tobytes() == second.channels[name].tobytes() for name in first.channels
    )
    if not same:
        yield "the second reading gives other numbers; keep no state between files"
    if hashlib.sha256(case.path.read_bytes()).hexdigest() != before:
        yield "the file was changed; open it for reading only"
    if _is_open(case.path):
        yield "the file stays open; close it when the context ends"


def _is_open(path: Path) -> bool:
    """Return True when this process holds a file open, as far as the system says."""
    folder = Path("/proc/self/fd")
    if not folder.is_dir():
        return False
    opened = []
    for link in folder.iterdir():
        try:
            opened.append(link.readlink())
        except OSError:
            continue
    return path.resolve() in opened


@_check
def _lists_its_variables(case: _Case) -> Iterator[str]:
    with case.open_source(case.path, case.files) as source:
        if missing := [name for name in case.variables if name not in source.names]:
            yield f"Source.names lacks {', '.join(missing)}; list every variable that can be read"
        try:
            source.read("no_such_variable")
        except ContentError:
            pass
        else:
            yield "a variable that is not there is read; let Source.read refuse it"
    excluded = case.variables[-1]
    with case.open_source(case.path, case.files.model_copy(update={"drop": [excluded]})) as source:
        try:
            source.read(excluded)
        except ContentError:
            return
    yield "a variable under 'drop' is read; give files.drop to Source as 'dropped'"


@_check
def _refuses_bad_files(case: _Case) -> Iterator[str]:
    """Empty, absent, damaged and foreign files are refused by name; of a cut text whole rows may be read."""
    whole = case.path.read_bytes()
    noise = np.random.default_rng(1).integers(0, 256, len(whole), dtype=np.uint8).tobytes()
    bad = {"empty": b"", "foreign": b"<html>404 Not Found</html>\n", "random": noise}
    for label, content in bad.items():
        yield from _refusal(case, f"{label} file", content)
    for part in (0.1, 0.5, 0.9):
        yield from _refusal(
            case, f"file cut at {100 * part:.0f} %", whole[: int(part * len(whole))], cut=True
        )
    try:
        case.read(case.path.with_name("absent" + case.path.suffix))
    except ReadError:
        return
    except Exception as error:
        yield f"an absent file raises {type(error).__name__}; begin with require_content(path)"
        return
    yield "an absent file is read; begin with require_content(path)"


def _refusal(case: _Case, label: str, content: bytes, cut: bool = False) -> Iterator[str]:
    path = case.path.with_name(f"bad{case.path.suffix}")
    path.write_bytes(content)
    try:
        table = case.read(path)
    except (ReadError, ContentError) as error:
        if path.name not in error.file:
            yield f"of an {label} the error does not name the file: {error}; raise it with file=str(path)"
        if not error.remedy:
            yield f"of an {label} the error states no remedy: {error}; state what a person can do"
        return
    except Exception as error:
        yield (
            f"a {label} raises {type(error).__name__}: {error}; wrap the library's calls in reading(path), "
            "which names the file"
        )
        return
    rows = table.times.size
    if not (cut and np.array_equal(table.times, case.example.tt2000[:rows])):
        yield f"a {label} is read as {rows} rows; refuse it with ReadError"
