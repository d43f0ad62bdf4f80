"""Figures of a residual before and after calibration."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import AFTER, BEFORE, REFERENCE, log_ticks, place_legend, plain_figure

Days = npt.NDArray[np.datetime64]
#: What the two states are called unless a page says otherwise.
STATES = ("pre-flight model", "calibrated")
_HALF_DAY = np.timedelta64(12, "h")


def daily_figure(
    day: Days, before: Floats, after: Floats, floor: float, labels: tuple[str, str] = STATES
) -> figure:
    """Draw each day's rms residual before and after, and the noise floor; nT, logarithmic."""
    plot = plain_figure(
        "Residual |B_vector| - F, each day", "", "rms (nT)", x_axis_type="datetime", y_axis_type="log"
    )
    for values, colour, label in ((before, BEFORE, labels[0]), (after, AFTER, labels[1])):
        plot.line(day, values, color=colour, alpha=0.6)
        plot.scatter(day, values, color=colour, size=5, legend_label=label)
    # Half a day to either side: of a single day the axis would tell microseconds.
    ends = day[0] - _HALF_DAY, day[-1] + _HALF_DAY
    plot.x_range = Range1d(*(int(end.astype("datetime64[ms]").astype(np.int64)) for end in ends))
    if (ticks := log_ticks(np.concatenate([before, after]))) is not None:
        plot.yaxis.ticker = ticks
    if np.isfinite(floor) and floor > 0:
        plot.line(list(ends), [floor, floor], color=REFERENCE, line_dash="dashed", legend_label="noise floor")
    place_legend(plot, "center_right")
    return plot


def series_figure(time: Days, mean: Floats, low: Floats, high: Floats) -> figure:
    """Draw the calibrated residual in time: means of short spans, and the band of their extremes."""
    plot = plain_figure("Calibrated residual in time", "", "nT", x_axis_type="datetime", width=1130)
    source = ColumnDataSource({"time": time, "mean": mean, "low": low, "high": high})
    band = {"x": "time", "y1": "low", "y2": "high", "source": source}
    plot.varea(**band, color=AFTER, alpha=0.2, legend_label="extremes")
    plot.line("time", "mean", source=source, color=AFTER, line_width=1.2, legend_label="mean")
    place_legend(plot)
    return plot


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
