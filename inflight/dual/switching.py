"""States told by the sequence of steps alone, whatever the difference drifts in between.

A step is known to the noise of short stretches however far the level has moved since a state was last seen.
Where all steps of a record are sums of a few vectors, and each vector is added and taken off in turn, the
accumulated steps name the states. That a wrong reading of the steps passes this test halves in likelihood
with every step beyond one for each vector, so that a record of some length proves itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.changes import Change, Occupancy, joined, limit_of, reduced, simplest
from inflight.dual.correction import TRANSIENT
from inflight.dual.drift import DriftRate, Track
from inflight.dual.segments import Segments
from inflight.time import SECOND

Labels = npt.NDArray[np.int64]

#: Steps beyond one for each vector that prove a reading: one in a thousand passes by accident.
_PROOF = 10
#: Each vector must be seen so often, and be no nearer to another than this part of its size: else errors may
#: have made two of one.
_TURNS, _ALIKE = 3, 0.1
#: With more distinct steps than this they are no sums of a few vectors.
_MOST = 24


class Proven(NamedTuple):
    """States that the steps prove.

    Attributes
    ----------
    label : ndarray of int64, shape (segment,)
        State of each segment, numbered as they appear; `TRANSIENT` for those too short.
    occupancy : ndarray of int64, shape (state, unit)
        0 or 1.
    """

    label: Labels
    occupancy: Occupancy


def labels_by_steps(
    segments: Segments, rates: Sequence[DriftRate], scatters: Sequence[float]
) -> Proven | None:
    """Return the states that the steps between segments prove; None where they prove none.

    Parameters
    ----------
    segments : Segments
    rates : sequence of DriftRate
        How fast the difference may drift, the likeliest first.
    scatters : sequence of float
        By how much a state's point may vary beside noise and drift, nT; the likeliest first.
    """
    if np.count_nonzero(~segments.transient) < _PROOF + 2:
        return None
    for rate in rates:
        step, covariance = steps_between(segments, rate)
        for scatter in scatters:
            found = _read(segments, step, covariance + 2.0 * scatter**2 * np.eye(3))
            if found is not None:
                return found
    return None


def _read(segments: Segments, step: Floats, covariance: Floats) -> Proven | None:
    steady = np.flatnonzero(~segments.transient)
    limit = limit_of(len(step))
    size = np.einsum("si,sij,sj->s", step, np.linalg.inv(covariance), step)
    real = np.flatnonzero(size > limit)
    # The surest steps first: others are recognised by them.
    order = real[np.argsort(np.einsum("sii->s", covariance[real]), kind="stable")]
    changes: list[Change] = []
    which: dict[int, tuple[int, int]] = {}
    for one in order.tolist():
        which[one] = joined(changes, Change(step[one], covariance[one], 1), limit)
        if len(changes) > _MOST:
            return None
    kept, parts = reduced(changes)
    if len(real) - len(kept) < _PROOF or _alike(np.array([changes[one].vector for one in kept])):
        return None
    toggled = np.zeros((steady.size, len(kept)), dtype=np.int64)
    for one, (change, sign) in which.items():
        for unit, value in parts[change].items():
            toggled[one + 1, unit] = sign * value
    table = simplest(np.cumsum(toggled, axis=0))
    seldom = np.abs(np.diff(table, axis=0)).sum(axis=0).min(initial=_TURNS) < _TURNS
    if seldom or np.ptp(table, axis=0).max(initial=0) > 1:
        return None
    _, first, found = np.unique(table, axis=0, return_index=True, return_inverse=True)
    label = np.full(len(segments), TRANSIENT, dtype=np.int64)
    label[steady] = np.argsort(np.argsort(first))[found.ravel()]
    return Proven(label, table[np.sort(first)])


def _alike(vectors: Floats) -> bool:
    """Return whether two of the vectors (vector, axis) hardly differ, up to their sign."""
    size = np.linalg.norm(vectors, axis=1)
    apart = np.minimum(
        np.linalg.norm(vectors[:, None] - vectors[None], axis=2),
        np.linalg.norm(vectors[:, None] + vectors[None], axis=2),
    )
    np.fill_diagonal(apart, np.inf)
    return bool(np.any(apart < _ALIKE * np.minimum(size[:, None], size[None])))


def steps_between(segments: Segments, rate: DriftRate) -> tuple[Floats, Floats]:
    """Return steps from each steady segment to the next, the drift in between taken off, and covariances.

    Parameters
    ----------
    segments : Segments
    rate : DriftRate

    Returns
    -------
    step, covariance : ndarray, shape (steady segment - 1, axis) and (..., axis, axis)
        nT and nT^2.
    """
    steady = np.flatnonzero(~segments.transient)
    track = Track.start(rate)
    step, covariance = np.empty((steady.size - 1, 3)), np.empty((steady.size - 1, 3, 3))
    track.sloping(segments.begin.slope[steady[0]], segments.slope_variance[steady[0]])
    for place, (one, after) in enumerate(pairwise(steady.tolist())):
        track.through(segments, one)
        seconds = float(segments.begin.middle[after] - segments.finish.middle[one]) / SECOND
        value = track.value.copy()
        track.covariance[:, 0, :] = track.covariance[:, :, 0] = 0.0
        track.forward(seconds)
        track.sloping(segments.begin.slope[after], segments.slope_variance[after])
        step[place] = segments.begin.mean[after] - segments.finish.mean[one] - (track.value - value)
        covariance[place] = segments.covariance[one] + segments.covariance[after] + track.spread
    return step, covariance
