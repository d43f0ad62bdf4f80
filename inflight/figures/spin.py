"""Figures of a spinning sensor: its parameters over days, its estimates, and the tones of its residual.

Takes tables of `inflight.tasks.pipelines.spin.tables`, selected estimates (`SubintervalEstimates`), and the
tones and their dependences (`inflight.spin.residual`); makes Bokeh figures. `estimates_figure` and
`uncertainty_figure` are figures 3 and 2 (c to f) of Plaschke et al. (2019).
"""

from __future__ import annotations

from dataclasses import dataclass
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
    HIGHLIGHT,
    REFERENCE,
    draw_line,
    draw_points,
    draw_segments,
    error_band,
    error_bars,
    legend_below,
    place_legend,
    plain_figure,
)
from inflight.spin import (
    PARAMETER_UNITS,
    ROW_NAMES,
    SPIN_RELATED,
    TONES,
    Bools,
    Selection,
    ToneDependence,
    Tones,
)
from inflight.time import Int64, to_utc
from inflight.units import with_error

#: Distance of markers of different kinds, in intervals.
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
        Of days, as `inflight.tasks.pipelines.spin.tables.spin_table` makes it.
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
        f"{name}, pre-flight {with_error(prior, float(row['prior_sigma']))}",
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
        draw_points(plot, when, value[known], color=colour, size=5, legend_label=label)
    used = row["value"].values - prior
    draw_segments(
        plot, to_utc(start), used, to_utc(end), used, color=HIGHLIGHT, line_width=2, legend_label="in use"
    )
    values = np.concatenate([used, own[np.isfinite(own)]])
    # The pre-flight value is drawn where it does not press everything else together.
    if np.abs(values).min() <= _FAR * float(np.ptp(values)):
        ends = to_utc(start[:1]), [0.0], to_utc(end[-1:]), [0.0]
        draw_segments(plot, *ends, color=REFERENCE, line_dash="dashed", legend_label="pre-flight")
    legend_below(plot)
    return plot


def zero_drift_figure(table: xr.Dataset, rate: dict[str, tuple[float, float]]) -> figure:
    """Draw the three offsets less their pre-flight values over days; `rate` is nT a day with its error."""
    plot = plain_figure("Zero levels since before the flight", "", "nT", x_axis_type="datetime", width=560)
    names = [str(one).split(".", 1)[1] for one in table["parameter"].values]
    middle = to_utc(table["start"].values // 2 + table["end"].values // 2)
    for name, colour in zip((f"offset[{axis}]" for axis in (1, 2, 3)), COMPONENTS, strict=True):
        row = table.isel(parameter=names.index(name))
        change, sigma = row["own"].values - float(row["prior"]), row["own_sigma"].values
        known = np.isfinite(sigma)
        drift = f": {with_error(*rate[name])} nT a day" if name in rate else ""
        error_bars(plot, middle[known], change[known], sigma[known], colour, 0.5)
        draw_points(plot, middle[known], change[known], color=colour, size=6, legend_label=f"{name}{drift}")
    legend_below(plot)
    if plot.legend:
        plot.legend[0].orientation = "vertical"
    return plot


def zero_methods_figure(zero: xr.Dataset, title: str = "Offset along the spin axis by method") -> figure:
    """Draw the offset along an axis by every method in each window, and the combined one."""
    plot = plain_figure(title, "", "nT", x_axis_type="datetime", width=560)
    start, end = zero["start"].values, zero["end"].values
    colours = (*COMPONENTS, "#8a5ca8")
    for place, (name, colour) in enumerate(zip(zero["method_name"].values, colours, strict=True)):
        value, sigma = (zero[one].values[:, place] for one in ("method_value", "method_sigma"))
        _markers(plot, (start, end), (value, sigma), colour, (str(name), _APART * (place - 2)))
    known = np.where(np.isfinite(zero["sigma"].values), zero["value"].values, np.nan)
    _markers(plot, (start, end), (known, zero["sigma"].values), HIGHLIGHT, ("combined", 2 * _APART))
    # Half a window to either side: of a single one the axis would be labelled in seconds.
    ends = (to_utc(np.array([start[0], end[-1]])).astype("datetime64[ms]")).astype(np.int64)
    plot.x_range = Range1d(int(ends[0]), int(ends[1]))
    legend_below(plot)
    return plot


def _markers(
    plot: figure, span: tuple[Any, Any], values: tuple[Floats, Floats], colour: str, label: tuple[str, float]
) -> None:
    """Draw values with their errors; `label` is the name and the distance from the middle in intervals."""
    known = np.isfinite(values[0]) & np.isfinite(values[1])
    middle = span[0] // 2 + span[1] // 2 + (label[1] * (span[1] - span[0])).astype(np.int64)
    when = to_utc(middle)[known]
    error_bars(plot, when, values[0][known], values[1][known], colour)
    draw_points(plot, when, values[0][known], color=colour, size=6, legend_label=label[0])


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


def parameter_change_figure(table: xr.Dataset) -> figure:
    """Draw by how many sigma each of the eight moved from the first to the last interval that determines it.

    A change of the spin axis touches its two parameters alone (Plaschke et al. 2019, section 2).
    """
    names = [str(one).split(".", 1)[1] for one in table["parameter"].values]
    plot = plain_figure(
        "What moved from the first to the last", "", "sigma", x_range=list(SPIN_RELATED), width=470
    )
    changes = []
    for name in SPIN_RELATED:
        row = table.isel(parameter=names.index(name))
        known = np.flatnonzero(np.isfinite(row["own_sigma"].values))
        first, last = (known[0], known[-1]) if known.size else (0, 0)
        value, sigma = row["own"].values, row["own_sigma"].values
        changes.append(
            float((value[last] - value[first]) / np.hypot(sigma[first], sigma[last]))
            if known.size > 1
            else 0.0
        )
    plot.vbar(
        list(SPIN_RELATED), 0.6, changes, color=[HIGHLIGHT if abs(one) > _MOVED else AFTER for one in changes]
    )
    for limit in (-_MOVED, _MOVED):
        plot.add_layout(Span(location=limit, dimension="width", line_color=REFERENCE, line_dash="dashed"))
    plot.xaxis.major_label_orientation = 0.8
    return plot


#: Panels in the order of figure 3 of Plaschke et al. (2019).
_ORDER = (
    "gain_ratio",
    "azimuth",
    "spin_axis[x]",
    "spin_axis[y]",
    "offset[1]",
    "offset[2]",
    "elevation[1]",
    "elevation[2]",
)

#: The height of a panel is this many standard deviations of the chosen estimates to either side.
_TALL = 12.0

#: And it ends at this many times the threshold: the poorest estimates hold no information.
_WIDE = 3e3


@dataclass(frozen=True)
class SubintervalEstimates:
    """Estimates of sub-intervals, and which of them a threshold chooses.

    Attributes
    ----------
    start, end : ndarray of int64, shape (sub,)
        TT2000.
    estimate, uncertainty : ndarray, shape (sub, 8)
        In the order of `SPIN_RELATED`.
    chosen : ndarray of bool, shape (sub, 8)
    threshold, value, sigma : ndarray, shape (8,)
        Largest uncertainty chosen; mean of the chosen ones and its error, infinite for none.
    """

    start: Int64
    end: Int64
    estimate: Floats
    uncertainty: Floats
    chosen: Bools
    threshold: Floats
    value: Floats
    sigma: Floats

    @classmethod
    def of(cls, found: Selection) -> SubintervalEstimates:
        """Return the estimates of a selection."""
        one = found.estimates
        return cls(
            one.start,
            one.end,
            one.value,
            one.uncertainty,
            found.chosen,
            found.threshold,
            found.value,
            found.sigma,
        )


def estimates_figure(selection: SubintervalEstimates, joint: tuple[Floats, Floats] | None = None) -> Any:
    """Draw the estimates of all sub-intervals against their uncertainties, as in the paper's figure 3.

    Parameters
    ----------
    selection : SubintervalEstimates
        Chosen estimates are drawn in red, their mean as a line; the threshold is a dotted one.
    joint : tuple of (ndarray (8,), ndarray (8,)), optional
        Value and sigma of the joint estimate, drawn as a dashed line.
    """
    panels = [_estimates_panel(selection, joint, name) for name in _ORDER]
    return gridplot([panels[:4], panels[4:]], toolbar_location="above", merge_tools=True)


def _estimates_panel(
    selection: SubintervalEstimates, joint: tuple[Floats, Floats] | None, name: str
) -> figure:
    at = SPIN_RELATED.index(name)
    value, uncertainty = selection.estimate[:, at], selection.uncertainty[:, at]
    chosen = selection.chosen[:, at]
    known = np.isfinite(value) & (uncertainty > 0.0)
    unit = PARAMETER_UNITS[name]
    plot = plain_figure(
        name,
        f"uncertainty ({unit})",
        f"estimate ({unit})",
        x_axis_type="log",
        y_range=_height(selection, at),
        width=290,
    )
    for which, colour, label in ((known & ~chosen, BEFORE, "others"), (known & chosen, HIGHLIGHT, "chosen")):
        draw_points(
            plot, uncertainty[which], value[which], color=colour, size=3, alpha=0.6, legend_label=label
        )
    span = [float(uncertainty[known].min()), float(uncertainty[known].max())] if known.any() else [1e-6, 1.0]
    if np.isfinite(selection.threshold[at]):
        span[1] = min(span[1], _WIDE * float(selection.threshold[at]))
    plot.x_range = Range1d(0.7 * span[0], 1.4 * span[1])
    if np.isfinite(selection.sigma[at]):
        draw_line(plot, span, [selection.value[at]] * 2, color=AFTER, line_width=2, legend_label="selection")
    if np.isfinite(selection.threshold[at]):
        limit = float(selection.threshold[at])
        plot.add_layout(Span(location=limit, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    if joint is not None and np.isfinite(joint[1][at]):
        draw_line(plot, span, [joint[0][at]] * 2, color=REFERENCE, line_dash="dashed", legend_label="joint")
    legend_below(plot)
    return plot


def _height(selection: SubintervalEstimates, at: int) -> Range1d:
    """Return a range in which the chosen estimates can be seen: poor ones lie orders of magnitude away."""
    value = selection.estimate[:, at]
    near = value[selection.chosen[:, at]]
    if near.size < 2:
        near = value[np.isfinite(value)]
    if near.size < 2:
        return Range1d(-1.0, 1.0)
    middle, scatter = float(np.median(near)), float(near.std())
    reach = _TALL * max(scatter, 1e-12)
    return Range1d(middle - reach, middle + reach)


def uncertainty_figure(selection: SubintervalEstimates) -> Any:
    """Draw the uncertainties of the four pairs over time, as in panels c to f of the paper's figure 2."""
    hours = (to_utc(selection.start // 2 + selection.end // 2)).astype("datetime64[ms]")
    panels = []
    for name, title in (
        ("gain_ratio", "gain ratio; half of azimuth (1)"),
        ("spin_axis[x]", "spin axis (rad)"),
        ("offset[1]", "spin-plane offsets (nT)"),
        ("elevation[1]", "elevations (rad)"),
    ):
        at = SPIN_RELATED.index(name)
        uncertainty, chosen = selection.uncertainty[:, at], selection.chosen[:, at]
        plot = plain_figure(
            title,
            "time (UTC)",
            "uncertainty",
            width=820,
            height=190,
            x_axis_type="datetime",
            y_axis_type="log",
        )
        known = np.isfinite(uncertainty) & (uncertainty > 0.0)
        for which, colour in ((known & ~chosen, BEFORE), (known & chosen, HIGHLIGHT)):
            draw_points(plot, hours[which], uncertainty[which], color=colour, size=3)
        panels.append(plot)
    return gridplot([[panel] for panel in panels], toolbar_location="above", merge_tools=True)


#: Points of a curve over time: more intervals are drawn as medians of several.
_POINTS = 600

_STATES = (("pre-flight model", BEFORE), ("calibrated", AFTER))


def tone_name(tone: int) -> str:
    """Return the name of a tone: its row, and how often it comes a turn."""
    row, harmonic = TONES[tone]
    return f"{('along axis', 'modulus')[row]}, {harmonic} a turn"


def tones_over_time_figure(time: Int64, before: Tones, after: Tones, tone: int) -> figure:
    """Draw the rms of one tone in each interval before and after calibration, and nature's noise; nT."""
    plot = plain_figure(
        f"Tone {tone_name(tone)}", "", "rms (nT)", x_axis_type="datetime", y_axis_type="log", width=560
    )
    for one, (label, colour) in zip((before, after), _STATES, strict=True):
        x, y = _medians(time, np.abs(one.value[:, tone]) / np.sqrt(2.0))
        draw_points(plot, x, y, color=colour, size=3, alpha=0.7, legend_label=label)
    x, y = _medians(time, after.noise)
    draw_line(plot, x, y, color=REFERENCE, legend_label="nature's noise, all tones")
    legend_below(plot)
    return plot


def _medians(time: Int64, values: Floats) -> tuple[Any, Floats]:
    """Return UTC and medians of groups of intervals, so many as a browser can draw."""
    known = np.flatnonzero(np.isfinite(values) & (values > 0.0))
    each = max(1, -(-known.size // _POINTS))
    groups = [known[at : at + each] for at in range(0, known.size, each)]
    middle = np.array([time[group[len(group) // 2]] for group in groups], dtype=np.int64)
    return to_utc(middle), np.array([np.median(values[group]) for group in groups])


def mean_turn_figure(before: ToneDependence | None, after: ToneDependence | None) -> Any:
    """Draw the mean turn of both rows before and after calibration, a band of one sigma; nT."""
    phase = np.linspace(0.0, 360.0, 121)
    plots = []
    for row, name in enumerate(ROW_NAMES):
        plot = plain_figure(f"Mean turn, {name}", "spin phase (deg)", "nT", width=376)
        for one, (label, colour) in zip((before, after), _STATES, strict=True):
            if one is None:
                continue
            tones = [tone for tone, (which, _) in enumerate(TONES) if which == row]
            waves = [one.mean[0, at] * np.exp(-1j * TONES[at][1] * np.deg2rad(phase)) for at in tones]
            curve = np.sum(np.real(waves), axis=0)
            sigma = np.full(phase.size, np.sqrt(np.sum(one.sigma[0, tones] ** 2) / 2.0))
            error_band(plot, phase, curve, sigma, colour)
            draw_line(plot, phase, curve, color=colour, line_width=2, legend_label=label)
        legend_below(plot)
        plots.append(plot)
    return gridplot([plots], toolbar_location="above", merge_tools=True)


def tone_dependence_figure(found: ToneDependence, tone: int) -> figure:
    """Draw cosine and sine of one tone in bins of a coordinate, bars of one sigma between blocks; nT."""
    one = found.coordinate
    size, error = found.amplitude[tone], found.sigma_amplitude[tone]
    label = f"{one.name} ({one.unit})" if one.unit and one.unit != "1" else one.name
    plot = plain_figure(f"{tone_name(tone)}: {with_error(size, error)} nT", label, "nT")
    plot.title.text_font_size = "10px"
    met = np.isfinite(found.mean[:, tone])
    order = np.flatnonzero(met)[np.argsort(found.centre[met])]
    x, sigma = found.centre[order], found.sigma[order, tone] / np.sqrt(2.0)
    for part, colour, name in (
        (found.mean[order, tone].real, COMPONENTS[0], "cosine"),
        (found.mean[order, tone].imag, COMPONENTS[2], "sine"),
    ):
        error_bars(plot, x, part, sigma, colour, 0.5)
        draw_line(plot, x, part, color=colour, legend_label=name)
        draw_points(plot, x, part, color=colour, size=5)
    place_legend(plot)
    legend_below(plot)
    return plot
