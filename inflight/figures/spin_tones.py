"""Figures of what of a residual goes with the spin: tones over time, the mean turn, what tones follow."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.layouts import gridplot
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    REFERENCE,
    band,
    error_bars,
    legend_below,
    place_legend,
    plain_figure,
)
from inflight.fourier import Complex
from inflight.spin.residual_tones import ROWS, TONES, ToneDependence, Tones
from inflight.time import Int64, to_utc

#: Points of a curve over time: more intervals are drawn as medians of several.
_POINTS = 600
_STATES = (("pre-flight model", BEFORE), ("calibrated", AFTER))


def tone_name(tone: int) -> str:
    """Return what people call a tone: its row, and how often it comes a turn."""
    row, harmonic = TONES[tone]
    return f"{('along axis', 'modulus')[row]}, {harmonic} a turn"


def tones_over_time_figure(time: Int64, before: Tones, after: Tones, tone: int) -> figure:
    """Draw the rms of one tone in each interval before and after calibration, and nature's noise; nT."""
    plot = plain_figure(
        f"Tone {tone_name(tone)}", "", "rms (nT)", x_axis_type="datetime", y_axis_type="log", width=560
    )
    for one, (label, colour) in zip((before, after), _STATES, strict=True):
        x, y = _medians(time, np.abs(one.value[:, tone]) / np.sqrt(2.0))
        plot.scatter(x, y, color=colour, size=3, alpha=0.7, legend_label=label)
    x, y = _medians(time, after.noise)
    plot.line(x, y, color=REFERENCE, legend_label="nature's noise, all tones")
    legend_below(plot)
    return plot


def _medians(time: Int64, values: Floats) -> tuple[Any, Floats]:
    """Return UTC and medians of groups of intervals, such as a browser can draw."""
    known = np.flatnonzero(np.isfinite(values) & (values > 0.0))
    each = max(1, -(-known.size // _POINTS))
    groups = [known[at : at + each] for at in range(0, known.size, each)]
    middle = np.array([time[group[len(group) // 2]] for group in groups], dtype=np.int64)
    return to_utc(middle), np.array([np.median(values[group]) for group in groups])


def mean_turn_figure(before: ToneDependence | None, after: ToneDependence | None) -> Any:
    """Draw the mean turn of both rows before and after calibration, a band of one sigma; nT."""
    phase = np.linspace(0.0, 360.0, 121)
    plots = []
    for row, name in enumerate(ROWS):
        plot = plain_figure(f"Mean turn, {name}", "spin phase (deg)", "nT", width=376)
        for one, (label, colour) in zip((before, after), _STATES, strict=True):
            if one is None:
                continue
            curve, sigma = _turn(one.mean[0], one.sigma[0], row, np.deg2rad(phase))
            band(plot, phase, curve, sigma, colour)
            plot.line(phase, curve, color=colour, line_width=2, legend_label=label)
        legend_below(plot)
        plots.append(plot)
    return gridplot([plots], toolbar_location="above", merge_tools=True)


def _turn(mean: Complex, sigma: Floats, row: int, phase: Floats) -> tuple[Floats, Floats]:
    """Return a row over a turn from its tones, and its sigma."""
    mine = [tone for tone, (which, _) in enumerate(TONES) if which == row]
    curve = sum(np.real(mean[tone] * np.exp(-1j * TONES[tone][1] * phase)) for tone in mine)
    spread = float(np.sqrt(np.sum(sigma[mine] ** 2) / 2.0))
    return np.asarray(curve), np.full(phase.size, spread)


def tone_dependence_figure(found: ToneDependence, tone: int) -> figure:
    """Draw cosine and sine of one tone in bins of a coordinate, bars of one sigma between blocks; nT."""
    one = found.coordinate
    size, error = found.amplitude[tone], found.sigma_amplitude[tone]
    label = f"{one.name} ({one.unit})" if one.unit and one.unit != "1" else one.name
    plot = plain_figure(f"{one.name}: {tone_name(tone)}, rms {size:.4f} +- {error:.4f} nT", label, "nT")
    plot.title.text_font_size = "10px"
    met = np.isfinite(found.mean[:, tone])
    order = np.flatnonzero(met)[np.argsort(found.centre[met])]
    x, sigma = found.centre[order], found.sigma[order, tone] / np.sqrt(2.0)
    for part, colour, name in (
        (found.mean[order, tone].real, COMPONENTS[0], "cosine"),
        (found.mean[order, tone].imag, COMPONENTS[2], "sine"),
    ):
        error_bars(plot, x, part, sigma, colour, 0.5)
        plot.line(x, part, color=colour, legend_label=name)
        plot.scatter(x, part, color=colour, size=5)
    place_legend(plot)
    legend_below(plot)
    return plot
