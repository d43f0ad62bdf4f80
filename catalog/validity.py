"""Calibration tables and when they hold: half-open validities that never overlap.

`certify_table` gives a table a validity, `valid_table` finds the one that holds at an instant.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from inflight.catalog.records import TableRecord, is_damaged
from inflight.catalog.schema import ApprovalRow, CertificationRow, ContextRow, StoreRow, TableRow
from inflight.errors import CatalogError, ValidityError
from inflight.time import to_utc

#: (table id, start, end, context), TT2000 half-open.
Certification = tuple[int, int, int, str | None]


def certify_table(session: Session, certification: Certification, *, supersede: bool) -> None:
    """Give a table a validity; see `Catalog.certify`."""
    table_id, start, end, context = certification
    table = session.get(TableRow, table_id)
    if table is None:
        raise CatalogError(f"table {table_id} is not in the catalog", remedy="see Catalog.tables")
    if end <= start:
        raise ValidityError(f"validity of table {table_id} ends at {end}, not after its start {start}")
    scope = context or ""
    overlapping = session.scalars(
        select(CertificationRow).where(
            CertificationRow.name == table.name,
            CertificationRow.context == scope,
            CertificationRow.start < end,
            CertificationRow.end > start,
        )
    ).all()
    for older in overlapping:
        if not supersede:
            raise ValidityError(
                f"table {table_id} of '{table.name}', valid {_span(start, end)}, overlaps "
                f"table {older.table_id}, valid {_span(older.start, older.end)}",
                remedy="choose a span that is free, or supersede the older table",
            )
        # What remains of the older validity before and behind the new one stays valid.
        remaining = [span for span in ((older.start, start), (end, older.end)) if span[0] < span[1]]
        if remaining:
            older.start, older.end = remaining[0]
        else:
            session.delete(older)
        session.flush()
        for first, last in remaining[1:]:
            again = CertificationRow(name=table.name, context=scope, start=first, end=last)
            again.table_id = older.table_id
            session.add(again)
    session.flush()
    session.add(CertificationRow(table_id=table_id, name=table.name, context=scope, start=start, end=end))
    session.flush()


def valid_table(session: Session, name: str, at: int, context: str | None) -> tuple[TableRow, str]:
    """Return the table of `name` that holds at `at`, and the path of its store.

    The order of preference: certified for the context, pinned by the context, certified for any.

    Raises
    ------
    CatalogError
        When no table holds then; the message lists those that hold at other times.
    """
    found = _certified(session, name, at, context) if context else None
    if found is None and context:
        pinned = session.scalar(select(ContextRow.tables).where(ContextRow.id == context)) or {}
        found = session.get(TableRow, pinned[name]) if name in pinned else None
    found = found or _certified(session, name, at, "")
    if found is None:
        spans = session.scalars(select(CertificationRow).where(CertificationRow.name == name))
        others = "; ".join(f"table {row.table_id} {_span(row.start, row.end)}" for row in spans) or "none"
        raise CatalogError(
            f"no table '{name}' is valid at {to_utc(at)}Z; certified: {others}",
            remedy="certify one for that time",
        )
    path = session.scalars(select(StoreRow.path).where(StoreRow.id == found.store_id)).one()
    return found, path


def table_records(session: Session, name: str | None) -> list[TableRecord]:
    """Return all tables, or those of one name, oldest first."""
    query = select(TableRow, StoreRow).join(StoreRow, StoreRow.id == TableRow.store_id).order_by(TableRow.id)
    if name is not None:
        query = query.where(TableRow.name == name)
    approvals: dict[int, list[tuple[str, str, str]]] = {}
    for one in session.scalars(select(ApprovalRow).order_by(ApprovalRow.id)):
        approvals.setdefault(one.table_id, []).append((one.person, one.created, one.note))
    validities: dict[int, list[tuple[str | None, int, int]]] = {}
    for row in session.scalars(select(CertificationRow).order_by(CertificationRow.start)):
        validities.setdefault(row.table_id, []).append((row.context or None, row.start, row.end))
    return [
        row.as_record(
            TableRecord,
            run=row.run_id,
            segment=store.path,
            certified=tuple(validities.get(row.id, ())),
            damaged=is_damaged(store.notes),
            approved=tuple(approvals.get(row.id, ())),
        )
        for row, store in session.execute(query)
    ]


def approve_table(session: Session, table_id: int, person: str, note: str) -> None:
    """Record that a person answers for a table; see `Catalog.approve`."""
    if not person.strip():
        raise CatalogError("an approval needs a person", remedy="say who: --by NAME")
    require_tables(session, [table_id])
    created = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    session.add(ApprovalRow(table_id=table_id, person=person.strip(), note=note, created=created))
    session.flush()


def require_tables(session: Session, ids: Sequence[int]) -> None:
    """Raise CatalogError unless every id is that of a table."""
    known = set(session.scalars(select(TableRow.id).where(TableRow.id.in_(ids))))
    if missing := sorted(set(ids) - known):
        raise CatalogError(f"tables {missing} are not in the catalog", remedy="stage them first")


def _certified(session: Session, name: str, at: int, scope: str) -> TableRow | None:
    return session.scalar(
        select(TableRow)
        .join(CertificationRow, CertificationRow.table_id == TableRow.id)
        .where(
            CertificationRow.name == name,
            CertificationRow.context == scope,
            CertificationRow.start <= at,
            CertificationRow.end > at,
        )
    )


def _span(start: int, end: int) -> str:
    return f"[{to_utc(start)}Z, {to_utc(end)}Z)"
