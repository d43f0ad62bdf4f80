"""Spans of days on which a clock was wrong, found in daily estimates of the time shift (Yin 2010, ch. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import stats

from inflight.arrays import Floats
from inflight.calibration.robust import robust_sigma
from inflight.errors import CalibrationError

#: Days on either side that say what the shift usually is, and the fewest of them.
_AROUND, _FEWEST = 45, 10
#: Chance that a mission without a fault is told to have one.
FALSE_ALARM = 0.01
#: Longest fault that is looked for, days: a longer one is the usual state.
LONGEST = 30
#: A day this many sigmas off is off by itself.
_LOUD = 6.0


@dataclass(frozen=True)
class ClockFault:
    """Days first to last (MJD, whole days, inclusive), how far the clock was off (s), sigma, significance."""

    first: int
    last: int
    shift: float
    sigma: float
    z: float


@dataclass(frozen=True)
class ClockFaults:
    """All faults of a mission.

    Attributes
    ----------
    faults : tuple of ClockFault
        In order of time.
    usual, scatter : ndarray, shape (day,)
        What the shift usually is around each day, and the standard deviation of a day about it, s.
    mjd : ndarray, shape (day,)
        Middles of the days.
    limit : float
        Significance beyond which a span is a fault.
    """

    faults: tuple[ClockFault, ...]
    usual: Floats
    scatter: Floats
    mjd: Floats
    limit: float

    def told(self) -> list[str]:
        """Say each fault in a sentence."""
        return [
            f"MJD {one.first} to {one.last}: the time shift is off by {1e3 * one.shift:.2f} +- "
            f"{1e3 * one.sigma:.2f} ms"
            for one in self.faults
        ]

    def table(self) -> xr.Dataset:
        """Return the faults: dim fault; `value` s."""
        rows = self.faults
        return xr.Dataset(
            {
                "value": ("fault", np.array([one.shift for one in rows])),
                "sigma": ("fault", np.array([one.sigma for one in rows])),
                "units": ("fault", np.full(len(rows), "s")),
                "first": ("fault", np.array([one.first for one in rows], dtype=np.int64), {"units": "MJD"}),
                "last": ("fault", np.array([one.last for one in rows], dtype=np.int64), {"units": "MJD"}),
                "z": ("fault", np.array([one.z for one in rows])),
            },
            attrs={"told": "; ".join(self.told()), "limit": self.limit},
        )


def clock_faults(mjd: Floats, shift: Floats, sigma: Floats, longest: int = LONGEST) -> ClockFaults:
    """Find spans of days whose time shift stands out from what it is around them.

    Every span of 1 to `longest` days is held against the median of the days around, and its significance
    against that of all spans of its length; the most significant is taken, its days are left out, and so on,
    while noise would make one like it in one mission of a hundred.

    Parameters
    ----------
    mjd : ndarray, shape (day,)
        Middles of the days, rising.
    shift, sigma : ndarray, shape (day,)
        Daily estimates of the time shift and their standard deviations, s; NaN in gaps.
    longest : int
        Days.

    Raises
    ------
    CalibrationError
        When fewer than ten days have an estimate.
    """
    known = np.flatnonzero(np.isfinite(shift) & np.isfinite(sigma) & (sigma > 0))
    if known.size < _FEWEST:
        raise CalibrationError(
            f"{known.size} days have a time shift, {_FEWEST} are needed", remedy="use a longer span"
        )
    limit = float(stats.norm.isf(0.5 * FALSE_ALARM / (known.size * longest)))
    t, y, own = mjd[known], shift[known], sigma[known]
    free = np.ones(t.size, dtype=bool)
    faults: list[ClockFault] = []
    while True:
        usual = _usual(t, y, free)
        scatter = _scatter(y - usual, own, free)
        found = _strongest((y - usual) / scatter, t, free, longest)
        if found is None or abs(found[2]) < limit:
            break
        days = slice(found[0], found[1] + 1)
        faults.append(_fault(t[days], (y - usual)[days], scatter[days], found[2]))
        free[days] = False
    whole = [np.full(mjd.size, np.nan) for _ in range(2)]
    for series, values in zip(whole, (usual, scatter), strict=True):
        series[known] = values
    ordered = tuple(sorted(faults, key=lambda one: one.first))
    return ClockFaults(ordered, whole[0], whole[1], mjd, limit)


def _usual(days: Floats, value: Floats, free: np.ndarray) -> Floats:
    """Return the median of the free days around each; (day,)."""
    base, series = days[free], value[free]
    whole = float(np.median(series))
    low, high = np.searchsorted(base, days - _AROUND), np.searchsorted(base, days + _AROUND, side="right")
    return np.array(
        [np.median(series[a:b]) if b - a >= _FEWEST else whole for a, b in zip(low, high, strict=True)]
    )


def _scatter(left: Floats, own: Floats, free: np.ndarray) -> Floats:
    """Return the standard deviation of a day about the usual: the stated one, widened to the days' own."""
    return np.asarray(own * robust_sigma(left[free] / own[free], floor=1.0))


def _strongest(z: Floats, days: Floats, free: np.ndarray, longest: int) -> tuple[int, int, float] | None:
    """Return first, last and significance of the most significant span of free days."""
    best: tuple[int, int, float] | None = None
    sums = np.concatenate([[0.0], np.cumsum(np.where(free, z, 0.0))])
    taken = np.concatenate([[0], np.cumsum(~free)])
    noisy = np.concatenate([[0], np.cumsum(np.abs(z) > _LOUD)])
    for length in range(1, min(longest, z.size // 2) + 1):
        score = (sums[length:] - sums[:-length]) / np.sqrt(length)
        whole = (taken[length:] == taken[:-length]) & (
            days[length - 1 :] - days[: z.size - length + 1] < longest
        )
        # Shifts that wander make long spans scatter more than their days do; spans with a day that is itself
        # far off tell of no wander.
        calm = np.abs(score[whole & (noisy[length:] == noisy[:-length])])
        usual = robust_sigma(calm) if calm.size >= _FEWEST else 1.0
        score = np.where(whole, score / max(usual, 1.0), 0.0)
        at = int(np.argmax(np.abs(score)))
        if best is None or abs(score[at]) > abs(best[2]):
            best = (at, at + length - 1, float(score[at]))
    return best


def _fault(days: Floats, left: Floats, scatter: Floats, z: float) -> ClockFault:
    weight = 1.0 / scatter**2
    shift = float(np.sum(weight * left) / weight.sum())
    first, last = int(np.floor(days[0])), int(np.floor(days[-1]))
    return ClockFault(first, last, shift, float(1.0 / np.sqrt(weight.sum())), z)
