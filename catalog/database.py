"""The database behind the catalog: opened, migrated, asked and written in short transactions.

What is asked or written is a function of a session, so that it can be done once more when the database
ended the transaction: `Database.read` and `Database.write` call it.
"""

from __future__ import annotations

import datetime as dt
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, Concatenate, Final, ParamSpec, TypeVar

from sqlalchemy import URL, Connection, Engine, func, make_url, select, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from inflight.catalog.backends import backend_of
from inflight.errors import CatalogError

#: Newest migration; a test holds it equal to the head of ``migrations/versions``.
HEAD: Final = "0006"
#: Smallest difference of times that are recorded.
_TICK: Final = dt.timedelta(microseconds=1)

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class Database:
    """Sessions on one database; safe to use from several threads, each session in one.

    Parameters
    ----------
    url : str or URL
        SQLAlchemy URL; SQLite is the embedded default, PostgreSQL the other.

    Raises
    ------
    CatalogError
        When the database was made by a newer version, is none, or its driver is not there.
    StorageError
        When its server does not answer.
    """

    def __init__(self, url: str | URL) -> None:
        address = make_url(url)
        self.backend = backend_of(address)
        self.engine = _engine_of(address)
        self._writing = self.engine.execution_options(inflight_writes=True)
        # Who opens a catalog is told at once that its server is gone; who is at work waits for it.
        self._is_patient = False
        self._until_answered(self._migrate)

    @property
    def place(self) -> str:
        """The address, without its password."""
        return address_without_password(self.engine.url)

    def read(
        self,
        ask: Callable[Concatenate[Session, Arguments], Answer],
        /,
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        """Call `ask` with a session that sees one consistent state, whatever is published meanwhile.

        Raises
        ------
        StorageError
            When the server is gone and does not come back.
        """

        def attempt() -> Answer:
            with Session(self.engine, expire_on_commit=False) as session:
                return ask(session, *arguments, **options)

        return self._until_answered(attempt)

    def write(
        self,
        change: Callable[Concatenate[Session, Arguments], Answer],
        /,
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        """Call `change` with the only writing session; it commits at the end, or nothing happened.

        It is called again when the database ended its transaction: what it does besides is done twice.

        Raises
        ------
        StorageError
            When another writer holds the database for longer than the busy timeout, the disk is full or the
            server is gone.
        """
        return self._until_answered(lambda: self._written(None, change, *arguments, **options))

    def write_to(
        self,
        datasets: Iterable[str],
        change: Callable[Concatenate[Session, Arguments], Answer],
        /,
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        """Like `write`, but keep out only those who write to the same datasets, where the database can."""
        names = tuple(datasets)
        return self._until_answered(lambda: self._written(names, change, *arguments, **options))

    def write_beside(
        self,
        change: Callable[Concatenate[Session, Arguments], Answer],
        /,
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        """Like `write`, for one statement that neither needs nor disturbs what other writers do."""

        def attempt() -> Answer:
            with Session(self._writing) as session, session.begin():
                return change(session, *arguments, **options)

        return self._until_answered(attempt)

    def _written(
        self,
        datasets: tuple[str, ...] | None,
        change: Callable[Concatenate[Session, Arguments], Answer],
        *arguments: Arguments.args,
        **options: Arguments.kwargs,
    ) -> Answer:
        with Session(self._writing, expire_on_commit=False) as session:
            transaction = self.backend.begin_writing(session, datasets)
            answer = change(session, *arguments, **options)
            session.flush()
            try:
                session.commit()
            except DBAPIError:
                # The connection may have broken after the server had committed.
                if not (transaction and self.read(self.backend.has_committed, transaction)):
                    raise
        return answer

    def _until_answered(self, attempt: Callable[[], Answer]) -> Answer:
        """Try again while the failure may pass; turn what the driver raises into a `CatalogError`."""
        pauses, begun = self.backend.pauses(), time.monotonic()
        while True:
            try:
                answer = attempt()
            except DBAPIError as error:
                pause = next(pauses, None) if self._is_patient and self.backend.may_pass(error) else None
                if pause is None:
                    # Waited for in vain once, it is asked only once from now on, until it answers.
                    self._is_patient = self._is_patient and not self.backend.may_pass(error)
                    waited_s = time.monotonic() - begun
                    raise self.backend.refusal(error, self.place, waited_s) from error
                time.sleep(pause)
            else:
                self._is_patient = True
                return answer

    def _migrate(self) -> None:
        with self.engine.connect() as connection:
            if self._version(connection) == HEAD:
                return
        # Imported here because opening an up-to-date catalog should not pay for Alembic.
        from alembic import command
        from alembic.config import Config
        from alembic.util.exc import CommandError

        config = Config()
        config.set_main_option("script_location", str(Path(__file__).resolve().parent / "migrations"))
        with Session(self._writing) as session, session.begin():
            self.backend.begin_writing(session, None)
            config.attributes["connection"] = session.connection()
            try:
                command.upgrade(config, "head")
            except CommandError as error:
                raise CatalogError(
                    f"the catalog's database cannot be migrated: {error}",
                    remedy="install a newer version of inflight",
                ) from error

    def _version(self, connection: Connection) -> str | None:
        if not self.engine.dialect.has_table(connection, "alembic_version"):
            return None
        return connection.execute(text("SELECT version_num FROM alembic_version")).scalar()


@lru_cache(maxsize=16)
def _engine_of(address: URL) -> Engine:
    """Return the engine of a database, which keeps no connection, but what it compiled of queries.

    A process opens its catalog again and again: compiling costs more than asking.
    """
    return backend_of(address).engine(address)


def time_in_order(session: Session, column: Any) -> dt.datetime:
    """Return the present time, or one right behind the newest of a column (ISO 8601, UTC) when that is later.

    What is recorded keeps its order when the clock of a machine is set back.
    """
    now, newest = present_time(), session.scalar(select(func.max(column)))
    return now if newest is None else max(now, dt.datetime.fromisoformat(newest) + _TICK)


def present_time() -> dt.datetime:
    """Return what the clock of this machine says, UTC."""
    return dt.datetime.now(dt.UTC)


def address_without_password(url: URL) -> str:
    """Return a URL as it may be shown and written: without its passwords."""
    plain = url._replace(password=None).difference_update_query(["password", "sslpassword"])
    return plain.render_as_string(hide_password=False)
