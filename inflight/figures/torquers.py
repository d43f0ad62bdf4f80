"""Figures of the magneto-torquers: daily coefficients, the band before and after, the running mean."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.models import BoxAnnotation, Span
from bokeh.plotting import figure

from inflight.estimators.secular import STATES, CarriedMean
from inflight.estimators.torquer_band import BAND
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
from inflight.time import to_utc

_WIDE = 560


def coefficient_figures(daily: xr.Dataset, mean: xr.Dataset) -> list[figure]:
    """Draw the daily coefficients of each field axis, one colour a coil, and their robust means as lines.

    Parameters
    ----------
    daily : xarray.Dataset
        Of `torquer_band.daily_fits`.
    mean : xarray.Dataset
        Of `torquer_band.robust_mean`.
    """
    return [_coefficients_of(daily, mean, axis) for axis in daily["axis"].values]


def _coefficients_of(daily: xr.Dataset, mean: xr.Dataset, axis: str) -> figure:
    plot = plain_figure(
        f"Torquers' field along {axis}", "", "nT/A, vector less scalar", x_axis_type="datetime"
    )
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    for coil, colour in zip(daily["coil"].values, COMPONENTS, strict=True):
        one = daily.sel(axis=axis, coil=coil)
        value = float(mean["value"].sel(axis=axis, coil=coil))
        error_bars(plot, middle, one["value"].values, one["sigma"].values, colour, 0.35)
        plot.scatter(middle, one["value"].values, color=colour, size=5, legend_label=f"coil {coil}")
        plot.add_layout(Span(location=value, dimension="width", line_color=colour, line_width=1))
    legend_below(plot)
    return plot


def band_figure(spectra: xr.Dataset, low: float = 0.02, high: float = 0.1) -> figure:
    """Draw the spectrum of dB around the modulation, before and after; the band that is fitted is shaded.

    Parameters
    ----------
    spectra : xarray.Dataset
        Of `torquer_band.band_spectra`.
    low, high : float
        Hz, what is shown.
    """
    plot = plain_figure(
        "Residual around the torquers' 20 s",
        "frequency (Hz)",
        "nT / sqrt(Hz)",
        y_axis_type="log",
        width=_WIDE,
    )
    frequency = spectra["frequency"].values
    shown = (frequency >= low) & (frequency <= high)
    for name, colour in (("before", BEFORE), ("after", AFTER)):
        size = np.sqrt(spectra[name].values[shown])
        plot.line(frequency[shown], size, color=colour, legend_label=name)
    plot.add_layout(BoxAnnotation(left=BAND[0], right=BAND[1], fill_color=REFERENCE, fill_alpha=0.1))
    legend_below(plot)
    return plot


def carried_mean_figures(mean: CarriedMean, field: xr.Dataset) -> list[figure]:
    """Draw daily and running means of the torquer currents, and the remanent field they tell.

    Parameters
    ----------
    mean : CarriedMean
    field : xarray.Dataset
        Of `secular.remanent_field`. Where the window was not covered the line is dashed.
    """
    middle = to_utc(field["start"].values // 2 + field["end"].values // 2)
    upper = plain_figure(
        f"Torquer currents: daily and {mean.window:g} d means", "", "mA", x_axis_type="datetime", width=_WIDE
    )
    lower = plain_figure("Remanent field at the scalar sensor", "", "nT", x_axis_type="datetime", width=_WIDE)
    own = mean.state < STATES.index("interpolated")
    for index, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        upper.scatter(middle, 1e3 * mean.daily[:, index], color=colour, size=2, alpha=0.35)
        for plot, value, sigma in (
            (upper, 1e3 * mean.value[:, index], 1e3 * mean.sigma[:, index]),
            (lower, field["value"].values[:, index], field["sigma"].values[:, index]),
        ):
            band(plot, middle, value, sigma, colour)
            plot.line(middle, np.where(own, value, np.nan), color=colour, line_width=2, legend_label=axis)
            plot.line(middle, np.where(own, np.nan, value), color=colour, line_width=2, line_dash="dashed")
    for plot in (upper, lower):
        legend_below(plot)
    return [upper, lower]
