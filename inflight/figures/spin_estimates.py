"""Figures of the eight spin-related parameters: estimates against uncertainty, and uncertainty over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import AFTER, BEFORE, NEW, REFERENCE, legend_below, plain_figure
from inflight.spin.equation import SPIN_RELATED, UNITS
from inflight.spin.layout import Bools
from inflight.spin.selection import Selection
from inflight.time import Int64, to_utc

#: Panels in the order of figure 3 of Plaschke et al. (2019).
_ORDER = (
    "gain_ratio",
    "azimuth",
    "spin_axis[x]",
    "spin_axis[y]",
    "offset[1]",
    "offset[2]",
    "elevation[1]",
    "elevation[2]",
)
#: The height of a panel is this many standard deviations of the chosen estimates to either side.
_TALL = 12.0
#: And it ends at this many times the threshold: the poorest estimates say nothing.
_WIDE = 3e3


@dataclass(frozen=True)
class Cloud:
    """Estimates of sub-intervals, and which of them a threshold chooses.

    Attributes
    ----------
    start, end : ndarray of int64, shape (sub,)
        TT2000.
    estimate, uncertainty : ndarray, shape (sub, 8)
        In the order of `SPIN_RELATED`.
    chosen : ndarray of bool, shape (sub, 8)
    threshold, value, sigma : ndarray, shape (8,)
        Largest uncertainty chosen; mean of the chosen ones and its error, infinite for none.
    """

    start: Int64
    end: Int64
    estimate: Floats
    uncertainty: Floats
    chosen: Bools
    threshold: Floats
    value: Floats
    sigma: Floats

    @classmethod
    def of(cls, found: Selection) -> Cloud:
        """Return the cloud of a selection."""
        one = found.estimates
        return cls(
            one.start,
            one.end,
            one.value,
            one.uncertainty,
            found.chosen,
            found.threshold,
            found.value,
            found.sigma,
        )


def estimates_figure(selection: Cloud, joint: tuple[Floats, Floats] | None = None) -> Any:
    """Draw the estimates of all sub-intervals against their uncertainties, as in the paper's figure 3.

    Parameters
    ----------
    selection : Cloud
        Chosen estimates are drawn in red, their mean as a line; the threshold is a dotted one.
    joint : tuple of (ndarray (8,), ndarray (8,)), optional
        Value and sigma of the joint estimate, drawn as a dashed line.
    """
    panels = [_estimates_panel(selection, joint, name) for name in _ORDER]
    return gridplot([panels[:4], panels[4:]], toolbar_location="above", merge_tools=True)


def _estimates_panel(selection: Cloud, joint: tuple[Floats, Floats] | None, name: str) -> figure:
    at = SPIN_RELATED.index(name)
    value, uncertainty = selection.estimate[:, at], selection.uncertainty[:, at]
    chosen = selection.chosen[:, at]
    known = np.isfinite(value) & (uncertainty > 0.0)
    unit = UNITS[name]
    plot = plain_figure(
        name,
        f"uncertainty ({unit})",
        f"estimate ({unit})",
        x_axis_type="log",
        y_range=_height(selection, at),
        width=290,
    )
    for which, colour, label in ((known & ~chosen, BEFORE, "others"), (known & chosen, NEW, "chosen")):
        plot.scatter(uncertainty[which], value[which], color=colour, size=3, alpha=0.6, legend_label=label)
    span = [float(uncertainty[known].min()), float(uncertainty[known].max())] if known.any() else [1e-6, 1.0]
    if np.isfinite(selection.threshold[at]):
        span[1] = min(span[1], _WIDE * float(selection.threshold[at]))
    plot.x_range = Range1d(0.7 * span[0], 1.4 * span[1])
    if np.isfinite(selection.sigma[at]):
        plot.line(span, [selection.value[at]] * 2, color=AFTER, line_width=2, legend_label="selection")
    if np.isfinite(selection.threshold[at]):
        limit = float(selection.threshold[at])
        plot.add_layout(Span(location=limit, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    if joint is not None and np.isfinite(joint[1][at]):
        plot.line(span, [joint[0][at]] * 2, color=REFERENCE, line_dash="dashed", legend_label="joint")
    legend_below(plot)
    return plot


def _height(selection: Cloud, at: int) -> Range1d:
    """Return a range in which the chosen estimates can be seen: poor ones lie orders of magnitude away."""
    value = selection.estimate[:, at]
    near = value[selection.chosen[:, at]]
    if near.size < 2:
        near = value[np.isfinite(value)]
    if near.size < 2:
        return Range1d(-1.0, 1.0)
    middle, scatter = float(np.median(near)), float(near.std())
    reach = _TALL * max(scatter, 1e-12)
    return Range1d(middle - reach, middle + reach)


def uncertainty_figure(selection: Cloud) -> Any:
    """Draw the uncertainties of the four pairs over time, as in panels c to f of the paper's figure 2."""
    hours = (to_utc(selection.start // 2 + selection.end // 2)).astype("datetime64[ms]")
    panels = []
    for name, title in (
        ("gain_ratio", "gain ratio; half of azimuth (1)"),
        ("spin_axis[x]", "spin axis (rad)"),
        ("offset[1]", "spin-plane offsets (nT)"),
        ("elevation[1]", "elevations (rad)"),
    ):
        at = SPIN_RELATED.index(name)
        panels.append(_time_panel(hours, selection.uncertainty[:, at], selection.chosen[:, at], title))
    return gridplot([[panel] for panel in panels], toolbar_location="above", merge_tools=True)


def _time_panel(hours: Any, uncertainty: Floats, chosen: Any, title: str) -> figure:
    plot = plain_figure(
        title, "time (UTC)", "uncertainty", width=820, height=190, x_axis_type="datetime", y_axis_type="log"
    )
    known = np.isfinite(uncertainty) & (uncertainty > 0.0)
    for which, colour in ((known & ~chosen, BEFORE), (known & chosen, NEW)):
        source = ColumnDataSource({"x": hours[which], "y": uncertainty[which]})
        plot.scatter("x", "y", source=source, color=colour, size=3)
    return plot
