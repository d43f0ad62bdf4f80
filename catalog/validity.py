"""Calibration tables and when they hold: half-open validities that never overlap.

`certify_table` gives a table a validity, `decertify_table` takes it away; what either cuts in the middle is
split. Each act is kept with author, reason and time, so that `validities` also knows what was valid before.
`valid_table` finds the table that holds at an instant.
"""

from __future__ import annotations

import datetime as dt
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from inflight.catalog.database import time_in_order
from inflight.catalog.records import CertificationAct, TableRecord, Validity, is_gone
from inflight.catalog.schema import (
    ApprovalRow,
    CertificationActRow,
    CertificationRow,
    ContextRow,
    DayRow,
    EdgeRow,
    ReleaseDayRow,
    ReleaseRow,
    StoreRow,
    TableRow,
)
from inflight.catalog.spans import Span
from inflight.errors import CatalogError, ValidityError
from inflight.time import to_utc

#: (table id, start, end, context), TT2000 half-open.
Certification = tuple[int, int, int, str | None]

#: What is done to validities.
CERTIFY, DECERTIFY = "certify", "decertify"


class Authority(NamedTuple):
    """Who changes a validity and why; `run` is None for a person."""

    author: str = ""
    reason: str = ""
    run: str | None = None


def certify_table(
    session: Session, certification: Certification, authority: Authority, *, supersede: bool
) -> None:
    """Give a table a validity; see `Catalog.certify`."""
    table_id, start, end, context = certification
    table = _table(session, table_id)
    if end <= start:
        raise ValidityError(f"validity of table {table_id} ends at {end}, not after its start {start}")
    overlapping = _overlapping(session, table.name, context, start, end)
    for older in overlapping:
        if not supersede:
            raise ValidityError(
                f"table {table_id} of '{table.name}', valid {_span(start, end)}, overlaps "
                f"table {older.table_id}, valid {_span(older.start, older.end)}",
                remedy="choose a span that is free, or supersede the older table",
            )
    _cut(session, [one for one in overlapping if one.table_id != table_id], start, end, authority)
    _cut(session, [one for one in overlapping if one.table_id == table_id], start, end, None)
    row = CertificationRow(name=table.name, context=context or "", start=start, end=end)
    row.table_id = table_id
    session.add(row)
    _keep_act(session, table, CERTIFY, (start, end, context), authority)


def decertify_table(
    session: Session,
    table_id: int,
    start: int | None,
    end: int | None,
    context: str | None,
    authority: Authority,
) -> None:
    """Take a table's validity away in a span; see `Catalog.decertify`."""
    table = _table(session, table_id)
    own = select(CertificationRow).where(
        CertificationRow.table_id == table_id, CertificationRow.context == (context or "")
    )
    rows = [
        row
        for row in session.scalars(own)
        if (start is None or row.end > start) and (end is None or row.start < end)
    ]
    if not rows:
        raise ValidityError(
            f"table {table_id} of '{table.name}' is not valid in the span asked for",
            remedy=f"'inflight catalog show {table.name}' tells when it is",
        )
    first = min(row.start for row in rows) if start is None else start
    last = max(row.end for row in rows) if end is None else end
    if last <= first:
        raise ValidityError(f"the span ends at {last}, not after its start {first}")
    _cut(session, rows, first, last, authority)
    _keep_act(session, table, DECERTIFY, (first, last, context), authority)


def _table(session: Session, table_id: int) -> TableRow:
    table = session.get(TableRow, table_id)
    if table is None:
        raise CatalogError(f"table {table_id} is not in the catalog", remedy="see Catalog.tables")
    return table


def _overlapping(
    session: Session, name: str, context: str | None, start: int, end: int
) -> list[CertificationRow]:
    found = select(CertificationRow).where(
        CertificationRow.name == name,
        CertificationRow.context == (context or ""),
        CertificationRow.start < end,
        CertificationRow.end > start,
    )
    return list(session.scalars(found))


def _cut(
    session: Session, rows: Iterable[CertificationRow], start: int, end: int, authority: Authority | None
) -> None:
    """Take a span out of validities; what remains before and behind it stays valid.

    A person may not take what a release was made with; a run makes what the next one is made with.
    """
    for row in rows:
        if authority is not None and authority.run is None:
            _refuse_behind_release(session, row, start, end)
        remaining = _outside((row.start, row.end), start, end)
        if remaining:
            row.start, row.end = remaining[0]
        else:
            session.delete(row)
        session.flush()
        for first, last in remaining[1:]:
            again = CertificationRow(name=row.name, context=row.context, start=first, end=last)
            again.table_id = row.table_id
            session.add(again)
    session.flush()


def _outside(span: tuple[int, int], start: int, end: int) -> list[tuple[int, int]]:
    """Return what is left of a span without another one."""
    parts = ((span[0], min(start, span[1])), (max(end, span[0]), span[1]))
    return [part for part in parts if part[0] < part[1]]


def _refuse_behind_release(session: Session, row: CertificationRow, start: int, end: int) -> None:
    whole = Span(max(row.start, start), min(row.end, end))
    made = select(EdgeRow.child).where(EdgeRow.parent == f"table:{row.table_id}")
    children = {child for child in session.scalars(made) if child.startswith("day:")}
    released = (
        select(DayRow.id, DayRow.day, ReleaseRow.version)
        .join(ReleaseDayRow, ReleaseDayRow.day_id == DayRow.id)
        .join(ReleaseRow, ReleaseRow.id == ReleaseDayRow.release_id)
        .where(DayRow.day >= whole.first_day(), DayRow.day <= whole.last_day())
        .order_by(DayRow.day)
    )
    for number, day, version in session.execute(released) if children else ():
        if f"day:{number}" in children:
            raise ValidityError(
                f"release {version} has {day} made with table {row.table_id} of '{row.name}': its validity "
                "there is published",
                remedy="shorten it on days that no release has; for the next release, make a newer table "
                "with 'inflight reprocess'",
            )


def _keep_act(
    session: Session, table: TableRow, act: str, span: tuple[int, int, str | None], authority: Authority
) -> None:
    start, end, context = span
    session.add(
        CertificationActRow(
            table_id=table.id,
            name=table.name,
            context=context or "",
            act=act,
            start=start,
            end=end,
            author=authority.author,
            reason=authority.reason,
            created=time_in_order(session, CertificationActRow.created).isoformat(timespec="microseconds"),
            run_id=authority.run,
        )
    )
    session.flush()


def withdraw_tables(session: Session, tables: Sequence[int], authority: Authority) -> None:
    """End all validities of tables that cannot be read any more, whatever they were used for."""
    valid = select(CertificationRow).where(CertificationRow.table_id.in_(tables))
    for row in session.scalars(valid).all():
        span = row.start, row.end, row.context or None
        _keep_act(session, _table(session, row.table_id), DECERTIFY, span, authority)
        session.delete(row)
    session.flush()


def certification_acts(
    session: Session, name: str | None = None, until: dt.datetime | None = None
) -> list[CertificationAct]:
    """Return what was done to validities, oldest first, of one table name or of all, before an instant."""
    query = select(CertificationActRow).order_by(CertificationActRow.id)
    if name is not None:
        query = query.where(CertificationActRow.name == name)
    return [
        row.as_record(CertificationAct, table=row.table_id, context=row.context or None, run=row.run_id)
        for row in session.scalars(query)
        if until is None or dt.datetime.fromisoformat(row.created) < until
    ]


def validities(acts: Iterable[CertificationAct], context: str | None = None) -> Mapping[str, list[Validity]]:
    """Return what acts lead to, in order of time: table name -> validities in any context, or in one."""
    found: dict[str, list[Validity]] = defaultdict(list)
    for act in acts:
        if act.context == context:
            found[act.name] = after_act(found[act.name], act)
    return {name: spans for name, spans in found.items() if spans}


def after_act(spans: Iterable[Validity], act: CertificationAct) -> list[Validity]:
    """Return the validities of a name, in order of time, after something was done to them."""
    parts = [
        (table, *part)
        for table, first, last in spans
        for part in (
            _outside((first, last), act.start, act.end)
            if act.act == CERTIFY or table == act.table
            else [(first, last)]
        )
    ]
    new = [(act.table, act.start, act.end)] if act.act == CERTIFY else []
    return sorted(parts + new, key=lambda one: one[1])


def valid_table(session: Session, name: str, at: int, context: str | None) -> tuple[TableRow, str]:
    """Return the table of `name` that holds at `at`, and the path of its store.

    The order of preference: certified for the context, pinned by the context, certified for any. A context
    that pins a name has no other table of it.

    Raises
    ------
    CatalogError
        When no table holds then; the message lists those that hold at other times.
    """
    found = _certified(session, name, at, context) if context else None
    pinned: Mapping[str, Sequence[Validity]] = {}
    if found is None and context:
        pinned = session.scalar(select(ContextRow.tables).where(ContextRow.id == context)) or {}
        number = next((one for one, start, end in pinned.get(name, ()) if start <= at < end), None)
        found = None if number is None else session.get(TableRow, number)
    if found is None and name not in pinned:
        found = _certified(session, name, at, "")
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
    by_persons = select(CertificationActRow).where(CertificationActRow.run_id.is_(None))
    last_act = {one.table_id: one.act for one in session.scalars(by_persons.order_by(CertificationActRow.id))}
    validities: dict[int, list[tuple[str | None, int, int]]] = {}
    for row in session.scalars(select(CertificationRow).order_by(CertificationRow.start)):
        validities.setdefault(row.table_id, []).append((row.context or None, row.start, row.end))
    return [
        row.as_record(
            TableRecord,
            run=row.run_id,
            segment=store.path,
            certified=tuple(validities.get(row.id, ())),
            damaged=is_gone(store.notes),
            approved=tuple(approvals.get(row.id, ())),
            decertified=last_act.get(row.id) == DECERTIFY,
        )
        for row, store in session.execute(query)
    ]


def approve_table(session: Session, table_id: int, person: str, note: str) -> None:
    """Record that a person answers for a table; see `Catalog.approve`."""
    if not person.strip():
        raise CatalogError("an approval needs a person", remedy="say who: --by NAME")
    require_tables(session, [table_id])
    created = time_in_order(session, ApprovalRow.created).isoformat(timespec="seconds")
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
