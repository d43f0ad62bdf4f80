"""Noise with heavy tails: single samples far out, so many that two in a row would look like a state.

Rare ones are told one by one (`jumps.spikes`). Where they are part of the noise, every sample's distance from
the median of its surroundings is bounded, in the whole record alike: steps and stretches of three samples or
more keep their size, and means are again as sure as their scatter says.
"""

from __future__ import annotations

from bisect import bisect_left

import numba
import numpy as np
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.jumps import Places
from inflight.dual.readings import white_covariance

#: Squared distances from the median of five (whitened) that one in 8000 samples of Gaussian noise exceeds.
_FAR = 18.2
#: Part of the samples beyond that, alone among their neighbours, which makes tails heavy: by then two in a
#: row happen by chance.
_HEAVY = 0.002
#: Distances are then bounded to this many standard deviations; 97 % of Gaussian noise is within.
_BOUND = 3.0
#: Samples on either side whose medians must differ at a jump, in one of these lengths at least, and the
#: chance that noise does so: it need not be small, as the means differ already.
_MEDIANS = (16, 64, 512)
_UNLIKE = float(stats.chi2.isf(0.01, 3))


def confirmed(values: Floats, places: Places) -> Places:
    """Return the jumps at which medians differ, too: a few samples far out make a mean but no median.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    places : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    """
    white = white_covariance(values)
    if not white.max() > 0:
        return places
    weight = np.linalg.inv(white + 1e-12 * np.trace(white) * np.eye(3))
    left = places.tolist()
    doubtful = [one for one in left if _unlikeness(values, left, one, weight) < _UNLIKE]
    # Without its doubtful neighbours a jump has longer stretches to show itself.
    for one in doubtful:
        if _unlikeness(values, left, one, weight) < _UNLIKE:
            left.remove(one)
    return np.array(left, dtype=np.int64)


def _unlikeness(values: Floats, places: list[int], one: int, weight: Floats) -> float:
    """Return the largest squared difference, in errors, of the medians on both sides of a jump."""
    index = bisect_left(places, one)
    first = places[index - 1] if index else 0
    last = places[index + 1] if index + 1 < len(places) else len(values)
    highest = 0.0
    for length in _MEDIANS:
        before, after = values[max(first, one - length) : one], values[one : min(last, one + length)]
        step = np.median(after, axis=0) - np.median(before, axis=0)
        # The median of white Gaussian noise; of two samples it is their mean.
        error = 0.5 * np.pi * (1.0 / len(before) + 1.0 / len(after))
        highest = max(highest, float(step @ weight @ step) / error)
    return highest


def without_tails(values: Floats) -> Floats:
    """Return a series whose noise has no heavy tails: the same one unless it has.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    """
    white = white_covariance(values)
    if len(values) < 5 or not white.max() > 0:
        return values
    back = np.linalg.cholesky(white + 1e-12 * np.trace(white) * np.eye(3))
    unit = np.ascontiguousarray(values @ np.linalg.inv(back).T)
    middle, square = _about_medians(unit)
    far = square > _FAR
    alone = far[1:-1] & ~far[:-2] & ~far[2:]
    if np.mean(alone) < _HEAVY:
        return values
    share = np.minimum(1.0, _BOUND / np.sqrt(np.maximum(square, 1e-300)))[:, None]
    return np.asarray((middle + share * (unit - middle)) @ back.T)


@numba.njit(cache=True, nogil=True)
def _about_medians(unit: Floats) -> tuple[Floats, Floats]:
    """Return the median of each sample and its four neighbours, by axis, and the squared distance from it."""
    count = unit.shape[0]
    middle, square = np.empty_like(unit), np.zeros(count)
    near = np.empty(5)
    for one in range(count):
        first = min(max(one - 2, 0), count - 5)
        for k in range(unit.shape[1]):
            for other in range(5):
                value = unit[first + other, k]
                place = other
                while place > 0 and near[place - 1] > value:
                    near[place] = near[place - 1]
                    place -= 1
                near[place] = value
            middle[one, k] = near[2]
            square[one] += (unit[one, k] - near[2]) ** 2
    return middle, square
