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
from dataclasses import dataclass
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
from inflight.tasks.report import KeptPage, to_json, write_page

#: What a diagnosis is computed by, and what draws its page beside.
_DRAWN_BY = ("inflight.figures", "inflight.tasks")
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


@dataclass(frozen=True)
class DiagnosisReport:
    """A diagnosis, the fields of `Diagnosis.as_json`, and the page that shows it."""

    fields: Mapping[str, Any]
    path: Path

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        names = ["run", "context", "comparison", "model", "blocks", "verdict", "sentence", "entries"]
        names += ["residual", "remaining"]
        effects = [{"name": one["name"], "family": one["family"]} for one in self.fields["effects"]]
        return (
            {"command": "report", "path": str(self.path)}
            | {name: self.fields[name] for name in names}
            | {"effects": effects}
        )


def page_of_diagnosis(workspace: Workspace, comparison: str, start: str | None, end: str | None) -> Path:
    """Return where the page of a diagnosis lies unless another place is named."""
    return workspace.reports / f"{'-'.join(['report', comparison, *filter(None, (start, end))])}.html"


def keep_page(
    workspace: Workspace,
    path: Path,
    page: str,
    start: str | None,
    end: str | None,
    settings: DiagnoseSettings,
) -> None:
    """Keep that a page that was written shows the last diagnosis, where that is what was asked for.

    Parameters
    ----------
    path, page : Path, str
        Where, and its text.
    start, end, settings
        As of `diagnose_if_unchanged`.
    """
    if diagnose_if_unchanged(workspace, start, end, settings) is None:
        return
    asked = (last_diagnosis(workspace, settings.comparison) or {})["asked"]
    KeptPage.of(path, page, _drawn_from(asked)).save(_kept_page(workspace, settings.comparison))


def report_if_unchanged(
    workspace: Workspace,
    output: Path,
    start: str | None,
    end: str | None,
    settings: DiagnoseSettings,
) -> DiagnosisReport | None:
    """Return the page of the last diagnosis when that is still what `diagnose` would find, else None.

    Parameters
    ----------
    output : Path
        Where the page goes; it is copied when it lies elsewhere.
    start, end, settings
        As of `diagnose_if_unchanged`.
    """
    kept = KeptPage.read(_kept_page(workspace, settings.comparison))
    if kept is None:
        return None
    found = diagnose_if_unchanged(workspace, start, end, settings)
    asked = (last_diagnosis(workspace, settings.comparison) or {}).get("asked")
    if found is None or asked is None or kept.made_from != _drawn_from(asked):
        return None
    kept.copy_to(output)
    return DiagnosisReport(found, output)


def _drawn_from(asked: Mapping[str, Any]) -> str:
    """Return a hash of all that the page of a diagnosis is made from: what was asked, and what draws it."""
    what = {name: asked.get(name) for name in ("start", "end", "settings", "made_from")}
    return hashlib.sha256(json.dumps([what, hash_of_software(_DRAWN_BY)]).encode()).hexdigest()


def _kept_page(workspace: Workspace, comparison: str) -> Path:
    return workspace.reports / f"report-{comparison}.json"


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
    tables = _tables_told_of(cat, mission, settings.comparison) if through is None else []
    there = [one for one in archive if through is None or one[1] <= str(through)]
    # Not its version: an undo makes another of an older text.
    parts = [mission.text, used.model.name, used.text, settings.model_dump(), there, tables]
    return hashlib.sha256(json.dumps([*parts, hash_of_software()], default=str).encode()).hexdigest()


def _tables_told_of(cat: Catalog, mission: Mission, comparison: str) -> list[list[Any]]:
    """Return the tables that a diagnosis may say something of: id, key, who certified each.

    Of a scalar comparison the search reads the archive alone, and what is told of products is whether they
    follow a trend: without a table of all days they do not, whatever the tables of windows are.
    """
    known = [one for one in cat.tables() if one.name.startswith(comparison)]
    has_trend = any(one.name == f"{comparison}-continuous" for one in known)
    if mission.comparisons[comparison].kind == "scalar" and not has_trend:
        return []
    return [[one.id, one.key, one.certified] for one in known]


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
