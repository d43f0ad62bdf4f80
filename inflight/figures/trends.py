"""Figures of continuous parameters: the trend through the table's values, rivals, and steps."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.estimators.days import mjd_of
from inflight.estimators.jumps import Jumps
from inflight.estimators.trend_choice import TrendComparison
from inflight.estimators.trends import TrendFit
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    REFERENCE,
    band,
    error_bars,
    legend_below,
    plain_figure,
)

#: Points of a curve, and error bars drawn at most.
_POINTS, _BARS = 400, 60


def trend_figure(fit: TrendFit, table: xr.Dataset, parameters: list[str], factor: float, unit: str) -> figure:
    """Draw values of a table with error bars, and the trend with its band of one sigma, less the first value.

    Parameters
    ----------
    fit : TrendFit
    table : xarray.Dataset
        dims interval, parameter: `value`, `sigma`, `start`, `end`.
    parameters : list of str
        At most three; all shown in `unit`, which is `factor` times their own.
    """
    title = "trend" if fit.origin is None else fit.origin.told()
    plot = plain_figure(f"Continuous parameters: {title}", "MJD (2000-01-01)", unit, width=560)
    times = np.linspace(*fit.span, _POINTS).astype(np.int64)
    value, sigma = fit.at(times)
    middle = mjd_of(table["start"].values // 2 + table["end"].values // 2)
    thin = slice(None, None, max(1, middle.size // _BARS))
    for name, colour in zip(parameters, COMPONENTS, strict=False):
        index = list(fit.trends).index(name)
        base = value[0, index]
        shown = (table["value"].sel(parameter=name).values - base) * factor
        bars = table["sigma"].sel(parameter=name).values * factor
        error_bars(plot, middle[thin], shown[thin], bars[thin], colour, 0.35)
        plot.scatter(middle, shown, color=colour, size=3, alpha=0.4)
        label = f"{name.rsplit('[', maxsplit=1)[-1].rstrip(']')}: {fit.trends[name].time}"
        curve = (value[:, index] - base) * factor
        band(plot, mjd_of(times), curve, sigma[:, index] * factor, colour)
        plot.line(
            mjd_of(times), curve, color=colour, line_width=2, legend_label=f"{label}: {fit.trends[name].time}"
        )
    legend_below(plot)
    return plot


def comparison_figure(found: TrendComparison) -> figure:
    """Draw the held-out rms of each kind of trend; the bars are those of the difference to the best."""
    kinds = [one.kind for one in found.rivals]
    plot = plain_figure(
        f"Held-out residual: {found.chosen} chosen", "", found.unit, x_range=kinds, y_axis_type="log"
    )
    rms = np.array([one.rms for one in found.rivals])
    sigma = np.array([one.sigma_behind for one in found.rivals]) / (2.0 * rms)
    error_bars(plot, kinds, rms, np.minimum(sigma, 0.9 * rms), REFERENCE)
    plot.scatter(kinds, rms, size=9, color=[AFTER if one.tied else BEFORE for one in found.rivals])
    return plot


def jumps_figure(table: Jumps, trend: Jumps) -> figure:
    """Draw the steps of |B| at the boundaries of a table, and those of continuous parameters."""
    title = f"Steps at boundaries in {table.strength:.0f} nT, rms over directions"
    plot = plain_figure(title, "MJD (2000-01-01)", "nT", width=560)
    plot.scatter(mjd_of(table.at), table.rms, color=BEFORE, size=4, legend_label="intervals")
    plot.line(mjd_of(table.at), np.abs(table.mean), color=BEFORE, alpha=0.6, legend_label="|mean|")
    plot.line(mjd_of(trend.at), trend.rms, color=AFTER, line_width=2, legend_label="continuous")
    legend_below(plot)
    return plot
