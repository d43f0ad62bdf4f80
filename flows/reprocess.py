"""The flow ``reprocess``: calibrate a span, solve its tables, write its level-2 products."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow

from inflight.catalog import Catalog, Workspace
from inflight.flows.batches import batch_tasks
from inflight.flows.cluster import dask_client
from inflight.flows.span import DateOrNone, Span
from inflight.flows.stages import batch_runner
from inflight.tasks import RunReport
from inflight.tasks.pipelines import ReprocessSettings
from inflight.tasks.pipelines import reprocess as run_chain

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_SETTINGS = ReprocessSettings()


@flow(name="reprocess", task_runner=batch_runner(), persist_result=False)
def reprocess(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    workers: int | None = None,
) -> dict[str, Any]:
    """Calibrate and write level-2 products of a span; days whose inputs did not change are left alone.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    start, end : date, optional
        UTC days, half-open; all days of the archive when absent.
    settings : ReprocessSettings
        How it is done.
    workers : int, optional
        Dask processes; the cores when absent.

    Returns
    -------
    dict
        The fields of a `RunReport`.
    """
    span = Span(start=start, end=end)
    with dask_client(workers) as client:
        return reprocess_span(Workspace.open(workspace), span, settings, client).as_json()


def reprocess_span(
    workspace: Workspace, span: Span, settings: ReprocessSettings, client: Client
) -> RunReport:
    """Carry out the whole chain for a span, within the flow that calls this; a Prefect task a batch."""
    catalog, mission = Catalog(workspace.root), workspace.mission()
    return run_chain(catalog, mission, *span.as_text(), settings=settings, mapper=batch_tasks(client))
