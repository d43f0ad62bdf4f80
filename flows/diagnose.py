"""The flow ``diagnose``: look at every day once, find which effect is missing, and add it when asked to."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow

from inflight.catalog import Workspace
from inflight.flows.cluster import client_when_needed
from inflight.flows.progress import tell
from inflight.flows.span import DateOrNone, Span
from inflight.flows.stages import batch_runner, step, unsearched
from inflight.tasks.analysis import DiagnoseSettings, diagnose_span

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_SETTINGS = DiagnoseSettings()


@flow(name="diagnose", task_runner=batch_runner(), persist_result=False)
def diagnose(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: DiagnoseSettings = DEFAULT_SETTINGS,
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
    span = Span(start=start, end=end)
    with client_when_needed(workers) as client:
        return search(workspace, span, settings, save, unsearched(client))


@step("search")
def search(
    workspace: Path, span: Span, settings: DiagnoseSettings, save: bool, client: Client
) -> dict[str, Any]:
    """Make the evidence on the client, and put the question to it."""
    place = Workspace.open(workspace)
    return diagnose_span(place, *span.as_text(), settings, save=save, client=client, progress=tell)
