"""Figures of a coil's temperature: what it does to the scale factors, and the rivals on held-out blocks."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.estimators.coil_temperature import CoilFit
from inflight.estimators.temperature_rivals import TemperatureChoice
from inflight.figures.style import (
    AFTER,
    COMPONENTS,
    NEW,
    REFERENCE,
    band,
    error_bars,
    legend_below,
    plain_figure,
)


def scale_curves_figure(fit: CoilFit, temperatures: Floats) -> figure:
    """Draw the change of the scale factors against temperature with its band, ppm.

    Parameters
    ----------
    fit : CoilFit
    temperatures : ndarray, shape (place,)
        degC, rising: the range that was seen.
    """
    title = f"Scale factors with {fit.channel}: {fit.told().split('; ')[-1]}"
    plot = plain_figure(title, "temperature (degC)", "ppm", width=560)
    change = temperatures - fit.reference
    for axis, (name, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        rows = np.zeros((change.size, fit.fit.value.size))
        rows[:, axis], rows[:, axis + 3] = -change, -(change**2)
        value = 1e6 * rows @ fit.fit.value
        sigma = 1e6 * np.sqrt(np.einsum("ti,ij,tj->t", rows, fit.fit.covariance, rows))
        band(plot, temperatures, value, sigma, colour)
        plot.line(temperatures, value, color=colour, line_width=2, legend_label=name)
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
        (~tied, NEW, "worse"),
    ):
        if which.any():
            plot.scatter(place[which], behind[which], color=colour, size=8, legend_label=label)
    plot.xaxis.ticker = place.tolist()
    plot.xaxis.major_label_overrides = {at: one.channel for at, one in enumerate(choice.rivals)}
    legend_below(plot)
    return plot
