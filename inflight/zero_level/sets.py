"""Corrections of sets of successive averages, their scatter and trend (IMP-8: 72 sets of 1440, table 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.robust import robust_sigma
from inflight.errors import CalibrationError
from inflight.estimators.longrun import long_run_covariance
from inflight.estimators.robust_fit import robust_fit
from inflight.time import DAY, SECOND, Int64
from inflight.zero_level.davis_smith import least_variance
from inflight.zero_level.estimate import BOUND, Estimate, Question, informed
from inflight.zero_level.intervals import AXES, Bools, Intervals
from inflight.zero_level.minimum_correlation import NAME, balance, joint_equations

#: Averages of a set, and parts of a set whose scatter says what the set tells.
SET, _PARTS = 1440, 12
#: Fewest sets of a trend, and of a scatter.
_FEWEST = 3
_ROUNDS, _SETTLED, _STRIDE = 60, 1e-4, 0.2


@dataclass(frozen=True)
class Sets:
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
    def told(self) -> Bools:
        """Sets that tell an offset; (set,)."""
        return np.asarray(np.isfinite(self.value).all(axis=1))

    def mean(self) -> Estimate:
        """Return the mean of the sets, its covariance from their scatter; outlying sets lose their say.

        Raises
        ------
        CalibrationError
            Fewer than three sets tell an offset.
        """
        used = self._enough()
        value, sigma = self.value[used], self.sigma[used]
        fits = [robust_fit(np.ones((len(value), 1)), value[:, i], sigma[:, i] ** 2, 1.0) for i in range(3)]
        mean = np.array([fit.value[0] for fit in fits])
        weight = np.stack([fit.say for fit in fits], axis=1) / (sigma**2 + [fit.scatter**2 for fit in fits])
        influence = np.zeros_like(self.value)
        influence[used] = weight * (value - mean) / weight.sum(axis=0)
        spread = np.sqrt([fit.covariance[0, 0] for fit in fits])
        shared = long_run_covariance(influence[used])
        size = np.sqrt(np.maximum(np.diag(shared), 1e-300))
        covariance = shared * np.outer(spread / size, spread / size)
        lost = int((~used).sum() + sum(fit.outlying for fit in fits))
        told = f"{lost} of {used.size} sets have no zero nearby, or one far from those of the others"
        return Estimate(
            f"{NAME}, sets",
            mean,
            covariance,
            np.full(3, True),
            influence,
            used,
            self.start,
            self.end,
            np.zeros((3, 3)),
            (told,) if lost else (),
        )

    def trend(self) -> SetTrend:
        """Return the line c = a t + b of each axis, t in days from the middle; outlying sets lose their say.

        Raises
        ------
        CalibrationError
            Fewer than three sets tell an offset.
        """
        used = self._enough()
        middle = (self.start // 2 + self.end // 2)[used]
        centre = round(float(np.mean(middle - middle[0]))) + int(middle[0])
        days = (middle - centre) / DAY
        columns = np.column_stack([days, np.ones_like(days)])
        value, variance = self.value[used], self.sigma[used] ** 2
        fits = [robust_fit(columns, value[:, i], variance[:, i], 2.0) for i in range(3)]
        line = np.array([fit.value for fit in fits]).T
        error = np.sqrt([np.diag(fit.covariance) for fit in fits]).T
        scatter = np.array([robust_sigma(fit.left) for fit in fits])
        return SetTrend(line[0], error[0], line[1], error[1], scatter, centre, int(used.sum()))

    def _enough(self) -> Bools:
        used = self.told
        if used.sum() < _FEWEST:
            raise CalibrationError(
                f"{int(used.sum())} of {used.size} sets tell an offset, {_FEWEST} needed",
                remedy="take a longer span, or larger sets",
            )
        return used

    def table(self) -> xr.Dataset:
        """Return the values along set and parameter."""
        return xr.Dataset(
            {
                "value": (("set", "parameter"), self.value, {"units": "nT"}),
                "sigma": (("set", "parameter"), self.sigma),
                "units": ("parameter", np.array(["nT"] * 3)),
                "start": ("set", self.start, {"scale": "TT2000"}),
                "end": ("set", self.end, {"scale": "TT2000"}),
            },
            coords={"parameter": [f"offset_{axis}" for axis in AXES]},
        )


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

    def table(self) -> xr.Dataset:
        """Return slope and level of each axis along parameter."""
        names = [f"{part}_{axis}" for part in ("slope", "level") for axis in AXES]
        return xr.Dataset(
            {
                "value": ("parameter", np.concatenate([self.slope, self.level])),
                "sigma": ("parameter", np.concatenate([self.sigma_slope, self.sigma_level])),
                "units": ("parameter", np.array(["nT/day"] * 3 + ["nT"] * 3)),
                "middle": ((), np.int64(self.middle), {"scale": "TT2000"}),
            },
            coords={"parameter": names},
            attrs={"sets": self.sets},
        )


def correlation_sets(
    tt2000: Int64,
    averages: Floats,
    size: int = SET,
    good: Bools | None = None,
    bound: float = BOUND,
    free: tuple[bool, bool, bool] = (True, True, True),
) -> Sets:
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
        A set whose zero lies further out, or nowhere, tells nothing; nT.
    free : tuple of bool
        Axes to estimate; the others are 0.

    Raises
    ------
    CalibrationError
        No whole set.
    """
    cadence = float(np.median(np.diff(tt2000))) / SECOND
    parts = max(size // _PARTS, 16)
    intervals = Intervals.of(tt2000, averages, parts * cadence, good, fewest=_PARTS // 2)
    number = (intervals.start - intervals.start[0]) // round(parts * cadence * SECOND) // _PARTS
    rows = [np.flatnonzero(number == one) for one in np.unique(number)]
    rows = [row for row in rows if row.size >= _PARTS // 2]
    question = Question(free, bound=bound)
    found = np.array([_zero(intervals.where(row), question) for row in rows]).reshape(-1, 2, 3)
    start = np.array([intervals.start[row[0]] for row in rows], dtype=np.int64)
    end = np.array([intervals.end[row[-1]] for row in rows], dtype=np.int64)
    return Sets(found[:, 0], found[:, 1], start, end)


def _zero(part: Intervals, question: Question) -> Floats:
    """Return the offset of one set and its error; NaN when there is no zero within the bound; (2, 3)."""
    found = [_from(part, question, first) for first in question.begins(least_variance(part, question))]
    told = [one for one in found if np.isfinite(one).all() and not part.around(one[0])]
    if not told:
        return np.full((2, 3), np.nan)
    return max(told, key=lambda one: abs(float(np.log(balance(part, one[0])))))


def _from(part: Intervals, question: Question, offset: Floats) -> Floats:
    """Return the zero found from an offset, and its error; NaN when there is none; (2, 3)."""
    free = np.asarray(question.free)
    for _ in range(_ROUNDS):
        scores, slopes = joint_equations(part, offset)
        # A set that tells little has a large error, and shows in the scatter of the sets.
        inverse, _ = informed(slopes, free, 0.0)
        step = inverse @ scores.sum(axis=0)
        step = step * min(1.0, _STRIDE * question.bound / max(float(np.abs(step).max()), 1e-300))
        offset = offset + step
        if np.abs(offset).max() >= question.bound:
            break
        if np.abs(step).max() < _SETTLED:
            influence = scores @ inverse.T
            return np.stack([offset, np.sqrt(np.sum(influence**2, axis=0)) + 1e-9])
    return np.full((2, 3), np.nan)
