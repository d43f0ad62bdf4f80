"""Figures of two vector sensors against each other: how they stand, and which of three disagrees."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.figures.style import AFTER, COMPONENTS, REFERENCE, error_bars, legend_below, plain_figure
from inflight.time import to_utc

#: Parts of a relation: title, factor and unit shown.
PARTS = {
    "rotation": ("Rotation of the second sensor against the first", 3600.0, "arcsec"),
    "stretch": ("Stretch of the second sensor against the first", 1e6, "ppm"),
    "shift": ("Shift of the second sensor against the first", 1.0, "nT"),
}
_WIDTH = 470
#: Error bars at most: more of them are one surface.
_BARS = 300


def relation_figure(table: xr.Dataset, part: str) -> figure:
    """Draw one part of a relation with its errors.

    Parameters
    ----------
    table : xarray.Dataset
        Of `inflight.estimators.two_fluxgates.Relation`.
    part : str
        Of `PARTS`.
    """
    title, factor, unit = PARTS[part]
    names = _names(table, part)
    one = table.sel(parameter=names)
    plot = plain_figure(title, "", unit, width=_WIDTH)
    place = np.arange(len(names), dtype=np.float64)
    value = factor * one["value"].values
    plot.line([-0.5, len(names) - 0.5], [0.0, 0.0], color=REFERENCE)
    error_bars(plot, place, value, factor * one["sigma"].values, AFTER)
    plot.scatter(place, value, color=AFTER, size=7)
    _label(plot, [name.partition("[")[2].removesuffix("]") for name in names])
    return plot


def relation_days_figure(daily: xr.Dataset, part: str) -> figure:
    """Draw the components of one part of the relation of each day, less their medians.

    Parameters
    ----------
    daily : xarray.Dataset
        dims interval, parameter: `value`, `sigma`; `start`, `end` TT2000.
    part : str
        ``rotation`` or ``shift``.
    """
    title, factor, unit = PARTS[part]
    plot = plain_figure(f"{title}, days less their median", "", unit, x_axis_type="datetime", width=_WIDTH)
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    sparse = slice(None, None, max(1, middle.size // _BARS))
    for name, colour in zip(_names(daily, part), COMPONENTS, strict=True):
        one = daily.sel(parameter=name)
        value = factor * (one["value"].values - np.nanmedian(one["value"].values))
        error_bars(plot, middle[sparse], value[sparse], factor * one["sigma"].values[sparse], colour, 0.4)
        plot.scatter(
            middle, value, color=colour, size=4, legend_label=name.partition("[")[2].removesuffix("]")
        )
    legend_below(plot)
    return plot


def corners_figure(table: xr.Dataset) -> figure:
    """Draw the variance that belongs to each of three sensors, with its error.

    Parameters
    ----------
    table : xarray.Dataset
        Of `inflight.estimators.two_fluxgates.Corners`. A variance may come out negative: it is an estimate.
    """
    names = [str(name) for name in table["sensor"].values]
    title = f"What disagrees, means of {table.attrs['mean_s']:g} s"
    plot = plain_figure(title, "", "variance, nT^2", width=_WIDTH)
    place = np.arange(len(names), dtype=np.float64)
    plot.line([-0.5, len(names) - 0.5], [0.0, 0.0], color=REFERENCE)
    error_bars(plot, place, table["value"].values, table["sigma"].values, AFTER)
    plot.scatter(place, table["value"].values, color=AFTER, size=8)
    _label(plot, [f"{name} fluxgate" if name != "scalar" else "scalar sensor" for name in names])
    return plot


def _names(table: xr.Dataset, part: str) -> list[str]:
    return [str(name) for name in table["parameter"].values if str(name).startswith(f"{part}[")]


def _label(plot: figure, labels: list[str]) -> None:
    plot.xaxis.ticker = list(range(len(labels)))
    plot.xaxis.major_label_overrides = dict(enumerate(labels))
