"""The database behind the catalog: opened, migrated, and written in short exclusive transactions."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, Engine, NullPool, create_engine, event, text
from sqlalchemy.exc import DatabaseError, OperationalError
from sqlalchemy.orm import Session

from inflight.errors import CatalogError, StorageError

#: Newest migration; a test holds it equal to the head of ``migrations/versions``.
HEAD: Final = "0005"
#: How long a writer waits for another one, ms.
BUSY_TIMEOUT_MS: Final = 30_000


class Database:
    """Sessions on one database; safe to use from several threads, each session in one.

    Parameters
    ----------
    url : str
        SQLAlchemy URL; SQLite is the embedded default.

    Raises
    ------
    CatalogError
        When the database was made by a newer version, or is none.
    """

    def __init__(self, url: str) -> None:
        # No pool: a connection costs 0.2 ms, and none may be inherited by a forked worker.
        self.engine = create_engine(url, poolclass=NullPool)
        if self.engine.dialect.name == "sqlite":
            event.listen(self.engine, "do_connect", _open_read_only)
            event.listen(self.engine, "connect", _prepare_sqlite)
            event.listen(self.engine, "begin", _begin_sqlite)
        self._writing = self.engine.execution_options(inflight_writes=True)
        try:
            self._migrate()
        except DatabaseError as error:
            raise _catalog_error(error, url) from error

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Open a session that sees one consistent state, whatever is published meanwhile."""
        with _database_errors(self.engine), Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Open the only writing session; it commits at the end, or nothing happened.

        Raises
        ------
        StorageError
            When another writer holds the database for longer than the busy timeout, or the disk is full.
        """
        with (
            _database_errors(self.engine),
            Session(self._writing, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session

    def _migrate(self) -> None:
        with self.engine.connect() as connection:
            if self.engine.dialect.has_table(connection, "alembic_version"):
                version = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
                if version == HEAD:
                    return
        # Imported here because opening an up-to-date catalog should not pay for Alembic.
        from alembic import command
        from alembic.config import Config
        from alembic.util.exc import CommandError

        config = Config()
        config.set_main_option("script_location", str(Path(__file__).resolve().parent / "migrations"))
        with self._writing.begin() as connection:
            config.attributes["connection"] = connection
            try:
                command.upgrade(config, "head")
            except CommandError as error:
                raise CatalogError(
                    f"the catalog's database cannot be migrated: {error}",
                    remedy="install a newer version of inflight",
                ) from error


def _open_read_only(
    _dialect: Any, _record: Any, arguments: Sequence[Any], _options: Any
) -> sqlite3.Connection | None:
    """Open a database that this user cannot write, for reading; None leaves any other to SQLAlchemy.

    A write-ahead log needs a file of its own next to the database even to read. Where none can be made and
    no process writes at this moment, the database is read as a file that does not change.
    """
    path = Path(str(arguments[0])) if arguments else Path()
    if not _is_read_only(path):
        return None
    log, shared = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    in_use = log.exists() and (shared.exists() or log.stat().st_size > 0)
    fixed = "" if in_use else "&immutable=1"
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro{fixed}", uri=True, check_same_thread=False)


def _prepare_sqlite(connection: sqlite3.Connection, _record: Any) -> None:
    connection.isolation_level = None  # the driver's own BEGIN is the deferred one
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
    if not _is_read_only(Path(cursor.execute("PRAGMA database_list").fetchone()[2])):
        # With the write-ahead log readers go on while one writes. The switch ignores the busy timeout.
        deadline = time.monotonic() + BUSY_TIMEOUT_MS / 1000
        while cursor.execute("PRAGMA journal_mode").fetchone()[0] != "wal":
            try:
                cursor.execute("PRAGMA journal_mode=WAL")
            except sqlite3.OperationalError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.05)
    cursor.execute("PRAGMA synchronous=FULL")  # a published day survives a power failure
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _is_read_only(path: Path) -> bool:
    """Return True when a database is there and this user can only read it."""
    return path.is_file() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK))


def _begin_sqlite(connection: Connection) -> None:
    # A transaction that reads first and writes later would fail at once when another one wrote in
    # between, without waiting; a writer therefore takes the lock at its beginning.
    writes = connection.get_execution_options().get("inflight_writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


@contextmanager
def _database_errors(engine: Engine) -> Iterator[None]:
    """Turn what the driver raises into a `CatalogError`."""
    try:
        yield
    except DatabaseError as error:
        raise _catalog_error(error, str(engine.url)) from error


def _catalog_error(error: DatabaseError, url: str) -> CatalogError:
    reason = str(error.orig)
    if isinstance(error, OperationalError) and any(
        word in reason for word in ("locked", "full", "disk", "readonly", "unable to open")
    ):
        return StorageError(
            f"the catalog's database refused: {reason}",
            file=url,
            remedy="free space, make the workspace writable or wait for the other writer, then run again",
        )
    return CatalogError(
        f"the catalog's database failed: {reason}", file=url, remedy="restore the workspace's catalog.db"
    )
