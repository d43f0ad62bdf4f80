"""Figures of calibration parameters in time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.figures.style import COMPONENTS, error_bars, legend_below, plain_figure
from inflight.time import to_utc

#: What is drawn: part of the parameter's name, title, factor and unit shown, less the prior.
_PANELS = (
    ("scale_factor", "Scale factors less prior", 1e6, "ppm"),
    ("misalignment", "Misalignment angles less prior", 3600.0, "arcsec"),
    ("offset", "Offsets less prior", 1.0, "nT"),
)


def parameter_figures(daily: xr.Dataset, used: xr.Dataset) -> list[figure]:
    """Draw daily parameters with error bars, and the table that products use as steps.

    Parameters
    ----------
    daily, used : xarray.Dataset
        Calibration tables; dims interval, parameter.

    Returns
    -------
    list of figure
        Scale factors, misalignment angles, offsets; empty circles are not determined by the day alone.
    """
    return [_panel(daily, used, *panel) for panel in _PANELS]


def _panel(daily: xr.Dataset, used: xr.Dataset, part: str, title: str, factor: float, unit: str) -> figure:
    plot = plain_figure(title, "", unit, x_axis_type="datetime")
    names = [str(name) for name in daily["parameter"].values if f".{part}[" in str(name)]
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    for name, colour in zip(names, COMPONENTS, strict=False):
        prior = float(daily["prior"].sel(parameter=name))
        value = (daily["value"].sel(parameter=name).values - prior) * factor
        sigma = daily["sigma"].sel(parameter=name).values * factor
        known = daily["determined"].sel(parameter=name).values
        label = name.split("[")[-1].rstrip("]")
        # The prior's width is no measurement, and would flatten what was measured.
        error_bars(plot, middle[known], value[known], sigma[known], colour, 0.4)
        fill = np.where(known, 1.0, 0.0)
        plot.scatter(middle, value, color=colour, fill_alpha=fill, size=5, legend_label=label)
        _steps(plot, daily, used, name, prior, factor, colour)
    legend_below(plot)
    return plot


def _steps(
    plot: figure, daily: xr.Dataset, used: xr.Dataset, part: str, prior: float, factor: float, colour: str
) -> None:
    begin, stop = int(daily["start"].values[0]), int(daily["end"].values[-1])
    start, end = (to_utc(np.clip(used[name].values, begin, stop)) for name in ("start", "end"))
    value = (used["value"].sel(parameter=part).values - prior) * factor
    plot.segment(start, value, end, value, color=colour, line_width=2, alpha=0.8)
