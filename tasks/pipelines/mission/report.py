"""All results of a mission's chain: as fields for programs, and as one page that needs nothing but itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inflight import __version__
from inflight.catalog import Catalog
from inflight.figures import html_page
from inflight.mission import Mission
from inflight.tasks.pipelines.base import Part
from inflight.tasks.pipelines.mission.fit import MissionFitResults, read_mission_fit
from inflight.tasks.pipelines.mission.parameter_sections import (
    behaviour,
    clock,
    coil_temperature,
    cross_talk,
    day_night,
    temperature,
)
from inflight.tasks.pipelines.mission.sections import (
    coefficients,
    current_steps,
    jumps,
    offsets,
    panels,
    residual,
    torquers,
    trend,
)
from inflight.tasks.report import write_page

#: In the order of the page.
SECTIONS: tuple[Callable[[MissionFitResults], Part], ...] = (
    residual,
    coefficients,
    trend,
    jumps,
    current_steps,
    panels,
    torquers,
    offsets,
    behaviour,
    clock,
    temperature,
    coil_temperature,
    day_night,
    cross_talk,
)


@dataclass(frozen=True)
class MissionFitReport:
    """Results of a chain, section by section; `path` is the page, when one was written."""

    found: MissionFitResults
    parts: tuple[Part, ...]
    path: Path | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON; `absent` says what the span cannot tell, and why."""
        found = self.found
        return {
            "command": "chain",
            "comparison": found.comparison,
            "model": found.version,
            "span": found.span,
            "days": len(found.days),
            "tables": {name: f"{found.comparison}-{name}" for name in sorted(found.tables)},
            "sections": {part.key: part.fields | {"absent": part.absent} for part in self.parts},
            "path": str(self.path) if self.path else "",
        }


def mission_fit_report(
    cat: Catalog, mission: Mission, comparison: str = "main", output: Path | None = None, cause: str = ""
) -> MissionFitReport:
    """Tell what the whole chain found, and write the page of it when a path is given.

    Parameters
    ----------
    output : Path, optional
        Where the page goes; written whole, by one rename.
    cause : str
        A parameter or cause: what it does to all others when it is ignored is told, too.

    Raises
    ------
    SettingsError, CatalogError
        As `inflight.tasks.pipelines.mission.fit.read_mission_fit`.
    """
    found = read_mission_fit(cat, mission, comparison)
    parts = tuple(make(found) if make is not cross_talk else cross_talk(found, cause) for make in SECTIONS)
    if output is not None:
        write_page(output, mission_fit_page(found, parts))
    return MissionFitReport(found, parts, output)


def mission_fit_page(found: MissionFitResults, parts: tuple[Part, ...]) -> str:
    """Return the page as HTML."""
    first, last = found.span
    title = f"{found.mission.mission}: all days together, {first} to {last}"
    made = f"{found.version}; {len(found.days)} days; inflight {__version__}."
    footer = " ".join(part for part in (made, found.mission.acknowledgement) if part)
    return html_page(title, [(part.heading, part.text, part.plots) for part in parts], footer)
