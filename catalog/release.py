"""Releases: a collection frozen in the catalog and copied out whole, readable by any Zarr v3 reader.

`freeze_release` collects days, tables and context, refuses what lacks provenance or a cause, writes the copy
with its manifest, and registers the release in one transaction that ends with the rename of its folder.
"""

from __future__ import annotations

import csv
import datetime as dt
import json
import re
import shutil
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import groupby
from pathlib import Path
from typing import Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.days import published_days, status_of_days
from inflight.catalog.faultpoints import fault_point
from inflight.catalog.manifest import flush, flush_files, write_manifest
from inflight.catalog.opening import read_one_day
from inflight.catalog.provenance import Edge, context_record, model_text, unknown_ids, walk
from inflight.catalog.records import ContextRecord, Day, DayData, TableRecord
from inflight.catalog.schema import DatasetRow, ReleaseDayRow, ReleaseRow
from inflight.catalog.segments import write_segment, write_table
from inflight.catalog.spans import Span
from inflight.catalog.stores import open_store
from inflight.catalog.upkeep import missing_days
from inflight.catalog.validity import table_records
from inflight.errors import CatalogError, IntegrityError, StorageError
from inflight.time import to_utc

#: Days of one released store: bounds the memory a release needs.
DAYS_PER_STORE: Final = 10
_MARKER: Final = "release.json"
_WHOLE: Final = Span(None, None)


@dataclass(frozen=True, kw_only=True)
class _Collection:
    """What goes into a release: the days, the days that are not there, the tables and the context."""

    version: str
    notes: str
    days: tuple[Day, ...]
    absent: tuple[Day, ...]
    tables: tuple[TableRecord, ...]
    context: ContextRecord | None
    model: str


def freeze_release(
    workspace: Path,
    database: Database,
    version: str,
    context: str | None,
    datasets: Sequence[str],
    notes: str,
    destination: Path,
) -> Path:
    """Freeze the published days of some datasets and copy them out; see `Catalog.release`."""
    require_releasable(database, version, datasets)
    with database.read() as session:
        collection = _collect(session, version, context, datasets, notes)
        _refuse_without_provenance(session, collection.days)
    if unexplained := [day for day in collection.absent if not day.cause]:
        listed = ", ".join(f"{day.dataset} {day.day} ({day.state})" for day in unexplained[:5])
        raise CatalogError(
            f"{len(unexplained)} missing days have no recorded cause, among them {listed}",
            remedy="process them again, or record why they are missing",
        )
    staged = destination / f".{version}-{uuid.uuid4().hex[:8]}"
    try:
        destination.mkdir(parents=True, exist_ok=True)
        _write_release(workspace, staged, collection)
        fault_point("release_written")
        return _register(database, collection, context, staged, destination / version)
    except OSError as error:
        if isinstance(error, CatalogError):
            raise
        raise StorageError(
            f"release could not be written: {error}", remedy="free space and run again"
        ) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def require_releasable(database: Database, version: str, datasets: Sequence[str]) -> None:
    """Raise CatalogError for what cannot be released: no version, one used before, or nothing to copy."""
    if not re.fullmatch(r"[0-9A-Za-z][0-9A-Za-z.-]*", version):
        raise CatalogError(
            f"{version!r} is no release version", remedy="use digits, letters, '.' and '-', as in '1.0'"
        )
    with database.read() as session:
        _refuse_known_version(session, version)
        _collect(session, version, None, datasets, "")


def _refuse_known_version(session: Session, version: str) -> None:
    if session.scalar(select(ReleaseRow.id).where(ReleaseRow.version == version)) is not None:
        raise CatalogError(
            f"release {version} exists", remedy="a version is never reused: choose the next one"
        )


def _collect(
    session: Session, version: str, context: str | None, patterns: Sequence[str], notes: str
) -> _Collection:
    names = [
        name
        for name in session.scalars(select(DatasetRow.name).order_by(DatasetRow.name))
        if any(fnmatchcase(name, pattern) for pattern in patterns)
    ]
    days: list[Day] = []
    absent: list[Day] = []
    for name in names:
        present = published_days(session, name, _WHOLE, None)
        if context is not None and any(day.context is not None for day in present):
            present = published_days(session, name, _WHOLE, context)
        days += present
        there = {day.day for day in present}
        recorded = [day for day in status_of_days(session, name, _WHOLE, None) if day.day not in there]
        known = {day.day for day in recorded}
        gaps = [
            Day(dataset=name, day=day, state="missing") for day in missing_days(present) if day not in known
        ]
        absent += sorted(recorded + gaps, key=lambda day: day.day)
    if not days:
        raise CatalogError(
            f"nothing is published that matches {' or '.join(patterns)}",
            remedy="first 'inflight ingest' and 'inflight reprocess'; see 'inflight catalog list'",
        )
    pinned = context_record(session, context) if context else None
    pinned_ids = set(pinned.tables.values()) if pinned else set()
    tables = [
        table
        for table in table_records(session, None)
        if table.id in pinned_ids or any(scope in {None, context} for scope, _, _ in table.certified)
    ]
    model = model_text(session, pinned.model_name, pinned.model_version)[2] if pinned else ""
    return _Collection(
        version=version,
        notes=notes,
        days=tuple(days),
        absent=tuple(absent),
        tables=tuple(tables),
        context=pinned,
        model=model,
    )


def _refuse_without_provenance(session: Session, days: Sequence[Day]) -> None:
    """Every day, and every day it was made from, states what it was made from, and that is known."""
    ids = [day.id for day in days]
    edges: list[Edge] = walk(session, ids, up=True)
    with_parents = {edge.child for edge in edges}
    named = {*ids, *(edge.parent for edge in edges)}
    orphans = sorted(item for item in named if item.startswith("day:") and item not in with_parents)
    unknown = unknown_ids(session, named)
    if orphans or unknown:
        by_id = {day.id: f"{day.dataset} {day.day}" for day in days}
        listed = ", ".join(by_id.get(item, item) for item in [*orphans, *unknown][:5])
        raise CatalogError(
            f"{len(orphans) + len(unknown)} items lack provenance, among them {listed}",
            remedy="make these days again by a run that states their parents",
        )


def _write_release(workspace: Path, folder: Path, collection: _Collection) -> None:
    # Days of one segment can share a released store: their variables and units are equal.
    for _, group in groupby(collection.days, key=lambda day: (day.dataset, day.segment)):
        members = list(group)
        for first in range(0, len(members), DAYS_PER_STORE):
            _copy_days(workspace, folder, members[first : first + DAYS_PER_STORE])
    for table in collection.tables:
        store = open_store(str(workspace / table.segment))
        dataset = store.dataset_of_day(0, list(store.variables), 0, 0)
        write_table(folder, "tables", f"{table.name}-{table.id}", dataset, portable=True)
    if (folder / "stores").exists():
        for part in (folder / "stores").iterdir():
            part.rename(folder / part.name)
        (folder / "stores").rmdir()
    shutil.rmtree(folder / "staging", ignore_errors=True)
    ordered = sorted((*collection.days, *collection.absent), key=lambda day: (day.dataset, day.day))
    _write_csv(
        folder / "days.csv",
        ("dataset", "day", "version", "coverage", "samples", "state", "cause", "message", "key"),
        (
            (
                *(day.dataset, day.day, day.version, "" if day.coverage is None else f"{day.coverage:.6f}"),
                *(day.count, day.state, day.cause, day.message, day.key),
            )
            for day in ordered
        ),
    )
    _write_csv(
        folder / "tables.csv",
        ("table", "name", "context", "valid_from", "valid_to", "valid_from_tt2000", "valid_to_tt2000"),
        (
            (table.id, table.name, context or "", to_utc(start), to_utc(end), start, end)
            for table in collection.tables
            for context, start, end in table.certified or ((table.context, table.start, table.end),)
        ),
    )
    if collection.context:
        (folder / "mission.yaml").write_text(collection.context.mission_text, "utf-8")
        (folder / "model.yaml").write_text(collection.model, "utf-8")
    (folder / "README.md").write_text(_readme(collection), "utf-8")
    notes = [f"# Release notes, {collection.version}", "", collection.notes.strip() or "No notes were given."]
    if collection.absent:
        notes += ["", f"{len(collection.absent)} days are missing; `days.csv` gives the cause of each."]
    (folder / "RELEASE_NOTES.md").write_text("\n".join(notes) + "\n", "utf-8")
    (folder / _MARKER).write_text(json.dumps({"version": collection.version}) + "\n", "utf-8")
    write_manifest(folder)
    flush_files(folder)


def _copy_days(workspace: Path, folder: Path, batch: Sequence[Day]) -> None:
    """Write days again without the delta filter, and compare every value with the original."""
    contents = [
        read_one_day(workspace, day, None)
        .drop_vars("time", errors="ignore")
        .assign_attrs(version=day.version)
        for day in batch
    ]
    data = [
        DayData(day.day, dataset, day.key, report=day.report)
        for day, dataset in zip(batch, contents, strict=True)
    ]
    segment = write_segment(folder, "data", batch[0].dataset, data, portable=True)
    store = open_store(str(folder / segment.path))
    for index, (row, dataset) in enumerate(zip(segment.rows, contents, strict=True)):
        copied = store.dataset_of_day(index, list(store.variables), row.start, row.stop)
        if not copied.identical(dataset):
            raise IntegrityError(
                f"released copy of {batch[0].dataset} differs from the original",
                day=str(row.day),
                remedy="run 'inflight catalog verify'",
            )


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


def _readme(collection: _Collection) -> str:
    lines = [
        f"# Release {collection.version}",
        "",
        "`data/` holds one Zarr v3 store for up to ten days of one dataset: row `i` of day `k` is row",
        "`k * chunk + i` of every variable with a time; `chunk`, `days` and `counts` stand in the",
        "attribute `inflight` of the store. Packed variables follow the CF convention (`scale_factor`,",
        "`_FillValue`). `tt2000` counts nanoseconds since 2000-01-01T12:00:00 Terrestrial Time; rows",
        "beyond a day's count are fill.",
        "`tables/` holds the calibration tables; `tables.csv` says when each is valid (half-open).",
        "`days.csv` lists every day with version, coverage and, where it is missing, why.",
        "Check the files with `sha256sum -c MANIFEST.sha256`.",
        "",
        "| dataset | first day | last day | days | missing |",
        "|---|---|---|---|---|",
    ]
    for name, group in groupby(collection.days, key=lambda day: day.dataset):
        days = list(group)
        missing = sum(day.dataset == name for day in collection.absent)
        lines.append(f"| {name} | {days[0].day} | {days[-1].day} | {len(days)} | {missing} |")
    if collection.context:
        context = collection.context
        lines += [
            "",
            f"Model: {context.model_name} version {context.model_version} (`model.yaml`), "
            f"context `{context.id}`.",
        ]
    return "\n".join(lines) + "\n"


def _register(
    database: Database, collection: _Collection, context: str | None, staged: Path, target: Path
) -> Path:
    """Freeze the collection and rename its folder in one transaction, which ends with the rename."""
    created = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    with database.write() as session:
        _refuse_known_version(session, collection.version)
        row = ReleaseRow(
            version=collection.version,
            context=context,
            notes=collection.notes,
            path=str(target),
            created=created,
        )
        session.add(row)
        session.flush()
        days = (int(day.id.partition(":")[2]) for day in collection.days)
        session.add_all(ReleaseDayRow(release_id=row.id, day_id=day) for day in days)
        session.flush()
        if target.exists():
            # Left by a release that was killed between its rename and its commit; nothing else is removed.
            marker = target / _MARKER
            stated = json.loads(marker.read_text("utf-8")) if marker.exists() else {}
            if stated.get("version") != collection.version:
                raise CatalogError(
                    "the folder exists and is no release", file=str(target), remedy="move it away"
                )
            shutil.rmtree(target)
        staged.rename(target)
        flush(target.parent)
        fault_point("release_renamed")
    return target
