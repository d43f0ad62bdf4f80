"""How parameters answer for each other: correlations, and what an ignored effect does to the calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper
from bokeh.plotting import figure

from inflight.diagnosis.tradeoffs import CrossTalk, Shift
from inflight.estimators.crosstalk import SHOWN, CrossTalkTable
from inflight.figures.heatmap import DIVERGING
from inflight.figures.naming import bare_parameter, distinct, short_name, short_parameter
from inflight.figures.page import html_table
from inflight.figures.style import plain_figure

#: Units of the calibration's parameters by part of the name.
_UNITS = {"scale_factor": "1", "misalignment": "deg", "offset": "nT"}


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


def ignored_figure(found: CrossTalkTable) -> figure:
    """Draw what each ignored cause does to the fitted parameters.

    Colours compare shifts of one unit with each other: they run to the largest shift of that unit.
    """
    rows = distinct([one.label for one in found.ignored])
    parameters = [
        f"{short_parameter(name)} ({unit})" for name, unit in zip(found.parameters, found.units, strict=True)
    ]
    columns = distinct(parameters)
    plot = plain_figure(
        "Shift of the calibration by what it ignores",
        "",
        "",
        x_range=columns,
        y_range=rows[::-1],
        width=min(260 + 70 * len(columns), 1100),
        height=150 + 34 * len(rows),
    )
    limit = {unit: np.abs(found.shift[:, [one == unit for one in found.units]]).max() for unit in found.units}
    row, column = np.divmod(np.arange(found.shift.size), len(columns))
    value = found.shift.ravel()
    source = ColumnDataSource(
        {
            "x": [columns[place] for place in column],
            "y": [rows[place] for place in row],
            "part": [
                one / max(limit[found.units[place]], 1e-12) for one, place in zip(value, column, strict=True)
            ],
            "told": [_two_digits(one) for one in value],
        }
    )
    mapper = LinearColorMapper(palette=DIVERGING, low=-1.4, high=1.4)
    colour = {"field": "part", "transform": mapper}
    plot.rect("x", "y", width=1, height=1, source=source, fill_color=colour, line_color="#ffffff")
    plot.text(
        "x",
        "y",
        text="told",
        source=source,
        text_align="center",
        text_baseline="middle",
        text_font_size="11px",
    )
    plot.xaxis.major_label_orientation = 0.7
    plot.grid.visible = False
    plot.hover.tooltips = [("ignored", "@y"), ("shifts", "@x"), ("by", "@told")]
    return plot


def _two_digits(value: float) -> str:
    """Two digits that count, without powers of ten; what rounds to nothing is 0."""
    return "0" if abs(value) < 0.005 else f"{value:+.2f}" if abs(value) < 1.0 else f"{value:+.1f}"


def _unit(name: str) -> tuple[float, str]:
    for part, unit in _UNITS.items():
        if part in name:
            return SHOWN[unit]
    return 1.0, ""
