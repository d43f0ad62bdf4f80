"""What of a correction changes slowly, and is left alone where it may be the sensors' own.

Sensors drift, and ambient field that leaks into the difference is largest on long times: a correction is
often sure on short times only. What is slow is that of a whole window; its days find it in the table, so
that the field does not step between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from scipy import ndimage

from inflight.arrays import Floats
from inflight.dual.correction import Correction
from inflight.dual.readings import Readings

#: The variable of a table, and its times.
_NAME, _TIMES = "left_alone", "left_time"
#: Values of the slow part in one width.
_DENSE = 16


@dataclass(frozen=True)
class Part:
    """What of a correction is taken off.

    Attributes
    ----------
    share : float
        1 for all of it.
    seconds : float
        What changes more slowly than means over so long is left alone; 0 where nothing is.
    """

    share: float = 1.0
    seconds: float = 0.0

    def __str__(self) -> str:
        share = "all" if self.share == 1.0 else f"{self.share:.2f}"
        if not self.seconds:
            return f"{share} of it"
        hours = self.seconds / 3600.0
        return f"{share} of what changes within {f'{hours:.1f} h' if hours >= 1 else f'{self.seconds:.0f} s'}"


WHOLE = Part()


def slow_part(values: Floats, width: int) -> Floats:
    """Return what of values (time, column) changes more slowly than means over `width` samples.

    A mean of means: a response that is nowhere negative, so that no frequency is left with more than it had.
    """
    around = width | 1
    once = ndimage.uniform_filter1d(values, around, axis=0, mode="nearest")
    return np.asarray(ndimage.uniform_filter1d(once, around, axis=0, mode="nearest"))


def slow_of(correction: Correction, readings: Readings, seconds: float) -> Floats:
    """Return what of a correction changes more slowly than means over some seconds.

    Returns
    -------
    ndarray, shape (time, axis)
        nT; NaN where the correction is not known.
    """
    known = correction.known
    slow = np.full_like(correction.field, np.nan)
    if known.any():
        slow[known] = slow_part(correction.field[known], readings.samples_in(seconds))
    return slow


def slow_variables(correction: Correction, readings: Readings, seconds: float) -> xr.Dataset:
    """Return the slow part of a window's correction as variables of a table.

    Returns
    -------
    Dataset
        With variable `left_alone` (left_time, axis), nT, and `left_time`, TT2000.
    """
    slow = slow_of(correction, readings, seconds)
    known = np.flatnonzero(np.isfinite(slow).all(axis=1))
    every = max(readings.samples_in(seconds) // _DENSE, 1)
    rows = known[np.unique(np.append(np.arange(0, known.size, every), known.size - 1))]
    return xr.Dataset(
        {_NAME: ((_TIMES, "axis"), slow[rows], {"units": "nT"})}, {_TIMES: readings.stamps[rows]}
    )


def leaves_slow_alone(table: xr.Dataset) -> bool:
    """Return True when the correction of a table leaves alone what is slow."""
    return _NAME in table


def slow_in_window(table: xr.Dataset, correction: Correction, readings: Readings, seconds: float) -> Floats:
    """Return the slow part of a day's correction, (time, axis) nT, by the table of its window.

    A day outside of the window has that of its own correction.
    """
    times = (
        np.asarray(table[_TIMES].values, dtype=np.int64)
        if leaves_slow_alone(table)
        else np.zeros(0, np.int64)
    )
    if not times.size or readings.stamps[0] > times[-1] or readings.stamps[-1] < times[0]:
        return slow_of(correction, readings, seconds)
    since = (readings.stamps - times[0]).astype(np.float64)
    known = (times - times[0]).astype(np.float64)
    values = np.asarray(table[_NAME].values)
    return np.stack([np.interp(since, known, one) for one in values.T], axis=1)


def partly(correction: Correction, part: Part, away: float, slow: Floats | None = None) -> Correction:
    """Return the correction of which only a part is taken off.

    Parameters
    ----------
    correction : Correction
    part : Part
        `WHOLE` for all of it, which is returned as it is.
    away : float
        How far the share is from that of the stray field, rms: it widens the error of what changes.
    slow : ndarray, shape (time, axis), optional
        What of the field is left alone where the part says so, nT, the constant part with it: all that
        changes of it is an error.
    """
    known, share = correction.known, part.share
    if part == WHOLE or not known.any():
        return correction
    left = np.zeros_like(correction.field) if slow is None or not part.seconds else slow
    taken = correction.field - left
    changes = taken - np.median(taken[known], axis=0)
    left = left - np.median(left[known], axis=0)
    return replace(
        correction,
        field=share * taken,
        covariance=correction.covariance * share**2 + away**2 * _squares(changes) + _squares(left),
        constant_known=correction.constant_known and not part.seconds,
    )


def _squares(vectors: Floats) -> Floats:
    """Return products of components; from (time, axis) to (time, axis, axis)."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])
