"""Ingest: delivered files become level-1 days ``l1/<instrument>`` of the archive.

`survey` finds an instrument's files and indexes them: a file whose size and time of change are those on
record is not opened, any other is hashed and its times are read, so that every row is known by its own UTC
day. A day is made from every file that holds rows of it (`make_batch`, which needs no database, so that Dask
workers run it) and gets a key from their hashes and from the mission YAML: same key, no work. So a
file delivered twice changes nothing, a corrected one makes new revisions of exactly its days, and an ingest
that was killed is completed by the next one.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day, DayData, FileRecord, Run, Segment, idempotency_key, write_segment
from inflight.catalog.readers import (
    Delivered,
    NameSpan,
    RawTable,
    assemble_day,
    find_files,
    nearest_names,
    newest_versions,
    parse_name,
    pattern_for,
    read_file,
    read_times,
    split_days,
)
from inflight.errors import InflightError, MissionError, ReadError, StorageError
from inflight.instruments import Files, Instrument
from inflight.mission import Mission
from inflight.progress import Progress, silent, with_progress
from inflight.tasks.batches import iter_results
from inflight.tasks.report import RunReport, problem, problem_of
from inflight.time import as_day, day_bounds, day_of, day_range, other_cadence, parse_utc, to_tt2000, to_utc

if TYPE_CHECKING:
    import xarray as xr

#: Bumped when the same files would give other archive days.
INGEST_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class IngestSettings:
    """How much is worked on at a time.

    Attributes
    ----------
    batch_bytes : int
        Samples of one batch in memory, before packing; it bounds the memory of a worker (assumed).
    most_days : int
        Days of one batch (assumed).
    longest_name_span : int
        Days that an unreadable file may mark as failed by the span of its name (assumed).
    """

    batch_bytes: int = 64_000_000
    most_days: int = 60
    longest_name_span: int = 366


INGEST_SETTINGS = IngestSettings()

Problem = dict[str, str]


@dataclass(frozen=True, kw_only=True)
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

    def require_unchanged(self, path: Path) -> None:
        """Raise `ReadError` when the file is gone, or is not the one that was hashed."""
        if not path.exists():
            raise ReadError(
                "is not there any more, and a day it has rows of must be made anew",
                remedy="restore the file",
                file=self.name,
            )
        status = path.stat()
        if (status.st_size, status.st_mtime_ns) != (self.size, self.mtime_ns):
            raise ReadError("changed while it was taken in", remedy="ingest again", file=self.name)


@dataclass(frozen=True)
class Delivery:
    """All files of one instrument, in order of time; old name -> new name of superseded versions.

    `unread` new files were left out: `survey` was told not to read any. `missing` says that no file was ever
    delivered: none is here, and none was taken in before.
    """

    instrument: str
    key: str
    files: tuple[FileIndex, ...]
    superseded: dict[str, str]
    unread: int = 0
    missing: Problem | None = None

    def by_day(self) -> dict[str, list[FileIndex]]:
        """Return the files of each day: by their rows, or by their name where they cannot be read."""
        days: dict[str, list[FileIndex]] = {}
        for file in self.files:
            for day in file.days:
                days.setdefault(day, []).append(file)
        return dict(sorted(days.items()))


def content_key(files: Files, instrument: Instrument) -> str:
    """Return the sha256 of everything in the mission YAML that decides what a file becomes.

    Patterns, positions and orientations do not: changing them makes no new revision of any day. What a
    mission says of stamps and averaging does by what it adds to the stamps.
    """
    elsewhere = {"files", "position", "orientation", "averaging", "stamp", "delay", "sigma"}
    content = {
        "version": INGEST_VERSION,
        "files": files.model_dump(mode="json", exclude={"pattern", "same_as"}),
        "instrument": instrument.model_dump(mode="json", exclude=elsewhere),
    } | ({"moment": instrument.moment_ns} if instrument.moment_ns else {})
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def survey(
    cat: Catalog,
    mission: Mission,
    name: str,
    data: Path,
    *,
    span: tuple[int | None, int | None] = (None, None),
    client: Any = None,
    read_new: bool = True,
    only: Sequence[str] | None = None,
    progress: Progress = silent,
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
    read_new : bool
        Read files that are not on record; they are only counted otherwise.
    only : sequence of str, optional
        Of the files below the folder these alone, by their paths below it.
    progress : callable, optional
        Called with ("index", done, total) of the files that are read.
    """
    files, instrument = mission.files(name), mission.instruments[name]
    key = content_key(files, instrument)
    records = cat.files(name)
    present, superseded = find_files(data, files)
    if only is not None:
        present = [delivered for delivered in present if delivered.name in set(only)]
    absent = (parse_name(path, files) for path in records if not (data / path).exists())
    gone = [delivered for delivered in absent if delivered is not None]
    # A delivery that was taken in and removed since still holds for its days.
    listed, also = newest_versions([*present, *gone])
    known = {file.name: _recorded_index(file, data, records.get(file.name), key) for file in listed}
    new = [file for file in listed if known[file.name] is None and _overlaps(file.span, span, files.spill)]
    jobs = [(data / file.name, file, files, instrument) for file in (new if read_new else [])]
    results = with_progress(progress, "index", iter_results(client, index_file, jobs), len(jobs))
    found = {index.name: index for index in results}
    indexed = [index for file in listed if (index := found.get(file.name) or known[file.name]) is not None]
    missing = None if listed or only is not None else _nothing_delivered(name, data, files)
    return Delivery(name, key, tuple(indexed), superseded | also, len(new) - len(jobs), missing)


def _nothing_delivered(name: str, data: Path, files: Files) -> Problem:
    """Return the problem that no file matches an instrument's patterns, with the names nearest to them."""
    patterns = " or ".join(map(repr, files.pattern or ()))
    near = nearest_names(data, files)
    there = f"; the nearest names are {', '.join(near)}" if near else "; no file there is called alike"
    fitting = pattern_for(near[0]) if near else ""
    remedy = (
        f"mission.yaml, instruments.{name}.files.pattern: {fitting!r} would match"
        if fitting
        else (f"put the files there, or mend instruments.{name}.files.pattern in mission.yaml")
    )
    return problem("repeatable", f"no file below {data} matches {patterns}{there}", remedy=remedy)


def _recorded_index(file: Delivered, data: Path, record: FileRecord | None, key: str) -> FileIndex | None:
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
        delivered=file,
        sha256=record.sha256,
        size=record.size,
        mtime_ns=record.mtime_ns,
        days=tuple(record.days),
        problem=record.report.get("problem"),
        known=True,
    )


def _overlaps(span: NameSpan, other: tuple[int | None, int | None], spill: int) -> bool:
    """Return True when a file whose name claims a span may hold rows of another one."""
    start, end = other
    before = start is not None and span.end is not None and span.end + spill <= start
    after = end is not None and span.start is not None and span.start - spill >= end
    return not (before or after)


def index_file(path: Path, file: Delivered, files: Files, instrument: Instrument) -> FileIndex:
    """Hash a file and read the days of its rows; what is wrong with it is returned, not raised."""
    index = FileIndex(delivered=file, sha256="", size=0, mtime_ns=0, days=named_days(file.span))
    try:
        sha256, size, mtime_ns = fingerprint(path)
    except OSError as error:
        unreadable = ReadError(f"cannot be read: {error}", remedy="check the file", file=file.name)
        return replace(index, problem=problem_of(unreadable))
    index = replace(index, sha256=sha256, size=size, mtime_ns=mtime_ns)
    try:
        times = read_times(path, files, instrument, file.span)
    except InflightError as error:
        error.file = file.name  # as every later step and the catalog name it
        return replace(index, problem=problem_of(error))
    return replace(index, days=tuple(str(day) for day in np.unique(day_of(times))))


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
    return tuple(str(day) for day in day_range(first, last + 1)[: INGEST_SETTINGS.longest_name_span])


@dataclass(frozen=True, kw_only=True)
class BatchJob:
    """Days of one instrument that a worker makes into one segment; it needs no database.

    Attributes
    ----------
    data : Path
        Folder of the deliveries.
    options : Files
        How the instrument's files are read.
    files : tuple of FileIndex
        Every file that holds rows of these days, in order of time.
    keys : mapping of str to str
        The days and their keys.
    """

    workspace: Path
    data: Path
    run: str
    instrument_name: str
    instrument: Instrument
    options: Files
    files: tuple[FileIndex, ...]
    keys: Mapping[str, str]


@dataclass(frozen=True)
class BatchResult:
    """What came of a batch: a segment of the days that could be made, and why the others could not."""

    segment: Segment | None
    failures: dict[str, Problem]
    #: What was dropped and noted, per file.
    notes: dict[str, dict[str, Any]]


def days_of_batch(instrument: Instrument) -> int:
    """Return how many days of an instrument fit `INGEST.batch_bytes`, at least 1."""
    numbers = sum(max(1, len(channel.axis_names)) for channel in instrument.channels.values())
    per_day = 86_400_000_000_000 / instrument.cadence * (12 + 8 * numbers)
    return int(np.clip(INGEST_SETTINGS.batch_bytes // per_day, 1, INGEST_SETTINGS.most_days))


def make_batch(job: BatchJob) -> BatchResult:
    """Read the files of a batch one after the other, make its days, write them as one segment.

    Raises
    ------
    StorageError
        When the disk refuses the write. What is wrong with files and days is returned instead.
    """
    tables, broken, notes = _read_tables(job)
    made: list[DayData] = []
    failures: dict[str, Problem] = {}
    for day, key in job.keys.items():
        files = [file for file in job.files if day in file.days]
        problem = next((broken[file.name] for file in files if file.name in broken), None)
        if problem is not None:
            failures[day] = problem | {"day": day}
            continue
        try:
            if day not in tables:
                raise InflightError("no file holds rows of this day any more", remedy="ingest again", day=day)
            date = np.datetime64(day, "D")
            dataset, report = assemble_day(date, tables.pop(day), job.instrument_name, job.instrument)
        except StorageError:
            raise
        except InflightError as error:
            failures[day] = problem_of(error, day)
            continue
        channels = report["channels"]
        main = [channels["field"]] if "field" in channels else list(channels.values())
        report["coverage"] = min(channel["coverage"] for channel in main)
        made.append(DayData(date, dataset, key, tuple(f"file:{file.sha256}" for file in files), report))
    if not made:
        return BatchResult(None, failures, notes)
    segment = write_segment(job.workspace, job.run, f"l1/{job.instrument_name}", _with_common_types(made))
    return BatchResult(segment, failures, notes)


def _read_tables(
    job: BatchJob,
) -> tuple[dict[str, list[RawTable]], dict[str, Problem], dict[str, dict[str, Any]]]:
    """Return the rows of each day of a batch, and by file what is wrong with it and what was noted."""
    tables: dict[str, list[RawTable]] = {}
    broken: dict[str, Problem] = {}
    notes: dict[str, dict[str, Any]] = {}
    for file in job.files:
        name, path = file.name, job.data / file.name
        try:
            file.require_unchanged(path)
            table = read_file(path, job.options, job.instrument, file.delivered.span, name)
        except InflightError as error:
            error.file = name  # below the data folder, as the catalog names it
            broken[name] = problem_of(error)
            continue
        told = [*table.notes, other_cadence(table.times, job.instrument.cadence)]
        notes[name] = {
            "rows": int(table.times.size),
            "dropped": table.dropped,
            "notes": list(filter(None, told)),
        }
        for day, part in split_days(table).items():
            if str(day) in job.keys:
                tables.setdefault(str(day), []).append(part)
    return tables, broken, notes


def _with_common_types(days: list[DayData]) -> list[DayData]:
    """Give a channel one number type in all days of a segment, the one that holds them all exactly."""
    types: dict[str, np.dtype[Any]] = {}
    for day in days:
        for name, array in day.dataset.variables.items():
            types[str(name)] = np.result_type(array.dtype, types.get(str(name), array.dtype))

    def cast(dataset: xr.Dataset) -> xr.Dataset:
        named = {str(name): array for name, array in dataset.data_vars.items()}
        return dataset.assign(
            {name: array.astype(types[name]) for name, array in named.items() if array.dtype != types[name]}
        )

    return [replace(day, dataset=cast(day.dataset)) for day in days]


@dataclass(kw_only=True)
class _Plan:
    """What one instrument's days need."""

    delivery: Delivery
    keys: dict[str, str] = field(default_factory=dict)
    todo: list[str] = field(default_factory=list)
    adopt: list[str] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    #: Failures that are on record with the same key, and new ones.
    failed: dict[str, Problem] = field(default_factory=dict)
    new_failures: dict[str, Problem] = field(default_factory=dict)
    #: Days between the first and the last that no file holds; those not on record yet.
    empty: list[str] = field(default_factory=list)
    new_empty: list[str] = field(default_factory=list)
    notes: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def dataset(self) -> str:
        return f"l1/{self.delivery.instrument}"

    @property
    def has_work(self) -> bool:
        new_files = any(not file.known for file in self.delivery.files)
        return bool(new_files or self.todo or self.adopt or self.new_failures or self.new_empty)

    def summary(self, done: Sequence[Day]) -> dict[str, Any]:
        """Return what the report says of the dataset; `done` are its days that were published."""
        dropped: Counter[str] = Counter()
        for notes in self.notes.values():
            dropped.update(notes["dropped"])
        return {
            "days": len(self.keys),
            "done": len(done),
            "mean_coverage": round(float(np.mean([day.coverage for day in done])), 6) if done else None,
            "first": min(self.keys, default=""),
            "last": max(self.keys, default=""),
            "dropped": dict(dropped),
            "notes": sorted({note for notes in self.notes.values() for note in notes["notes"]})[:20],
        }


def ingest(
    cat: Catalog,
    mission: Mission,
    data: Path | str,
    instruments: Sequence[str] | None = None,
    start: str | np.datetime64 | None = None,
    end: str | np.datetime64 | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
    batch_days: int | None = None,
    files: Sequence[str] | None = None,
) -> RunReport:
    """Take delivered files into the archive.

    Parameters
    ----------
    cat : Catalog
        The workspace's catalog.
    mission : Mission
        Instruments, channels and file patterns.
    data : Path
        Folder that the patterns start from.
    instruments : sequence of str, optional
        Only these.
    start, end : UTC date, optional
        Half-open span of days.
    client : distributed.Client, optional
        Batches run on it; the archive is the same byte for byte as without.
    progress : callable, optional
        Called with (stage, done, total).
    batch_days : int, optional
        Days of one segment; chosen from the cadence when absent.
    files : sequence of str, optional
        These files alone, by their paths below the folder.

    Returns
    -------
    RunReport
        Days by outcome, and each problem with file, day, channel and remedy. What went wrong with one
        file or day does not stop the others. Extra fields: ``datasets``, ``files``.

    Raises
    ------
    MissionError
        When an instrument is not in the mission.
    StorageError
        When the disk refuses a write; nothing is published then.
    """
    names, folder = _named_instruments(mission, instruments), Path(data).resolve()
    span = (_bound(start), _bound(end))
    report_progress = progress or silent
    plans, indexed = [], 0

    def tell_files(stage: str, done: int, total: int) -> None:
        # Those of the instruments before, and of this one.
        report_progress(stage, indexed + done, indexed + total)

    for name in names:
        how: Any = {"span": span, "client": client, "only": files, "progress": tell_files}
        delivery = survey(cat, mission, name, folder, **how)
        indexed += sum(not file.known for file in delivery.files)
        plans.append(_plan(cat, delivery, span))
    if not any(plan.has_work for plan in plans):
        return _report("", plans, [])
    settings = {"mission": mission.mission, "mission_sha": mission.sha, "instruments": names}
    settings |= {"start": str(start or ""), "end": str(end or "")}
    with cat.run(
        "ingest", settings | {"days_planned": sum(len(plan.todo) + len(plan.adopt) for plan in plans)}
    ) as run:
        jobs = [job for plan in plans for job in _jobs(cat, mission, run, folder, plan, batch_days)]
        by_instrument = {plan.delivery.instrument: plan for plan in plans}
        results = iter_results(client, make_batch, [(job,) for job in jobs])
        results = with_progress(report_progress, "ingest", results, len(jobs))
        for job, result in zip(jobs, results, strict=True):
            plan = by_instrument[job.instrument_name]
            if result.segment is not None:
                run.attach(result.segment)
            plan.new_failures |= result.failures
            plan.notes |= result.notes
        for plan in plans:
            _record(cat, run, plan)
        published = run.publish()
    return _report(run.id, plans, published)


def ingest_if_unchanged(
    cat: Catalog,
    mission: Mission,
    data: Path | str,
    instruments: Sequence[str] | None = None,
    start: str | np.datetime64 | None = None,
    end: str | np.datetime64 | None = None,
    files: Sequence[str] | None = None,
) -> RunReport | None:
    """Return the report of an ingest that has nothing to do; None when there is work. No file is opened.

    Parameters and errors are those of `ingest`.
    """
    span, plans = (_bound(start), _bound(end)), []
    for name in _named_instruments(mission, instruments):
        folder = Path(data).resolve()
        delivery = survey(cat, mission, name, folder, span=span, read_new=False, only=files)
        plans.append(_plan(cat, delivery, span))
        if delivery.unread or plans[-1].has_work:
            return None
    return _report("", plans, [])


def _named_instruments(mission: Mission, instruments: Sequence[str] | None) -> list[str]:
    names = list(mission.instruments if instruments is None else instruments)
    if unknown := [name for name in names if name not in mission.instruments]:
        raise MissionError(
            f"the mission has no instrument {', '.join(unknown)}",
            remedy=f"choose from {', '.join(mission.instruments)}",
        )
    return names


def _bound(day: str | np.datetime64 | None) -> int | None:
    return None if day is None else int(to_tt2000(parse_utc(str(day))))


def _plan(cat: Catalog, delivery: Delivery, span: tuple[int | None, int | None]) -> _Plan:
    """Compare what was delivered with what is published, recorded as failed, or left by a dead run."""
    plan, by_day, (start, end) = _Plan(delivery=delivery), delivery.by_day(), span
    if not by_day:
        return plan

    def known_as(state: str) -> dict[str, Day]:
        # Of the days delivered: of a long mission those may be the last month.
        delivered = slice(min(by_day), str(np.datetime64(max(by_day), "D") + 1))
        return {str(day.day): day for day in cat.days(plan.dataset, delivered, states=[state])}

    published, failed = known_as("published"), known_as("failed")
    verified = {(day, found.key) for day, found in known_as("verified").items()}
    for day, files in by_day.items():
        first, last = day_bounds(day)
        if (start is not None and last <= start) or (end is not None and first >= end):
            continue
        hashes = sorted(file.sha256 for file in files)
        key = idempotency_key(plan.dataset, day, INGEST_VERSION, delivery.key, hashes)
        plan.keys[day] = key
        broken = next((file.problem for file in files if file.problem), None)
        if day in published and published[day].key == key:
            plan.unchanged.append(day)
        elif day in failed and failed[day].key == key and failed[day].cause == "repeatable":
            plan.failed[day] = dict(failed[day].report.get("problem", {"message": failed[day].message}))
        elif broken is not None:
            plan.new_failures[day] = broken | {"day": day}
        elif (day, key) in verified:
            plan.adopt.append(day)
        else:
            plan.todo.append(day)
    if plan.keys:
        # Days between the first and the last one that no file holds: each gap gets its cause.
        known, recorded = {*by_day, *published, *failed}, known_as("no_work")
        between = map(str, day_range(min(plan.keys), max(plan.keys)))
        plan.empty = [day for day in between if day not in known]
        plan.new_empty = [day for day in plan.empty if day not in recorded]
    return plan


def _jobs(
    cat: Catalog, mission: Mission, run: Run, data: Path, plan: _Plan, batch_days: int | None
) -> list[BatchJob]:
    for day in plan.adopt:
        if run.adopt(plan.dataset, day, plan.keys[day]) is None:
            plan.todo.append(day)
    name = plan.delivery.instrument
    size, todo = batch_days or days_of_batch(mission.instruments[name]), sorted(plan.todo)
    batches = [todo[begin : begin + size] for begin in range(0, len(todo), size)]
    return [
        BatchJob(
            workspace=cat.workspace,
            data=data,
            run=run.id,
            instrument_name=name,
            instrument=mission.instruments[name],
            options=mission.files(name),
            files=tuple(file for file in plan.delivery.files if not set(days).isdisjoint(file.days)),
            keys={day: plan.keys[day] for day in days},
        )
        for days in batches
    ]


def _record(cat: Catalog, run: Run, plan: _Plan) -> None:
    """Record failures, empty days and files; files count as taken in when the run publishes."""
    for day, found in plan.new_failures.items():
        run.record(
            plan.dataset,
            day,
            "failed",
            found.get("cause") or "repeatable",
            found.get("message", ""),
            {"problem": found},
            plan.keys[day],
        )
    run.record_no_work(
        plan.dataset, dict.fromkeys(plan.new_empty, "no delivered file holds rows of this day")
    )
    cat.record_files(
        run,
        [
            FileRecord(
                instrument=plan.delivery.instrument,
                path=file.name,
                sha256=file.sha256,
                size=file.size,
                mtime_ns=file.mtime_ns,
                days=tuple(map(str, file.days)),
                report={
                    "key": plan.delivery.key,
                    **({"problem": file.problem} if file.problem else {}),
                    **plan.notes.get(file.name, {}),
                },
                run=run.id,
            )
            for file in plan.delivery.files
            if not file.known
        ],
    )


def _report(run: str, plans: Sequence[_Plan], published: Sequence[Day]) -> RunReport:
    done: dict[str, list[Day]] = {plan.dataset: [] for plan in plans}
    for day in published:
        done[day.dataset].append(day)
    problems = []
    for plan in plans:
        name = plan.delivery.instrument
        failures = plan.failed | plan.new_failures
        problems += [{"instrument": name, **plan.delivery.missing}] if plan.delivery.missing else []
        problems += [{"instrument": name, **problem, "day": day} for day, problem in sorted(failures.items())]
        problems += [
            {"instrument": name, **file.problem}
            for file in plan.delivery.files
            if file.problem and not file.days
        ]
    counts = {
        "planned": sum(len(plan.keys) for plan in plans),
        "done": len(published),
        "unchanged": sum(len(plan.unchanged) for plan in plans),
        "failed": sum(len(plan.failed) + len(plan.new_failures) for plan in plans),
        "no_work": sum(len(plan.empty) for plan in plans),
    }
    extra = {
        "datasets": {plan.dataset: plan.summary(done[plan.dataset]) for plan in plans},
        "files": {
            "read": sum(not file.known for plan in plans for file in plan.delivery.files),
            "unchanged": sum(file.known for plan in plans for file in plan.delivery.files),
            "superseded": {
                old: new for plan in plans for old, new in sorted(plan.delivery.superseded.items())
            },
        },
    }
    outputs = sorted({day.segment for day in published})
    return RunReport("ingest", run=run, days=counts, problems=problems, outputs=outputs, extra=extra)
