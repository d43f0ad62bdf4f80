"""Carrying out one stage for many batches of days: a Prefect task a batch, a Dask process for its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from inflight.flows.progress import tell
from inflight.flows.stages import step, unsearched
from inflight.tasks import result_of

if TYPE_CHECKING:
    from distributed import Client

    from inflight.tasks import Mapper


def batch_tasks(client: Client) -> Mapper:
    """Return a mapper that runs every batch as a Prefect task whose work a Dask process does.

    It yields the outcomes in the order of the batches, so that what is registered does not depend
    on which process was faster. It must be called inside a flow.

    Parameters
    ----------
    client : distributed.Client
        Shared by all batches of the run.
    """

    def spread(
        stage: str, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]
    ) -> Iterator[Any]:
        run_batch = step(stage)(_run_batch)
        tell(stage, 0, len(arguments))
        shared = (unsearched(client), unsearched(function))
        futures = [run_batch.submit(*shared, unsearched(batch)) for batch in arguments]
        for done, future in enumerate(futures, start=1):
            outcome = future.result()
            tell(stage, done, len(arguments))
            yield outcome

    return spread


def _run_batch(client: Client, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Run a plain function in one of the client's processes and wait for its result.

    The function is not pure to Dask: it writes a store, so an equal call is never answered from
    memory.
    """
    return result_of(client.submit(function, *arguments, pure=False))
