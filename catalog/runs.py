"""Runs: one piece of work whose days become visible together, or not at all.

A run registers the segments that workers wrote (`Run.attach`) and records days without data; `Run.publish`
makes its days the present ones and certifies its tables, in one transaction.

`close_dead_runs` ends the runs of processes that are gone. With a database in the workspace the process of a
run is known by host, pid and the time it began. With a server a run has a lease, which its process renews
(`_Pulse`), and whose end is on the clock of the database: machines need neither know each other nor agree on
the time. A run that was ended so publishes nothing any more, should its process go on after all.
"""

from __future__ import annotations

import datetime as dt
import os
import socket
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, Final, ParamSpec, Self, TypeVar

import numpy as np
from sqlalchemy import func, select, tuple_, update
from sqlalchemy.orm import Session

from inflight.catalog.backends import Backend
from inflight.catalog.database import Database, present_time, time_in_order
from inflight.catalog.days import adoptable_day, adoptable_days, day_record
from inflight.catalog.faultpoints import fault_point
from inflight.catalog.layout import plain_attributes
from inflight.catalog.location import require_not_moved
from inflight.catalog.manifest import manifest_faults, manifest_sha256
from inflight.catalog.provenance import Edge, add_edges, parent_ids, walk
from inflight.catalog.records import (
    CAUSES,
    DAY_STATES,
    Day,
    DayData,
    RunRecord,
    Segment,
    SegmentRow,
    utc_day,
    version_text,
)
from inflight.catalog.schema import (
    CurrentRow,
    DatasetRow,
    DayRow,
    FileRow,
    RunRow,
    SettingRow,
    StoreRow,
    TableRow,
)
from inflight.catalog.segments import clear_unfinished, flush_segment, write_segment, write_table
from inflight.catalog.spans import as_date
from inflight.catalog.validity import Authority, Certification, certify_table
from inflight.errors import CatalogError, InflightError, IntegrityError, StorageError

if TYPE_CHECKING:
    import xarray as xr

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

#: States a caller may record; the others follow from staging and publishing.
_RECORDED = ("planned", "running", "failed", "no_work")
#: Setting that holds the release baseline, the XX of ``vXX.YY``.
BASELINE_SETTING: Final = "baseline"

#: Runs that a rate is taken from, the last ones.
_RUNS_OF_A_RATE: Final = 20


class Run:
    """One run, to be used in a ``with`` statement; made by `Catalog.run`.

    Leaving the block closes the run: ``done``, or ``failed`` with cause and message when it raised.
    Days that were attached and not published stay unseen; a later run may adopt them.

    Attributes
    ----------
    report : mapping, optional
        Plain fields that are kept with a run that is done.
    """

    def __init__(
        self, workspace: Path, database: Database, kind: str, settings: Mapping[str, Any], context: str | None
    ) -> None:
        now = database.read(time_in_order, RunRow.started)
        self.id = f"{now:%Y%m%dT%H%M%S}-{kind}-{uuid.uuid4().hex[:8]}"
        self.kind, self.context, self.workspace = kind, context, workspace
        self.settings: dict[str, Any] = plain_attributes(settings, f"run '{kind}'")
        self.report: Mapping[str, Any] | None = None
        self._database = database
        self._started, self._began = now, time.monotonic()
        self._intact_stores: set[str] = set()
        #: Datasets it has days of.
        self._datasets: set[str] = set()
        self._pulse: _Pulse | None = None

    def __enter__(self) -> Self:
        self._database.write_to((), self._begin)
        if self._database.backend.lease_s:
            self._pulse = _Pulse(self._database, self.id)
            self._pulse.start()
        return self

    def _begin(self, session: Session) -> None:
        require_not_moved(session)
        session.add(
            RunRow(
                id=self.id,
                kind=self.kind,
                settings=self.settings,
                context=self.context,
                state="running",
                host=socket.gethostname(),
                pid=os.getpid(),
                process=_process_start(os.getpid()),
                started=max(self._started, time_in_order(session, RunRow.started)).isoformat(
                    timespec="microseconds"
                ),
                lease=_lease(self._database.backend),
            )
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        state = "done" if error is None else "failed"
        cause, message = (
            ("", "") if error is None else (failure_cause(error), f"{type(error).__name__}: {error}")
        )
        clear_unfinished(self.workspace, self.id)
        if self._pulse is not None:
            self._pulse.stop()
        report = None if error else self.report
        try:
            self._database.write_to(
                (), close_run, self.id, state, cause, message, report, time.monotonic() - self._began
            )
        except CatalogError as refused:
            if error is None:
                raise
            # The first failure is reported; the next opening after this process closes the run.
            error.add_note(f"the run could not be closed: {refused}")

    def attach(self, segment: Segment, parents: Iterable[Day | str] = ()) -> list[Day]:
        """Register the days of a verified segment with this run.

        Parameters
        ----------
        segment : Segment
            From `write_segment` with this run's id.
        parents : iterable of Day or lineage ids
            Of all its days, in addition to those each `DayData` states and the run's context.

        Returns
        -------
        list of Day
            In state ``verified``; invisible to readers until `publish`.

        Raises
        ------
        CatalogError
            When this run has already published one of the days.
        """
        flush_segment(self.workspace, segment)
        fault_point("attach")
        shared = parent_ids(parents) + ([f"context:{self.context}"] if self.context else [])
        return self._write_to(segment.name, self._attach, segment, shared)

    def _attach(self, session: Session, segment: Segment, shared: Sequence[str]) -> list[Day]:
        dataset = _dataset(session, segment.name)
        store = self._store(session, segment)
        rows = self._staged_rows(session, dataset, store, segment.rows)
        pairs = zip(rows, segment.rows, strict=True)
        add_edges(
            session,
            (
                Edge(parent, f"day:{row.id}")
                for row, written in pairs
                for parent in [*written.parents, *shared]
            ),
        )
        return [day_record(row, segment.name, segment.path) for row in rows]

    def stage(
        self,
        name: str,
        dataset: xr.Dataset,
        *,
        day: str | np.datetime64,
        parents: Iterable[Day | str] = (),
        key: str = "",
        report: Mapping[str, Any] | None = None,
    ) -> Day:
        """Write one day as a segment of its own and attach it; see `write_segment` and `attach`."""
        data = DayData(utc_day(day), dataset, key, report=report or {})
        return self.attach(write_segment(self.workspace, self.id, name, [data]), parents)[0]

    def stage_table(
        self,
        name: str,
        dataset: xr.Dataset,
        *,
        start: int,
        end: int,
        parents: Iterable[Day | str] = (),
        key: str = "",
        context: str | None = None,
    ) -> int:
        """Write a calibration table; it holds nowhere until it is certified.

        Parameters
        ----------
        name : str
            Of the table, such as ``offsets``.
        dataset : xarray.Dataset
            Dims ``interval``, ``parameter``; variables value, sigma, covariance, start, end, determined
            and source.
        start, end : int
            Half-open TT2000 span it was made for.
        parents, key, context
            As for days; `context` is the run's unless given.

        Returns
        -------
        int
            Its id.
        """
        context = self.context if context is None else context
        segment = write_table(self.workspace, self.id, f"tables/{name}", dataset)
        flush_segment(self.workspace, segment)
        columns = {"name": name, "start": start, "end": end, "key": key, "context": context}
        made_from = parent_ids(parents) + ([f"context:{context}"] if context else [])
        return self._write_to(segment.name, self._attach_table, segment, columns, made_from)

    def _attach_table(
        self, session: Session, segment: Segment, columns: Mapping[str, Any], made_from: Sequence[str]
    ) -> int:
        table = TableRow(run_id=self.id, store_id=self._store(session, segment).id, **columns)
        session.add(table)
        session.flush()
        add_edges(session, (Edge(parent, f"table:{table.id}") for parent in made_from))
        return table.id

    def record(
        self,
        name: str,
        day: str | np.datetime64,
        state: str,
        cause: str = "",
        message: str = "",
        report: Mapping[str, Any] | None = None,
        key: str = "",
    ) -> Day:
        """Record what became of a day that has nothing to attach: planned, running, failed or no_work.

        Raises
        ------
        CatalogError
            When state or cause is unknown, a failure has no cause, or the run has published the day.
        """
        if state not in _RECORDED:
            raise CatalogError(
                f"state {state!r} cannot be recorded", remedy=f"use one of {', '.join(_RECORDED)}"
            )
        if (cause or state == "failed") and cause not in CAUSES:
            raise CatalogError(f"cause {cause!r} is unknown", remedy=f"use one of {', '.join(CAUSES)}")
        plain = plain_attributes(report or {}, f"the report of day {day}")
        columns: dict[str, Any] = {"state": state, "cause": cause, "message": message, "report": plain}
        columns["key"], columns["coverage"] = key, plain.get("coverage")
        (recorded,) = self._write_to(name, self._record, name, {as_date(day): columns})
        return recorded

    def record_no_work(self, name: str, days: Mapping[Any, str]) -> None:
        """Record, in one transaction, days with nothing to work on: day -> what is missing."""
        columns = {"state": "no_work", "cause": "no_work"}
        rows = {as_date(day): {**columns, "message": message} for day, message in days.items()}
        self._write_to(name, self._record, name, rows)

    def _record(self, session: Session, name: str, days: Mapping[dt.date, Mapping[str, Any]]) -> list[Day]:
        if not days:
            return []
        rows = self._own_rows(session, _dataset(session, name), list(days))
        for row, columns in zip(rows, days.values(), strict=True):
            for column, value in columns.items():
                setattr(row, column, value)
        session.flush()
        return [day_record(row, name, None) for row in rows]

    def adoptable(self, name: str) -> set[tuple[np.datetime64, str]]:
        """Return (day, key) of what `adopt` would find, by one query."""
        found = self._database.read(adoptable_days, name)
        return {(np.datetime64(day, "D"), key) for day, key in found}

    def adopt(self, name: str, day: str | np.datetime64, key: str) -> Day | None:
        """Take over a day that an ended run verified with the same key and never published.

        Returns
        -------
        Day or None
            Now a day of this run, or None when there is none, or its store is damaged.
        """
        if not key:
            return None
        return self._write_to(name, self._adopt, name, as_date(day), key)

    def _adopt(self, session: Session, name: str, day: dt.date, key: str) -> Day | None:
        found = adoptable_day(session, name, day, key)
        if found is None:
            return None
        theirs, store = found
        if store.path not in self._intact_stores:
            if manifest_faults(self.workspace / store.path, store.sha256):
                return None
            self._intact_stores.add(store.path)
        written = theirs.as_record(SegmentRow, day=utc_day(theirs.day))
        (row,) = self._staged_rows(session, theirs.dataset_id, store, [written])
        adopted = f"day:{theirs.id}"
        made_from = [edge.parent for edge in walk(session, [adopted], up=True) if edge.child == adopted]
        add_edges(session, (Edge(parent, f"day:{row.id}") for parent in made_from))
        return day_record(row, name, store.path)

    def publish(self, certify: Sequence[Certification] = (), *, supersede: bool = False) -> list[Day]:
        """Make all attached days of this run the present ones, in one transaction.

        Parameters
        ----------
        certify : sequence of (table id, start, end, context)
            Validities that begin with the publication (TT2000, half-open).
        supersede : bool
            End older validities that overlap.

        Returns
        -------
        list of Day
            The days now published, with their versions. A day whose key equals that of the present
            revision changes nothing and is recorded as ``no_work``.

        Raises
        ------
        ValidityError
            When a validity overlaps another; nothing is published then.
        IntegrityError
            When a store is missing or not the one that was verified; nothing is published then.
        """
        published = self._write_to(None, self._publish, certify, supersede)
        fault_point("published")
        return published

    def _publish(self, session: Session, certify: Sequence[Certification], supersede: bool) -> list[Day]:
        fault_point("publish_begun")
        rows = session.execute(
            select(DayRow, StoreRow, DatasetRow.name)
            .join(StoreRow, StoreRow.id == DayRow.store_id)
            .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
            .where(DayRow.run_id == self.id, DayRow.state == "verified")
            .order_by(DatasetRow.name, DayRow.day)
        ).all()
        for path, sha256 in {store.path: store.sha256 for _, store, _ in rows}.items():
            if manifest_sha256(self.workspace / path) != sha256:
                raise IntegrityError(
                    "the manifest is not the one that was verified", file=path, remedy="run again"
                )
        published = _move_pointers(session, self.id, [row for row, _, _ in rows])
        authority = Authority(reason=str(self.settings.get("reason", "")), run=self.id)
        for certification in certify:
            certify_table(session, certification, authority, supersede=supersede)
        # A delivered file counts as taken in only with the days that were made from it.
        session.execute(update(FileRow).where(FileRow.run_id == self.id).values(taken=True))
        session.flush()
        fault_point("publish_flushed")
        return [day_record(row, name, store.path) for row, store, name in rows if row.id in published]

    def _write_to(
        self,
        dataset: str | None,
        change: Callable[Concatenate[Session, Arguments], Answer],
        /,
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        """Call `change` with a session that keeps out other writers of a dataset, or of all this run has."""

        def checked(session: Session) -> Answer:
            _require_running(session, self.id)
            return change(session, *arguments, **options)

        if dataset is not None:
            self._datasets.add(dataset)
        return self._database.write_to(self._datasets if dataset is None else [dataset], checked)

    def _store(self, session: Session, segment: Segment) -> StoreRow:
        store = StoreRow(
            path=segment.path,
            sha256=segment.sha256,
            bytes=segment.bytes,
            notes=list(segment.notes),
            run_id=self.id,
        )
        session.add(store)
        session.flush()
        return store

    def _own_rows(self, session: Session, dataset: int, days: Sequence[dt.date]) -> list[DayRow]:
        """Return this run's rows of some days, made where there are none yet."""
        mine = select(DayRow).where(DayRow.run_id == self.id, DayRow.dataset_id == dataset)
        found = session.scalars(mine.where(DayRow.day.between(min(days), max(days))))
        known = {row.day: row for row in found}
        rows = []
        for day in days:
            row = known.get(day)
            if row is None:
                columns = {"run_id": self.id, "dataset_id": dataset, "context": self.context}
                row = known[day] = DayRow(day=day, state=DAY_STATES[0], **columns)
                session.add(row)
            elif row.state == "published":
                raise CatalogError(
                    "this run has already published it", day=str(day), remedy="start another run"
                )
            rows.append(row)
        return rows

    def _staged_rows(
        self, session: Session, dataset: int, store: StoreRow, days: Sequence[SegmentRow]
    ) -> list[DayRow]:
        """Return this run's rows of the days of a store, numbered."""
        rows = self._own_rows(session, dataset, [as_date(written.day) for written in days])
        for row, written in zip(rows, days, strict=True):
            row.state, row.message = "verified", str(written.report.get("partial", ""))
            row.cause = "partial" if row.message else ""
            row.store_id, row.start, row.stop, row.key = store.id, written.start, written.stop, written.key
            row.first_tt2000, row.last_tt2000 = written.first_tt2000, written.last_tt2000
            row.count, row.step_ns, row.report = written.count, written.step_ns, dict(written.report)
            row.coverage = written.report.get("coverage")
        session.flush()
        return rows


def failure_cause(error: BaseException) -> str:
    """Return the catalog's cause of an exception: only failures that can pass are ``transient``."""
    if isinstance(error, InflightError):
        return error.cause
    # What is no `Exception` ended the work from outside: Ctrl-C, or Prefect when a run is cancelled.
    passing = isinstance(error, OSError | MemoryError) or not isinstance(error, Exception)
    return "transient" if passing else "bug"


def close_run(
    session: Session,
    run_id: str,
    state: str,
    cause: str,
    message: str,
    report: Mapping[str, Any] | None = None,
    elapsed: float | None = None,
) -> None:
    """End a run; with a failure, also the days it had begun.

    It ends `elapsed` seconds after it started where its process knows, whatever was done to the clock since.
    """
    row = session.get_one(RunRow, run_id)
    started = dt.datetime.fromisoformat(row.started)
    ended = max(present_time(), started) if elapsed is None else started + dt.timedelta(seconds=elapsed)
    row.state, row.cause, row.message = state, cause, message
    row.report = None if report is None else dict(report)
    row.ended = ended.isoformat(timespec="microseconds")
    session.flush()
    if state == "failed":
        session.execute(
            update(DayRow)
            .where(DayRow.run_id == run_id, DayRow.state.in_(("running", "staged")))
            .values(state="failed", cause=cause, message=message)
        )


def run_records(session: Session, kind: str | None, last: int | None = None) -> list[RunRecord]:
    """Return the records of all runs or of the `last`, oldest first."""
    query = select(RunRow).order_by(RunRow.started.desc(), RunRow.id.desc()).limit(last)
    if kind is not None:
        query = query.where(RunRow.kind == kind)
    return [row.as_record(RunRecord) for row in session.scalars(query)][::-1]


def days_of_run(session: Session, run_id: str) -> list[Day]:
    """Return the days of a run, whatever became of them, by dataset and day."""
    query = (
        select(DayRow, StoreRow.path, DatasetRow.name)
        .outerjoin(StoreRow, StoreRow.id == DayRow.store_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .where(DayRow.run_id == run_id)
        .order_by(DatasetRow.name, DayRow.day)
    )
    return [day_record(row, name, path) for row, path, name in session.execute(query)]


def run_counts(session: Session, ids: Sequence[str]) -> dict[str, dict[str, dict[str, int]]]:
    """Return how many days runs have by dataset and state: run -> dataset -> state -> count."""
    query = (
        select(DayRow.run_id, DatasetRow.name, DayRow.state, func.count())
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .where(DayRow.run_id.in_(ids))
        .group_by(DayRow.run_id, DatasetRow.name, DayRow.state)
        .order_by(DatasetRow.name)
    )
    found: dict[str, dict[str, dict[str, int]]] = {one: {} for one in ids}
    for run_id, name, state, count in session.execute(query):
        found[run_id].setdefault(name, {})[state] = count
    return found


@dataclass(frozen=True, kw_only=True)
class RunRate:
    """What a run cost: days of the dataset it made most of, seconds, and bytes of all its stores."""

    run: str
    days: int
    seconds: float
    bytes: int

    def cost(self, days: int) -> dict[str, float]:
        """Return the ``seconds`` and ``bytes`` of so many days at this rate; a start is in it."""
        return {
            "seconds": round(self.seconds * days / self.days, 1),
            "bytes": round(self.bytes * days / self.days),
        }


def measured_rate(session: Session, kind: str) -> RunRate | None:
    """Return the rate of the largest of the last runs of a kind that were done; None without one.

    Small runs tell little: of a day most is the start of the processes.
    """
    query = select(RunRow).where(RunRow.kind == kind, RunRow.state == "done").order_by(RunRow.started.desc())
    found = []
    for row in session.scalars(query.limit(_RUNS_OF_A_RATE)):
        counted = select(func.count()).where(DayRow.run_id == row.id, DayRow.state == "published")
        days = max(session.scalars(counted.group_by(DayRow.dataset_id)), default=0)
        if days and row.ended:
            spent = dt.datetime.fromisoformat(row.ended) - dt.datetime.fromisoformat(row.started)
            size = session.scalar(select(func.sum(StoreRow.bytes)).where(StoreRow.run_id == row.id))
            found.append(RunRate(run=row.id, days=days, seconds=spent.total_seconds(), bytes=int(size or 0)))
    return max(found, key=lambda one: one.days, default=None)


def run_report(session: Session, run_id: str) -> Mapping[str, Any] | None:
    """Return what a run said of itself when it was done; None when it said nothing."""
    return session.scalar(select(RunRow.report).where(RunRow.id == run_id))


def close_dead_runs(workspace: Path, database: Database) -> list[str]:
    """Close runs whose process is gone, clear what runs that failed left unfinished; return their ids.

    A worker of a run that was interrupted may have begun a store after the run had cleared its own.
    """
    of_runs = workspace / "stores"
    there = [folder.name for folder in of_runs.iterdir()] if of_runs.is_dir() else []
    left, gone = database.read(_failed_runs, there, database.backend)
    if gone:
        gone = database.write(_close_gone_runs, database.backend)
    for run_id in (*gone, *left):
        clear_unfinished(workspace, run_id)
    return gone


def _failed_runs(session: Session, there: Sequence[str], backend: Backend) -> tuple[list[str], list[str]]:
    """Return those of some runs that failed, and the runs whose process is gone."""
    failed = session.scalars(select(RunRow.id).where(RunRow.state == "failed"))
    return sorted(set(failed).intersection(there)), _gone_runs(session, backend)


def _gone_runs(session: Session, backend: Backend) -> list[str]:
    """Return the runs whose lease has ended, or whose process on this host has."""
    running = session.execute(
        select(RunRow.id, RunRow.host, RunRow.pid, RunRow.process, RunRow.lease < backend.clock).where(
            RunRow.state == "running"
        )
    )
    return [
        run_id
        for run_id, host, pid, process, is_over in running
        # Without a lease, a process of another host may be alive.
        if is_over or (is_over is None and host == socket.gethostname() and _process_start(pid) != process)
    ]


def _close_gone_runs(session: Session, backend: Backend) -> list[str]:
    # Asked again under the write lock: a run may have ended, or given a sign of life.
    gone = _gone_runs(session, backend)
    for run_id in gone:
        message = "its process ended before the run did; run again"
        close_run(session, run_id, "failed", "transient", message)
    return gone


def _require_running(session: Session, run_id: str) -> None:
    """Refuse to write for a run that was taken for dead and ended: others do its work by now."""
    state = session.scalar(select(RunRow.state).where(RunRow.id == run_id))
    if state != "running":
        raise StorageError(
            f"run {run_id} has ended: {'it gave no sign of life in time' if state else 'it never began'}",
            remedy="run again",
        )


class _Pulse:
    """Renews the lease of a run from a thread of its own, as long as the process lives."""

    def __init__(self, database: Database, run_id: str) -> None:
        self._database, self._run_id = database, run_id
        self._ended = threading.Event()

    def start(self) -> None:
        """Begin; the first renewal comes after a quarter of the lease."""
        threading.Thread(target=self._beat, name=f"pulse of {self._run_id}", daemon=True).start()

    def stop(self) -> None:
        """End, without waiting for a renewal that is under way."""
        self._ended.set()

    def _beat(self) -> None:
        while not self._ended.wait(self._database.backend.lease_s / 4):
            # A server that is gone may come back; a run that was taken for dead learns it when it writes.
            with suppress(CatalogError):
                self._database.write_beside(_renew, self._run_id, self._database.backend)


def _renew(session: Session, run_id: str, backend: Backend) -> None:
    mine = update(RunRow).where(RunRow.id == run_id, RunRow.state == "running")
    session.execute(mine.values(lease=_lease(backend)), execution_options={"synchronize_session": False})


def _lease(backend: Backend) -> Any:
    """Return the end of a lease that begins now, on the database's clock; None where there are none."""
    return backend.clock + backend.lease_s if backend.lease_s else None


def _dataset(session: Session, name: str) -> int:
    row = session.scalar(select(DatasetRow).where(DatasetRow.name == name))
    if row is None:
        row = DatasetRow(name=name)
        session.add(row)
        session.flush()
    return row.id


def baseline_of(session: Session) -> int:
    """Return the workspace's release baseline."""
    setting = session.get(SettingRow, BASELINE_SETTING)
    return int(setting.value) if setting else 1


def raise_baseline(session: Session, baseline: int) -> None:
    """Begin a new release baseline; see `Catalog.set_baseline`."""
    present = baseline_of(session)
    if baseline < present:
        raise CatalogError(f"baseline {baseline} is lower than the present {present}", remedy="raise it")
    session.merge(SettingRow(name=BASELINE_SETTING, value=str(baseline)))


def _move_pointers(session: Session, run_id: str, rows: Sequence[DayRow]) -> set[int]:
    """Give each row its version and make it the present one; return the ids of the published."""
    baseline = baseline_of(session)
    mine = select(DayRow.dataset_id, DayRow.day).where(DayRow.run_id == run_id)
    pointers = session.execute(
        select(CurrentRow, DayRow)
        .join(DayRow, DayRow.id == CurrentRow.day_id)
        .where(tuple_(CurrentRow.dataset_id, CurrentRow.day).in_(mine))
    )
    present = {(pointer.dataset_id, pointer.day): (pointer, old) for pointer, old in pointers}
    newest = session.execute(
        select(DayRow.dataset_id, DayRow.day, func.max(DayRow.revision))
        .where(DayRow.baseline == baseline, tuple_(DayRow.dataset_id, DayRow.day).in_(mine))
        .group_by(DayRow.dataset_id, DayRow.day)
    )
    revisions = {(dataset, day): revision or 0 for dataset, day, revision in newest}
    published = set()
    for row in rows:
        place = (row.dataset_id, row.day)
        pointer, old = present.get(place, (None, None))
        if old is not None and row.key and row.key == old.key and old.baseline == baseline:
            row.state, row.cause = "no_work", "no_work"
            row.message = f"already published as {version_text(old.baseline, old.revision or 0)}"
            continue
        row.state, row.baseline, row.revision = "published", baseline, revisions.get(place, -1) + 1
        published.add(row.id)
        if pointer is None:
            session.add(CurrentRow(dataset_id=row.dataset_id, day=row.day, day_id=row.id))
        else:
            pointer.day_id = row.id
    return published


def _process_start(pid: int) -> str:
    """Return when a process began, in the system's own unit; empty when there is none.

    With the host it names one process for good: a pid alone is given out again.
    """
    if not Path("/proc/self/stat").exists():
        line = ["ps", "-o", "lstart=", "-p", str(pid)]
        return subprocess.run(line, capture_output=True, text=True, check=False).stdout.strip()
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", errors="replace")
        boot_id = Path("/proc/sys/kernel/random/boot_id")
        boot = boot_id.read_text("utf-8").strip() if boot_id.exists() else ""
    except OSError:
        return ""
    fields = stat.rpartition(")")[2].split()
    # A killed process stays as a zombie until its parent asks for it.
    return "" if fields[0] in "ZX" else f"{boot}:{fields[19]}"
