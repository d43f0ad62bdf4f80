"""Curves in time thinned to what a picture can show: a mean, a least and a largest value a point."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.time import Int64


def thin_trace(
    tt2000: Int64, mean: Floats, low: Floats, high: Floats, first: int, last: int, points: int
) -> tuple[Int64, Floats, Floats, Floats]:
    """Return a curve between two times in at most so many points; gaps stay gaps.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (sample,)
        Increasing.
    mean, low, high : ndarray, shape (sample,)
        nT, NaN where nothing is known.
    first, last : int
        TT2000.

    Returns
    -------
    tuple of ndarray, shape (point,)
        Times, and mean, least and largest value of each point; NaN where nothing is known.
    """
    part = slice(*np.searchsorted(tt2000, [first, last]))
    time, mean, low, high = tt2000[part], mean[part], low[part], high[part]
    if time.size <= points:
        return time, mean, low, high
    begin = np.arange(0, time.size, -(-time.size // points))
    known = np.isfinite(mean)
    count = np.add.reduceat(known.astype(np.float64), begin)
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(count > 0, np.add.reduceat(np.where(known, mean, 0.0), begin) / count, np.nan)
    return time[begin], means, np.fmin.reduceat(low, begin), np.fmax.reduceat(high, begin)
