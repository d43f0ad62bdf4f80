"""How the steps of a flow run: their batches on Dask processes, with or without Prefect tasks around them.

A step asks `runner()` how to run its batches and where to show progress. Inside a Prefect flow every step
and every group of batches is a Prefect task with retries (`PrefectRunner`); elsewhere they are plain calls
(`PlainRunner`). What is computed, and every byte that is written, is the same.

Prefect plans, retries and shows; what was done is in the catalog alone. So tasks use no cache and keep no
result.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

from inflight.errors import InflightError
from inflight.progress import Progress, silent, with_progress
from inflight.tasks import batch_mapper, expect_work, few_at_once, result_of

if TYPE_CHECKING:
    from distributed import Client
    from prefect.tasks import Task

    from inflight.tasks import Mapper

#: Seconds before the second, third and fourth try.
RETRY_DELAYS: list[float] = [1.0, 10.0, 60.0]

#: Prefect tasks of a stage at most; assumed: enough to show how far a run is, and to try little again.
TASKS_OF_A_STAGE = 40

R = TypeVar("R")


class Runner(Protocol):
    """What a step needs of the process it runs in."""

    @property
    def progress(self) -> Progress:
        """Called with ``(stage, done, total)``."""

    def run(self, name: str, function: Callable[..., R], *arguments: Any) -> R:
        """Run one function as a step of this name and return its result."""

    def mapper(self, client: Client) -> Mapper:
        """Return what runs a function over independent batches and yields the outcomes in their order."""


class PlainRunner:
    """Runs steps as plain calls; only their batches go to Dask processes."""

    def __init__(self, progress: Progress | None = None) -> None:
        self._progress = progress or silent

    @property
    def progress(self) -> Progress:
        """Called with ``(stage, done, total)``."""
        return self._progress

    def run(self, name: str, function: Callable[..., R], *arguments: Any) -> R:
        """Call the function."""
        return function(*arguments)

    def mapper(self, client: Client) -> Mapper:
        """Return what runs batches on the client."""
        return batch_mapper(client, self.progress)


class PrefectRunner:
    """Runs steps and batches as tasks of the Prefect flow around them; transient failures are retried."""

    @property
    def progress(self) -> Progress:
        """Called with ``(stage, done, total)``; nothing listens in a flow that a worker runs."""
        return _progress.get()

    def run(self, name: str, function: Callable[..., R], *arguments: Any) -> R:
        """Run the function as a task of this name."""
        return cast(R, _as_task(name, function)(*map(_as_is, arguments)))

    def mapper(self, client: Client) -> Mapper:
        """Return what runs batches as tasks whose work Dask processes do.

        A task costs the server and this process as much as half a day's calibration: each stage of a long
        mission has some hundred tasks, of several batches, and that of a short one a task a batch.
        """

        def run_batches(
            stage: str, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
        ) -> Iterator[Any]:
            run_group = _as_task(stage, _run_batches)
            shared = (_as_is(client), _as_is(function))
            size = -(-len(arguments) // TASKS_OF_A_STAGE) or 1
            expect_work(client, len(arguments))
            results = few_at_once(
                lambda group: run_group.submit(*shared, _as_is(group)),
                lambda future: future.result(),
                [arguments[at : at + size] for at in range(0, len(arguments), size)],
            )
            each = itertools.chain.from_iterable(results)
            return with_progress(self.progress, stage, each, len(arguments))

        return run_batches


_runner: ContextVar[Runner | None] = ContextVar("runner", default=None)
_progress: ContextVar[Progress] = ContextVar("progress", default=silent)


def runner() -> Runner:
    """Return the runner of the flow or plain call this is part of."""
    return _runner.get() or PlainRunner(_progress.get())


@contextmanager
def using_runner(chosen: Runner) -> Iterator[None]:
    """Run the steps inside with a runner."""
    token = _runner.set(chosen)
    try:
        yield
    finally:
        _runner.reset(token)


@contextmanager
def progress_to(listener: Progress | None) -> Iterator[None]:
    """Report the progress of what runs inside to `listener`, a function ``(stage, done, total)``."""
    token = _progress.set(listener or silent)
    try:
        yield
    finally:
        _progress.reset(token)


def is_transient(error: object) -> bool:
    """Return True for a failure that may not happen again: a full disk, a lost process, a locked database."""
    if isinstance(error, InflightError):
        return error.cause == "transient"
    from distributed import KilledWorker
    from distributed.comm.core import CommClosedError
    from sqlalchemy.exc import OperationalError

    return isinstance(
        error, KilledWorker | CommClosedError | OperationalError | ConnectionError | TimeoutError
    )


def _as_task(name: str, function: Callable[..., Any]) -> Task[..., Any]:
    """Make a plain function a Prefect task; `name` is what the server shows."""
    from prefect import task
    from prefect.cache_policies import NO_CACHE

    return task(
        name=name,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=len(RETRY_DELAYS),
        retry_delay_seconds=RETRY_DELAYS,
        retry_condition_fn=lambda step, run, state: is_transient(state.data),
        log_prints=False,
    )(function)


def _as_is(value: R) -> R:
    """Return an argument that a task takes as it is: Prefect would search it for futures to wait for."""
    from prefect.utilities.annotations import quote

    return cast(R, quote(value))


def _run_batches(
    client: Client, function: Callable[..., Any], batches: Sequence[tuple[Any, ...]]
) -> list[Any]:
    """Run a plain function on some batches in the client's processes and wait for the results.

    The function is not pure to Dask: it writes a store, so an equal call is never answered from
    memory.
    """
    futures = [client.submit(function, *arguments, pure=False) for arguments in batches]
    try:
        return [result_of(future) for future in futures]
    except BaseException:
        # Another try submits all of them again.
        for future in futures:
            future.cancel()  # type: ignore[no-untyped-call]
        raise
