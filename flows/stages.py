"""How Prefect runs one step of the pipeline: retries for what can pass, no cache, no stored results.

Prefect plans, retries and shows; what was done is in the catalog alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.futures import PrefectFuture
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner
from prefect.tasks import Task
from prefect.utilities.annotations import quote

from inflight.errors import InflightError

#: Seconds before the second, third and fourth try.
RETRY_DELAYS: list[float] = [1.0, 10.0, 60.0]
#: Batches in flight at once: enough to keep the Dask processes busy, few enough to bound the memory.
BATCHES_IN_FLIGHT = 4

P = ParamSpec("P")
R = TypeVar("R")


def batch_runner() -> TaskRunner[PrefectFuture[Any]]:
    """Return the task runner of every flow: threads that wait for Dask."""
    return cast("TaskRunner[PrefectFuture[Any]]", ThreadPoolTaskRunner(max_workers=BATCHES_IN_FLIGHT))


def unsearched(value: R) -> R:
    """Return an argument that a task takes as it is: Prefect would search it for futures to wait for."""
    return cast(R, quote(value))


def can_pass(error: object) -> bool:
    """Return True for a failure that may not happen again: a full disk, a lost process, a locked database."""
    if isinstance(error, InflightError):
        return error.cause == "transient"
    from distributed import KilledWorker
    from distributed.comm.core import CommClosedError
    from sqlalchemy.exc import OperationalError

    return isinstance(
        error, KilledWorker | CommClosedError | OperationalError | ConnectionError | TimeoutError
    )


def _is_worth_a_retry(step: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    return can_pass(state.data)


def step(name: str) -> Callable[[Callable[P, R]], Task[P, R]]:
    """Make a plain function a Prefect task; `name` is what the server shows."""
    return task(
        name=name,
        cache_policy=NO_CACHE,
        persist_result=False,
        retries=len(RETRY_DELAYS),
        retry_delay_seconds=RETRY_DELAYS,
        retry_condition_fn=_is_worth_a_retry,
        log_prints=False,
    )
