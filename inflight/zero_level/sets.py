"""Corrections of sets of successive averages, their scatter and their trend (IMP-8: 72 sets of 1440, table 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.estimators.longrun import long_run_covariance
from inflight.time import DAY, SECOND, Int64
from inflight.zero_level.davis_smith import least_variance
from inflight.zero_level.estimate import BOUND, Estimate, Question, informed
from inflight.zero_level.intervals import AXES, Bools, Intervals
from inflight.zero_level.minimum_correlation import NAME, joint_equations

#: Averages of a set, and parts of a set whose scatter says what the set tells.
SET, _PARTS = 1440, 12
#: Fewest sets of a trend, and of a scatter.
_FEWEST = 3
_ROUNDS, _SETTLED = 60, 1e-4


@dataclass(frozen=True)
class Sets:
    """Offsets of sets, one after the other.

    Attributes
    ----------
    value : ndarray, shape (set, 3)
        nT; NaN for a set that tells not every axis within the bound.
    start, end : ndarray of int64, shape (set,)
        TT2000.
    """

    value: Floats
    start: Int64
    end: Int64

    @property
    def told(self) -> Bools:
        """Sets that tell an offset; (set,)."""
        return np.asarray(np.isfinite(self.value).all(axis=1))

    def mean(self) -> Estimate:
        """Return the mean of the sets, its covariance from their scatter.

        Raises
        ------
        CalibrationError
            Fewer than three sets tell an offset.
        """
        used = self._enough()
        value = self.value[used].mean(axis=0)
        influence = np.zeros_like(self.value)
        influence[used] = (self.value[used] - value) / used.sum()
        small = used.sum() / (used.sum() - 1)
        covariance = small * long_run_covariance(influence[used])
        reasons = (f"{int((~used).sum())} of {used.size} sets tell no offset",) if not used.all() else ()
        return Estimate(
            f"{NAME}, sets", value, covariance, np.full(3, True), influence, used, self.start, self.end,
            np.zeros((3, 3)), reasons,
        )  # fmt: skip

    def trend(self) -> SetTrend:
        """Return the line c = a t + b of each axis, t in days from the middle of the sets.

        Raises
        ------
        CalibrationError
            Fewer than three sets tell an offset.
        """
        used = self._enough()
        middle = (self.start // 2 + self.end // 2)[used]
        centre = int(round(float(np.mean(middle - middle[0])))) + int(middle[0])
        days = (middle - centre) / DAY
        columns = np.column_stack([days, np.ones_like(days)])
        values = self.value[used]
        inverse = np.linalg.inv(columns.T @ columns)
        fit = inverse @ columns.T @ values
        left = values - columns @ fit
        scatter = np.sqrt(np.sum(left**2, axis=0) / (len(values) - 2))
        error = np.sqrt(np.diag(inverse))[:, None] * scatter
        return SetTrend(fit[0], error[0], fit[1], error[1], scatter, centre, int(used.sum()))

    def _enough(self) -> Bools:
        used = self.told
        if used.sum() < _FEWEST:
            raise CalibrationError(
                f"{int(used.sum())} of {used.size} sets tell an offset, {_FEWEST} needed",
                remedy="take a longer span, or larger sets",
            )
        return used

    def table(self) -> xr.Dataset:
        """Return the values along set and parameter; sigma is the scatter of the sets."""
        scatter = np.full(3, np.nan) if self.told.sum() < 2 else np.std(self.value[self.told], axis=0, ddof=1)
        return xr.Dataset(
            {
                "value": (("set", "parameter"), self.value, {"units": "nT"}),
                "sigma": (("set", "parameter"), np.broadcast_to(scatter, self.value.shape).copy()),
                "units": ("parameter", np.array(["nT"] * 3)),
                "start": ("set", self.start, {"scale": "TT2000"}),
                "end": ("set", self.end, {"scale": "TT2000"}),
            },
            coords={"parameter": [f"offset_{axis}" for axis in AXES]},
        )


@dataclass(frozen=True)
class SetTrend:
    """c = a t + b; all (3,), and errors that take the sets as independent.

    Attributes
    ----------
    slope, sigma_slope : ndarray
        a, nT/day.
    level, sigma_level : ndarray
        b, nT, at the middle.
    scatter : ndarray
        Standard deviation of a set about the line, nT.
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
    which, first = np.unique(number, return_index=True)
    rows = [np.flatnonzero(number == one) for one in which]
    rows = [row for row in rows if row.size >= _PARTS // 2]
    value = np.array([_zero(intervals.where(row), Question(free, bound=bound)) for row in rows]).reshape(-1, 3)
    start = np.array([intervals.start[row[0]] for row in rows], dtype=np.int64)
    end = np.array([intervals.end[row[-1]] for row in rows], dtype=np.int64)
    return Sets(value, start, end)


def _zero(part: Intervals, question: Question) -> Floats:
    """Return the offset of one set; NaN when there is no zero within the bound."""
    offset, free = least_variance(part, question), np.asarray(question.free)
    for _ in range(_ROUNDS):
        scores, slopes = joint_equations(part, offset)
        # A set that tells little shows in the scatter of the sets.
        inverse, _ = informed(slopes, free, 0.0)
        step = inverse @ scores.sum(axis=0)
        offset = offset + step
        if np.abs(offset).max() >= question.bound:
            return np.full(3, np.nan)
        if np.abs(step).max() < _SETTLED:
            return offset
    return np.full(3, np.nan)
