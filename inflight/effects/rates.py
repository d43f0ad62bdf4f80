"""Rates of change of sampled series, gaps respected."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import GAP, SECOND, usual_step

#: Steps are equal when they differ by less than this part of the usual one.
_EVEN = 1e-3


def slope(values: Floats, tt2000: npt.NDArray[np.int64], order: int = 4) -> Floats:
    """Return the rate of change, a second; NaN where a sample has no neighbour.

    Of fourth order where two neighbours on either side are equally far, else central, one-sided at the
    ends of gap-free runs: a field that swings within some samples must not seem to change too slowly.

    Parameters
    ----------
    values : ndarray, shape (time,) or (time, axis)
        NaN where missing.
    tt2000 : ndarray, shape (time,)
        Stamps, nanoseconds.
    order : int
        4, or 2 for the plain form throughout.
    """
    if len(values) < 2:
        return np.full_like(values, np.nan)
    step = np.diff(tt2000) / SECOND
    usual = usual_step(tt2000) / SECOND
    apart = step > GAP * usual
    shape = (-1,) + (1,) * (values.ndim - 1)
    change = np.diff(values, axis=0) / step.reshape(shape)
    change[apart] = np.nan
    missing = np.full_like(values[:1], np.nan)
    before, after = np.concatenate([missing, change]), np.concatenate([change, missing])
    both = 0.5 * (before + after)
    sides = np.where(np.isfinite(both), both, np.where(np.isfinite(before), before, after))
    if len(values) < 5 or order < 4:
        return sides
    outer = change[:-3] + change[3:]
    inner = change[1:-2] + change[2:-1]
    fine = (7.0 * inner - outer) / 12.0
    # Uneven steps, by more than a stamp's rounding, keep the plain form.
    if np.ptp(step) >= _EVEN * usual:
        fours = [step[first : step.size - 3 + first] for first in range(4)]
        uneven = np.maximum.reduce(fours) - np.minimum.reduce(fours) >= _EVEN * usual
        fine[uneven] = np.nan
    sides[2:-2] = np.where(np.isfinite(fine), fine, sides[2:-2])
    return sides
