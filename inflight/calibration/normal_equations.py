"""Equations of blocks, from any columns.

Normal equations per block: the sufficient statistics everything later is computed from.

One object holds, for each block (a day, or any half-open span), the weighted Gram matrix of
[model columns | residual] in scaled columns. Adding blocks, choosing columns and solving never read
the archive again.

Normal equations with more columns than the nine: rows of any columns, summed block by block.

Sign: a column is the derivative of the corrected residual dB = |B| - F by its parameter, as in
`inflight.calibration.normal_equations`; a field that a cause *adds* to the vector sensor has the column
``-e . field``, one that it adds to the scalar reading the column ``+field``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration.scalar import (
    SCALE,
    SUB_BLOCKS,
    UNITS,
    BlockFit,
    Reference,
    kernel_parameters,
    score_scatter,
    shift_reference,
)
from inflight.effects import AXES
from inflight.errors import CalibrationError
from inflight.frames import direction_of
from inflight.lsq import Solution, biweight, gram_inverse, robust_sigma, solve
from inflight.time import Int64

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


#: Nine parameters of a perfect sensor: scale factors, angles (deg), offsets (nT).
PERFECT = np.array([1.0] * 3 + [90.0] * 3 + [0.0] * 3)

#: Names of the nine columns, in order, and their units.
NINE = tuple(Reference(PERFECT, np.zeros(9)).columns)

NINE_UNITS = dict(zip(NINE, UNITS, strict=True))

#: Turns of the robust weights; they settle in three or four.
_TURNS = 6

#: Scaled prior sigma with which the scores of sub-blocks are steadied: wider than anything fitted.
_WIDE = 1e4


def nine_columns(field: Floats, value: Floats = PERFECT) -> dict[str, Floats]:
    """Return what one unit of each of the nine parameters adds to the corrected residual.

    Derivatives of |K (E - E0)| (Yin 2010, eq. 2.5) at the corrected field B, with e = B/|B| and
    E - E0 = K^-1 B: ``e_i (E - E0)_j`` for K_ij, ``-K^T e`` for E0; an angle a enters as cos a.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Corrected field, nT, orthogonal sensor axes.
    value : ndarray, shape (9,)
        Where the derivative is taken: scale factors, angles (deg), offsets (nT).

    Returns
    -------
    dict of str to ndarray, shape (time,)
        nT per 1, per deg and per nT.
    """
    k = kernel_parameters(value)
    matrix = np.array([[k[0], k[3], k[4]], [0.0, k[1], k[5]], [0.0, 0.0, k[2]]])
    reading = np.linalg.solve(matrix, field.T)
    x, y, z = direction_of(field).T
    turn = -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    scale = [x * reading[0], y * reading[1], z * reading[2]]
    angles = [x * reading[1] * turn[0], x * reading[2] * turn[1], y * reading[2] * turn[2]]
    offsets = list(-matrix.T @ np.stack([x, y, z]))
    return dict(zip(NINE, [*scale, *angles, *offsets], strict=True))


def field_columns(
    name: str, direction: Floats, series: Floats, axes: Sequence[str] = AXES
) -> dict[str, Floats]:
    """Return the columns of a field at the vector sensor that follows a series, one an axis.

    Parameters
    ----------
    name : str
        ``effect.parameter``; columns are ``name[axis]``.
    direction : ndarray, shape (time, 3)
        Of the field, sensor axes.
    series : ndarray, shape (time,)
        What the field is in proportion to.
    axes : sequence of str
        Which of x, y, z.

    Returns
    -------
    dict of str to ndarray, shape (time,)
        ``-e_axis series``: nT per nT and unit of the series.
    """
    return {f"{name}[{axis}]": -direction[:, AXES.index(axis)] * series for axis in axes}


def block_equations(
    columns: Mapping[str, Floats],
    residual: Floats,
    span: tuple[int, int],
    good: Floats | None = None,
    robust: bool = True,
    attributes: Mapping[str, Any] | None = None,
) -> NormalEquations:
    """Return the normal equations of one block.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (time,)
        As `nine_columns` and `field_columns` make them, physical units.
    residual : ndarray, shape (time,)
        nT, at the values the columns were made at, which become the reference 0.
    span : tuple of int
        Half-open TT2000 span of the block.
    good : ndarray, shape (time,), optional
        Weight of each row, 0 to leave it out; rows that are not finite are left out by themselves.
    robust : bool
        Weigh rows down that lie far from a fit of all columns (Tukey's biweight).
    attributes : mapping, optional
        Of the Dataset; comparison, model and filter must agree where equations are added.

    Raises
    ------
    CalibrationError
        When fewer rows are usable than there are columns.
    """
    names = [*columns, RESIDUAL]
    scale = np.array([SCALE[NINE.index(name)] if name in NINE else 1.0 for name in names])
    rows = np.column_stack([*columns.values(), residual]) * scale
    given = np.ones(len(rows)) if good is None else np.asarray(good, dtype=np.float64)
    use = np.isfinite(rows).all(axis=1) & (given > 0)
    if use.sum() <= len(names):
        raise CalibrationError(
            f"{int(use.sum())} usable rows for {len(columns)} columns",
            remedy="take a longer block, or see the coverage and flags of this one",
        )
    rows, weight = rows[use], given[use]
    if robust:
        weight = weight * _biweight(rows, weight)
    parts = np.array_split(rows * np.sqrt(weight)[:, None], min(SUB_BLOCKS, len(rows)))
    grams = np.array([part.T @ part for part in parts])
    return _assembled(grams, float(weight.sum()), names, scale, span, dict(attributes or {}))


def _biweight(rows: Floats, weight: Floats) -> Floats:
    """Weights of rows [columns | residual] about their own fit; (row,) in [0, 1]."""
    found = np.ones(len(rows))
    for _ in range(_TURNS):
        gram = (rows * (weight * found)[:, None]).T @ rows
        change = -gram_inverse(gram[:-1, :-1]) @ gram[:-1, -1]
        rest = rows[:, -1] + rows[:, :-1] @ change
        found = biweight(rest / robust_sigma(rest, floor=1e-9))
    return found


def _assembled(
    grams: Floats, count: float, names: list[str], scale: Floats, span: tuple[int, int], attrs: dict[str, Any]
) -> NormalEquations:
    total = grams.sum(axis=0)
    change = -gram_inverse(total[:-1, :-1]) @ total[:-1, -1]
    scatter = np.zeros_like(total)
    scatter[:-1, :-1] = score_scatter(grams, change, np.full(len(names) - 1, _WIDE))
    row, still = ("block", "column", "other"), np.zeros((1, len(names)))
    dataset = xr.Dataset(
        {
            "gram": (row, total[None], {"units": "nT2"}),
            "scatter": (row, scatter[None], {"units": "nT4", "sub_blocks": len(grams)}),
            "reference": (("block", "column"), still),
            "linearised_at": (("block", "column"), still),
            "start": ("block", np.array([span[0]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "end": ("block", np.array([span[1]], dtype=np.int64), {"units": "ns", "scale": "TT2000"}),
            "count": ("block", np.array([count])),
            "scale": ("column", scale),
        },
        coords={"column": names, "other": names},
        attrs=attrs,
    )
    return NormalEquations(dataset)


def joined(equations: Sequence[NormalEquations]) -> NormalEquations:
    """Return the equations of all blocks, in order of time.

    Raises
    ------
    CalibrationError
        When there are none, or they do not belong together.
    """
    if not equations:
        raise CalibrationError("there are no normal equations to join", remedy="give at least one block")
    if len(equations) == 1:
        return equations[0]
    # By halves: one after the other would copy all blocks again for each.
    half = len(equations) // 2
    return joined(equations[:half]) + joined(equations[half:])


def places(equations: NormalEquations, names: Sequence[str]) -> Int64:
    """Return where columns stand among all, the residual included.

    Raises
    ------
    CalibrationError
        When one is not there.
    """
    known = [str(name) for name in equations.dataset["column"].values]
    missing = [name for name in names if name not in known]
    if missing:
        raise CalibrationError(
            f"no columns {missing} among {known}", remedy="form the normal equations with these columns"
        )
    return np.array([known.index(name) for name in names], dtype=np.int64)
