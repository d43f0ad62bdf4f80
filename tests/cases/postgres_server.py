"""A PostgreSQL server of the tests' own, in a temporary folder, started once; each test has a database."""

from __future__ import annotations

import ctypes
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import pytest

#: Set where the absence of a server is a failure and no reason to skip.
NEEDED = "INFLIGHT_NEEDS_POSTGRES"
PASSWORD = "correct horse"
#: Speed instead of safety against a power failure, which no test makes.
SETTINGS = {
    "fsync": "off",
    "synchronous_commit": "off",
    "full_page_writes": "off",
    "max_connections": "60",
    "shared_buffers": "32MB",
    "autovacuum": "off",
    "logging_collector": "off",
}


class PostgresServer:
    """One server: over a unix socket without a password, over 127.0.0.1 with one."""

    def __init__(self, programs: Path) -> None:
        self._programs = programs
        self._user = _unprivileged()
        self._folder = Path(tempfile.mkdtemp(prefix="inflight-postgres-", dir=_quick_folder()))
        if self._user:
            os.chown(self._folder, pwd.getpwnam(self._user).pw_uid, -1)
        self.port = _free_port()
        self._numbers = count()
        self._process: subprocess.Popen[bytes] | None = None
        self._run("initdb", "-D", str(self._data), "-U", "inflight", "-E", "UTF8", "--no-sync", "-A", "trust")
        access = "local all all trust\nhost all all 127.0.0.1/32 scram-sha-256\n"
        (self._data / "pg_hba.conf").write_text(access)
        self.start()

    @property
    def _data(self) -> Path:
        return self._folder / "data"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        settings = [f"-c{name}={value}" for name, value in SETTINGS.items()]
        place = ["-D", str(self._data), "-k", str(self._folder), "-p", str(self.port), "-h", "127.0.0.1"]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                [self._programs / "postgres", *place, *settings],
                stdout=log,
                stderr=log,
                user=self._user,
                preexec_fn=_end_with_parent,  # noqa: PLW1509 - it calls the kernel alone
            )
        deadline = time.monotonic() + 60
        while True:
            try:
                self.execute("SELECT 1")
            except Exception as error:
                ended = self._process.poll() is not None
                if ended or time.monotonic() > deadline:
                    raise RuntimeError((self._folder / "log").read_text()) from error
                time.sleep(0.02)
            else:
                return

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """Stop it: SIGINT ends all sessions, SIGQUIT is a crash."""
        assert self._process is not None
        self._process.send_signal(how)
        self._process.wait(timeout=60)

    def remove(self) -> None:
        """Stop it for good."""
        self.stop(signal.SIGQUIT)
        shutil.rmtree(self._folder, ignore_errors=True)

    def execute(self, statement: str, database: str = "postgres") -> list[tuple]:
        """Execute one statement outside a transaction; return its rows."""
        import psycopg

        with psycopg.connect(
            host=str(self._folder), port=self.port, user="inflight", dbname=database, autocommit=True
        ) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    @contextmanager
    def database(self, template: str = "template1") -> Iterator[str]:
        """Make a database for a while; give its name."""
        name = f"catalog_{next(self._numbers)}"
        self.execute(f"CREATE DATABASE {name} TEMPLATE {template} STRATEGY FILE_COPY")
        yield name
        self.execute(f"DROP DATABASE {name} WITH (FORCE)")

    def url(self, database: str) -> str:
        """Return the address of a database over the unix socket."""
        return f"postgresql://inflight@/{database}?host={self._folder}&port={self.port}"

    def tcp_url(self, database: str, password: str = PASSWORD, port: int | None = None) -> str:
        """Return the address of a database over TCP, with a password."""
        self.execute(f"ALTER ROLE inflight PASSWORD '{PASSWORD}'")
        secret = password.replace(" ", "%20")
        return f"postgresql://inflight:{secret}@127.0.0.1:{port or self.port}/{database}"

    def _run(self, program: str, *arguments: str) -> None:
        subprocess.run(
            [self._programs / program, *arguments],
            check=True,
            capture_output=True,
            user=self._user,
            cwd=self._folder,
        )


def running_server() -> Iterator[PostgresServer]:
    """Start a server for a session of tests; skip them, or fail where it is needed, when there is none."""
    programs = server_programs()
    if programs is None:
        if os.environ.get(NEEDED):
            pytest.fail(f"{NEEDED} is set, and there is no PostgreSQL server program")
        pytest.skip("there is no PostgreSQL server program (Debian: apt-get install postgresql)")
    if not os.environ.get(NEEDED):
        pytest.importorskip("psycopg", reason="psycopg is not installed")
    server = PostgresServer(programs)
    yield server
    server.remove()


def server_programs() -> Path | None:
    """Return the folder of ``initdb`` and ``postgres``, the newest where there are several."""
    found = shutil.which("postgres")
    if found and shutil.which("initdb"):
        return Path(found).resolve().parent
    installed = Path("/usr/lib/postgresql").glob("*/bin/postgres")
    return max((path.parent for path in installed), key=lambda path: int(path.parts[-2]), default=None)


def _quick_folder() -> str:
    """Return a folder that every user can reach, in memory if possible; a socket's path must be short."""
    return next(folder for folder in ("/dev/shm", "/tmp") if os.access(folder, os.W_OK))


def _unprivileged() -> str | None:
    """Return the user to run the server as; None for this one. It refuses to run as root."""
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return "postgres" if "postgres" in known else "nobody"


def _end_with_parent() -> None:
    """Let the kernel stop the server when the tests are killed."""
    pr_set_pdeathsig = 1
    ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGQUIT)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
