"""Processes of their own for work that is to be killed, begun in milliseconds, and what they leave behind.

Run as a program, this module imports the project once and forks a child for each piece of work that
it is told of on standard input: a fresh process in everything but the seconds of importing.
"""

import gc
import json
import os
import resource
import signal
import subprocess
import sys
import traceback
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit code (negative for a signal), its report or its error."""

    code: int
    report: dict
    error: dict


class Stage:
    """Begins processes; `close` ends them all."""

    def __init__(self):
        # The project that is tested here, wherever it is imported from.
        path = os.pathsep.join([str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = os.environ | {"PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, "-u", str(Path(__file__).resolve())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self._outcomes = {}

    def begin(self, work, workspace, *, kill_at="", file_limit=0, **options):
        """Begin a piece of `WORK` in a workspace; return the pid of its process."""
        outcome = Path(workspace).parent / f"outcome-{len(self._outcomes)}.json"
        told = {"work": work, "workspace": str(workspace), "outcome": str(outcome), "options": options}
        pid = self._ask(told | {"kill_at": kill_at, "file_limit": file_limit})
        self._outcomes[pid] = outcome
        return pid

    def ended(self, pid):
        """Wait for a process and return how it ended."""
        code, outcome = self._ask({"wait": pid}), self._outcomes[pid]
        told = json.loads(outcome.read_text()) if outcome.exists() else {}
        return Ended(code, told.get("report", {}), told.get("error", {}))

    def kill(self, pid):
        """Kill a process that was begun, unless it has ended; return how it ended."""
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        return self.ended(pid)

    def run(self, work, workspace, **options):
        """Begin and wait."""
        return self.ended(self.begin(work, workspace, **options))

    def close(self):
        self._server.stdin.close()
        self._server.wait(timeout=60)

    def _ask(self, told):
        self._server.stdin.write(json.dumps(told) + "\n")
        self._server.stdin.flush()
        return json.loads(self._server.stdout.readline())


def _client(address):
    if not address:
        return None
    from distributed import Client

    return Client(address, set_as_default=False)


def _ingest(workspace, scheduler=None, **options):
    from inflight.catalog import Catalog, Workspace
    from inflight.tasks.archive import ingest

    place = Workspace.open(workspace)
    return ingest(Catalog(workspace), place.mission(), place.data, client=_client(scheduler), **options)


def _reprocess(workspace, scheduler=None, **settings):
    from inflight.catalog import Catalog, Workspace
    from inflight.tasks.pipelines import ReprocessSettings, reprocess

    mission = Workspace.open(workspace).mission()
    chosen = ReprocessSettings(**settings)
    return reprocess(Catalog(workspace), mission, settings=chosen, client=_client(scheduler))


def _diagnose(workspace, **settings):
    from inflight.catalog import Catalog, Workspace
    from inflight.tasks.analysis import DiagnoseSettings, diagnose

    told = []
    found = diagnose(
        Catalog(workspace),
        Workspace.open(workspace).mission(),
        settings=DiagnoseSettings(**settings),
        progress=lambda *step: told.append(step),
    )
    return Report(found.as_json() | {"told": told})


def _release(workspace, version):
    from inflight.catalog import Catalog

    return Report({"path": str(Catalog(workspace).release(version))})


def _collect_garbage(workspace):
    from inflight.catalog import Catalog

    return Report({"removed": len(Catalog(workspace).gc(dry_run=False, past=True))})


class Report(dict):
    """What work without a report of its own says."""

    def as_json(self):
        return dict(self)


#: What is imported before anything is forked: all that the work below needs, at its first use too.
IMPORTED = (
    "alembic.command",
    "dask.array",
    "distributed",
    "pyarrow.pandas_compat",
    "inflight.tasks.archive.ingestion",
    "inflight.tasks.pipelines.registry",
    "inflight.tasks.pipelines.scalar.day",
    "inflight.tasks.pipelines.scalar.product",
    "inflight.tasks.pipelines.two_sensor.day",
    "inflight.calibration.residual_loops",
    "pint",
    "sqlalchemy.dialects.sqlite",
    "zarr",
)
#: What a process can be told to do.
WORK = {
    "ingest": _ingest,
    "reprocess": _reprocess,
    "diagnose": _diagnose,
    "release": _release,
    "gc": _collect_garbage,
}


def _carry_out(told):
    from inflight.errors import InflightError

    os.environ["INFLIGHT_KILL_AT"] = told["kill_at"]
    if told["file_limit"]:
        resource.setrlimit(resource.RLIMIT_FSIZE, (told["file_limit"], resource.RLIM_INFINITY))
    code = 0
    try:
        outcome = {"report": WORK[told["work"]](told["workspace"], **told["options"]).as_json()}
    except InflightError as error:
        code, outcome = 1, {"error": error.as_json() | {"cause": error.cause}}
    except Exception as error:
        traceback.print_exc()
        code, outcome = 2, {"error": {"kind": type(error).__name__, "message": str(error), "cause": "bug"}}
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    from inflight.tasks import to_json

    # Whoever is killed while it writes has told nothing.
    unfinished = Path(told["outcome"] + ".part")
    unfinished.write_text(to_json(outcome))
    unfinished.rename(told["outcome"])
    return code


def _serve():
    for line in sys.stdin:
        told = json.loads(line)
        if "wait" in told:
            print(os.waitstatus_to_exitcode(os.waitpid(told["wait"], 0)[1]), flush=True)
            continue
        pid = os.fork()
        if pid == 0:
            code = 3
            try:
                # The pipe to the tests is the server's alone.
                os.dup2(2, 1)
                code = _carry_out(told)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        print(pid, flush=True)


if __name__ == "__main__":
    import importlib

    import numba

    for name in IMPORTED:
        importlib.import_module(name)
    # Numba reads half of itself at its first call.
    numba.njit(lambda value: value)(1)
    # Nothing of this can go: children need not look for it, nor touch, and so copy, memory that they share.
    gc.freeze()
    _serve()
