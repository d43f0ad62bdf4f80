"""Normal equations per block: the sufficient statistics everything later is computed from.

One object holds, for each block (a day, or any half-open span), the weighted Gram matrix of
[model columns | residual] in scaled columns. Adding blocks, choosing columns and solving never read
the archive again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.scalar import SUB_BLOCKS, BlockFit, shift_reference
from inflight.calibration.sensor import SCALE, Reference
from inflight.calibration.solution import Solution, solve
from inflight.errors import CalibrationError

#: A function of time: from TT2000 nanoseconds (block,) to numbers (block,).
TimeFunction = Callable[[Floats], Floats]
#: Name of the residual among the columns.
RESIDUAL = "residual"


@dataclass(frozen=True)
class NormalEquations:
    """Sufficient statistics of one comparison, immutable.

    Attributes
    ----------
    dataset : xarray.Dataset
        dims block, column, other (= column): `gram` (block, column, other) nT^2 in scaled columns,
        residual last; `scatter` (block, column, other), scores of sub-blocks at the block's own
        fit; `reference` (block, column), what the residual column refers to, physical units;
        `start`, `end` (block) TT2000; `count` (block) sum of weights; `scale` (column).
        Attributes: comparison, model, cadence_ns, filter, key.
    """

    dataset: xr.Dataset

    @classmethod
    def from_fit(
        cls, fit: BlockFit, reference: Reference, span: tuple[int, int], attributes: dict[str, Any]
    ) -> NormalEquations:
        """Make the equations of one block from its fit."""
        width = len(SCALE) + 1
        scatter = np.zeros((width, width))
        scatter[:-1, :-1] = fit.scatter
        names = [*reference.columns, RESIDUAL]
        row = ("block", "column", "other")
        dataset = xr.Dataset(
            {
                "gram": (row, fit.gram[None], {"units": "nT2"}),
                "scatter": (row, scatter[None], {"units": "nT4", "sub_blocks": SUB_BLOCKS}),
                "reference": (("block", "column"), np.append(reference.value, 0.0)[None]),
                "linearised_at": (("block", "column"), np.append(fit.linearised_at, 0.0)[None]),
                "start": ("block", np.array([span[0]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
                "end": ("block", np.array([span[1]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
                "count": ("block", np.array([fit.count])),
                "scale": ("column", np.append(SCALE, 1.0)),
            },
            coords={"column": names, "other": names},
            attrs=attributes,
        )
        return cls(dataset)

    @property
    def columns(self) -> list[str]:
        """Names of the parameters' columns, without the residual."""
        return [str(name) for name in self.dataset["column"].values if name != RESIDUAL]

    def __len__(self) -> int:
        return int(self.dataset.sizes["block"])

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return the equations of both sets of blocks, in order of time.

        Raises
        ------
        CalibrationError
            When comparison, model, filter, columns or scale differ, or blocks overlap.
        """
        for name in ("comparison", "model", "filter"):
            mine, theirs = self.dataset.attrs.get(name), other.dataset.attrs.get(name)
            if mine != theirs:
                raise CalibrationError(
                    f"normal equations differ in '{name}': {mine} and {theirs}",
                    remedy="recompute them with one model version",
                )
        for name in ("column", "scale"):
            if not np.array_equal(self.dataset[name].values, other.dataset[name].values):
                raise CalibrationError(
                    f"normal equations differ in '{name}'", remedy="recompute them with one model version"
                )
        rows = [part.dataset.drop_vars("scale") for part in (self, other)]
        joined = xr.concat(rows, "block", join="exact").assign(scale=self.dataset["scale"])
        joined = joined.isel(block=np.argsort(joined["start"].values, kind="stable"))
        if np.any(joined["start"].values[1:] < joined["end"].values[:-1]):
            raise CalibrationError("blocks overlap", remedy="add each block once")
        return NormalEquations(joined)

    def select(self, columns: Sequence[str]) -> NormalEquations:
        """Return the equations of some columns; the others stay at their reference."""
        names = [*columns, RESIDUAL]
        return NormalEquations(self.dataset.sel(column=names, other=names))

    @property
    def filled(self) -> Self:
        """The blocks that say something: days without their housekeeping leave empty ones."""
        full = np.flatnonzero(self.dataset["count"].values > 0)
        return self if full.size == len(self) else self._pick(full)

    def within(self, start: int, end: int) -> NormalEquations:
        """Return the blocks that lie in a half-open TT2000 span."""
        inside = (self.dataset["start"].values >= start) & (self.dataset["end"].values <= end)
        return NormalEquations(self.dataset.isel(block=np.flatnonzero(inside)))

    def at(self, reference: Floats) -> NormalEquations:
        """Return the equations with every block's residual expressed at one reference, physical units."""
        scale = self.dataset["scale"].values[:-1]
        change = (reference - self.dataset["reference"].values[:, :-1]) / scale
        if not change.any():
            return self
        gram = np.array(
            [
                shift_reference(one, step)
                for one, step in zip(self.dataset["gram"].values, change, strict=True)
            ]
        )
        common = np.broadcast_to(np.append(reference, 0.0), (len(self), reference.size + 1))
        dataset = self.dataset.assign(
            gram=self.dataset["gram"].copy(data=gram), reference=self.dataset["reference"].copy(data=common)
        )
        return NormalEquations(dataset)

    def merge(self, edges: Sequence[int]) -> NormalEquations:
        """Return the equations of wider blocks: all blocks between two TT2000 edges become one.

        Gram matrices, scores' scatter and counts add up; scatter between the blocks is not in it.

        Raises
        ------
        CalibrationError
            When a block lies across an edge or outside the edges: it would be lost.
        """
        common = self.at(self.reference)
        parts = [common.within(start, end) for start, end in pairwise(edges)]
        if sum(len(part) for part in parts) != len(self):
            raise CalibrationError("a block lies across or outside the edges", remedy="use edges of blocks")
        totals = [part._total() for part in parts if len(part)]
        return NormalEquations(xr.concat(totals, "block").assign(scale=self.dataset["scale"]))

    def _total(self) -> xr.Dataset:
        data = self.dataset
        total = data[["gram", "scatter", "count"]].sum("block", keep_attrs=True).expand_dims("block")
        return total.assign(
            reference=data["reference"].isel(block=[0]),
            start=("block", data["start"].values[:1], data["start"].attrs),
            end=("block", data["end"].values[-1:], data["end"].attrs),
        ).assign_attrs(data.attrs)

    def expand(self, functions: Mapping[str, Mapping[str, TimeFunction]]) -> NormalEquations:
        """Return the equations of parameters that depend on time from block to block.

        Parameters
        ----------
        functions : mapping of str to mapping of str to callable
            For each column to expand, functions of time by name: from the blocks' middles, (block,)
            TT2000, to (block,). The column gives way to one column a function, ``column*name``;
            the others stay.

        Returns
        -------
        NormalEquations
            A function is taken as constant within a block. Where a column was expanded, solutions are
            changes against the reference of the first block, whatever it was: their own is 0.
        """
        common = self if not len(self) else self.at(self.reference)
        data = common.dataset
        middle = data["start"].values // 2 + data["end"].values // 2
        names, turns = [], []
        for index, column in enumerate(data["column"].values):
            for name, function in functions.get(str(column), {"": np.ones_like}).items():
                turn = np.zeros((len(self), data.sizes["column"]))
                turn[:, index] = function(middle.astype(np.float64))
                names.append(f"{column}*{name}" if name else str(column))
                turns.append(turn)
        turn = np.stack(turns, axis=1)
        origin = [list(data["column"].values).index(name.split("*", maxsplit=1)[0]) for name in names]
        kept = np.array(["*" not in name for name in names])
        across = turn.transpose(0, 2, 1)
        row = ("block", "column", "other")
        dataset = xr.Dataset(
            {
                "gram": (row, turn @ data["gram"].values @ across, data["gram"].attrs),
                "scatter": (row, turn @ data["scatter"].values @ across, data["scatter"].attrs),
                "reference": (("block", "column"), data["reference"].values[:, origin] * kept),
                "start": data["start"],
                "end": data["end"],
                "count": data["count"],
                "scale": ("column", data["scale"].values[origin]),
            },
            coords={"column": names, "other": names},
            attrs=data.attrs,
        )
        return NormalEquations(dataset)

    def scores(self, value: Floats) -> Floats:
        """Return each block's scores ``X^T y`` at values of the parameters.

        Parameters
        ----------
        value : ndarray, shape (column,)
            Physical units.

        Returns
        -------
        ndarray, shape (block, column)
            nT^2 per scaled unit; they sum to zero at a least-squares solution.
        """
        scale = self.dataset["scale"].values[:-1]
        change = (value - self.dataset["reference"].values[:, :-1]) / scale
        gram = self.dataset["gram"].values
        return np.asarray(gram[:, :-1, -1] + np.einsum("bij,bj->bi", gram[:, :-1, :-1], change))

    def solve(self, prior_sigma: Floats, prior: Floats | None = None) -> Solution:
        """Solve all blocks together.

        Parameters
        ----------
        prior_sigma : ndarray, shape (column,)
            What is known beforehand, physical units; 0 fixes a parameter.
        prior : ndarray, shape (column,), optional
            Its mean, physical units; the reference when absent.

        Returns
        -------
        Solution
            Scaled, relative to the reference; its covariance holds, a direction, the larger of the
            scatter within the blocks and between them.
        """
        if len(self) > 1 and np.ptp(self.dataset["reference"].values, axis=0).any():
            return self.at(self.reference).solve(prior_sigma, prior)
        scale = self.dataset["scale"].values[:-1]
        centre = np.zeros_like(scale) if prior is None else (prior - self.reference) / scale
        gram, within = self.dataset["gram"].values, self.dataset["scatter"].values[:, :-1, :-1].sum(axis=0)
        total, count = gram.sum(axis=0), float(self.dataset["count"].values.sum())
        sigma = np.asarray(prior_sigma) / scale
        first = solve(total, within, count, centre, sigma)
        if len(self) == 1:
            return first
        scores = gram[:, :-1, -1] + gram[:, :-1, :-1] @ first.value
        between = scores.T @ scores * len(self) / (len(self) - 1)
        return solve(total, larger_scatter(total[:-1, :-1], within, between, sigma), count, centre, sigma)

    def physical(self, solution: Solution) -> tuple[Floats, Floats]:
        """Return values (column,) and covariance (column, column) of a solution in physical units."""
        scale = self.dataset["scale"].values[:-1]
        return self.reference + solution.value * scale, solution.covariance * np.outer(scale, scale)

    @property
    def reference(self) -> Floats:
        """What the residual of the first block refers to, physical units; solutions are relative to it."""
        return np.asarray(self.dataset["reference"].values[0, :-1])

    def split(self, folds: int) -> list[tuple[Self, Self]]:
        """Return (fitted, held-out) pairs of contiguous blocks for cross-validation.

        Raises
        ------
        CalibrationError
            When there are not at least two folds, or fewer blocks than folds.
        """
        if not 2 <= folds <= len(self):
            raise CalibrationError(
                f"{len(self)} blocks make no {folds} folds",
                remedy="ask for two or more, and at most one a block",
            )
        indices = np.array_split(np.arange(len(self)), folds)
        return [(self._pick(np.setdiff1d(np.arange(len(self)), held)), self._pick(held)) for held in indices]

    def _pick(self, index: np.ndarray[Any, np.dtype[np.int64]]) -> Self:
        return type(self)(self.dataset.isel(block=index))


def larger_scatter(matrix: Floats, within: Floats, between: Floats, prior_sigma: Floats) -> Floats:
    """Return the scatter of scores that is larger, direction by direction; (column, column), scaled.

    Both estimate the same when blocks differ by chance alone, so they must not be added; what
    wanders from block to block shows between them only, and what few blocks show may be too little.
    """
    free = np.flatnonzero(prior_sigma > 0)
    grid, sigma = np.ix_(free, free), prior_sigma[free]
    unit = np.outer(sigma, sigma)
    _, vectors = np.linalg.eigh(matrix[grid] * unit)
    inside = vectors.T @ (within[grid] * unit) @ vectors
    outside = np.diag(vectors.T @ (between[grid] * unit) @ vectors)
    inside += np.diag(np.where(np.diag(inside) <= 0, outside, 0.0))
    own = np.diag(inside)
    lift = np.sqrt(np.maximum(np.divide(outside, own, out=np.ones_like(own), where=own > 0), 1.0))
    out = np.zeros_like(matrix)
    out[grid] = vectors @ (lift[:, None] * inside * lift[None, :]) @ vectors.T / unit
    return out
