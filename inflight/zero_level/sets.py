"""Zero levels of sets of successive averages, one after the other, by minimum correlation.

`correlation_sets` takes averages over whole spins and makes `OffsetSets`: the offset of each set with its
error, their mean and their trend. IMP-8 had 72 sets of 1440, Helios steps of two hours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import long_run_covariance, robust_fit, robust_sigma
from inflight.time import DAY, SECOND, Int64
from inflight.zero_level.estimate import Estimate, OffsetSearch
from inflight.zero_level.intervals import Bools, Intervals
from inflight.zero_level.methods import MINIMUM_CORRELATION, zero_of_minimum_correlation

#: Averages of a set (IMP-8).
SET = 1440


@dataclass(frozen=True, kw_only=True)
class SetSettings:
    """Numbers of sets.

    Attributes
    ----------
    parts : int
        Parts of a set whose scatter gives its error. Assumed.
    fewest : int
        Fewest sets of a mean or a trend. Assumed.
    """

    parts: int = 12
    fewest: int = 3


SET_SETTINGS = SetSettings()


@dataclass(frozen=True)
class OffsetSets:
    """Offsets of sets, one after the other.

    Attributes
    ----------
    value, sigma : ndarray, shape (set, 3)
        nT; the error from the parts of the set. NaN for a set without a zero within the bound.
    start, end : ndarray of int64, shape (set,)
        TT2000.
    """

    value: Floats
    sigma: Floats
    start: Int64
    end: Int64

    @property
    def determined(self) -> Bools:
        """Sets that determine an offset; (set,)."""
        return np.asarray(np.isfinite(self.value).all(axis=1))

    def mean(self) -> Estimate:
        """Return the mean of the sets, its covariance from their scatter; outlying sets are down-weighted.

        Raises
        ------
        CalibrationError
            Fewer than three sets determine an offset.
        """
        used = self._sufficient()
        value, sigma = self.value[used], self.sigma[used]
        fits = [robust_fit(np.ones((len(value), 1)), value[:, i], sigma[:, i] ** 2, 1.0) for i in range(3)]
        mean = np.array([fit.value[0] for fit in fits])
        weight = np.stack([fit.robust_weight for fit in fits], axis=1) / (
            sigma**2 + [fit.scatter**2 for fit in fits]
        )
        influence = np.zeros_like(self.value)
        influence[used] = weight * (value - mean) / weight.sum(axis=0)
        spread = np.sqrt([fit.covariance[0, 0] for fit in fits])
        shared = long_run_covariance(influence[used])
        size = np.sqrt(np.maximum(np.diag(shared), 1e-300))
        covariance = shared * np.outer(spread / size, spread / size)
        lost = int((~used).sum() + sum(fit.outlying for fit in fits))
        why = f"{lost} of {used.size} sets have no zero nearby, or one far from those of the others"
        return Estimate(
            method=f"{MINIMUM_CORRELATION}, sets",
            solution=mean,
            covariance=covariance,
            determined=np.full(3, True),
            influence=influence,
            used=used,
            start=self.start,
            end=self.end,
            systematic=np.zeros((3, 3)),
            reasons=(why,) if lost else (),
        )

    def trend(self) -> SetTrend:
        """Return the line c = a t + b of each axis, t in days from the middle, with robust weights.

        Raises
        ------
        CalibrationError
            Fewer than three sets determine an offset.
        """
        used = self._sufficient()
        middle = (self.start // 2 + self.end // 2)[used]
        centre = round(float(np.mean(middle - middle[0]))) + int(middle[0])
        days = (middle - centre) / DAY
        columns = np.column_stack([days, np.ones_like(days)])
        value, variance = self.value[used], self.sigma[used] ** 2
        fits = [robust_fit(columns, value[:, i], variance[:, i], 2.0) for i in range(3)]
        line = np.array([fit.value for fit in fits]).T
        error = np.sqrt([np.diag(fit.covariance) for fit in fits]).T
        scatter = np.array([robust_sigma(fit.residual) for fit in fits])
        return SetTrend(line[0], error[0], line[1], error[1], scatter, centre, int(used.sum()))

    def _sufficient(self) -> Bools:
        used = self.determined
        if used.sum() < SET_SETTINGS.fewest:
            raise CalibrationError(
                f"{int(used.sum())} of {used.size} sets tell an offset, {SET_SETTINGS.fewest} needed",
                remedy="take a longer span, or larger sets",
            )
        return used


@dataclass(frozen=True)
class SetTrend:
    """c = a t + b; all (3,), and errors from the scatter of the sets.

    Attributes
    ----------
    slope, sigma_slope : ndarray
        a, nT/day.
    level, sigma_level : ndarray
        b, nT, at the middle.
    scatter : ndarray
        Robust standard deviation of a set about the line, nT.
    middle : int
        TT2000.
    sets : int
    """

    slope: Floats
    sigma_slope: Floats
    level: Floats
    sigma_level: Floats
    scatter: Floats
    middle: int
    sets: int


def correlation_sets(
    tt2000: Int64,
    averages: Floats,
    size: int = SET,
    good: Bools | None = None,
    bound: float = OffsetSearch.bound,
    free: tuple[bool, bool, bool] = (True, True, True),
) -> OffsetSets:
    """Find the offset of each set of successive averages by minimum correlation along all axes at once.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (time,)
    averages : ndarray, shape (time, 3)
        nT, over whole spins.
    size : int
        Averages of a set.
    good : ndarray of bool, shape (time,), optional
    bound : float
        A set whose zero lies further out, or nowhere, determines nothing; nT.
    free : tuple of bool
        Axes to estimate; the others are 0.

    Raises
    ------
    CalibrationError
        No whole set.
    """
    cadence = float(np.median(np.diff(tt2000))) / SECOND
    parts = max(size // SET_SETTINGS.parts, 16)
    intervals = Intervals.of(tt2000, averages, parts * cadence, good, fewest=SET_SETTINGS.parts // 2)
    number = (intervals.start - intervals.start[0]) // round(parts * cadence * SECOND) // SET_SETTINGS.parts
    rows = [np.flatnonzero(number == one) for one in np.unique(number)]
    rows = [row for row in rows if row.size >= SET_SETTINGS.parts // 2]
    search = OffsetSearch(free, bound=bound)
    found = np.array([zero_of_minimum_correlation(intervals.select(row), search) for row in rows]).reshape(
        -1, 2, 3
    )
    start = np.array([intervals.start[row[0]] for row in rows], dtype=np.int64)
    end = np.array([intervals.end[row[-1]] for row in rows], dtype=np.int64)
    return OffsetSets(found[:, 0], found[:, 1], start, end)
