"""The report of a diagnosis: one HTML file that needs nothing but itself."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from inflight import __version__
from inflight.catalog import Catalog
from inflight.diagnosis.diagnosis import Diagnosis
from inflight.diagnosis.material import Material
from inflight.diagnosis.pictures import seen_of
from inflight.diagnosis.search import Search
from inflight.diagnosis.verdict import conclude
from inflight.figures.found import found_effects, rivals_apart
from inflight.figures.ledger import facts_list, ledger_table
from inflight.figures.page import Section, html_page
from inflight.figures.verdict import verdict_strip
from inflight.mission import Mission
from inflight.tasks.chain_report import write_page
from inflight.tasks.diagnose import DiagnoseSettings, material_of, prepare, search_of
from inflight.tasks.diagnosis_sections import (
    error_falls,
    fails_here,
    follows,
    shapes,
    spectrum,
    stands_for,
    which_effect,
)
from inflight.tasks.report import Progress
from inflight.tasks.states_units import named_units
from inflight.time import DayLike, to_utc


@dataclass(frozen=True)
class DiagnosisReport:
    """A diagnosis and the page that shows it."""

    diagnosis: Diagnosis
    path: Path

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        told = self.diagnosis.as_json()
        names = ("run", "context", "comparison", "model", "verdict", "sentence", "residual", "remaining")
        effects = [{"name": one["name"], "family": one["family"]} for one in told["effects"]]
        return (
            {"command": "report", "path": str(self.path)}
            | {name: told[name] for name in names}
            | {"effects": effects}
        )


def report(
    cat: Catalog,
    mission: Mission,
    output: Path,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> DiagnosisReport:
    """Diagnose a span and write the page of it; evidence that is there already is not made again.

    Parameters
    ----------
    output : Path
        Where the page goes; written whole, by one rename.
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    client : distributed.Client, optional
        The pass runs on it.
    progress : callable, optional
        Called with (stage, done, total).

    Raises
    ------
    MissionError, ModelError, CatalogError, CalibrationError
        As `inflight.tasks.diagnose.diagnose` raises them.
    """
    examined = examine(cat, mission, start, end, settings, client=client, progress=progress)
    tell = progress or (lambda stage, done, total: None)
    tell("report", 0, 1)
    write_page(output, diagnosis_page(*examined))
    tell("report", 1, 1)
    return DiagnosisReport(examined.found, output)


class Examined(NamedTuple):
    """A finished search, and all that its sections are made from: arguments of `diagnosis_sections`."""

    search: Search
    material: Material
    found: Diagnosis
    settings: DiagnoseSettings
    facts: Mapping[str, Any]


def examine(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> Examined:
    """Diagnose a span and return with the result what it was made from; arguments are those of `report`."""
    settings = settings or DiagnoseSettings()
    tell = progress or (lambda stage, done, total: None)
    made = prepare(cat, mission, start, end, settings, client=client, progress=progress)
    tell("search", 0, 1)
    search, material = search_of(made, settings), material_of(made, mission)
    found = conclude(search, material)
    tell("search", 1, 1)
    facts = {"evidence key": made.plan.key, "days that failed": made.days_failed or None}
    units = named_units(cat, mission, settings.comparison, start, end)
    facts["units that switch"] = "; ".join(one["sentence"] for one in units) if units else None
    return Examined(search, material, found, settings, facts)


def diagnosis_page(
    search: Search,
    material: Material,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any] | None = None,
) -> str:
    """Return the page of a finished search as HTML; parameters are those of `diagnosis_sections`."""
    raw = search.raw
    first, last = (np.datetime_as_string(to_utc(int(edge)), "D") for edge in (raw.start[0], raw.end[-1] - 1))
    name = f"{material.mission.mission}: what is missing from the model, {first} to {last}"
    sections = diagnosis_sections(search, material, found, settings, facts)
    return html_page(name, sections, material.mission.acknowledgement)


def diagnosis_sections(
    search: Search,
    material: Material,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any] | None = None,
) -> list[Section]:
    """Return everything that is shown of a finished search.

    Parameters
    ----------
    search : Search
        As `conclude` left it.
    facts : mapping, optional
        More lines of the ledger.
    """
    seen = seen_of(search, material)
    told = found.as_json()
    strip = verdict_strip(found.verdict, found.sentence, told["residual"], told["remaining"]["verdict"])
    sections: list[Section] = [
        ("Verdict", [strip, *found_effects(told), *rivals_apart(told)], []),
        fails_here(seen),
        follows(seen, found),
        spectrum(seen, material),
        which_effect(search, material, found),
        error_falls(seen, search, material, found),
        shapes(seen, search, found),
        stands_for(search, found),
        _ledger(search, material, found, settings, facts or {}),
    ]
    return [section for section in sections if section[1] or section[2]]


# Ledger.


def _ledger(
    search: Search,
    material: Material,
    found: Diagnosis,
    settings: DiagnoseSettings,
    facts: Mapping[str, Any],
) -> Section:
    y = search.raw.residuals[search.residual]
    data = hashlib.sha256(np.ascontiguousarray(search.raw.gram[:, :, y]).tobytes()).hexdigest()
    rules = search.rules
    listed = {
        "mission": material.mission.mission,
        "comparison": found.comparison,
        "model": f"{found.model.get('name')} version {found.model.get('version')}",
        "blocks": f"{found.blocks['count']} of {found.blocks['length_s'] / 3600.0:.3g} h, "
        f"{found.blocks['independent']:.0f} of them independent",
        "samples left out": _left_out(found.outliers),
        "cadence of the search": f"{material.cadence_s:g} s",
        "settings": ", ".join(f"{name}={value}" for name, value in settings.model_dump().items()),
        "rules": f"t > {rules.t:g}, gain > {rules.gain:g}, family-wise p < {rules.p:g}, "
        f"over the best placebo t > {rules.t:g}",
        "seed of the sign flips": rules.seed,
        "sha256 of the data's products with the residual": data,
        "run": found.run,
        "context": found.context,
        "software": f"inflight {__version__}",
        **facts,
    }
    note = (
        "The search changes nothing: 'inflight add' puts an effect into a new version of the model, "
        "'inflight undo' returns to the version before it, 'inflight drop' takes out any effect."
    )
    text = [ledger_table(found.rounds), facts_list(listed), f'<p class="quiet">{escape(note)}</p>']
    return "Ledger", text, []


def _left_out(outliers: Mapping[str, Any]) -> str:
    """Return how many samples are not in the evidence, and when the first bursts of them were."""
    if not outliers:
        return "none"
    text = f"{outliers['samples']}, {outliers['spikes']} of them single"
    if not outliers["burst_count"]:
        return text
    kept = ", kept because they hold too much of the span" if outliers["kept"] else ""
    told = [
        f"{one['start']} to {one['end']} ({one['times_usual']:.0f} times the usual scatter)"
        for one in outliers["bursts"]
    ]
    more = "; ..." if len(told) < outliers["burst_count"] else ""
    return f"{text}; {outliers['burst_count']} bursts{kept}: {'; '.join(told)}{more}"
