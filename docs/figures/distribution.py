"""Figures of what was distributed along the field, and of what is left."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure
from scipy import signal

from inflight.arrays import Floats
from inflight.calibration import ResidualCorrection
from inflight.figures import AFTER, BEFORE, HIGHLIGHT, REFERENCE, legend_below, plain_figure

#: Points drawn, and samples of a segment of the spectrum.
_POINTS, _SEGMENT = 1200, 4096


def distribution_figure(found: ResidualCorrection, hours: Floats) -> figure:
    """Draw the slow part that was distributed and extremes of what is left, in bins; edges are red.

    Parameters
    ----------
    found : Distribution
    hours : ndarray, shape (time,)
        Time of day.
    """
    plot = plain_figure(
        f"Distributed {found.rms:.3f} nT rms, left {found.rms_remaining:.3f} nT", "hours", "nT", width=560
    )
    size = max(1, hours.size // _POINTS)
    whole = hours.size // size * size
    bins = (
        np.where(found.valid, one, np.nan)[:whole].reshape(-1, size) for one in (found.remaining, found.slow)
    )
    left, slow = (np.ma.masked_invalid(one) for one in bins)
    at = hours[:whole].reshape(-1, size).mean(axis=1)
    low, high = (one.filled(np.nan) for one in (left.min(axis=1), left.max(axis=1)))
    plot.varea(x=at, y1=low, y2=high, color=REFERENCE, alpha=0.35, legend_label="left")
    plot.line(at, slow.mean(axis=1).filled(np.nan), color=AFTER, legend_label="distributed")
    edge = found.edge[:whole].reshape(-1, size).any(axis=1)
    plot.scatter(
        at[edge], slow.mean(axis=1).filled(np.nan)[edge], color=HIGHLIGHT, size=3, legend_label="edge"
    )
    legend_below(plot)
    return plot


def left_spectrum_figure(found: ResidualCorrection) -> figure:
    """Draw the amplitude density of the residual before and after, and the period of the filter."""
    plot = plain_figure(
        "Residual before and after", "period (s)", "nT / sqrt(Hz)", x_axis_type="log", y_axis_type="log"
    )
    whole = (
        np.where(found.valid, found.remaining + found.slow, 0.0),
        np.where(found.valid, found.remaining, 0.0),
    )
    for series, colour, label in zip(whole, (BEFORE, AFTER), ("before", "after"), strict=True):
        segment = min(_SEGMENT, series.size)
        frequency, density = signal.welch(np.nan_to_num(series), fs=1.0 / found.cadence, nperseg=segment)
        plot.line(1.0 / frequency[1:], np.sqrt(density[1:]), color=colour, legend_label=label)
    plot.ray(x=found.period, y=1e-9, length=0, angle=np.pi / 2, color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot
