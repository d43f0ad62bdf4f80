"""Weighted means of daily values in a window that moves over the days, whose ends count by the part inside.

One way for a parameter whose mean is undefined where the window is not (`behaviour.running_mean`) and for
currents that a correction needs on every day (`secular.carried_mean`). Both are means of this module; they
differ in what they say of days without one: nothing, or the mean carried there with a wider sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import SettingsError


@dataclass(frozen=True)
class Windowed:
    """Means over windows; a window without a day has the mean 0 and no coverage.

    Attributes
    ----------
    mean, spread : ndarray, shape (day, column)
        Weighted mean of the values and their standard deviation within the window.
    weight : ndarray, shape (day,)
        Sum of the weights inside.
    coverage : ndarray, shape (day,)
        The same as a part of what a window without gaps would have, in [0, 1].
    lean : ndarray, shape (day,)
        How far the mean time of what is there lies from the middle, days.
    """

    mean: Floats
    spread: Floats
    weight: Floats
    coverage: Floats
    lean: Floats


def windowed(daily: Floats, weight: Floats, window: float) -> Windowed:
    """Return the means of the days within half a window on either side of each.

    Parameters
    ----------
    daily : ndarray, shape (day, column)
        One row a day, no day left out; NaN where the weight is 0.
    weight : ndarray, shape (day,)
        0 for none, 1 for a usual day.
    window : float
        Days; the days at its ends weigh by the part of them inside, so that a window of 260.5 d removes what
        repeats in 260.5 d.

    Raises
    ------
    SettingsError
        For a window shorter than a day.
    """
    if not window >= 1.0:
        raise SettingsError(f"a window of {window:g} d found", remedy="take one day or more")
    half = int(np.ceil(0.5 * window - 0.5))
    offset = np.arange(-half, half + 1)
    kernel = np.clip(0.5 * window + 0.5 - np.abs(offset), 0.0, 1.0)
    known = np.where(weight[:, None] > 0, daily, 0.0) * weight[:, None]
    inside = np.clip(_same(weight, kernel), 0.0, None)
    total = np.maximum(inside, 1e-12)
    mean = np.stack([_same(column, kernel) for column in known.T], axis=1) / total[:, None]
    squares = np.where(weight[:, None] > 0, daily, 0.0) * known
    square = np.stack([_same(column, kernel) for column in squares.T], axis=1) / total[:, None]
    return Windowed(
        mean,
        np.sqrt(np.clip(square - mean**2, 0.0, None)),
        inside,
        np.clip(inside / kernel.sum(), 0.0, 1.0),
        # A convolution turns the kernel over: a day that is later weighs with the negative of its offset.
        -_same(weight, kernel * offset) / total,
    )


def _same(series: Floats, kernel: Floats) -> Floats:
    """Return the convolution at the places of the series, however short it is."""
    half = kernel.size // 2
    return np.asarray(np.convolve(series, kernel)[half : half + series.size])
