"""Trainings repeated as the spacecraft ages: a state keeps its number, and what it adds is followed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from inflight.arrays import Floats
from inflight.dual.training import Training

#: Chance that the same state is not recognised in a later training, of all its states.
_MISSED = 1e-3


@dataclass(frozen=True)
class Ageing:
    """How a later training compares with an earlier one.

    Attributes
    ----------
    training : Training
        The later one with the earlier one's numbers, and what both know together of states that have not
        changed.
    matched : ndarray of int64, shape (pair, 2)
        Places of a state in the earlier and the later training.
    shift : ndarray, shape (axis,)
        By how much the difference went on in between, the same for all states, nT.
    change, sigma : ndarray, shape (pair, axis)
        Change of the correction, beside that of all together where one is relative, and its standard
        deviation, nT.
    aged : ndarray of bool, shape (pair,)
        The change exceeds what noise makes.
    """

    training: Training
    matched: npt.NDArray[np.int64]
    shift: Floats
    change: Floats
    sigma: Floats
    aged: npt.NDArray[np.bool_]


def continued(earlier: Training, later: Training) -> Ageing:
    """Return a later training that goes on from an earlier one.

    Notes
    -----
    States are matched by their differences after a common shift, the one that matches most states; a state
    that has none keeps its own place and takes the next free number. Where a correction has not changed
    beyond its noise both are averaged by their covariances; where it has, the later one holds alone.
    """
    matched, shift = _matched(earlier, later)
    number = np.full(len(later), -1, dtype=np.int64)
    number[matched[:, 1]] = earlier.number[matched[:, 0]]
    new = number < 0
    number[new] = earlier.number.max(initial=-1) + 1 + np.arange(np.count_nonzero(new))
    old, own = earlier.correction[matched[:, 0]], later.correction[matched[:, 1]]
    spread_old, spread_own = earlier.covariance[matched[:, 0]], later.covariance[matched[:, 1]]
    gauge = _gauge(earlier, later, old, own, spread_old + spread_own)
    change = own - (old + gauge)
    total = spread_old + spread_own + 1e-12 * np.eye(3)
    far = np.einsum("pi,pij,pj->p", change, np.linalg.inv(total), change)
    aged = far > stats.chi2.isf(_MISSED / max(len(matched), 1), 3)
    correction, covariance = later.correction.copy(), later.covariance.copy()
    for pair in np.flatnonzero(~aged & earlier.seen[matched[:, 0]]):
        place = matched[pair, 1]
        gain = spread_own[pair] @ np.linalg.inv(total[pair])
        correction[place] = own[pair] - gain @ change[pair]
        covariance[place] = spread_own[pair] - gain @ spread_own[pair]
    reference = -1 if later.reference < 0 else int(number[later.number == later.reference][0])
    training = replace(
        later, number=number, correction=correction, covariance=covariance, reference=reference
    )
    sigma = np.sqrt(np.einsum("pii->pi", total))
    return Ageing(training, matched, shift, change, sigma, np.asarray(aged))


def _matched(earlier: Training, later: Training) -> tuple[npt.NDArray[np.int64], Floats]:
    """Return pairs of the same state and the common shift that matches most, the nearest if several do."""
    apart = later.centre[None] - earlier.centre[:, None]
    scatter = (earlier.scatter**2 + later.scatter**2) * np.eye(3)
    spread = earlier.centre_covariance[:, None] + later.centre_covariance[None] + scatter
    limit = stats.chi2.isf(_MISSED / max(len(later), 1), 3)
    best: tuple[float, float, npt.NDArray[np.int64], Floats] | None = None
    # Each pair of states seen offers a shift; its own noise is that of the pair.
    for one, other in np.argwhere(earlier.seen[:, None] & later.seen[None]):
        shift = apart[one, other]
        left = apart - shift
        far = np.einsum("kli,klij,klj->kl", left, np.linalg.inv(spread + spread[one, other]), left)
        pairs = _nearest_pairs(far, limit)
        weight = float(np.sum(later.seconds[pairs[:, 1]] * earlier.seen[pairs[:, 0]]))
        size = float(np.linalg.norm(shift))
        if best is None or (weight, -size) > (best[0], -best[1]):
            best = weight, size, pairs, shift
    if best is None:
        return np.empty((0, 2), dtype=np.int64), np.zeros(3)
    precision = np.linalg.inv(spread[best[2][:, 0], best[2][:, 1]])
    right = np.einsum("pij,pj->i", precision, apart[best[2][:, 0], best[2][:, 1]])
    return best[2], np.asarray(np.linalg.solve(precision.sum(axis=0), right))


def _nearest_pairs(far: Floats, limit: float) -> npt.NDArray[np.int64]:
    """Return pairs that are each other's nearest, within a limit."""
    to = far.argmin(axis=1)
    back = far.argmin(axis=0)
    own = np.arange(len(far))
    mutual = (back[to] == own) & (far[own, to] < limit)
    return np.stack([own[mutual], to[mutual]], axis=1)


def _gauge(earlier: Training, later: Training, old: Floats, own: Floats, spread: Floats) -> Floats:
    """Return what is to be added to the earlier corrections: both may be relative to different states."""
    if (earlier.constant_known and later.constant_known) or not len(old):
        return np.zeros(3)
    weight = np.linalg.inv(spread + 1e-6 * np.trace(spread.mean(axis=0)) * np.eye(3) + 1e-12 * np.eye(3))
    right = np.einsum("pij,pj->i", weight, own - old)
    return np.asarray(np.linalg.solve(weight.sum(axis=0), right))
