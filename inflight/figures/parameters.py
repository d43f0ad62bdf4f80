"""Parameters, correlations.

Figures of calibration parameters in time.

Figure of how far the daily parameters wander.

How parameters answer for each other: correlations, and what an ignored effect does to the calibration.

Figures of continuous parameters: the trend through the table's values, rivals, and steps.

Figures of how daily parameters behave: spectra, running means, loops, steps, clock faults.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from bokeh.models import ColorBar, ColumnDataSource, LinearColorMapper, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.residual import DIVERGING
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    HIGHLIGHT,
    REFERENCE,
    bare_parameter,
    draw_line,
    draw_points,
    draw_segments,
    error_band,
    error_bars,
    legend_below,
    plain_figure,
    short_name,
    short_parameter,
    unique_labels,
)
from inflight.figures.text import html_table
from inflight.residual import ParameterScatter
from inflight.time import mjd2000, to_utc

if TYPE_CHECKING:
    from inflight.calibration import BoundarySteps
    from inflight.diagnosis import CalibrationBias, CrossTalk
    from inflight.mission_fit import (
        ClockFaults,
        CrossTalkTable,
        EventSteps,
        HysteresisLoop,
        ParameterSpectrum,
        RunningMean,
        TrendComparison,
    )

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
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    # Steps of the table that products use, within the days that are drawn.
    begin, stop = int(daily["start"].values[0]), int(daily["end"].values[-1])
    start, end = (to_utc(np.clip(used[name].values, begin, stop)) for name in ("start", "end"))
    plots = []
    for part, names in parts.items():
        if not (daily["value"] != daily["prior"]).sel(parameter=names).values.any():
            continue
        stated = str(daily["units"].sel(parameter=names[0]).values)
        factor, unit = _UNITS.get(stated, (1.0, stated))
        title = _TITLES.get(part, part.replace("_", " ").capitalize())
        plot = plain_figure(f"{title} less prior", "", unit, x_axis_type="datetime")
        for name, colour in zip(names, COMPONENTS, strict=False):
            own = daily.sel(parameter=name)
            prior = float(own["prior"])
            value, sigma = (own["value"].values - prior) * factor, own["sigma"].values * factor
            known = own["determined"].values
            label = name.partition("[")[2].rstrip("]") or part.replace("_", " ")
            # The prior's width is no measurement, and would flatten what was measured.
            error_bars(plot, middle[known], value[known], sigma[known], colour, 0.4)
            # One style for many circles: a browser draws them sooner than circles that each have their own.
            for which, fill in ((known, 1.0), (~known, 0.0)):
                if which.any():
                    own_days = middle[which], value[which]
                    draw_points(plot, *own_days, color=colour, fill_alpha=fill, size=5, legend_label=label)
            level = (used["value"].sel(parameter=name).values - prior) * factor
            draw_segments(plot, start, level, end, level, color=colour, line_width=2, alpha=0.8)
        legend_below(plot)
        plots.append(plot)
    return plots


#: A ratio this many sigmas above 1 is drawn in red.
_SIGNIFICANT = 3.0


def excess_scatter_figure(found: Sequence[ParameterScatter]) -> figure:
    """Draw each parameter's scatter from day to day over its own stated uncertainty; 1 is a complete model.

    Parameters that the days do not determine have no mark.
    """
    names = [one.name.split(".", 1)[-1] for one in found]
    plot = plain_figure(
        "Daily scatter / stated uncertainty", "", "ratio", x_range=names, y_axis_type="log", width=560
    )
    plot.xaxis.major_label_orientation = 0.6
    draw_line(plot, [names[0], names[-1]] if names else [], [1.0, 1.0] if names else [], color=REFERENCE)
    known = [index for index, one in enumerate(found) if np.isfinite(one.ratio) and one.ratio > 0]
    ratio = np.array([found[index].ratio for index in known])
    sigma = np.array([found[index].sigma_ratio * found[index].ratio for index in known])
    far = [found[index].ratio > 1 + _SIGNIFICANT * found[index].sigma_ratio for index in known]
    shown = [names[index] for index in known]
    error_bars(plot, shown, ratio, np.minimum(sigma, 0.9 * ratio), AFTER, 0.5)
    draw_points(plot, shown, ratio, size=8, color=[HIGHLIGHT if one else AFTER for one in far])
    return plot


#: Units of the calibration's parameters by part of the name.
_UNIT_OF_PARAMETER = {"scale_factor": "1", "misalignment": "deg", "offset": "nT"}


def cross_talk_figure(found: CrossTalk) -> figure:
    """Draw the signed correlations of the parameters' errors: calibration, model, found effects in order."""
    names = [short_parameter(name) for name in found.names]
    labels = unique_labels(names)
    size = len(labels)
    width = 250 + 17 * size
    plot = plain_figure(
        "Correlation of the parameters' errors",
        "",
        "",
        x_range=labels or ["none"],
        y_range=labels[::-1] or ["none"],
        width=min(max(width, 480), 1100),
        height=min(max(width - 60, 420), 1000),
    )
    mapper = LinearColorMapper(palette=DIVERGING, low=-1.0, high=1.0)
    row, column = np.divmod(np.arange(size * size), max(size, 1))
    source = ColumnDataSource(
        {
            "x": [labels[place] for place in column],
            "y": [labels[place] for place in row],
            "value": found.correlation.ravel().round(3),
        }
    )
    plot.rect(
        "x",
        "y",
        width=1,
        height=1,
        source=source,
        fill_color={"field": "value", "transform": mapper},
        line_color=None,
    )
    plot.add_layout(ColorBar(color_mapper=mapper, width=14, padding=4), "right")
    plot.xaxis.major_label_orientation = 1.2
    plot.axis.major_label_text_font_size = "9px"
    plot.grid.visible = False
    plot.hover.tooltips = [("", "@x"), ("with", "@y"), ("correlation", "@value{0.000}")]
    return plot


def strongest_pairs(found: CrossTalk, most: int = 5) -> list[str]:
    """Return the strongest correlations of a found parameter with any other, in words."""
    names = [short_parameter(name) for name in found.names]
    pairs = [
        (abs(float(found.correlation[i, j])), i, j)
        for i in range(len(names))
        for j in range(i)
        if found.groups[i] == "found"
        and found.names[i].rpartition(".")[0] != found.names[j].rpartition(".")[0]
    ]
    ordered = sorted(pairs, reverse=True)[:most]
    return [f"{names[i]} with {names[j]}: {found.correlation[i, j]:+.2f}" for _, i, j in ordered]


def shift_table(shifts: Sequence[CalibrationBias]) -> str:
    """Return as HTML what each found coefficient, if ignored, would do to the calibration."""
    if not shifts:
        return ""
    parameters = list(shifts[0].shifts)
    shown = [_unit(name) for name in parameters]
    head = (
        "ignored",
        *(f"{short_parameter(name)} ({unit})" for name, (_, unit) in zip(parameters, shown, strict=True)),
    )
    rows = [
        (
            f"{short_name(one.effect)} {bare_parameter(one.coefficient)} = {one.value:.3g} {one.unit}",
            *(
                f"{one.shifts[name] * factor:+.2g}"
                for name, (factor, _) in zip(parameters, shown, strict=True)
            ),
        )
        for one in shifts
    ]
    return html_table(head, rows, kind="wide scrolled", one_line=True)


def ignored_effects_figure(found: CrossTalkTable) -> figure:
    """Draw what each ignored cause does to the fitted parameters.

    Colours compare shifts of one unit with each other: they run to the largest shift of that unit.
    """
    rows = unique_labels([one.label for one in found.ignored])
    parameters = [
        f"{short_parameter(name)} ({unit})" for name, unit in zip(found.parameters, found.units, strict=True)
    ]
    columns = unique_labels(parameters)
    plot = plain_figure(
        "Shift of the calibration by what it ignores",
        "",
        "",
        x_range=columns,
        y_range=rows[::-1],
        width=min(260 + 70 * len(columns), 1100),
        height=150 + 34 * len(rows),
    )
    limit = {unit: np.abs(found.shift[:, [one == unit for one in found.units]]).max() for unit in found.units}
    row, column = np.divmod(np.arange(found.shift.size), len(columns))
    value = found.shift.ravel()
    source = ColumnDataSource(
        {
            "x": [columns[place] for place in column],
            "y": [rows[place] for place in row],
            "part": [
                one / max(limit[found.units[place]], 1e-12) for one, place in zip(value, column, strict=True)
            ],
            "text": [_two_digits(one) for one in value],
        }
    )
    mapper = LinearColorMapper(palette=DIVERGING, low=-1.4, high=1.4)
    colour = {"field": "part", "transform": mapper}
    plot.rect("x", "y", width=1, height=1, source=source, fill_color=colour, line_color="#ffffff")
    plot.text(
        "x",
        "y",
        text="text",
        source=source,
        text_align="center",
        text_baseline="middle",
        text_font_size="11px",
    )
    plot.xaxis.major_label_orientation = 0.7
    plot.grid.visible = False
    plot.hover.tooltips = [("ignored", "@y"), ("shifts", "@x"), ("by", "@text")]
    return plot


def _two_digits(value: float) -> str:
    """Two digits that count, without powers of ten; what rounds to nothing is 0."""
    return "0" if abs(value) < 0.005 else f"{value:+.2f}" if abs(value) < 1.0 else f"{value:+.1f}"


def _unit(name: str) -> tuple[float, str]:
    from inflight.mission_fit import DISPLAY_UNITS

    for part, unit in _UNIT_OF_PARAMETER.items():
        if part in name:
            return DISPLAY_UNITS[unit]
    return 1.0, ""


#: Points of a curve, and error bars drawn at most.
_POINTS, _BARS = 400, 60


def comparison_figure(found: TrendComparison) -> figure:
    """Draw the held-out rms of each kind of trend; the bars are those of the difference to the best."""
    kinds = [one.kind for one in found.rivals]
    plot = plain_figure(
        f"Held-out residual: {found.chosen} chosen", "", found.unit, x_range=kinds, y_axis_type="log"
    )
    rms = np.array([one.rms for one in found.rivals])
    sigma = np.array([one.sigma_behind for one in found.rivals]) / (2.0 * rms)
    error_bars(plot, kinds, rms, np.minimum(sigma, 0.9 * rms), REFERENCE)
    draw_points(plot, kinds, rms, size=9, color=[AFTER if one.tied else BEFORE for one in found.rivals])
    return plot


def boundary_steps_figure(table: BoundarySteps, trend: BoundarySteps) -> figure:
    """Draw the steps of |B| at the boundaries of a table, and those of continuous parameters."""
    title = f"Steps at boundaries in {table.strength:.0f} nT, rms over directions"
    plot = plain_figure(title, "MJD (2000-01-01)", "nT", width=560)
    draw_points(plot, mjd2000(table.at), table.rms, color=BEFORE, size=4, legend_label="intervals")
    draw_line(plot, mjd2000(table.at), np.abs(table.mean), color=BEFORE, alpha=0.6, legend_label="|mean|")
    draw_line(plot, mjd2000(trend.at), trend.rms, color=AFTER, line_width=2, legend_label="continuous")
    legend_below(plot)
    return plot


#: Error bars at most: more of them are one surface.
_MOST_BARS = 300


def parameter_spectrum_figure(found: ParameterSpectrum, title: str) -> figure:
    """Draw amplitude against period with the noise's background and its false-alarm level of 1 %."""
    plot = plain_figure(title, "period (d)", found.unit, x_axis_type="log", width=560)
    period = 1.0 / found.frequency
    draw_line(plot, period, found.amplitude, color=AFTER, legend_label="amplitude")
    draw_line(plot, period, found.background, color=REFERENCE, legend_label="red noise")
    draw_line(plot, period, found.level, color=BEFORE, line_dash="dashed", legend_label="false alarm 1 %")
    for one in found.named:
        dash = "solid" if one.resolved else "dotted"
        mark = Span(
            location=one.period, dimension="height", line_color=REFERENCE, line_dash=dash, line_alpha=0.5
        )
        plot.add_layout(mark)
    named = [one for one in found.peaks if one.label]
    unnamed = [one for one in found.peaks if not one.label]
    for peaks, colour, label in ((named, AFTER, "named"), (unnamed, HIGHLIGHT, "unnamed")):
        x, y = [one.period for one in peaks], [one.amplitude for one in peaks]
        if peaks:
            draw_points(plot, x, y, color=colour, size=8, legend_label=label)
    legend_below(plot)
    return plot


def running_means_figure(mjd: Floats, value: Floats, means: Sequence[RunningMean], title: str) -> figure:
    """Draw daily values and their running means with bands; gaps stay gaps."""
    unit = means[0].unit if means else ""
    plot = plain_figure(title, "MJD (2000-01-01)", unit, width=560)
    draw_points(plot, mjd, value, color=REFERENCE, size=2, alpha=0.5)
    for one, colour in zip(means, COMPONENTS, strict=False):
        error_band(plot, one.mjd, one.value, one.sigma, colour)
        draw_line(plot, one.mjd, one.value, color=colour, line_width=2, legend_label=f"{one.window:g} d")
    legend_below(plot)
    return plot


def hysteresis_figure(found: HysteresisLoop, title: str) -> figure:
    """Draw a parameter against temperature on the rising and the falling branch."""
    title = f"{title}: area {found.area:.3g} +- {found.sigma:.2g} {found.unit} K"
    plot = plain_figure(title, "temperature (degC)", found.unit, width=470)
    branches = (
        (found.rising, found.sigma_rising, BEFORE, "rising"),
        (found.falling, found.sigma_falling, AFTER, "falling"),
    )
    for mean, sigma, colour, label in branches:
        error_bars(plot, found.centre, mean, sigma, colour)
        draw_line(plot, found.centre, mean, color=colour, legend_label=label)
        draw_points(plot, found.centre, mean, color=colour, size=5)
    legend_below(plot)
    return plot


def event_steps_figure(found: EventSteps, title: str) -> figure:
    """Draw the step at each event with its error; those beyond chance are red."""
    plot = plain_figure(title, "MJD (2000-01-01)", found.unit, width=560)
    error_bars(plot, found.at, found.size, found.sigma, REFERENCE, 0.3)
    for which, colour, label in (
        (~found.found, AFTER, "event"),
        (found.found, HIGHLIGHT, "step beyond chance"),
    ):
        draw_points(plot, found.at[which], found.size[which], color=colour, size=5, legend_label=label)
    legend_below(plot)
    return plot


def clock_figure(found: ClockFaults, shift: Floats, sigma: Floats | None = None) -> figure:
    """Draw daily time shifts (s), what is usual around them, and the faults in red; milliseconds.

    Error bars are the days' own sigmas (s); when they are not known, what days scatter by.
    """
    plot = plain_figure("Time shift of each day", "MJD (2000-01-01)", "ms", width=560)
    size = found.scatter if sigma is None else sigma
    some = slice(None, None, max(1, found.mjd.size // _MOST_BARS))
    error_bars(plot, found.mjd[some], 1e3 * shift[some], 1e3 * size[some], AFTER, 0.35)
    draw_points(plot, found.mjd, 1e3 * shift, color=AFTER, size=3, legend_label="days")
    draw_line(plot, found.mjd, 1e3 * found.usual, color=REFERENCE, line_width=2, legend_label="usual")
    for one in found.faults:
        days = (found.mjd >= one.first) & (found.mjd < one.last + 1)
        draw_points(plot, found.mjd[days], 1e3 * shift[days], color=HIGHLIGHT, size=8, legend_label="fault")
    legend_below(plot)
    return plot
