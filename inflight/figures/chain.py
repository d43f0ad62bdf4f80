"""Figures of a whole mission's fit: coefficients, daily parameters, the torquers' band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from bokeh.models import Range1d, Span, Whisker
from bokeh.models.sources import ColumnDataSource
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.estimators.days import mjd_of
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

_WIDE = 560
#: Error bars drawn at most, and pixels of a row of coefficients.
_BARS, _ROW = 60, 15
#: A band is left out when it is so many times wider than the values.
_HIDES = 3.0


def prior_figure(names: Sequence[str], shift: Floats, sigma: Floats, determined: Sequence[bool]) -> figure:
    """Draw how far each coefficient went from what was known of it, in sigmas of that.

    Parameters
    ----------
    names : sequence of str
        Each once, the first on top.
    shift, sigma : ndarray, shape (coefficient,)
        Value less prior and standard deviation, both over the prior's sigma.
    determined : sequence of bool
        Hollow marks are not.
    """
    rows = list(names)
    plot = plain_figure(
        "Coefficients less what was known before",
        "sigmas of what was known; the grey band is one sigma",
        "",
        y_range=rows[::-1],
        width=_WIDE + 180,
        height=90 + _ROW * len(rows),
    )
    reach = 1.1 * max(float(np.max(np.abs(shift) + sigma)), 1.5)
    plot.x_range = Range1d(-reach, reach)
    plot.hbar(
        y=rows, left=-1.0, right=1.0, height=1.0, fill_color=REFERENCE, fill_alpha=0.12, line_color=None
    )
    source = ColumnDataSource({"y": rows, "low": shift - sigma, "high": shift + sigma})
    bars = Whisker(base="y", lower="low", upper="high", dimension="width", source=source, line_color=AFTER)
    for head in (bars.lower_head, bars.upper_head):
        head.size, head.line_color = 5, AFTER
    plot.add_layout(bars)
    plot.scatter(shift, rows, size=6, color=AFTER, fill_alpha=np.where(determined, 1.0, 0.0))
    plot.add_layout(Span(location=0.0, dimension="height", line_color=REFERENCE))
    plot.yaxis.major_label_text_font_size = "10px"
    return plot


def continuous_figure(daily: xr.Dataset, table: xr.Dataset, title: str, factor: float, unit: str) -> figure:
    """Draw parameters of days with error bars, and the continuous ones with their band of one sigma.

    Parameters
    ----------
    daily : xarray.Dataset
        dims interval, parameter (at most three): `value`, `sigma`, `start`, `end`.
    table : xarray.Dataset
        The continuous table, with the same parameters; its first values are taken off both.
    title : str
    factor, unit : float, str
        Unit shown, which is `factor` times the parameters' own.
    """
    plot = plain_figure(title, "MJD (2000-01-01)", unit, width=_WIDE)
    when, curve = _middles(daily), _middles(table)
    thin = slice(None, None, max(1, when.size // _BARS))
    for name, colour in zip(daily["parameter"].values, COMPONENTS, strict=False):
        own, common = daily.sel(parameter=name), table.sel(parameter=name)
        base = float(common["value"].values[0])
        shown, bars = factor * (own["value"].values - base), factor * own["sigma"].values
        error_bars(plot, when[thin], shown[thin], bars[thin], colour, 0.35)
        label = str(name).rsplit("[", maxsplit=1)[-1].rstrip("]")
        plot.scatter(when, shown, color=colour, size=3, alpha=0.5)
        values = factor * (common["value"].values - base)
        sigma = factor * common["sigma"].values
        reach = float(np.nanmax(np.abs(shown)) + np.nanmedian(bars))
        # A band many times wider than all that is to be seen hides it; the label tells its size.
        if np.nanmedian(sigma) < _HIDES * reach:
            band(plot, curve, values, sigma, colour)
        plot.line(
            curve, values, color=colour, line_width=2, legend_label=f"{label} ± {np.nanmedian(sigma):.2g}"
        )
    legend_below(plot)
    return plot


def band_level_figure(start: np.ndarray, before: Floats, after: Floats) -> figure:
    """Draw what the residual has in the torquers' band each day, before and after the fitted matrix; nT."""
    plot = plain_figure("Residual in the torquers' band", "MJD (2000-01-01)", "nT", width=_WIDE)
    when = mjd_of(start)
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        plot.scatter(when, values, color=colour, size=5, legend_label=label)
        plot.line(when, values, color=colour, alpha=0.4)
    plot.y_range.start = 0.0
    legend_below(plot)
    return plot


def temperature_figure(temperature: Floats, value: Floats, sigma: Floats, title: str, unit: str) -> figure:
    """Draw a daily parameter against the day's temperature."""
    plot = plain_figure(title, "temperature (degC)", unit, width=470)
    thin = slice(None, None, max(1, temperature.size // (4 * _BARS)))
    error_bars(plot, temperature[thin], value[thin], sigma[thin], AFTER, 0.3)
    plot.scatter(temperature, value, color=AFTER, size=4)
    return plot


def _middles(table: xr.Dataset) -> Floats:
    return mjd_of(table["start"].values // 2 + table["end"].values // 2)
