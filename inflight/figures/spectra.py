"""Figures of spectra: the residual, and the residual along each axis, with known and unknown lines.

Takes spectra and lines as `inflight.residual` makes them (`SpectrumSum`, `Line`, periods by name); makes
Bokeh figures of amplitude density against period.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from bokeh.models import Label, Span
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import (
    AFTER,
    BEFORE,
    HIGHLIGHT,
    REFERENCE,
    draw_line,
    draw_points,
    log_ticks,
    place_legend,
    plain_figure,
)
from inflight.residual import SERIES, Line, SpectrumSum, format_period, thin_spectrum

#: What each series is called above its figure.
_TITLES = {
    "residual": "Spectrum of the residual",
    "x": "Spectrum of the residual along x",
    "y": "Spectrum of the residual along y",
    "z": "Spectrum of the residual along z",
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
            shown, thin = thin_spectrum(frequency, power)
            draw_line(plot, 1.0 / shown, np.sqrt(thin), color=colour, legend_label=label)
    period = 1.0 / frequency
    if (ticks := log_ticks(period)) is not None:
        plot.xaxis.ticker = ticks
    inside = {name: s for name, s in known.items() if period.min() <= s <= period.max()}
    _mark_known(plot, inside)
    _mark_new(plot, frequency, after, [line for line in lines if line.is_new], series)
    place_legend(plot, "center_left")
    return plot


def draw_floor(plot: figure, frequency: Floats, level: float) -> None:
    """Draw the amplitude density of white noise of this rms, nT: what the spectrum falls to."""
    if np.isfinite(level) and level > 0:
        period = 1.0 / frequency[[0, -1]]
        height = level / np.sqrt(frequency[-1])
        draw_line(
            plot, period, [height, height], color="#222222", line_dash="dashed", legend_label="noise floor"
        )


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
    # Of a line that was not seen in this series the amplitude is NaN or its own noise.
    seen = [line for line in lines if line.amplitude[index] > 3.0 * line.sigma[index]][:_MARKS]
    inside = [line for line in seen if frequency[0] <= 1.0 / line.period_s <= frequency[-1]]
    if not inside:
        return
    at = [int(np.argmin(np.abs(frequency - 1.0 / line.period_s))) for line in inside]
    height = [float(np.sqrt(power[max(i - 1, 0) : i + 2].max())) for i in at]
    periods = [line.period_s for line in inside]
    draw_points(plot, periods, height, color=HIGHLIGHT, size=7, legend_label="unknown period")
    for seconds, top in zip(periods, height, strict=True):
        plot.add_layout(
            Label(
                x=seconds,
                y=top,
                x_offset=5,
                y_offset=3,
                text=format_period(seconds),
                text_font_size="10px",
                text_color=HIGHLIGHT,
            )
        )


def axis_spectrum_figures(
    before: SpectrumSum | None, after: SpectrumSum, known: Mapping[str, float], lines: Sequence[Line] = ()
) -> list[figure]:
    """Draw dB u_x, dB u_y, dB u_z: amplitude density against period, both logarithmic.

    Known periods are named; lines of the residual that no known period explains are red with their period.

    Parameters
    ----------
    before : SpectrumSum, optional
        Absent when nothing was found.
    known : mapping of str to float
        Periods to name, s.
    lines : sequence of Line
        Of the spectrum after.
    """
    same = before is not None and before.frequency.size == after.frequency.size
    # Along axes that are never seen there is nothing: one figure of the residual is enough.
    axes = SERIES[1:] if after.direction_square[2:].any() else SERIES[:1]
    plots = []
    for name in axes:
        index = SERIES.index(name)
        earlier = before.density[index] if before is not None and same else None
        now = after.density[index]
        labels = ("before", "after" if earlier is not None else "now")
        plot = spectrum_figure(after.frequency, earlier, now, known, lines, name, labels)
        drawn = np.sqrt(now if earlier is None else np.concatenate([earlier, now]))
        if (ticks := log_ticks(drawn)) is not None:
            plot.yaxis.ticker = ticks
        plots.append(plot)
    return plots
