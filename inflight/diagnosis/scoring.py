"""Scores of candidates on one form of the evidence: held-out loss, in-sample fit, scores of blocks.

Everything is computed after the columns already in the model (P) are projected out (Frisch, Waugh,
Lovell); all candidates at once, grouped by their number of columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.diagnosis.evidence import Evidence, solve_scaled

Index = npt.NDArray[np.int64]
#: Directions of a candidate that keep less than this of their own variance beside its others are dropped.
_EIGEN_CUT = 1e-6
#: A block in which less than this part of a column's largest block is left says nothing of it.
_QUIET = 1e-2
#: Folds of the cross-validation at most.
FOLDS = 13


@dataclass(frozen=True)
class Present:
    """What the model holds already: columns, and what is known of them beforehand (scaled 1/sigma^2)."""

    columns: Index
    precision: Floats

    def solve(self, gram: Floats) -> Floats:
        """Return the projection of all columns on those of the model; (present, column)."""
        if not self.columns.size:
            return np.zeros((0, gram.shape[0]))
        inner = gram[np.ix_(self.columns, self.columns)] + np.diag(self.precision)
        return solve_scaled(inner, gram[self.columns])


@dataclass(frozen=True)
class Scores:
    """Scores of candidates on one form.

    Attributes
    ----------
    loss0 : ndarray, shape (block,)
        Held-out sum of squares without any candidate, nT^2.
    loss : ndarray, shape (block, candidate)
        Held-out sum of squares with each.
    gain, t : ndarray, shape (candidate,)
        Part of the held-out loss it removes, and the mean of its block gains over their error.
    gamma : list of ndarray
        In-sample values, scaled.
    explained : ndarray, shape (candidate,)
        In-sample sum of squares explained, nT^2.
    active : ndarray of bool, shape (block, candidate)
        Blocks in which anything of it is left beside the calibration.
    """

    loss0: Floats
    loss: Floats
    gain: Floats
    t: Floats
    gamma: list[Floats]
    explained: Floats
    active: npt.NDArray[np.bool_]

    def behind(self, one: int, other: int) -> float:
        """Return the t by which one candidate leaves more than another, where either tells anything."""
        if one == other:
            return 0.0
        difference = self.loss[:, [one]] - self.loss[:, [other]]
        return float(hac_t(difference, self.active[:, [one]] | self.active[:, [other]])[0])


def folds_of(blocks: int, interleaved: bool = False, most: int = FOLDS) -> list[Index]:
    """Return the blocks of each fold: contiguous runs, or every k-th for effects bound to a time."""
    count = max(2, min(most, blocks))
    if interleaved:
        return [np.arange(fold, blocks, count) for fold in range(min(count, blocks))]
    return [part for part in np.array_split(np.arange(blocks), count) if part.size]


def hac_t(difference: Floats, active: npt.NDArray[np.bool_] | None = None) -> Floats:
    """Return mean over standard error of series; (series,), errors with Bartlett's kernel over blocks.

    Parameters
    ----------
    difference : ndarray, shape (block, series)
    active : ndarray of bool, shape (block, series), optional
        Blocks that tell anything: an effect that lasts a week is judged by that week.
    """
    used = np.ones(difference.shape, dtype=bool) if active is None else active
    count = np.maximum(used.sum(axis=0), 1)
    summed = np.where(used, difference, 0.0).sum(axis=0)
    centred = np.where(used, difference - summed / count, 0.0)
    variance = np.sum(centred**2, axis=0)
    reach = max(1, int(4.0 * (len(difference) / 100.0) ** (2.0 / 9.0)))
    total = variance.copy()
    for lag in range(1, min(reach, len(difference) - 1) + 1):
        weight = 1.0 - lag / (reach + 1.0)
        total += 2.0 * weight * np.sum(centred[lag:] * centred[:-lag], axis=0)
    # Few blocks can look anticorrelated by chance; that must not make them more certain.
    total = np.maximum(total, variance)
    error = np.sqrt(total * count / np.maximum(count - 1, 1))
    return np.where((error > 0) & (count > 2), summed / np.where(error > 0, error, 1.0), 0.0)


def activity(evidence: Evidence, candidates: Sequence[Index]) -> npt.NDArray[np.bool_]:
    """Return in which blocks anything is left of each candidate's columns; (block, candidate)."""
    own = np.einsum("bii->bi", evidence.gram)
    peak = np.maximum(own.max(axis=0), 1e-300)
    lively = own > _QUIET * peak
    return (
        np.stack([lively[:, columns].any(axis=1) for columns in candidates], axis=1)
        if candidates
        else lively[:, :0]
    )


def grouped(candidates: Sequence[Index]) -> list[tuple[Index, Index]]:
    """Return (positions, columns (candidate, k)) of candidates with the same number of columns."""
    sizes = np.array([len(one) for one in candidates])
    out = []
    for size in np.unique(sizes):
        positions = np.flatnonzero(sizes == size)
        out.append((positions, np.stack([candidates[int(place)] for place in positions])))
    return out


def half_inverse(matrices: Floats) -> Floats:
    """Return L with ``L L^T`` the inverse of each matrix where it is one; (candidate, k, k)."""
    size = np.sqrt(np.clip(np.einsum("cii->ci", matrices), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    own, vectors = np.linalg.eigh(matrices * unit[:, :, None] * unit[:, None, :])
    root = np.where(own > _EIGEN_CUT, 1.0 / np.sqrt(np.where(own > _EIGEN_CUT, own, 1.0)), 0.0)
    return np.asarray(unit[:, :, None] * vectors * root[:, None, :])


def projected(gram: Floats, present: Present) -> Floats:
    """Return the Gram matrix of what the model's columns leave of all others."""
    if not present.columns.size:
        return gram
    return np.asarray(gram - gram[:, present.columns] @ present.solve(gram))


def fit(
    evidence: Evidence, present: Present, candidates: Sequence[Index], y: int
) -> tuple[list[Floats], Floats]:
    """Return in-sample values (scaled) and explained sums of squares of every candidate."""
    gram = projected(evidence.total, present)
    gamma: list[Floats] = [np.empty(0)] * len(candidates)
    explained = np.zeros(len(candidates))
    for positions, columns in grouped(candidates):
        half = half_inverse(gram[columns[:, :, None], columns[:, None, :]])
        score = np.einsum("cik,ci->ck", half, gram[columns, y])
        values = -np.einsum("cik,ck->ci", half, score)
        explained[positions] = np.sum(score**2, axis=1)
        for place, value in zip(positions, values, strict=True):
            gamma[place] = value
    return gamma, explained


def score(
    evidence: Evidence, present: Present, candidates: Sequence[Index], y: int, folds: Sequence[Index]
) -> Scores:
    """Score candidates by cross-validation over blocks.

    Parameters
    ----------
    evidence : Evidence
        One form, the calibration absorbed.
    present : Present
        The model's columns.
    candidates : sequence of ndarray
        Columns of each.
    y : int
        Index of the residual.
    folds : sequence of ndarray
        Blocks held out together.
    """
    total = evidence.total
    loss0 = np.zeros(len(evidence))
    loss = np.zeros((len(evidence), len(candidates)))
    groups = grouped(candidates)
    p = present.columns
    for fold, held in zip(folds, evidence.sums(folds), strict=True):
        blocks = evidence.gram[fold]
        train = total - held
        own = present.solve(train)
        base = _quadratic(blocks, p, own[:, y], y)
        loss0[fold] = base
        for positions, columns in groups:
            inner = train[columns[:, :, None], columns[:, None, :]]
            right = train[columns, y]
            if p.size:
                across = train[columns[:, :, None], p]
                inner = inner - across @ own[:, columns].transpose(1, 0, 2)
                right = right - across @ own[:, y]
            half = half_inverse(inner)
            gamma = -np.einsum("cik,ck->ci", half, np.einsum("cik,ci->ck", half, right))
            loss[np.ix_(fold, positions)] = base[:, None] + _change(blocks, p, own, columns, gamma, y)
    whole = float(loss0.sum())
    gain = 1.0 - loss.sum(axis=0) / whole if whole > 0 else np.zeros(len(candidates))
    gamma_all, explained = fit(evidence, present, candidates, y)
    active = activity(evidence, candidates)
    return Scores(loss0, loss, gain, hac_t(loss0[:, None] - loss, active), gamma_all, explained, active)


def _quadratic(blocks: Floats, present: Index, own_y: Floats, y: int) -> Floats:
    """Return the sum of squares of the residual after the model's own columns; (block,)."""
    out = blocks[:, y, y].copy()
    if present.size:
        out -= 2.0 * blocks[:, present, y] @ own_y
        out += np.einsum("i,bij,j->b", own_y, blocks[:, present[:, None], present[None, :]], own_y)
    return np.asarray(out)


def _change(blocks: Floats, present: Index, own: Floats, columns: Index, gamma: Floats, y: int) -> Floats:
    """Return by how much candidates change the held-out sum of squares; (block, candidate)."""
    linear = np.sum(blocks[:, columns, y] * gamma, axis=2)
    inner = blocks[:, columns[:, :, None], columns[:, None, :]]
    square = np.sum(np.matmul(inner, gamma[:, :, None])[:, :, :, 0] * gamma, axis=2)
    if not present.size:
        return np.asarray(2.0 * linear + square)
    # The model's own columns give way: their change is minus the candidate's projection on them.
    beta = -np.einsum("pck,ck->cp", own[:, columns], gamma)
    own_y = own[:, y]
    model = blocks[:, present[:, None], present[None, :]]
    across = np.matmul(gamma[:, None, :], blocks[:, columns[:, :, None], present])[:, :, 0, :]
    linear = linear - across @ own_y + (blocks[:, present, y] - model @ own_y) @ beta.T
    square = square + 2.0 * np.sum(across * beta, axis=2) + np.sum(np.matmul(beta, model) * beta, axis=2)
    return np.asarray(2.0 * linear + square)


def block_scores(evidence: Evidence, present: Present, y: int) -> Floats:
    """Return each block's scores of every column at the model's own fit; (block, column).

    They sum to what the projected columns have in common with the residual.
    """
    total = evidence.total
    own = present.solve(total)
    gram = evidence.gram
    if not present.columns.size:
        return np.asarray(gram[:, :, y])
    p = present.columns
    right = gram[:, :, y] - gram[:, :, p] @ own[:, y]
    inner = right[:, p]
    return np.asarray(right - inner @ own)
