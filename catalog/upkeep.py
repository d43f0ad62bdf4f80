"""Upkeep of a workspace: whether it is whole, and the way back from damage.

`find_faults` compares every store with its manifest, `repair` takes damaged stores out of use.

Repair: a published key means that there is no work. So the days of a damaged store lose their pointer, and
its tables their validity; the next ingest and reprocess make them again. What was delivered and what is
whole is not touched.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.manifest import manifest_faults
from inflight.catalog.provenance import unknown_ids
from inflight.catalog.records import DAMAGED, is_gone
from inflight.catalog.runs import Run
from inflight.catalog.schema import (
    CurrentRow,
    DatasetRow,
    DayRow,
    EdgeRow,
    StoreRow,
    TableRow,
)
from inflight.catalog.validity import Authority, withdraw_tables
from inflight.progress import Progress, tell_each


def find_faults(
    session: Session, workspace: Path, name: str | None, progress: Progress
) -> list[dict[str, str]]:
    """Hash every store that is in use against its manifest; see `Catalog.verify`."""
    faults = [
        {"item": item, "fault": fault, "path": f"{store.path}/{file}"}
        for store, item, found in damaged_stores(session, workspace, name, progress)
        for file, fault in found
    ]
    if name is None:
        # Of published days only: a run that died had not recorded the files of others yet.
        others = select(DayRow.id).where(DayRow.state != "published")
        unpublished = {f"day:{id}" for id in session.scalars(others)}
        edges = session.execute(select(EdgeRow.parent, EdgeRow.child)).all()
        named = (end for edge in edges if edge.child not in unpublished for end in edge)
        unknown = unknown_ids(session, named)
        faults += [
            {"item": item, "fault": "lineage names what is not in the catalog", "path": ""}
            for item in unknown
        ]
    return faults


def damaged_stores(
    session: Session, workspace: Path, name: str | None, progress: Progress
) -> Iterator[tuple[StoreRow, str, list[tuple[str, str]]]]:
    """Yield the stores in use that are not as they were written: store, dataset or table, (file, fault)."""
    of_days = (
        select(StoreRow, DatasetRow.name)
        .join(DayRow, DayRow.store_id == StoreRow.id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .where(DayRow.state == "published")
        .order_by(StoreRow.id)
    )
    of_tables = select(StoreRow, TableRow.name).join(TableRow, TableRow.store_id == StoreRow.id)
    in_use = {store.path: (store, dataset) for store, dataset in session.execute(of_days)}
    in_use |= {store.path: (store, f"tables/{table}") for store, table in session.execute(of_tables)}
    asked = [
        (store, item) for store, item in in_use.values() if name in {None, item} and not is_gone(store.notes)
    ]
    for store, item in tell_each(progress, "verify", asked):
        if found := manifest_faults(workspace / store.path, store.sha256):
            yield store, item, found


@dataclass(frozen=True)
class Repair:
    """One damaged store: its dataset or table (`item`), the damaged files, and what is to be made again.

    Attributes
    ----------
    days : tuple of str
        UTC days whose present revision lies in the store; empty when later revisions replaced all.
    tables : tuple of int
        Ids of calibration tables.
    """

    item: str
    path: str
    files: tuple[str, ...]
    days: tuple[str, ...]
    tables: tuple[int, ...]


def repair(workspace: Path, database: Database, *, dry_run: bool, progress: Progress) -> list[Repair]:
    """Withdraw what lies in damaged stores; see `Catalog.repair`."""
    found = database.read(_damage, workspace, progress)
    if dry_run or not found:
        return found
    settings = {"repaired": [asdict(store) for store in found]}
    with Run(workspace, database, "repair", settings, None) as run:
        return database.write(_withdraw, run.id, found)


def _damage(session: Session, workspace: Path, progress: Progress) -> list[Repair]:
    return [
        _contents(session, store.path, item, tuple(file for file, _ in faults))
        for store, item, faults in damaged_stores(session, workspace, None, progress)
    ]


def _contents(session: Session, path: str, item: str, files: tuple[str, ...]) -> Repair:
    days = session.scalars(
        select(DayRow.day)
        .join(CurrentRow, CurrentRow.day_id == DayRow.id)
        .join(StoreRow, StoreRow.id == DayRow.store_id)
        .where(StoreRow.path == path)
        .order_by(DayRow.day)
    )
    tables = session.scalars(
        select(TableRow.id).join(StoreRow, StoreRow.id == TableRow.store_id).where(StoreRow.path == path)
    )
    return Repair(item, path, files, tuple(map(str, days)), tuple(tables))


def _withdraw(session: Session, run_id: str, damaged: Sequence[Repair]) -> list[Repair]:
    """Take the pointers and validities of damaged stores away; return what was in them by now."""
    # Asked again under the write lock: a run may have published meanwhile.
    found = [_contents(session, damage.path, damage.item, damage.files) for damage in damaged]
    for damage in found:
        _withdraw_store(session, run_id, damage)
    return found


def _withdraw_store(session: Session, run_id: str, damage: Repair) -> None:
    """Take the pointers and validities of one store away and record why; rows and files stay."""
    store = session.scalars(select(StoreRow).where(StoreRow.path == damage.path)).one()
    store.notes = [*store.notes, DAMAGED + ", ".join(damage.files)]
    message = f"its store is damaged: {damage.path}/{damage.files[0]}"
    rows = session.scalars(
        select(DayRow).join(CurrentRow, CurrentRow.day_id == DayRow.id).where(DayRow.store_id == store.id)
    ).all()
    for row in rows:
        failed = DayRow(run_id=run_id, dataset_id=row.dataset_id, day=row.day, context=row.context)
        failed.state, failed.cause, failed.message = "failed", "transient", message
        session.add(failed)
    session.execute(delete(CurrentRow).where(CurrentRow.day_id.in_([row.id for row in rows])))
    withdraw_tables(session, damage.tables, Authority(reason=message, run=run_id))
