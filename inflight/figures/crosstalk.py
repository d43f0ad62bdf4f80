"""How parameters answer for each other: correlations, and what an ignored effect does to the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper
from bokeh.plotting import figure

from inflight.diagnosis.tradeoffs import CrossTalk, Shift
from inflight.figures.heatmap import DIVERGING
from inflight.figures.naming import bare_parameter, distinct, short_name, short_parameter
from inflight.figures.page import html_table
from inflight.figures.style import plain_figure

#: What the calibration's parameters are shown in: part of the name, factor, unit.
_SHOWN = (
    ("scale_factor", 1e6, "ppm"),
    ("misalignment", 3600.0, "arcsec"),
    ("offset", 1.0, "nT"),
)


def cross_talk_figure(found: CrossTalk) -> figure:
    """Draw the signed correlations of the parameters' errors: calibration, model, found effects in order."""
    names = [short_parameter(name) for name in found.names]
    labels = distinct(names)
    size = len(labels)
    width = 250 + 17 * size
    plot = plain_figure(
        "Correlation of the parameters' errors",
        "",
        "",
        x_range=labels or ["none"],
        y_range=labels[::-1] or ["none"],
        width=min(max(width, 480), 1100),
        height=min(max(width - 60, 420), 1000),
    )
    mapper = LinearColorMapper(palette=DIVERGING, low=-1.0, high=1.0)
    row, column = np.divmod(np.arange(size * size), max(size, 1))
    source = ColumnDataSource(
        {
            "x": [labels[place] for place in column],
            "y": [labels[place] for place in row],
            "value": found.correlation.ravel().round(3),
        }
    )
    plot.rect(
        "x",
        "y",
        width=1,
        height=1,
        source=source,
        fill_color={"field": "value", "transform": mapper},
        line_color=None,
    )
    plot.add_layout(ColorBar(color_mapper=mapper, width=14, padding=4), "right")
    plot.xaxis.major_label_orientation = 1.2
    plot.axis.major_label_text_font_size = "9px"
    plot.grid.visible = False
    plot.hover.tooltips = [("", "@x"), ("with", "@y"), ("correlation", "@value{0.000}")]
    return plot


def strongest_pairs(found: CrossTalk, most: int = 5) -> list[str]:
    """Return the strongest correlations of a found parameter with any other, in words."""
    names = [short_parameter(name) for name in found.names]
    pairs = [
        (abs(float(found.correlation[i, j])), i, j)
        for i in range(len(names))
        for j in range(i)
        if found.groups[i] == "found"
        and found.names[i].rpartition(".")[0] != found.names[j].rpartition(".")[0]
    ]
    ordered = sorted(pairs, reverse=True)[:most]
    return [f"{names[i]} with {names[j]}: {found.correlation[i, j]:+.2f}" for _, i, j in ordered]


def shift_table(shifts: Sequence[Shift]) -> str:
    """Return as HTML what each found coefficient, if ignored, would do to the calibration."""
    if not shifts:
        return ""
    parameters = list(shifts[0].shifts)
    shown = [_unit(name) for name in parameters]
    head = (
        "ignored",
        *(f"{short_parameter(name)} ({unit})" for name, (_, unit) in zip(parameters, shown, strict=True)),
    )
    rows = [
        (
            f"{short_name(one.effect)} {bare_parameter(one.coefficient)} = {one.value:.3g} {one.unit}",
            *(
                f"{one.shifts[name] * factor:+.2g}"
                for name, (factor, _) in zip(parameters, shown, strict=True)
            ),
        )
        for one in shifts
    ]
    return f'<div class="wide" style="overflow-x:auto;white-space:nowrap">{html_table(head, rows)}</div>'


def _unit(name: str) -> tuple[float, str]:
    for part, factor, unit in _SHOWN:
        if part in name:
            return factor, unit
    return 1.0, ""
