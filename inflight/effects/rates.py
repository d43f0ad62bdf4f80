"""Rates of change of sampled series, gaps respected."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import GAP, SECOND


def slope(values: Floats, tt2000: npt.NDArray[np.int64]) -> Floats:
    """Return the rate of change, a second; NaN where a sample has no neighbour.

    Central within gap-free runs, one-sided at their ends.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        NaN where missing.
    tt2000 : ndarray, shape (time,)
        Stamps, nanoseconds.
    """
    if len(values) < 2:
        return np.full_like(values, np.nan)
    step = np.diff(tt2000) / SECOND
    apart = step > GAP * np.median(step)
    shape = (-1,) + (1,) * (values.ndim - 1)
    change = np.diff(values, axis=0) / step.reshape(shape)
    change[apart] = np.nan
    missing = np.full_like(values[:1], np.nan)
    before, after = np.concatenate([missing, change]), np.concatenate([change, missing])
    both = 0.5 * (before + after)
    return np.where(np.isfinite(both), both, np.where(np.isfinite(before), before, after))
