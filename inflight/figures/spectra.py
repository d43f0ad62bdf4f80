"""Spectra.

Figures of spectra: the residual and the residual along each axis, with known and unknown lines.

Periodograms of the residual along each axis, before and after the found effects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import Label, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.diagnosis import Periodogram
from inflight.figures.style import AFTER, BEFORE, NEW, REFERENCE, log_ticks, place_legend, plain_figure
from inflight.residual import SERIES, Line, thinned, told_period

#: What each series is called above its figure.
_TITLES = {
    "residual": "Spectrum of the residual dB",
    "x": "Spectrum of dB u_x",
    "y": "Spectrum of dB u_y",
    "z": "Spectrum of dB u_z",
}

#: Unknown lines that get a mark, largest first.
_MARKS = 5


def spectrum_figure(
    frequency: Floats,
    before: Floats | None,
    after: Floats,
    known: Mapping[str, float],
    lines: Sequence[Line] = (),
    series: str = "residual",
    labels: tuple[str, str] = ("pre-flight model", "calibrated"),
) -> figure:
    """Draw amplitude densities against period, known periods dotted and named, unknown lines marked in red.

    Parameters
    ----------
    frequency : ndarray, shape (frequency,)
        Hz.
    before, after : ndarray, shape (frequency,)
        Power densities, nT^2/Hz; without the one before when there is none.
    known : mapping of str to float
        Periods to mark, s.
    lines : sequence of Line
        As `inflight.residual.lines.find_lines` returns them.
    series : str
        One of `inflight.residual.lines.SERIES`.
    labels : tuple of str
        What the two states are called.
    """
    plot = plain_figure(
        _TITLES[series], "period (s)", "nT / sqrt(Hz)", x_axis_type="log", y_axis_type="log", width=560
    )
    for power, colour, label in ((before, BEFORE, labels[0]), (after, AFTER, labels[1])):
        if power is not None:
            shown, thin = thinned(frequency, power)
            plot.line(1.0 / shown, np.sqrt(thin), color=colour, legend_label=label)
    period = 1.0 / frequency
    if (ticks := log_ticks(period)) is not None:
        plot.xaxis.ticker = ticks
    inside = {name: s for name, s in known.items() if period.min() <= s <= period.max()}
    _mark_known(plot, inside)
    _mark_new(plot, frequency, after, [line for line in lines if line.is_new], series)
    place_legend(plot, "center_left")
    return plot


def _mark_known(plot: figure, known: Mapping[str, float]) -> None:
    """Draw dotted lines with their names, one height below the other so that neighbours stay readable."""
    for place, (name, seconds) in enumerate(sorted(known.items(), key=lambda item: -item[1])):
        plot.add_layout(
            Span(location=seconds, dimension="height", line_color=REFERENCE, line_dash="dotted", line_width=1)
        )
        plot.add_layout(
            Label(
                x=seconds,
                y=186 - 12 * (place % 5),
                y_units="screen",
                x_offset=2,
                text=name,
                text_font_size="9px",
                text_color=REFERENCE,
            )
        )


def _mark_new(plot: figure, frequency: Floats, power: Floats, lines: Sequence[Line], series: str) -> None:
    """Mark the unknown lines that this series shows with a red point and their period."""
    index = SERIES.index(series)
    seen = [line for line in lines if np.isfinite(line.amplitude[index])][:_MARKS]
    inside = [line for line in seen if frequency[0] <= 1.0 / line.period_s <= frequency[-1]]
    if not inside:
        return
    at = [int(np.argmin(np.abs(frequency - 1.0 / line.period_s))) for line in inside]
    height = [float(np.sqrt(power[max(i - 1, 0) : i + 2].max())) for i in at]
    periods = [line.period_s for line in inside]
    plot.scatter(periods, height, color=NEW, size=7, legend_label="unknown period")
    for seconds, top in zip(periods, height, strict=True):
        plot.add_layout(
            Label(
                x=seconds,
                y=top,
                x_offset=5,
                y_offset=3,
                text=told_period(seconds),
                text_font_size="10px",
                text_color=NEW,
            )
        )


#: Unlabelled peaks marked a figure, and how near to another one, in frequencies, one is the same.
_PEAKS, _APART = 4, 6


def periodogram_figures(
    before: Periodogram | None, after: Periodogram, known: Mapping[str, float]
) -> list[figure]:
    """Draw dB u_x, dB u_y, dB u_z: amplitude density against period, both logarithmic.

    Known periods are named; peaks of what is left that no known period explains are red with their period.

    Parameters
    ----------
    before : Periodogram, optional
        Absent when nothing was found.
    known : mapping of str to float
        Periods to name, s.
    """
    frequency = after.frequency[1:]
    plots = [
        spectrum_figure(
            frequency,
            before.power[axis, 1:] if before is not None else None,
            after.power[axis, 1:],
            known,
            [_line(after, axis, at) for at in unexplained_peaks(after, axis)],
            series,
            labels=("before", "after" if before is not None else "now"),
        )
        for axis, series in enumerate("xyz" if after.power[1:].any() else ["residual"])
    ]
    for axis, plot in enumerate(plots):
        powers = [one.power[axis, 1:] for one in (before, after) if one is not None]
        drawn = np.sqrt(np.concatenate(powers))
        if (ticks := log_ticks(drawn)) is not None:
            plot.yaxis.ticker = ticks
    return plots


def unexplained_peaks(found: Periodogram, axis: int) -> list[int]:
    """Return the frequencies (indices) that stand beyond chance where no known period is, strongest first."""
    ratio = np.where(found.known, 0.0, found.ratio[axis])
    taken: list[int] = []
    for at in np.argsort(-ratio):
        if ratio[at] < found.threshold or len(taken) == _PEAKS:
            break
        if all(abs(int(at) - other) > _APART for other in taken):
            taken.append(int(at))
    return taken


def _line(found: Periodogram, axis: int, at: int) -> Line:
    step = float(found.frequency[1])
    amplitude: Floats = np.full(4, np.nan)
    amplitude[[0, axis + 1]] = np.sqrt(2.0 * found.power[axis, at] * step)
    return Line(1.0 / float(found.frequency[at]), "", "", float(found.ratio[axis, at]), amplitude, amplitude)
