"""Release: what is published becomes a frozen collection, copied out with manifest and notes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from inflight.catalog import Catalog, Workspace
from inflight.progress import Progress, silent
from inflight.tasks.report import RunReport


def make_release(
    workspace: Workspace,
    version: str,
    notes: str = "",
    destination: Path | None = None,
    formats: Sequence[str] = ("zarr",),
    maturity: str = "preliminary",
    progress: Progress = silent,
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
    formats : sequence of str
        ``zarr``, ``cdf`` and ``netcdf``.
    maturity : str
        ``quick-look``, ``preliminary`` or ``definitive``, for which tables must be approved.
    progress : callable, optional
        Called with (stage, done, total).

    Returns
    -------
    RunReport
        Its days are those of all released datasets together.

    Raises
    ------
    CatalogError
        When the version was used before, a day lacks its provenance or its cause, or files of a day lack keys
        of the mission YAML.
    """
    from inflight.tasks.release_documents import write_documents  # draws: figures are slow to load

    catalog = Catalog(workspace.root)
    folder = catalog.release(
        version,
        notes=notes,
        destination=destination,
        formats=formats,
        mission=workspace.mission(),
        documents=partial(write_documents, workspace, progress=progress),
        maturity=maturity,
        progress=progress,
    )
    released = (item for item in catalog.inventory() if item["dataset"].startswith(("l1/", "l2/")))
    published = sum(item["days"] for item in released)
    return RunReport(
        "release",
        days={"planned": published, "done": published},
        outputs=[workspace.relative(folder)],
        extra={"version": version, "formats": list(formats), "maturity": maturity},
    )


def plan_release(
    workspace: Workspace,
    version: str,
    formats: Sequence[str] = ("zarr",),
    maturity: str = "preliminary",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Return what `make_release` would copy out and what stands against it; nothing is written.

    Returns
    -------
    dict
        ``version``, ``formats``, ``maturity``, ``tables``, ``parts``, ``previous``, ``changes``,
        ``next_version`` (as `ReleasePlan` has them) and ``objections``: the fields of an error each.
    """
    plan = Catalog(workspace.root).plan_release(
        version, formats=formats, mission=workspace.mission(), maturity=maturity, progress=progress
    )
    return {
        "command": "release",
        "version": version,
        "formats": list(formats),
        "maturity": maturity,
        "tables": plan.tables,
        "parts": [dict(part) for part in plan.parts],
        "previous": plan.previous,
        "changes": dict(plan.changes),
        "next_version": plan.next_version,
        "objections": [error.as_json() for error in plan.objections],
    }
