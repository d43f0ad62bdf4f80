"""Compiled loops over the samples of a block: residual of the nine parameters, and its Gram matrices.

They work with the nine numbers (K_xx, K_yy, K_zz, K_xy, K_xz, K_yz, E0_x, E0_y, E0_z) and the residual
``r = |K (E - E0) - S| - F`` (Yin 2010, eqs. 2.5, 2.6); see `inflight.calibration.scalar`, which imports them
where a block is fitted: solving from stored sums needs no compiler.
"""

from __future__ import annotations

import numba
import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import Int64

#: Rows handled at once: the block of columns stays in the cache and BLAS forms its Gram matrix; measured.
_ROWS = 2048

#: Columns: nine parameters and the residual.
WIDTH = 10


@numba.njit(cache=True, nogil=True)
def residuals(theta: Floats, e: Floats, s: Floats, f: Floats) -> Floats:  # pragma: no cover
    """Return |K (E - E0) - S| - F; (time,) nT.

    Parameters
    ----------
    theta : ndarray, shape (9,)
        K entries and offsets.
    e, s : ndarray, shape (time, 3)
        Raw readings and additive fields, nT; `s` may have one row for all.
    f : ndarray, shape (time,)
        Corrected scalar field, nT.
    """
    out = np.empty(f.size)
    many = s.shape[0] > 1
    for i in range(f.size):
        x, y, z = e[i, 0] - theta[6], e[i, 1] - theta[7], e[i, 2] - theta[8]
        q = i if many else 0
        bx = theta[0] * x + theta[3] * y + theta[4] * z - s[q, 0]
        by = theta[1] * y + theta[5] * z - s[q, 1]
        bz = theta[2] * z - s[q, 2]
        out[i] = np.sqrt(bx * bx + by * by + bz * bz) - f[i]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(
    rows: Floats, theta: Floats, e: Floats, s: Floats, f: Floats, width: float, scale: Floats, first: int
) -> tuple[float, float]:  # pragma: no cover
    """Fill a block of weighted, scaled rows [nine columns | residual].

    The weight is Tukey's biweight ``(1 - (r / width)^2)^2``; its root multiplies the row. Returns
    the sums of the weights and of the slopes of r w(r).
    """
    last = s.shape[0] - 1
    weights, slopes = 0.0, 0.0
    for k in range(rows.shape[0]):
        i = first + k
        x, y, z = e[i, 0] - theta[6], e[i, 1] - theta[7], e[i, 2] - theta[8]
        q = min(i, last)
        bx = theta[0] * x + theta[3] * y + theta[4] * z - s[q, 0]
        by = theta[1] * y + theta[5] * z - s[q, 1]
        bz = theta[2] * z - s[q, 2]
        norm = np.sqrt(bx * bx + by * by + bz * bz)
        r = norm - f[i]
        u = min((r / width) ** 2, 1.0)
        root = 1.0 - u
        weights += root * root
        slopes += root * (1.0 - 5.0 * u)
        part = root / norm
        ux, uy, uz = part * bx, part * by, part * bz
        rows[k, 0] = ux * x * scale[0]
        rows[k, 1] = uy * y * scale[1]
        rows[k, 2] = uz * z * scale[2]
        rows[k, 3] = ux * y * scale[3]
        rows[k, 4] = ux * z * scale[4]
        rows[k, 5] = uy * z * scale[5]
        rows[k, 6] = -theta[0] * ux * scale[6]
        rows[k, 7] = -(theta[3] * ux + theta[1] * uy) * scale[7]
        rows[k, 8] = -(theta[4] * ux + theta[5] * uy + theta[2] * uz) * scale[8]
        rows[k, 9] = root * r
    return weights, slopes


@numba.njit(cache=True, nogil=True)
def _add(total: Floats, gram: Floats) -> None:  # pragma: no cover
    """Add a matrix in place, number by number: numba takes seconds to compile the sum of slices."""
    for i in range(WIDTH):
        for j in range(WIDTH):
            total[i, j] += gram[i, j]


@numba.njit(cache=True, nogil=True)
def gram_at(
    theta: Floats, e: Floats, s: Floats, f: Floats, root: Floats, scale: Floats
) -> Floats:  # pragma: no cover
    """Return the Gram matrix linearised at `theta` with given weights ``root^2``; (10, 10) nT^2."""
    out = np.zeros((WIDTH, WIDTH))
    rows = np.empty((_ROWS, WIDTH))
    for at in range(0, f.size, _ROWS):
        part = rows[: min(_ROWS, f.size - at)]
        _fill(part, theta, e, s, f, np.inf, scale, at)
        for k in range(part.shape[0]):
            for column in range(WIDTH):
                part[k, column] *= root[at + k]
        _add(out, np.dot(part.T, part))
    return out


@numba.njit(cache=True, nogil=True)
def compress(
    e: Floats, s: Floats, f: Floats, good: npt.NDArray[np.bool_]
) -> tuple[Floats, Floats, Floats]:  # pragma: no cover
    """Return the rows where `good` is True; several times faster than indexing by a mask."""
    many = good.sum()
    held = s.shape[0] > 1
    e_out, f_out = np.empty((many, 3)), np.empty(many)
    s_out = np.empty((many, 3)) if held else s.copy()
    k = 0
    for i in range(good.size):
        if good[i]:
            for axis in range(3):
                e_out[k, axis] = e[i, axis]
                if held:
                    s_out[k, axis] = s[i, axis]
            f_out[k] = f[i]
            k += 1
    return e_out, s_out, f_out


@numba.njit(cache=True, nogil=True)
def grams(
    theta: Floats, e: Floats, s: Floats, f: Floats, width: float, scale: Floats, edges: Int64
) -> tuple[Floats, float, float]:  # pragma: no cover
    """Return the weighted Gram matrices of [nine columns | residual] of consecutive sub-blocks.

    Parameters
    ----------
    theta : ndarray, shape (9,)
        Point of linearisation.
    e, s, f : ndarray
        Readings (time, 3), additive fields (time, 3) or (1, 3), scalar field (time,); finite, nT.
    width : float
        Where the biweight ends, nT; infinite for plain least squares.
    scale : ndarray, shape (9,)
        Units of the columns: a column holds the change of the residual by ``scale`` of its parameter.
    edges : ndarray of int64, shape (block + 1,)
        Row indices that bound the sub-blocks.

    Returns
    -------
    gram : ndarray, shape (block, 10, 10)
        nT^2.
    weights, slopes : float
        Sums of the biweight and of the slope of its influence function.
    """
    out = np.zeros((edges.size - 1, WIDTH, WIDTH))
    rows = np.empty((_ROWS, WIDTH))
    weights, slopes = 0.0, 0.0
    for b in range(edges.size - 1):
        at = edges[b]
        while at < edges[b + 1]:
            many = min(_ROWS, edges[b + 1] - at)
            part = rows[:many]
            w, d = _fill(part, theta, e, s, f, width, scale, at)
            weights += w
            slopes += d
            _add(out[b], np.dot(part.T, part))
            at += many
    return out, weights, slopes
