"""The report of a whole-mission fit: fields for programs, lines for a person, and one self-contained page.

`mission_fit_report` reads the published tables (`read_mission_fit`) and makes each part of `SECTIONS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from inflight import __version__
from inflight.catalog import Catalog
from inflight.figures import html_page
from inflight.mission import Mission
from inflight.progress import Progress, silent, tell_each
from inflight.tasks.pipelines.base import Part, TextLine, with_unit
from inflight.tasks.pipelines.mission_fit.fit import MissionFitResults, read_mission_fit
from inflight.tasks.pipelines.mission_fit.parameter_sections import (
    behaviour,
    clock,
    coil_temperature,
    cross_talk,
    day_night,
    temperature,
)
from inflight.tasks.pipelines.mission_fit.sections import (
    MISSION_REPORT_SETTINGS,
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


@dataclass
class MissionFitReport:
    """Results of a whole-mission fit, section by section; `path` is the page, when one was written."""

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

    def summary(self) -> list[TextLine]:
        """Return residual, trend, coefficients far from their priors, clock faults, and what is absent."""
        sections = {part.key: part.fields for part in self.parts}
        size, trends = sections["residual"], sections["trend"]
        product = size["products_nT"]
        after = f", {product:.4g} nT in the products of all days together" if isfinite(product) else ""
        own = f"{size['own_fit_nT']:.4g} nT with each day's own nine"
        lines = [
            f"residual {size['before_nT']:.4g} nT before, {own}{after}",
            f"scale factors: {trends['kind']}; {trends.get('told', 'no rivals compared')}",
            *_coefficient_lines(sections["coefficients"]["items"]),
            *([lines["told"]] if (lines := sections["torquers"].get("lines")) else []),
            *([f"the body's field: eta {eta['told']}"] if (eta := sections["torquers"].get("eta")) else []),
            *_offset_lines(sections["offsets_from_spread"]),
            *(sections["clock_faults"].get("told") or []),
            *_cross_talk_lines(sections["cross_talk"].get("asked", {})),
        ]
        absent = [f"  not told: {what}: {why}" for part in self.parts for what, why in part.absent.items()]
        first, last = self.found.span
        title = f"{self.found.version}: {len(self.found.days)} days, {first} to {last}"
        return [
            TextLine(title, "bold"),
            *(TextLine(f"  {line}") for line in lines),
            *(TextLine(line, "dim") for line in absent),
        ]


def mission_fit_report(
    cat: Catalog,
    mission: Mission,
    comparison: str = "main",
    output: Path | None = None,
    cause: str = "",
    progress: Progress = silent,
) -> MissionFitReport:
    """Return what the published whole-mission fit found, and write the page of it when a path is given.

    Parameters
    ----------
    output : Path, optional
        Where the page goes; written whole, by one rename.
    cause : str
        A parameter or cause; the report then says what it does to all others when it is ignored.
    progress : callable, optional
        Called with ("sections", done, total).

    Raises
    ------
    SettingsError, CatalogError
        As `inflight.tasks.pipelines.mission_fit.fit.read_mission_fit`.
    """
    found = read_mission_fit(cat, mission, comparison)
    parts = tuple(
        make(found) if make is not cross_talk else cross_talk(found, cause)
        for make in tell_each(progress, "sections", SECTIONS)
    )
    if output is not None:
        first, last = found.span
        title = f"{mission.mission}: all days together, {first} to {last}"
        made = f"{found.version}; {len(found.days)} days; inflight {__version__}."
        footer = " ".join(text for text in (made, mission.acknowledgement) if text)
        sections = [(part.heading, part.text, part.plots) for part in parts]
        write_page(output, html_page(title, sections, footer))
    return MissionFitReport(found, parts, output)


def _coefficient_lines(items: list[Mapping[str, Any]]) -> list[str]:
    """Return how many coefficients are determined, and those far from what was known, farthest first."""
    known = sum(one["determined"] for one in items)
    head = f"{len(items)} coefficients, {known} determined;"
    far = [one for one in items if abs(one["shift_sigma"] or 0.0) > MISSION_REPORT_SETTINGS.far_sigma]
    if not far:
        return [f"{head} none is beyond {MISSION_REPORT_SETTINGS.far_sigma:g} sigma of what was known before"]
    return [
        f"{head} beyond {MISSION_REPORT_SETTINGS.far_sigma:g} sigma of what was known before:",
        *(
            f"  {one['name']} {with_unit(one['value'], one['sigma'], one['unit'])} "
            f"({one['shift_sigma']:+.1f})"
            for one in sorted(far, key=lambda one: -abs(one["shift_sigma"]))
        ),
    ]


#: Daily offsets are worth taking off when they are so many times their errors; assumed.
_WORTH = 2.0
#: Said of a law whose factor is not the orbit's.
_NO_OFFSET = ": what days differ by in their own fits is no offset along z that spreads the residual"


def _offset_lines(fields: Mapping[str, Any]) -> list[str]:
    """Return the law of the residual's spread, and what its daily offsets are; none where there is no law."""
    law, out, far = fields.get("law"), list[str](), MISSION_REPORT_SETTINGS.far_sigma
    if law:
        factor = with_unit(law["factor"], law["factor_sigma"], "")
        noise = with_unit(law["noise_nT2"], law["noise_sigma_nT2"], "nT2")
        out.append(
            f"std^2(dB) = ({factor}) Z0^2 + ({noise}) over {law['days']} days; "
            f"{law['geometry']:.4f} by the orbit"
            + ("" if abs(law["factor"] - law["geometry"]) < far * law["factor_sigma"] else _NO_OFFSET)
        )
    if "rms_nT" in fields:
        size, error = fields["rms_nT"], fields["sigma_rms_nT"]
        what = "'inflight add z_offset' takes them off" if size > _WORTH * error else "no more than noise"
        what = "the model takes them off" if fields["applied"] else what
        out.append(f"daily z offsets {size:.3g} nT rms, their errors {error:.3g} nT: {what}")
    return out


def _cross_talk_lines(found: Mapping[str, Any]) -> list[str]:
    """Return what one ignored cause does to the nine alone, and with all else fitted; largest first."""
    out = []
    for key, how in (("alone", "the nine fitted alone"), ("together", "everything else fitted")):
        if rows := found.get(key):
            out.append(f"ignoring {found['ignored']} = {found['size']:g} {found['size_unit']}, {how}:")
            rows = sorted(rows, key=lambda one: -abs(one["shift"]) / max(one["sigma"], 1e-300))
            out += [
                f"  {one['parameter']} {with_unit(one['shift'], one['sigma'], one['unit'])}"
                for one in rows[: MISSION_REPORT_SETTINGS.listed_shifts]
            ]
    return out
