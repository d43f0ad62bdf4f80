r"""Wang and Pan (2021): every Alfvenic interval has a line of offsets that keep the field's size constant.

The tip of a field of constant size moves on a sphere, in one interval nearly on an arc: any centre on the
axis of the arc explains it. The axis is the direction of least variance u; across it the best centre
solves ``A O = b`` (`inflight.zero_level.davis_smith`). The offset is where the lines of intervals with
different u meet: :math:`\sum w P_u (b - A O) = 0`. A line's weight is how well it keeps the size constant,
``samples / var(B^2/2)``, so a compressed interval has little say; drifts of the size within an interval
are taken off first.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.zero_level.davis_smith import compression, moments
from inflight.zero_level.estimate import Estimate, Question, answering, informed, solve
from inflight.zero_level.intervals import Bools, Intervals

NAME = "wang-pan"


def lines(intervals: Intervals) -> tuple[Floats, Floats]:
    """Return the direction (interval, 3) of each line and the projector across it (interval, 3, 3)."""
    _, vectors = np.linalg.eigh(intervals.covariance)
    least = vectors[:, :, 0]
    return least, np.eye(3) - least[:, :, None] * least[:, None, :]


def wang_pan(intervals: Intervals, used: Bools | None = None, question: Question | None = None) -> Estimate:
    """Estimate the offset as the meeting point of the intervals' lines.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Alfvenic intervals; all when absent.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.chosen(NAME, intervals, used)
    a, b = moments(intervals)
    across = lines(intervals)[1]
    slope = across @ a @ across

    def parts(offset: Floats) -> tuple[Floats, Floats]:
        squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
        left = b - a @ offset - squeezed[:, None] * (intervals.mean - offset)
        unrest = _unrest(intervals, offset)
        # No line is known much better than usual: the little unrest of some intervals is chance.
        return left, intervals.count / (unrest + np.median(unrest[mask]))

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        left, weight = parts(offset)
        return weight[:, None] * np.einsum("kij,kj->ki", across, left), weight[:, None, None] * slope

    def answer(offset: Floats) -> Floats:
        left, weight = parts(offset)
        left = np.einsum("kij,kj->ki", across, left)
        follow = (2.0 * weight**2 / intervals.count)[:, None, None] * left[:, :, None] * left[:, None, :]
        return np.asarray(weight[:, None, None] * slope - follow)

    found = solve(NAME, equations, intervals, mask, question, answer, first=question.begins(np.zeros(3))[0])
    left, weight = parts(found.solution)
    along = weight[:, None] * np.einsum("kij,kj->ki", np.eye(3) - across, left)
    inverse, _ = informed(equations(found.solution)[1][mask], np.asarray(question.free), 0.0)
    inverse = answering(inverse, answer(found.solution)[mask].sum(axis=0))
    return found.pulled(inverse @ along[mask].sum(axis=0), "errors of the lines' directions")


def _unrest(intervals: Intervals, offset: Floats) -> Floats:
    """Return the variance of half the square of the corrected field; (interval,), nT^4."""
    half = 0.5 * np.sum((intervals.field - offset) ** 2, axis=2)
    rest = np.nan_to_num(half - (np.nansum(half, axis=1) / intervals.count)[:, None])
    return np.asarray(np.sum(rest**2, axis=1) / intervals.count)
