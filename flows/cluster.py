"""The Dask cluster of a run: processes on this machine, or a scheduler that exists already.

The processes are forks of one that has imported what they need (Python's fork server): what is imported is
read once and in memory once, however many there are.
"""

from __future__ import annotations

import atexit
import gc
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import forkserver
from typing import TYPE_CHECKING, Any, Final

from inflight.errors import InflightError
from inflight.threads import ONE_THREAD_VARIABLES, one_thread

if TYPE_CHECKING:
    from distributed import Client


#: Address of a Dask scheduler to use instead of starting processes here.
SCHEDULER_VARIABLE = "INFLIGHT_DASK_SCHEDULER"

#: A day's arrays are made and dropped by the hundred. Dask's own setting gives each back to the system at
#: once, which then hands out empty pages again: 90 days took twice as long. Workers keep them instead; 32 MiB
#: is the most that glibc takes for the second. One thread of a worker does its work: it gets what the others
#: leave free.
_KEEP_MEMORY = {
    "MALLOC_TRIM_THRESHOLD_": "67108864",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "MALLOC_ARENA_MAX": "1",
}

#: Numpy and the system read these before any task can set them.
WORKERS_ENVIRONMENT: Final = ONE_THREAD_VARIABLES | _KEEP_MEMORY | {"PYTHONSAFEPATH": "1"}

#: Imported once for all processes.
_PRELOAD = ["inflight.flows.preload"]

#: What processes take to start, s, about: with the process that they are forks of, and as forks of one that
#: is ready.
_START_S, _FORK_S = 3.0, 0.5
#: How many pieces of work are few. Of more, the first is not tried here: it would keep all processes waiting.
#: For very few, nothing gets ready before it pays; they are tried here even where processes are ready.
_FEW, _VERY_FEW = 6, 2
#: Pieces of work that only a long record has.
_MUCH = 12

#: Messages that Dask keeps for its developers, of each connection. Each holds a batch with all it needs: the
#: 1000 that Dask keeps by itself are more than a mission of 3000 days has.
_MESSAGES_KEPT = 16


#: What Dask's own processes do beside the work, for pages that nobody opens: they look every 10 ms where
#: each thread is, every 20 ms whether the loop is late, and say every half second how they are. Two idle
#: workers took a tenth of a core so.
_LESS_ASIDE = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
}

#: Tells workers how far they stand behind others on this machine, as ``nice`` counts it.
_NICENESS: Final = "INFLIGHT_NICENESS"


def dask_setup(worker: Any) -> None:
    """Let a worker ignore Ctrl-C, which is for the command: it ends the workers. Dask calls this in each.

    What is imported stays: Python need not look again and again which of it could go, nor touch, and so copy,
    memory that the processes share.

    What a worker says when its scheduler is gone is no news: its command has ended. What goes wrong with a
    task is the task's error.
    """
    del worker
    logging.getLogger("distributed.worker").setLevel(logging.CRITICAL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(int(os.environ.get(_NICENESS, "0")))
    gc.freeze()


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def dask_client(workers: int | None = None, niceness: int = 0) -> Iterator[Client]:
    """Yield one client for the whole run.

    Parameters
    ----------
    workers : int, optional
        Processes to start; the cores of this machine when absent. Each has one thread and one BLAS
        thread, so that results do not depend on how many there are. The environment variable
        ``INFLIGHT_DASK_SCHEDULER`` names a running scheduler instead.
    niceness : int
        How far the processes stand behind others of this machine.
    """
    # First: it imports on another core what they need, while this process imports what it does.
    start_early()
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.worker.multiprocessing-method": "forkserver",
        # The fork server's environment is that of its start.
        "distributed.nanny.environ": {**os.environ, **ONE_THREAD_VARIABLES, _NICENESS: str(niceness)},
        "distributed.worker.memory.spill": False,
        "distributed.worker.preload": [__name__],
        "distributed.admin.low-level-log-length": _MESSAGES_KEPT,
        **_LESS_ASIDE,
    }
    address = os.environ.get(SCHEDULER_VARIABLE)
    with dask.config.set(settings), _quiet_log(), ExitStack() as stack:
        scheduler: Any = address or stack.enter_context(
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers or available_cores(),
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.ERROR,
            )
        )
        if not address:
            _living.append(scheduler)
            stack.callback(_living.remove, scheduler)
        yield stack.enter_context(Client(scheduler, set_as_default=False))  # type: ignore[no-untyped-call]


#: Schedulers of clusters that live in this process: their workers are forks of one process.
_living: list[object] = []
#: When the process that workers are forks of was started, on the clock of `time.monotonic`, by its number.
_fork_server_began: dict[int, float] = {}


@contextmanager
def environment_of(variables: Mapping[str, str]) -> Iterator[None]:
    """Let processes that start inside have these variables, too."""
    before = dict(os.environ)
    os.environ.update(variables)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def start_early() -> None:
    """Start the process that workers are forks of, unless it runs: it imports what they need.

    Nothing starts where ``INFLIGHT_DASK_SCHEDULER`` names a running scheduler.
    """
    if os.environ.get(SCHEDULER_VARIABLE):
        return
    multiprocessing.set_forkserver_preload(_PRELOAD)
    with environment_of(WORKERS_ENVIRONMENT):
        forkserver.ensure_running()
    _fork_server_began.setdefault(_fork_server(), time.monotonic())
    # It would end by itself, a moment later than its command.
    atexit.unregister(_end_fork_server)
    atexit.register(_end_fork_server)


def _fork_server() -> int:
    """Return the number of the process that workers are forks of; 0 while there is none."""
    return forkserver._forkserver._forkserver_pid or 0  # type: ignore[attr-defined]


def _is_fork_server_ready() -> bool:
    """Return whether the process that workers are forks of has had time to import what they need."""
    began = _fork_server_began.get(_fork_server())
    return began is not None and time.monotonic() - began > _START_S - _FORK_S


def _end_fork_server() -> None:
    _fork_server_began.clear()
    # A process that Python's own multiprocessing began has removed the folder of its sockets by now.
    with suppress(FileNotFoundError):
        forkserver._forkserver._stop()  # type: ignore[attr-defined]


class _Done:
    """The result of work that was done at once; stands for a Dask future."""

    def __init__(self, work: Callable[..., Any], arguments: Sequence[Any]) -> None:
        self._error: Exception | None = None
        try:
            # As in a process of its own: results must not depend on the number of threads.
            with one_thread():
                self._result = work(*arguments)
        except Exception as error:
            self._error = error

    def result(self) -> Any:
        """Return the result, or raise what the work raised."""
        if self._error is not None:
            raise self._error
        return self._result

    def cancel(self) -> None:
        """There is nothing to cancel any more."""


class _LazyClient:
    """Stands for a client whose processes start when there is work enough for them.

    A few pieces of work are done in this process while processes would save less of what is left of them, by
    how long those before it took, than they take to start. More than very few are given to processes at once
    where these need only be forked.
    """

    def __init__(self, workers: int | None, niceness: int) -> None:
        self._settings, self._stack = (workers, niceness), ExitStack()
        self._client: Client | None = None
        self._ended = False
        # Prefect's tasks run in threads, several of which may bring the first work.
        self._starting = threading.Lock()
        self._left = self._given = 0
        self._took: list[float] = []

    def expect(self, pieces: int) -> None:
        """Tell how many pieces of work come, before the first of them."""
        # Where processes are as good as there, the first piece would keep them waiting as well.
        few = _VERY_FEW if _is_fork_server_ready() else _FEW
        alone = SCHEDULER_VARIABLE not in os.environ and pieces <= few
        self._left, self._took = (pieces if alone else 0), []
        if pieces > _VERY_FEW and not self._ended:
            # Meanwhile the first is tried here, or what a client needs is imported.
            start_early()

    def submit(self, work: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Give work to the client: see `distributed.Client.submit`.

        Raises
        ------
        InflightError
            When the run has ended: Prefect's tasks that still waited when it was cancelled do nothing more.
        """
        with self._starting:
            if self._ended:
                raise InflightError("the run has ended; its work is not begun any more", remedy="run again")
            if self._client is None and self._pays_to_stay():
                begun = time.perf_counter()
                done = _Done(work, arguments)
                self._took.append(time.perf_counter() - begun)
                self._left -= 1
                return done
            if self._client is None:
                self._client = self._stack.enter_context(dask_client(*self._settings))
            self._given += 1
        return self._client.submit(work, *arguments, **options)

    def _pays_to_stay(self) -> bool:
        """Return whether processes would save less of few pieces than they take to start."""
        usual = sum(self._took) / max(len(self._took), 1)
        workers = min(self._settings[0] or available_cores(), self._left)
        takes = _FORK_S if _is_fork_server_ready() else _START_S
        return self._left > 0 and (1.0 - 1.0 / workers) * self._left * usual < takes

    def end(self) -> None:
        """End the processes for good."""
        self._ended = True
        self.end_processes()

    def end_processes(self) -> None:
        """End the processes; the next work starts others. Nothing may be under way.

        After much work, the process that they were forks of ends, too: memory counts then, not two seconds.
        """
        with self._starting:
            self._client = None
            self._stack.close()
            if self._given > _MUCH and not _living:
                _end_fork_server()
            self._given = 0


@contextmanager
def lazy_client(workers: int | None = None, niceness: int = 0) -> Iterator[Any]:
    """Yield what work can be submitted to; no process starts before the first does.

    Parameters
    ----------
    workers, niceness : int
        As of `dask_client`.
    """
    client = _LazyClient(workers, niceness)
    try:
        yield client
    finally:
        client.end()


@contextmanager
def _quiet_log() -> Iterator[None]:
    """Keep Dask's log to errors: Prefect's own logging set-up would otherwise show every connection."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]
    loggers = [logging.getLogger(name) for name in ["distributed", *names]]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
