"""Figures of a turning sensor's tables: parameters over days, the axial offset by method, correlations."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from bokeh.layouts import gridplot
from bokeh.models import ColorBar, LinearColorMapper, Range1d, Span
from bokeh.palettes import RdBu11
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    NEW,
    REFERENCE,
    error_bars,
    legend_below,
    plain_figure,
)
from inflight.spin.equation import SPIN_RELATED
from inflight.time import to_utc

#: Parts of an interval by which marks of different kinds stand apart.
_APART = 0.12
#: A pre-flight value farther off than this many times the values' own range is not drawn.
_FAR = 3.0
#: Sigmas beyond which a parameter has moved.
_MOVED = 5.0


def parameter_days_figure(table: xr.Dataset, selected: tuple[Floats, Floats]) -> Any:
    """Draw nine parameters over days: each day's own, those of selected estimates, and what is used.

    Parameters
    ----------
    table : xarray.Dataset
        Of days, as `inflight.tasks.spin_tables.spin_table` makes it.
    selected : tuple of ndarray, shape (interval, 8)
        Means of the estimates that a threshold chooses, and their errors, by `SPIN_RELATED`.
    """
    names = [*SPIN_RELATED, "offset[3]"]
    panels = [_days_panel(table, selected, name) for name in names]
    return gridplot([panels[at : at + 3] for at in range(0, len(panels), 3)], merge_tools=True)


def _days_panel(table: xr.Dataset, selected: tuple[Floats, Floats], name: str) -> figure:
    row = table.isel(parameter=[str(one).split(".", 1)[1] for one in table["parameter"].values].index(name))
    prior, unit = float(row["prior"]), str(row["units"].values)
    plot = plain_figure(
        f"{name}, pre-flight {prior:.6g} +- {float(row['prior_sigma']):.2g}",
        "",
        f"less pre-flight ({unit})",
        x_axis_type="datetime",
    )
    start, end = row["start"].values, row["end"].values
    middle = start // 2 + end // 2
    own, error = row["own"].values - prior, row["own_sigma"].values
    shown = [(own, error, AFTER, "joint", 0.0)]
    if name in SPIN_RELATED:
        at = SPIN_RELATED.index(name)
        shown.append((selected[0][:, at] - prior, selected[1][:, at], BEFORE, "selection", _APART))
    for value, sigma, colour, label, apart in shown:
        known = np.isfinite(value) & np.isfinite(sigma)
        when = to_utc((middle + apart * (end - start)).astype(np.int64))[known]
        error_bars(plot, when, value[known], sigma[known], colour, 0.5)
        plot.scatter(when, value[known], color=colour, size=5, legend_label=label)
    used = row["value"].values - prior
    plot.segment(to_utc(start), used, to_utc(end), used, color=NEW, line_width=2, legend_label="in use")
    _level(plot, used, own, to_utc(start[:1]), to_utc(end[-1:]))
    legend_below(plot)
    return plot


def _level(plot: figure, used: Floats, own: Floats, start: Any, end: Any) -> None:
    """Draw the pre-flight value where it does not press everything else together."""
    values = np.concatenate([used, own[np.isfinite(own)]])
    reach = float(np.ptp(values))
    if np.abs(values).min() <= _FAR * reach:
        plot.segment(start, [0.0], end, [0.0], color=REFERENCE, line_dash="dashed", legend_label="pre-flight")


def zero_drift_figure(table: xr.Dataset, rate: dict[str, tuple[float, float]]) -> figure:
    """Draw the three offsets less their pre-flight values over days; `rate` is nT a day with its error."""
    plot = plain_figure("Zero levels since before the flight", "", "nT", x_axis_type="datetime", width=560)
    names = [str(one).split(".", 1)[1] for one in table["parameter"].values]
    middle = to_utc(table["start"].values // 2 + table["end"].values // 2)
    for name, colour in zip((f"offset[{axis}]" for axis in (1, 2, 3)), COMPONENTS, strict=True):
        row = table.isel(parameter=names.index(name))
        change, sigma = row["own"].values - float(row["prior"]), row["own_sigma"].values
        known = np.isfinite(sigma)
        told = f": {rate[name][0]:+.3g} +- {rate[name][1]:.1g} nT a day" if name in rate else ""
        error_bars(plot, middle[known], change[known], sigma[known], colour, 0.5)
        plot.scatter(middle[known], change[known], color=colour, size=6, legend_label=f"{name}{told}")
    legend_below(plot)
    if plot.legend:
        plot.legend[0].orientation = "vertical"
    return plot


def zero_methods_figure(zero: xr.Dataset) -> figure:
    """Draw the offset along the spin axis by every method in each window, and the combined one."""
    plot = plain_figure("Offset along the spin axis by method", "", "nT", x_axis_type="datetime", width=560)
    start, end = zero["start"].values, zero["end"].values
    colours = (*COMPONENTS, "#8a5ca8")
    for place, (name, colour) in enumerate(zip(zero["method_name"].values, colours, strict=True)):
        value, sigma = (zero[one].values[:, place] for one in ("method_value", "method_sigma"))
        _marks(plot, (start, end), (value, sigma), colour, (str(name), _APART * (place - 2)))
    known = np.where(np.isfinite(zero["sigma"].values), zero["value"].values, np.nan)
    _marks(plot, (start, end), (known, zero["sigma"].values), NEW, ("combined", 2 * _APART))
    # Half a window to either side: of a single one the axis would tell seconds.
    ends = (to_utc(np.array([start[0], end[-1]])).astype("datetime64[ms]")).astype(np.int64)
    plot.x_range = Range1d(int(ends[0]), int(ends[1]))
    legend_below(plot)
    return plot


def _marks(
    plot: figure, span: tuple[Any, Any], told: tuple[Floats, Floats], colour: str, what: tuple[str, float]
) -> None:
    known = np.isfinite(told[0]) & np.isfinite(told[1])
    middle = span[0] // 2 + span[1] // 2 + (what[1] * (span[1] - span[0])).astype(np.int64)
    when = to_utc(middle)[known]
    error_bars(plot, when, told[0][known], told[1][known], colour)
    plot.scatter(when, told[0][known], color=colour, size=6, legend_label=what[0])


def correlation_figure(correlation: Floats) -> figure:
    """Draw the correlation of the eight parameters' estimates; (8, 8).

    What shares no tone is not correlated: a change of the spin axis touches its two parameters alone
    (Plaschke et al. 2019, section 2).
    """
    names = list(SPIN_RELATED)
    plot = plain_figure(
        "Correlation of a day's estimates",
        "",
        "",
        x_range=names,
        y_range=names[::-1],
        width=470,
        height=400,
    )
    pairs = [(one, other) for one in names for other in names]
    size = [float(correlation[names.index(one), names.index(other)]) for one, other in pairs]
    mapper = LinearColorMapper(palette=RdBu11, low=-1.0, high=1.0)
    source = {"x": [one for one, _ in pairs], "y": [other for _, other in pairs], "size": size}
    plot.rect(
        "x", "y", 1, 1, source=source, fill_color={"field": "size", "transform": mapper}, line_color=None
    )
    plot.add_layout(ColorBar(color_mapper=mapper, width=10), "right")
    plot.xaxis.major_label_orientation = 0.8
    return plot


def moved_figure(table: xr.Dataset) -> figure:
    """Draw by how many sigma each of the eight moved from the first interval that tells it to the last.

    A change of the spin axis touches its two parameters alone (Plaschke et al. 2019, section 2).
    """
    names = [str(one).split(".", 1)[1] for one in table["parameter"].values]
    plot = plain_figure(
        "What moved from the first to the last", "", "sigma", x_range=list(SPIN_RELATED), width=470
    )
    pulls = []
    for name in SPIN_RELATED:
        row = table.isel(parameter=names.index(name))
        told = np.flatnonzero(np.isfinite(row["own_sigma"].values))
        first, last = (told[0], told[-1]) if told.size else (0, 0)
        value, sigma = row["own"].values, row["own_sigma"].values
        pulls.append(
            float((value[last] - value[first]) / np.hypot(sigma[first], sigma[last]))
            if told.size > 1
            else 0.0
        )
    plot.vbar(list(SPIN_RELATED), 0.6, pulls, color=[NEW if abs(one) > _MOVED else AFTER for one in pulls])
    for limit in (-_MOVED, _MOVED):
        plot.add_layout(Span(location=limit, dimension="width", line_color=REFERENCE, line_dash="dashed"))
    plot.xaxis.major_label_orientation = 0.8
    return plot
