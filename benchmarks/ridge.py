"""Regression on few samples and many similar columns, without harm where nothing was learnt.

Least squares on a short record spends its freedom on combinations the record hardly holds, and is
wrong by their full size elsewhere. Here coefficients are held near zero, by as much as the record
itself asks for when parts of it are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError

Mask = npt.NDArray[np.bool_]

Fold = tuple[Mask, Mask]

#: Strengths tried, in units of one group's mean square; the last one is "no correction at all".
_AMOUNTS = np.append(np.logspace(-6.0, 2.0, 41), np.inf)

#: Directions smaller than this part of the largest are not there at all.
_NOTHING = 1e-12

#: Fewer left-out parts tell no spread between them.
MIN_FOLDS = 3


@dataclass(frozen=True)
class Ridge:
    """Coefficients held near zero.

    Attributes
    ----------
    coefficient : ndarray, shape (column,)
        nT a unit of the column; all zero when the record taught nothing.
    amount : float
        Strength chosen; infinite for no correction.
    loss : ndarray, shape (fold, amount)
        Mean square left in each left-out part at each strength, nT^2; the last one is that of no
        correction.
    chosen, best : int
        Index of the strength chosen, and of the one of least loss.
    """

    coefficient: Floats
    amount: float
    loss: Floats
    chosen: int
    best: int

    @property
    def learnt(self) -> bool:
        """True when a correction is better than none on what was left out."""
        return bool(np.isfinite(self.amount))


def block_folds(count: int, block: int, margin: int = 0) -> list[Fold]:
    """Return (fitted, left out) samples of contiguous parts, each at least a block long.

    Parameters
    ----------
    count, block : int
        Samples of the record, and the fewest of a part: a period of the slowest oscillation in it.
    margin : int
        Samples on each side of a part that are neither fitted nor left out, because a filter has
        mixed them.
    """
    edges = np.linspace(0, count, max(count // block, 1) + 1).astype(int)
    index = np.arange(count)
    return [
        ((index < first - margin) | (index >= last + margin), (index >= first) & (index < last))
        for first, last in pairwise(edges)
    ]


def cautious_ridge(
    columns: Floats,
    residual: Floats,
    groups: Mapping[str, Sequence[int]],
    folds: Sequence[Fold],
    by_error: bool = True,
) -> Ridge:
    """Fit a residual by columns whose groups are expected to matter alike.

    Each column counts in units of its group's rms, so that a group's size in the record, not its unit,
    decides; a common strength is chosen by leaving out each fold. Of all strengths whose loss is within
    one standard error of the least, the strongest is taken (Breiman et al. 1984, section 3.4.3): on few
    folds the least loss is often an accident. Of records of pure noise about a sixth still get a weak
    correction, as one standard error means.

    Parameters
    ----------
    columns : ndarray, shape (time, column)
        Any unit; means are taken off.
    residual : ndarray, shape (time,)
        nT; its mean is taken off: a constant is none of the columns' business.
    groups : mapping of str to sequence of int
        Columns of each group.
    folds : sequence of Fold
        As `block_folds` returns them.
    by_error : bool
        False takes the strength of least loss.

    Raises
    ------
    CalibrationError
        When there are fewer than `MIN_FOLDS` folds.
    """
    if len(folds) < MIN_FOLDS:
        raise CalibrationError(
            f"the record has {len(folds)} parts to leave out, at least {MIN_FOLDS} are needed",
            remedy="give a longer record, or shorter blocks",
        )
    scale = _group_scale(columns, groups)
    scaled = columns * scale
    loss = np.array([_left(scaled, residual, *fold) for fold in folds])
    mean = loss.mean(axis=0)
    best = chosen = int(mean.argmin())
    if by_error:
        difference = loss - loss[:, [best]]
        error = difference.std(axis=0, ddof=1) / np.sqrt(len(folds))
        chosen = int(np.flatnonzero(mean - mean[best] <= error).max())
    coefficient = scale * _solutions(scaled, residual)[chosen]
    return Ridge(coefficient, float(_AMOUNTS[chosen]), loss, chosen, best)


def least_squares(columns: Floats, residual: Floats) -> Floats:
    """Return the plain least-squares coefficients (column,), means taken off: for comparison only."""
    return np.asarray(np.linalg.lstsq(columns - columns.mean(axis=0), residual - residual.mean())[0])


def retained(columns: Floats, groups: Mapping[str, Sequence[int]]) -> dict[str, Floats]:
    """Return what each column keeps of its square when every column of the other groups is taken out.

    Near 1 a group can be told from the others, near 0 it cannot (1 / variance inflation).

    Parameters
    ----------
    columns : ndarray, shape (time, column)
        Means are taken off.

    Returns
    -------
    dict of ndarray
        By group, one fraction a column.
    """
    unit = columns - columns.mean(axis=0)
    unit = unit / np.linalg.norm(unit, axis=0)
    found = {}
    for name, own in groups.items():
        others = np.delete(np.arange(unit.shape[1]), own)
        left, size, _ = np.linalg.svd(unit[:, others], full_matrices=False)
        basis = left[:, size > np.sqrt(_NOTHING) * size[0]] if others.size else left[:, :0]
        rest = unit[:, own] - basis @ (basis.T @ unit[:, own])
        found[name] = np.sum(rest**2, axis=0)
    return found


def _group_scale(columns: Floats, groups: Mapping[str, Sequence[int]]) -> Floats:
    scale = np.zeros(columns.shape[1])
    variance = columns.var(axis=0)
    for own in groups.values():
        scale[own] = 1.0 / np.sqrt(max(float(variance[own].mean()), _NOTHING**2))
    return scale


def _left(scaled: Floats, residual: Floats, fitted: Mask, out: Mask) -> Floats:
    """Return the mean square left in the part left out at each strength; (amount,) nT^2."""
    solutions = _solutions(scaled[fitted], residual[fitted])
    left = residual[out] - (scaled[out] @ solutions.T).T
    return np.asarray(left.var(axis=1))


def _solutions(scaled: Floats, residual: Floats) -> Floats:
    """Return the coefficients at each strength; (amount, column), 0 at the last."""
    centred = scaled - scaled.mean(axis=0)
    left, size, right = np.linalg.svd(centred, full_matrices=False)
    along = left.T @ (residual - residual.mean())
    # By the number of samples, so that a strength means the same with and without a fold.
    weight = size / (size**2 + len(scaled) * _AMOUNTS[:, None])
    return np.asarray((weight * along) @ right)
