"""Where calibration intervals are cut, and what of a change at a moment no cut may hide.

Parameters that are fitted anew in every interval take up a step at an interval's edge, and most of one
that is near it. Where intervals begin is nobody's knowledge of the sensors. A change is therefore judged
with intervals whose edges keep away from its moment, as long as the others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.scoring import Index, Present, projected

Groups = Sequence[Sequence[int]]

#: Edges keep so far away from moments, in parts of an interval's usual length.
_AWAY = 0.25
#: A change shows in the intervals as they were when it takes off so many times a row's variance at least
#: (three sigma, of residuals correlated over several rows), and this part of what its size promises.
_CLEAR, _KEPT = 50.0, 0.5


def cut_around(evidence: Evidence, cut: Groups, moments: Sequence[int]) -> list[list[int]]:
    """Return intervals no edge of which is near some moments.

    An edge that is near one goes half an interval away from it, to both sides: no interval becomes longer
    than the longest. Only where another moment is there the intervals stay together.

    Parameters
    ----------
    cut : sequence of sequence of int
        Consecutive blocks of each interval.
    moments : sequence of int
        TT2000.
    """
    firsts = [*(group[0] for group in cut), len(evidence)]
    length = float(np.median([evidence.end[group[-1]] - evidence.start[group[0]] for group in cut]))
    edges: set[int] = set()
    for before, edge, after in zip(firsts, firsts[1:-1], firsts[2:], strict=False):
        if _is_free(evidence, edge, moments, _AWAY * length):
            edges.add(edge)
        else:
            edges |= {before + (edge - before) // 2, edge + -(-(after - edge) // 2)}
    inner = {one for one in edges if 0 < one < len(evidence)}
    kept = sorted(one for one in inner if _is_free(evidence, one, moments, _AWAY * length))
    return [part.tolist() for part in np.split(np.arange(len(evidence)), kept)]


def _is_free(evidence: Evidence, edge: int, moments: Sequence[int], reach: float) -> bool:
    return all(abs(int(evidence.start[edge]) - moment) >= reach for moment in moments)


def is_at_edge(evidence: Evidence, cut: Groups, moment: int, sharpness: int) -> bool:
    """Return True when a moment known no better may lie on an edge between intervals."""
    return any(abs(int(evidence.start[group[0]]) - moment) <= sharpness for group in cut[1:])


def shows(
    evidence: Evidence, present: Present, columns: Index, gamma: Floats, y: int, variance: float
) -> bool:
    """Return True when a change of a known size takes off of the residual what it should.

    Parameters
    ----------
    evidence : Evidence
        With the intervals as they were.
    gamma : ndarray, shape (column,)
        The change's values (scaled), from intervals that do not hide it.
    variance : float
        Of a row, nT^2.
    """
    left = projected(evidence.total, present)
    promised = float(gamma @ left[np.ix_(columns, columns)] @ gamma)
    gained = -2.0 * float(gamma @ left[columns, y]) - promised
    return gained > max(_CLEAR * variance, _KEPT * promised)
