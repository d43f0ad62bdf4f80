"""Switchings that no channel follows: jumps of the difference of two sensors beside those of housekeeping.

A unit without housekeeping that switches is no noise. Its field stands for an hour, in the difference and in
the reading that the difference is calibrated against, so that everything fitted beside it is wrong by more
than its scatter tells. What switches together with a channel is told by the sizes: steps are regressed on the
changes of the channels, robustly, and one that disagrees is unexplained, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.dual.jumps import Places, find_jumps
from inflight.dual.readings import white_covariance
from inflight.time import Int64

#: Rows of a mean on either side of a jump, at most; jumps this near to each other are one.
_WIDTH, _ONE = 8, 2
#: A channel changes at a jump when it moves by so many of its usual changes and this part of its range.
_CHANGED, _PART = 8.0, 0.02
#: Jumps at which a channel must change to be regressed on, and scatters beyond which a step disagrees.
_FEWEST, _DISAGREES = 3, 6.0
#: Turns of the robust fit, and residuals (in scatters) that count half.
_TURNS, _HALF = 40, 2.0
#: Median of the length of a vector of three components of unit variance.
_MEDIAN_LENGTH = 1.5382
#: Steps belong to one unit when they agree within so many scatters, or this part of their size.
_LIKE, _LIKE_PART = 6.0, 0.05


@dataclass(frozen=True)
class Switched:
    """Switchings that a difference shows.

    Attributes
    ----------
    last, first : ndarray of int64, shape (switching,)
        TT2000 of the last row before it and the first one after that know nothing of it; where channels
        follow, of these, too.
    follows : ndarray of bool, shape (switching,)
        Whether changes of channels explain it.
    step : ndarray, shape (switching, axis)
        What the channels do not explain of the step of the difference, nT.
    scatter : float
        Of a component of the steps that channels explain, nT.
    """

    last: Int64
    first: Int64
    follows: npt.NDArray[np.bool_]
    step: Floats
    scatter: float

    @property
    def unexplained(self) -> int:
        """Number of switchings that no channel follows."""
        return int(np.count_nonzero(~self.follows))

    @property
    def units(self) -> list[tuple[Floats, Floats, int]]:
        """Return step, standard deviation and number of switchings of each unit, the busiest first.

        A unit switches on and off by the same vector; its sign is that which makes the largest component
        positive.
        """
        left = np.flatnonzero(~self.follows)
        out = []
        while left.size:
            near = [_like(self.step[left], self.step[one], self.scatter) for one in left]
            signs = max(near, key=lambda sign: int(np.count_nonzero(sign)))
            own = (self.step[left] * signs[:, None])[signs != 0]
            mean = np.median(own, axis=0)
            mean = mean * np.sign(mean[np.argmax(np.abs(mean))])
            spread = TO_SIGMA * np.median(np.abs(own - np.median(own, axis=0)), axis=0)
            # A median is a little less sure than a mean.
            sigma = np.maximum(spread, self.scatter) * np.sqrt(np.pi / 2.0 / len(own))
            out.append((mean, sigma, len(own)))
            left = left[signs == 0]
        return out


def _like(steps: Floats, one: Floats, scatter: float) -> Floats:
    """Return +1 or -1 for steps that are one step or its negative, 0 for others; (step,)."""
    limit = max(_LIKE * scatter, _LIKE_PART * float(np.linalg.norm(one)))
    up, down = (np.linalg.norm(steps - sign * one, axis=1) < limit for sign in (1.0, -1.0))
    return np.where(up, 1.0, np.where(down, -1.0, 0.0))


def switched(
    stamps: Int64, difference: Floats, channels: Mapping[str, Floats], reach: Mapping[str, int]
) -> Switched | None:
    """Return the jumps of a difference, and which of them channels explain; None when there are none.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, increasing; of rows in which both sensors are known.
    difference : ndarray, shape (time, axis)
        nT, one frame, finite.
    channels : mapping of str to ndarray, shape (time,)
        Housekeeping on the same rows; NaN where it is missing.
    reach : mapping of str to int
        Rows that a step of each channel is spread over.
    """
    places, _ = find_jumps(difference)
    if not places.size:
        return None
    first, last = _joined(places)
    step, rows = _steps(difference, first, last)
    changes = {name: _changes(channels[name], first, last, reach[name]) for name in sorted(channels)}
    names = [name for name, one in changes.items() if np.count_nonzero(one[0]) >= _FEWEST]
    used = [changes[name] for name in names]
    change = np.stack([one[0] for one in used], axis=1) if used else np.zeros((first.size, 0))
    white = np.sqrt(np.trace(white_covariance(difference)) / 3.0)
    # A step's own noise at least: where all steps agree by chance there is no smaller scatter.
    least = float(white * np.sqrt(2.0 / np.median(rows)))
    left, scatter = _regressed(step, change, np.array([one[1] for one in used]), least)
    follows = np.linalg.norm(left, axis=1) <= _DISAGREES * scatter
    spread = 1 + max((reach[name] for name in names), default=0) * follows
    before, after = np.maximum(first - spread, 0), np.minimum(last + spread - 1, stamps.size - 1)
    return Switched(stamps[before], stamps[after], follows, left, float(np.median(scatter)))


def _joined(places: Places) -> tuple[Places, Places]:
    """Return the first and the last of jumps that are too near to be told apart."""
    edges = np.flatnonzero(np.diff(places) > _ONE) + 1
    return places[np.concatenate([[0], edges])], places[np.concatenate([edges - 1, [places.size - 1]])]


def _steps(values: Floats, first: Places, last: Places) -> tuple[Floats, Floats]:
    """Return mean after less mean before, the rows next to a jump left out, and the rows of the shorter."""
    ends = np.concatenate([[0], last + 1])[:-1]
    begins = np.concatenate([first, [len(values)]])[1:]
    step, rows = np.zeros((first.size, values.shape[1])), np.ones(first.size)
    for one in range(first.size):
        low, high = max(int(first[one]) - 1, 1), min(int(last[one]) + 1, len(values) - 1)
        before = values[max(int(ends[one]), low - _WIDTH, 0) : low]
        after = values[high : min(int(begins[one]), high + _WIDTH)]
        before = before if len(before) else values[low - 1 : low]
        after = after if len(after) else values[high : high + 1]
        step[one] = after.mean(axis=0) - before.mean(axis=0)
        rows[one] = min(len(before), len(after))
    return step, rows


def _changes(values: Floats, first: Places, last: Places, reach: int) -> tuple[Floats, float]:
    """Return the change of a channel across each jump, 0 where it is no more than elsewhere or unknown.

    With it comes the size of its usual change, one sigma.
    """
    top = values.size - 1
    change = values[np.minimum(last + reach, top)] - values[np.maximum(first - 1 - reach, 0)]
    known = values[np.isfinite(values)]
    width = int(np.median(last - first)) + 1 + 2 * reach
    if known.size < 2 * width + 2:
        return np.zeros(first.size), 0.0
    usual = TO_SIGMA * float(np.median(np.abs(known[width:] - known[:-width])))
    limit = max(_CHANGED * usual, _PART * float(np.ptp(known)))
    return np.where(np.isfinite(change) & (np.abs(change) > limit), change, 0.0), usual


def _regressed(step: Floats, change: Floats, usual: Floats, least: float) -> tuple[Floats, Floats]:
    """Return what changes of channels leave of steps (robust fit), and the scatter of a component of each.

    Parameters
    ----------
    step : ndarray, shape (jump, axis)
    change : ndarray, shape (jump, channel)
    usual : ndarray, shape (channel,)
        Noise of such a change.
    least : float
        Scatter of a component at least, nT.
    """
    takes: npt.NDArray[np.bool_] = np.asarray((change != 0).any(axis=1))
    alone = np.full(len(step), least)
    if np.count_nonzero(takes) <= change.shape[1]:
        return step, alone
    x, y = change[takes] / np.abs(change).max(axis=0), step[takes]
    weight, scatter, slope = np.ones(len(x)), least, np.zeros((x.shape[1], 3))
    for turn in range(_TURNS):
        slope = np.linalg.lstsq(x * weight[:, None], y * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(y - x @ slope, axis=1)
        scatter = max(float(np.median(size)) / _MEDIAN_LENGTH, least)
        # Least absolute lengths first, which no start misleads; then what lies near.
        root = size / scatter if turn < _TURNS // 2 else 1.0 + (size / (_HALF * scatter)) ** 2
        weight = 1.0 / np.sqrt(np.maximum(root, 1e-2))
    left = step.copy()
    left[takes] = y - x @ slope
    # A channel's own noise, read into nT, is part of what is left where it changes.
    read = usual / np.abs(change).max(axis=0) * np.linalg.norm(slope, axis=1)
    noise = np.sqrt(scatter**2 + ((change != 0) @ read**2) / 3.0)
    return left, np.where(takes, noise, alone)
