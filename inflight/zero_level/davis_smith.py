r"""Davis and Smith (1968): the offset that makes the square of the field vary least.

With readings B and offset O the square is :math:`|B - O|^2 = B^2 - 2 B \cdot O + O^2`. Over an interval
:math:`\mathrm{var}(B^2 - 2 B \cdot O)` is least where :math:`A O = b`, :math:`A = \mathrm{cov}(B, B)`,
:math:`b = \mathrm{cov}(B, B^2)/2`; intervals are added, each less its own mean, so that slow compressions
between intervals do not enter. The same equations hold in a turning frame: O is in the sensor's axes.

White noise adds its variance to A and that times the mean field to b, which pulls the offset towards the
mean field: both are taken off when the noise is stated. (Estimated from the readings it would hold
turbulence, and taking that off pulls by more than the noise does.) Compressions of variance C along the
field B_0 add C B_0 to b. The method as published is pulled by ``inverse(A) sum(C B_0)``, whence Leinweber
et al. (2008) search for pure rotations. C is seen in the corrected field, so the pull is taken off here:
``(A - C) O = b - C mean(B)``. That is minimum correlation over whole intervals, and as blind where
compression equals rotation.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.zero_level.estimate import Estimate, Question, informed, likeliest, solve
from inflight.zero_level.intervals import Bools, Intervals

NAME = "davis-smith"


def moments(intervals: Intervals) -> tuple[Floats, Floats]:
    """Return A (interval, 3, 3), nT^2, and b (interval, 3), nT^3, without the white noise stated."""
    delta, count = intervals.fluctuation, intervals.count
    square = np.nan_to_num(0.5 * np.sum(intervals.field**2, axis=2))
    b = np.einsum("ksi,ks->ki", delta, square) / count[:, None]
    noise = intervals.white**2
    return intervals.covariance - noise * np.eye(3), b - noise * intervals.mean


def compression(intervals: Intervals, offset: Floats) -> Floats:
    """Return the variance of |B - O| in each interval; (interval,), nT^2."""
    size = np.linalg.norm(intervals.field - offset, axis=2)
    mean = np.nansum(size, axis=1) / intervals.count
    return np.asarray(np.nansum((size - mean[:, None]) ** 2, axis=1) / intervals.count)


def davis_smith(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None, corrected: bool = True
) -> Estimate:
    """Estimate the offset from the least variance of the square of the field.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals (`inflight.zero_level.selection`); all when absent.
    question : Question, optional
    corrected : bool
        Whether the pull of compressions is taken off; else it is told and enters the covariance.

    Returns
    -------
    Estimate

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.chosen(NAME, intervals, used)
    a, b = moments(intervals)
    weight = intervals.count[:, None]

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        left, slope = b - a @ offset, a
        if corrected:
            squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
            left = left - squeezed[:, None] * (intervals.mean - offset)
            slope = slope - squeezed[:, None, None] * np.eye(3)
        return weight * left, weight[..., None] * slope

    if not corrected:
        found = solve(NAME, equations, intervals, mask, question, turning=True)
        return found.pulled(compression_pull(intervals, found, question), "compressions")
    part = intervals.where(mask)
    each = [
        solve(NAME, equations, intervals, mask, question, first=first, signed=True)
        for first in question.begins(least_variance(part, question))
    ]
    # The offset under which the size of the field varies least.
    return likeliest(each, lambda one: -float(np.sum(compression(part, one.solution) * part.count)))


def least_variance(intervals: Intervals, question: Question) -> Floats:
    """Return the offset of least variance of the square of all intervals, in closed form; (3,), nT."""
    a, b = moments(intervals)
    start, weight = np.asarray(question.start), intervals.count[:, None]
    inverse, _ = informed(weight[..., None] * a, np.asarray(question.free), 0.0)
    return np.asarray(start + inverse @ np.sum(weight * (b - a @ start), axis=0))


def compression_pull(intervals: Intervals, found: Estimate, question: Question) -> Floats:
    """Return what compressions along the mean field do to a Davis-Smith offset; (3,), nT."""
    part = intervals.where(found.used)
    rest = np.maximum(compression(part, found.solution) - part.white**2, 0.0)
    slopes = part.count[:, None, None] * moments(part)[0]
    inverse, _ = informed(slopes, np.asarray(question.free), 0.0)
    weight = (part.count * rest)[:, None]
    return np.asarray(inverse @ np.sum(weight * (part.mean - found.solution), axis=0))
