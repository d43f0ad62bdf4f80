"""The flow ``backfill``: take in and reprocess a past span, planned first, only what is needed."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

from prefect import flow

from inflight.catalog import Workspace
from inflight.flows.cluster import dask_client
from inflight.flows.ingest import take_in
from inflight.flows.reprocess import DEFAULT_SETTINGS, reprocess_span
from inflight.flows.span import Span
from inflight.flows.stages import batch_runner, unsearched
from inflight.tasks.pipelines import ReprocessSettings


@flow(name="backfill", task_runner=batch_runner(), persist_result=False)
def backfill(
    workspace: Path,
    start: dt.date,
    end: dt.date,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Take in what was delivered late for a span, then reprocess the days whose inputs changed.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    start, end : date
        UTC days, half-open.
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
    span = Span(start=start, end=end)
    return bring_up_to_date("backfill", workspace, (span, span), settings, data, workers)


def bring_up_to_date(
    command: str,
    workspace: Path,
    spans: tuple[Span, Span],
    settings: ReprocessSettings,
    data: Path | None,
    workers: int | None,
) -> dict[str, Any]:
    """Take in the first span and reprocess the second one, within the flow that calls this.

    Parameters and result as of the flow ``backfill``; `command` names the report.
    """
    delivered, made = spans
    with dask_client(workers) as client:
        taken = take_in(workspace, data, None, delivered, unsearched(client))
        report = reprocess_span(Workspace.open(workspace), made, settings, client)
    return taken.followed_by(report, command).as_json()
