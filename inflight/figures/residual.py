"""Figures of a residual before and after: each day, in time, its distribution, by day and orbit.

Takes daily sizes, means and histograms, and heat maps of a finished search; makes Bokeh figures. Maps before
and after share one scale of colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from bokeh.models import (
    BoxAnnotation,
    ColorBar,
    ColumnDataSource,
    FixedTicker,
    Label,
    LinearColorMapper,
    Range1d,
    Span,
    WheelZoomTool,
)
from bokeh.palettes import RdBu11, interp_palette
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import (
    AFTER,
    BEFORE,
    BETWEEN,
    HIGHLIGHT,
    REFERENCE,
    draw_area,
    draw_line,
    draw_points,
    legend_below,
    log_ticks,
    place_legend,
    plain_figure,
)
from inflight.time import to_utc

if TYPE_CHECKING:
    from inflight.diagnosis import HeatMap

Days = npt.NDArray[np.datetime64]

#: What the two states are called unless a page says otherwise.
STATES = ("pre-flight model", "calibrated")

#: Told apart by readers who see no red or no green, too (Okabe and Ito, 2008).
_DISTINCT = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#6b5d00")

#: Of a stack: rows that the rms of the largest curve takes up; how near another has to be to a tenth of it to
#: be drawn ten times as large, in decades; the mean that is told, in parts of the rms.
_ROW_RMS, _NEARLY_TEN, _TOLD_MEAN = 0.2, 0.15, 0.5
_HALF_DAY = np.timedelta64(12, "h")


def daily_figure(
    day: Days,
    before: Floats,
    after: Floats,
    floor: float,
    labels: tuple[str, str] = STATES,
    earlier: tuple[Floats, str] | None = None,
) -> figure:
    """Draw each day's rms residual before and after, and the noise floor; nT, logarithmic.

    `earlier` is a third residual between the two, and what it is called.
    """
    plot = plain_figure(
        "Residual |B_vector| - F, each day", "", "rms (nT)", x_axis_type="datetime", y_axis_type="log"
    )
    middle = [] if earlier is None else [(earlier[0], BETWEEN, earlier[1])]
    for values, colour, label in ((before, BEFORE, labels[0]), *middle, (after, AFTER, labels[1])):
        draw_line(plot, day, values, color=colour, alpha=0.6)
        draw_points(plot, day, values, color=colour, size=5, legend_label=label)
    # Half a day to either side: of a single day the axis would show microseconds.
    ends = day[0] - _HALF_DAY, day[-1] + _HALF_DAY
    plot.x_range = Range1d(*(int(end.astype("datetime64[ms]").astype(np.int64)) for end in ends))
    if (ticks := log_ticks(np.concatenate([before, after]))) is not None:
        plot.yaxis.ticker = ticks
    if np.isfinite(floor) and floor > 0:
        draw_line(
            plot, list(ends), [floor, floor], color=REFERENCE, line_dash="dashed", legend_label="noise floor"
        )
    place_legend(plot, "center_right")
    return plot


def fall_figure(
    day: Days, before: Floats, after: Floats, floor: float, labels: tuple[str, str], width: int = 560
) -> figure:
    """Draw each day's rms residual before and after a change of the model down to the noise; nT, from 0."""
    plot = plain_figure(
        "How the error falls, each day", "", "rms residual (nT)", x_axis_type="datetime", width=width
    )
    draw_area(plot, x=day, y1=after, y2=before, color=BETWEEN, alpha=0.15)
    for values, colour, label in ((before, BETWEEN, labels[0]), (after, AFTER, labels[1])):
        draw_line(plot, day, values, color=colour, line_width=2)
        draw_points(plot, day, values, color=colour, size=5, legend_label=label)
    ends = day[0] - _HALF_DAY, day[-1] + _HALF_DAY
    plot.x_range = Range1d(*(int(end.astype("datetime64[ms]").astype(np.int64)) for end in ends))
    most = float(np.nanmax(np.concatenate([before, after, [floor if np.isfinite(floor) else 0.0]])))
    plot.y_range = Range1d(0.0, 1.15 * most)
    if np.isfinite(floor) and floor > 0:
        draw_line(
            plot, list(ends), [floor, floor], color="#222222", line_dash="dashed", legend_label="noise floor"
        )
    legend_below(plot)
    return plot


def series_figure(time: Days, mean: Floats, low: Floats, high: Floats) -> figure:
    """Draw the calibrated residual in time: means of short spans, and the band of their extremes."""
    plot = plain_figure("Calibrated residual in time", "", "nT", x_axis_type="datetime", width=1130)
    source = ColumnDataSource({"time": time, "mean": mean, "low": low, "high": high})
    band = {"x": "time", "y1": "low", "y2": "high", "source": source}
    draw_area(plot, **band, color=AFTER, alpha=0.2, legend_label="extremes")
    draw_line(plot, "time", "mean", source=source, color=AFTER, line_width=1.2, legend_label="mean")
    place_legend(plot)
    return plot


def trace_figure(sources: Mapping[str, ColumnDataSource], span: Range1d) -> figure:
    """Draw a residual in time from sources that are filled later: means between their extremes; nT.

    Parameters
    ----------
    sources : mapping of str to ColumnDataSource
        ``residual``, or ``before`` and ``after``, with columns ``x`` (ms of UTC), ``mean``, ``low`` and
        ``high``; ``flagged`` with ``x``, ``y`` and ``flag``.
    span : Range1d
        What is visible, ms of UTC; shared with other figures.
    """
    plot = plain_figure("Residual in time", "UTC", "residual (nT)", x_axis_type="datetime", x_range=span)
    colours = {"residual": AFTER, "before": REFERENCE, "after": AFTER}
    for name in (one for one in sources if one in colours):
        band = {"x": "x", "y1": "low", "y2": "high", "source": sources[name]}
        draw_area(plot, **band, color=colours[name], alpha=0.2)
        draw_line(plot, "x", "mean", source=sources[name], color=colours[name], legend_label=name, name=name)
    marks = {"marker": "x", "size": 7, "color": HIGHLIGHT, "legend_label": "flagged", "name": "flagged"}
    dots = draw_points(plot, "x", "y", source=sources["flagged"], **marks)
    plot.hover.renderers, plot.hover.tooltips = [dots], [("flags", "@flag"), ("nT", "@y{0.0000}")]
    _as_strip(plot)
    return plot


@dataclass(frozen=True)
class StackRow:
    """A curve of a stack: where it stands, and how it is enlarged.

    Attributes
    ----------
    name : str
        What the source and the glyphs are called.
    mean : float
        What is taken off, nT.
    place : float
        Its zero, in rows from the top: 0, -1, ...
    scale : float
        Rows a nT.
    text : str
        What the row says: name, enlargement, size.
    """

    name: str
    mean: float
    place: float
    scale: float
    text: str


def stack_rows(curves: Mapping[str, Floats]) -> list[StackRow]:
    """Return the rows of a stack; small curves are enlarged by a power of ten, as the row says.

    Parameters
    ----------
    curves : mapping of str to ndarray, shape (sample,)
        nT, from the top; NaN where nothing is known.
    """
    means = {name: float(np.nanmean(one)) if np.isfinite(one).any() else 0.0 for name, one in curves.items()}
    sizes = {name: float(np.nanstd(one)) if np.isfinite(one).any() else 0.0 for name, one in curves.items()}
    largest = max(sizes.values(), default=1.0) or 1.0
    rows = []
    for place, (name, size) in enumerate(sizes.items()):
        small = np.log10(largest / size) if size > 0 else 0.0
        by = 10 ** min(int(small + _NEARLY_TEN), 6)
        enlarged = f" (×{by})" if by > 1 else ""
        about = f" about {means[name]:.3g} nT" if abs(means[name]) > _TOLD_MEAN * size else ""
        text = f"{name}{enlarged}: {size:.3g} nT rms{about}"
        rows.append(StackRow(name, means[name], -float(place), by * _ROW_RMS / largest, text))
    return rows


def contribution_figure(
    sources: Mapping[str, ColumnDataSource], rows: Sequence[StackRow], span: Range1d
) -> figure:
    """Draw curves in time one below the other: the residual, and what each effect makes of it; nT.

    Parameters
    ----------
    sources : mapping of str to ColumnDataSource
        By a row's name, filled later: ``x`` (ms of UTC), ``y``, ``low`` and ``high`` in rows, and ``nT``.
    rows : sequence of StackRow
        From the top.
    span : Range1d
        What is visible, ms of UTC; shared with other figures.
    """
    title = "What is left, and what each effect of the model makes of it"
    plot = plain_figure(title, "UTC", "nT", x_axis_type="datetime", x_range=span)
    plot.y_range = Range1d(rows[-1].place - 0.55, rows[0].place + 0.75)
    ticks, labels = [], {}
    for place, row in enumerate(rows):
        colour = AFTER if place == 0 else _DISTINCT[1:][(place - 1) % (len(_DISTINCT) - 1)]
        source = sources[row.name]
        plot.add_layout(Span(location=row.place, dimension="width", line_color="#c8c8c8"))
        draw_area(plot, x="x", y1="low", y2="high", source=source, color=colour, alpha=0.3)
        draw_line(plot, "x", "y", source=source, color=colour, line_width=1.2, name=row.name)
        step = float(f"{0.3 / row.scale:.0e}")
        for value in (-step, 0.0, step):
            ticks.append(row.place + value * row.scale)
            labels[ticks[-1]] = f"{value:.3g}"
        told = {"text": row.text, "text_font_size": "11px", "text_color": colour, "y_offset": -3}
        back = {"background_fill_color": "white", "background_fill_alpha": 0.75}
        where = {"x": 6, "x_units": "screen", "y": row.place + 0.5, "text_baseline": "middle"}
        plot.add_layout(Label(**where, **told, **back))
    plot.yaxis.ticker = FixedTicker(ticks=ticks)
    plot.yaxis.major_label_overrides = labels
    plot.ygrid.visible = False
    plot.hover.tooltips = [("", "$name"), ("nT", "@nT{0.0000}")]
    plot.height = 70 + 72 * len(rows)
    _as_strip(plot, legend=False)
    return plot


def mark_events(plot: figure, events: Sequence[tuple[float, float, str]]) -> None:
    """Draw events from when until when (ms of UTC), with what happened."""
    for place, (begin, end, text) in enumerate(events):
        if end > begin:
            band = BoxAnnotation(left=begin, right=end, fill_color=BETWEEN, fill_alpha=0.15)
            plot.add_layout(band)
        plot.add_layout(Span(location=begin, dimension="height", line_color=BETWEEN, line_dash="dashed"))
        height = 4 + 13 * (place % 4)
        label = Label(x=begin, y=height, y_units="screen", x_offset=3, text=text, text_font_size="11px")
        plot.add_layout(label)


def _as_strip(plot: figure, *, legend: bool = True) -> None:
    """Make a figure one that is as wide as the page: zoomed in time alone, its legend below it."""
    plot.toolbar_location = "right"
    zoom = next(tool for tool in plot.tools if isinstance(tool, WheelZoomTool))
    zoom.dimensions, plot.toolbar.active_scroll = "width", zoom
    if legend:
        legend_below(plot)


def histogram_figure(
    edges: Floats, before: Floats, after: Floats, labels: tuple[str, str] = STATES
) -> figure:
    """Draw the distributions of the residual less its mean, before and after; logarithmic counts.

    The edges follow the calibrated residual; what lies outside them is not drawn.
    """
    plot = plain_figure("Distribution (less its mean)", "nT", "samples", y_axis_type="log")
    for counts, colour, label in ((before, BEFORE, labels[0]), (after, AFTER, labels[1])):
        shown = np.maximum(counts, 0.5)
        plot.step(edges[:-1], shown, mode="after", color=colour, line_width=1.5, legend_label=label)
    most = max(float(before.max(initial=1.0)), float(after.max(initial=1.0)))
    plot.y_range = Range1d(0.5, 2.0 * most)
    place_legend(plot)
    return plot


#: Diverging, for readers who see no red or no green too; blue is negative.
DIVERGING = tuple(interp_palette(RdBu11, 101))

#: Part of the cells whose values the colours span.
_SPANNED = 0.98

_WIDTH, _HEIGHT = 560, 330


def heat_map_figures(found: HeatMap, changed: bool = True, stacked: bool = False) -> list[figure]:
    """Draw a map before and after a change (`changed`), or one; grey cells were not measured.

    Beside each other the last has the scale of colours; of those that are `stacked` each has it.
    """
    limit = _colour_limit(found.before)
    label = f"{found.coordinate.replace('_', ' ')} ({found.unit})"
    # Bokeh's axes of time count milliseconds of UTC since 1970.
    start, end = to_utc(np.array(found.span)).astype("datetime64[ms]").astype(np.float64).tolist()
    plots = []
    pair = [("before", found.before), ("after", found.after)]
    for title, map_ in pair if changed else [("now", found.before)]:
        last = stacked or title != "before"
        # One scale, but a mapper a figure: each becomes a document of its own.
        mapper = LinearColorMapper(palette=DIVERGING, low=-limit, high=limit, nan_color="#d8d8d8")
        plot = plain_figure(
            f"Mean residual (nT) {title}, by time and {found.coordinate.replace('_', ' ')}",
            label,
            "UTC",
            y_axis_type="datetime",
            x_range=(0.0, found.reach),
            y_range=(start, end),
            width=_WIDTH + (40 if last else -20),
            height=_HEIGHT,
        )
        plot.image(
            image=[map_.astype(np.float32)],
            x=0.0,
            y=start,
            dw=found.reach,
            dh=end - start,
            color_mapper=mapper,
        )
        plot.grid.visible = False
        plot.hover.tooltips = [(found.coordinate.replace("_", " "), "$x{0.0}"), ("nT", "@image{0.0000}")]
        if last:
            bar = ColorBar(color_mapper=mapper, width=14, padding=4, title="nT")
            plot.add_layout(bar, "right")
        plots.append(plot)
    return plots


def place_map_figures(states: Mapping[str, Floats]) -> list[figure]:
    """Draw the mean residual by local time and latitude, a figure a state, all on one scale of colours.

    Parameters
    ----------
    states : mapping of str to ndarray, shape (latitude, local time)
        As `inflight.diagnosis.place_map` returns them, by what they are called; nT.
    """
    first = next(iter(states.values()))
    limit = _colour_limit(first)
    plots = []
    for name, values in states.items():
        mapper = LinearColorMapper(palette=DIVERGING, low=-limit, high=limit, nan_color="#d8d8d8")
        plot = plain_figure(
            f"Mean residual (nT){name and f', {name},'} by local time and latitude",
            "local time (h)",
            "latitude (deg)",
            x_range=(0.0, 24.0),
            y_range=(-90.0, 90.0),
            width=_WIDTH,
            height=_HEIGHT,
        )
        plot.image(image=[values.astype(np.float32)], x=0.0, y=-90.0, dw=24.0, dh=180.0, color_mapper=mapper)
        plot.xaxis.ticker = FixedTicker(ticks=list(range(0, 25, 3)))
        plot.yaxis.ticker = FixedTicker(ticks=list(range(-90, 91, 30)))
        plot.grid.visible = False
        places = [("local time", "$x{0.0} h"), ("latitude", "$y{0} deg")]
        plot.hover.tooltips = [*places, ("nT", "@image{0.0000}")]
        plot.add_layout(ColorBar(color_mapper=mapper, width=14, padding=4, title="nT"), "right")
        plots.append(plot)
    return plots


def _colour_limit(values: Floats) -> float:
    """Return the value at the ends of a scale of colours, nT."""
    known = np.abs(values[np.isfinite(values)])
    return max(float(np.quantile(known, _SPANNED)) if known.size else 0.0, 1e-6)
