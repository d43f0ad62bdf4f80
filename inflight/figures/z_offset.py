"""Figures of the spread of the residual against the offset, and of the offsets it gives."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.estimators.days import mjd_of
from inflight.estimators.z_offset import OffsetsFromSpread, SpreadLaw
from inflight.figures.style import AFTER, BEFORE, REFERENCE, error_bars, legend_below, plain_figure


def spread_figure(statistics: xr.Dataset, offset: Floats, law: SpreadLaw) -> figure:
    """Draw each day's spread of dB against its offset, and the law (Yin 2010, eq. 3.6)."""
    sigma = np.sqrt(law.covariance[0, 0])
    plot = plain_figure(
        f"a {law.factor:.4f} +- {sigma:.4f}, orbit {law.geometry:.4f}; noise {np.sqrt(law.noise):.3f} nT",
        "offset (nT)",
        "std dB (nT)",
        width=470,
    )
    spread = np.sqrt(statistics["variance"].values)
    error = np.sqrt(statistics["covariance"].values[:, 1, 1]) / (2.0 * spread)
    error_bars(plot, offset, spread, error, AFTER, 0.4)
    plot.scatter(offset, spread, color=AFTER, size=4, legend_label="days")
    reach = np.linspace(min(offset.min(), 0.0), max(offset.max(), 0.0), 200)
    curve = np.sqrt(np.maximum(law.factor * reach**2 + law.noise, 0.0))
    plot.line(reach, curve, color=BEFORE, line_width=2, legend_label="law")
    legend_below(plot)
    return plot


def offsets_figure(found: OffsetsFromSpread) -> figure:
    """Draw the daily offsets from the spread with their errors, and those from the slope."""
    plot = plain_figure(
        f"Offset along {found.axis} from the spread of dB", "MJD (2000-01-01)", "nT", width=560
    )
    middle = mjd_of(found.start // 2 + found.end // 2)
    error_bars(plot, middle, found.value, found.sigma, AFTER, 0.4)
    fill = np.where(found.seen, 1.0, 0.0)
    plot.scatter(middle, found.value, color=AFTER, fill_alpha=fill, size=5, legend_label="spread")
    plot.line(middle, found.slope, color=BEFORE, alpha=0.7, legend_label="slope of dB on the direction")
    plot.line([middle[0], middle[-1]], [0.0, 0.0], color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot
