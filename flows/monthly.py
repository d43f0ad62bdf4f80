"""The flow ``monthly``: take in what came late for a calendar month, and calibrate it by itself."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Any

from prefect import flow

from inflight.flows.backfill import bring_up_to_date
from inflight.flows.span import month_span
from inflight.flows.stages import batch_runner
from inflight.tasks.pipelines import ReprocessSettings

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
    settings, data, workers
        As of the flow ``backfill``, and so is the result.
    """
    span = month_span(month, dt.datetime.now(dt.UTC).date())
    return bring_up_to_date("monthly", workspace, (span.with_neighbours(), span), settings, data, workers)
