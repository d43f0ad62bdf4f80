"""The flow ``ingest``: delivered files become archive days."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow

from inflight.catalog import Catalog, Workspace
from inflight.flows.cluster import dask_client
from inflight.flows.progress import tell
from inflight.flows.span import DateOrNone, Span
from inflight.flows.stages import batch_runner, step, unsearched
from inflight.tasks import RunReport
from inflight.tasks import ingest as ingest_files

if TYPE_CHECKING:
    from distributed import Client


@flow(name="ingest", task_runner=batch_runner(), persist_result=False)
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
    span = Span(start=start, end=end)
    with dask_client(workers) as client:
        return take_in(workspace, data, instruments, span, unsearched(client)).as_json()


@step("take in")
def take_in(
    workspace: Path, data: Path | None, instruments: Sequence[str] | None, span: Span, client: Client
) -> RunReport:
    """Index, read and write; the batches of days run on the client."""
    place = Workspace.open(workspace)
    return ingest_files(
        Catalog(place.root),
        place.mission(),
        data or place.data,
        instruments,
        *span.as_text(),
        client=client,
        progress=tell,
    )
