"""Figures of how daily parameters behave: spectra, running means, loops, steps, clock faults."""

from __future__ import annotations

from collections.abc import Sequence

from bokeh.models import Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.estimators.behaviour import RunningMean
from inflight.estimators.clock_faults import ClockFaults
from inflight.estimators.event_steps import EventSteps
from inflight.estimators.hysteresis import HysteresisLoop
from inflight.estimators.periods import ParameterSpectrum
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    NEW,
    REFERENCE,
    band,
    error_bars,
    legend_below,
    plain_figure,
)

#: Error bars at most: more of them are one surface.
_BARS = 300


def parameter_spectrum_figure(found: ParameterSpectrum, title: str) -> figure:
    """Draw amplitude against period with the noise's background and its false-alarm level of 1 %."""
    plot = plain_figure(title, "period (d)", found.unit, x_axis_type="log", width=560)
    period = 1.0 / found.frequency
    plot.line(period, found.amplitude, color=AFTER, legend_label="amplitude")
    plot.line(period, found.background, color=REFERENCE, legend_label="red noise")
    plot.line(period, found.level, color=BEFORE, line_dash="dashed", legend_label="false alarm 1 %")
    for one in found.named:
        dash = "solid" if one.resolved else "dotted"
        mark = Span(
            location=one.period, dimension="height", line_color=REFERENCE, line_dash=dash, line_alpha=0.5
        )
        plot.add_layout(mark)
    told = [one for one in found.peaks if one.label]
    new = [one for one in found.peaks if not one.label]
    for peaks, colour, label in ((told, AFTER, "named"), (new, NEW, "unnamed")):
        x, y = [one.period for one in peaks], [one.amplitude for one in peaks]
        if peaks:
            plot.scatter(x, y, color=colour, size=8, legend_label=label)
    legend_below(plot)
    return plot


def running_means_figure(mjd: Floats, value: Floats, means: Sequence[RunningMean], title: str) -> figure:
    """Draw daily values and their running means with bands; gaps stay gaps."""
    unit = means[0].unit if means else ""
    plot = plain_figure(title, "MJD (2000-01-01)", unit, width=560)
    plot.scatter(mjd, value, color=REFERENCE, size=2, alpha=0.5)
    for one, colour in zip(means, COMPONENTS, strict=False):
        band(plot, one.mjd, one.value, one.sigma, colour)
        plot.line(one.mjd, one.value, color=colour, line_width=2, legend_label=f"{one.window:g} d")
    legend_below(plot)
    return plot


def loop_figure(found: HysteresisLoop, title: str) -> figure:
    """Draw a parameter against temperature on the rising and the falling branch."""
    told = f"{title}: area {found.area:.3g} +- {found.sigma:.2g} {found.unit} K"
    plot = plain_figure(told, "temperature (degC)", found.unit, width=470)
    branches = (
        (found.rising, found.sigma_rising, BEFORE, "rising"),
        (found.falling, found.sigma_falling, AFTER, "falling"),
    )
    for mean, sigma, colour, label in branches:
        error_bars(plot, found.centre, mean, sigma, colour)
        plot.line(found.centre, mean, color=colour, legend_label=label)
        plot.scatter(found.centre, mean, color=colour, size=5)
    legend_below(plot)
    return plot


def steps_figure(found: EventSteps, title: str) -> figure:
    """Draw the step at each event with its error; those beyond chance are red."""
    plot = plain_figure(title, "MJD (2000-01-01)", found.unit, width=560)
    error_bars(plot, found.at, found.size, found.sigma, REFERENCE, 0.3)
    for which, colour, label in ((~found.found, AFTER, "event"), (found.found, NEW, "step beyond chance")):
        plot.scatter(found.at[which], found.size[which], color=colour, size=5, legend_label=label)
    legend_below(plot)
    return plot


def clock_figure(found: ClockFaults, shift: Floats, sigma: Floats | None = None) -> figure:
    """Draw daily time shifts (s), what is usual around them, and the faults in red; milliseconds.

    Error bars are the days' own sigmas (s); when they are not known, what days scatter by.
    """
    plot = plain_figure("Time shift of each day", "MJD (2000-01-01)", "ms", width=560)
    size = found.scatter if sigma is None else sigma
    some = slice(None, None, max(1, found.mjd.size // _BARS))
    error_bars(plot, found.mjd[some], 1e3 * shift[some], 1e3 * size[some], AFTER, 0.35)
    plot.scatter(found.mjd, 1e3 * shift, color=AFTER, size=3, legend_label="days")
    plot.line(found.mjd, 1e3 * found.usual, color=REFERENCE, line_width=2, legend_label="usual")
    for one in found.faults:
        days = (found.mjd >= one.first) & (found.mjd < one.last + 1)
        plot.scatter(found.mjd[days], 1e3 * shift[days], color=NEW, size=8, legend_label="fault")
    legend_below(plot)
    return plot
