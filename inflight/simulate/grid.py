"""Smooth series on nodes every 30 s of absolute time, and their interpolation to any regular sampling.

Nodes are anchored to TT2000, not to a day, so a series is one function of time whatever span is
asked for. Eight-point Lagrange interpolation on regular phases is one small matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.errors import SamplesError
from inflight.time import SECOND

Float = npt.NDArray[np.float64]
Int64 = npt.NDArray[np.int64]

#: Distance of nodes, ns: a twelfth of the shortest wave of degree 13 along an orbit.
STEP = 30 * SECOND
_TAPS = 8
_BEFORE = _TAPS // 2 - 1


@dataclass(frozen=True)
class Grid:
    """`count` nodes from node number `first`; node k lies at TT2000 = k * STEP."""

    first: int
    count: int

    @classmethod
    def covering(cls, start: int, end: int) -> Grid:
        """Return the nodes that interpolation anywhere in ``[start, end]`` (TT2000 ns) needs."""
        first = start // STEP - _TAPS
        return cls(first, end // STEP + _TAPS + 1 - first)

    @property
    def seconds(self) -> Float:
        """Time of the nodes, s of TT2000, shape (count,)."""
        return np.asarray((self.first + np.arange(self.count)) * (STEP / SECOND), dtype=np.float64)

    def part(self, other: Grid) -> slice:
        """Return where the nodes of a grid inside this one stand."""
        return slice(other.first - self.first, other.first - self.first + other.count)


@dataclass(frozen=True)
class Sampling:
    """Regular times: `count` of them from `start` every `cadence`, TT2000 ns."""

    start: int
    cadence: int
    count: int

    @classmethod
    def of_span(cls, start: int, end: int, cadence: int) -> Sampling:
        """Return the times in the half-open span ``[start, end)``."""
        return cls(start, cadence, -(-(end - start) // cadence))

    @property
    def tt2000(self) -> Int64:
        """The times, int64 ns, shape (count,)."""
        return self.start + self.cadence * np.arange(self.count, dtype=np.int64)

    @property
    def seconds(self) -> Float:
        """The times, s of TT2000, shape (count,)."""
        return self.tt2000 / SECOND

    def shifted(self, seconds: float) -> Sampling:
        """Return the same times moved by `seconds`, exact to a nanosecond."""
        return Sampling(self.start + round(seconds * SECOND), self.cadence, self.count)


def interpolate(values: Float, grid: Grid, times: Sampling) -> Float:
    """Interpolate a series on nodes to regular times.

    Parameters
    ----------
    values : ndarray, shape (grid.count, ...)
        Smooth over a few nodes; any unit.
    grid : Grid
        Of the values.
    times : Sampling
        Wanted times; `STEP` must be a multiple of their cadence.

    Returns
    -------
    ndarray, shape (times.count, ...)

    Raises
    ------
    SamplesError
        When the cadence does not divide `STEP` or the nodes do not reach.
    """
    if STEP % times.cadence:
        raise SamplesError(f"cadence {times.cadence} ns does not divide the {STEP} ns of the nodes")
    cell, within = divmod(times.start - grid.first * STEP, STEP)
    skip, phase = divmod(within, times.cadence)
    per_cell = STEP // times.cadence
    cells = -(-(skip + times.count) // per_cell)
    low, high = cell - _BEFORE, cell + cells - 1 + _TAPS - _BEFORE
    if low < 0 or high > grid.count:
        raise SamplesError(f"nodes {low} to {high} needed, 0 to {grid.count} there; widen the grid")
    weights = _lagrange_weights((phase + times.cadence * np.arange(per_cell)) / STEP)
    windows = np.lib.stride_tricks.sliding_window_view(values[low:high], _TAPS, axis=0)
    dense = np.moveaxis(windows @ weights.T, -1, 1)
    return np.ascontiguousarray(dense.reshape(-1, *values.shape[1:])[skip : skip + times.count])


def _lagrange_weights(fractions: Float) -> Float:
    """Weights of the eight nodes around each fraction of a cell, shape (fraction, node)."""
    nodes = np.arange(_TAPS) - float(_BEFORE)
    weights = np.ones((fractions.size, _TAPS))
    for index, node in enumerate(nodes):
        others = np.delete(nodes, index)
        weights[:, index] = np.prod((fractions[:, None] - others) / (node - others), axis=1)
    return weights
