"""The Prefect flows: what a deployment names, such as ``inflight.flows.prefect_flows.reprocess``.

Each is the step of its name in `inflight.flows.steps`, run with Prefect tasks around its parts. Parameters
are checked by their types before the run begins.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import Any, cast, get_type_hints

from prefect import flow
from prefect.flows import Flow
from prefect.futures import PrefectFuture
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from inflight.flows import steps
from inflight.flows.runner import PrefectRunner, using_runner

#: Batches in flight at once: enough to keep the Dask processes busy, few enough to bound the memory.
BATCHES_IN_FLIGHT = 4


def _as_flow(step: Callable[..., dict[str, Any]]) -> Flow[..., dict[str, Any]]:
    @wraps(step)
    def run(*arguments: Any, **keywords: Any) -> dict[str, Any]:
        with using_runner(PrefectRunner()):
            return step(*arguments, **keywords)

    # Prefect looks the types of parameters up in this module, where the step's names are unknown.
    run.__annotations__ = get_type_hints(step)
    run.__signature__ = signature(step, eval_str=True)  # type: ignore[attr-defined]
    # Threads that wait for Dask: the work itself is done by processes.
    threads = cast("TaskRunner[PrefectFuture[Any]]", ThreadPoolTaskRunner(max_workers=BATCHES_IN_FLIGHT))
    return flow(name=step.__name__, task_runner=threads, persist_result=False)(run)


# A deployment names a flow by this module and its name.
ingest = _as_flow(steps.ingest)
reprocess = _as_flow(steps.reprocess)
backfill = _as_flow(steps.backfill)
monthly = _as_flow(steps.monthly)
diagnose = _as_flow(steps.diagnose)
update = _as_flow(steps.update)
release = _as_flow(steps.release)
