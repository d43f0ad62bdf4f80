"""The array type of the whole project, sums over runs of rows, products with axes, and straight pieces."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

Number = TypeVar("Number", np.float64, np.complex128)


def sums_of_runs(values: npt.NDArray[Number], starts: npt.NDArray[np.int64]) -> npt.NDArray[Number]:
    """Return the sums of rows (row, column) from each start to the next; (run, column), 0 for none."""
    out = np.zeros((starts.size - 1, values.shape[1]), dtype=values.dtype)
    filled = np.flatnonzero(np.diff(starts))
    if filled.size:
        out[filled] = np.add.reduceat(values, starts[filled], axis=0)
    return out


def times_axes(series: Floats, numbers: Floats) -> Floats:
    """Return a series (time,) times one number an axis, (axis,) or (time, axis); (time, axis).

    Each axis is one run of memory: what is added to it or multiplied by it is then several times as fast.
    """
    return np.asarray((series * (numbers[:, None] if numbers.ndim == 1 else numbers.T)).T)


def finite_rows(values: Floats) -> npt.NDArray[np.bool_]:
    """Return which rows of (row,) or (row, component) hold nothing but finite values; (row,)."""
    # A product is ten times as fast as a sum over the few components.
    return np.asarray(np.isfinite(values if values.ndim == 1 else values @ np.ones(values.shape[1])))


def straight_pieces(values: Floats, knots: Floats) -> Floats:
    """Return functions that are 1 at one knot, 0 at the others and straight between; (..., knot).

    Beyond the outer knots they stay as they are there.
    """
    return np.stack([np.interp(values, knots, only) for only in np.eye(knots.size)], axis=-1)
