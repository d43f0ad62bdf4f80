"""Carrying out one step for many batches of days: a Prefect task a batch, a Dask process for its work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from prefect.futures import as_completed
from prefect.tasks import Task
from prefect.utilities.annotations import quote

from inflight.flows.progress import tell

if TYPE_CHECKING:
    from distributed import Client


def in_process(client: Client, function: Callable[..., Any], *arguments: Any) -> Any:
    """Run a plain function in one of the client's processes and wait for its result.

    The function is not pure to Dask: it writes to the catalog, so an equal call is never answered
    from memory. A process that dies takes the call with it; whether to try again is the caller's
    decision, because a day that was staged need not be made again.
    """
    return client.submit(function, *arguments, pure=False, retries=0).result()


def for_batches(stage: str, task: Task[..., Any], batches: Sequence[Any], *arguments: Any) -> list[Any]:
    """Run a Prefect task once a batch and return the results in the order of the batches.

    Every batch is given its chance before the first failure is raised, so that one bad batch
    costs one batch.
    """
    tell(stage, 0, len(batches))
    futures = [task.submit(quote(batch), *map(quote, arguments)) for batch in batches]
    for done, _ in enumerate(as_completed(futures), start=1):
        tell(stage, done, len(batches))
    return [future.result() for future in futures]
