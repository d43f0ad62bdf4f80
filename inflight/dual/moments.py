"""What cells of both sensors say of the matrix from difference to outboard sensor, and how well.

Row k of the matrix is regressed from the outboard reading's axis k on the stray part of the difference, each
cell weighted by the ambient field's variance there. What the difference holds of noise is taken out of its
squares, else the matrix comes out too small; the noise stays in the regression's error, and so does ambient
field that leaks into the difference. Where the ambient field hides everything nothing is said, and what was
known before remains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from inflight.arrays import Floats
from inflight.dual.scales import Cells

#: Weighted square of the difference along a direction that tells something of the matrix.
_SEEN = 0.1
#: The noise that both series share is known to this part of the difference's.
_UNSURE = 0.1
#: Blocks of time whose scatter tells how far the variances can be believed.
_BLOCKS = 24
#: Neighbouring cells of a scale whose ambient field is about as lively.
_ALIKE = 5
_LEAST = 1e-12
#: A basis of all matrices, row by row.
ELEMENTS = np.eye(9).reshape(9, 3, 3)


@dataclass(frozen=True)
class Noise:
    """White noise of the difference and how much of it is the outboard sensor's.

    Attributes
    ----------
    covariance : ndarray, shape (3, 3)
        Of the difference, nT^2.
    share, share_sigma : float
        Part of it that is the outboard sensor's: it stands in both series, with opposite sign.
    """

    covariance: Floats
    share: float
    share_sigma: float

    @property
    def floor(self) -> Floats:
        """Least variance of the outboard reading, nT^2; (axis,)."""
        return np.maximum(self.share * np.diag(self.covariance), 1e-12)


class Whitened(NamedTuple):
    """Rows of the matrix as a regression with errors of size one: ``wanted[k] = design[k] matrix[k]``."""

    design: Floats  # (axis, 3, 3)
    wanted: Floats  # (axis, 3)


@dataclass(frozen=True)
class Moments:
    """Weighted sums over cells for each axis of the outboard sensor, in blocks of time.

    Attributes
    ----------
    square : ndarray, shape (block, axis, 3, 3)
        Of the stray part of the difference.
    cross : ndarray, shape (block, axis, 3)
        Of it with the outboard reading.
    noise : ndarray, shape (block, axis, 3, 3)
        The white noise's part of the squares.
    error : ndarray, shape (axis, 3, 3)
        Covariance of what leak and shared noise add to the sum of `cross`.
    """

    square: Floats
    cross: Floats
    noise: Floats
    error: Floats

    def solve(self, basis: Floats, prior: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the factors of matrices that explain the outboard field, and their covariance.

        The covariance is widened by what blocks of time disagree beyond it: units of different places, which
        no one matrix describes, show there.

        Parameters
        ----------
        basis : ndarray, shape (parameter, 3, 3)
        prior : tuple of ndarray, shapes (9,), (9, 9)
            Mean and covariance of the elements of the matrix, row by row, before anything is seen.
        """
        flat = basis.reshape(len(basis), 9)
        first, _ = self._regressed(basis, prior, self.whitened(prior[0].reshape(3, 3), 1.0))
        matrix = (first @ flat).reshape(3, 3)
        return self._regressed(basis, prior, self.whitened(matrix, self.excess(matrix)))

    def _regressed(
        self, basis: Floats, prior: tuple[Floats, Floats], told: Whitened
    ) -> tuple[Floats, Floats]:
        flat = basis.reshape(len(basis), 9)
        precision = np.linalg.inv(prior[1])
        total = flat @ precision @ flat.T
        right = flat @ precision @ prior[0]
        for axis in range(3):
            design = told.design[axis] @ basis[:, axis].T
            total += design.T @ design
            right += design.T @ told.wanted[axis]
        covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
        return covariance @ right, covariance

    def whitened(self, matrix: Floats, excess: float) -> Whitened:
        """Return the regression of all rows with errors of size one about a matrix; `excess` widens them."""
        clear = self._clear()
        design, wanted = np.empty((3, 3, 3)), np.empty((3, 3))
        for axis in range(3):
            unsure = _UNSURE * self.noise[:, axis].sum(axis=0) @ matrix[axis]
            spread = self.square[:, axis].sum(axis=0) + self.error[axis] + np.outer(unsure, unsure)
            value, vector = np.linalg.eigh(excess * spread)
            inverse = (vector / np.sqrt(np.maximum(value, _LEAST))).T
            design[axis] = inverse @ clear[axis]
            wanted[axis] = inverse @ self.cross[:, axis].sum(axis=0)
        return Whitened(design, wanted)

    def _clear(self) -> Floats:
        """Return the sums of squares without their noise, (axis, 3, 3): none is below zero, or above all."""
        out = np.empty((3, 3, 3))
        for axis in range(3):
            whole = self.square[:, axis].sum(axis=0)
            value, vector = np.linalg.eigh(whole)
            root = vector * np.sqrt(np.maximum(value, _LEAST))
            inverse = vector / np.sqrt(np.maximum(value, _LEAST))
            share, turn = np.linalg.eigh(inverse.T @ (whole - self.noise[:, axis].sum(axis=0)) @ inverse)
            out[axis] = root @ (turn * np.clip(share, 0.0, 1.0)) @ turn.T @ root.T
        return out

    def scatter(self, matrix: Floats) -> float:
        """Return the variance of an element of the matrix between blocks of time, beyond chance.

        Units of different places have different matrices; the one that switches now is not the mean of all.
        """
        extra = power = 0.0
        for axis in range(3):
            for one, square in zip(self._scores(axis, matrix[axis]), self.square[:, axis], strict=True):
                value, vector = np.linalg.eigh(square)
                seen = value > _SEEN
                extra += float(np.sum((vector.T @ one)[seen] ** 2 / value[seen])) - float(seen.sum())
                power += float(value[seen].sum())
        return max(extra, 0.0) / power if power > 0 else 0.0

    def _scores(self, axis: int, row: Floats) -> Floats:
        return np.asarray(self.cross[:, axis] - (self.square[:, axis] - self.noise[:, axis]) @ row)

    def excess(self, matrix: Floats) -> float:
        """Return the variance between blocks of time beside what the squares state; at least 1."""
        found = 0.0
        for axis in range(3):
            score = self._scores(axis, matrix[axis])
            middle = score.T @ score - np.outer(score.sum(axis=0), score.sum(axis=0)) / len(score)
            stated = np.linalg.pinv(self.square[:, axis].sum(axis=0), hermitian=True)
            found += float(np.trace(middle @ stated)) / 9.0
        return max(found, 1.0)


def moments(cells: Cells, rows: tuple[Floats, Floats], noise: Noise, leak: Floats) -> Moments:
    """Return what cells say of the matrix, in blocks of time.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d].
    rows : tuple of ndarray, shape (3, 6) each
        What makes the ambient and the stray field of [B_out, d].
    noise : Noise
    leak : ndarray, shape (9, 9)
        Covariance of the leak's elements, row by row.
    """
    ambient, stray = rows
    bent = cells.covariance @ stray.T
    square, cross = stray @ bent, bent[:, :3]
    field = ambient @ cells.covariance @ ambient.T
    # The noise that both series share is out of the cells, but it is in what is left of the reading.
    both = np.diag(ambient[:, :3] @ (noise.share * noise.covariance) @ ambient[:, 3:].T)
    variance = np.maximum(np.einsum("ckk->ck", field) - 2.0 * both, noise.floor)
    weight = cells.count[:, None] / _usual(variance, cells)
    block = cells.blocks(_BLOCKS)
    sums, crosses = np.zeros((_BLOCKS, 3, 3, 3)), np.zeros((_BLOCKS, 3, 3))
    weights = np.zeros((_BLOCKS, 3))
    np.add.at(sums, block, weight[:, :, None, None] * square[:, None])
    np.add.at(crosses, block, weight[:, :, None] * cross)
    np.add.at(weights, block, weight)
    # Ambient field left in the difference is regressed on itself, and on other axes of it that go with it.
    alike = np.einsum("ck,ckj->kj", weight, field)
    error = np.einsum("kj,kl,ijml->kim", alike, alike, leak.reshape(3, 3, 3, 3))
    shared = noise.share_sigma * np.einsum("k,ki->ki", weight.sum(axis=0), noise.covariance)
    error = error + np.einsum("ki,kj->kij", shared, shared)
    return Moments(sums, crosses, weights[:, :, None, None] * noise.covariance, error)


def _usual(variance: Floats, cells: Cells) -> Floats:
    """Return variances (cell, axis) half their own, half those around them on the same scale.

    By its own alone a cell in which ambient and stray field cancel by chance would count for many.
    """
    out = variance.copy()
    for scale in np.unique(cells.scale):
        here = np.flatnonzero(cells.scale == scale)
        around = ndimage.uniform_filter1d(variance[here], _ALIKE, axis=0, mode="nearest")
        out[here] = 0.5 * variance[here] + 0.5 * around
    return out
