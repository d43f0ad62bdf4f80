"""The flow ``monthly``: take in what came late for a calendar month, and calibrate it by itself."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

from prefect import flow

from inflight.catalog.workspace import Workspace
from inflight.flows.cluster import dask_client
from inflight.flows.ingest import take_in
from inflight.flows.reprocess import reprocess_span
from inflight.flows.span import month_span
from inflight.flows.stages import batch_runner, unsearched
from inflight.tasks.planning import ReprocessSettings

#: Each day's own parameters with the month's offset along the spin axis.
MONTHLY_SETTINGS = ReprocessSettings(table="daily")


@flow(name="monthly", task_runner=batch_runner(), persist_result=False)
def monthly(
    workspace: Path,
    month: str | None = None,
    settings: ReprocessSettings = MONTHLY_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Close a calendar month; days whose inputs and offsets did not change are left alone.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    month : str, optional
        ``YYYY-MM``; the last one that is over when absent.
    settings : ReprocessSettings
        As of the flow ``reprocess``.
    data : Path, optional
        Folder of the delivered files; ``data`` in the workspace when absent.
    workers : int, optional
        Dask processes; the cores when absent.

    Returns
    -------
    dict
        The fields of a `RunReport`: its days are those of the products; ``ingest`` tells what was
        taken in.
    """
    span = month_span(month, dt.datetime.now(dt.UTC).date())
    with dask_client(workers) as client:
        taken = take_in(workspace, data, None, span.with_neighbours(), unsearched(client))
        report = reprocess_span(Workspace.open(workspace), span, settings, client)
    return taken.followed_by(report, "monthly").as_json()
