"""Upkeep of a workspace: what it holds, whether it is whole, which stores are no longer needed."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.days import status_of_days
from inflight.catalog.lineage import unknown_ids
from inflight.catalog.manifest import manifest_faults
from inflight.catalog.records import Day, is_damaged
from inflight.catalog.schema import CurrentRow, DatasetRow, DayRow, EdgeRow, RunRow, StoreRow, TableRow
from inflight.catalog.spans import Span


def dataset_summary(session: Session, span: Span) -> list[dict[str, Any]]:
    """Describe each dataset; see `Catalog.inventory`."""
    names = session.scalars(select(DatasetRow.name).order_by(DatasetRow.name)).all()
    return [_summary(name, status_of_days(session, name, span, None)) for name in names]


def find_faults(workspace: Path, session: Session, name: str | None) -> list[dict[str, str]]:
    """Hash every store that is in use against its manifest; see `Catalog.verify`."""
    faults = [
        {"item": item, "fault": fault, "path": f"{store.path}/{file}"}
        for store, item, found in damaged_stores(workspace, session, name)
        for file, fault in found
    ]
    if name is None:
        unknown = unknown_ids(session, (end for edge in _edges_in_use(session) for end in edge))
        faults += [
            {"item": item, "fault": "lineage names what is not in the catalog", "path": ""}
            for item in unknown
        ]
    return faults


def damaged_stores(
    workspace: Path, session: Session, name: str | None
) -> Iterator[tuple[StoreRow, str, list[tuple[str, str]]]]:
    """Yield the stores in use that are not as they were written: store, dataset or table, (file, fault)."""
    for store, item in _stores_in_use(session, name):
        if found := manifest_faults(workspace / store.path, store.sha256):
            yield store, item, found


def _edges_in_use(session: Session) -> list[tuple[str, str]]:
    """Return the lineage of published days: a run that died had not recorded the files of others yet."""
    unseen = {f"day:{id}" for id in session.scalars(select(DayRow.id).where(DayRow.state != "published"))}
    edges = session.execute(select(EdgeRow.parent, EdgeRow.child)).all()
    return [(parent, child) for parent, child in edges if child not in unseen]


def collect_garbage(workspace: Path, database: Database, *, dry_run: bool) -> list[str]:
    """Remove stores and staging folders that nothing refers to; see `Catalog.gc`."""
    # Folders are listed before the database is asked: what appears later belongs to a run that is alive.
    present = sorted((workspace / "stores").glob("*/*.zarr")) + sorted((workspace / "staging").iterdir())
    with database.read() as session:
        alive = set(session.scalars(select(RunRow.id).where(RunRow.state == "running")))
        needed = _needed_stores(session)
    garbage = []
    for folder in present:
        path = folder.relative_to(workspace).as_posix()
        run_id = path.split("/")[1]
        if run_id not in alive and path not in needed:
            garbage.append(path)
    if not dry_run:
        _remove(workspace, database, garbage)
    return garbage


def _remove(workspace: Path, database: Database, garbage: list[str]) -> None:
    with database.write() as session:
        # Asked again under the write lock: a run may have adopted a store meanwhile.
        needed = _needed_stores(session)
        garbage = [path for path in garbage if path not in needed]
        stores = session.scalars(select(StoreRow).where(StoreRow.path.in_(garbage))).all()
        ids = [store.id for store in stores]
        session.execute(
            update(DayRow)
            .where(DayRow.store_id.in_(ids))
            .values(store_id=None, state="failed", cause="no_work")
        )
        for store in stores:
            session.delete(store)
    for path in garbage:
        shutil.rmtree(workspace / path, ignore_errors=True)
        if not any((workspace / path).parent.iterdir()) and path.startswith("stores/"):
            (workspace / path).parent.rmdir()


def _needed_stores(session: Session) -> set[str]:
    """Return the paths of stores of published days, of tables and of days that may still be adopted."""
    published = (
        select(StoreRow.path).join(DayRow, DayRow.store_id == StoreRow.id).where(DayRow.state == "published")
    )
    tables = select(StoreRow.path).join(TableRow, TableRow.store_id == StoreRow.id)
    newer = (
        select(CurrentRow.day_id)
        .where(
            CurrentRow.dataset_id == DayRow.dataset_id,
            CurrentRow.day == DayRow.day,
            CurrentRow.day_id > DayRow.id,
        )
        .exists()
    )
    adoptable = (
        select(StoreRow.path)
        .join(DayRow, DayRow.store_id == StoreRow.id)
        .where(DayRow.state == "verified", ~newer)
    )
    return {path for query in (published, tables, adoptable) for path in session.scalars(query)}


def _stores_in_use(session: Session, name: str | None) -> list[tuple[StoreRow, str]]:
    of_days = (
        select(StoreRow, DatasetRow.name)
        .join(DayRow, DayRow.store_id == StoreRow.id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .where(DayRow.state == "published")
        .order_by(StoreRow.id)
    )
    of_tables = select(StoreRow, TableRow.name).join(TableRow, TableRow.store_id == StoreRow.id)
    found = {store.path: (store, dataset) for store, dataset in session.execute(of_days)}
    found |= {store.path: (store, f"tables/{table}") for store, table in session.execute(of_tables)}
    return [
        (store, item)
        for store, item in found.values()
        if name in {None, item} and not is_damaged(store.notes)
    ]


def _summary(name: str, days: list[Day]) -> dict[str, Any]:
    states = Counter(day.state for day in days)
    published = [day for day in days if day.state == "published"]
    known = [day.coverage for day in published if day.coverage is not None]
    return {
        "dataset": name,
        "first": str(published[0].day) if published else "",
        "last": str(published[-1].day) if published else "",
        "days": states["published"],
        "failed": states["failed"],
        "no_work": states["no_work"],
        "gaps": [str(day) for day in missing_days(published)],
        "versions": dict(sorted(Counter(day.version for day in published).items())),
        "coverage": float(np.mean(known)) if known else None,
        "samples": sum(day.count for day in published),
    }


def missing_days(published: list[Day]) -> list[np.datetime64]:
    """Return the days between the first and the last published one that are not published."""
    if not published:
        return []
    there = {day.day for day in published}
    return [day for day in np.arange(published[0].day, published[-1].day) if day not in there]
