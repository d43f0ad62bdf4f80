"""What differs between the databases that can be behind the catalog, `Sqlite` and `Postgres`.

`Database` is written once and asks its backend how to connect, how a writer keeps others out, which failures
may pass, and what the clock says.
"""

from __future__ import annotations

import hashlib
import os
import random
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from sqlalchemy import (
    URL,
    ColumnElement,
    Connection,
    Engine,
    Float,
    NullPool,
    cast,
    create_engine,
    event,
    func,
    literal_column,
    text,
)
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session

from inflight.errors import CatalogError, StorageError, ValidityError

#: How long a writer waits for another one, ms.
BUSY_TIMEOUT_MS: Final = 30_000
#: How long a program that runs waits for a server that is gone, s.
PATIENCE_S: Final = 60.0
#: A run is taken for alive so long after its last sign of life, s; it gives one four times as often.
LEASE_S: Final = 60.0
#: After which the server ends a transaction whose writer does nothing, ms: of a process that was stopped.
_IDLE_MS: Final = 600_000

#: PostgreSQL: serialisation failure, deadlock, server shutting down or starting, too many connections.
_PASSING: Final = ("40001", "40P01", "57P01", "57P02", "57P03", "53300")


class Backend:
    """One kind of database.

    Attributes
    ----------
    lease_s : float
        How long a run is taken for alive after its last sign of life; 0 where its process is looked at.
    clock : SQL expression
        Seconds since 1970 on the clock of the database.
    is_shared : bool
        True when the database lies elsewhere than the workspace, so that the two could be confused.
    """

    lease_s: float = 0.0
    clock: ColumnElement[float]
    is_shared = False

    def engine(self, url: URL) -> Engine:
        """Return the engine that makes connections, none of them kept."""
        raise NotImplementedError

    def begin_writing(self, session: Session, datasets: Iterable[str] | None) -> str:
        """Begin a writing transaction and keep out the others: all, or those of the same datasets.

        Returns
        -------
        str
            What `has_committed` knows the transaction by; empty where a commit cannot be in doubt.
        """
        return ""

    def has_committed(self, session: Session, transaction: str) -> bool:
        """Return True when a transaction whose commit was not answered was committed."""
        return False

    def may_pass(self, error: DBAPIError) -> bool:
        """Return True when the same transaction may succeed if it is tried again."""
        return False

    def pauses(self) -> Iterator[float]:
        """Yield the seconds to wait before each new attempt, until it is time to give up."""
        return iter(())

    def number_on(self, session: Session, table: str) -> None:
        """Let new rows of a table be numbered behind those that were copied into it with their numbers."""

    def refusal(self, error: DBAPIError, place: str, waited_s: float) -> CatalogError:
        """Return the error of the catalog for one of the driver, after having tried for so long."""
        raise NotImplementedError


def backend_of(url: URL) -> Backend:
    """Return the backend of a database.

    Raises
    ------
    CatalogError
        When the catalog cannot be kept in such a database.
    """
    name = url.get_backend_name()
    if name not in _BACKENDS:
        raise CatalogError(
            f"a catalog cannot be kept in {name!r}", remedy="use postgresql://... or sqlite:///..."
        )
    return _BACKENDS[name]()


class Sqlite(Backend):
    """A file in the workspace: nothing to install, many readers beside one writer of one machine."""

    clock = literal_column("(julianday('now') - 2440587.5) * 86400.0", Float)

    def engine(self, url: URL) -> Engine:
        """Return an engine whose transactions take the write lock at their beginning."""
        # No pool: a connection costs 0.2 ms, and none may be inherited by a forked worker.
        engine = create_engine(url, poolclass=NullPool)
        event.listen(engine, "do_connect", _open_read_only)
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine

    def refusal(self, error: DBAPIError, place: str, waited_s: float) -> CatalogError:
        """Tell a full or locked disk from a database that is damaged."""
        del waited_s
        reason = str(error.orig)
        if isinstance(error, OperationalError) and any(
            word in reason for word in ("locked", "full", "disk", "readonly", "unable to open")
        ):
            return StorageError(
                f"the catalog's database refused: {reason}",
                file=place,
                remedy="free space, make the workspace writable or wait for the other writer, then run again",
            )
        return CatalogError(
            f"the catalog's database failed: {reason}",
            file=place,
            remedy="restore the workspace's catalog.db",
        )


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


class Postgres(Backend):
    """A server: many writers on several machines.

    A writer takes advisory locks before it reads anything, and each of its statements sees what others have
    committed (READ COMMITTED): under the lock that is one consistent state. A reader sees the state of its
    first statement (REPEATABLE READ).
    """

    lease_s = LEASE_S
    clock = cast(func.extract("epoch", func.clock_timestamp()), Float)
    is_shared = True

    def engine(self, url: URL) -> Engine:
        """Return an engine of psycopg.

        Raises
        ------
        CatalogError
            When psycopg is not installed.
        """
        # A server that vanished without a word, and a client that did, are noticed within half a minute.
        server_side = {
            "lock_timeout": BUSY_TIMEOUT_MS,
            "tcp_keepalives_idle": 10,
            "tcp_keepalives_interval": 5,
            "tcp_keepalives_count": 3,
        }
        options: dict[str, Any] = {
            "connect_timeout": 10,
            "application_name": "inflight",
            "keepalives_idle": 10,
            "keepalives_interval": 5,
            "keepalives_count": 3,
            "tcp_user_timeout": 25_000,
            "options": " ".join(f"-c {name}={value}" for name, value in server_side.items()),
        }
        stated = {name: value for name, value in options.items() if name not in url.query}
        try:
            engine = create_engine(
                url.set(drivername="postgresql+psycopg"), poolclass=NullPool, connect_args=stated
            )
        except ModuleNotFoundError as error:
            raise CatalogError(
                "the catalog is in PostgreSQL, and its driver psycopg is not installed",
                remedy="pip install 'inflight-magnetometer[postgres]'",
            ) from error
        event.listen(engine, "begin", _begin_postgres)
        return engine

    def begin_writing(self, session: Session, datasets: Iterable[str] | None) -> str:
        """Take the lock of the whole catalog, or share it and take those of datasets."""
        names = None if datasets is None else sorted(set(datasets))
        lock = "pg_advisory_xact_lock" if names is None else "pg_advisory_xact_lock_shared"
        begun = (
            # A published day survives a power failure.
            "SELECT set_config('synchronous_commit', 'on', true),"
            f" set_config('idle_in_transaction_session_timeout', '{_IDLE_MS}', true),"
            f" pg_current_xact_id()::text AS id, {lock}(:catalog)"
        )
        transaction = session.execute(text(begun), {"catalog": _lock_of("")}).one().id
        # In one order everywhere: two writers of two datasets cannot wait for each other.
        for key in sorted(map(_lock_of, names or ())):
            session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": key})
        return str(transaction)

    def has_committed(self, session: Session, transaction: str) -> bool:
        """Ask the server what became of a transaction; wait while it still is at it."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            status = session.scalar(text("SELECT pg_xact_status(CAST(:id AS xid8))"), {"id": transaction})
            if status != "in progress" or time.monotonic() > deadline:
                return bool(status == "committed")
            time.sleep(0.1)

    def may_pass(self, error: DBAPIError) -> bool:
        """Serialisation failures, deadlocks, and a server that is gone."""
        state = getattr(error.orig, "sqlstate", None)
        if state is None:  # the server was not heard at all, or the driver refused what it was given
            return isinstance(error, OperationalError) or error.connection_invalidated
        return state in _PASSING or state.startswith("08")

    def pauses(self) -> Iterator[float]:
        """Longer and longer ones, for a minute."""
        deadline, pause = time.monotonic() + PATIENCE_S, 0.05
        while time.monotonic() < deadline:
            yield pause * random.uniform(0.5, 1.5)
            pause = min(2 * pause, 2.0)

    def number_on(self, session: Session, table: str) -> None:
        """Set the sequence behind the column ``id``."""
        session.execute(
            text(
                "SELECT setval(pg_get_serial_sequence(:name, 'id'), coalesce(max(id), 1), count(*) > 0)"
                f' FROM "{table}"'
            ),
            {"name": f'"{table}"'},
        )

    def refusal(self, error: DBAPIError, place: str, waited_s: float) -> CatalogError:
        """Tell what can pass from what the administrator has to mend."""
        reason = " ".join(str(error.orig).split())
        state = getattr(error.orig, "sqlstate", None) or ""
        if state == "23P01":
            return ValidityError(
                f"the database refuses validities of one table name and context that overlap: {reason}",
                file=place,
                remedy="choose a span that is free, or supersede the older table",
            )
        if state == "55P03":
            return StorageError(
                f"another writer held the catalog for longer than {BUSY_TIMEOUT_MS // 1000} s",
                file=place,
                remedy="wait for it, then run again",
            )
        if state in {"42501", "25006", "0A000", "58P01"}:
            return StorageError(
                f"the catalog's database refused: {reason}",
                file=place,
                remedy="ask its administrator: the user must own the database, which needs btree_gist",
            )
        if state.startswith("53") or self.may_pass(error):
            since = f"has not answered for {waited_s:.0f} s" if waited_s >= 1 else "cannot be used"
            return StorageError(
                f"the catalog's database {since}: {reason}",
                file=place,
                remedy="see that the server runs, and that host, user and password (PGPASSWORD or ~/.pgpass) "
                "are right; then run again: what is published is unchanged, what was finished is taken over",
            )
        return CatalogError(
            f"the catalog's database failed: {reason}", file=place, remedy="ask its administrator"
        )


def _begin_postgres(connection: Connection) -> None:
    if not connection.get_execution_options().get("inflight_writes", False):
        connection.exec_driver_sql("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY")


def _lock_of(name: str) -> int:
    """Return the 64-bit number that stands for the catalog (``""``) or one of its datasets."""
    digest = hashlib.sha256(f"inflight catalog {name}".encode()).digest()
    return int.from_bytes(digest[:8], "big", signed=True)


_BACKENDS: Final[dict[str, type[Backend]]] = {"sqlite": Sqlite, "postgresql": Postgres}
