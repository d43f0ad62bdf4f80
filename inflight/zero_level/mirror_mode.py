r"""Mirror modes (Plaschke and Narita 2016; in 3-D Plaschke et al. 2017): compressions lie along the field.

In a mirror mode the direction D of most variance is that of the mean field: the cross product of D and
:math:`\bar B - O` is zero. One interval tells the offset across D; intervals with different D tell all of
it: O_z = mean B_z less the mean in the spin plane times the tangent of D's elevation is
what is left when x and y are known. With b the direction of the corrected mean field the equations are
:math:`\sum P_b D (b \cdot D) / |\bar B - O| = 0`: errors of D enter once, and do not pull the offset along
the field as they would when P_D stood there. Errors of b do, by at most ``sum(angle^2 b / |B|)`` over the
slopes: the field may turn within an interval. That enters the covariance; longer intervals lessen it.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.robust import biweight, biweight_slope, robust_sigma
from inflight.zero_level.estimate import Estimate, Question, answering, informed, solve
from inflight.zero_level.intervals import Bools, Intervals

NAME = "mirror mode"


def most_variance(intervals: Intervals) -> Floats:
    """Return the direction of most variance of each interval; (interval, 3)."""
    _, vectors = np.linalg.eigh(intervals.covariance)
    return np.asarray(vectors[:, :, 2])


def mirror_mode(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None
) -> Estimate:
    """Estimate the offset from the direction of most variance.

    Parameters
    ----------
    intervals : Intervals
    used : ndarray of bool, shape (interval,), optional
        Compressional intervals (`inflight.zero_level.selection`); all when absent.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.chosen(NAME, intervals, used)
    direction, mean = most_variance(intervals), intervals.mean

    def leaning(offset: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        field = mean - offset
        size = np.maximum(np.linalg.norm(field, axis=1), 1e-6)
        unit = field / size[:, None]
        lean = np.sum(direction * unit, axis=1)
        miss = direction * np.sign(lean)[:, None] - unit * np.abs(lean)[:, None]
        angle = np.linalg.norm(miss, axis=1)
        # The angles are two-dimensional; their usual size is that of what is used.
        pull = angle / robust_sigma(angle[mask], floor=1e-6)
        across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        return miss, pull, size, np.abs(lean), across

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        miss, pull, size, lean, across = leaning(offset)
        say = biweight(pull)
        # A mean reading that is too large turns away from D: the offset is what it is too large by.
        return -(say / size)[:, None] * miss, (say * lean / size**2)[:, None, None] * across

    def answer(offset: Floats) -> Floats:
        miss, pull, size, lean, across = leaning(offset)
        along = miss / np.maximum(np.linalg.norm(miss, axis=1), 1e-300)[:, None]
        radial = along[:, :, None] * along[:, None, :]
        # Across the miss the influence keeps its weight, along it the weight gives way.
        given = (biweight_slope(pull) - biweight(pull))[:, None, None] * radial
        return np.asarray((lean / size**2)[:, None, None] * (biweight(pull)[:, None, None] * across + given))

    found = solve(NAME, equations, intervals, mask, question, answer, first=question.begins(np.zeros(3))[0])
    miss, pull, size, _, _ = leaning(found.solution)
    square = np.sum(miss**2, axis=1) * biweight(pull) / size**2
    inverse, _ = informed(equations(found.solution)[1][mask], np.asarray(question.free), 0.0)
    inverse = answering(inverse, answer(found.solution)[mask].sum(axis=0))
    most = inverse @ np.sum((square[:, None] * (mean - found.solution))[mask], axis=0)
    return found.pulled(most / np.sqrt(3.0), "turning of the mean field within intervals")
