"""Loops that interpolate a series at given times: straight lines, and a windowed sinc; running means.

Takes stamps and values of a series and the times asked for; makes the values there, NaN where too many
samples are missing. `inflight.samples.alignment` chooses between them.
"""

from __future__ import annotations

from functools import cache

import numba
import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import GAP, Int64


@numba.njit(cache=True, nogil=True)
def linear(stamps: Int64, values: Floats, target: Int64, widest: float) -> Floats:  # pragma: no cover
    """Return values on straight lines between neighbours no farther apart than `widest`, ns."""
    out = np.full((target.size, values.shape[1]), np.nan)
    j = 0
    for i in range(target.size):
        # Both increase: what is past for one target is past for the next.
        while j < stamps.size and stamps[j] < target[i]:
            j += 1
        if j < stamps.size and stamps[j] == target[i]:
            for column in range(values.shape[1]):
                out[i, column] = values[j, column]
        elif 0 < j < stamps.size and stamps[j] - stamps[j - 1] <= widest:
            part = (target[i] - stamps[j - 1]) / (stamps[j] - stamps[j - 1])
            for column in range(values.shape[1]):
                before = values[j - 1, column]
                out[i, column] = before + part * (values[j, column] - before)
    return out


@numba.njit(cache=True, nogil=True)
def nearest(
    stamps: Int64, target: Int64, same: float, between: float
) -> tuple[Int64, npt.NDArray[np.bool_], bool]:  # pragma: no cover
    """Return which stamp is nearest to each target, and whether it is within `same`, ns.

    The third is False where a target is farther from its stamp than that, yet nearer than `between`: what is
    behind it is not looked at then.
    """
    index, there = np.zeros(target.size, np.int64), np.zeros(target.size, np.bool_)
    j = 0
    for i in range(target.size):
        # Both increase: what is past for one target is past for the next.
        while j < stamps.size - 1 and stamps[j] < target[i]:
            j += 1
        k = j if j == 0 or abs(stamps[j] - target[i]) < abs(target[i] - stamps[j - 1]) else j - 1
        off = abs(stamps[k] - target[i])
        index[i], there[i] = k, off <= same
        if same < off < between:
            return index, there, False
    return index, there, True


@numba.njit(cache=True, nogil=True)
def running_means(stamps: Int64, values: Floats, reach: int) -> Floats:  # pragma: no cover
    """Return the mean of the samples within `reach`, ns, on either side of each sample; (time, column).

    Both sides have equally many samples: as many as the side with fewer.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, increasing.
    values : ndarray, shape (time, column)
        Finite: a NaN would spoil the means of all that follow.
    """
    columns = values.shape[1]
    sums = np.zeros((stamps.size + 1, columns))
    for i in range(stamps.size):
        for column in range(columns):
            sums[i + 1, column] = sums[i, column] + (values[i, column] - values[0, column])
    out = np.empty_like(values)
    first, last = 0, 0
    for i in range(stamps.size):
        # Both ends only move on.
        while stamps[first] < stamps[i] - reach:
            first += 1
        while last + 1 < stamps.size and stamps[last + 1] <= stamps[i] + reach:
            last += 1
        each = max(0, min(i - first, last - i))
        for column in range(columns):
            total = sums[i + each + 1, column] - sums[i - each, column]
            out[i, column] = total / (2 * each + 1) + values[0, column]
    return out


#: Values of the windowed sinc in each of its lobes, between which cubics run: exact to 1e-10 (derived).
_PER_LOBE = 512


@cache
def _kernel(lobes: float, kaiser_beta: float) -> Floats:
    """Return the windowed sinc from its middle to its end, `_PER_LOBE` values a lobe."""
    from_middle = np.arange(round(lobes * _PER_LOBE) + 1) / _PER_LOBE
    window = np.i0(kaiser_beta * np.sqrt(np.maximum(0.0, 1.0 - (from_middle / lobes) ** 2)))
    return np.asarray(np.sinc(from_middle) * window / np.i0(kaiser_beta), dtype=np.float64)


def sinc(
    stamps: Int64,
    values: Floats,
    target: Int64,
    cadence: float,
    cutoff: float,
    lobes: float,
    kaiser_beta: float,
) -> Floats:
    """Windowed-sinc interpolation at each target.

    Weights are normalised to keep a constant, and the line through the ends of the window is taken
    off and put back, so that the main field's slope along the orbit leaves no error. Weights hold for
    the next target, too, where its samples lie alike: always, where both are regular.

    Parameters
    ----------
    stamps : ndarray of int64, shape (sample,)
    values : ndarray, shape (sample, column)
    target : ndarray of int64, shape (time,)
        Increasing, as `stamps`.
    cadence : float
        Usual distance of samples, ns.
    cutoff : float
        What passes, in Nyquist frequencies of the samples.
    lobes, kaiser_beta : float
        Half-width of the window, in lobes of the sinc, and its parameter.

    Returns
    -------
    ndarray, shape (time, column)
        NaN where samples are missing under the window.
    """
    half = lobes / cutoff * cadence
    across = np.ascontiguousarray(values.T)
    return _sinc(stamps, across, target, cadence, cutoff, half, _kernel(lobes, kaiser_beta))


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _weighted(weights: Floats, values: Floats) -> float:  # pragma: no cover
    """Return the weighted sum of values; in an order that the processor's vectors are used in."""
    total = 0.0
    for j in range(values.size):
        total += weights[j] * values[j]
    return total


@numba.njit(cache=True, nogil=True)
def _weights_of(
    weights: Floats, stamps: Int64, first: int, count: int, target: int, scale: float, kernel: Floats
) -> tuple[float, float]:  # pragma: no cover
    """Write the weights of samples about a target; return their sum, and that times the time from the first.

    A sample's place in the kernel is its distance from the target, ns, times `scale`.
    """
    total, moment = 0.0, 0.0
    for j in range(count):
        place = abs(target - stamps[first + j]) * scale
        k = min(max(int(place), 1), kernel.size - 3)
        t = place - k
        # The cubic through four values of the kernel.
        ahead, after = t - 1.0, t - 2.0
        weights[j] = (
            -t * ahead * after * kernel[k - 1] / 6.0
            + (t + 1.0) * ahead * after * kernel[k] / 2.0
            - (t + 1.0) * t * after * kernel[k + 1] / 2.0
            + (t + 1.0) * t * ahead * kernel[k + 2] / 6.0
        )
        total += weights[j]
        moment += weights[j] * (stamps[first + j] - stamps[first])
    return total, moment


@numba.njit(cache=True, nogil=True)
def _reaches(stamps: Int64, first: int, last: int, target: int, edge: float) -> bool:  # pragma: no cover
    """Return True when samples reach as far as `edge`, ns, on both sides of a target."""
    return bool(min(target - stamps[first], stamps[last] - target) >= edge)


@numba.njit(cache=True, nogil=True)
def _sinc(
    stamps: Int64, values: Floats, target: Int64, cadence: float, cutoff: float, half: float, kernel: Floats
) -> Floats:  # pragma: no cover
    """Interpolate `values`, (column, sample), under a window of half-width `half`, ns."""
    columns = values.shape[0]
    out = np.full((target.size, columns), np.nan)
    least, edge = int(2 * half / cadence) - 1, half - GAP * cadence
    scale = cutoff / cadence * _PER_LOBE
    weights, total, moment = np.zeros(least + 4), 0.0, 0.0
    # Of the samples that the weights are for: their number, distance, and that of the first to the target.
    known_count, known_step, known_lead = 0, 0, 0
    # Where the last step that is a gap ends, and the last one that is not as long as that before.
    gap, uneven = 0, 0
    first, last = 0, -1
    for i in range(target.size):
        # Both increase: what is past for one target is past for the next.
        while first < stamps.size and target[i] - stamps[first] >= half:
            first += 1
        while last + 1 < stamps.size and stamps[last + 1] - target[i] < half:
            last += 1
            if last > 0 and stamps[last] - stamps[last - 1] > GAP * cadence:
                gap = last
            if last > 1 and stamps[last] - stamps[last - 1] != stamps[last - 1] - stamps[last - 2]:
                uneven = last
        count = last - first + 1
        if count < max(least, 2) or gap > first or not _reaches(stamps, first, last, target[i], edge):
            continue
        step, lead = stamps[first + 1] - stamps[first], target[i] - stamps[first]
        even = uneven <= first + 1
        if not even or count != known_count or step != known_step or lead != known_lead:
            if count > weights.size:
                # Stamps closer than the cadence: more of them are under the window.
                weights = np.zeros(2 * count)
            total, moment = _weights_of(weights, stamps, first, count, target[i], scale, kernel)
            known_count, known_step, known_lead = (count, step, lead) if even else (0, 0, 0)
        width = float(stamps[last] - stamps[first])
        for column in range(columns):
            # One run of memory: a part of all columns would be none, and its sum four times as slow.
            inside = values[column, first : last + 1]
            slope = (inside[-1] - inside[0]) / width
            found = _weighted(weights, inside)
            out[i, column] = (found - slope * moment) / total + slope * lead
    return out
