"""Loops that interpolate a series at given times: straight lines, and a windowed sinc.

Takes stamps and values of a series and the times asked for; makes the values there, NaN where too many
samples are missing. `inflight.samples.alignment` chooses between them.
"""

from __future__ import annotations

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
def _bessel_i0(x: float) -> float:  # pragma: no cover
    total, term, k = 1.0, 1.0, 1.0
    while term > 1e-17 * total:
        term *= (x / (2.0 * k)) ** 2
        total += term
        k += 1.0
    return total


@numba.njit(cache=True, nogil=True)
def _whole(
    stamps: Int64, first: int, last: int, target: int, half: float, cadence: float
) -> bool:  # pragma: no cover
    """Return True when no sample is missing under a window of half-width `half`, ns."""
    edge = half - GAP * cadence
    if target - stamps[first] < edge or stamps[last] - target < edge:
        return False
    for j in range(first, last):  # noqa: SIM110, numba knows no generator expressions
        if stamps[j + 1] - stamps[j] > GAP * cadence:
            return False
    return True


@numba.njit(cache=True, nogil=True)
def _sinc_weight(x: float, cutoff: float, half: float, kaiser_beta: float) -> float:  # pragma: no cover
    """Return the weight of a sample `x` cadences away, of a window of half-width `half`."""
    window = _bessel_i0(kaiser_beta * np.sqrt(max(0.0, 1.0 - (x / half) ** 2))) / _bessel_i0(kaiser_beta)
    return float(np.sinc(cutoff * x) * window)


@numba.njit(cache=True, nogil=True)
def _under_window(
    stamps: Int64, middle: int, target: int, half: float, cadence: float
) -> tuple[int, int]:  # pragma: no cover
    """Return the first and last sample closer to a target than `half`, ns; (0, -1) where one is missing."""
    first, last = middle, middle - 1
    while first > 0 and target - stamps[first - 1] < half:
        first -= 1
    while last + 1 < stamps.size and stamps[last + 1] - target < half:
        last += 1
    whole = last - first + 1 >= int(2 * half / cadence) - 1 and _whole(
        stamps, first, last, target, half, cadence
    )
    return (first, last) if whole else (0, -1)


@numba.njit(cache=True, nogil=True)
def sinc(
    stamps: Int64,
    values: Floats,
    target: Int64,
    cadence: float,
    cutoff: float,
    lobes: float,
    kaiser_beta: float,
) -> Floats:  # pragma: no cover
    """Windowed-sinc interpolation at each target.

    Weights are normalised to keep a constant, and the line through the ends of the window is taken
    off and put back, so that the main field's slope along the orbit leaves no error. A weight holds for
    the next target, too, where the sample lies as far from it: always, where both are regular.
    """
    columns = values.shape[1]
    out = np.full((target.size, columns), np.nan)
    half = lobes / cutoff
    weights = np.zeros(2 * int(half) + 4)
    distances = np.full(weights.size, np.iinfo(np.int64).max)
    slope, sums = np.zeros(columns), np.zeros(columns)
    middle = np.searchsorted(stamps, target)
    for i in range(target.size):
        first, last = _under_window(stamps, middle[i], target[i], half * cadence, cadence)
        if last < first:
            continue
        if last - first >= weights.size:
            # Stamps closer than the cadence: more of them are under the window.
            weights = np.zeros(2 * (last - first))
            distances = np.full(weights.size, np.iinfo(np.int64).max)
        total = 0.0
        width = float(stamps[last] - stamps[first])
        for column in range(columns):
            slope[column] = (values[last, column] - values[first, column]) / width
            sums[column] = 0.0
        for j in range(first, last + 1):
            tap, distance = j - first, target[i] - stamps[j]
            if distances[tap] != distance:
                weights[tap] = _sinc_weight(distance / cadence, cutoff, half, kaiser_beta)
                distances[tap] = distance
            total += weights[tap]
            along = float(stamps[j] - stamps[first])
            for column in range(columns):
                above = values[j, column] - values[first, column] - slope[column] * along
                sums[column] += weights[tap] * above
        along = float(target[i] - stamps[first])
        for column in range(columns):
            out[i, column] = sums[column] / total + values[first, column] + slope[column] * along
    return out
