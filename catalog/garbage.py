"""Garbage: stores that nothing refers to, and, when asked for, past revisions that nothing needs.

Needed are the newest version of each day, what a release holds, what was made last in a named context,
tables that are valid, approved or pinned by a named context, and all that these were made from (lineage).
A revision that was freed keeps its record, so its version is never given out again; a table too, so that
lineage still names it.
"""

from __future__ import annotations

import datetime as dt
import shutil
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.manifest import folder_bytes
from inflight.catalog.provenance import walk
from inflight.catalog.records import FREED, is_gone, version_text
from inflight.catalog.schema import (
    ApprovalRow,
    CertificationRow,
    ContextRow,
    CurrentRow,
    DatasetRow,
    DayRow,
    NamedContextRow,
    ReleaseDayRow,
    RunRow,
    StoreRow,
    TableRow,
)
from inflight.errors import CatalogError
from inflight.progress import Progress, tell_each

#: After which a release that nothing was written to any more is taken for killed, s; assumed.
_ABANDONED_S = 86_400.0


@dataclass(frozen=True, kw_only=True)
class Garbage:
    """A folder that can go.

    Attributes
    ----------
    path : str
        Relative to the workspace.
    bytes : int
        On the disk.
    item : str
        Its dataset or ``tables/NAME``; empty for what the catalog does not know.
    revisions : tuple of str
        Published revisions in it that cannot be read any more, ``2005-01-31 v01.00``.
    tables : tuple of int
        Ids of calibration tables in it.
    """

    path: str
    bytes: int = 0
    item: str = ""
    revisions: tuple[str, ...] = ()
    tables: tuple[int, ...] = ()


def collect_garbage(
    workspace: Path, database: Database, *, dry_run: bool, past: bool, progress: Progress
) -> list[Garbage]:
    """Remove stores that nothing needs; see `Catalog.gc`."""
    # Folders are listed before the database is asked: what appears later belongs to a run that is alive.
    present = sorted((workspace / "stores").glob("*/*.zarr"))
    paths = [folder.relative_to(workspace).as_posix() for folder in present]
    garbage = database.read(_find, paths, past) if dry_run else database.write(_forget, paths, past)
    garbage = [*garbage, *(Garbage(path=path) for path in _abandoned_releases(workspace))]
    sized = [
        replace(one, bytes=folder_bytes(workspace / one.path))
        for one in tell_each(progress, "measure", garbage)
    ]
    for one in tell_each(progress, "remove", [] if dry_run else garbage):
        folder = workspace / one.path
        shutil.rmtree(folder, ignore_errors=True)
        if one.path.startswith("stores/") and not any(folder.parent.iterdir()):
            folder.parent.rmdir()
    return sized


def _find(session: Session, paths: Iterable[str], past: bool) -> list[Garbage]:
    """Return which folders can go, in order, with what the catalog knows of them."""
    alive = set(session.scalars(select(RunRow.id).where(RunRow.state == "running")))
    if past and alive:
        raise CatalogError(
            f"a run is under way, which may read past revisions: {', '.join(sorted(alive))}",
            remedy="wait for it, or leave out --past",
        )
    needed = _needed_stores(session, past)
    gone = [path for path in paths if path not in needed and path.split("/")[1] not in alive]
    known: dict[str, Garbage] = {path: Garbage(path=path) for path in gone}
    of_days = (
        select(StoreRow.path, DatasetRow.name, DayRow)
        .join(DayRow, DayRow.store_id == StoreRow.id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .order_by(DayRow.day, DayRow.id)
    )
    for path, name, row in session.execute(of_days):
        if path in known:
            told = f"{row.day} {version_text(row.baseline or 0, row.revision or 0)}"
            new = (told,) if row.state == "published" else ()
            known[path] = replace(known[path], item=name, revisions=known[path].revisions + new)
    of_tables = select(StoreRow.path, TableRow.name, TableRow.id).join(
        TableRow, TableRow.store_id == StoreRow.id
    )
    for path, name, number in session.execute(of_tables):
        if path in known:
            known[path] = replace(known[path], item=f"tables/{name}", tables=(*known[path].tables, number))
    return list(known.values())


def _forget(session: Session, paths: Iterable[str], past: bool) -> list[Garbage]:
    """Take what can go out of the database; asked under the write lock, a run may have adopted some."""
    garbage = _find(session, paths, past)
    today = dt.datetime.now(dt.UTC).date()
    freed, tables = [one.path for one in garbage], {one.path for one in garbage if one.tables}
    stores = session.scalars(select(StoreRow).where(StoreRow.path.in_(freed))).all()
    own = DayRow.store_id.in_([store.id for store in stores])
    session.execute(
        update(DayRow)
        .where(own, DayRow.state == "published")
        .values(state="freed", message=f"nothing needed this revision: freed on {today}", store_id=None)
    )
    session.execute(update(DayRow).where(own).values(store_id=None, state="failed", cause="no_work"))
    for store in stores:
        if store.path not in tables:
            session.delete(store)
        elif not is_gone(store.notes):
            store.notes = [*store.notes, f"{FREED}{today}"]
    return garbage


def _abandoned_releases(workspace: Path) -> list[str]:
    """Return folders of releases that were killed before they were whole: hidden, and a day old."""
    before = time.time() - _ABANDONED_S
    folders = (workspace / "releases").glob(".*-*") if (workspace / "releases").is_dir() else ()
    old = (one for one in folders if one.is_dir() and one.stat().st_mtime < before)
    return sorted(one.relative_to(workspace).as_posix() for one in old)


def _needed_stores(session: Session, past: bool) -> set[str]:
    """Return the paths of stores that stay; unless `past`, those of all that was ever published."""
    newer = (
        select(CurrentRow.day_id)
        .where(
            CurrentRow.dataset_id == DayRow.dataset_id,
            CurrentRow.day == DayRow.day,
            CurrentRow.day_id > DayRow.id,
        )
        .exists()
    )
    adoptable = set(session.scalars(select(DayRow.id).where(DayRow.state == "verified", ~newer)))
    of_days = select(DayRow.id, StoreRow.path, DayRow.state).join(StoreRow, StoreRow.id == DayRow.store_id)
    of_tables = select(TableRow.id, StoreRow).join(StoreRow, StoreRow.id == TableRow.store_id)
    days, tables = needed_items(session, adoptable) if past else (adoptable, set[int]())
    return {
        path
        for number, path, state in session.execute(of_days)
        if number in days or (state == "published" and not past)
    } | {
        store.path
        for number, store in session.execute(of_tables)
        if number in tables or not (past or any(note.startswith(FREED) for note in store.notes))
    }


def needed_items(session: Session, days: Collection[int] = ()) -> tuple[set[int], set[int]]:
    """Return the days and tables that something needs, beside `days`, and all that these were made from."""
    contexts = session.execute(
        select(ContextRow.id, ContextRow.tables).join(
            NamedContextRow, NamedContextRow.context_id == ContextRow.id
        )
    ).all()
    made_in = (
        select(DayRow)
        .where(DayRow.context.in_([id for id, _ in contexts]), DayRow.state == "published")
        .order_by(DayRow.baseline, DayRow.revision)
    )
    newest = {(row.dataset_id, row.day, row.context): row.id for row in session.scalars(made_in)}
    rows = {
        *days,
        *newest.values(),
        *session.scalars(select(CurrentRow.day_id)),
        *session.scalars(select(ReleaseDayRow.day_id)),
    }
    tables = {
        *session.scalars(select(CertificationRow.table_id)),
        *session.scalars(select(ApprovalRow.table_id)),
        *(int(one[0]) for _, pinned in contexts for spans in pinned.values() for one in spans),
    }
    roots = [*(f"day:{number}" for number in rows), *(f"table:{number}" for number in tables)]
    items = {*roots, *(edge.parent for edge in walk(session, roots, up=True))}
    numbers = {
        kind: {int(item[len(kind) :]) for item in items if item.startswith(kind)}
        for kind in ("day:", "table:")
    }
    return numbers["day:"], numbers["table:"]
