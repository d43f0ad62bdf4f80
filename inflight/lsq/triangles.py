"""Symmetric matrices of single precision, one of each block, of which each entry is kept once.

Entry (i, j), i >= j, of a matrix is number i (i + 1) / 2 + j of its block: columns that join follow those
that are there, in memory too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq.solver import Indices

Singles = npt.NDArray[np.float32]


class Triangles:
    """Symmetric matrices of some blocks, half of each, to which columns may be appended.

    Attributes
    ----------
    values : ndarray of float32, shape (block, entry)
        There may be room for the entries of more columns.
    width : int
        Columns in use.
    """

    def __init__(self, values: Singles, width: int) -> None:
        self.values, self.width = values, width

    @classmethod
    def zeros(cls, blocks: int, width: int) -> Triangles:
        """Return matrices of zeros."""
        return cls(np.zeros((blocks, entries_of(width)), dtype=np.float32), width)

    @classmethod
    def sum(cls, every: Sequence[Triangles]) -> Triangles:
        """Return the sum of matrices of the same columns, block by block, in an array of its own."""
        used = entries_of(every[0].width)
        values = every[0].values[:, :used].copy()
        for one in every[1:]:
            values += one.values[:, :used]
        return cls(values, every[0].width)

    def __len__(self) -> int:
        return len(self.values)

    def put(self, block: int, matrix: npt.NDArray[np.floating]) -> None:
        """Set the products of the last columns of a block with each other; (column, column)."""
        first = self.width - len(matrix)
        own = self.values[block]
        # Row by row, each a run of memory: in a quarter of the time that places of single entries take.
        for row, values in enumerate(matrix, start=first):
            begin = entries_of(row) + first
            own[begin : begin + row - first + 1] = values[: row - first + 1]

    def at(self, blocks: Indices, entries: Indices) -> Singles:
        """Return some entries of some blocks, as `places_of_entries` names them; (block, ...)."""
        if are_neighbours(blocks):
            # One index takes a fraction of the time of two.
            found = self.values[blocks[0] : blocks[-1] + 1].take(entries.ravel(), axis=1)
        else:
            found = self.values[blocks[:, None], entries.ravel()]
        return np.asarray(found.reshape(len(blocks), *entries.shape))

    def diagonal(self, columns: Indices) -> Singles:
        """Return the entries of columns with themselves; (block, column)."""
        return self.values.take(places_of_entries(columns, columns), axis=1)

    def sum_of(self, blocks: Indices, entries: Indices) -> Floats:
        """Return the sum over some blocks of some entries, in double precision."""
        out = np.zeros(entries_of(self.width))
        for block in np.asarray(blocks).tolist():
            out += self.values[block, : out.size]
        return out[entries]

    def select(self, columns: Indices) -> Triangles:
        """Return the matrices of some columns, in an array of their own."""
        rows, others = np.tril_indices(columns.size)
        entries = places_of_entries(columns[rows], columns[others])
        return Triangles(self.values.take(entries, axis=1), columns.size)

    def append(self, across: Floats, inner: Floats, room: int) -> None:
        """Append columns.

        Parameters
        ----------
        across : ndarray, shape (block, column, new column)
        inner : ndarray, shape (block, new column, new column)
        room : int
            Columns to make room for when the array must grow.
        """
        old, new = self.width, self.width + inner.shape[-1]
        if entries_of(new) > self.values.shape[1]:
            wider = np.zeros((len(self), entries_of(max(room, new))), dtype=np.float32)
            wider[:, : entries_of(old)] = self.values[:, : entries_of(old)]
            self.values = wider
        for column in range(old, new):
            begin = entries_of(column)
            self.values[:, begin : begin + old] = across[:, :, column - old]
            self.values[:, begin + old : begin + column + 1] = inner[:, column - old, : column - old + 1]
        self.width = new


def entries_of(width: int) -> int:
    """Return how many entries a matrix of so many columns has."""
    return width * (width + 1) // 2


def places_of_entries(rows: Indices, columns: Indices) -> Indices:
    """Return which entries of a block are those of some rows and columns."""
    high = np.maximum(rows, columns)
    return np.asarray(high * (high + 1) // 2 + np.minimum(rows, columns))


def are_neighbours(places: Indices) -> bool:
    """Return whether places follow each other."""
    if not places.size or places[-1] - places[0] != places.size - 1:
        return False
    return bool((places[1:] > places[:-1]).all())
