"""Look, labels.

How all figures look: colours, sizes, axes.

Short names for places too narrow for whole ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.core.properties import value as literal
from bokeh.models import (
    ColumnDataSource,
    FixedTicker,
    Glyph,
    GlyphRenderer,
    Legend,
    LegendItem,
    Line,
    Scatter,
    Segment,
    VArea,
)
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.residual import format_period

#: Before calibration, after it, and a reference line.
BEFORE, AFTER, REFERENCE = "#b0532c", "#1f5c99", "#7a7a7a"
#: A residual between the two: that of the model before the last change.
BETWEEN = "#d79a2b"

#: What nothing explains yet.
HIGHLIGHT = "#c21f3a"

#: Sensor axes and angle pairs.
COMPONENTS = ("#1f5c99", "#2a8a57", "#b0532c")

_WIDTH, _HEIGHT = 376, 260


def plain_figure(title: str, x: str, y: str, **options: Any) -> figure:
    """Return an empty figure with title and axis labels in the project's style; the mouse reads both axes."""
    in_time = options.get("x_axis_type") == "datetime"
    plot = figure(
        title=title,
        x_axis_label=x,
        y_axis_label=y,
        width=options.pop("width", _WIDTH),
        height=options.pop("height", _HEIGHT),
        tools="pan,wheel_zoom,box_zoom,reset,hover",
        toolbar_location="above",
        **options,
    )
    plot.title.text_font_size = "12px"
    plot.grid.grid_line_alpha = 0.4
    plot.toolbar.logo = None
    plot.hover.tooltips = [(x or "x", "$x{%F %R}" if in_time else "$x"), (y or "y", "$y")]
    plot.hover.formatters = {"$x": "datetime"} if in_time else {}
    return plot


def place_legend(plot: figure, location: str = "top_right") -> None:
    """Put the legend where it hides least; clicking an entry hides its curve."""
    if plot.legend:
        plot.legend.location = location
        plot.legend.click_policy = "hide"
        plot.legend.background_fill_alpha = 0.7
        plot.legend.label_text_font_size = "11px"


def legend_below(plot: figure) -> None:
    """Put the legend under a small figure, where it hides nothing."""
    place_legend(plot, "center")
    if plot.legend:
        legend = plot.legend[0]
        legend.orientation = "horizontal"
        plot.add_layout(legend, "below")


def log_ticks(values: Floats) -> FixedTicker | None:
    """Return ticks at 1 and 3 of each decade for values of less than two decades, more of them below one.

    Bokeh's own labels would run into each other there; None when they do not.
    """
    positive = values[np.isfinite(values) & (values > 0)]
    if not positive.size or positive.max() >= 100 * positive.min():
        return None
    low, high = np.floor(np.log10(positive.min())), np.ceil(np.log10(positive.max()))
    decades = 10.0 ** np.arange(low, high + 1)
    parts = (1, 3) if positive.max() >= 10 * positive.min() else (1, 1.5, 2, 3, 5, 7)
    return FixedTicker(ticks=sorted(float(f"{part * decade:.3g}") for decade in decades for part in parts))


# Bokeh's own methods of a figure make three glyphs of each curve, two of them for states that nothing here
# has (not selected, muted): a third of what a page of a hundred figures takes. These make one.


def draw_line(plot: figure, x: Any, y: Any, **style: Any) -> GlyphRenderer:
    """Draw a line through points; see `_draw` for the style."""
    return _draw(plot, Line, {"x": x, "y": y}, style)


def draw_points(plot: figure, x: Any, y: Any, **style: Any) -> GlyphRenderer:
    """Draw points; see `_draw` for the style."""
    return _draw(plot, Scatter, {"x": x, "y": y}, style)


def draw_segments(plot: figure, x0: Any, y0: Any, x1: Any, y1: Any, **style: Any) -> GlyphRenderer:
    """Draw a straight line from each (x0, y0) to (x1, y1); see `_draw` for the style."""
    return _draw(plot, Segment, {"x0": x0, "y0": y0, "x1": x1, "y1": y1}, style)


def draw_area(plot: figure, x: Any, y1: Any, y2: Any, **style: Any) -> GlyphRenderer:
    """Fill what lies between two curves; see `_draw` for the style."""
    return _draw(plot, VArea, {"x": x, "y1": y1, "y2": y2}, style)


def _draw(plot: figure, glyph: type[Glyph], places: dict[str, Any], style: dict[str, Any]) -> GlyphRenderer:
    """Draw a glyph.

    Parameters
    ----------
    places : dict
        Values by what of the glyph they are; names of columns where `style` has a `source`.
    style : dict
        As Bokeh's own methods take it: properties of the glyph (``line_width``, ``size``), ``color`` and
        ``alpha`` of all of it, ``source``, ``legend_label``, and the ``name`` of what is drawn.
    """
    source, label = style.pop("source", None), style.pop("legend_label", "")
    named = {"name": style.pop("name")} if "name" in style else {}
    for what in ("color", "alpha"):
        if what in style:
            given = style.pop(what)
            style = {f"{part}_{what}": given for part in _PARTS[glyph]} | style
    if source is None:
        # Of a list, a colour or size of each point. What is given twice is on the page once.
        each = places | {key: one for key, one in style.items() if isinstance(one, np.ndarray | list)}
        first = {id(one): key for key, one in reversed(each.items())}
        source = ColumnDataSource({key: each[key] for key in first.values()})
        places = {key: first[id(one)] for key, one in each.items()}
    renderer = plot.add_glyph(source, glyph(**style | places), **named)
    if label:
        _name_in_legend(plot, renderer, label)
    return renderer


#: What of a glyph has a colour.
_PARTS: dict[type[Glyph], tuple[str, ...]] = {
    Line: ("line",),
    Segment: ("line",),
    Scatter: ("line", "fill"),
    VArea: ("fill",),
}


def _name_in_legend(plot: figure, renderer: GlyphRenderer, label: str) -> None:
    """Give what is drawn its entry in the legend; what has the same name shares one."""
    places = (plot.center, plot.above, plot.below, plot.left, plot.right)
    legend = next((one for place in places for one in place if isinstance(one, Legend)), None)
    if legend is None:
        legend = Legend()
        plot.add_layout(legend)
    for item in legend.items:
        if item.label == literal(label):
            item.renderers.append(renderer)
            return
    legend.items.append(LegendItem(label=literal(label), renderers=[renderer]))


def error_band(plot: figure, x: Any, value: Floats, sigma: Floats, colour: str) -> None:
    """Draw a band of one sigma around a curve."""
    draw_area(plot, x, value - sigma, value + sigma, color=colour, alpha=0.18)


def error_bars(plot: figure, x: Any, value: Floats, sigma: Floats, colour: str, alpha: float = 1.0) -> None:
    """Draw error bars of one sigma that the figure's range takes in; whiskers would be marks of their own."""
    draw_segments(plot, x, value - sigma, x, value + sigma, color=colour, alpha=alpha)


def curve_with_errors(
    plot: figure, x: Floats, value: Floats, sigma: Floats, colour: str, bars: float = 0.5
) -> None:
    """Draw a curve through points, with a band and bars (of opacity `bars`) of one sigma."""
    # All of one source, whose values the page has once.
    source = ColumnDataSource({"x": x, "value": value, "low": value - sigma, "high": value + sigma})
    draw_area(plot, "x", "low", "high", source=source, color=colour, alpha=0.18)
    draw_segments(plot, "x", "low", "x", "high", source=source, color=colour, alpha=bars)
    draw_line(plot, "x", "value", source=source, color=colour)
    draw_points(plot, "x", "value", source=source, color=colour, size=5)


_FIELD = re.compile(r"channel_(field|rate|scale)\((?P<channel>.*)\)(?P<rest>(@.*)?)$")

_LAG = re.compile(r"@lag=([0-9.e+-]+)s")

_PLAY_WIDTH = re.compile(r"@width=([0-9.e+-]+)")

_STAMP = re.compile(r"([@/])(\d{4}-\d\d-\d\d)T(\d\d:\d\d)(:\d\d)?[0-9.]*")

_WORDS = {"scale_factor": "scale", "misalignment": "angle", "coefficient": ""}

_KIND = {"field": "", "rate": "rate of ", "scale": "scale by "}


def short_name(name: str) -> str:
    """Return the name of a candidate in readable form: ``battery_current, lag 40 s``."""

    def time(stamp: re.Match[str]) -> str:
        """Return a time with as much of the clock as it needs."""
        seconds = stamp[4] if stamp[4] not in (None, ":00") else ""
        clock = f" {stamp[3]}{seconds}" if seconds or stamp[3] != "00:00" else ""
        return f"{' ' if stamp[1] == '@' else ' to '}{stamp[2]}{clock}"

    found = _FIELD.match(name)
    text = f"{_KIND[found[1]]}{found['channel']}{found['rest']}" if found else name
    text = _LAG.sub(lambda lag: f", lag {format_period(float(lag[1]))}", text)
    text = _PLAY_WIDTH.sub(lambda width: f", width {float(width[1]):g}", text)
    return _STAMP.sub(time, text)


def short_parameter(name: str) -> str:
    """Return a parameter without the name of a lone sensor, its effect's name shortened."""
    effect, _, parameter = name.rpartition(".")
    parameter = bare_parameter(parameter)
    if effect in ("", "vector_sensor"):
        return parameter
    drift = effect.split(".")
    if len(drift) > 1 and drift[-1] == "vector_sensor":
        return f"{short_name(drift[0])} {parameter}"
    return f"{short_name(effect)} {parameter}"


def bare_parameter(name: str) -> str:
    """Return ``scale_factor[x]`` as ``scale x``, and a coefficient as its axis alone."""
    kind, _, axis = name.partition("[")
    return f"{_WORDS.get(kind, kind)} {axis.rstrip(']')}".strip() or kind


def unique_labels(names: Sequence[str]) -> list[str]:
    """Return the names, repeated ones with invisible marks: an axis of names needs each one once."""
    return [name + "\u200b" * list(names[:place]).count(name) for place, name in enumerate(names)]
