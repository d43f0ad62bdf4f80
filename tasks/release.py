"""Release: what is published becomes a frozen collection, copied out with manifest and notes."""

from __future__ import annotations

from pathlib import Path

from inflight.catalog import Catalog, Workspace
from inflight.tasks.report import RunReport


def make_release(
    workspace: Workspace, version: str, notes: str = "", destination: Path | None = None
) -> RunReport:
    """Freeze the published collection under a version and copy it out.

    Parameters
    ----------
    workspace : Workspace
        Where.
    version : str
        Never used before in this workspace.
    notes : str
        Text for the release notes.
    destination : Path, optional
        Folder the release goes to; ``releases`` in the workspace when absent.

    Returns
    -------
    RunReport
        Its days are those of all released datasets together.

    Raises
    ------
    CatalogError
        When the version was used before, or a day lacks its provenance or its cause.
    """
    catalog = Catalog(workspace.root)
    folder = catalog.release(version, notes=notes, destination=destination)
    published = sum(item["days"] for item in catalog.inventory())
    return RunReport(
        "release",
        days={"planned": published, "done": published},
        outputs=[workspace.relative(folder)],
        extra={"version": version},
    )
