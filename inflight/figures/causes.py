"""Figures of causes: temperature, day and night, magneto-torquers, current steps, offsets from the spread.

Takes the fits of `inflight.mission_fit` and calibration tables; makes Bokeh figures of what each cause does:
scale factors against temperature, the day/night field along the orbit, the torquers' coefficients and their
band, superposed epochs of a current, daily offsets, and coefficients against what was known of them before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from bokeh.models import ColumnDataSource, Range1d, Span, Whisker
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.effects import AXES, panel_weights_at
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    HIGHLIGHT,
    REFERENCE,
    draw_area,
    draw_line,
    draw_points,
    error_band,
    error_bars,
    legend_below,
    plain_figure,
)
from inflight.mission_fit import (
    MEAN_STATES,
    SERIES,
    TORQUER_BAND_HZ,
    CoilFit,
    DayNightField,
    EpochStack,
    FilledRunningMean,
    LocalTimeDependence,
    OffsetsFromSpread,
    PanelModel,
    TemperatureChoice,
)
from inflight.time import mjd2000, to_utc


def scale_curves_figure(fit: CoilFit, temperatures: Floats) -> figure:
    """Draw the change of the scale factors against temperature with its band, ppm.

    Parameters
    ----------
    fit : CoilFit
    temperatures : ndarray, shape (place,)
        degC, rising: the range that was seen.
    """
    title = f"Scale factors with {fit.channel}: {fit.summary().split('; ')[-1]}"
    plot = plain_figure(title, "temperature (degC)", "ppm", width=560)
    change = temperatures - fit.reference
    for axis, (name, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        rows = np.zeros((change.size, fit.fit.value.size))
        rows[:, axis], rows[:, axis + 3] = -change, -(change**2)
        value = 1e6 * rows @ fit.fit.value
        sigma = 1e6 * np.sqrt(np.einsum("ti,ij,tj->t", rows, fit.fit.covariance, rows))
        error_band(plot, temperatures, value, sigma, colour)
        draw_line(plot, temperatures, value, color=colour, line_width=2, legend_label=name)
    legend_below(plot)
    return plot


def rivals_figure(choice: TemperatureChoice) -> figure:
    """Draw how far each temperature's held-out square lies behind the best, with its error; ties are grey."""
    plot = plain_figure("Temperatures on held-out blocks", "", "nT^2 behind the best", width=470)
    place = np.arange(len(choice.rivals), dtype=np.float64)
    behind = np.array([one.behind for one in choice.rivals])
    error_bars(plot, place, behind, np.array([one.behind_sigma for one in choice.rivals]), REFERENCE)
    tied = np.array([one.ties for one in choice.rivals])
    for which, colour, label in (
        (place == 0, AFTER, "best"),
        (tied & (place > 0), REFERENCE, "tied"),
        (~tied, HIGHLIGHT, "worse"),
    ):
        if which.any():
            draw_points(plot, place[which], behind[which], color=colour, size=8, legend_label=label)
    plot.xaxis.ticker = place.tolist()
    plot.xaxis.major_label_overrides = {at: one.channel for at, one in enumerate(choice.rivals)}
    legend_below(plot)
    return plot


_WIDTH, _HEIGHT = 560, 300


def day_night_figure(found: DayNightField) -> figure:
    """Draw the fitted series along the orbit, its mean left out, with a band of one sigma.

    Parameters
    ----------
    found : DayNightField
        A fit of `series_columns`; components that were not fitted are not drawn.
    """
    plot = plain_figure(
        "Day/night field along the orbit, mean left out",
        "angle from the point nearest the Sun (deg)",
        "nT, vector less scalar sensor",
        width=_WIDTH,
        height=_HEIGHT,
    )
    phase = np.linspace(-180.0, 180.0, 361)
    value, sigma = found.series(phase)
    draw_line(plot, [-180.0, 180.0], [0.0, 0.0], color=REFERENCE)
    for index, axis in enumerate(AXES):
        if any(name.startswith(f"{SERIES}[c{axis}") for name in found.columns):
            error_band(plot, phase, value[:, index], sigma[:, index], COMPONENTS[index])
            draw_line(plot, phase, value[:, index], color=COMPONENTS[index], line_width=2, legend_label=axis)
    legend_below(plot)
    return plot


def with_and_without_figure(ignored: xr.Dataset, added: xr.Dataset, parameter: str, title: str) -> figure:
    """Draw a parameter of every block with the day/night field ignored, and with it in the model.

    Parameters
    ----------
    ignored, added : xarray.Dataset
        Of `inflight.mission_fit.day_night.block_parameters`.
    parameter : str
        Which one.
    title : str
    """
    unit = str(ignored["units"].sel(parameter=parameter).item())
    plot = plain_figure(title, "", unit, x_axis_type="datetime", width=_WIDTH, height=_HEIGHT)
    for table, colour, label in ((ignored, BEFORE, "ignored"), (added, AFTER, "in the model")):
        middle = to_utc(table["start"].values // 2 + table["end"].values // 2)
        value = table["value"].sel(parameter=parameter).values
        error_bars(plot, middle, value, table["sigma"].sel(parameter=parameter).values, colour, 0.4)
        draw_points(plot, middle, value, color=colour, size=5, legend_label=label)
    legend_below(plot)
    return plot


def coefficient_figures(daily: xr.Dataset, mean: xr.Dataset) -> list[figure]:
    """Draw the daily coefficients of each field axis, one colour a coil, and their robust means as lines.

    Parameters
    ----------
    daily : xarray.Dataset
        Of `torquer_band.daily_fits`.
    mean : xarray.Dataset
        Of `torquer_band.robust_mean`.
    """
    plots = []
    middle = to_utc(daily["start"].values // 2 + daily["end"].values // 2)
    for axis in daily["axis"].values:
        plot = plain_figure(
            f"Torquers' field along {axis}", "", "nT/A, vector less scalar", x_axis_type="datetime"
        )
        for coil, colour in zip(daily["coil"].values, COMPONENTS, strict=True):
            own = daily.sel(axis=axis, coil=coil)
            value = float(mean["value"].sel(axis=axis, coil=coil))
            error_bars(plot, middle, own["value"].values, own["sigma"].values, colour, 0.35)
            draw_points(plot, middle, own["value"].values, color=colour, size=5, legend_label=f"coil {coil}")
            plot.add_layout(Span(location=value, dimension="width", line_color=colour, line_width=1))
        legend_below(plot)
        plots.append(plot)
    return plots


def torquer_mean_figures(mean: FilledRunningMean, field: xr.Dataset) -> list[figure]:
    """Draw daily and running means of the torquer currents, and the remanent field that follows from them.

    Parameters
    ----------
    mean : FilledRunningMean
    field : xarray.Dataset
        Of `secular.remanent_field`. Where the window was not covered the line is dashed.
    """
    middle = to_utc(field["start"].values // 2 + field["end"].values // 2)
    upper = plain_figure(
        f"Torquer currents: daily and {mean.window:g} d means", "", "mA", x_axis_type="datetime", width=_WIDE
    )
    lower = plain_figure("Remanent field at the scalar sensor", "", "nT", x_axis_type="datetime", width=_WIDE)
    own = mean.state < MEAN_STATES.index("interpolated")
    for index, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        draw_points(upper, middle, 1e3 * mean.daily[:, index], color=colour, size=2, alpha=0.35)
        for plot, value, sigma in (
            (upper, 1e3 * mean.value[:, index], 1e3 * mean.sigma[:, index]),
            (lower, field["value"].values[:, index], field["sigma"].values[:, index]),
        ):
            error_band(plot, middle, value, sigma, colour)
            draw_line(
                plot, middle, np.where(own, value, np.nan), color=colour, line_width=2, legend_label=axis
            )
            draw_line(
                plot, middle, np.where(own, np.nan, value), color=colour, line_width=2, line_dash="dashed"
            )
    for plot in (upper, lower):
        legend_below(plot)
    return [upper, lower]


def torquer_lines_figure(lines: xr.Dataset) -> figure:
    """Draw each instrument's own spectrum about the torquers' 20 s, and the course beside the band.

    Parameters
    ----------
    lines : xarray.Dataset
        Of `inflight.mission_fit.torquer_lines`.
    """
    plot = plain_figure(
        str(lines.attrs["told"]), "Hz", "nT/sqrt(Hz), of first differences", y_axis_type="log", width=_WIDTH
    )
    for sensor, colour in zip(lines["sensor"].values, (AFTER, BEFORE), strict=True):
        own = lines.sel(sensor=sensor)
        frequency = own["frequency"].values
        draw_line(plot, frequency, np.sqrt(own["beside"].values), color=colour, line_dash="dashed")
        draw_line(
            plot,
            frequency,
            np.sqrt(own["power"].values),
            color=colour,
            line_width=2,
            legend_label=str(sensor),
        )
    for edge in TORQUER_BAND_HZ:
        plot.add_layout(Span(location=edge, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    legend_below(plot)
    return plot


def spread_law_figure(law: xr.Dataset) -> figure:
    """Draw the days' variance of the residual against their offset's square (Yin 2010, Fig. 3.18).

    Parameters
    ----------
    law : xarray.Dataset
        Of `inflight.mission_fit.SpreadLaw.table`, with `offset`, `offset_sigma` and `variance` by day.
    """
    square = law["offset"].values ** 2 - law["offset_sigma"].values ** 2
    factor, noise = law["value"].values
    plot = plain_figure(
        "Variance of the residual", "square of the day's z offset (nT^2)", "nT^2", width=_WIDTH
    )
    draw_points(plot, square, law["variance"].values, color=BEFORE, size=5, legend_label="days")
    ends = np.array([min(square.min(), 0.0), square.max()])
    draw_line(plot, ends, factor * ends + noise, color=AFTER, line_width=2, legend_label="fit")
    geometry = float(law.attrs["geometry"])
    draw_line(
        plot, ends, geometry * ends + noise, color=REFERENCE, line_dash="dashed", legend_label="by the orbit"
    )
    legend_below(plot)
    return plot


def stack_figures(found: EpochStack, unit_of: str = "solar current") -> list[figure]:
    """Draw the stacked residual with the band that resampling days gives, and the current below it."""
    reach = Range1d(float(found.lag[0]) - 3.0, float(found.lag[-1]) + 3.0)
    title = f"Residual around {found.epochs} steps on {found.days} days"
    upper = plain_figure(title, "s after the step", "dB less drift (nT)", x_range=reach, width=_WIDE)
    draw_area(upper, found.lag, found.low, found.high, color=AFTER, alpha=0.22, legend_label="68 % over days")
    draw_line(upper, found.lag, found.residual, color=AFTER, line_width=2, legend_label="mean residual")
    lower = plain_figure(
        f"Mean {unit_of}", "s after the step", "change (A)", x_range=reach, width=_WIDE, height=190
    )
    draw_line(lower, found.lag, found.current, color=BEFORE, line_width=2)
    for plot in (upper, lower):
        plot.add_layout(Span(location=0.0, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    legend_below(upper)
    return [upper, lower]


def local_time_figure(course: LocalTimeDependence, model: PanelModel | None = None) -> figure:
    """Draw the coefficient against the orbit's local time, which falls: noon and midnight are marked.

    Parameters
    ----------
    course : LocalTimeDependence
    model : PanelModel, optional
        Drawn as lines when it depends on local time alone: *constant* or *two_panels*.
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
        draw_points(plot, x, value, color=colour, size=6, legend_label=axis)
        if model is not None and model.name in ("constant", "two_panels"):
            hours = np.linspace(0.0, 24.0, 241)
            weight = panel_weights_at(hours) if model.name == "two_panels" else np.ones((hours.size, 1))
            draw_line(plot, hours, weight @ model.value[:, index], color=colour, alpha=0.7)
    for hour in (12.0, 0.0):
        plot.add_layout(Span(location=hour, dimension="height", line_color=REFERENCE, line_dash="dotted"))
    legend_below(plot)
    return plot


def offsets_figure(found: OffsetsFromSpread) -> figure:
    """Draw the daily offsets from the spread with their errors, and those from the slope."""
    plot = plain_figure(
        f"Offset along {found.axis} from the spread of dB", "MJD (2000-01-01)", "nT", width=560
    )
    middle = mjd2000(found.start // 2 + found.end // 2)
    error_bars(plot, middle, found.value, found.sigma, AFTER, 0.4)
    fill = np.where(found.seen, 1.0, 0.0)
    draw_points(plot, middle, found.value, color=AFTER, fill_alpha=fill, size=5, legend_label="spread")
    draw_line(plot, middle, found.slope, color=BEFORE, alpha=0.7, legend_label="slope of dB on the direction")
    draw_line(plot, [middle[0], middle[-1]], [0.0, 0.0], color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot


_WIDE = 560

#: Error bars drawn at most, and pixels of a row of coefficients.
_BARS, _ROW = 60, 15

#: A band is left out when it is so many times wider than the values.
_HIDES = 3.0


def prior_figure(names: Sequence[str], shift: Floats, sigma: Floats, determined: Sequence[bool]) -> figure:
    """Draw how far each coefficient went from what was known of it, in sigmas of that.

    Parameters
    ----------
    names : sequence of str
        Each once, the first on top.
    shift, sigma : ndarray, shape (coefficient,)
        Value less prior and standard deviation, both over the prior's sigma.
    determined : sequence of bool
        Hollow marks are not.
    """
    rows = list(names)
    plot = plain_figure(
        "Coefficients less what was known before",
        "sigmas of what was known; the grey band is one sigma",
        "",
        y_range=rows[::-1],
        width=_WIDE + 180,
        height=90 + _ROW * len(rows),
    )
    reach = 1.1 * max(float(np.max(np.abs(shift) + sigma)), 1.5)
    plot.x_range = Range1d(-reach, reach)
    plot.hbar(
        y=rows, left=-1.0, right=1.0, height=1.0, fill_color=REFERENCE, fill_alpha=0.12, line_color=None
    )
    source = ColumnDataSource({"y": rows, "low": shift - sigma, "high": shift + sigma})
    bars = Whisker(base="y", lower="low", upper="high", dimension="width", source=source, line_color=AFTER)
    for head in (bars.lower_head, bars.upper_head):
        head.size, head.line_color = 5, AFTER
    plot.add_layout(bars)
    draw_points(plot, shift, rows, size=6, color=AFTER, fill_alpha=np.where(determined, 1.0, 0.0))
    plot.add_layout(Span(location=0.0, dimension="height", line_color=REFERENCE))
    plot.yaxis.major_label_text_font_size = "10px"
    return plot


def continuous_figure(daily: xr.Dataset, table: xr.Dataset, title: str, factor: float, unit: str) -> figure:
    """Draw parameters of days with error bars, and the continuous ones with their band of one sigma.

    Parameters
    ----------
    daily : xarray.Dataset
        dims interval, parameter (at most three): `value`, `sigma`, `start`, `end`.
    table : xarray.Dataset
        The continuous table, with the same parameters; its first values are taken off both.
    title : str
    factor, unit : float, str
        Unit shown, which is `factor` times the parameters' own.
    """
    plot = plain_figure(title, "MJD (2000-01-01)", unit, width=_WIDE)
    when, curve = _middles(daily), _middles(table)
    thin = slice(None, None, max(1, when.size // _BARS))
    for name, colour in zip(daily["parameter"].values, COMPONENTS, strict=False):
        own, common = daily.sel(parameter=name), table.sel(parameter=name)
        base = float(common["value"].values[0])
        shown, bars = factor * (own["value"].values - base), factor * own["sigma"].values
        error_bars(plot, when[thin], shown[thin], bars[thin], colour, 0.35)
        label = str(name).rsplit("[", maxsplit=1)[-1].rstrip("]")
        draw_points(plot, when, shown, color=colour, size=3, alpha=0.5)
        values = factor * (common["value"].values - base)
        sigma = factor * common["sigma"].values
        reach = float(np.nanmax(np.abs(shown)) + np.nanmedian(bars))
        # A band many times wider than all that is to be seen hides it; the label has its size.
        if np.nanmedian(sigma) < _HIDES * reach:
            error_band(plot, curve, values, sigma, colour)
        draw_line(
            plot,
            curve,
            values,
            color=colour,
            line_width=2,
            legend_label=f"{label} ± {np.nanmedian(sigma):.2g}",
        )
    legend_below(plot)
    return plot


def band_level_figure(start: np.ndarray, before: Floats, after: Floats) -> figure:
    """Draw what the residual has in the torquers' band each day, before and after the fitted matrix; nT."""
    plot = plain_figure("Residual in the torquers' band", "MJD (2000-01-01)", "nT", width=_WIDE)
    when = mjd2000(start)
    for values, colour, label in ((before, BEFORE, "before"), (after, AFTER, "after")):
        draw_points(plot, when, values, color=colour, size=5, legend_label=label)
        draw_line(plot, when, values, color=colour, alpha=0.4)
    plot.y_range.start = 0.0
    legend_below(plot)
    return plot


def temperature_figure(temperature: Floats, value: Floats, sigma: Floats, title: str, unit: str) -> figure:
    """Draw a daily parameter against the day's temperature."""
    plot = plain_figure(title, "temperature (degC)", unit, width=470)
    thin = slice(None, None, max(1, temperature.size // (4 * _BARS)))
    error_bars(plot, temperature[thin], value[thin], sigma[thin], AFTER, 0.3)
    draw_points(plot, temperature, value, color=AFTER, size=4)
    return plot


def _middles(table: xr.Dataset) -> Floats:
    return mjd2000(table["start"].values // 2 + table["end"].values // 2)
