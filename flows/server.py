"""The embedded Prefect server: a process of its own, started while the command gets ready, ended with it.

Takes the Prefect home of a workspace and the environment of `inflight.flows.launch`; makes the address that
flows report to. Prefect starts such a server by itself at the first flow, after it has imported the whole
server into the caller as well; here both begin at once, and the caller imports the client only.

A new home takes its database from a copy that was migrated once on this machine: migrating takes as long as
all the rest of a start. What a server would do at each start with a database that is as it should be is left
out: to look whether it has to be migrated, and, while it is small, to look for old events.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from inflight.errors import WorkerError

#: How long a server may take to answer, and between two questions, s.
_PATIENCE_S, _PAUSE_S = 120.0, 0.05
#: Up to this size a database keeps its old events, bytes: those of some hundred runs.
_SMALL = 64_000_000
#: No kind of rows to remove, as Prefect reads its list.
_REMOVE_NOTHING = ","

#: What the process of the server runs. It ends with whoever started it, for then its standard input does: a
#: command that is killed cannot end it. A fifth of its start was Python looking through all that is imported
#: for what could go.
_SERVE = """
import gc, os, sys, threading

def end_with_parent():
    sys.stdin.buffer.read()
    os._exit(0)

threading.Thread(target=end_with_parent, daemon=True).start()
gc.disable()
import uvicorn
from prefect.server.api.server import create_app

def application():
    made = create_app()
    gc.freeze()
    gc.enable()
    return made

uvicorn.run(application, factory=True, host="127.0.0.1", port=int(sys.argv[1]), log_level="error",
            lifespan="on")
"""

#: Servers of this process, by their home.
_running: dict[str, EmbeddedServer] = {}


class EmbeddedServer:
    """A server of this process.

    Attributes
    ----------
    url : str
        Its API.
    """

    def __init__(self, home: Path, environment: Mapping[str, str]) -> None:
        port = _free_port()
        self.url = f"http://127.0.0.1:{port}/api"
        home.mkdir(parents=True, exist_ok=True)
        prepared = _prepare_database(home, environment)
        self._mark = None if prepared else _mark_of(home)
        self._log = home / "server.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _SERVE, str(port)],
                env=_server_environment(environment) | _not_at_start(home, prepared=prepared),
                # Closed by the system when this process ends, however it does.
                stdin=subprocess.PIPE,
                # What it says while it is ended under way is no news of the command.
                stdout=log,
                stderr=log,
                # Ctrl-C is for the command: its flow tells the server that it was interrupted.
                start_new_session=True,
            )

    def wait(self) -> None:
        """Return when the server answers.

        Raises
        ------
        WorkerError
            When it ends, or does not answer in time.
        """
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until and self._process.poll() is None:
            with (
                contextlib.suppress(urllib.error.URLError, ConnectionError, TimeoutError),
                urllib.request.urlopen(f"{self.url}/health", timeout=5) as answer,
            ):
                if answer.status == 200:
                    if self._mark is not None:
                        self._mark.touch()
                    return
            time.sleep(_PAUSE_S)
        raise WorkerError(
            f"the embedded Prefect server does not answer; its log is {self._log}",
            remedy="run again with '--no-prefect', or name a server with PREFECT_API_URL",
        )

    def stop(self) -> None:
        """End the server."""
        self._process.terminate()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def embedded_server(home: Path, environment: Mapping[str, str]) -> EmbeddedServer:
    """Return the server of a home, started at the first call; it ends with this process."""
    key = str(home.resolve())
    found = _running.get(key)
    if found is None or found._process.poll() is not None:
        found = _running[key] = EmbeddedServer(home, environment)
        atexit.register(found.stop)
    return found


def is_own(url: str) -> bool:
    """Return True for the address of a server that this process started."""
    return any(server.url == url for server in _running.values())


def _server_environment(environment: Mapping[str, str]) -> dict[str, str]:
    given = {name: value for name, value in os.environ.items() if name != "PREFECT_API_URL"}
    own = {"PREFECT__SERVER_EPHEMERAL": "1", "PREFECT__SERVER_FINAL": "1"}
    return {**given, **environment, **own}


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _not_at_start(home: Path, *, prepared: bool) -> dict[str, str]:
    """Return the settings that leave out of a server's start what its database does not need."""
    left_out = {}
    # A database of the user's own is elsewhere: its server looks.
    named = any(name.startswith(("PREFECT_SERVER_DATABASE_", "PREFECT_API_DATABASE_")) for name in os.environ)
    if prepared and not named:
        left_out["PREFECT_SERVER_DATABASE_MIGRATE_ON_START"] = "false"
    database = home / "prefect.db"
    if not database.exists() or database.stat().st_size < _SMALL:
        left_out["PREFECT_SERVER_SERVICES_DB_VACUUM_ENABLED"] = _REMOVE_NOTHING
    return {name: value for name, value in left_out.items() if name not in os.environ}


def _mark_of(home: Path) -> Path:
    """Return the file that is there when the database of a home has the tables of this Prefect."""
    return home / f"tables-of-prefect-{version('prefect')}"


def _prepare_database(home: Path, environment: Mapping[str, str]) -> bool:
    """Give a new home a copy of the migrated database.

    Returns
    -------
    bool
        Whether its tables are known to be those of this Prefect; otherwise the server looks, and migrates.
    """
    mark = _mark_of(home)
    if (home / "prefect.db").exists():
        return mark.exists()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "inflight"
    kept = cache / f"prefect-{version('prefect')}.db"
    try:
        if not kept.exists():
            cache.mkdir(parents=True, exist_ok=True)
            _migrate(kept, environment)
        part = home / f"prefect.db.{os.getpid()}"
        shutil.copyfile(kept, part)
        part.rename(home / "prefect.db")
        mark.touch()
    except (OSError, subprocess.CalledProcessError):
        return False
    return True


def _migrate(kept: Path, environment: Mapping[str, str]) -> None:
    """Make an empty database with all tables, visible when it is whole."""
    with tempfile.TemporaryDirectory(dir=kept.parent) as folder:
        subprocess.run(
            [sys.executable, "-m", "prefect", "server", "database", "upgrade", "-y"],
            env=_server_environment(environment) | {"PREFECT_HOME": folder},
            check=True,
            capture_output=True,
        )
        (Path(folder) / "prefect.db").rename(kept)
