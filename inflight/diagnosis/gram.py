"""One block's sufficient statistics: the Gram matrix of [columns | residuals], raw and prewhitened.

Everything that is said about candidates is computed from these matrices (see `inflight.diagnosis.scoring`);
no sample is read again.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import GAP, SECOND


def root_weights(weight: Floats) -> Floats:
    """Return the factor of each row, so that every good sample counts once; (time,)."""
    return np.sqrt(np.clip(weight, 0.0, None))


def prewhiten(values: Floats, weight: Floats, stamps: npt.NDArray[np.int64], memory_s: float) -> Floats:
    """Take from every row what the one before it foretells: ``v_t - exp(-dt / memory) v_(t-1)``.

    Parameters
    ----------
    values : ndarray, shape (time, ...)
    weight : ndarray, shape (time,)
        Rows of weight 0, and the first ones after a gap, become 0.
    memory_s : float
        Correlation time that is assumed, seconds.
    """
    step = np.diff(stamps) / SECOND
    usual = float(np.median(step)) if step.size else 1.0
    follows = (step <= GAP * usual) & (weight[1:] > 0) & (weight[:-1] > 0)
    phi = np.where(follows, np.exp(-step / memory_s), 0.0)
    shape = (-1,) + (1,) * (values.ndim - 1)
    out = np.empty_like(values)
    out[0] = 0.0
    np.multiply(values[:-1], -phi.reshape(shape), out=out[1:])
    out[1:] += values[1:]
    out[1:][~follows] = 0.0
    return out


def gram_of(columns: Floats, residuals: Floats, weight: Floats, parts: Sequence[slice]) -> Floats:
    """Return the Gram matrices of consecutive parts of a block; (part, column, column), nT^2.

    Parameters
    ----------
    columns : ndarray, shape (time, row, column)
    residuals : ndarray, shape (time, row, residual)
    weight : ndarray, shape (time,)
    parts : sequence of slice
        Of the time.
    """
    width = columns.shape[-1] + residuals.shape[-1]
    out = np.zeros((len(parts), width, width))
    root = root_weights(weight)[:, None]
    kinds = columns.shape[-1]
    for index, part in enumerate(parts):
        # One run of memory a column, whatever the order the columns come in.
        flat = np.empty((width, *root[part].shape[:1], columns.shape[1]))
        np.multiply(np.moveaxis(columns[part], -1, 0), root[part], out=flat[:kinds])
        np.multiply(np.moveaxis(residuals[part], -1, 0), root[part], out=flat[kinds:])
        flat = flat.reshape(width, -1)
        out[index] = flat @ flat.T
    return out


def pack(gram: Floats) -> Floats:
    """Return the upper triangles of symmetric matrices; (block, entry)."""
    upper = np.triu_indices(gram.shape[-1])
    return np.asarray(gram[:, upper[0], upper[1]])


def unpack(packed: Floats) -> Floats:
    """Return the symmetric matrices of their upper triangles; (block, column, column)."""
    width = int((np.sqrt(8 * packed.shape[1] + 1) - 1) / 2)
    out = np.zeros((packed.shape[0], width, width))
    upper = np.triu_indices(width)
    out[:, upper[0], upper[1]] = packed
    out[:, upper[1], upper[0]] = packed
    return out


def parts_of(stamps: npt.NDArray[np.int64], edges: Sequence[int]) -> list[slice]:
    """Return the rows between consecutive TT2000 edges."""
    places = np.searchsorted(stamps, np.asarray(edges, dtype=np.int64)).tolist()
    return [slice(a, b) for a, b in pairwise(places)]
