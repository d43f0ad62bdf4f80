"""The page of a spin comparison's `compare`: tones before and after, and what they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.figures import daily_figure, wander_figure
from inflight.figures.page import Later, html_table
from inflight.figures.spin_tones import (
    mean_turn_figure,
    tone_dependence_figure,
    tone_name,
    tones_over_time_figure,
)
from inflight.mission import Mission
from inflight.spin.residual_tones import TONES, ToneDependence, Tones
from inflight.tasks.compare_page import CompareReport, fails_text, wandering_text
from inflight.time import Int64

#: Tones drawn over time.
_SHOWN = 2


@dataclass
class SpinCompareReport(CompareReport):
    """What `compare` found of a turning sensor; `tones` are the rms of each before and after, nT."""

    tones: tuple[Floats, Floats] = (np.zeros(len(TONES)), np.zeros(len(TONES)))

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return super().as_json() | {
            "tones": [
                {
                    "row": ("axial", "modulus")[row],
                    "harmonic": harmonic,
                    "before_nT": before,
                    "after_nT": after,
                }
                for (row, harmonic), before, after in zip(
                    TONES, *(one.tolist() for one in self.tones), strict=True
                )
            ]
        }


@dataclass(frozen=True)
class SpinDrawn:
    """What the page draws: intervals' times and tones, mean turns, and what the tones follow."""

    time: Int64
    before: Tones
    after: Tones
    turns: tuple[ToneDependence | None, ToneDependence | None]
    found: Sequence[ToneDependence]


def spin_parts(report: SpinCompareReport, drawn: SpinDrawn) -> list[Later]:
    """Return everything that is shown of a spin comparison, as the page and the explorer have it."""
    return [
        ("Residual", lambda: (_told(report), _residual_figures(report, drawn))),
        ("Where it fails", lambda: (fails_text(report), [])),
        (
            "What the tones follow",
            lambda: ([_legend(report), _in_step(drawn.found)], _dependence_figures(drawn)),
        ),
        ("Parameters", lambda: ([wandering_text(report)], [wander_figure(report.wander)])),
    ]


def _residual_figures(report: SpinCompareReport, drawn: SpinDrawn) -> list[Any]:
    day = np.array([entry["day"] for entry in report.by_day], dtype="datetime64[ns]")
    before, after = (np.array([entry[name] for entry in report.by_day]) for name in ("before_nT", "after_nT"))
    daily = daily_figure(day, before, after, report.floor.level_nT)
    daily.title.text = "What goes with the spin, each day"
    strongest = np.argsort(-drawn.after.size)[:_SHOWN]
    over_time = [
        tones_over_time_figure(drawn.time, drawn.before, drawn.after, int(tone)) for tone in strongest
    ]
    return [daily, mean_turn_figure(*drawn.turns), *over_time]


def _dependence_figures(drawn: SpinDrawn) -> list[Any]:
    varying = [one for one in drawn.found if len(one.centre) > 1]
    varying.sort(key=lambda one: (not one.clear.any(), -one.amplitude[one.strongest]))
    return [tone_dependence_figure(one, one.strongest) for one in varying]


def spin_title(report: SpinCompareReport, mission: Mission) -> str:
    """Return what the page is headed with."""
    first, last = report.by_day[0]["day"], report.by_day[-1]["day"]
    return f"{mission.mission}: what still goes with the spin, {first} to {last}"


def _told(report: SpinCompareReport) -> list[str]:
    rows = [
        (tone_name(tone), f"{before:.5f}", f"{after:.5f}")
        for tone, (before, after) in enumerate(zip(*report.tones, strict=True))
    ]
    rows.append(("all, a row", f"{report.before.rms:.5f}", f"{report.after.rms:.5f}"))
    floor = report.floor
    note = (
        f"Rms over intervals, by weights that fall with nature's own noise in each. Nature's noise at the "
        f"neighbouring frequencies would alone leave {floor.level_nT:.5f} nT a row (95 % interval "
        f"{floor.low_nT:.5f} to {floor.high_nT:.5f}): how much a turn's tones differ from the next turn's. "
        f"{report.left_out} samples of turns with too few readings are left out."
    )
    return [html_table(("tone", "pre-flight, nT", "calibrated, nT"), rows), f"<p>{escape(note)}</p>"]


def _legend(report: SpinCompareReport) -> str:
    return (
        "Of each coordinate the tone that follows it most, less its mean: cosine and sine of the spin's "
        f"phase, clear ones first; bars are one sigma between blocks of one {report.block}."
    )


def _in_step(found: Sequence[ToneDependence]) -> str:
    """Return the table of channels that go with the spin themselves."""
    rows = []
    for one in (one for one in found if one.coordinate.wheel is not None):
        tone = one.strongest
        slope, sigma = np.abs(one.mean[0, tone]), one.sigma[0, tone]
        unit = f"nT/{one.coordinate.unit}" if one.coordinate.unit else "nT"
        told = f"{one.amplitude[tone]:.4f} +- {one.sigma_amplitude[tone]:.4f}"
        rows.append((one.coordinate.name, tone_name(tone), told, f"{slope:.3g} +- {sigma:.1g} {unit}"))
    if not rows:
        return ""
    head = ("channel", "residual tone in step with it", "rms, nT", "size for each unit")
    return html_table(head, rows)
