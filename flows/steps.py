"""The steps of each flow, written once: `run_plain` calls them, `inflight.flows.prefect_flows` wraps them.

Each takes a workspace and the parameters that the command line and a deployment name, and returns the fields
of a `RunReport`. How its batches run is the runner's affair (`inflight.flows.runner`).
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflight.catalog import Catalog, Workspace
from inflight.flows.cluster import dask_client, lazy_client
from inflight.flows.runner import runner
from inflight.flows.span import DateOrNone, DaySpan, month_span
from inflight.tasks import ReprocessSettings, RunReport, make_release
from inflight.tasks import ingest as ingest_files
from inflight.tasks import reprocess as reprocess_days
from inflight.tasks.analysis import DiagnoseSettings, diagnose_span

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_SETTINGS = ReprocessSettings()
#: Each day's own parameters with the month's offset along the spin axis.
MONTHLY_SETTINGS = ReprocessSettings(table="daily")
DIAGNOSE_SETTINGS = DiagnoseSettings()


def ingest(
    workspace: Path,
    data: Path | None = None,
    instruments: list[str] | None = None,
    start: DateOrNone = None,
    end: DateOrNone = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Take delivered files into the archive; files already taken in cost nothing.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    data : Path, optional
        Folder of the delivered files; ``data`` in the workspace when absent.
    instruments : list of str, optional
        Only these.
    start, end : date, optional
        UTC days, half-open; everything delivered when absent.
    workers : int, optional
        Dask processes; the cores when absent.

    Returns
    -------
    dict
        The fields of a `RunReport`.
    """
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with dask_client(workers) as client:
        return _take_in(place, data, instruments, span, client).as_json()


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
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with dask_client(workers) as client:
        return _make_products(place, span, settings, client).as_json()


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
        The fields of a `RunReport`: its days are those of the products; ``ingest`` says what was
        taken in.
    """
    span = DaySpan(start=start, end=end)
    return _bring_up_to_date("backfill", workspace, (span, span), settings, data, workers)


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
        What is not stated is as of `MONTHLY_SETTINGS`.
    data, workers
        As of the flow ``backfill``, and so is the result.
    """
    span = month_span(month, dt.datetime.now(dt.UTC).date())
    stated = MONTHLY_SETTINGS.model_copy(update=settings.model_dump(exclude_unset=True))
    return _bring_up_to_date("monthly", workspace, (span.with_neighbours(), span), stated, data, workers)


def diagnose(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: DiagnoseSettings = DIAGNOSE_SETTINGS,
    save: bool = False,
    workers: int | None = None,
) -> dict[str, Any]:
    """Find which effect is missing from the model; days looked at before cost nothing.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    start, end : date, optional
        UTC days, half-open; all days of the archive when absent.
    settings : DiagnoseSettings
        How it is done.
    save : bool
        Save a version of the model for every effect that was found.
    workers : int, optional
        Dask processes; the cores when absent.

    Returns
    -------
    dict
        The fields of a `Diagnosis`.
    """
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)

    def search(client: Client) -> dict[str, Any]:
        return diagnose_span(
            place, *span.as_text(), settings, save=save, client=client, progress=runner().progress
        )

    with lazy_client(workers) as client:
        return runner().run("search", search, client)


def release(
    workspace: Path, version: str, notes: str = "", destination: Path | None = None
) -> dict[str, Any]:
    """Freeze the published collection under a version and copy it out with manifest and notes.

    Parameters
    ----------
    workspace : Path
        Folder of the mission.
    version : str
        Never used before in this workspace.
    notes : str
        Text for the release notes.
    destination : Path, optional
        Folder the release goes to; ``releases`` in the workspace when absent.

    Returns
    -------
    dict
        The fields of a `RunReport`.
    """
    place = Workspace.open(workspace)
    report: RunReport = runner().run("copy out", make_release, place, version, notes, destination)
    return report.as_json()


#: What can be run by name, plainly or as a Prefect flow.
STEPS: dict[str, Callable[..., dict[str, Any]]] = {
    "ingest": ingest,
    "reprocess": reprocess,
    "backfill": backfill,
    "monthly": monthly,
    "diagnose": diagnose,
    "release": release,
}


def _take_in(
    place: Workspace, data: Path | None, instruments: list[str] | None, span: DaySpan, client: Client
) -> RunReport:
    """Index, read and write; the batches of days run on the client."""

    def take_in(client: Client) -> RunReport:
        return ingest_files(
            Catalog(place.root),
            place.mission(),
            data or place.data,
            instruments,
            *span.as_text(),
            client=client,
            progress=runner().progress,
        )

    return runner().run("take in", take_in, client)


def _make_products(place: Workspace, span: DaySpan, settings: ReprocessSettings, client: Client) -> RunReport:
    mapper = runner().mapper(client)
    return reprocess_days(
        Catalog(place.root), place.mission(), *span.as_text(), settings=settings, mapper=mapper
    )


def _bring_up_to_date(
    command: str,
    workspace: Path,
    spans: tuple[DaySpan, DaySpan],
    settings: ReprocessSettings,
    data: Path | None,
    workers: int | None,
) -> dict[str, Any]:
    """Take in the first span and reprocess the second one; `command` names the report."""
    place, (delivered, made) = Workspace.open(workspace), spans
    with dask_client(workers) as client:
        taken = _take_in(place, data, None, delivered, client)
        report = _make_products(place, made, settings, client)
    return taken.followed_by(report, command).as_json()
