"""Covariances of both sensors' readings on many time scales, stretch by stretch.

A contrast is the mean over some samples less that over as many before them, times the root of half their
number: white noise gives the same variance on every scale, a constant gives nothing, and contrasts that do
not overlap hold all there is to know. A cell is a stretch of contrasts on one scale. Where the ambient field
is restless, or the spacecraft switches, the cell shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: The longest blocks are this part of the record.
_LONGEST = 16
#: Contrasts of one cell.
_CELL = 31


@dataclass(frozen=True)
class Cells:
    """Covariances of series, such as [outboard, difference], in cells of time and scale.

    Attributes
    ----------
    covariance : ndarray, shape (cell, column, column)
        Mean products of contrasts, nT^2; three columns a series.
    count : ndarray, shape (cell,)
        Contrasts that do not overlap, or as many as the overlapping ones are worth.
    scale : ndarray of int64, shape (cell,)
        Samples of a block: 1, 2, 4 and so on.
    row : ndarray of int64, shape (cell,)
        Sample in the middle of the cell.
    """

    covariance: Floats
    count: Floats
    scale: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.count.size)

    def blocks(self, number: int) -> npt.NDArray[np.int64]:
        """Return in which of so many blocks of time each cell is, from 0; (cell,)."""
        return np.asarray(self.row * number // (int(self.row.max(initial=0)) + 1), dtype=np.int64)

    def part(self, use: npt.NDArray[np.bool_]) -> Cells:
        """Return some of the cells."""
        return Cells(self.covariance[use], self.count[use], self.scale[use], self.row[use])


def cells_of(*series: Floats, longest: int = _LONGEST) -> Cells:
    """Return the cells of series of samples that are all there.

    Parameters
    ----------
    *series : ndarray, shape (time, axis)
        nT, finite. Samples on both sides of a gap count as neighbours: the cell then shows a larger change of
        the ambient field.
    longest : int
        The longest blocks are this part of the record.
    """
    sums = running_sums(np.concatenate(series, axis=1))
    count, columns = len(series[0]), sums.shape[1]
    parts = []
    for block in scales_of(count, longest):
        values, middle, share = contrasts(sums, block)
        parts.append(_cells(values, middle, block, share))
    if not parts:
        none = np.zeros(0, dtype=np.int64)
        return Cells(np.zeros((0, columns, columns)), np.zeros(0), none, none)
    return joined_cells(parts)


def scales_of(count: int, longest: int = _LONGEST) -> list[int]:
    """Return the lengths of blocks in a record of `count` samples: powers of two up to that part of it.

    Half the record is always among them where they go so far: else half of it could be slower than all.
    """
    most = min(max(count // longest, 1), count // 2)
    powers = [1 << power for power in range(most.bit_length())]
    return [*powers, most] if longest == 2 and powers and most > powers[-1] else powers


def joined_cells(parts: Sequence[Cells]) -> Cells:
    """Return the cells of several stretches together; their rows are those in the stretch."""
    return Cells(
        np.concatenate([one.covariance for one in parts]),
        np.concatenate([one.count for one in parts]),
        np.concatenate([one.scale for one in parts]),
        np.concatenate([one.row for one in parts]),
    )


def running_sums(series: Floats) -> Floats:
    """Return the sums of the first samples of a series (time, column), less its mean; (time + 1, column)."""
    zero = np.zeros((1, series.shape[1]))
    if not len(series):
        return zero
    # Sums of many large numbers would lose the noise: the mean says nothing in a contrast.
    return np.concatenate([zero, np.cumsum(series - series.mean(axis=0), axis=0)])


def contrasts(sums: Floats, block: int) -> tuple[Floats, npt.NDArray[np.int64], float]:
    """Return contrasts of a series over blocks of samples, from its `running_sums`.

    Returns
    -------
    values : ndarray, shape (contrast, column)
    middle : ndarray of int64, shape (contrast,)
        First sample of the later block.
    share : float
        What one contrast is worth of one that does not overlap.
    """
    stride = max(block // 2, 1)
    middle = np.arange(block, len(sums) - block, stride)
    values = (sums[middle + block] - 2.0 * sums[middle] + sums[middle - block]) / np.sqrt(2.0 * block)
    return values, middle.astype(np.int64), stride / (2.0 * block)


def _cells(values: Floats, middle: npt.NDArray[np.int64], block: int, share: float) -> Cells:
    first = np.arange(0, max(len(values) - _CELL // 2, 1), _CELL)
    number = np.diff(np.append(first, len(values)))
    products = values[:, :, None] * values[:, None, :]
    covariance = np.add.reduceat(products, first, axis=0) / number[:, None, None]
    rows = np.asarray(middle[first + number // 2], dtype=np.int64)
    return Cells(covariance, share * number, np.full(first.size, block, dtype=np.int64), rows)
