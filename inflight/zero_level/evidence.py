r"""What the readings say for one offset against any other within the bound, however far apart.

Each method solves equations that have several zeros, and its error is that of the zero it found. This is
the test over all of them. In nature the size B and the direction n of the field fluctuate independently of
each other; under a wrong offset they do not. With both Gaussian within an interval of N samples, their
variances its own, the likelihood of its *readings* is

.. math:: \ell(c) / N = -\tfrac12 \ln \mathrm{var}(B) - \tfrac12 \ln\det\mathrm{cov}(n) - 2\langle\ln B\rangle

where B and n are those of the reading less c, and the last term is the volume that a step of B and n has.
It holds for rotations and for compressions alike, so that no choice of intervals enters.

Neither Gaussian nor independent samples are relied on: two offsets are compared interval by interval, as
models are that are not nested (Vuong 1989, Econometrica 57, 307). Were they equally good, either would win
in as many intervals; the sum of the differences d is held against its scatter in time, and at least
against half of ``sum d^2``, which signs drawn at random give. So few intervals hardly refuse anything.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.estimators.longrun import long_run_covariance
from inflight.zero_level.estimate import Estimate, Question
from inflight.zero_level.intervals import AXES, Intervals

#: An offset is refused when the intervals speak against it by so many standard deviations.
REFUSED = 3.0
#: Offsets looked at along an axis, from one end of the bound to the other.
_STEPS = 121
#: Least variance of a sum of differences, of what signs drawn at random give.
_LEAST_CHANCE = 0.5
#: Least variances, of the variance of all components: readings that stand still say nothing.
_LEAST = 1e-6


def evidence(intervals: Intervals, offset: Floats) -> Floats:
    """Return the mean of a sample's log-likelihood in each interval, up to a constant; (interval,).

    Parameters
    ----------
    intervals : Intervals
    offset : ndarray, shape (3,)
        nT.
    """
    there = np.isfinite(intervals.field[..., 0])
    field = np.where(there[..., None], intervals.field - offset, 1.0)
    size = np.maximum(np.sqrt(np.einsum("ksi,ksi->ks", field, field)), 1e-9)
    part = there / intervals.count[:, None]
    unit = field / size[..., None]
    mean = np.einsum("ks,ksi->ki", part, unit)
    axis = mean / np.maximum(np.linalg.norm(mean, axis=1), 1e-300)[:, None]
    second = np.einsum("ks,ksi,ksj->kij", part, unit, unit, optimize=True)
    across = np.eye(3) - axis[:, :, None] * axis[:, None, :]
    turning = across @ (second - mean[:, :, None] * mean[:, None, :]) @ across
    middle = np.einsum("ks,ks->k", part, size)
    squeezed = np.einsum("ks,ks->k", part, (size - middle[:, None]) ** 2)
    whole = squeezed + middle**2 * np.trace(turning, axis1=1, axis2=2)
    least = _LEAST * np.maximum(whole, 1e-300)
    plane = np.maximum(np.linalg.eigvalsh(turning)[:, 1:], (least / middle**2)[:, None])
    volume = 2.0 * np.einsum("ks,ks->k", part, np.log(size))
    return np.asarray(-0.5 * (np.log(np.maximum(squeezed, least)) + np.log(plane).sum(axis=1)) - volume)


def against(better: Floats, other: Floats) -> float:
    """Return by how many standard deviations the intervals speak for one offset against another.

    Intervals of one verdict whose strength wanders for hours are no doubt; what is held against the sum
    is the scatter about their common part.

    Parameters
    ----------
    better, other : ndarray, shape (interval,)
        Of `evidence`, in order of time.
    """
    apart = better - other
    whole = float(np.abs(apart).sum())
    if whole <= 0.0:
        return 0.0
    about = apart - apart.sum() / whole * np.abs(apart)
    chance = max(_LEAST_CHANCE * float(np.sum(apart**2)), float(long_run_covariance(about[:, None])[0, 0]))
    return float(apart.sum() / np.sqrt(chance))


def most_evident(intervals: Intervals, through: Floats, question: Question) -> Floats:
    """Return the offset of most evidence within the bound, one axis after the other; (3,), nT.

    Parameters
    ----------
    through : ndarray, shape (3,)
        Where to begin, nT.
    """
    offset = np.asarray(through, dtype=np.float64)
    for axis in np.flatnonzero(question.free):
        line = along(offset, int(axis), question)
        offset = line[int(np.argmax([evidence(intervals, one).sum() for one in line]))]
    return offset


def along(through: Floats, axis: int, question: Question) -> Floats:
    """Return offsets on a line along an axis, from one end of the bound to the other; (point, 3), nT."""
    line = np.tile(np.asarray(through, dtype=np.float64), (_STEPS, 1))
    line[:, axis] = question.start[axis] + np.linspace(-question.bound, question.bound, _STEPS)
    return line


def held_to_all(intervals: Intervals, found: Estimate, question: Question) -> Estimate:
    """Return an estimate without the axes along which other offsets within the bound do as well.

    Along each axis, the others at their values, the offsets that the readings do not refuse must be one
    stretch about the solution that ends before the bound does, and none may be better by as much.

    Parameters
    ----------
    found : Estimate
        Of these intervals.
    """
    own, reasons = evidence(intervals, found.solution), list[str]()
    told = found.determined.copy()
    for axis in np.flatnonzero(found.determined):
        line = along(found.solution, int(axis), question)
        verdict = np.array([against(own, evidence(intervals, one)) for one in line])
        why = _rivals(verdict, line[:, axis], float(found.solution[axis]))
        if why:
            told[axis] = False
            reasons.append(f"cannot tell {AXES[axis]}, {found.solution[axis]:.1f} nT by its methods: {why}")
    return found.withdrawn(told, question).because(*reasons) if reasons else found


def _rivals(verdict: Floats, place: Floats, solution: float) -> str:
    """Return which offsets of a line are not refused beside a solution; empty when none are."""
    if verdict.min() < -REFUSED:
        return f"the readings refuse it for {place[int(verdict.argmin())]:.1f} nT"
    possible = verdict < REFUSED
    at = int(np.argmin(np.abs(place - solution)))
    possible[at] = True
    stretch = np.cumsum(np.diff(possible, prepend=False))
    # Counting its edges, a stretch has a number of its own.
    other = possible & (stretch != stretch[at])
    if other.any():
        return f"{place[other].min():.1f} to {place[other].max():.1f} nT are not refused either"
    if possible[0] or possible[-1]:
        own = place[possible]
        return f"nothing from {own.min():.1f} to {own.max():.1f} nT is refused"
    return ""
