"""Figures of zero levels: what each method says, which intervals are of which kind, scatter, and trend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import FixedTicker, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures import (
    AFTER,
    BEFORE,
    COMPONENTS,
    HIGHLIGHT,
    REFERENCE,
    error_bars,
    legend_below,
    log_ticks,
    plain_figure,
)
from inflight.scorecard.zero_level_studies import PUBLISHED, ScatterWithHours
from inflight.time import DAY
from inflight.zero_level import AXES, KIND_SETTINGS, CombinedEstimate, IntervalKinds, OffsetSets

#: Distance of an axis' mark from the method's place.
_APART = 0.18


def methods_figure(found: CombinedEstimate) -> figure:
    """Draw the offset of every method and of all, with errors of one sigma, axis by axis."""
    estimates = [*found.methods, found.estimate]
    names = [*(one.method for one in found.methods), "combined"]
    verdict = "methods agree" if found.agrees else "METHODS DISAGREE"
    plot = plain_figure(f"Zero level by method: {verdict}", "", "nT", width=520)
    for place, (axis, colour) in enumerate(zip(AXES, COMPONENTS, strict=True)):
        known = [one.determined[place] for one in estimates]
        x = np.arange(len(estimates))[known] + _APART * (place - 1)
        value = np.array([one.value[place] for one in estimates])[known]
        sigma = np.array([one.sigma[place] for one in estimates])[known]
        error_bars(plot, x, value, sigma, colour)
        plot.scatter(x, value, color=colour, size=6, legend_label=axis)
    plot.xaxis.ticker = FixedTicker(ticks=list(range(len(names))))
    plot.xaxis.major_label_overrides = dict(enumerate(names))
    plot.x_range.start, plot.x_range.end = -0.5, len(names) - 0.5
    legend_below(plot)
    return plot


def kinds_figure(kinds: IntervalKinds) -> figure:
    """Draw turning against compression of every interval, with the limits of the kinds."""
    plot = plain_figure(kinds.summary(), "compression / variance", "turning (rad)", width=470)
    parts = (
        (kinds.alfvenic, AFTER, "Alfvenic"),
        (kinds.compressional, BEFORE, "compressional"),
        (kinds.neither, REFERENCE, "neither"),
    )
    for chosen, colour, label in parts:
        x, y = kinds.compression[chosen], kinds.rotation[chosen]
        plot.scatter(x, y, color=colour, size=5, alpha=0.7, legend_label=label)
    for limit in (KIND_SETTINGS.alfvenic, KIND_SETTINGS.compressional):
        plot.add_layout(Span(location=limit, dimension="height", line_color=REFERENCE, line_dash="dashed"))
    legend_below(plot)
    return plot


def scatter_figure(found: Sequence[ScatterWithHours]) -> figure:
    """Draw how the scatter falls with hours, root mean square of three axes, beside published figures."""
    plot = plain_figure(
        "Scatter of the recovered zero level", "hours", "nT", width=470, x_axis_type="log", y_axis_type="log"
    )
    shown: list[Floats] = []
    for one, colour in zip(found, COMPONENTS, strict=False):
        size = np.sqrt(np.mean(one.scatter**2, axis=1))
        told = one.determined_part >= 0.5
        plot.line(one.hours[told], size[told], color=colour, line_width=2, legend_label=one.method)
        plot.scatter(one.hours[told], size[told], color=colour, size=5)
        shown.append(size[told])
    hours, published = np.array(PUBLISHED).T
    plot.scatter(hours, published, color=HIGHLIGHT, marker="diamond", size=11, legend_label="published")
    _ticks(plot, [*shown, published], [*(one.hours for one in found), hours])
    legend_below(plot)
    return plot


def _ticks(plot: figure, vertical: list[Floats], horizontal: list[Floats]) -> None:
    for axis, values in ((plot.yaxis, vertical), (plot.xaxis, horizontal)):
        ticks = log_ticks(np.concatenate(values))
        if ticks is not None:
            axis.ticker = ticks
            axis.major_label_overrides = {tick: f"{tick:g}" for tick in ticks.ticks}


def sets_figure(sets: OffsetSets) -> figure:
    """Draw the corrections of sets of averages and the line through each axis'."""
    trend = sets.trend()
    plot = plain_figure(f"{trend.sets} sets, c = a t + b", "days from the middle", "nT", width=560)
    days = ((sets.start // 2 + sets.end // 2) - trend.middle) / DAY
    for place, (axis, colour) in enumerate(zip(AXES, COMPONENTS, strict=True)):
        label = f"{axis}: a {trend.slope[place]:.4f} +- {trend.sigma_slope[place]:.4f} nT/day"
        plot.scatter(
            days[sets.determined],
            sets.value[sets.determined, place],
            color=colour,
            size=4,
            legend_label=label,
        )
        line = trend.level[place] + trend.slope[place] * days
        plot.line(days, line, color=colour, line_width=2)
    legend_below(plot)
    plot.legend[0].orientation = "vertical"
    return plot
