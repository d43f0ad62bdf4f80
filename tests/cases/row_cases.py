"""Rows of numbers and their evidence: a test works from the rows, the code from the evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.lsq import GramArrays

DAY_NS = 86_400_000_000_000


@dataclass(frozen=True)
class RowCase:
    """Columns (block, row, column) by name, the residual last."""

    names: tuple[str, ...]
    values: np.ndarray

    @property
    def grams(self) -> GramArrays:
        """The Gram matrix of each block; scales are not 1, so that nobody forgets them."""
        blocks, rows, width = self.values.shape
        gram = np.einsum("bri,brj->bij", self.values, self.values)
        start = DAY_NS * np.arange(blocks, dtype=np.int64)
        scale = np.append(1.0 + np.arange(width - 1) / 8.0, 1.0)
        return GramArrays(self.names, gram, start, start + DAY_NS, np.full(blocks, float(rows)), scale)

    def of(self, *names: str) -> np.ndarray:
        """Return columns; (block, row, column)."""
        return self.values[:, :, [self.names.index(name) for name in names]]


def row_case(seed: int = 0, blocks: int = 20, rows: int = 60, effect: float = 0.3) -> RowCase:
    """Return three columns of a calibration, two of a model, five of candidates and a residual of them."""
    g = np.random.default_rng(seed)
    n = g.normal(size=(blocks, rows, 3))
    p = g.normal(size=(blocks, rows, 2)) + 0.5 * n[:, :, :2]
    z = g.normal(size=(blocks, rows, 5)) + 0.7 * p[:, :, :1] - 0.3 * n[:, :, 2:]
    y = n @ [1.0, 2.0, 3.0] + p @ [0.5, 0.2] + effect * z[:, :, 0] - 0.5 * effect * z[:, :, 1]
    y = y + g.normal(size=y.shape)
    names = ("n0", "n1", "n2", "p0", "p1", "z0", "z1", "z2", "z3", "z4", "residual")
    return RowCase(names, np.concatenate([n, p, z, y[:, :, None]], axis=2))
