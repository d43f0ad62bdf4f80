"""What fitted columns take over from others: algebra of Gram matrices for cross-talk and evidence."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: Places of columns in a Gram matrix.
Places = npt.NDArray[np.int64]

#: Directions that keep less than this of their own variance beside the others are dropped.
_EIGEN_CUT = 1e-6


def half_inverse(matrices: Floats) -> Floats:
    """Return L with ``L L^T`` the inverse of each matrix where it is one; (candidate, k, k)."""
    size = np.sqrt(np.clip(np.einsum("cii->ci", matrices), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    own, vectors = np.linalg.eigh(matrices * unit[:, :, None] * unit[:, None, :])
    root = np.where(own > _EIGEN_CUT, 1.0 / np.sqrt(np.where(own > _EIGEN_CUT, own, 1.0)), 0.0)
    return np.asarray(unit[:, :, None] * vectors * root[:, None, :])


def gram_inverse(matrix: Floats) -> Floats:
    """Return the inverse of a Gram matrix (k, k) along what it determines, 0 along what it does not."""
    half = half_inverse(matrix[None])[0]
    return np.asarray(half @ half.T)


def taken_over(gram: Floats, fitted: Places, ignored: Places) -> Floats:
    """Return how much of each fitted column stands for one unit of each ignored one; (..., fitted, ignored).

    With X the fitted columns and z an ignored one it is ``(X^T X)^-1 X^T z``: least squares of z on X.

    Parameters
    ----------
    gram : ndarray, shape (..., column, column)
        Gram matrix of all columns; one, or one a block.
    fitted, ignored : ndarray of int
        Their places.
    """
    stack = gram.reshape(-1, *gram.shape[-2:])
    half = half_inverse(stack[:, fitted[:, None], fitted[None, :]])
    found = half @ half.swapaxes(1, 2) @ stack[:, fitted[:, None], ignored[None, :]]
    return np.asarray(found.reshape(*gram.shape[:-2], fitted.size, ignored.size))


def left(gram: Floats, absorbed: Places, kept: Places) -> Floats:
    """Return the Gram matrix of the kept columns less what the absorbed ones explain; (..., kept, kept)."""
    over = taken_over(gram, absorbed, kept)
    cross = gram[..., kept[:, None], absorbed[None, :]]
    return np.asarray(gram[..., kept[:, None], kept[None, :]] - cross @ over)


def correlation_of(covariance: Floats) -> Floats:
    """Return the correlations of a covariance or Gram matrix (k, k), in [-1, 1]; 0 where a size is 0."""
    size = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    return np.clip(covariance * unit[:, None] * unit[None, :], -1.0, 1.0)
