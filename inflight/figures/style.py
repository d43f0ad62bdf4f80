"""Look, labels.

How all figures look: colours, sizes, axes.

Short names for places too narrow for whole ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, Line, Scatter, Segment, VArea
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


def error_band(plot: figure, x: Any, value: Floats, sigma: Floats, colour: str) -> None:
    """Draw a band of one sigma around a curve."""
    source = ColumnDataSource({"x": x, "low": value - sigma, "high": value + sigma})
    _draw_band(plot, source, colour)


def error_bars(plot: figure, x: Any, value: Floats, sigma: Floats, colour: str, alpha: float = 1.0) -> None:
    """Draw error bars of one sigma that the figure's range takes in."""
    source = ColumnDataSource({"x": x, "low": value - sigma, "high": value + sigma})
    _draw_bars(plot, source, colour, alpha)


def curve_with_errors(
    plot: figure, x: Floats, value: Floats, sigma: Floats, colour: str, bars: float = 0.5
) -> None:
    """Draw a curve through points, with a band and bars (of opacity `bars`) of one sigma."""
    ends = {"x": x, "value": value, "low": value - sigma, "high": value + sigma}
    source = ColumnDataSource(ends)
    _draw_band(plot, source, colour)
    _draw_bars(plot, source, colour, bars)
    plot.add_glyph(source, Line(x="x", y="value", line_color=colour))
    plot.add_glyph(source, Scatter(x="x", y="value", line_color=colour, fill_color=colour, size=5))


# Glyphs of a source they share, and no whiskers: a page has hundreds, of which Bokeh's own methods make
# models for states that nothing here has (selected, muted), and whiskers need marks that widen the range.


def _draw_band(plot: figure, source: ColumnDataSource, colour: str) -> None:
    plot.add_glyph(source, VArea(x="x", y1="low", y2="high", fill_color=colour, fill_alpha=0.18))


def _draw_bars(plot: figure, source: ColumnDataSource, colour: str, alpha: float) -> None:
    ends = {"x0": "x", "y0": "low", "x1": "x", "y1": "high"}
    plot.add_glyph(source, Segment(**ends, line_color=colour, line_alpha=alpha))


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
