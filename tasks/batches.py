"""Running independent batches: one after the other in this process, or on the processes of a Dask client.

`reprocess`, `ingest` and `diagnose` cut their work into batches whose results do not depend on each other.
`iter_results` runs them and yields the results in the order of the batches, so that what is registered does
not depend on which process was faster; a `Mapper` is the same with a name for the stage, and is what a flow
uses instead.
"""

from __future__ import annotations

import ctypes
import itertools
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from inflight.errors import WorkerError
from inflight.progress import Progress, silent, with_progress

Result = TypeVar("Result")

#: Runs a function over the argument lists of independent batches and yields the outcomes in order:
#: (stage, function, argument lists).
Mapper = Callable[[str, Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[Any]]

#: Batches of a process after which it gives memory back, and a count of them.
_GIVES_BACK_AFTER, _batches = 8, itertools.count(1)

#: Batches submitted to a Dask client at once, at most: enough to keep the processes busy (assumed).
IN_FLIGHT = 16


def iter_results(
    client: Any, function: Callable[..., Result], jobs: Sequence[Sequence[Any]]
) -> Iterator[Result]:
    """Yield the results of a function in the order of its jobs, on a Dask client when there is one.

    At most `IN_FLIGHT` jobs are submitted at once, so results never pile up.
    """
    if client is None:
        return (function(*job) for job in jobs)
    expect_work(client, len(jobs))
    return few_at_once(lambda job: client.submit(function, *job, pure=False), result_of, jobs)


def few_at_once(
    submit: Callable[[Any], Any], read: Callable[[Any], Result], jobs: Iterable[Any]
) -> Iterator[Result]:
    """Yield the results of jobs in their order; at most `IN_FLIGHT` are submitted and not read yet.

    A mission has hundreds of batches: what waits to be run, or to be read, costs memory.

    Parameters
    ----------
    submit : callable
        Takes a job; returns what `read` waits for.
    read : callable
        Returns the result of what was submitted.
    """
    waiting: deque[Any] = deque()
    for job in jobs:
        waiting.append(submit(job))
        if len(waiting) >= IN_FLIGHT:
            yield read(waiting.popleft())
    while waiting:
        yield read(waiting.popleft())


def give_back_memory() -> None:
    """Give memory that was let go of back to the system: other processes need it now.

    The C library keeps what a search's arrays left behind, half a gigabyte of a long record.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def give_back_memory_at_times() -> None:
    """Give memory back after every eighth batch of a process.

    What the C library keeps grows by a megabyte a batch, of which a mission has hundreds. Who makes a few
    need not fetch it anew each time.
    """
    if next(_batches) % _GIVES_BACK_AFTER == 0:
        give_back_memory()


def expect_work(client: Any, pieces: int) -> None:
    """Tell a client that starts its processes by itself how many pieces of work come: a few may need none."""
    expect = getattr(client, "expect", None)
    if expect is not None:
        expect(pieces)


def end_processes(client: Any) -> None:
    """Let a client that starts its processes by itself end them: what follows needs the memory.

    A `distributed.Client` is its owner's to close; it stays as it is.
    """
    end = getattr(client, "end_processes", None)
    if end is not None:
        end()


def result_of(future: Any) -> Any:
    """Return the result of a Dask future.

    Raises
    ------
    WorkerError
        When several processes in turn ended while they ran it. Errors of the function itself are raised as
        they are.
    """
    try:
        return future.result()
    except Exception as error:
        # Dask is imported where it is used; work that was done in this process needs none.
        from distributed import KilledWorker

        if not isinstance(error, KilledWorker):
            raise
        raise WorkerError(
            f"{error.allowed_failures + 1} Dask processes in turn ended while they did one piece of work",
            remedy="look for what ends them, most often too little memory: fewer '--workers' or "
            "'--batch-days' need less; then run again",
        ) from error


def batch_mapper(client: Any, progress: Progress | None = None) -> Mapper:
    """Return a mapper that runs batches here, or on a Dask client, and reports how many are done."""
    report = progress or silent

    def run_batches(
        stage: str, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
    ) -> Iterator[Any]:
        return with_progress(report, stage, iter_results(client, function, arguments), len(arguments))

    return run_batches
