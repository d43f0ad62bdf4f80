"""Moving a catalog to another database: from ``catalog.db`` into PostgreSQL, and back.

All rows are copied with their numbers while no one can write, then counted and compared. The stores stay
where they are. A move that was interrupted is finished, or begun again, by the same call: the new database
is marked until all is in it, and the old one from then on.
"""

from __future__ import annotations

import hashlib
import json
import math
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Integer, Table, delete, func, insert, select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.location import (
    DATABASE_FILE,
    MOVED_SETTING,
    WORKSPACE_SETTING,
    database_url,
    join,
    name_workspace,
    parse_url,
    read_marks,
    sqlite_url,
    state_location,
)
from inflight.catalog.runs import close_dead_runs
from inflight.catalog.schema import Base, RunRow, SettingRow
from inflight.errors import CatalogError, IntegrityError
from inflight.progress import Progress, silent

#: Where `move_catalog` moves to when it is to be the database in the workspace.
INTO_WORKSPACE: Final = "sqlite"
#: The old ``catalog.db`` is kept under this name.
_KEPT: Final = "catalog-moved.db"
_UNFINISHED: Final = "unfinished, it is being moved here from "
#: Rows copied at a time.
_BATCH: Final = 1000

Row = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Move:
    """What was, or would be, moved: the addresses without passwords, and the rows of each table."""

    source: str
    target: str
    rows: Mapping[str, int]
    done: bool


def move_catalog(
    workspace: Path, address: str, *, dry_run: bool = False, progress: Progress = silent
) -> Move:
    """Move the catalog of a workspace to another database, and state there where it is now.

    Parameters
    ----------
    workspace : Path
    address : str
        ``postgresql://USER@HOST/DATABASE``, of a database that is empty; ``sqlite``, the workspace itself.
    dry_run : bool
        Only open both, look whether the move can be made, and count.
    progress : callable, optional
        Called with ("move", done, total): rows that were copied, and read back to compare them.

    Raises
    ------
    CatalogError
        When runs are under way, or the database is not empty.
    IntegrityError
        When what was copied is not what was there; nothing has changed then.
    """
    into = sqlite_url(workspace) if address == INTO_WORKSPACE else parse_url(address, "the new address")
    source, target = Database(database_url(workspace)), Database(into)
    if source.engine.url == target.engine.url:
        raise CatalogError("the catalog is there already", file=target.place, remedy="name another database")
    close_dead_runs(workspace, source)
    name, moved, _ = source.read(read_marks)
    if moved and moved != target.place:
        raise CatalogError(f"this catalog was moved: {moved}", file=source.place, remedy="move it from there")
    if not (name or dry_run):
        name = source.write(name_workspace, uuid.uuid4().hex)
    if not moved:
        source.read(_require_no_runs)
        target.read(_require_free, name)
    if dry_run:
        return Move(source=source.place, target=target.place, rows=source.read(_counts), done=False)
    if not moved:
        source.write(_move, source, target, name, progress)
    target.write(_unmark)
    join(workspace, name)
    state_location(workspace, into)
    if source.engine.url == sqlite_url(workspace):
        _put_aside(workspace / DATABASE_FILE)
    return Move(source=source.place, target=target.place, rows=target.read(_counts), done=True)


def _tables() -> list[Table]:
    return Base.metadata.sorted_tables


def _counts(session: Session) -> dict[str, int]:
    return {
        table.name: session.scalar(select(func.count()).select_from(table)) or 0
        for table in _tables()
        if table.name != SettingRow.__tablename__
    }


def _require_no_runs(session: Session) -> None:
    if running := session.scalars(select(RunRow.id).where(RunRow.state == "running")).all():
        raise CatalogError(
            f"runs are under way: {', '.join(running)}", remedy="wait until they have ended, then move"
        )


def _require_free(session: Session, name: str) -> None:
    """Refuse a database that holds anything but what was moved away from it, or a move that broke off."""
    marks = read_marks(session)
    if any(_counts(session).values()) and not (marks.moved and marks.workspace == name):
        raise CatalogError(
            "the database holds a catalog already",
            remedy="make an empty one with 'createdb', and move into it",
        )


def _move(session: Session, source: Database, target: Database, name: str, progress: Progress) -> None:
    """Copy all rows while the source is locked, and mark it in the same transaction."""
    _require_no_runs(session)
    target.write(_fill, session, source, target, name, progress)
    session.merge(SettingRow(name=MOVED_SETTING, value=target.place))


def _fill(
    session: Session, old: Session, source: Database, target: Database, name: str, progress: Progress
) -> None:
    _require_free(session, name)
    tables = _tables()
    # Each row is copied, and read back.
    done, total = 0, 2 * sum(old.scalar(select(func.count()).select_from(table)) or 0 for table in tables)
    progress("move", done, total)
    for table in reversed(tables):
        session.execute(delete(table))
    for table in tables:
        copied = _Digest()
        for rows in _batches(old, table):
            copied.add(rows)
            session.execute(insert(table), rows)
            done += len(rows)
            progress("move", done, total)
        written = _Digest()
        for rows in _batches(session, table):
            written.add(rows)
            done += len(rows)
            progress("move", done, total)
        if copied != written:
            raise IntegrityError(
                f"table '{table.name}' was not copied whole: {copied.count} rows, {written.count} arrived",
                file=target.place,
                remedy="move again",
            )
        if "id" in table.columns and isinstance(table.columns["id"].type, Integer):
            target.backend.number_on(session, table.name)
    session.merge(SettingRow(name=WORKSPACE_SETTING, value=name))
    session.merge(SettingRow(name=MOVED_SETTING, value=f"{_UNFINISHED}{source.place}"))


def _unmark(session: Session) -> None:
    session.execute(delete(SettingRow).where(SettingRow.name == MOVED_SETTING))


def _batches(session: Session, table: Table) -> Iterator[list[Row]]:
    found = session.execute(select(table), execution_options={"yield_per": _BATCH})
    for rows in found.mappings().partitions():
        yield [dict(row) for row in rows]


class _Digest:
    """Number and content of rows, whatever their order."""

    def __init__(self) -> None:
        self.count, self._sum = 0, 0

    def add(self, rows: list[Row]) -> None:
        """Take rows in."""
        self.count += len(rows)
        for row in rows:
            plain = {name: _plain(value) for name, value in row.items()}
            digest = hashlib.sha256(json.dumps(plain, default=str).encode()).digest()
            self._sum = (self._sum + int.from_bytes(digest, "big")) % 2**256

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Digest) and (self.count, self._sum) == (other.count, other._sum)

    __hash__ = None  # type: ignore[assignment]


def _plain(value: Any) -> Any:
    # SQLite has no NaN of its own, and keeps none.
    return None if isinstance(value, float) and math.isnan(value) else value


def _put_aside(file: Path) -> None:
    """Keep the old database under another name, so that nothing takes it for the catalog."""
    kept, number = file.with_name(_KEPT), 1
    while kept.exists():
        number += 1
        kept = file.with_name(f"{Path(_KEPT).stem}-{number}.db")
    for end in ("-wal", "-shm"):
        if (beside := file.with_name(file.name + end)).exists():
            beside.replace(kept.with_name(kept.name + end))
    file.replace(kept)
