"""Heat maps of the residual by day and orbit, before and after side by side on one scale of colours."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColorBar, LinearColorMapper
from bokeh.palettes import RdBu11, interp_palette
from bokeh.plotting import figure

from inflight.diagnosis.pictures import HeatMap
from inflight.figures.style import plain_figure
from inflight.time import to_utc

#: Diverging, told apart by people who see no red or no green; blue is negative.
DIVERGING = tuple(interp_palette(RdBu11, 101))
#: Part of the cells whose values the colours span.
_SPANNED = 0.98
_WIDTH, _HEIGHT = 560, 330


def heat_map_figures(found: HeatMap, changed: bool = True) -> list[figure]:
    """Draw a map before and after the found effects (`changed`), or one; grey cells were not measured."""
    values = np.abs(found.before[np.isfinite(found.before)])
    limit = float(np.quantile(values, _SPANNED)) if values.size else 0.0
    limit = max(limit, 1e-6)
    label = f"{found.coordinate.replace('_', ' ')} ({found.unit})"
    start, end = (_milliseconds(edge) for edge in found.span)
    plots = []
    pair = [("before", found.before), ("after", found.after)]
    for title, map_ in pair if changed else [("now", found.before)]:
        last = title != "before"
        # One scale, but a mapper a figure: each becomes a document of its own.
        mapper = LinearColorMapper(palette=DIVERGING, low=-limit, high=limit, nan_color="#d8d8d8")
        plot = plain_figure(
            f"Mean residual (nT) {title}, by time and {found.coordinate.replace('_', ' ')}",
            label,
            "",
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
            bar = ColorBar(color_mapper=mapper, width=14, padding=4)
            plot.add_layout(bar, "right")
        plots.append(plot)
    return plots


def _milliseconds(tt2000: int) -> float:
    """Return what Bokeh's axes of time count in: milliseconds of UTC since 1970."""
    return float(to_utc(tt2000).astype("datetime64[ms]").astype(np.int64))
