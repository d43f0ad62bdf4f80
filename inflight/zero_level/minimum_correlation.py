r"""Minimum correlation (Hedgecock 1975): changes of the field's size are unrelated to those of its direction.

For successive averages with size B and direction n, an offset c of the reading changes
:math:`dB \to dB + c \cdot dn` and :math:`dn \to dn - P c\, dB/B^2`, P across n. All three directions at once:

.. math:: \sum dB\,dn = M c, \quad M = \sum (dn\,dn^T - P\, dB^2/B^2),

which along one axis at the angle :math:`\theta` is
:math:`\mathrm{cov}(dB, d\theta) \sim c \sin\theta\, (\langle dB^2\rangle/B^2 - \langle d\theta^2\rangle)`
(up to its sign). **It is blind where compression equals rotation**: M is zero there. White noise adds as
much to either part and drops out. The offset along the mean direction has least information, because n
hardly moves along itself.
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.zero_level.davis_smith import least_variance
from inflight.zero_level.estimate import Estimate, Question, likeliest, solve
from inflight.zero_level.intervals import Bools, Intervals

NAME = "minimum correlation"


def balance(intervals: Intervals, offset: Floats) -> Floats:
    """Return compression over rotation, ``<dB^2/B^2> / (<dn^2>/2)``, of all pairs: blind at 1."""
    change, turn, size, pair = changes(intervals, offset)
    squeezed = np.sum((change / size) ** 2, where=pair)
    return np.asarray(squeezed / max(0.5 * float(np.sum(turn**2, where=pair[..., None])), 1e-300))


def changes(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats, Floats, Bools]:
    """Return dB (interval, pair), dn (interval, pair, 3), B of the pair, and which pairs there are.

    The offset has shape (3,), or (interval, 3) when each interval has its own.
    """
    field = intervals.field - _each(offset)
    size = np.linalg.norm(field, axis=2)
    pair = intervals.neighbours & (size[:, 1:] > 0) & (size[:, :-1] > 0)
    safe = np.where(np.isfinite(size) & (size > 0), size, 1.0)
    unit = np.nan_to_num(field) / safe[..., None]
    change = np.where(pair, np.diff(safe, axis=1), 0.0)
    turn = np.where(pair[..., None], np.diff(unit, axis=1), 0.0)
    return change, turn, np.sqrt(safe[:, 1:] * safe[:, :-1]), pair


def minimum_correlation(
    intervals: Intervals, used: Bools | None = None, question: Question | None = None
) -> Estimate:
    """Estimate the offset along all axes at once from uncorrelated changes of size and direction.

    M may be negative: compression that outweighs rotation tells as well as rotation alone, but intervals
    of both kinds together cancel; give them apart.

    Parameters
    ----------
    intervals : Intervals
        Of averages over whole spins (`inflight.zero_level.averaging`).
    used : ndarray of bool, shape (interval,), optional
        Any kind of interval may take part.
    question : Question, optional

    Raises
    ------
    CalibrationError
        Too few intervals.
    """
    question = question or Question()
    mask = question.chosen(NAME, intervals, used, lively=False)  # noise drops out

    def equations(offset: Floats) -> tuple[Floats, Floats]:
        return joint_equations(intervals, offset)

    part = intervals.where(mask)
    # Correlations vanish far out and within the readings, too: of several zeros that is taken at which
    # compression and rotation differ most.
    found = likeliest(
        [
            solve(NAME, equations, intervals, mask, question, first=first, signed=True)
            for first in question.begins(least_variance(part, question))
        ],
        lambda one: abs(float(np.log(balance(part, one.solution)))),
    )
    ratio = float(balance(part, found.solution))
    told = f"compression over rotation is {ratio:.2f}"
    if not found.determined[np.asarray(question.free)].all():
        told += "; the method is blind where it is 1"
    return found.because(told)


def joint_equations(intervals: Intervals, offset: Floats) -> tuple[Floats, Floats]:
    """Return ``sum dB dn`` (interval, 3) and M (interval, 3, 3) of the pairs of each interval."""
    change, turn, size, pair = changes(intervals, offset)
    middle = np.nan_to_num(0.5 * (intervals.field[:, 1:] + intervals.field[:, :-1]) - _each(offset))
    unit = middle / np.maximum(np.linalg.norm(middle, axis=2, keepdims=True), 1e-300)
    squeezed = np.where(pair, (change / size) ** 2, 0.0)
    scores = np.einsum("kp,kpi->ki", change, turn)
    rotation = np.einsum("kpi,kpj->kij", turn, turn)
    along = np.einsum("kp,kpi,kpj->kij", squeezed, unit, unit, optimize=True)
    across = squeezed.sum(axis=1)[:, None, None] * np.eye(3) - along
    return scores, rotation - across


def _each(offset: Floats) -> Floats:
    return offset[:, None, :] if offset.ndim == 2 else offset
