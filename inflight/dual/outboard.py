"""What a switched unit adds to the outboard sensor: from its own steps, the ambient field continuous.

At a jump of the difference the outboard reading jumps, too, and the ambient field goes on as before. What
the ambient field does between the two stretches compared is noise of the step; it is measured from the
outboard readings themselves where nothing switches, the best length of stretch is chosen by it, and more
lively times count less. Where the ambient field is known, the level of each segment tells its stray field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.dual.jumps import Places, StepNoise, step_noise
from inflight.dual.readings import Readings
from inflight.dual.segments import Segments
from inflight.time import SECOND

#: Places in either segment at which the liveliness of the ambient field is measured; what its usual
#: liveliness counts beside them, in steps.
_AROUND, _USUAL = 24, 4.0
#: Beyond this many standard deviations (three components) a step counts less: Huber's weight.
_HUBER = 3.4
_TURNS = 5


@dataclass(frozen=True)
class OutboardSteps:
    """Steps of the outboard reading from one steady segment to the next.

    Attributes
    ----------
    before, after : ndarray of int64, shape (step,)
        Segments.
    step : ndarray, shape (step, axis)
        nT.
    covariance : ndarray, shape (step, axis, axis)
        Of noise and of what the ambient field does in the meantime, nT^2.
    """

    before: Places
    after: Places
    step: Floats
    covariance: Floats


def outboard_steps(readings: Readings, segments: Segments) -> OutboardSteps:
    """Return the outboard steps between neighbouring steady segments.

    The covariance of a step grows with the square of the time between both stretches beside that of
    neighbouring ones: for a field smoother than a random walk this is enough, for white noise too much.
    """
    rows = np.flatnonzero(readings.good)
    field = readings.outboard[rows]
    first, last = np.searchsorted(rows, segments.first), np.searchsorted(rows, segments.last)
    noise = step_noise(field, first[1:])
    best = int(np.argmin(np.einsum("sii->s", noise.covariance)))
    steady = np.flatnonzero(~segments.transient)
    before, after = steady[:-1], steady[1:]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(field - field.mean(axis=0), axis=0)])
    width, scale = _widths(noise, best, np.minimum(segments.count[before], segments.count[after]))
    step = _mean(sums, first[after], first[after] + width) - _mean(sums, last[before] - width, last[before])
    gap = (segments.start[after] - segments.end[before]) / SECOND
    usual = readings.step / SECOND
    stretch = (1.0 + np.maximum(gap - usual, 0.0) / (width * usual)) ** 2
    lively = np.array(
        [
            _liveliness(sums, first, last, noise, int(k), (int(b), int(a)))
            for k, b, a in zip(scale, before, after, strict=True)
        ]
    )
    covariance = noise.covariance[scale] * (stretch * lively)[:, None, None]
    return OutboardSteps(before, after, step, covariance)


def _widths(noise: StepNoise, best: int, count: Places) -> tuple[Places, Places]:
    """Return the length of the stretches compared, and its place among the lengths."""
    fits = np.searchsorted(noise.length, count, side="right") - 1
    scale = np.clip(fits, 0, best)
    return noise.length[scale], scale


def _mean(sums: Floats, first: Places, last: Places) -> Floats:
    return np.asarray((sums[last] - sums[first]) / (last - first)[:, None])


def _liveliness(
    sums: Floats, first: Places, last: Places, noise: StepNoise, scale: int, pair: tuple[int, int]
) -> float:
    """Return the variance of steps within two segments beside the usual one."""
    width = int(noise.length[scale])
    # Those that are nearest to the jump, from both sides.
    at = [last[pair[0]] - width - (width * np.arange(_AROUND)) // 2]
    at.append(first[pair[1]] + width + (width * np.arange(_AROUND)) // 2)
    inside = [
        one[(one - width >= first[own]) & (one + width <= last[own])]
        for one, own in zip(at, pair, strict=True)
    ]
    place = np.concatenate(inside)
    if not place.size:
        return 1.0
    step = (sums[place + width] - 2.0 * sums[place] + sums[place - width]) / width
    pull = np.einsum("ti,ij,tj->t", step, np.linalg.inv(noise.covariance[scale]), step) / 3.0
    # Half of the overlapping steps are independent.
    number = 0.5 * place.size
    return float((pull.mean() * number + _USUAL) / (number + _USUAL))


@dataclass(frozen=True)
class StrayFit:
    """Weighted least squares of stray fields at the outboard sensor.

    Attributes
    ----------
    value : ndarray, shape (parameter, axis)
        nT.
    covariance : ndarray, shape (parameter, axis, parameter, axis)
        nT^2.
    excess : float
        Scatter of the rows beside what they state, in sigmas; the covariance is widened by it where above 1.
    """

    value: Floats
    covariance: Floats
    excess: float


def fit_stray(design: Floats, observed: Floats, covariance: Floats, prior: Floats) -> StrayFit:
    """Fit stray fields to steps and levels, robustly.

    Parameters
    ----------
    design : ndarray, shape (row, parameter)
        Same for all three axes.
    observed : ndarray, shape (row, axis)
        nT.
    covariance : ndarray, shape (row, axis, axis)
        nT^2.
    prior : ndarray, shape (parameter,)
        Standard deviation of each parameter about zero, nT: where nothing is measured.
    """
    width = design.shape[1]
    inverse = np.linalg.inv(covariance)
    ridge = np.diag(np.repeat(1.0 / prior**2, 3))
    weight = np.ones(len(observed))
    freedom = max(3 * (len(observed) - width), 1)
    for _ in range(_TURNS):
        weighted = weight[:, None, None] * inverse
        normal = np.einsum("rp,rij,rq->piqj", design, weighted, design).reshape(3 * width, 3 * width)
        right = np.einsum("rp,rij,rj->pi", design, weighted, observed).ravel()
        total = np.linalg.pinv(normal + ridge, hermitian=True)
        value = (total @ right).reshape(width, 3)
        left = observed - design @ value
        far = np.einsum("ri,rij,rj->r", left, inverse, left)
        weight = np.minimum(1.0, _HUBER / np.sqrt(np.maximum(far, 1e-300)))
    excess = float(np.sqrt(np.sum(weight * far) / freedom)) if len(observed) > width else 1.0
    # The prior's share is not noise, and does not grow with it.
    widened = total * max(1.0, excess) ** 2
    return StrayFit(value, widened.reshape(width, 3, width, 3), excess)
