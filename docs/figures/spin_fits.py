"""Figures of the spin: its period, Slope/Intercept, the phasor of the spin-axis sensor, zero levels."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure

from inflight.figures import (
    AFTER,
    BEFORE,
    COMPONENTS,
    HIGHLIGHT,
    REFERENCE,
    error_band,
    error_bars,
    legend_below,
    plain_figure,
)
from inflight.spin import FarrellFit, SpinFits, SpinPhase, ZeroDrift
from inflight.time import mjd2000

#: More points than this are drawn as every n-th.
_MOST = 4000


def _few(count: int) -> slice:
    return slice(None, None, max(1, count // _MOST))


def slope_figure(fits: SpinFits, found: FarrellFit) -> figure:
    """Draw C0 of sensors 1 and 2 against that of sensor 3 and the lines (Farrell et al. 1995, eq. 23)."""
    plot = plain_figure("Slope/Intercept", "C0 of sensor 3 (nT)", "C0 less the intercept (nT)", width=470)
    whole = fits.whole
    constant = whole.constant[_few(len(whole))]
    axial, levels = constant[:, 2], found.intercepts
    window = np.searchsorted(levels.start, whole.time[_few(len(whole))], side="right") - 1
    own = constant[:, :2] - levels.intercept[np.maximum(window, 0)]
    reach = np.array([axial.min(), axial.max()])
    slope = np.sin(found.value[:2]) / np.cos(found.tilt[0])
    for k in range(2):
        name = f"sensor {k + 1}: {np.rad2deg(found.value[k]):+.3f} +- {np.rad2deg(found.sigma[k]):.3f} deg"
        plot.scatter(axial, own[:, k], size=3, color=COMPONENTS[k], alpha=0.15)
        plot.line(reach, slope[k] * reach, color=COMPONENTS[k], line_width=3, legend_label=name)
    # Half a percent of the fits may lie far outside.
    far = np.percentile(np.abs(own), 99.5)
    plot.y_range.start, plot.y_range.end = -1.15 * far, 1.15 * far
    legend_below(plot)
    return plot


def phasor_figure(fits: SpinFits, found: FarrellFit) -> figure:
    """Draw Z3 / Z1 of every fit and the tilt found, which is their mean by weight (eqs. 24 and 25)."""
    tilt, sigma = (np.rad2deg(one) for one in found.tilt)
    plot = plain_figure(
        f"Tilt of sensor 3: {tilt:.4f} +- {sigma:.4f} deg",
        "Re Z3 / Z1 (deg)",
        "Im Z3 / Z1 (deg)",
        width=340,
        height=380,
    )
    phasor = fits.whole.phasor
    ratio = (180.0 / np.pi * phasor[:, 2] / phasor[:, 0])[_few(len(phasor))]
    plot.scatter(ratio.real, ratio.imag, size=3, color=AFTER, alpha=0.35, legend_label="fits")
    x, y = np.rad2deg(found.value[2:4])
    plot.scatter([x], [y], size=12, marker="cross", color=HIGHLIGHT, line_width=2, legend_label="tilt")
    far = 1.1 * np.percentile(np.maximum(np.abs(ratio.real), np.abs(ratio.imag)), 98)
    plot.x_range.start, plot.x_range.end = -far, far
    plot.y_range.start, plot.y_range.end = -far, far
    legend_below(plot)
    return plot


def zero_figure(drift: ZeroDrift) -> figure:
    """Draw the zero levels of both spin-plane sensors over time, less those from before the flight."""
    plot = plain_figure("Zero levels since before the flight", "MJD (2000-01-01)", "nT", width=560)
    time = mjd2000(drift.levels.time)
    for k in range(2):
        name = f"sensor {k + 1}"
        if np.isfinite(drift.rate[k]):
            name += f": {drift.rate[k]:+.3g} +- {drift.rate_sigma[k]:.1g} nT a day"
        error_bars(plot, time, drift.change[:, k], drift.change_sigma[:, k], COMPONENTS[k], 0.5)
        plot.scatter(time, drift.change[:, k], size=6, color=COMPONENTS[k], legend_label=name)
    plot.line([time[0], time[-1]], [0.0, 0.0], color=REFERENCE, line_dash="dashed")
    legend_below(plot)
    return plot


def phase_figure(found: SpinPhase) -> figure:
    """Draw the spin period at the marks, its jumps, and where no turns could be counted."""
    marks = found.marks
    plot = plain_figure("Spin period", "MJD (2000-01-01)", "less the median (ms)", width=560)
    part = _few(marks.time.size)
    time = mjd2000(marks.time)
    period = 1e3 * (marks.period - found.period)
    sigma = 1e3 * marks.sigma * found.period * np.ones(period.size)
    error_band(plot, time[part], period[part], sigma[part], AFTER)
    plot.line(time[part], period[part], color=AFTER, legend_label=f"period, median {found.period:.6g} s")
    for chosen, colour, name in (
        (marks.jumped, HIGHLIGHT, "jump of the phase"),
        (marks.uncountable, BEFORE, "turns not counted"),
    ):
        place = np.flatnonzero(chosen)
        if place.size:
            plot.scatter(
                time[place], period[place], size=10, marker="x", color=colour, line_width=2, legend_label=name
            )
    legend_below(plot)
    return plot
