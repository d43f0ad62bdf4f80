"""Figures of two sensors on one boom: the states in the space of differences, and when each held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle, islice

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, FixedTicker
from bokeh.palettes import Category20_20
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import AFTER, BEFORE, COMPONENTS, REFERENCE, legend_below, plain_figure

Ints = npt.NDArray[np.int64]
Times = npt.NDArray[np.datetime64]
#: The planes of the three-dimensional difference.
PLANES = ((0, 1), (0, 2), (1, 2))
_AXES = "xyz"
#: Points drawn at most, and standard deviations of an ellipse.
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
    # Numbers stand beside their states: those at the edge need room.
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
    plot.scatter("x", "y", source=source, color="colour", size=4, alpha=0.5)
    for number, (middle, spread) in known.items():
        if not np.isfinite(middle).all():
            continue
        part = spread[np.ix_(plane, plane)]
        values, vectors = np.linalg.eigh(part)
        reach = _SIGMAS * np.sqrt(np.clip(values, 0.0, None))
        ring = vectors @ (reach[:, None] * np.stack([np.cos(_ROUND), np.sin(_ROUND)]))
        plot.line(middle[right] + ring[0], middle[up] + ring[1], color=colours[number], line_width=1.5)
        plot.text(
            [middle[right]], [middle[up]], [str(number)], text_font_size="10px", x_offset=5, y_offset=-3
        )
    return plot


def timeline_figure(begin: Times, end: Times, state: Ints, probability: Floats) -> figure:
    """Draw which state held when; pale where it is not sure, grey in the lowest row where none is known.

    Parameters
    ----------
    begin, end : ndarray of datetime64, shape (interval,)
    state : ndarray of int64, shape (interval,)
    probability : ndarray, shape (interval,)
        NaN where the method has none.
    """
    plot = plain_figure("States in time", "UTC", "state", x_axis_type="datetime", width=1130)
    colours = state_colours(state.tolist())
    sure = np.nan_to_num(probability, nan=0.3)
    source = ColumnDataSource(
        {
            "left": begin,
            "right": end,
            "bottom": np.maximum(state, -1) - 0.4,
            "top": np.maximum(state, -1) + 0.4,
            "colour": [colours[one] for one in state.tolist()],
            "alpha": np.clip(sure, 0.15, 1.0),
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
        plot.line(time, values[:, axis], color=colour, alpha=0.8, legend_label=label)
    legend_below(plot)
    return plot


def correction_figure(time: Times, taken_off: Floats) -> figure:
    """Draw what was taken off the outboard reading, all three components (time, axis), nT."""
    plot = plain_figure("What was taken off", "UTC", "nT", x_axis_type="datetime", width=1130)
    for axis, colour in enumerate(COMPONENTS):
        plot.line(time, taken_off[:, axis], color=colour, legend_label=_AXES[axis])
    legend_below(plot)
    return plot


def steps_figure(difference: Floats, outboard: Floats, corrected: Floats, axis: int) -> figure:
    """Draw the outboard step of each switching against that of the difference, before and after; nT.

    Parameters
    ----------
    difference, outboard, corrected : ndarray, shape (switching, axis)
        Steps across the same switchings.
    """
    plot = plain_figure(
        f"Steps at switchings along {_AXES[axis]}",
        "step of the difference (nT)",
        "step of the outboard field (nT)",
    )
    for values, colour, label in ((outboard, BEFORE, "as measured"), (corrected, AFTER, "corrected")):
        plot.scatter(
            difference[:, axis], values[:, axis], color=colour, size=5, alpha=0.7, legend_label=label
        )
    known = difference[np.isfinite(difference[:, axis]), axis]
    if known.size:
        plot.line([known.min(), known.max()], [0.0, 0.0], color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot
