"""What the flows do, without Prefect: for notebooks, for clusters without a server, and to compare with."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from inflight.catalog import Catalog, Workspace
from inflight.flows.cluster import client_when_needed, dask_client
from inflight.flows.span import Span, month_span
from inflight.tasks import Progress, RunReport, make_release

Parameters = Mapping[str, Any]


def _span(parameters: Parameters) -> tuple[str | None, str | None]:
    return Span(start=parameters.get("start"), end=parameters.get("end")).as_text()


def ingest(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Take delivered files into the archive."""
    from inflight.tasks.archive import ingest as take_in

    data = Path(parameters.get("data") or workspace.data)
    names = parameters.get("instruments")
    catalog, mission, span = Catalog(workspace.root), workspace.mission(), _span(parameters)
    with dask_client(workers) as client:
        return take_in(catalog, mission, data, names, *span, client=client, progress=progress)


def reprocess(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Calibrate and write level-2 products of a span."""
    from inflight.tasks.pipelines import ReprocessSettings
    from inflight.tasks.pipelines import reprocess as work

    settings = ReprocessSettings.model_validate(parameters.get("settings") or {})
    catalog, mission, span = Catalog(workspace.root), workspace.mission(), _span(parameters)
    with dask_client(workers) as client:
        return work(catalog, mission, *span, settings=settings, client=client, progress=progress)


def backfill(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Take in what was delivered late for a span, then reprocess the days whose inputs changed."""
    taken = ingest(workspace, parameters, workers, progress)
    return taken.followed_by(reprocess(workspace, parameters, workers, progress), "backfill")


def monthly(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Take in what was delivered late for a calendar month, and calibrate it with its own offsets."""
    from inflight.flows.monthly import MONTHLY_SETTINGS

    span = month_span(parameters.get("month"), dt.datetime.now(dt.UTC).date())
    settings = MONTHLY_SETTINGS.model_dump() | dict(parameters.get("settings") or {})
    given = {"data": parameters.get("data"), "settings": settings} | span.model_dump()
    taken = ingest(workspace, given | span.with_neighbours().model_dump(), workers, progress)
    return taken.followed_by(reprocess(workspace, given, workers, progress), "monthly")


def diagnose(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Find which effect is missing from the model of a span."""
    from inflight.tasks.analysis import DiagnoseSettings, diagnose_span

    settings = DiagnoseSettings.model_validate(parameters.get("settings") or {})
    save, span = bool(parameters.get("save")), _span(parameters)
    with client_when_needed(workers) as client:
        fields = diagnose_span(workspace, *span, settings, save=save, client=client, progress=progress)
    return RunReport.from_json(fields)


def release(
    workspace: Workspace, parameters: Parameters, workers: int | None, progress: Progress | None
) -> RunReport:
    """Freeze what is published and copy it out; `workers` and `progress` do not matter."""
    return make_release(workspace, **parameters)


#: Flow name -> plain function of (workspace, parameters, workers, progress).
STEPS: dict[str, Callable[[Workspace, Parameters, int | None, Progress | None], RunReport]] = {
    "ingest": ingest,
    "reprocess": reprocess,
    "backfill": backfill,
    "monthly": monthly,
    "diagnose": diagnose,
    "release": release,
}
