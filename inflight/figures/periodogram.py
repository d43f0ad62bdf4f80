"""Periodograms of the residual along each axis, before and after the found effects."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.diagnosis.signature import Periodogram
from inflight.figures.spectra import spectrum_figure
from inflight.figures.style import log_ticks
from inflight.lines import Line

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
