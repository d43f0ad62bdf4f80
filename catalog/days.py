"""Queries about days: which revision is the present one, what happened to the others.

Each takes a database session and the name of a dataset, and returns `Day` records.
"""

from __future__ import annotations

import datetime as dt
import hashlib
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import fields
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.records import DAY_STATES, Day, ReleaseRecord, parse_version, utc_day, version_text
from inflight.catalog.schema import (
    CurrentRow,
    DatasetRow,
    DayRow,
    ReleaseDayRow,
    ReleaseRow,
    RunRow,
    StoreRow,
)
from inflight.catalog.spans import Span
from inflight.errors import CatalogError

#: So many rows are asked for by their numbers; of more, all of the span are read.
_FEW_ROWS = 200

#: What tells rows of days apart in all databases: number, state, run, dataset and day.
_Kind = tuple[int, str, str, str, dt.date]
#: Records that this process has read: a published row changes no more, but for its state.
_published: dict[_Kind, Day] = {}

#: Columns of a day, and those that are fields of its record under their own names.
_COLUMNS = tuple(DayRow.__table__.columns.keys())
_OWN = tuple({item.name for item in fields(Day)} & set(_COLUMNS) - {"id", "day", "revision"})


def day_record(row: DayRow, dataset: str, path: str | None) -> Day:
    """Return a row of the database as the record users see."""
    return _record({name: getattr(row, name) for name in _COLUMNS}, dataset, path)


def _record(values: Mapping[str, Any], dataset: str, path: str | None) -> Day:
    """Return the values of a row's columns as the record users see."""
    baseline, revision = values["baseline"], values["revision"]
    published = baseline is not None and revision is not None
    return Day(
        **{name: values[name] for name in _OWN},
        dataset=dataset,
        day=utc_day(values["day"]),
        version=version_text(baseline or 0, revision or 0) if published else "",
        revision=-1 if revision is None else revision,
        run=values["run_id"],
        id=f"day:{values['id']}",
        segment=path or "",
        rows=(values["start"], values["stop"]),
    )


def dataset_id(session: Session, name: str) -> int | None:
    """Return the database id of a dataset, None when there is none."""
    return session.scalar(select(DatasetRow.id).where(DatasetRow.name == name))


def require_dataset(session: Session, name: str) -> int:
    """Return the database id of a dataset.

    Raises
    ------
    CatalogError
        When there is none; the message names those there are.
    """
    found = dataset_id(session, name)
    if found is None:
        known = ", ".join(sorted(session.scalars(select(DatasetRow.name)))) or "none"
        raise CatalogError(
            f"dataset '{name}' is not in the catalog, which has: {known}", remedy="check the name"
        )
    return found


def current_day(session: Session, name: str, day: dt.date) -> Day | None:
    """Return the published revision of a day, None when there is none."""
    found = session.execute(
        _with_store()
        .join(CurrentRow, CurrentRow.day_id == DayRow.id)
        .join(DatasetRow, DatasetRow.id == CurrentRow.dataset_id)
        .where(DatasetRow.name == name, CurrentRow.day == day)
    ).first()
    return day_record(found[0], name, found[1]) if found else None


def day_of_version(session: Session, name: str, day: dt.date, version: str) -> Day | None:
    """Return one published revision of a day, present or past."""
    baseline, revision = parse_version(version)
    found = session.execute(
        _with_store()
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .where(
            DatasetRow.name == name,
            DayRow.day == day,
            DayRow.baseline == baseline,
            DayRow.revision == revision,
        )
    ).first()
    return day_record(found[0], name, found[1]) if found else None


def status_of_days(session: Session, name: str, span: Span, states: Iterable[str] | None) -> list[Day]:
    """Return one record a day: the published one, else the newest.

    With `states`, the newest record in one of them that is not older than the published one: a day
    that failed and was published later is not failed any more.
    """
    accepted = None if states is None else set(states)
    if accepted is not None and (unknown := accepted - set(DAY_STATES)):
        raise CatalogError(
            f"unknown day states {sorted(unknown)}", remedy=f"use some of {', '.join(DAY_STATES)}"
        )
    dataset = dataset_id(session, name)
    if dataset is None:
        return []
    # What tells records apart is little: of those that are not chosen no more is read.
    kinds = _in_span(select(DayRow.id, DayRow.state, DayRow.run_id, DayRow.day), span)
    present = CurrentRow.dataset_id == dataset
    if accepted == {"published"}:
        found = kinds.join(CurrentRow, CurrentRow.day_id == DayRow.id)
        found = found.where(present, DayRow.state == "published").order_by(DayRow.day)
        rows = session.execute(found).all()
        chosen = [(number, state, run, name, day) for number, state, run, day in rows]
    else:
        kinds = kinds.where(DayRow.dataset_id == dataset).order_by(DayRow.id)
        current = set(session.scalars(select(CurrentRow.day_id).where(present)))
        chosen = _chosen_of(session.execute(kinds), current, name, accepted)
    records = {kind: _published[kind] for kind in chosen if kind in _published}
    if left := [kind for kind in chosen if kind not in records]:
        made = _records_of(session, name, dataset, span, [kind[0] for kind in left])
        records |= {kind: made[kind[0]] for kind in left}
        _published.update((kind, records[kind]) for kind in left if kind[1] == "published")
    return [records[kind] for kind in chosen]


def _chosen_of(
    rows: Iterable[Any], current: Collection[int], name: str, accepted: Collection[str] | None
) -> list[_Kind]:
    """Return one of the records of each day, in order of time; rows are in that of their numbers."""
    by_day: dict[dt.date, list[_Kind]] = defaultdict(list)
    for number, state, run, day in rows:
        if number in current:
            by_day[day] = [(number, state, run, name, day)]
        elif state != "published":
            by_day[day].append((number, state, run, name, day))
    chosen: list[_Kind] = []
    for _, found in sorted(by_day.items()):
        preferred = {"published"} if accepted is None else accepted
        matching = [kind for kind in found if kind[1] in preferred]
        chosen += matching[-1:] or (found[-1:] if accepted is None else [])
    return chosen


def _records_of(
    session: Session, name: str, dataset: int, span: Span, numbers: Sequence[int]
) -> dict[int, Day]:
    """Return the records of days of a dataset by the numbers of their rows."""
    # Columns, not objects: of thousands of days those take most of the time.
    query = select(*DayRow.__table__.columns, StoreRow.path)
    query = query.outerjoin_from(DayRow, StoreRow, StoreRow.id == DayRow.store_id)
    query = _in_span(query.where(DayRow.dataset_id == dataset), span)
    if len(numbers) <= _FEW_ROWS:
        query = query.where(DayRow.id.in_(numbers))
    rows = {row.id: row for row in session.execute(query)}
    return {
        number: _record(dict(zip(_COLUMNS, rows[number], strict=False)), name, rows[number].path)
        for number in numbers
    }


def published_contexts(session: Session, name: str) -> list[tuple[dt.date, str | None]]:
    """Return the published days of a dataset in order, and the context that made each."""
    rows = session.execute(
        select(CurrentRow.day, DayRow.context)
        .join(DayRow, DayRow.id == CurrentRow.day_id)
        .join(DatasetRow, DatasetRow.id == CurrentRow.dataset_id)
        .where(DatasetRow.name == name)
        .order_by(CurrentRow.day)
    )
    return [(day, context) for day, context in rows]


def dataset_names(session: Session, patterns: Iterable[str]) -> list[str]:
    """Return the names of the datasets that match one of some patterns, such as ``l2/*``, in order."""
    names = session.scalars(select(DatasetRow.name).order_by(DatasetRow.name))
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def hash_of_days(session: Session, names: Iterable[str]) -> str:
    """Return a hash of which days of some datasets there are: every revision, its state, key and store."""
    query = (
        select(DayRow.id, DayRow.state, DayRow.key, DayRow.store_id, CurrentRow.day_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .outerjoin(CurrentRow, CurrentRow.day_id == DayRow.id)
        .where(DatasetRow.name.in_(list(names)), DayRow.revision.is_not(None))
        .order_by(DayRow.id)
    )
    found = hashlib.sha256()
    for row in session.execute(query):
        found.update(repr(tuple(row)).encode())
    return found.hexdigest()


def published_days(session: Session, name: str, span: Span, context: str | None) -> list[Day]:
    """Return the days to read: the present revisions, or the newest ones made in `context`."""
    dataset = require_dataset(session, name)
    query = _in_span(_with_store().where(DayRow.dataset_id == dataset), span)
    if context is None:
        query = query.join(CurrentRow, CurrentRow.day_id == DayRow.id)
    else:
        query = query.where(DayRow.context == context, DayRow.state == "published")
    query = query.order_by(DayRow.day, DayRow.baseline, DayRow.revision)
    newest = {row.day: (row, path) for row, path in session.execute(query)}
    return [day_record(row, name, path) for row, path in newest.values()]


def revisions_of_days(session: Session, name: str, span: Span) -> list[Day]:
    """Return every revision of each day that was ever published, the oldest first."""
    dataset = dataset_id(session, name)
    if dataset is None:
        return []
    query = _in_span(_with_store().where(DayRow.dataset_id == dataset, DayRow.state == "published"), span)
    return [day_record(row, name, path) for row, path in session.execute(query.order_by(DayRow.id))]


def released_days(session: Session, version: str, name: str | None, span: Span) -> list[Day]:
    """Return the days of a frozen collection.

    Raises
    ------
    CatalogError
        When there is no such release.
    """
    release = session.scalar(select(ReleaseRow.id).where(ReleaseRow.version == version))
    if release is None:
        known = ", ".join(session.scalars(select(ReleaseRow.version).order_by(ReleaseRow.id))) or "none"
        raise CatalogError(
            f"release {version!r} does not exist; released: {known}", remedy="check the version"
        )
    query = (
        select(DayRow, StoreRow.path, DatasetRow.name)
        .join(StoreRow, StoreRow.id == DayRow.store_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .join(ReleaseDayRow, ReleaseDayRow.day_id == DayRow.id)
        .where(ReleaseDayRow.release_id == release)
        .order_by(DatasetRow.name, DayRow.day)
    )
    if name is not None:
        query = query.where(DatasetRow.name == name)
    return [day_record(row, dataset, path) for row, path, dataset in session.execute(_in_span(query, span))]


def release_records(session: Session) -> list[ReleaseRecord]:
    """Return all releases, the oldest first."""
    held = (
        select(ReleaseDayRow.release_id, DatasetRow.name, func.min(DayRow.day), func.max(DayRow.day))
        .join(DayRow, DayRow.id == ReleaseDayRow.day_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .group_by(ReleaseDayRow.release_id, DatasetRow.name)
        .order_by(DatasetRow.name)
    )
    datasets: dict[int, dict[str, tuple[dt.date, dt.date]]] = defaultdict(dict)
    for release, name, first, last in session.execute(held):
        datasets[release][name] = first, last
    rows = session.scalars(select(ReleaseRow).order_by(ReleaseRow.id))
    return [
        ReleaseRecord(
            version=row.version, created=row.created, datasets=datasets[row.id], maturity=row.maturity
        )
        for row in rows
    ]


def adoptable_day(session: Session, name: str, day: dt.date, key: str) -> tuple[DayRow, StoreRow] | None:
    """Return a day that an ended run verified and never published, made from the same key."""
    found = session.execute(
        select(DayRow, StoreRow)
        .join(StoreRow, StoreRow.id == DayRow.store_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .join(RunRow, RunRow.id == DayRow.run_id)
        .where(
            DatasetRow.name == name,
            DayRow.day == day,
            DayRow.key == key,
            DayRow.state == "verified",
            RunRow.state != "running",
        )
        .order_by(DayRow.id.desc())
    ).first()
    return (found[0], found[1]) if found else None


def adoptable_days(session: Session, name: str) -> list[tuple[dt.date, str]]:
    """Return day and key of all days that ended runs verified and never published."""
    found = session.execute(
        select(DayRow.day, DayRow.key)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .join(RunRow, RunRow.id == DayRow.run_id)
        .where(DatasetRow.name == name, DayRow.state == "verified", RunRow.state != "running")
    )
    return [(day, key) for day, key in found]


def maturities(session: Session, name: str) -> dict[str, str]:
    """Return the maturity of the days of a dataset that a release holds, that of the last one."""
    dataset = dataset_id(session, name)
    rows = session.execute(
        select(DayRow.id, ReleaseRow.maturity)
        .join(ReleaseDayRow, ReleaseDayRow.day_id == DayRow.id)
        .join(ReleaseRow, ReleaseRow.id == ReleaseDayRow.release_id)
        .where(DayRow.dataset_id == dataset)
        .order_by(ReleaseRow.id)
    )
    return {f"day:{id}": maturity for id, maturity in rows}


def days_by_id(session: Session, ids: Iterable[int]) -> list[Day]:
    """Return the records of days of any state by the numbers of their rows."""
    rows = _with_store().add_columns(DatasetRow.name).join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
    found = []
    numbers = sorted(set(ids))
    for first in range(0, len(numbers), 500):  # databases bound the number of values in one statement
        some = rows.where(DayRow.id.in_(numbers[first : first + 500]))
        found += [day_record(row, name, path) for row, path, name in session.execute(some)]
    return found


def stored_together(session: Session, path: str) -> tuple[str, list[Day]]:
    """Return the sha256 of a store's manifest, and the days in it in order, each once."""
    sha256 = session.scalars(select(StoreRow.sha256).where(StoreRow.path == path)).one()
    rows = session.scalars(
        select(DayRow.id)
        .join(StoreRow, StoreRow.id == DayRow.store_id)
        .where(StoreRow.path == path)
        .order_by(DayRow.start, DayRow.id)
    )
    # A run that was killed has left rows of the same days that another one took over.
    by_day = {day.day: day for day in sorted(days_by_id(session, rows), key=lambda day: int(day.id[4:]))}
    return sha256, [by_day[day] for day in sorted(by_day)]


def dataset_summary(session: Session, span: Span) -> list[dict[str, Any]]:
    """Describe each dataset; see `Catalog.inventory`."""
    names = session.scalars(select(DatasetRow.name).order_by(DatasetRow.name)).all()
    return [summary_of_days(name, status_of_days(session, name, span, None)) for name in names]


def summary_of_days(name: str, days: Sequence[Day]) -> dict[str, Any]:
    """Describe the days of one dataset; see `Catalog.inventory`."""
    states = Counter(day.state for day in days)
    published = [day for day in days if day.state == "published"]
    coverages = [day.coverage for day in published if day.coverage is not None]
    return {
        "dataset": name,
        "first": str(published[0].day) if published else "",
        "last": str(published[-1].day) if published else "",
        "days": states["published"],
        "failed": states["failed"],
        "no_work": states["no_work"],
        "gaps": [str(day) for day in missing_days(published)],
        "versions": dict(sorted(Counter(day.version for day in published).items())),
        "coverage": float(np.mean(coverages)) if coverages else None,
        "samples": sum(day.count for day in published),
    }


def missing_days(published: list[Day]) -> list[np.datetime64]:
    """Return the days between the first and the last published one that are not published."""
    if not published:
        return []
    there = {day.day for day in published}
    return [day for day in np.arange(published[0].day, published[-1].day) if day not in there]


class DatabaseDays:
    """The days that a catalog's database knows; `ReleaseFolder` answers the same of a folder without one."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def names(self) -> list[str]:
        """Return the names of all datasets in order."""
        return self._database.read(dataset_names, ["*"])

    def current(self, name: str, day: dt.date) -> Day | None:
        """Return the published revision of a day; None without one."""
        return self._database.read(current_day, name, day)

    def of_version(self, name: str, day: dt.date, version: str) -> Day | None:
        """Return a published revision of a day, past or present."""
        return self._database.read(day_of_version, name, day, version)

    def days(self, name: str, span: Span, states: Iterable[str] | None, release: str | None) -> list[Day]:
        """Return one record a day; see `Catalog.days`."""
        if release is not None:
            return self._database.read(released_days, release, name, span)
        return self._database.read(status_of_days, name, span, states)

    def published(self, name: str) -> list[tuple[dt.date, str | None]]:
        """Return the published days, and what made each; see `Catalog.published`."""
        return self._database.read(published_contexts, name)

    def to_read(self, name: str, span: Span, release: str | None, context: str | None) -> list[Day]:
        """Return the days that opening a span reads; see `Catalog.open`."""
        if release is not None:
            return self.days(name, span, None, release)
        return self._database.read(published_days, name, span, context)

    def inventory(self, span: Span) -> list[dict[str, Any]]:
        """Describe each dataset; see `Catalog.inventory`."""
        return self._database.read(dataset_summary, span)

    def releases(self) -> list[ReleaseRecord]:
        """Return all releases, the oldest first."""
        return self._database.read(release_records)


def _with_store() -> Select[Any]:
    return select(DayRow, StoreRow.path).outerjoin(StoreRow, StoreRow.id == DayRow.store_id)


def _in_span(query: Select[Any], span: Span) -> Select[Any]:
    if (first := span.first_day()) is not None:
        query = query.where(DayRow.day >= first)
    if (last := span.last_day()) is not None:
        query = query.where(DayRow.day <= last)
    return query
