"""One batch of an ingest: files are read one after the other, days made, one segment written.

It needs no database, so Dask workers run it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import DayData, Segment, write_segment
from inflight.catalog.readers import NameSpan, RawTable, assemble_day, read_file, split_days
from inflight.errors import InflightError, ReadError, StorageError
from inflight.instruments import Files, Instrument
from inflight.tasks.delivery import FileIndex, Problem
from inflight.tasks.report import problem_of

#: Samples of one batch in memory, before packing; it bounds the memory of a worker.
BATCH_BYTES = 64_000_000
MOST_DAYS = 60


@dataclass(frozen=True)
class SourceFile:
    """A file to be read, and its size and time of change when it was hashed."""

    name: str
    path: Path
    span: NameSpan
    size: int
    mtime_ns: int

    def require_unchanged(self) -> None:
        """Raise `ReadError` when the file is gone or another one than was hashed."""
        if not self.path.exists():
            raise ReadError(
                "is not there any more, and a day it has rows of must be made anew",
                remedy="restore the file",
                file=self.name,
            )
        status = self.path.stat()
        if (status.st_size, status.st_mtime_ns) != (self.size, self.mtime_ns):
            raise ReadError("changed while it was taken in", remedy="ingest again", file=self.name)


@dataclass(frozen=True)
class BatchJob:
    """Days of one instrument that a worker makes into one segment; it needs no database."""

    workspace: Path
    run: str
    instrument_name: str
    instrument: Instrument
    files: Files
    #: Every file that holds rows of these days.
    sources: tuple[SourceFile, ...]
    #: Day, key, names of its files, their hashes.
    days: tuple[tuple[str, str, tuple[str, ...], tuple[str, ...]], ...]


@dataclass(frozen=True)
class BatchResult:
    """What came of a batch: a segment of the days that could be made, and why the others could not."""

    segment: Segment | None
    failures: dict[str, Problem]
    #: What was dropped and noted, per file.
    told: dict[str, dict[str, Any]]


def source_file(file: FileIndex, data: Path) -> SourceFile:
    """Return what a worker needs to know of an indexed file."""
    return SourceFile(file.name, data / file.name, file.delivered.span, file.size, file.mtime_ns)


def days_of_batch(instrument: Instrument) -> int:
    """Return how many days of an instrument fit `BATCH_BYTES`, at least 1."""
    numbers = sum(max(1, len(channel.axis_names)) for channel in instrument.channels.values())
    per_day = 86_400_000_000_000 / instrument.cadence * (12 + 8 * numbers)
    return int(np.clip(BATCH_BYTES // per_day, 1, MOST_DAYS))


def make_batch(job: BatchJob) -> BatchResult:
    """Read the files of a batch one after the other, make its days, write them as one segment.

    Raises
    ------
    StorageError
        When the disk refuses the write. What is wrong with files and days is returned instead.
    """
    parts, broken, told = _read_parts(job)
    made: list[DayData] = []
    failures: dict[str, Problem] = {}
    for day, key, names, hashes in job.days:
        problem = next((broken[name] for name in names if name in broken), None)
        if problem is not None:
            failures[day] = problem | {"day": day}
            continue
        try:
            made.append(_make_day(job, day, key, parts.pop(day, []), hashes))
        except StorageError:
            raise
        except InflightError as error:
            failures[day] = problem_of(error, day)
    if not made:
        return BatchResult(None, failures, told)
    segment = write_segment(job.workspace, job.run, f"l1/{job.instrument_name}", _alike(made))
    return BatchResult(segment, failures, told)


def _read_parts(
    job: BatchJob,
) -> tuple[dict[str, list[RawTable]], dict[str, Problem], dict[str, dict[str, Any]]]:
    wanted = {day for day, *_ in job.days}
    parts: dict[str, list[RawTable]] = {}
    broken: dict[str, Problem] = {}
    told: dict[str, dict[str, Any]] = {}
    for source in job.sources:
        name = source.name
        try:
            source.require_unchanged()
            table = read_file(source.path, job.files, job.instrument, source.span, name)
        except InflightError as error:
            error.file = name  # below the data folder, as the catalog names it
            broken[name] = problem_of(error)
            continue
        told[name] = {"rows": int(table.times.size), "dropped": table.dropped, "notes": list(table.notes)}
        for day, part in split_days(table).items():
            if str(day) in wanted:
                parts.setdefault(str(day), []).append(part)
    return parts, broken, told


def _make_day(job: BatchJob, day: str, key: str, parts: list[RawTable], hashes: Iterable[str]) -> DayData:
    if not parts:
        raise InflightError("no file holds rows of this day any more", remedy="ingest again", day=day)
    date = np.datetime64(day, "D")
    dataset, report = assemble_day(date, parts, job.instrument_name, job.instrument)
    channels = report["channels"]
    main = [channels["field"]] if "field" in channels else list(channels.values())
    report["coverage"] = min(channel["coverage"] for channel in main)
    return DayData(date, dataset, key, tuple(f"file:{sha256}" for sha256 in hashes), report)


def _alike(days: list[DayData]) -> list[DayData]:
    """Give a channel one number type in all days of a segment, the one that holds them all exactly."""
    types: dict[str, np.dtype[Any]] = {}
    for item in days:
        for name, array in item.dataset.variables.items():
            types[str(name)] = np.result_type(array.dtype, types.get(str(name), array.dtype))
    return [
        DayData(item.day, _cast(item.dataset, types), item.key, item.parents, item.report) for item in days
    ]


def _cast(dataset: xr.Dataset, types: dict[str, np.dtype[Any]]) -> xr.Dataset:
    return dataset.assign(
        {
            name: array.astype(types[str(name)])
            for name, array in dataset.data_vars.items()
            if array.dtype != types[str(name)]
        }
    )
