"""Noise with heavy tails: single samples far out, so many that two in a row would look like a state.

Rare ones are told one by one (`jumps.spikes`). Where they are part of the noise, every sample's distance from
the median of its surroundings is bounded, in the whole record alike: steps and stretches of three samples or
more keep their size, and means are again as sure as their scatter says.
"""

from __future__ import annotations

import numba
import numpy as np

from inflight.arrays import Floats
from inflight.dual.readings import white_covariance

#: Squared distances from the median of five (whitened) that one in 8000 samples of Gaussian noise exceeds.
_FAR = 18.2
#: Part of the samples beyond that, alone among their neighbours, which makes tails heavy: by then two in a
#: row happen by chance.
_HEAVY = 0.002
#: Distances are then bounded to this many standard deviations; 97 % of Gaussian noise is within.
_BOUND = 3.0


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
