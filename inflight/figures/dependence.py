"""Figures of what a residual follows, and of the form of what was found.

Takes dependences and responses of `inflight.residual`, curves and lag profiles of a finished search; makes
Bokeh figures: means in bins with error bars and branches, the field along each axis with the envelope of
chance, the residual along the field, around an event, folded by phase, and by lag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from bokeh.models import BoxAnnotation, Span
from bokeh.plotting import figure

from inflight.figures.style import (
    AFTER,
    BEFORE,
    BETWEEN,
    COMPONENTS,
    HIGHLIGHT,
    REFERENCE,
    curve_with_errors,
    draw_area,
    draw_line,
    draw_points,
    draw_segments,
    error_band,
    error_bars,
    legend_below,
    place_legend,
    plain_figure,
    short_name,
)
from inflight.figures.text import render
from inflight.residual import AxisResponse, Curve, Dependence, FieldResponse
from inflight.units import with_error

if TYPE_CHECKING:
    from inflight.diagnosis import EntryCurve, LagProfile


def dependence_figure(
    found: Dependence, earlier: Dependence | None = None, name: str = "", level: float = float("nan")
) -> figure:
    """Draw the mean residual in bins of a coordinate, its band of one sigma between blocks, its branches.

    `earlier` is what another version of the model, called `name`, left: drawn behind it; within `level`, nT,
    drawn as a band, is what does not matter.

    Branches (while the coordinate rises, while it falls) are drawn where they differ by five sigma
    or more; elsewhere they would only be noise.
    """
    plot = plain_figure(
        f"{found.coordinate}: rms {with_error(found.amplitude, found.sigma_amplitude)} nT",
        _axis(found.coordinate, found.unit),
        "nT",
    )
    if np.isfinite(level):
        plot.add_layout(BoxAnnotation(bottom=-level, top=level, fill_color=REFERENCE, fill_alpha=0.15))
    if earlier is not None:
        known = np.isfinite(earlier.mean)
        draw_line(
            plot,
            earlier.centre[known],
            earlier.mean[known],
            color=BETWEEN,
            line_dash="dashed",
            legend_label=f"{name}: rms {with_error(earlier.amplitude, earlier.sigma_amplitude)} nT",
        )
    loop = found.loop
    if loop is not None and loop.is_open:
        apart = f"falling; apart by {with_error(loop.opening, loop.sigma_opening)}"
        for branch, colour, label in ((loop.rising, BEFORE, "rising"), (loop.falling, AFTER, apart)):
            met = np.isfinite(branch.mean)
            error_band(plot, found.centre[met], branch.mean[met], branch.sigma[met], colour)
            draw_line(plot, found.centre[met], branch.mean[met], color=colour, legend_label=label)
        legend_below(plot)
        return plot
    met = np.isfinite(found.mean)
    curve_with_errors(plot, found.centre[met], found.mean[met], found.sigma[met], AFTER)
    if earlier is not None:
        legend_below(plot)
    return plot


def entry_figure(found: EntryCurve) -> figure:
    """Draw one effect: what is measured with all else in the model, what the effect makes, and what is left.

    Were it what is there, points lie on the line, and what is left is flat; bars are one sigma.
    """
    against = _axis(found.coordinate, found.unit) if found.axis else "what it makes (nT)"
    instead = f" instead of {short_name(found.instead_of)}" if found.instead_of else ""
    plot = plain_figure(
        f"{short_name(found.name)}{instead}{f': field along {found.axis}' if found.axis else ''}",
        against,
        "nT",
        width=560,
        height=300,
    )
    error_bars(plot, found.centre, found.measured, found.measured_sigma, BEFORE)
    draw_points(
        plot,
        found.centre,
        found.measured,
        color=BEFORE,
        size=6,
        legend_label="measured, all else in the model",
    )
    draw_line(plot, found.centre, found.made, color="#111111", legend_label="what it would make")
    error_bars(plot, found.centre, found.left, found.left_sigma, AFTER)
    draw_line(
        plot,
        found.centre,
        found.left,
        color=AFTER,
        line_dash="dotted",
        legend_label="left with it in the model",
    )
    draw_points(plot, found.centre, found.left, color=AFTER, size=4)
    legend_below(plot)
    return plot


def axis_figure(found: AxisResponse) -> figure:
    """Draw the field along x, y, z that makes the residual follow a coordinate; bars of one sigma."""
    plot = plain_figure(
        f"{found.coordinate}: field along each axis", _axis(found.coordinate, found.unit), "nT"
    )
    for index, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        value, sigma = found.field[:, index], found.sigma[:, index]
        error_bars(plot, found.centre, value, sigma, colour, 0.6)
        legend = f"{axis} {with_error(found.amplitude[index], found.sigma_amplitude[index])}"
        draw_line(plot, found.centre, value, color=colour, legend_label=legend)
        draw_points(plot, found.centre, value, color=colour, size=4)
    legend_below(plot)
    return plot


def _axis(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit not in ("", "1") else name


#: Day and night, and their marks, for readers who cannot separate the colours.
_SIDES = {"day": ("#c98a00", "circle"), "night": ("#3b3f8f", "square"), "all": (AFTER, "circle")}

_BRANCHES = {
    "rising": (BEFORE, "triangle"),
    "falling": (AFTER, "inverted_triangle"),
    "all": (AFTER, "circle"),
}

_CHANCE = "#9a9a94"


def along_field_figures(found: Mapping[str, Sequence[Curve]], axis: str = "z") -> list[figure]:
    """Draw the residual against a component of the field's direction, by day and by night."""
    plots = []
    reach = _reach([curve for curves in found.values() for curve in curves])
    for which, curves in found.items():
        plot = plain_figure(
            f"Residual against B_{axis} / |B|, {which}",
            f"B_{axis} / |B|",
            "mean residual (nT)",
            width=560,
            height=290,
            x_range=(-1.05, 1.05),
            y_range=reach,
        )
        for curve in curves:
            colour, marker = _SIDES[curve.label]
            _draw(plot, curve, colour, marker, curve.label)
        legend_below(plot)
        plots.append(plot)
    return plots


def response_figures(found: FieldResponse) -> list[figure]:
    """Draw what a field along x, y and z would have to be to make the residual follow a channel.

    Bars are one sigma between blocks, the grey band is what the same channel at other times explains,
    the dotted line is the residual after the found effects; `response_legend` is their common legend.
    """
    plots = []
    curves = [curve for branch in found.branches.values() for curve in branch]
    reach = _reach(curves, [*found.low, *found.high])
    label = f"{found.channel} ({found.unit})" if found.unit not in ("", "1") else found.channel
    for axis, name in enumerate(found.axes):
        plot = plain_figure(
            f"{found.channel}: field along {name}", label, "nT", height=205, width=384, y_range=reach
        )
        plot.toolbar.autohide = True
        known = np.isfinite(found.low[axis]) & np.isfinite(found.high[axis]) & np.isfinite(found.centre)
        if known.sum() > 1:
            ends = (found.centre[known], found.low[axis][known], found.high[axis][known])
            draw_area(plot, *ends, color=_CHANCE, alpha=0.35)
        for branch, parts in found.branches.items():
            if branch == "after":
                continue
            colour, marker = _BRANCHES[branch]
            _draw(plot, parts[axis], colour, marker)
        if "after" in found.branches:
            after = found.branches["after"][axis]
            known = np.isfinite(after.mean)
            style = {"color": "#111111", "line_dash": "dotted", "line_width": 2}
            draw_line(plot, after.centre[known], after.mean[known], **style)
        plots.append(plot)
    return plots


def channel_figures(
    found: FieldResponse,
    labels: tuple[str, str],
    level: float = float("nan"),
    amplitude: Dependence | None = None,
    earlier: Dependence | None = None,
) -> list[figure]:
    """Draw a residual against a channel, or the fields along the axes that would make it follow the channel.

    The band of a curve is one sigma between blocks; the grey envelope is what the same channel at other times
    explains, so that only what leaves it counts. Of two states the first is grey, the second coloured. Of
    several axes the last figure has the legend.

    Parameters
    ----------
    found : FieldResponse
        Its axes may be ``residual`` alone.
    labels : tuple of str
        What the states are called; the first of one state alone.
    level : float
        Within it, nT, either way, between dotted lines, is what does not matter.
    amplitude : Dependence, optional
        Told in the title of a residual.
    earlier : Dependence, optional
        What an earlier version of the model left, drawn dashed.
    """
    changed = "after" in found.branches
    curves = [curve for branch in found.branches.values() for curve in branch]
    reach = _reach(curves, [*found.low, *found.high])
    plots = []
    for axis, name in enumerate(found.axes):
        whole = name == "residual"
        title = found.channel if whole else f"{found.channel}: field along {name}"
        if whole and amplitude is not None:
            title += f": rms {with_error(amplitude.amplitude, amplitude.sigma_amplitude)} nT"
        what = "mean residual (nT)" if whole else f"field along {name} (nT)"
        plot = plain_figure(title, _axis(found.channel, found.unit), what, y_range=reach)
        if np.isfinite(level):
            edge = {"line_color": "#222222", "line_dash": "dotted", "line_alpha": 0.8}
            plot.add_layout(BoxAnnotation(bottom=-level, top=level, fill_color=None, **edge))
        known = np.isfinite(found.low[axis]) & np.isfinite(found.high[axis]) & np.isfinite(found.centre)
        if known.sum() > 1:
            draw_area(
                plot,
                found.centre[known],
                found.low[axis][known],
                found.high[axis][known],
                fill_color=_CHANCE,
                fill_alpha=0.35,
                legend_label="chance",
            )
        if earlier is not None and whole:
            met = np.isfinite(earlier.mean)
            draw_line(
                plot,
                earlier.centre[met],
                earlier.mean[met],
                color=BETWEEN,
                line_dash="dashed",
                legend_label="version before",
            )
        for branch, parts in found.branches.items():
            colour, marker = _BRANCHES["all" if branch == "after" else branch]
            if changed and branch != "after":
                colour = REFERENCE
            label = {"all": labels[0], "after": labels[1]}.get(branch, f"{labels[0]}, {branch}")
            curve = parts[axis]
            met = np.isfinite(curve.mean) & np.isfinite(curve.centre)
            order = np.flatnonzero(met)[np.argsort(curve.centre[met])]
            sigma = np.nan_to_num(curve.sigma[order])
            error_band(plot, curve.centre[order], curve.mean[order], sigma, colour)
            draw_line(plot, curve.centre[order], curve.mean[order], color=colour, line_width=1.5)
            draw_points(
                plot,
                curve.centre[order],
                curve.mean[order],
                color=colour,
                marker=marker,
                size=6,
                legend_label=label,
                name=branch,
            )
        if name == found.axes[-1]:
            legend_below(plot)
        elif plot.legend:
            plot.legend.visible = False
        plots.append(plot)
    return plots


def response_legend() -> str:
    """Return the common legend of all response figures as HTML."""
    marks = (
        (_BRANCHES["rising"][0], "\u25b2", "before, channel rising"),
        (_BRANCHES["falling"][0], "\u25bc", "before, channel falling"),
        (_BRANCHES["all"][0], "\u25cf", "before, a channel without branches"),
        ("#111111", "\u22ef", "after"),
        (_CHANCE, "\u25a0", "chance"),
    )
    return render("key.html", marks=marks)


def _draw(plot: figure, curve: Curve, colour: str, marker: str, label: str = "") -> None:
    known = np.isfinite(curve.mean) & np.isfinite(curve.centre)
    x, mean, sigma = curve.centre[known], curve.mean[known], np.nan_to_num(curve.sigma[known])
    # Plain segments: whiskers are many models, and a page has many of these.
    draw_segments(plot, x, mean - sigma, x, mean + sigma, color=colour, alpha=0.6)
    named = {"legend_label": label} if label else {}
    draw_line(plot, x, mean, color=colour, line_width=1.5, **named)
    draw_points(plot, x, mean, color=colour, marker=marker, size=5, **named)


def _reach(curves: Sequence[Curve], more: Sequence[np.ndarray] = ()) -> tuple[float, float]:
    """Return one range for several figures, wide enough for all that is known to a few sigma."""
    ends = [np.zeros(1), *map(np.asarray, more)]
    for curve in curves:
        # Bins that are all noise must not set the scale of all others.
        usual = np.nanmedian(curve.sigma) if np.isfinite(curve.sigma).any() else np.inf
        ends.append(curve.mean[np.nan_to_num(curve.sigma, nan=0.0, posinf=0.0, neginf=0.0) <= 8.0 * usual])
    values = np.concatenate(ends)
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    room = 0.08 * max(high - low, 1e-6)
    return low - room, high + room


def epoch_figure(name: str, found: Mapping[str, Curve]) -> figure:
    """Draw the mean residual around an event, before and after the found effects."""
    plot = plain_figure(f"Around {name}", "days from the event", "mean residual (nT)", width=560)
    for which, colour, marker in (("before", BEFORE, "triangle"), ("after", AFTER, "circle")):
        _draw(plot, found[which], colour, marker, which)
    plot.add_layout(Span(location=0.0, dimension="height", line_color=REFERENCE, line_dash="dashed"))
    legend_below(plot)
    return plot


def fold_figure(period: str, curve: np.ndarray, sigma: np.ndarray) -> figure:
    """Draw what repeats, along each axis by phase: field (phase, axis) and its errors, nT."""
    plot = plain_figure(f"What is left, folded at {period}", "phase (periods)", "nT", width=560)
    phase = (np.arange(len(curve)) + 0.5) / len(curve)
    for axis, colour in enumerate(COMPONENTS):
        error_bars(
            plot,
            phase,
            curve[:, axis],
            np.where(np.isfinite(sigma[:, axis]), sigma[:, axis], 0.0),
            colour,
            0.5,
        )
        draw_line(plot, phase, curve[:, axis], color=colour, legend_label="xyz"[axis])
    legend_below(plot)
    return plot


def lag_figure(name: str, found: LagProfile, rows: float) -> figure:
    """Draw the rms that each lag leaves (in-sample) and the best one with its error.

    Parameters
    ----------
    name : str
        Of the effect.
    rows : float
        Rows of the Gram blocks, which turn sums of squares into an rms.
    """
    size = np.sqrt(np.maximum(found.remaining, 0.0) / max(rows, 1.0))
    drawn = found.lags > 0
    title = f"lag {found.best:.3g} ± {found.sigma:.2g} s" if found.best > 0 else "no lag is best"
    plot = plain_figure(
        f"{short_name(name).split(', lag')[0]}: {title}",
        "lag (s)",
        "rms left, in-sample (nT)",
        x_axis_type="log",
        width=560,
    )
    draw_line(plot, found.lags[drawn], size[drawn], color=AFTER, line_width=2, legend_label="this lag")
    # No lag at all has no place on a logarithmic axis: it is a level.
    draw_line(
        plot,
        found.lags[drawn][[0, -1]],
        [size[0], size[0]],
        color=AFTER,
        line_dash="dotted",
        legend_label="no lag",
    )
    if found.best > 0:
        height = float(np.interp(found.best, found.lags, size))
        draw_points(plot, [found.best], [height], color=HIGHLIGHT, size=8, legend_label="best")
        plot.add_layout(Span(location=found.best, dimension="height", line_color=HIGHLIGHT, line_width=1.5))
        # The axis is logarithmic: an interval that reaches nothing is open to the left.
        low = found.best - found.sigma
        left = low if low > 0 else None
        plot.add_layout(
            BoxAnnotation(left=left, right=found.best + found.sigma, fill_color=HIGHLIGHT, fill_alpha=0.12)
        )
    place_legend(plot, "top_left")
    return plot
