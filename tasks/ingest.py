"""Ingest: delivered files become level-1 days ``l1/<instrument>`` of the archive.

A day is made from every file that holds rows of it and gets a key from their hashes and from what the
mission YAML says: same key, nothing to do. So a file delivered twice changes nothing, a corrected one
makes new revisions of exactly its days, and an ingest that was killed goes on where it was.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from inflight.catalog import Catalog, Day, FileRecord, Run, idempotency_key
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.tasks.delivery import (
    INGEST_VERSION,
    Delivery,
    Problem,
    each_result,
    file_report,
    survey,
    within,
)
from inflight.tasks.ingest_batch import BatchJob, days_of_batch, make_batch, source_file
from inflight.tasks.report import Progress, RunReport
from inflight.time import day_range, parse_utc, to_tt2000


@dataclass
class _Plan:
    """What one instrument's days need."""

    delivery: Delivery
    keys: dict[str, str] = field(default_factory=dict)
    todo: list[str] = field(default_factory=list)
    adopt: list[str] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    #: Failures that are on record with the same key, and new ones.
    failed: dict[str, Problem] = field(default_factory=dict)
    fresh_failures: dict[str, Problem] = field(default_factory=dict)
    #: Days between the first and the last that no file holds; those not on record yet.
    empty: list[str] = field(default_factory=list)
    fresh_empty: list[str] = field(default_factory=list)
    told: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def dataset(self) -> str:
        return f"l1/{self.delivery.instrument}"

    @property
    def has_work(self) -> bool:
        fresh = any(not file.known for file in self.delivery.files)
        return bool(fresh or self.todo or self.adopt or self.fresh_failures or self.fresh_empty)


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
        Told (stage, done, total).
    batch_days : int, optional
        Days of one segment; chosen from the cadence when absent.

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
    names, folder = _instruments(mission, instruments), Path(data).resolve()
    span = (_bound(start), _bound(end))
    tell = progress or (lambda stage, done, total: None)
    plans = []
    for count, name in enumerate(names):
        tell("index", count, len(names))
        plans.append(_plan(cat, survey(cat, mission, name, folder, span=span, client=client), span))
    tell("index", len(names), len(names))
    if not any(plan.has_work for plan in plans):
        return _report("", plans, [])
    settings = {"mission": mission.mission, "mission_sha": mission.sha, "instruments": names}
    with cat.run("ingest", settings | {"start": str(start or ""), "end": str(end or "")}) as run:
        jobs = [job for plan in plans for job in _jobs(cat, mission, run, folder, plan, batch_days)]
        _make_days(run, {plan.delivery.instrument: plan for plan in plans}, jobs, client, tell)
        for plan in plans:
            _record(cat, run, plan)
        published = run.publish()
    return _report(run.id, plans, published)


def _instruments(mission: Mission, named: Sequence[str] | None) -> list[str]:
    """Return the instruments to take in: those named, or all."""
    names = list(named) if named is not None else list(mission.instruments)
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
    plan = _Plan(delivery)
    published = {str(day.day): day for day in cat.days(plan.dataset, states=["published"])}
    failed = {str(day.day): day for day in cat.days(plan.dataset, states=["failed"])}
    verified = {(str(day.day), day.key) for day in cat.days(plan.dataset, states=["verified"])}
    by_day = delivery.by_day()
    for day in within(by_day, span):
        files = by_day[day]
        hashes = sorted(file.sha256 for file in files)
        key = idempotency_key(plan.dataset, day, INGEST_VERSION, delivery.key, hashes)
        plan.keys[day] = key
        broken = next((file.problem for file in files if file.problem), None)
        if day in published and published[day].key == key:
            plan.unchanged.append(day)
        elif day in failed and failed[day].key == key and failed[day].cause == "repeatable":
            plan.failed[day] = dict(failed[day].report.get("problem", {"message": failed[day].message}))
        elif broken is not None:
            plan.fresh_failures[day] = broken | {"day": day}
        elif (day, key) in verified:
            plan.adopt.append(day)
        else:
            plan.todo.append(day)
    _plan_empty(cat, plan, {*published, *failed})
    return plan


def _plan_empty(cat: Catalog, plan: _Plan, known: set[str]) -> None:
    """List the days between the first and the last one that no file holds, so that each gap has its cause."""
    if not plan.keys:
        return
    first, last = min(plan.keys), max(plan.keys)
    told = {str(day.day) for day in cat.days(plan.dataset, states=["no_work"])}
    held = set(plan.delivery.by_day()) | known
    plan.empty = [str(day) for day in day_range(first, last) if str(day) not in held]
    plan.fresh_empty = [day for day in plan.empty if day not in told]


def _jobs(
    cat: Catalog, mission: Mission, run: Run, data: Path, plan: _Plan, batch_days: int | None
) -> list[BatchJob]:
    for day in plan.adopt:
        if run.adopt(plan.dataset, day, plan.keys[day]) is None:
            plan.todo.append(day)
    name = plan.delivery.instrument
    files, instrument = mission.files(name), mission.instruments[name]
    size = batch_days or days_of_batch(instrument)
    by_day, todo = plan.delivery.by_day(), sorted(plan.todo)
    jobs = []
    for begin in range(0, len(todo), size):
        days = todo[begin : begin + size]
        wanted = {file.name: file for day in days for file in by_day[day]}
        jobs.append(
            BatchJob(
                cat.workspace,
                run.id,
                name,
                instrument,
                files,
                tuple(source_file(file, data) for file in wanted.values()),
                tuple(
                    (
                        day,
                        plan.keys[day],
                        tuple(file.name for file in by_day[day]),
                        tuple(file.sha256 for file in by_day[day]),
                    )
                    for day in days
                ),
            )
        )
    return jobs


def _make_days(
    run: Run, plans: dict[str, _Plan], jobs: Sequence[BatchJob], client: Any, tell: Progress
) -> None:
    results = each_result(client, make_batch, [(job,) for job in jobs])
    for count, (job, result) in enumerate(zip(jobs, results, strict=True), start=1):
        plan = plans[job.instrument_name]
        if result.segment is not None:
            run.attach(result.segment)
        plan.fresh_failures |= result.failures
        plan.told |= result.told
        tell("ingest", count, len(jobs))


def _record(cat: Catalog, run: Run, plan: _Plan) -> None:
    """Record failures, empty days and files; files count as taken in when the run publishes."""
    for day, problem in plan.fresh_failures.items():
        run.record(
            plan.dataset,
            day,
            "failed",
            problem.get("cause") or "repeatable",
            problem.get("message", ""),
            {"problem": problem},
            plan.keys[day],
        )
    run.record_no_work(
        plan.dataset, dict.fromkeys(plan.fresh_empty, "no delivered file holds rows of this day")
    )
    cat.record_files(
        run,
        [
            FileRecord(
                plan.delivery.instrument,
                file.name,
                file.sha256,
                file.size,
                file.mtime_ns,
                tuple(map(str, file.days)),
                file_report(file, plan.delivery.key, plan.told.get(file.name, {})),
                run.id,
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
        days_told = plan.failed | plan.fresh_failures
        problems += [
            {"instrument": name, **problem, "day": day} for day, problem in sorted(days_told.items())
        ]
        problems += [
            {"instrument": name, **file.problem}
            for file in plan.delivery.files
            if file.problem and not file.days
        ]
    counts = {
        "planned": sum(len(plan.keys) for plan in plans),
        "done": len(published),
        "unchanged": sum(len(plan.unchanged) for plan in plans),
        "failed": sum(len(plan.failed) + len(plan.fresh_failures) for plan in plans),
        "no_work": sum(len(plan.empty) for plan in plans),
    }
    extra = {
        "datasets": {plan.dataset: _told_of(plan, done[plan.dataset]) for plan in plans},
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


def _told_of(plan: _Plan, done: Sequence[Day]) -> dict[str, Any]:
    dropped: Counter[str] = Counter()
    for told in plan.told.values():
        dropped.update(told["dropped"])
    return {
        "days": len(plan.keys),
        "done": len(done),
        "mean_coverage": round(float(np.mean([day.coverage for day in done])), 6) if done else None,
        "first": min(plan.keys, default=""),
        "last": max(plan.keys, default=""),
        "dropped": dict(dropped),
        "notes": sorted({note for told in plan.told.values() for note in told["notes"]})[:20],
    }
