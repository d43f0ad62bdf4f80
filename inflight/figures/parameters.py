"""Figures of calibration parameters in time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from bokeh.plotting import figure

from inflight.figures.style import COMPONENTS, error_bars, legend_below, plain_figure
from inflight.time import to_utc

#: How parts of the nine parameters are called; others by their own name.
_TITLES = {"scale_factor": "Scale factors", "misalignment": "Misalignment angles", "offset": "Offsets"}
_RADIAN = 3600.0 * 180.0 / np.pi
#: Unit in the table -> factor and unit that are drawn, less the prior.
_UNITS = {"1": (1e6, "ppm"), "deg": (3600.0, "arcsec"), "rad": (_RADIAN, "arcsec")}


def parameter_figures(daily: xr.Dataset, used: xr.Dataset) -> list[figure]:
    """Draw daily parameters with error bars, and the table that products use as steps.

    Parameters
    ----------
    daily, used : xarray.Dataset
        Calibration tables; dims interval, parameter.

    Returns
    -------
    list of figure
        One for each part, such as scale factors, misalignment angles, offsets, unless all of it stays at
        its prior; empty circles are not determined by the day alone.
    """
    parts: dict[str, list[str]] = {}
    for name in map(str, daily["parameter"].values):
        parts.setdefault(name.split(".", 1)[-1].partition("[")[0], []).append(name)
    return [
        _panel(daily, used, part, names)
        for part, names in parts.items()
        if (daily["value"] != daily["prior"]).sel(parameter=names).values.any()
    ]


def _panel(daily: xr.Dataset, used: xr.Dataset, part: str, names: list[str]) -> figure:
    stated = str(daily["units"].sel(parameter=names[0]).values)
    factor, unit = _UNITS.get(stated, (1.0, stated))
    title = _TITLES.get(part, part.replace("_", " ").capitalize())
    plot = plain_figure(f"{title} less prior", "", unit, x_axis_type="datetime")
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    for name, colour in zip(names, COMPONENTS, strict=False):
        prior = float(daily["prior"].sel(parameter=name))
        value = (daily["value"].sel(parameter=name).values - prior) * factor
        sigma = daily["sigma"].sel(parameter=name).values * factor
        known = daily["determined"].sel(parameter=name).values
        label = name.partition("[")[2].rstrip("]") or part.replace("_", " ")
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
