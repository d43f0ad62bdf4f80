"""Figures of two sensors: states on a boom, and two calibrated fluxgates.

Of two sensors on one boom: the states in the space of differences and in time, the field before and after the
correction, what was taken off, and the steps at switchings. Of two calibrated vector sensors: rotation,
stretch and shift of one against the other, and the variance that belongs to each of three sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, islice

import numpy as np
import numpy.typing as npt
import xarray as xr
from bokeh.models import ColumnDataSource, FixedTicker, Span
from bokeh.palettes import Category20_20
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    REFERENCE,
    draw_line,
    draw_points,
    error_bars,
    legend_below,
    plain_figure,
)
from inflight.time import to_utc
from inflight.units import with_error

Ints = npt.NDArray[np.int64]

Times = npt.NDArray[np.datetime64]

#: The planes of the three-dimensional difference.
PLANES = ((0, 1), (0, 2), (1, 2))

_AXES = "xyz"

#: Points drawn at most; standard deviations that an ellipse shows.
_POINTS, _SIGMAS = 6000, 2.0

#: States with a number at the axis, about.
_TICKS = 16

#: Part of a plane's range around its outermost states.
_ROOM = 0.25

_ROUND = np.linspace(0.0, 2.0 * np.pi, 73)


def state_colours(states: Sequence[int]) -> dict[int, str]:
    """Return a colour for each state; what is in no state is grey."""
    known = sorted(one for one in set(states) if one >= 0)
    return dict(zip(known, islice(cycle(Category20_20), len(known)), strict=True)) | {
        one: REFERENCE for one in set(states) if one < 0
    }


def difference_figure(
    points: Floats,
    state: Ints,
    known: Mapping[int, tuple[Floats, Floats]],
    plane: tuple[int, int],
) -> figure:
    """Draw mean differences of states' intervals and, as ellipses of two sigmas, the states themselves.

    Parameters
    ----------
    points : ndarray, shape (interval, axis)
        Mean ``B_in - B_out`` of each interval, nT.
    state : ndarray of int64, shape (interval,)
    known : mapping of int to (centre, covariance)
        Of each state by its number: its place in the difference, (axis,) nT, and the covariance of its
        points, (axis, axis) nT^2; not finite where it has none.
    plane : (int, int)
        Axes drawn to the right and up.
    """
    right, up = plane
    plot = plain_figure(
        f"States in the plane {_AXES[right]}, {_AXES[up]}",
        f"difference along {_AXES[right]} (nT)",
        f"difference along {_AXES[up]} (nT)",
    )
    # Numbers are written next to their states: those at the edge need room.
    plot.x_range.range_padding = plot.y_range.range_padding = _ROOM
    colours = state_colours([*state.tolist(), *known])
    thin = slice(None, None, max(1, len(points) // _POINTS))
    source = ColumnDataSource(
        {
            "x": points[thin, right],
            "y": points[thin, up],
            "colour": [colours[one] for one in state[thin].tolist()],
            "state": state[thin],
        }
    )
    draw_points(plot, "x", "y", source=source, color="colour", size=4, alpha=0.5)
    seen = {number: one for number, one in known.items() if np.isfinite(one[0]).all()}
    rings = [_ellipse(middle, spread, plane) for middle, spread in seen.values()]
    # One glyph for all rings and one for all numbers: Bokeh makes a dozen models for each.
    shown = ColumnDataSource(
        {
            "xs": [ring[0] for ring in rings],
            "ys": [ring[1] for ring in rings],
            "x": [float(middle[right]) for middle, _ in seen.values()],
            "y": [float(middle[up]) for middle, _ in seen.values()],
            "colour": [colours[number] for number in seen],
            "number": [str(number) for number in seen],
        }
    )
    plot.multi_line("xs", "ys", source=shown, color="colour", line_width=1.5)
    plot.text("x", "y", "number", source=shown, text_font_size="10px", x_offset=5, y_offset=-3)
    return plot


def _ellipse(middle: Floats, spread: Floats, plane: tuple[int, int]) -> Floats:
    """Return the ellipse of two sigmas about a state's place in a plane; (2, point), nT."""
    values, vectors = np.linalg.eigh(spread[np.ix_(plane, plane)])
    reach = _SIGMAS * np.sqrt(np.clip(values, 0.0, None))
    ring = vectors @ (reach[:, None] * np.stack([np.cos(_ROUND), np.sin(_ROUND)]))
    return np.asarray(middle[list(plane), None] + ring)


def timeline_figure(begin: Times, end: Times, state: Ints, probability: Floats) -> figure:
    """Draw which state held when; pale where it is uncertain, grey in the lowest row where none is known.

    Parameters
    ----------
    begin, end : ndarray of datetime64, shape (interval,)
    state : ndarray of int64, shape (interval,)
    probability : ndarray, shape (interval,)
        NaN where the method has none.
    """
    plot = plain_figure("States in time", "UTC", "state", x_axis_type="datetime", width=1130)
    colours = state_colours(state.tolist())
    opacity = np.nan_to_num(probability, nan=0.3)
    source = ColumnDataSource(
        {
            "left": begin,
            "right": end,
            "bottom": np.maximum(state, -1) - 0.4,
            "top": np.maximum(state, -1) + 0.4,
            "colour": [colours[one] for one in state.tolist()],
            "alpha": np.clip(opacity, 0.15, 1.0),
        }
    )
    plot.quad("left", "right", "top", "bottom", source=source, color="colour", alpha="alpha", line_width=0)
    numbers = sorted(set(np.maximum(state, -1).tolist()))
    plot.yaxis.ticker = FixedTicker(ticks=numbers[:: max(1, len(numbers) // _TICKS)])
    if (state < 0).any():
        plot.yaxis.major_label_overrides = {-1: "none"}
    return plot


def before_after_figure(time: Times, outboard: Floats, field: Floats, axis: int) -> figure:
    """Draw one component of the outboard reading and of the corrected field, nT."""
    plot = plain_figure(
        f"Outboard sensor along {_AXES[axis]}", "UTC", "nT", x_axis_type="datetime", width=1130
    )
    for values, colour, label in ((outboard, BEFORE, "as measured"), (field, AFTER, "corrected")):
        draw_line(plot, time, values[:, axis], color=colour, alpha=0.8, legend_label=label)
    legend_below(plot)
    return plot


def correction_figure(time: Times, correction: Floats) -> figure:
    """Draw what was taken off the outboard reading, all three components (time, axis), nT."""
    plot = plain_figure("What was taken off", "UTC", "nT", x_axis_type="datetime", width=1130)
    for axis, colour in enumerate(COMPONENTS):
        draw_line(plot, time, correction[:, axis], color=colour, legend_label=_AXES[axis])
    legend_below(plot)
    return plot


def switching_steps_figure(difference: Floats, outboard: Floats, corrected: Floats, axis: int) -> figure:
    """Draw the outboard step of each switching against that of the difference, before and after; nT.

    Parameters
    ----------
    difference, outboard, corrected : ndarray, shape (switching, axis)
        Steps across the same switchings.
    """
    plot = plain_figure(
        f"Steps at switchings along {_AXES[axis]}",
        "step of the difference (nT)",
        "outboard step (nT)",
    )
    for values, colour, label in ((outboard, BEFORE, "as measured"), (corrected, AFTER, "corrected")):
        draw_points(
            plot, difference[:, axis], values[:, axis], color=colour, size=5, alpha=0.7, legend_label=label
        )
    known = difference[np.isfinite(difference[:, axis]), axis]
    if known.size:
        draw_line(plot, [known.min(), known.max()], [0.0, 0.0], color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot


#: Parts of a relation: title, factor and unit shown.
PARTS = {
    "rotation": ("Rotation of the second sensor against the first", 3600.0, "arcsec"),
    "stretch": ("Stretch of the second sensor against the first", 1e6, "ppm"),
    "shift": ("Shift of the second sensor against the first", 1.0, "nT"),
}

_WIDTH = 470

#: Error bars at most: more of them are one surface.
_BARS = 300


def unit_steps_figure(time: Times, step: Floats, scatter: float, mean: Floats, sigma: Floats) -> figure:
    """Draw the steps of the difference at each switching of one unit, and the unit's own vector as lines.

    Parameters
    ----------
    time : ndarray of datetime64, shape (switching,)
    step : ndarray, shape (switching, axis)
        With the unit's sign, nT.
    scatter : float
        Of a component of a step, nT.
    mean, sigma : ndarray, shape (axis,)
        The unit's vector, nT.
    """
    plot = plain_figure(
        "Unit without housekeeping: steps of the difference", "UTC", "nT", x_axis_type="datetime", width=560
    )
    for axis, colour in enumerate(COMPONENTS):
        error_bars(plot, time, step[:, axis], np.full(len(step), scatter), colour)
        label = f"{_AXES[axis]} {with_error(float(mean[axis]), float(sigma[axis]))}"
        draw_points(plot, time, step[:, axis], color=colour, size=6, legend_label=label)
        plot.add_layout(Span(location=float(mean[axis]), dimension="width", line_color=colour))
    legend_below(plot)
    return plot


def relation_figure(table: xr.Dataset, part: str) -> figure:
    """Draw one part of a relation with its errors.

    Parameters
    ----------
    table : xarray.Dataset
        Of `inflight.mission_fit.two_fluxgates.Relation`.
    part : str
        Of `PARTS`.
    """
    title, factor, unit = PARTS[part]
    names = _names(table, part)
    one = table.sel(parameter=names)
    plot = plain_figure(title, "", unit, width=_WIDTH)
    place = np.arange(len(names), dtype=np.float64)
    value = factor * one["value"].values
    draw_line(plot, [-0.5, len(names) - 0.5], [0.0, 0.0], color=REFERENCE)
    error_bars(plot, place, value, factor * one["sigma"].values, AFTER)
    draw_points(plot, place, value, color=AFTER, size=7)
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
        draw_points(
            plot, middle, value, color=colour, size=4, legend_label=name.partition("[")[2].removesuffix("]")
        )
    legend_below(plot)
    return plot


def sensor_variance_figure(table: xr.Dataset) -> figure:
    """Draw the variance that belongs to each of three sensors, with its error.

    Parameters
    ----------
    table : xarray.Dataset
        Of `inflight.mission_fit.two_fluxgates.ThreeCornerVariances`. A variance may come out negative:
        it is an estimate.
    """
    names = [str(name) for name in table["sensor"].values]
    title = f"What disagrees, means of {table.attrs['mean_s']:g} s"
    plot = plain_figure(title, "", "variance, nT^2", width=_WIDTH)
    place = np.arange(len(names), dtype=np.float64)
    draw_line(plot, [-0.5, len(names) - 0.5], [0.0, 0.0], color=REFERENCE)
    error_bars(plot, place, table["value"].values, table["sigma"].values, AFTER)
    draw_points(plot, place, table["value"].values, color=AFTER, size=8)
    _label(plot, [f"{name} fluxgate" if name != "scalar" else "scalar sensor" for name in names])
    return plot


def _names(table: xr.Dataset, part: str) -> list[str]:
    return [str(name) for name in table["parameter"].values if str(name).startswith(f"{part}[")]


def _label(plot: figure, labels: list[str]) -> None:
    plot.xaxis.ticker = list(range(len(labels)))
    plot.xaxis.major_label_overrides = dict(enumerate(labels))
