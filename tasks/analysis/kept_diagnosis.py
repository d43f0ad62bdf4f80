"""The last diagnosis of a workspace: kept, read, and given again while nothing has changed.

Takes what `diagnose_span` found; writes it whole into the workspace's reports. A diagnosis is a function
of the archive, the mission, the model, the settings and the software: `made_from` is a hash of all of
these, and `diagnose_if_unchanged` returns the last answer when it is the same. It reads no samples.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.tasks.analysis.settings import DiagnoseSettings, require_sampled
from inflight.tasks.archive import ArchiveIndex, channel_needs, needs_of
from inflight.tasks.models import current_model
from inflight.tasks.report import to_json, write_page

#: What a diagnosis is computed by.
_SOFTWARE = (
    "inflight.calibration",
    "inflight.design",
    "inflight.diagnosis",
    "inflight.dual",
    "inflight.effects",
    "inflight.lsq",
    "inflight.model",
    "inflight.plumbing",
    "inflight.residual",
    "inflight.samples",
    "inflight.tasks.analysis",
    "inflight.tasks.archive",
)


def save_diagnosis(workspace: Workspace, fields: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Write a diagnosis whole or not at all, with what was asked for; a read-only workspace keeps none."""
    path = workspace.reports / f"diagnosis-{fields['comparison']}.json"
    with suppress(OSError):
        write_page(path, to_json({**fields, "asked": asked}))


def last_diagnosis(workspace: Workspace, comparison: str = "main") -> dict[str, Any] | None:
    """Return the last diagnosis of a comparison, with ``asked`` (span, settings); None without any."""
    path = workspace.reports / f"diagnosis-{comparison}.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def diagnose_if_unchanged(
    workspace: Workspace, start: str | None, end: str | None, settings: DiagnoseSettings
) -> dict[str, Any] | None:
    """Return the last diagnosis when the same was asked and nothing it was made from has changed, else None.

    Parameters
    ----------
    start, end, settings
        As of `diagnose_span`.

    Returns
    -------
    dict or None
        As of `diagnose_span`, with ``unchanged`` true.
    """
    found = last_diagnosis(workspace, settings.comparison)
    asked = (found or {}).pop("asked", None) or {}
    if found is None or not asked_alike(asked, start, end, settings):
        return None
    mission = workspace.mission()
    require_sampled(mission, settings.comparison)
    cat = Catalog(workspace.root)
    if asked.get("made_from") != made_from(cat, mission, settings, archive_of(cat, mission, settings)):
        return None
    return {**found, "unchanged": True}


def asked_alike(
    asked: Mapping[str, Any], start: str | None, end: str | None, settings: DiagnoseSettings
) -> bool:
    """Return True when a kept diagnosis is of the same span and settings."""
    same = {"start": start, "end": end, "settings": settings.model_dump()}
    return bool({name: asked.get(name) for name in same} == json.loads(to_json(same)))


def archive_of(cat: Catalog, mission: Mission, settings: DiagnoseSettings) -> list[list[Any]]:
    """Return dataset, day, id and key of every day of the archive that a diagnosis may read."""
    used = current_model(cat, mission, settings.comparison)
    index = ArchiveIndex.of(cat, [*needs_of(mission, used.model), *channel_needs(mission)])
    return sorted([name, str(day), record.id, record.key] for (name, day), record in index.days.items())


def made_from(
    cat: Catalog,
    mission: Mission,
    settings: DiagnoseSettings,
    archive: Sequence[Sequence[Any]],
    through: np.datetime64 | None = None,
) -> str:
    """Return a hash of all that a diagnosis is made from but the span: archive, tables, model, software.

    Parameters
    ----------
    archive : list of list
        Of `archive_of`.
    through : datetime64[D], optional
        Of the days up to this one, and of no tables: a day's calibration makes others.
    """
    used = current_model(cat, mission, settings.comparison)
    tables = [
        [one.id, one.key, one.certified]
        for one in (cat.tables() if through is None else ())
        if one.name.startswith(settings.comparison)
    ]
    there = [one for one in archive if through is None or one[1] <= str(through)]
    # Not its version: an undo makes another of an older text.
    parts = [mission.text, used.model.name, used.text, settings.model_dump(), there, tables]
    return hashlib.sha256(json.dumps([*parts, hash_of_software()], default=str).encode()).hexdigest()


@cache
def hash_of_software(packages: tuple[str, ...] = _SOFTWARE) -> str:
    """Return a hash of the code and templates of packages: a version would miss what is being written."""
    found = hashlib.sha256()
    for name in packages:
        spec = find_spec(name)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted([*Path(folder).glob("*.py"), *Path(folder).glob("templates/*.*")]):
                found.update(path.name.encode() + path.read_bytes())
    return found.hexdigest()


def hashes_of_companions(cat: Catalog, mission: Mission) -> list[str]:
    """Return a hash of each file that the mission names and the workspace has.

    Raises
    ------
    OSError
        When one cannot be read.
    """
    files = [Path(cat.workspace) / name for name in mission.companions]
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.exists()]
