"""The way back from damage: what a damaged store held is made again by the next ingest and reprocess.

A published key means that there is no work. So the days of a damaged store lose their
pointer, and its tables their validity; what was delivered and what is whole is not touched.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.records import DAMAGED
from inflight.catalog.runs import Run
from inflight.catalog.schema import CertificationRow, CurrentRow, DayRow, StoreRow, TableRow
from inflight.catalog.upkeep import damaged_stores


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


def repair(workspace: Path, database: Database, *, dry_run: bool) -> list[Repair]:
    """Withdraw what lies in damaged stores; see `Catalog.repair`."""
    with database.read() as session:
        damaged = [
            (store.path, item, tuple(file for file, _ in faults))
            for store, item, faults in damaged_stores(workspace, session, None)
        ]
        found = [_extent(session, *store) for store in damaged]
    if dry_run or not found:
        return found
    settings = {"repaired": [asdict(store) for store in found]}
    with Run(workspace, database, "repair", settings, None) as run, database.write() as session:
        # Asked again under the write lock: a run may have published meanwhile.
        found = [_extent(session, *store) for store in damaged]
        for store in found:
            _withdraw(session, run.id, store)
    return found


def _extent(session: Session, path: str, item: str, files: tuple[str, ...]) -> Repair:
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


def _withdraw(session: Session, run_id: str, damage: Repair) -> None:
    """Take the pointers and validities of one store away and record why; rows and files stay."""
    store = session.scalars(select(StoreRow).where(StoreRow.path == damage.path)).one()
    store.notes = [*store.notes, DAMAGED + ", ".join(damage.files)]
    message = f"its store is damaged: {damage.path}/{damage.files[0]}"
    rows = session.scalars(
        select(DayRow).join(CurrentRow, CurrentRow.day_id == DayRow.id).where(DayRow.store_id == store.id)
    ).all()
    for row in rows:
        lost = DayRow(run_id=run_id, dataset_id=row.dataset_id, day=row.day, context=row.context)
        lost.state, lost.cause, lost.message = "failed", "transient", message
        session.add(lost)
    session.execute(delete(CurrentRow).where(CurrentRow.day_id.in_([row.id for row in rows])))
    session.execute(delete(CertificationRow).where(CertificationRow.table_id.in_(damage.tables)))
