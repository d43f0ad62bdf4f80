"""Marks of the spin: which of them to believe, and how many turns lie between them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.calibration.robust import robust_sigma
from inflight.errors import CalibrationError
from inflight.estimators.readings import SIGNIFICANCE
from inflight.spin.fine_angle import fine_period, finely_read
from inflight.time import SECOND, Int64

#: Marks are within a turn's part of whole turns: at least this (0.04 degrees: a finer mark would see the
#: spin's own wander as a fault), at most a tenth, beyond which chance meets it too often.
_FINEST, _COARSEST = 1e-4, 0.1
#: A period is stated rightly when the median interval is within this part of a turn of whole turns.
_NEAR = 0.1
#: ... and this part of the intervals is of a single turn. Else pulses are not missing but never came.
_SINGLE = 0.05
#: Neighbours on each side whose votes a mark needs, and the part of them it needs.
_LAGS, _VOTES = 4, 0.5
#: Intervals around each mark that tell the local period, on either side.
_AROUND = 21
#: Standard deviations of a count of turns that must fit into half a turn, and of a jump that is one.
_SURE = 3.0


@dataclass(frozen=True)
class Marks:
    """Believed marks in order of time.

    Attributes
    ----------
    time : ndarray of int64, shape (mark,)
        TT2000.
    turn : ndarray, shape (mark,)
        Turns since the first mark's whole turn; whole for pulses.
    rate : ndarray, shape (mark,)
        Local spin rate, turns a second.
    left : ndarray, shape (mark - 1,)
        What lies between the turns counted to the next mark and the nearest possible, turns.
    unsure : ndarray, shape (mark - 1,)
        Standard deviation of the turns predicted across the interval.
    jumped, uncounted, gap : ndarray of bool, shape (mark - 1,)
        The turns do not fit; cannot be counted; are more than one and were counted.
    moved, doubtful : ndarray of bool, shape (mark,)
        The mark's turn is taken back by the size of a jump; a jump leaves it in doubt. See `steadied`.
    sigma : float
        Scatter of a mark, turns.
    dropped : int
        Marks dropped because they repeat another's turn.
    """

    time: Int64
    turn: Floats
    rate: Floats
    left: Floats
    unsure: Floats
    jumped: npt.NDArray[np.bool_]
    uncounted: npt.NDArray[np.bool_]
    gap: npt.NDArray[np.bool_]
    moved: npt.NDArray[np.bool_]
    doubtful: npt.NDArray[np.bool_]
    sigma: float
    dropped: int

    @property
    def period(self) -> Floats:
        """Local spin period, s; (mark,)."""
        return np.asarray(1.0 / self.rate)

    @property
    def missing(self) -> int:
        """Number of whole turns without a mark, where they could be counted."""
        return int(self.lacking.sum())

    @property
    def lacking(self) -> Int64:
        """Whole turns without a mark in each interval, 0 where they cannot be counted; (mark - 1,)."""
        lacking = np.maximum(np.rint(np.diff(self.turn)) - 1, 0)
        return np.where(self.uncounted, 0, lacking).astype(np.int64)

    def table(self) -> xr.Dataset:
        """Return `value` (the local period) and `sigma` along ``mark``."""
        last = [False]
        return xr.Dataset(
            {
                "time": ("mark", self.time, {"scale": "TT2000"}),
                "turn": ("mark", self.turn, {"units": "1"}),
                "value": ("mark", self.period, {"units": "s"}),
                "sigma": ("mark", self.sigma * self.period * np.sqrt(2.0 / _AROUND), {"units": "s"}),
                "jump_behind": ("mark", np.append(np.where(self.jumped, 360.0 * self.left, 0.0), 0.0)),
                "bridged_behind": ("mark", np.append(self.gap, last)),
                "uncounted_behind": ("mark", np.append(self.uncounted, last)),
            },
            attrs={"scatter_deg": 360.0 * self.sigma, "missing": self.missing},
        )


def usual_period(seconds: Floats, turns: Floats, nominal: float | None) -> float:
    """Return the period that most intervals show, s.

    Parameters
    ----------
    seconds, turns : ndarray, shape (mark,)
        Times, and parts of a turn in [0, 1); 0 for pulses.
    nominal : float, optional
        Stated period, s; it says only how many turns an interval may have.

    Raises
    ------
    CalibrationError
        When the angle is read too slowly to say anything against a stated period that does not fit, when it
        falls or stands still, or when none is stated for it.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    angle = bool(np.any(turns > 0))
    if angle and (nominal is None or not nominal > 0):
        raise CalibrationError(
            "an angle is given without a spin period, and may have made any number of turns between readings",
            remedy="state the spin period to better than a tenth of a turn between readings",
        )
    if angle and nominal is not None:
        fine = fine_period(seconds, turns, nominal)
        if fine is not None and 0.0 < fine < np.inf:
            return fine
        if fine is not None:
            raise CalibrationError(
                f"the angle, read every {np.median(apart):.4g} s, does not grow by turns of {nominal:.6g} s",
                remedy="see whether it stands still, or is counted from XA to XP",
            )
    if nominal is not None and nominal > 0:
        advance = np.rint(apart / nominal - part) + part
        left = apart / nominal - advance
        counted = advance > 0.25
        single = np.mean((advance < 1.5) & (np.abs(left) < _NEAR))
        near = counted & (np.abs(left) < _NEAR)
        if near.any() and np.median(np.abs(left)) < _NEAR and (angle or single > _SINGLE):
            return float(np.median(apart[near] / advance[near]))
    if not angle:
        return float(np.median(apart))
    # Read more than twice a turn, an angle moves on by less than half a turn each time.
    step = part % 1.0
    if nominal is None or not np.median(apart) < 0.5 * nominal or not 0.0 < np.median(step) < 0.5:
        raise CalibrationError(
            f"the angle is read every {np.median(apart):.4g} s, and turns of {nominal:.6g} s do not fit it",
            remedy="state the spin period to better than a tenth of a turn between readings",
        )
    return float(np.median(apart[step > 0] / step[step > 0]))


def believed(seconds: Floats, turns: Floats, period: float) -> npt.NDArray[np.bool_]:
    """Return which marks are whole turns from at least half of their neighbours before, or of those after.

    One side is enough: after a jump of the phase the marks agree among themselves.
    """
    rate = _local_rate(seconds, turns, period)
    tolerance = _tolerance(_scatter(seconds, turns, rate))
    votes, asked = np.zeros((2, seconds.size)), np.zeros((2, seconds.size))
    for lag in range(1, min(_LAGS, seconds.size - 1) + 1):
        ahead = (seconds[lag:] - seconds[:-lag]) * 0.5 * (rate[lag:] + rate[:-lag])
        left = ahead - (turns[lag:] - turns[:-lag])
        near = np.abs(left - np.rint(left)) < tolerance
        for side, part in enumerate((slice(lag, None), slice(None, -lag))):
            votes[side, part] += near
            asked[side, part] += 1
    return np.asarray(np.any((votes >= _VOTES * asked) & (asked > 0), axis=0))


def count_turns(times: Int64, turns: Floats, period: float) -> Marks:
    """Return the marks with their turns counted, and where these do not fit.

    Across an interval the rate is the mean of those before and after it; half their difference and the
    scatter of the marks say how sure the count is. A finely read angle must be thinned before: marks
    nearer than a tenth of a turn repeat one another.

    Raises
    ------
    CalibrationError
        When all marks are of one turn.
    """
    if times.size < 2:
        raise CalibrationError("all marks are of one turn", remedy="take a longer span")
    seconds = (times - times[0]) / SECOND
    rate = _local_rate(seconds, turns, period)
    advance = _advance(seconds, turns, rate)
    repeated = np.concatenate([[False], advance < _NEAR])
    if repeated.any():
        rest = count_turns(times[~repeated], turns[~repeated], period)
        return Marks(**(rest.__dict__ | {"dropped": rest.dropped + int(repeated.sum())}))
    apart = np.diff(seconds)
    before, after = _sides(rate)
    sigma = _scatter(seconds, turns, rate)
    error = np.hypot(0.5 * np.abs(after - before), sigma * rate.mean() * np.sqrt(2.0 / _AROUND))
    unsure = error * apart
    left = 0.5 * (before + after) * apart - advance
    uncounted = _SURE * unsure > 0.5
    jumped = ~uncounted & (np.abs(left) > _tolerance(sigma) + _SURE * unsure)
    turn = turns[0] + np.concatenate([[0.0], np.cumsum(advance)])
    ends = np.stack([np.append(before, after[-1]), np.append(before[0], after)])
    gap = (advance > 1.5) & ~jumped & ~uncounted
    none = np.zeros(turn.size, dtype=bool)
    return Marks(times, turn, ends.mean(axis=0), left, unsure, jumped, uncounted, gap, none, none, sigma, 0)


def steadied(marks: Marks) -> Marks:
    """Return marks of a turn without jumps, as far as they tell which of them to believe.

    A body that spins goes on turning as it did: what jumps is the clock of its marks, or the mark. Marks
    between jumps that come back to where they were are taken back by the size of the jumps. Where they do
    not come back, nothing tells which side is right: all marks of the stretch are in doubt. Stretches end
    where turns cannot be counted.
    """
    if not marks.jumped.any():
        return marks
    turn, moved, doubtful = marks.turn.copy(), marks.moved.copy(), marks.doubtful.copy()
    starts = np.concatenate([[0], np.flatnonzero(marks.uncounted) + 1])
    for first, last in zip(starts, [*starts[1:], turn.size], strict=True):
        inside = slice(first, last - 1)
        jumped = marks.jumped[inside]
        off = np.concatenate([[0.0], np.cumsum(np.where(jumped, marks.left[inside], 0.0))])
        error = np.hypot.reduce(np.where(jumped, marks.unsure[inside], 0.0))
        near = _tolerance(marks.sigma) * np.sqrt(max(jumped.sum(), 1)) + _SURE * error
        away = np.abs(off - np.rint(off)) > near
        if away.size and away[-1]:
            doubtful[first:last] = True
        else:
            turn[first:last] += off
            moved[first:last] = away
    return replace(marks, turn=turn, moved=moved, doubtful=doubtful)


def _advance(seconds: Floats, turns: Floats, rate: Floats) -> Floats:
    """Return the turns from each mark to the next; (mark - 1,)."""
    before, after = _sides(rate)
    part = np.diff(turns)
    return np.asarray(np.rint(0.5 * (before + after) * np.diff(seconds) - part) + part)


def _local_rate(seconds: Floats, turns: Floats, period: float) -> Floats:
    """Return the rate around each mark by the median of the intervals of few turns; turns a second.

    The short intervals of a fine angle tell none: those of them above a quarter turn are misread.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    advance = np.rint(apart / period - part) + part
    usual = max(float(np.median(advance)), 1.0)
    near = (advance > 0.25) & (advance < 3.0 * usual) & (np.abs(apart / period - advance) < _COARSEST)
    if not near.any() or finely_read(apart, turns, advance):
        return np.full(seconds.size, 1.0 / period)
    middle = 0.5 * (seconds[1:] + seconds[:-1])[near]
    rates = median_filter(advance[near] / apart[near], min(_AROUND, int(near.sum())), mode="nearest")
    return np.asarray(np.interp(seconds, middle, rates))


def _sides(rate: Floats) -> tuple[Floats, Floats]:
    """Return the rate before and after each interval, from medians that do not reach over it; (mark - 1,)."""
    reach = _AROUND // 2
    place = np.arange(rate.size - 1)
    return rate[np.maximum(place - reach, 0)], rate[np.minimum(place + 1 + reach, rate.size - 1)]


def _scatter(seconds: Floats, turns: Floats, rate: Floats) -> float:
    """Return the scatter of a mark, turns, from the intervals between neighbours."""
    left = np.diff(seconds) * 0.5 * (rate[1:] + rate[:-1]) - np.diff(turns)
    left -= np.rint(left)
    close = np.abs(left) < _COARSEST
    return robust_sigma(left[close]) / np.sqrt(2.0) if close.any() else _COARSEST


def _tolerance(sigma: float) -> float:
    return float(np.clip(SIGNIFICANCE * np.sqrt(2.0) * sigma, _FINEST, _COARSEST))
