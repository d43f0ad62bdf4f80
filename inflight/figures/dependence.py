"""Figures of what a residual follows: means in bins with error bars, branches, and the axis behind them."""

from __future__ import annotations

import numpy as np
from bokeh.plotting import figure

from inflight.dependence import AxisResponse, Dependence
from inflight.figures.style import (
    AFTER,
    BEFORE,
    COMPONENTS,
    band,
    error_bars,
    legend_below,
    plain_figure,
)


def dependence_figure(found: Dependence) -> figure:
    """Draw the mean residual in bins of a coordinate, its band of one sigma between blocks, its branches.

    Branches (while the coordinate rises, while it falls) are drawn where they differ by five sigma
    or more; elsewhere they would only be noise.
    """
    plot = plain_figure(
        f"{found.coordinate}: rms {found.amplitude:.3f} +- {found.sigma_amplitude:.3f} nT",
        _axis(found.coordinate, found.unit),
        "nT",
    )
    loop = found.loop
    if loop is not None and loop.is_open:
        apart = f"falling; apart by {loop.opening:.3f} +- {loop.sigma_opening:.3f}"
        for branch, colour, label in ((loop.rising, BEFORE, "rising"), (loop.falling, AFTER, apart)):
            met = np.isfinite(branch.mean)
            band(plot, found.centre[met], branch.mean[met], branch.sigma[met], colour)
            plot.line(found.centre[met], branch.mean[met], color=colour, legend_label=label)
        legend_below(plot)
        return plot
    met = np.isfinite(found.mean)
    band(plot, found.centre[met], found.mean[met], found.sigma[met], AFTER)
    error_bars(plot, found.centre, found.mean, found.sigma, AFTER, 0.5)
    plot.line(found.centre[met], found.mean[met], color=AFTER)
    plot.scatter(found.centre, found.mean, color=AFTER, size=5)
    return plot


def axis_figure(found: AxisResponse) -> figure:
    """Draw the field along x, y, z that makes the residual follow a coordinate; bars of one sigma."""
    plot = plain_figure(
        f"{found.coordinate}: field along each axis", _axis(found.coordinate, found.unit), "nT"
    )
    for index, (axis, colour) in enumerate(zip("xyz", COMPONENTS, strict=True)):
        value, sigma = found.field[:, index], found.sigma[:, index]
        error_bars(plot, found.centre, value, sigma, colour, 0.6)
        told = f"{axis} {found.amplitude[index]:.3f} +- {found.sigma_amplitude[index]:.3f}"
        plot.line(found.centre, value, color=colour, legend_label=told)
        plot.scatter(found.centre, value, color=colour, size=4)
    legend_below(plot)
    return plot


def _axis(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit not in ("", "1") else name
