"""The last diagnosis of a workspace: kept, read, and given again while nothing has changed.

Takes what `diagnose_span` found; writes it whole into the workspace's reports. A diagnosis is a function
of the archive, the mission, the model, the settings and the software: `made_from` is a hash of all of
these, and `diagnose_if_unchanged` returns the last answer when it is the same. So is its page, which
`report_if_unchanged` returns. It reads no samples.
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
from inflight.tasks.analysis.kept_page import KeptPage
from inflight.tasks.analysis.settings import DiagnoseSettings, require_sampled
from inflight.tasks.archive import ArchiveIndex, channel_needs, needs_of
from inflight.tasks.models import current_model
from inflight.tasks.report import to_json, write_page
from inflight.time import DayLike

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
#: What draws its page, beside these.
_DRAWN_BY = ("inflight.figures", "inflight.tasks")


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
    now = asked_of(Catalog(workspace.root), mission, start, end, settings)
    if asked.get("made_from") != now["made_from"]:
        return None
    return {**found, "unchanged": True}


def asked_of(
    cat: Catalog, mission: Mission, start: DayLike | None, end: DayLike | None, settings: DiagnoseSettings
) -> dict[str, Any]:
    """Return what is kept with a diagnosis: span, settings, and a hash of all that it is made from.

    Taken before the search begins: what changes meanwhile makes the next one.
    """
    first, last = (None if one is None else str(one) for one in (start, end))
    archive = archive_of(cat, mission, settings)
    hashed = made_from(cat, mission, settings, archive, product_inputs(cat, mission, settings, first, last))
    return {"start": first, "end": last, "settings": settings.model_dump(), "made_from": hashed}


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


def keep_report(workspace: Workspace, report: DiagnosisReport, page: str, asked: Mapping[str, Any]) -> None:
    """Keep what a page shows, and of which search it is.

    Parameters
    ----------
    page : str
        The text of the page at `report.path`.
    asked : mapping
        Of `asked_of`, before that search.
    """
    fields = json.loads(to_json(report.fields))
    kept = _KeptReport.of(report.path, page, _drawn_from(asked), fields=fields)
    kept.save(_kept_report(workspace, asked))


def report_if_unchanged(
    workspace: Workspace, output: Path, start: str | None, end: str | None, settings: DiagnoseSettings
) -> DiagnosisReport | None:
    """Return the page that was written of a diagnosis when it would be the same now, else None.

    Parameters
    ----------
    output : Path
        Where the page goes; it is copied when it lies elsewhere.
    start, end, settings
        As of `diagnose_if_unchanged`.
    """
    named = {"start": start, "end": end, "settings": settings.model_dump()}
    kept = _KeptReport.read(_kept_report(workspace, named))
    if kept is None:
        return None
    asked = asked_of(Catalog(workspace.root), workspace.mission(), start, end, settings)
    if kept.made_from != _drawn_from(asked):
        return None
    kept.copy_to(output)
    return DiagnosisReport(kept.fields, output)


class _KeptReport(KeptPage):
    """What is kept of the page of a diagnosis; `fields` are those of `DiagnosisReport`."""

    fields: dict[str, Any]


def _drawn_from(asked: Mapping[str, Any]) -> str:
    """Return a hash of all that the page of a diagnosis is made from: what was asked, and what draws it."""
    return hashlib.sha256(json.dumps([asked, hash_of_software(_DRAWN_BY)]).encode()).hexdigest()


def _kept_report(workspace: Workspace, asked: Mapping[str, Any]) -> Path:
    page = page_of_diagnosis(workspace, asked["settings"]["comparison"], asked["start"], asked["end"])
    return page.with_suffix(".json")


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
    products: Sequence[Any] = (),
    through: np.datetime64 | None = None,
) -> str:
    """Return a hash of all that a diagnosis is made from but the span: archive, model, products, software.

    Parameters
    ----------
    archive : list of list
        Of `archive_of`.
    products : sequence
        Of `product_inputs`; a search of the archive alone has none.
    through : datetime64[D], optional
        Of the days up to this one.
    """
    used = current_model(cat, mission, settings.comparison)
    there = [one for one in archive if through is None or one[1] <= str(through)]
    own, taken = hashes_of_companions(cat, mission), used.model.taken_tables
    # Not its version: an undo makes another of an older text.
    parts = [mission.text, own, used.model.name, used.text, taken, settings.model_dump(), there, *products]
    return hashlib.sha256(json.dumps([*parts, hash_of_software()], default=str).encode()).hexdigest()


def product_inputs(
    cat: Catalog, mission: Mission, settings: DiagnoseSettings, start: DayLike | None, end: DayLike | None
) -> list[Any]:
    """Return what of products and their tables a diagnosis is made from.

    Of a scalar comparison the search reads the archive alone, and what is told of products is whether they
    follow a trend, for which there is a table of all days. Others tell of states and units, which are learnt.
    """
    name = settings.comparison
    if mission.comparisons[name].kind != "scalar":
        tables = [[one.id, one.key, one.certified] for one in cat.tables() if one.name.startswith(name)]
        return [*tables, cat.hash_of_days([one for one in cat.dataset_names() if one.startswith("l2/")])]
    if not cat.tables(f"{name}-continuous"):
        return []
    from inflight.tasks.pipelines import trend_of_products

    return [trend_of_products(cat, name, current_model(cat, mission, name).version, start, end)]


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
