"""Noise of the level of a stretch, without the drift: what the mean of so many samples is sure to.

The noise of steps (`jumps.step_noise`) holds the drift of long stretches, which is right for telling jumps
but not for levels and slopes, whose drift is carried along (`states.Track`). Here three neighbouring
stretches are compared, ``m[1] - (m[0] + m[2]) / 2``, in which a straight drift cancels.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.dual.jumps import Places, StepNoise
from inflight.dual.readings import trimmed_covariance

#: Noise is measured at this many positions of each length, at least so many apart as part of the length.
_POSITIONS, _STRIDES = 20_000, 4
#: The fewest independent triples that tell a noise.
_FEWEST = 16


def level_noise(values: Floats, jumps: Places, steps: StepNoise) -> StepNoise:
    """Return the noise of steps between stretches whose straight drift is known.

    Parameters
    ----------
    values : ndarray, shape (time, axis)
        nT, finite.
    jumps : ndarray of int64, shape (jump,)
        Increasing rows of the first samples after a jump.
    steps : StepNoise
        With the drift.

    Returns
    -------
    StepNoise
        As far as stretches without a jump are long enough; never more than `steps`. White noise has the same
        in both. A random walk has half as much here: it is to be carried along as drift.
    """
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values - values.mean(axis=0), axis=0)])
    edges = np.concatenate([[0], jumps, [len(values)]])
    told = []
    for length in steps.length.tolist():
        covariance = _of_triples(sums, edges, length)
        if covariance is None:
            break
        told.append(covariance)
    if not told:
        return steps
    count = len(told)
    own = np.array(told)
    share = np.einsum("sii->s", own) / np.einsum("sii->s", steps.covariance[:count])
    kept = np.where((share < 1.0)[:, None, None], own, steps.covariance[:count])
    return StepNoise(steps.length[:count], kept, steps.freedom[:count])


def _of_triples(sums: Floats, edges: Places, length: int) -> Floats | None:
    """Return the covariance of a step of this length by three stretches in a row; None for too few."""
    count = len(sums) - 1
    stride = max(1, length // _STRIDES, count // _POSITIONS)
    at = np.arange(0, count - 3 * length + 1, stride)
    inside = np.searchsorted(edges, at + 3 * length) - np.searchsorted(edges, at, side="right")
    at = at[inside == 0]
    if at.size * stride < _FEWEST * 3 * length:
        return None
    bend = sums[at + 3 * length] - 3.0 * sums[at + 2 * length] + 3.0 * sums[at + length] - sums[at]
    # Six times the variance of one mean; a step has twice.
    return np.asarray(trimmed_covariance(bend / length) / 3.0)
