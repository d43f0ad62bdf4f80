"""Levels of a channel that switches: its readings without their noise."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA

#: A change from one reading to the next is a switching beyond so many of its usual sizes.
_JUMP = 8.0
#: A stretch between switchings has one level when it scatters no more than this beside its white noise; it
#: has readings enough from so many on.
_STEADY, _FEWEST = 1.5, 4


def without_noise(values: Floats) -> Floats:
    """Return readings with their mean between switchings in the place of each, where that is a level.

    A field of many nanotesla that is taken off by a noisy current is taken off with its noise, and the
    regression that finds its size is diluted. What wanders between its switchings, a temperature, stays.

    Parameters
    ----------
    values : ndarray, shape (time,)
        Readings in order of time, any unit; NaN where one is missing.
    """
    known = np.isfinite(values)
    told = values[known]
    change = np.diff(told)
    white = TO_SIGMA * float(np.median(np.abs(change))) / np.sqrt(2.0) if told.size > 1 else 0.0
    if not white > 0.0:
        return values
    begins = np.concatenate([[0], np.flatnonzero(np.abs(change) > _JUMP * np.sqrt(2.0) * white) + 1])
    count = np.diff(np.append(begins, told.size))
    mean = np.add.reduceat(told, begins) / count
    scatter = np.sqrt(np.add.reduceat((told - np.repeat(mean, count)) ** 2, begins) / count)
    level = np.repeat((scatter <= _STEADY * white) & (count >= _FEWEST), count)
    out = values.copy()
    out[known] = np.where(level, np.repeat(mean, count), told)
    return out
