"""What has been delivered: which files there are, what is known of them, and which days they hold.

A file whose size and time of change are those on record is not opened. Any other is hashed and its times
are read, so that every row is known by its own UTC day before a day is made.
"""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from inflight.catalog import Catalog, FileRecord
from inflight.catalog.readers import Delivered, NameSpan, describe, find_files, newest, read_times
from inflight.errors import InflightError, ReadError, WorkerError
from inflight.instruments import Files, Instrument
from inflight.mission import Mission
from inflight.tasks.report import problem_of
from inflight.time import as_day, day_bounds, day_of, day_range, to_utc

#: Bumped when the same files would give other archive days.
INGEST_VERSION = 1
#: Jobs given to a cluster before the first result is waited for.
IN_FLIGHT = 16
#: Days that an unreadable file may take with it by what its name says.
_LONGEST_NAME_SPAN = 366

Problem = dict[str, str]
Result = TypeVar("Result")


@dataclass(frozen=True)
class FileIndex:
    """One delivered file: its hash, the UTC days of its rows, and what is wrong with it."""

    delivered: Delivered
    sha256: str
    size: int
    mtime_ns: int
    days: tuple[str, ...]
    problem: Problem | None = None
    #: True when nothing about it has changed since it was taken in.
    known: bool = False

    @property
    def name(self) -> str:
        """Path below the data folder."""
        return self.delivered.name


@dataclass(frozen=True)
class Delivery:
    """All files of one instrument, in order of time; old name -> new name of superseded versions."""

    instrument: str
    key: str
    files: tuple[FileIndex, ...]
    superseded: dict[str, str]

    def by_day(self) -> dict[str, list[FileIndex]]:
        """Return the files of each day: by their rows, or by their name where they cannot be read."""
        days: dict[str, list[FileIndex]] = {}
        for file in self.files:
            for day in file.days:
                days.setdefault(day, []).append(file)
        return dict(sorted(days.items()))


def content_key(files: Files, instrument: Instrument) -> str:
    """Return the sha256 of everything in the mission YAML that decides what a file becomes.

    Patterns, positions and orientations do not: changing them makes no new revision of any day.
    """
    told = {
        "version": INGEST_VERSION,
        "files": files.model_dump(mode="json", exclude={"pattern", "same_as"}),
        "instrument": instrument.model_dump(mode="json", exclude={"files", "position", "orientation"}),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def survey(
    cat: Catalog,
    mission: Mission,
    name: str,
    data: Path,
    *,
    span: tuple[int | None, int | None] = (None, None),
    client: Any = None,
) -> Delivery:
    """Find and index an instrument's files.

    Parameters
    ----------
    cat : Catalog
        Knows what was taken in before.
    mission : Mission
        Patterns and options.
    name : str
        Instrument.
    data : Path
        Folder that the patterns start from.
    span : tuple
        TT2000 bounds (or None) outside which new files are not opened.
    client : distributed.Client, optional
        Reads files in parallel.
    """
    files, instrument = mission.files(name), mission.instruments[name]
    key = content_key(files, instrument)
    records = cat.files(name)
    present, superseded = find_files(data, files)
    gone = [
        told for path in records if not (data / path).exists() and (told := describe(path, files)) is not None
    ]
    # A delivery that was taken in and cleared away since still stands for its days.
    listed, also = newest([*present, *gone])
    known = {file.name: _unchanged(file, data, records.get(file.name), key) for file in listed}
    fresh = [file for file in listed if known[file.name] is None and _touches(file.span, span, files.spill)]
    jobs = [(data / file.name, file, files, instrument) for file in fresh]
    found = {index.name: index for index in each_result(client, index_file, jobs)}
    indexed = [index for file in listed if (index := found.get(file.name) or known[file.name]) is not None]
    return Delivery(name, key, tuple(indexed), superseded | also)


def _unchanged(file: Delivered, data: Path, record: FileRecord | None, key: str) -> FileIndex | None:
    """Return what is on record of a file when its size, time of change and options are the same."""
    if record is None:
        return None
    path = data / file.name
    if path.exists():
        status = path.stat()
        same = (status.st_size, status.st_mtime_ns) == (record.size, record.mtime_ns)
        if not same or record.report.get("key") != key:
            return None
    return FileIndex(
        file,
        record.sha256,
        record.size,
        record.mtime_ns,
        tuple(record.days),
        record.report.get("problem"),
        known=True,
    )


def _touches(span: NameSpan, wanted: tuple[int | None, int | None], spill: int) -> bool:
    start, end = wanted
    before = start is not None and span.end is not None and span.end + spill <= start
    after = end is not None and span.start is not None and span.start - spill >= end
    return not (before or after)


def index_file(path: Path, file: Delivered, files: Files, instrument: Instrument) -> FileIndex:
    """Hash a file and read the days of its rows; what is wrong with it is returned, not raised."""
    try:
        sha256, size, mtime_ns = fingerprint(path)
    except OSError as error:
        unreadable = ReadError(f"cannot be read: {error}", remedy="check the file", file=file.name)
        return FileIndex(file, "", 0, 0, named_days(file.span), problem_of(unreadable))
    try:
        times = read_times(path, files, instrument, file.span)
    except InflightError as error:
        error.file = file.name  # as every later step and the catalog name it
        return FileIndex(file, sha256, size, mtime_ns, named_days(file.span), problem_of(error))
    days = tuple(str(day) for day in np.unique(day_of(times)))
    return FileIndex(file, sha256, size, mtime_ns, days)


def fingerprint(path: Path) -> tuple[str, int, int]:
    """Return sha256, size in bytes and time of change (ns) of a file."""
    status = path.stat()
    with path.open("rb") as stream:
        sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
    return sha256, status.st_size, status.st_mtime_ns


def named_days(span: NameSpan) -> tuple[str, ...]:
    """Return the UTC days a file's name claims."""
    first = span.day
    if first is None:
        return ()
    last = first if span.end is None else as_day(str(to_utc(span.end - 1)))
    return tuple(str(day) for day in day_range(first, last + 1)[:_LONGEST_NAME_SPAN])


def each_result(
    client: Any, function: Callable[..., Result], jobs: Sequence[Sequence[Any]]
) -> Iterator[Result]:
    """Yield the results of a function in the order of its jobs, on a Dask client when there is one.

    At most `IN_FLIGHT` jobs are out at once, so results never pile up.
    """
    if client is None:
        for job in jobs:
            yield function(*job)
        return
    waiting: deque[Any] = deque()
    for job in jobs:
        waiting.append(client.submit(function, *job, pure=False))
        if len(waiting) >= IN_FLIGHT:
            yield result_of(waiting.popleft())
    while waiting:
        yield result_of(waiting.popleft())


def result_of(future: Any) -> Any:
    """Return the result of a Dask future.

    Raises
    ------
    WorkerError
        When several processes in turn died of it. What the function itself raised is raised as it is.
    """
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        raise WorkerError(
            f"{error.allowed_failures + 1} Dask processes in turn ended while they did one piece of work",
            remedy="look for what ends them, most often too little memory: fewer '--workers' or "
            "'--batch-days' need less; then run again",
        ) from error


def within(days: Iterable[str], span: tuple[int | None, int | None]) -> list[str]:
    """Return the days that lie in a half-open TT2000 span."""
    start, end = span
    return [
        day
        for day in days
        if (start is None or day_bounds(day)[1] > start) and (end is None or day_bounds(day)[0] < end)
    ]


def file_report(index: FileIndex, key: str, told: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the catalog keeps of a file beside its hash and days."""
    problem = {"problem": index.problem} if index.problem else {}
    return {"key": key, **problem, **told}
