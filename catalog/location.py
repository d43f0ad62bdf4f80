"""Where the catalog of a workspace is kept: in its own ``catalog.db``, or in a PostgreSQL database.

The variable ``INFLIGHT_CATALOG`` goes before the file ``catalog.yaml`` of the workspace, and that before
``catalog.db``. The mission's YAML says nothing of it: what it holds goes into every product.

A database elsewhere could be taken for that of another folder, whose stores would then seem to be garbage.
So both carry one random name, in `WORKSPACE_SETTING` and the file ``catalog.id``, and belong together only
when these are equal.
"""

from __future__ import annotations

import os
import uuid
from pathlib import Path
from typing import Final, NamedTuple

from sqlalchemy import URL, make_url, select
from sqlalchemy.exc import ArgumentError
from sqlalchemy.orm import Session

from inflight.catalog.database import Database, address_without_password
from inflight.catalog.schema import SettingRow, StoreRow
from inflight.errors import CatalogError, WorkspaceError

CATALOG_VARIABLE: Final = "INFLIGHT_CATALOG"
LOCATION_FILE: Final = "catalog.yaml"
DATABASE_FILE: Final = "catalog.db"
ID_FILE: Final = "catalog.id"
WORKSPACE_SETTING: Final = "workspace"
#: Setting of a database whose catalog was moved away: where to.
MOVED_SETTING: Final = "moved"


def database_url(workspace: Path) -> URL:
    """Return the address of a workspace's catalog.

    Raises
    ------
    CatalogError
        When what is stated is no address.
    """
    if stated := os.environ.get(CATALOG_VARIABLE):
        return parse_url(stated, CATALOG_VARIABLE)
    file = workspace / LOCATION_FILE
    if file.exists():
        return parse_url(_stated_in(file), str(file))
    return sqlite_url(workspace)


def sqlite_url(workspace: Path) -> URL:
    """Return the address of the database in the workspace."""
    return URL.create("sqlite", database=str(workspace / DATABASE_FILE))


def parse_url(address: str, where: str) -> URL:
    """Read an address; ``postgresql://`` and ``postgres://`` mean psycopg. The address is never repeated.

    Raises
    ------
    CatalogError
        When it is none.
    """
    try:
        url = make_url(address)
    except (ArgumentError, ValueError):
        raise CatalogError(
            "this is no address of a database",
            file=where,
            remedy="write postgresql://USER@HOST/DATABASE; a password may stand in PGPASSWORD or ~/.pgpass",
        ) from None
    if url.drivername in ("postgres", "postgresql"):
        url = url.set(drivername="postgresql+psycopg")
    return url


def state_location(workspace: Path, url: URL) -> None:
    """Write ``catalog.yaml``, without a password; remove it for the database in the workspace."""
    file = workspace / LOCATION_FILE
    if url == sqlite_url(workspace):
        file.unlink(missing_ok=True)
        return
    _replace(file, f"url: {address_without_password(url)}\n")


def is_workspace(folder: Path) -> bool:
    """Return True when a folder has, or points to, a catalog."""
    return any((folder / name).exists() for name in (DATABASE_FILE, LOCATION_FILE, ID_FILE))


def open_database(workspace: Path) -> Database:
    """Open the database of a workspace.

    Raises
    ------
    CatalogError
        When it cannot be used, was moved away, or belongs to another folder.
    """
    database = Database(database_url(workspace))
    marks = database.read(read_marks)
    if marks.moved:
        raise _moved(marks.moved, database.place)
    if database.backend.is_shared and not (marks.workspace and marks.workspace == _id_of(workspace)):
        _join(workspace, database, marks)
    return database


class Marks(NamedTuple):
    """What a database says of itself: the name of its folder, where it went, whether it knows stores."""

    workspace: str
    moved: str
    has_stores: bool


def read_marks(session: Session) -> Marks:
    """Return what a database says of itself."""
    rows = session.scalars(select(SettingRow).where(SettingRow.name.in_((WORKSPACE_SETTING, MOVED_SETTING))))
    values = {row.name: row.value for row in rows}
    some = session.scalar(select(StoreRow.id).limit(1))
    return Marks(values.get(WORKSPACE_SETTING, ""), values.get(MOVED_SETTING, ""), some is not None)


def require_not_moved(session: Session) -> None:
    """Refuse to begin work in a database whose catalog was moved since it was opened."""
    if row := session.get(SettingRow, MOVED_SETTING):
        raise _moved(row.value)


def _moved(where: str, place: str = "") -> CatalogError:
    return CatalogError(
        f"this catalog was moved: {where}",
        file=place,
        remedy=f"state the address it has now in {CATALOG_VARIABLE} or {LOCATION_FILE}; a move that was "
        "interrupted is finished by the same 'inflight catalog move'",
    )


def join(workspace: Path, name: str) -> None:
    """Write the name of the folder into it."""
    _replace(workspace / ID_FILE, f"{name}\n")


def _join(workspace: Path, database: Database, marks: Marks) -> None:
    """Bring a folder and a database together of which one is new; refuse any others."""
    here, stores = _id_of(workspace), (workspace / "stores").glob("*/*.zarr")
    filled = (workspace / DATABASE_FILE).exists() or any(stores)
    there = marks.workspace
    if not (there or filled):
        there = database.write(name_workspace, here or uuid.uuid4().hex)
    if (here and there != here) or (marks.has_stores and not here) or not there:
        what = (
            "the database is that of another folder"
            if there
            else "the folder has data, the database has none"
        )
        raise WorkspaceError(
            f"{workspace} and this database do not belong together: {what}",
            file=database.place,
            remedy="see that the folder which all machines share is mounted; 'inflight catalog move' brings "
            "a catalog into a database",
        )
    join(workspace, there)


def _id_of(workspace: Path) -> str:
    file = workspace / ID_FILE
    return file.read_text("utf-8").strip() if file.exists() else ""


def name_workspace(session: Session, name: str) -> str:
    """Give the database the name of its folder, unless it has one; return what it has."""
    row = session.get(SettingRow, WORKSPACE_SETTING)
    if row is None:
        session.add(SettingRow(name=WORKSPACE_SETTING, value=name))
    return row.value if row else name


def _replace(file: Path, content: str) -> None:
    new = file.with_name(f".{file.name}-{uuid.uuid4().hex[:8]}")
    new.write_text(content, encoding="utf-8")
    new.replace(file)


def _stated_in(file: Path) -> str:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe").load(file.read_text(encoding="utf-8"))
    except (YAMLError, OSError) as error:
        raise CatalogError(f"the file cannot be read: {type(error).__name__}", file=str(file)) from None
    if not isinstance(content, dict) or set(content) != {"url"} or not isinstance(content["url"], str):
        raise CatalogError(
            "the file must hold one key, 'url'", file=str(file), remedy="url: postgresql://USER@HOST/DATABASE"
        )
    return str(content["url"])
