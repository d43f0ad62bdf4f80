"""The flow ``reprocess``: calibrate a span, solve its tables, write its level-2 products."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow
from prefect.utilities.annotations import quote

from inflight.catalog import Catalog, Day
from inflight.catalog.workspace import load_mission
from inflight.flows.batches import for_batches, in_process
from inflight.flows.cluster import dask_client
from inflight.flows.span import Span
from inflight.flows.stages import batch_runner, step
from inflight.tasks import reprocess as steps
from inflight.tasks.report import RunReport
from inflight.tasks.reprocess import Plan, ReprocessSettings

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_SETTINGS = ReprocessSettings()


@flow(name="reprocess", task_runner=batch_runner(), persist_result=False, log_prints=False)
def reprocess(
    workspace: Path,
    start: dt.date | None = None,
    end: dt.date | None = None,
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
        return reprocess_span(workspace, span, settings, client).as_json()


def reprocess_span(workspace: Path, span: Span, settings: ReprocessSettings, client: Client) -> RunReport:
    """Carry out the stages of a span, within the flow that calls this."""
    planned = plan_days(workspace, span, settings)
    shared = (client, workspace, settings, planned.context)
    calibrated = for_batches("calibrate", calibrate_days, planned.batches, *shared)
    tables = solve_tables(workspace, quote(planned), settings)
    produced = for_batches("produce", produce_days, planned.batches, *shared)
    return steps.report_of(planned, [*calibrated, *produced], tables)


@step("plan")
def plan_days(workspace: Path, span: Span, settings: ReprocessSettings) -> Plan:
    """Find out which days need work."""
    return steps.plan(Catalog(workspace), load_mission(workspace), *span.as_text(), settings)


@step("calibrate")
def calibrate_days(batch: list[Any], client: Any, workspace: Path, settings: Any, context: str) -> list[Day]:
    """Form the normal equations and daily parameters of one batch."""
    return in_process(client, _calibrate, workspace, batch, settings, context)


@step("solve")
def solve_tables(workspace: Path, planned: Plan, settings: ReprocessSettings) -> list[int]:
    """Solve and certify the calibration tables of the span."""
    return steps.solve(Catalog(workspace), load_mission(workspace), planned, settings)


@step("produce")
def produce_days(batch: list[Any], client: Any, workspace: Path, settings: Any, context: str) -> list[Day]:
    """Write the level-2 products of one batch."""
    return in_process(client, _produce, workspace, batch, settings, context)


def _calibrate(workspace: Path, batch: list[Any], settings: ReprocessSettings, context: str) -> list[Day]:
    return steps.calibrate(Catalog(workspace), load_mission(workspace), batch, settings, context)


def _produce(workspace: Path, batch: list[Any], settings: ReprocessSettings, context: str) -> list[Day]:
    return steps.produce(Catalog(workspace), load_mission(workspace), batch, settings, context)
