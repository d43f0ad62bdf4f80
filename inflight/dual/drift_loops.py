"""Compiled steps of the drift filter, and the assignment of segments to states that it goes along with.

Records of thousands of segments are gone through hundreds of times, with matrices of two and of three rows:
arrays of numpy would cost a hundred times their arithmetic. `segments.DriftFilter` and `states.find_states`
say what is done here.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: A symmetric matrix of three rows as ``L D L^T``: the three of D, then L's second row, first, and third row.
_Factors = tuple[float, float, float, float, float, float]


class Drift(NamedTuple):
    """The common drift and its rates, each axis for itself; the first three change from step to step.

    Attributes
    ----------
    value, slope : ndarray, shape (axis,)
        nT, nT/s.
    covariance : ndarray, shape (axis, 2, 2)
        Of value and slope.
    most_slope, slope_walk, level_walk : ndarray, shape (axis,)
        Bound of the slope's variance, nT^2/s^2; rates of variance of slope, nT^2/s^3, and value, nT^2/s.
    """

    value: Floats
    slope: Floats
    covariance: Floats
    most_slope: Floats
    slope_walk: Floats
    level_walk: Floats


class SegmentTable(NamedTuple):
    """What of segments the loops use.

    Attributes
    ----------
    head_mean, tail_mean, head_slope, tail_slope : ndarray, shape (segment, axis)
        nT, nT/s.
    slope_variance : ndarray, shape (segment, axis)
        nT^2/s^2.
    covariance, own : ndarray, shape (segment, axis, axis)
        Of the noise of the means, and of what is the segment's own, nT^2.
    seconds : ndarray, shape (segment,)
        Between the middles of both ends.
    gap : ndarray, shape (segment,)
        From the steady segment before to this one, between the middles of these ends, s.
    """

    head_mean: Floats
    tail_mean: Floats
    head_slope: Floats
    tail_slope: Floats
    slope_variance: Floats
    covariance: Floats
    own: Floats
    seconds: Floats
    gap: Floats


class Found(NamedTuple):
    """What the assignment fills in.

    Attributes
    ----------
    centre, covariance : ndarray, shape (state, axis) and (state, axis, axis)
        With room for one state a segment.
    label : ndarray of int64, shape (segment,)
    drift, drift_end : ndarray, shape (segment, axis)
    drift_covariance : ndarray, shape (segment, axis, axis)
    confusion : ndarray, shape (segment,)
    """

    centre: Floats
    covariance: Floats
    label: npt.NDArray[np.int64]
    drift: Floats
    drift_end: Floats
    drift_covariance: Floats
    confusion: Floats


@numba.njit(cache=True, nogil=True, error_model="numpy")
def predict(drift: Drift, seconds: float) -> None:  # pragma: no cover
    """Advance the time without an observation."""
    for k in range(3):
        c = drift.covariance[k]
        drift.value[k] += seconds * drift.slope[k]
        walk = drift.slope_walk[k] * seconds
        upper, lower = c[0, 1] + seconds * c[1, 1], c[1, 0] + seconds * c[1, 1]
        c[0, 0] = (c[0, 0] + seconds * c[1, 0]) + seconds * upper
        c[0, 0] += drift.level_walk[k] * seconds + walk * seconds**2 / 3.0
        # The variance of the slope is bounded by that of usual slopes, however long the gap.
        free = c[1, 1] + walk
        known = min(free, drift.most_slope[k])
        # Value and slope keep their correlation: else the matrix would not stay positive, and the drift
        # would run away.
        correlated = np.sqrt(known / free) if free > 0.0 else 1.0
        c[0, 1] = (upper + walk * seconds / 2.0) * correlated
        c[1, 0] = (lower + walk * seconds / 2.0) * correlated
        c[1, 1] = known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def observe(drift: Drift, which: int, innovation: Floats, variance: Floats) -> None:  # pragma: no cover
    """Update with the value (0) or the slope (1), observed with an error.

    Parameters
    ----------
    innovation : ndarray, shape (axis,)
        Observed less expected.
    variance : ndarray, shape (axis,)
        Of the innovation; without effect where it is not positive.
    """
    for k in range(3):
        if not variance[k] > 0.0:
            continue
        c = drift.covariance[k]
        first, second = c[0, which] / variance[k], c[1, which] / variance[k]
        drift.value[k] += first * innovation[k]
        drift.slope[k] += second * innovation[k]
        one, other = c[which, 0], c[which, 1]
        c[0, 0] -= first * one
        c[0, 1] -= first * other
        c[1, 0] -= second * one
        c[1, 1] -= second * other


@numba.njit(cache=True, nogil=True, error_model="numpy")
def observe_slope(drift: Drift, slope: Floats, variance: Floats) -> None:  # pragma: no cover
    """Update with the slope within a segment (axis,), nT/s, and the variance of its noise."""
    innovation, total = np.empty(3), np.empty(3)
    for k in range(3):
        innovation[k], total[k] = slope[k] - drift.slope[k], drift.covariance[k, 1, 1] + variance[k]
    observe(drift, 1, innovation, total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cross_segment(
    drift: Drift, seconds: float, change: Floats, noise: Floats, slope: Floats, slope_variance: Floats
) -> None:  # pragma: no cover
    """Go from a segment's beginning to its end, between which the drift itself is observed.

    Parameters
    ----------
    change, noise : ndarray, shape (axis,)
        From head to tail, nT, and the variance of its noise.
    slope, slope_variance : ndarray, shape (axis,)
        At the tail.
    """
    if not seconds > 0.0:
        return
    known, value = np.empty(3), np.empty(3)
    for k in range(3):
        known[k], value[k] = drift.covariance[k, 0, 0], drift.value[k]
    predict(drift, seconds)
    for k in range(3):
        c = drift.covariance[k]
        predicted = max(c[0, 0] - known[k], 0.0)
        gain = predicted / max(predicted + noise[k], 1e-300)
        drift.value[k] += gain * (change[k] - (drift.value[k] - value[k]))
        c[0, 0] = known[k] + gain * noise[k]
        c[0, 1] = c[1, 0] = 0.0
    observe_slope(drift, slope, slope_variance)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _factors(m: Floats, n: Floats) -> _Factors:  # pragma: no cover
    """Return the sum of two symmetric matrices (3, 3) as ``L D L^T``."""
    d0, s10, s20 = m[0, 0] + n[0, 0], m[1, 0] + n[1, 0], m[2, 0] + n[2, 0]
    l10, l20 = s10 / d0, s20 / d0
    d1 = m[1, 1] + n[1, 1] - l10 * s10
    l21 = (m[2, 1] + n[2, 1] - l20 * s10) / d1
    return d0, d1, m[2, 2] + n[2, 2] - l20 * s20 - l21 * l21 * d1, l10, l20, l21


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_determinant(f: _Factors) -> float:  # pragma: no cover
    """Return the logarithm of the determinant's size."""
    return float(np.log(abs(f[0])) + np.log(abs(f[1])) + np.log(abs(f[2])))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _solve(f: _Factors, x: float, y: float, z: float) -> tuple[float, float, float]:  # pragma: no cover
    """Return what the matrix takes to a vector."""
    y -= f[3] * x
    z -= f[4] * x + f[5] * y
    z /= f[2]
    y = y / f[1] - f[5] * z
    return x / f[0] - f[3] * y - f[4] * z, y, z


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distance(f: _Factors, place: Floats, centre: Floats) -> float:  # pragma: no cover
    """Return the squared distance of a place (3,) from a centre (3,) in units of its errors."""
    a, b, c = place[0] - centre[0], place[1] - centre[1], place[2] - centre[2]
    x, y, z = _solve(f, a, b, c)
    return float(a * x + b * y + c * z)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _choose(distance: Floats, cost: Floats, limit: float, nearest: float) -> int:  # pragma: no cover
    """Return the state of the lowest cost that is near enough.

    Far beyond its noise a wide state must not win by its width alone.
    """
    state, least = 0, np.inf
    for one in range(distance.size):
        if distance[one] <= max(limit, nearest) and cost[one] < least:
            state, least = one, cost[one]
    return state


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _doubt(cost: Floats, state: int, anywhere: float) -> float:  # pragma: no cover
    """Return the probability that another state is right, or a new one, which could lie anywhere."""
    least, total = anywhere, 0.0
    for one in range(cost.size):
        least = min(least, cost[one])
    for one in range(cost.size):
        total += np.exp(-0.5 * (cost[one] - least))
    return float(1.0 - np.exp(-0.5 * (cost[state] - least)) / (total + np.exp(-0.5 * (anywhere - least))))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _take(place: Floats, total: Floats, centre: Floats, covariance: Floats) -> None:  # pragma: no cover
    """Make a place (3,) and its covariance (3, 3) those of a state."""
    for i in range(3):
        centre[i] = place[i]
        for j in range(3):
            covariance[i, j] = total[i, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _join(
    drift: Drift, place: Floats, total: Floats, centre: Floats, covariance: Floats, may_move: bool
) -> float:  # pragma: no cover
    """Update a state and the drift by a segment at a place; return the part of its error that is drift."""
    f, part, unit = _factors(total, covariance), 0.0, np.eye(3)
    residual, variance, gain = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(3):
        residual[i], variance[i] = place[i] - centre[i], total[i, i] + covariance[i, i]
        own = _solve(f, unit[i, 0], unit[i, 1], unit[i, 2])
        part = max(part, drift.covariance[i, 0, 0] * own[i])
        gain[i, 0], gain[i, 1], gain[i, 2] = _solve(f, covariance[i, 0], covariance[i, 1], covariance[i, 2])
    if may_move:
        before = covariance.copy()
        for i in range(3):
            for k in range(3):
                centre[i] += gain[i, k] * residual[k]
                for j in range(3):
                    covariance[i, j] -= gain[i, k] * before[k, j]
    observe(drift, 0, residual, variance)
    return part


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _assign(
    one: int,
    table: SegmentTable,
    drift: Drift,
    found: Found,
    count: int,
    given: int,
    limits: tuple[float, float],
    may_add: bool,
) -> tuple[int, float]:  # pragma: no cover
    """Assign one segment, and update its state and the drift by it; return states and its cost."""
    limit, anywhere = limits
    place, total, zero = np.empty(3), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(3):
        place[i] = table.head_mean[one, i] - drift.value[i]
        for j in range(3):
            total[i, j] = table.covariance[one, i, j] + table.own[one, i, j]
        total[i, i] += drift.covariance[i, 0, 0]
    distance, cost, nearest = np.empty(count), np.empty(count), np.inf
    for state in range(count):
        f = _factors(total, found.covariance[state])
        distance[state] = _distance(f, place, found.centre[state])
        cost[state] = distance[state] + _log_determinant(f)
        nearest = min(nearest, distance[state])
    is_new = given == count
    if given < 0:
        is_new = count == 0 or (may_add and nearest > limit)
    if is_new:
        found.label[one] = count
        _take(place, total, found.centre[count], found.covariance[count])
        return count + 1, 0.0
    chosen = _choose(distance, cost, limit, nearest) if given < 0 else given
    found.label[one] = chosen
    found.confusion[one] = _doubt(cost, chosen, anywhere) * _join(
        drift, place, total, found.centre[chosen], found.covariance[chosen], may_add
    )
    return count, distance[chosen] + _log_determinant(_factors(total, zero))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assign_segments(
    steady: npt.NDArray[np.int64],
    table: SegmentTable,
    drift: Drift,
    found: Found,
    count: int,
    given: npt.NDArray[np.int64],
    limits: tuple[float, float],
    may_add: bool,
) -> tuple[int, float]:  # pragma: no cover
    """Assign the steady segments to states, one after the other, and filter the drift along.

    Parameters
    ----------
    steady : ndarray of int64, shape (steady segment,)
    table, drift, found
        The drift is that before the first segment; `found` is filled in.
    count : int
        States known so far.
    given : ndarray of int64, shape (segment,)
        Labels that are known; negative where they are not.
    limits : (float, float)
        Squared distance from which on no state fits, and the log determinant of states' places before any is
        observed.
    may_add : bool
        Whether states may be added and change.

    Returns
    -------
    count : int
    cost : float
        Of all segments, as in `states.find_states`.
    """
    whole, change, noise = 0.0, np.empty(3), np.empty(3)
    for one in steady:
        predict(drift, table.gap[one])
        observe_slope(drift, table.head_slope[one], table.slope_variance[one])
        count, cost = _assign(one, table, drift, found, count, given[one], limits, may_add)
        whole += cost
        for k in range(3):
            found.drift[one, k] = drift.value[k]
            found.drift_covariance[one, k, k] = drift.covariance[k, 0, 0]
            change[k] = table.tail_mean[one, k] - table.head_mean[one, k]
            noise[k] = 2.0 * table.covariance[one, k, k]
        cross_segment(
            drift, table.seconds[one], change, noise, table.tail_slope[one], table.slope_variance[one]
        )
        for k in range(3):
            found.drift_end[one, k] = drift.value[k]
    return count, whole
