"""How all figures look: colours, sizes, axes."""

from __future__ import annotations

from typing import Any

from bokeh.plotting import figure

#: Before calibration, after it, and a reference line.
BEFORE, AFTER, REFERENCE = "#b0532c", "#1f5c99", "#7a7a7a"
#: Sensor axes and angle pairs.
COMPONENTS = ("#1f5c99", "#2a8a57", "#b0532c")
_WIDTH, _HEIGHT = 376, 260


def plain_figure(title: str, x: str, y: str, **options: Any) -> figure:
    """Return an empty figure with title and axis labels in the project's style."""
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
    return plot


def place_legend(plot: figure, location: str = "top_right") -> None:
    """Put the legend where it hides least; clicking an entry hides its curve."""
    if plot.legend:
        plot.legend.location = location
        plot.legend.click_policy = "hide"
        plot.legend.background_fill_alpha = 0.7
        plot.legend.label_text_font_size = "11px"
