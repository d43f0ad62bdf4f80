"""The flow ``release``: freeze what is published and copy it out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow

from inflight.catalog import Workspace
from inflight.flows.stages import batch_runner, step
from inflight.tasks import RunReport, make_release


@flow(name="release", task_runner=batch_runner(), persist_result=False)
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
    return copy_out(workspace, version, notes, destination).as_json()


@step("copy out")
def copy_out(workspace: Path, version: str, notes: str, destination: Path | None) -> RunReport:
    """Freeze and copy; refused, with the reason, while a day lacks its provenance or its cause."""
    return make_release(Workspace.open(workspace), version, notes, destination)
