"""The page of a comparison: the report's numbers and figures in one static HTML file."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.figures import (
    daily_figure,
    dependence_figure,
    histogram_figure,
    html_page,
    parameter_figures,
    series_figure,
    spectrum_figure,
)
from inflight.figures.page import html_table
from inflight.mission import Mission
from inflight.statistics import Dependence, NoiseFloor, Size
from inflight.time import SECOND, to_utc

#: Points of the figure of the residual in time.
_POINTS = 20_000


@dataclass
class CompareReport:
    """What `compare` found; `path` is the page, when one was written."""

    comparison: str
    context: str
    before: Size
    after: Size
    floor: NoiseFloor
    by_day: list[dict[str, Any]]
    fails_where: list[Dependence]
    directions: list[str]
    determined: list[str]
    path: Path | None = None
    left_out: int = 0
    outliers: int = 0
    acknowledgement: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": "compare",
            "run": "",
            "context": self.context,
            "comparison": self.comparison,
            "residual": {
                "before_nT": self.before.rms,
                "after_nT": self.after.rms,
                "before_less_mean_nT": self.before.std,
                "after_less_mean_nT": self.after.std,
                "noise_floor_nT": self.floor.level_nT,
                "noise_floor_interval_nT": [self.floor.low_nT, self.floor.high_nT],
                "before": self.before.as_json(),
                "after": self.after.as_json(),
                "samples_left_out": self.left_out,
                "outliers": self.outliers,
            },
            "by_day": self.by_day,
            "fails_where": [
                {
                    "coordinate": one.coordinate,
                    "amplitude_nT": one.amplitude,
                    "sigma_nT": one.sigma_amplitude,
                    "sentence": one.sentence,
                }
                for one in self.fails_where
            ],
            "parameters": {"determined": self.determined, "combinations": self.directions},
            "path": str(self.path) if self.path else "",
        }


@dataclass(frozen=True)
class Drawn:
    """Aggregates that the figures are drawn from: histograms, means of short spans, spectra, tables."""

    counts: dict[str, Floats]
    rows: dict[str, Floats]
    density: tuple[Floats, Floats, Floats]
    found: list[Dependence]
    tables: tuple[xr.Dataset, xr.Dataset]


def write_page(report: CompareReport, output: Path, mission: Mission, drawn: Drawn) -> None:
    """Write the static page whole, by one rename."""
    rows, counts = drawn.rows, drawn.counts
    day = np.array([entry["day"] for entry in report.by_day], dtype="datetime64[ns]")
    before = np.array([entry["before_nT"] for entry in report.by_day])
    after = np.array([entry["after_nT"] for entry in report.by_day])
    lines = {name: period / SECOND for name, period in mission.periods.items()}
    overview = [
        daily_figure(day, before, after, report.floor.level_nT),
        histogram_figure(counts["edges"], counts["before"], counts["after"]),
    ]
    if drawn.density[0].size:
        overview.append(spectrum_figure(*drawn.density, lines))
    series = series_figure(*_thinned(rows))
    first, last = report.by_day[0]["day"], report.by_day[-1]["day"]
    order = sorted(drawn.found, key=lambda one: -one.amplitude)
    page = html_page(
        f"{mission.mission}: model against measurement, {first} to {last}",
        [
            ("Residual", _told(report), [*overview, series]),
            ("Parameters", _known(report), parameter_figures(*drawn.tables)),
            ("Where it fails", _fails(report), [dependence_figure(one) for one in order]),
        ],
        mission.acknowledgement,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    unfinished = output.with_name(f".{output.name}.part")
    unfinished.write_text(page, encoding="utf-8")
    unfinished.replace(output)
    report.path = output


def _thinned(rows: dict[str, Floats]) -> tuple[Any, Floats, Floats, Floats]:
    """Return UTC, mean, lowest and highest of at most `_POINTS` groups of rows: what a browser can draw."""
    shown = np.flatnonzero(np.isfinite(rows["after"]))
    if not shown.size:
        return to_utc(np.empty(0, dtype=np.int64)), np.empty(0), np.empty(0), np.empty(0)
    first = np.arange(0, shown.size, -(-shown.size // _POINTS))
    count = np.diff(np.append(first, shown.size))
    return (
        to_utc(rows["tt2000"][shown][first].astype(np.int64)),
        np.add.reduceat(rows["after"][shown], first) / count,
        np.minimum.reduceat(rows["low"][shown], first),
        np.maximum.reduceat(rows["high"][shown], first),
    )


def _told(report: CompareReport) -> list[str]:
    rows = [
        ("pre-flight model", report.before),
        ("calibrated", report.after),
    ]
    head = ("nT", "rms", "mean", "std", "robust sigma", "least", "largest", "samples")
    cells = [
        (name, *(f"{v:.4f}" for v in (s.rms, s.mean, s.std, s.robust, s.least, s.largest)), f"{s.count}")
        for name, s in rows
    ]
    note = (
        f"Noise floor {report.floor.level_nT:.4f} nT, 95 % interval {report.floor.low_nT:.4f} to "
        f"{report.floor.high_nT:.4f} (white level of the calibrated residual between a tenth of the Nyquist "
        f"frequency and the Nyquist frequency, what falls with the frequency taken off). "
        f"{report.left_out} samples without a measurement are "
        f"left out; {report.outliers} outliers count in this table, but not in the spectra and dependences."
    )
    return [html_table(head, cells), escape(note)]


def _known(report: CompareReport) -> list[str]:
    names = ", ".join(name.split(".", 1)[-1] for name in report.determined) or "none"
    text = [f"Parameters that the span's data determine by themselves: {escape(names)}."]
    if len(report.determined) < len(report.directions) or not report.determined:
        listed = "".join(f"<li>{escape(line)}</li>" for line in report.directions)
        text.append(
            f"The data determine {len(report.directions)} combinations, in units of each prior's sigma, "
            f"best known first; everything else stays at its prior:<ol>{listed}</ol>"
        )
    return text


def _fails(report: CompareReport) -> list[str]:
    if not report.fails_where:
        return ["No dependence stands out by five sigma between blocks of three hours."]
    return ["<ul>" + "".join(f"<li>{escape(one.sentence)}</li>" for one in report.fails_where) + "</ul>"]
