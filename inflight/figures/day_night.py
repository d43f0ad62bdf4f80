"""Figures of the day/night field: its course along the orbit, the wander of an angle without and with it."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.effects.base import AXES
from inflight.estimators.day_night import SERIES, DayNightField
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

_WIDTH, _HEIGHT = 560, 300


def day_night_figure(found: DayNightField) -> figure:
    """Draw the fitted series along the orbit, its mean left out, with a band of one sigma.

    Parameters
    ----------
    found : DayNightField
        A fit of `series_columns`; components that were not fitted are not drawn.
    """
    plot = plain_figure(
        "Day/night field along the orbit, mean left out",
        "angle from the point nearest the Sun (deg)",
        "nT, vector less scalar sensor",
        width=_WIDTH,
        height=_HEIGHT,
    )
    phase = np.linspace(-180.0, 180.0, 361)
    value, sigma = found.series(phase)
    plot.line([-180.0, 180.0], [0.0, 0.0], color=REFERENCE)
    for index, axis in enumerate(AXES):
        if any(name.startswith(f"{SERIES}[c{axis}") for name in found.columns):
            band(plot, phase, value[:, index], sigma[:, index], COMPONENTS[index])
            plot.line(phase, value[:, index], color=COMPONENTS[index], line_width=2, legend_label=axis)
    legend_below(plot)
    return plot


def wandering_figure(ignored: xr.Dataset, added: xr.Dataset, parameter: str, title: str) -> figure:
    """Draw a parameter of every block with the day/night field ignored, and with it in the model.

    Parameters
    ----------
    ignored, added : xarray.Dataset
        Of `inflight.estimators.day_night.block_parameters`.
    parameter : str
        Which one.
    title : str
    """
    unit = str(ignored["units"].sel(parameter=parameter).item())
    plot = plain_figure(title, "", unit, x_axis_type="datetime", width=_WIDTH, height=_HEIGHT)
    for table, colour, label in ((ignored, BEFORE, "ignored"), (added, AFTER, "in the model")):
        middle = to_utc(table["start"].values // 2 + table["end"].values // 2)
        value = table["value"].sel(parameter=parameter).values
        error_bars(plot, middle, value, table["sigma"].sel(parameter=parameter).values, colour, 0.4)
        plot.scatter(middle, value, color=colour, size=5, legend_label=label)
    legend_below(plot)
    return plot
