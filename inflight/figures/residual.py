"""Figures of a residual before and after calibration."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import AFTER, BEFORE, REFERENCE, error_bars, log_ticks, place_legend, plain_figure
from inflight.statistics import Dependence

Days = npt.NDArray[np.datetime64]
_HALF_DAY = np.timedelta64(12, "h")


def daily_figure(day: Days, before: Floats, after: Floats, floor: float) -> figure:
    """Draw each day's rms residual before and after, and the noise floor; nT, logarithmic."""
    plot = plain_figure(
        "Residual |B_vector| - F, each day", "", "rms (nT)", x_axis_type="datetime", y_axis_type="log"
    )
    for values, colour, label in ((before, BEFORE, "pre-flight model"), (after, AFTER, "calibrated")):
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


def histogram_figure(edges: Floats, before: Floats, after: Floats) -> figure:
    """Draw the distributions of the residual less its mean, before and after; logarithmic counts.

    The edges follow the calibrated residual; what lies outside them is not drawn.
    """
    plot = plain_figure("Distribution (less its mean)", "nT", "samples", y_axis_type="log")
    for counts, colour, label in ((before, BEFORE, "pre-flight model"), (after, AFTER, "calibrated")):
        shown = np.maximum(counts, 0.5)
        plot.step(edges[:-1], shown, mode="after", color=colour, line_width=1.5, legend_label=label)
    most = max(float(before.max(initial=1.0)), float(after.max(initial=1.0)))
    plot.y_range = Range1d(0.5, 2.0 * most)
    place_legend(plot)
    return plot


def spectrum_figure(frequency: Floats, before: Floats, after: Floats, lines: dict[str, float]) -> figure:
    """Draw amplitude densities before and after, with the mission's known periods (seconds) marked."""
    plot = plain_figure(
        "Spectrum of the residual", "period (s)", "nT / sqrt(Hz)", x_axis_type="log", y_axis_type="log"
    )
    period = 1.0 / frequency
    for power, colour, label in ((before, BEFORE, "pre-flight model"), (after, AFTER, "calibrated")):
        plot.line(period, np.sqrt(power), color=colour, legend_label=label)
    if (ticks := log_ticks(period)) is not None:
        plot.xaxis.ticker = ticks
    for name, seconds in lines.items():
        if period.min() <= seconds <= period.max():
            plot.vspan(x=[seconds], line_color=REFERENCE, line_dash="dotted", legend_label=name)
    place_legend(plot, "top_left")
    return plot


def dependence_figure(found: Dependence) -> figure:
    """Draw the mean residual in bins of a coordinate, with error bars of one sigma between blocks."""
    unit = f" ({found.unit})" if found.unit not in ("", "1") else ""
    plot = plain_figure(
        f"{found.coordinate}: rms {found.amplitude:.3f} +- {found.sigma_amplitude:.3f} nT",
        f"{found.coordinate}{unit}",
        "nT",
    )
    error_bars(plot, found.centre, found.mean, found.sigma, AFTER)
    plot.line(found.centre, found.mean, color=AFTER)
    plot.scatter(found.centre, found.mean, color=AFTER, size=5)
    return plot
