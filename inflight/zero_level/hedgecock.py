"""Minimum correlation one axis after the other, as Hedgecock (1975) and the tests on IMP-8 and Helios did it.

V(c) = cov(dB, dtheta) of successive averages as a function of a correction c along one axis, theta the angle
*from* that axis; its zero is the correction. Pairs with both angles between 30 and 150 degrees are used, the
same ones while c varies. V also vanishes at large c: c is bounded, and the zero nearest to the present
correction is taken. Taking the axes in turn creeps when the direction varies little: the joint form
(`inflight.zero_level.minimum_correlation`) does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.zero_level.intervals import FEWEST_SAMPLES, Bools

#: Angles from the axis, degrees.
NEAREST, FARTHEST = 30.0, 150.0
#: Points of V(c), and a round that moves less than this ends it, nT.
_POINTS, _SETTLED = 41, 1e-3


@dataclass(frozen=True)
class AxisInTurn:
    """Corrections round by round.

    Attributes
    ----------
    value : ndarray, shape (3,)
        Offset, nT; NaN along an axis without a zero.
    history : ndarray, shape (round, 3)
        After each round.
    settled : bool
        The last round moved less than 1e-3 nT, and every axis has a zero.
    crossings : ndarray of int, shape (3,)
        Zeros of V within the bound in the last round; more than one is ambiguous.
    pairs : ndarray of int, shape (3,)
        Pairs used in the last round.
    """

    value: Floats
    history: Floats
    settled: bool
    crossings: np.ndarray
    pairs: np.ndarray


def angles_from(field: Floats, axis: int) -> Floats:
    """Return the angle of the field from an axis, radians; field (..., 3)."""
    other = [one for one in range(3) if one != axis]
    return np.arctan2(np.hypot(field[..., other[0]], field[..., other[1]]), field[..., axis])


def pairs_within(field: Floats, axis: int, joined: Bools) -> Bools:
    """Return pairs (time - 1,) whose both directions are 30 to 150 degrees from an axis."""
    angle = np.degrees(angles_from(field, axis))
    inside = (angle > NEAREST) & (angle < FARTHEST)
    return np.asarray(inside[1:] & inside[:-1] & joined)


def correlation(field: Floats, axis: int, corrections: Floats, pairs: Bools) -> Floats:
    """Return V(c) = cov(dB, dtheta), nT rad, for corrections (c,) taken off along an axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
    pairs : ndarray of bool, shape (time - 1,)
    """
    first, second = field[:-1][pairs], field[1:][pairs]
    shift = np.zeros((corrections.size, 1, 3))
    shift[:, 0, axis] = corrections
    first, second = first - shift, second - shift
    change = np.linalg.norm(second, axis=2) - np.linalg.norm(first, axis=2)
    turn = angles_from(second, axis) - angles_from(first, axis)
    centred = change - change.mean(axis=1, keepdims=True)
    return np.asarray(np.mean(centred * turn, axis=1))


def axis_in_turn(
    field: Floats,
    joined: Bools | None = None,
    *,
    bound: float = 3.0,
    rounds: int = 10,
    axes: tuple[int, ...] = (0, 1, 2),
) -> AxisInTurn:
    """Find the corrections axis by axis.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Successive averages, nT; NaN where missing. 1440 of them are usual.
    joined : ndarray of bool, shape (time - 1,), optional
        Pairs without a gap between.
    bound : float
        Largest correction a round may make, nT.
    rounds : int
        At least 1.
    axes : tuple of int

    Raises
    ------
    CalibrationError
        Too few pairs.
    """
    there = np.asarray(np.isfinite(field).all(axis=1))
    pairs_there = there[1:] & there[:-1]
    joined = np.asarray(pairs_there if joined is None else pairs_there & joined)
    offset, history = np.zeros(3), []
    crossings, used = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    settled, lacking = False, np.zeros(3, dtype=np.bool_)
    for _ in range(rounds):
        before = offset.copy()
        for axis in axes:
            pairs = pairs_within(field - offset, axis, joined)
            used[axis] = pairs.sum()
            if pairs.sum() < FEWEST_SAMPLES:
                raise CalibrationError(
                    f"{int(pairs.sum())} pairs 30 to 150 degrees from axis {axis}, {FEWEST_SAMPLES} needed",
                    remedy="take a longer span, or another axis",
                )
            step, crossings[axis] = _zero(field - offset, axis, pairs, bound)
            # The other axes go on beside the correction that this one has so far.
            lacking[axis] = not np.isfinite(step)
            offset[axis] += 0.0 if lacking[axis] else step
        history.append(np.where(lacking, np.nan, offset))
        if np.abs(offset - before).max() < _SETTLED:
            settled = not lacking.any()
            break
    return AxisInTurn(history[-1], np.array(history), settled, crossings, used)


def _zero(field: Floats, axis: int, pairs: Bools, bound: float) -> tuple[float, int]:
    """Return the zero of V nearest to 0 and how many there are within the bound."""
    grid = np.linspace(-bound, bound, _POINTS)
    v = correlation(field, axis, grid, pairs)
    where = np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)
    if not where.size:
        return float("nan"), 0
    place = where[np.argmin(np.abs(grid[where]))]
    low, high = grid[place], grid[place + 1]
    fine = np.linspace(low, high, _POINTS)
    v = correlation(field, axis, fine, pairs)
    at = int(np.flatnonzero(np.sign(v[1:]) * np.sign(v[:-1]) <= 0)[0])
    share = v[at] / (v[at] - v[at + 1]) if v[at] != v[at + 1] else 0.0
    return float(fine[at] + share * (fine[at + 1] - fine[at])), int(where.size)
