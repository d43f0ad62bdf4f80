"""Figures of superposed epochs: a current with its steps, the stacked residual, the field by local time."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.effects.panel_light import schedule
from inflight.estimators.current_steps import CurrentSteps
from inflight.estimators.epoch_fits import Stack
from inflight.estimators.panels import LocalTimeCourse, PanelModel
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
from inflight.time import Int64, to_utc

_WIDE = 560
#: Drops and rises are told apart by colour and mark.
_MARKS = {-1: ("drop", "inverted_triangle", NEW), 1: ("rise", "triangle", BEFORE)}


def steps_figure(stamps: Int64, current: Floats, steps: CurrentSteps, name: str = "current") -> figure:
    """Draw a current and the steps found in it.

    Parameters
    ----------
    stamps : ndarray of int64, shape (reading,)
        TT2000.
    current : ndarray, shape (reading,)
        In the steps' unit.
    steps : CurrentSteps
    name : str
        Of the channel.
    """
    title = f"Steps of {name.replace('_', ' ')}"
    plot = plain_figure(
        title, "", f"{name.replace('_', ' ')} ({steps.unit})", x_axis_type="datetime", width=_WIDE
    )
    plot.line(to_utc(stamps), current, color=AFTER, legend_label=name.replace("_", " "))
    for direction, (label, marker, colour) in _MARKS.items():
        chosen = steps.where(steps.direction == direction)
        when, middle = to_utc(chosen.time), 0.5 * (chosen.before + chosen.after)
        if len(chosen):
            plot.scatter(
                when, middle, marker=marker, color=colour, size=7, legend_label=f"{label} ({len(chosen)})"
            )
    legend_below(plot)
    return plot


def stack_figures(found: Stack, unit_of: str = "solar current") -> list[figure]:
    """Draw the stacked residual with the band that resampling days gives, and the current below it."""
    reach = Range1d(float(found.lag[0]) - 3.0, float(found.lag[-1]) + 3.0)
    title = f"Residual around {found.epochs} steps on {found.days} days"
    upper = plain_figure(title, "s after the step", "dB less drift (nT)", x_range=reach, width=_WIDE)
    source = ColumnDataSource({"x": found.lag, "low": found.low, "high": found.high})
    upper.varea("x", "low", "high", source=source, color=AFTER, alpha=0.22, legend_label="68 % over days")
    upper.line(found.lag, found.residual, color=AFTER, line_width=2, legend_label="mean residual")
    lower = plain_figure(
        f"Mean {unit_of}", "s after the step", "change (A)", x_range=reach, width=_WIDE, height=190
    )
    lower.line(found.lag, found.current, color=BEFORE, line_width=2)
    for plot in (upper, lower):
        plot.add_layout(Span(location=0.0, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    legend_below(upper)
    return [upper, lower]


def local_time_figure(course: LocalTimeCourse, model: PanelModel | None = None) -> figure:
    """Draw the coefficient against the orbit's local time, which falls: noon and midnight are marked.

    Parameters
    ----------
    course : LocalTimeCourse
    model : PanelModel, optional
        Drawn as lines when local time alone tells it: *constant* or *two_panels*.
    """
    plot = plain_figure(
        "Field of the solar current, vector minus scalar sensor",
        "local time of the ascending node (h)",
        "nT/A",
        x_range=Range1d(24.0, 0.0),
        width=_WIDE,
    )
    for index, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        known = np.isfinite(course.value[:, index]) & course.determined[:, index]
        x, value, sigma = (
            part[known] for part in (course.local_time, course.value[:, index], course.sigma[:, index])
        )
        error_bars(plot, x, value, sigma, colour, 0.5)
        plot.scatter(x, value, color=colour, size=6, legend_label=axis)
        if model is not None and model.name in ("constant", "two_panels"):
            hours = np.linspace(0.0, 24.0, 241)
            weight = schedule(hours) if model.name == "two_panels" else np.ones((hours.size, 1))
            plot.line(hours, weight @ model.value[:, index], color=colour, alpha=0.7)
    for hour in (12.0, 0.0):
        plot.add_layout(Span(location=hour, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    legend_below(plot)
    return plot
