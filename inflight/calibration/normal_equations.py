"""Normal equations of a comparison: Gram matrices of blocks with a reference, and their solution.

Takes columns and residuals of a block (a day, or any half-open span), or the fit of one; makes
`NormalEquations`, which are `inflight.lsq.GramArrays` with what a calibration needs in addition: the
parameters the residual refers to, the scatter of its scores, comparison, model and filter. Adding
blocks, choosing columns and solving never read the archive again.

A column is the derivative of the corrected residual dB = |B| - F by its parameter (Yin 2010,
eq. 2.5); a field that a cause *adds* to the vector sensor has the column ``-e . field``, one that it
adds to the scalar reading the column ``+field``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.scalar import (
    PARAMETER_SCALE,
    PARAMETER_UNITS,
    SCALAR_SETTINGS,
    BlockFit,
    ParameterPrior,
    matrix_parameters,
    score_scatter,
)
from inflight.effects import AXES
from inflight.errors import CalibrationError
from inflight.frames import direction_of
from inflight.lsq import (
    RESIDUAL,
    SOLVER_SETTINGS,
    GramArrays,
    Solution,
    arrays_of,
    biweight,
    full_dataset,
    larger_scatter,
    robust_sigma,
    solve_each,
    solve_scaled,
)
from inflight.time import Int64

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class RobustRowSettings:
    """How rows of any columns are weighted.

    Attributes
    ----------
    passes : int
        Passes of the robust weights; they settle in three or four.
    wide : float
        Scaled prior sigma with which the scatter of sub-blocks' scores is made: wider than anything fitted.
    """

    passes: int = 6
    wide: float = 1e4


ROBUST_ROW_SETTINGS = RobustRowSettings()


#: A function of time: from TT2000 nanoseconds (block,) to numbers (block,).
TimeFunction = Callable[[Floats], Floats]


class NormalEquations(GramArrays):
    """Sufficient statistics of one comparison, immutable; see `inflight.lsq.GramArrays`.

    Parameters
    ----------
    dataset : xarray.Dataset
        dims block, column, other (= column): `gram` (block, column, other) nT^2 in scaled columns,
        residual last; `scatter` (block, column, other), scores of sub-blocks at the block's own
        fit; `reference` (block, column), what the residual column refers to, physical units;
        `start`, `end` (block) TT2000; `count` (block) sum of weights; `scale` (column).
        Attributes: comparison, model, cadence_ns, filter, key.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        super().__init__(**arrays_of(dataset))

    @property
    def dataset(self) -> xr.Dataset:
        """The equations as a Dataset, as a store keeps them."""
        return full_dataset(self)

    @classmethod
    def of_arrays(cls, blocks: GramArrays) -> NormalEquations:
        """Return Gram matrices of any columns as normal equations."""
        return cls.__new__(cls)._filled_with(blocks)

    @classmethod
    def from_fit(
        cls, fit: BlockFit, reference: ParameterPrior, span: tuple[int, int], attributes: Mapping[str, Any]
    ) -> NormalEquations:
        """Make the equations of one block from its fit."""
        width = len(PARAMETER_SCALE) + 1
        scatter = np.zeros((width, width))
        scatter[:-1, :-1] = fit.scatter
        return _one_block(
            (*reference.columns, RESIDUAL),
            fit.gram,
            span,
            fit.count,
            np.append(PARAMETER_SCALE, 1.0),
            reference=np.append(reference.value, 0.0)[None],
            linearised_at=np.append(fit.linearised_at, 0.0)[None],
            scatter=scatter[None],
            sub_blocks=SCALAR_SETTINGS.sub_blocks,
            attributes=attributes,
        )

    def index(self, names: Sequence[str]) -> Int64:
        """Return the places of columns among all, the residual included.

        Raises
        ------
        CalibrationError
            When one is not there.
        """
        if missing := [name for name in names if name not in self.names]:
            raise CalibrationError(
                f"no columns {missing} among {list(self.names)}",
                remedy="form the normal equations with these columns",
            )
        return super().index(names)

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return the equations of both sets of blocks, in order of time.

        Raises
        ------
        CalibrationError
            When comparison, model, filter, columns or scale differ, or blocks overlap.
        """
        return concat_equations([self, other])

    def with_trends(self, functions: Mapping[str, Mapping[str, TimeFunction]]) -> NormalEquations:
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
        common = self.at_one_reference()
        middle = self.middle.astype(np.float64)
        names, origin, factors, kept = [], [], [], []
        for place, column in enumerate(self.names):
            for name, function in functions.get(column, {"": np.ones_like}).items():
                names.append(f"{column}*{name}" if name else column)
                origin.append(place)
                factors.append(function(middle))
                kept.append(not name)
        expanded = common._times(names, np.array(origin), np.stack(factors, axis=1))
        assert expanded.reference is not None
        return expanded._with(reference=expanded.reference * np.array(kept))

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
        common = self.at_one_reference()
        centre = common.first_reference if prior is None else prior
        return solve_sets([common], np.asarray(prior_sigma)[None], centre[None])[0]

    def solve_each(self, prior_sigma: Floats, prior: Floats) -> list[Solution]:
        """Solve every block for itself, as `solve` does the blocks of one.

        Parameters
        ----------
        prior_sigma, prior : ndarray, shape (block, column)
            What is known beforehand of each, physical units.

        Returns
        -------
        list of Solution
            Scaled, relative to each block's own reference.
        """
        scale = self.scale[:-1]
        reference = 0.0 if self.reference is None else self.reference[:, :-1]
        scatter = self._scatter[:, :-1, :-1]
        return solve_each(self.gram, scatter, self.count, (prior - reference) / scale, prior_sigma / scale)

    def physical(self, solution: Solution) -> tuple[Floats, Floats]:
        """Return values (column,) and covariance (column, column) of a solution in physical units."""
        scale = self.scale[:-1]
        return self.first_reference + solution.value * scale, solution.covariance * np.outer(scale, scale)

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
        every = np.arange(len(self))
        indices = np.array_split(every, folds)
        return [(self.of_blocks(np.setdiff1d(every, held)), self.of_blocks(held)) for held in indices]


def solve_sets(sets: Sequence[NormalEquations], prior_sigma: Floats, prior: Floats) -> list[Solution]:
    """Solve several sets of blocks, each for itself and as `NormalEquations.solve` does one, but together.

    Parameters
    ----------
    sets : sequence of NormalEquations
        Of the same columns, each at one reference (`inflight.lsq.GramArrays.at_one_reference`).
    prior_sigma, prior : ndarray, shape (set, column)
        What is known beforehand of each, physical units.

    Returns
    -------
    list of Solution
        Scaled, relative to each set's own reference.
    """
    if not sets:
        return []
    scale = sets[0].scale[:-1]
    references = np.array([blocks.first_reference for blocks in sets])
    centres = (prior - references) / scale
    sigmas = prior_sigma / scale
    withins = np.array([blocks._scatter[:, :-1, :-1].sum(axis=0) for blocks in sets])
    totals = np.array([blocks.total for blocks in sets])
    counts = np.array([float(blocks.count.sum()) for blocks in sets])
    found = solve_each(totals, withins, counts, centres, sigmas)
    several = [place for place, blocks in enumerate(sets) if len(blocks) > 1]
    if not several:
        return found
    for place in several:
        blocks = sets[place]
        scores = blocks.gram[:, :-1, -1] + blocks.gram[:, :-1, :-1] @ found[place].value
        between = scores.T @ scores * len(blocks) / (len(blocks) - 1)
        matrix, sigma = totals[place, :-1, :-1], sigmas[place]
        withins[place] = larger_scatter(matrix, withins[place], between, sigma)
    again = solve_each(totals[several], withins[several], counts[several], centres[several], sigmas[several])
    for place, solution in zip(several, again, strict=True):
        found[place] = solution
    return found


def _one_block(
    names: Sequence[str],
    gram: Floats,
    span: tuple[int, int],
    count: float,
    scale: Floats,
    **optional: Any,
) -> NormalEquations:
    """Return the equations of one block from its Gram matrix (column, column)."""
    start, end = (np.array([one], dtype=np.int64) for one in span)
    return NormalEquations.of_arrays(
        GramArrays(tuple(names), gram[None], start, end, np.array([count]), scale, **optional)
    )


#: Nine parameters of an ideal sensor: scale factors, angles (deg), offsets (nT).
IDEAL_SENSOR = np.array([1.0] * 3 + [90.0] * 3 + [0.0] * 3)

#: Names of the nine columns, in order, and their units.
NINE_PARAMETER_NAMES = tuple(ParameterPrior(IDEAL_SENSOR, np.zeros(9)).columns)

NINE_PARAMETER_UNITS = dict(zip(NINE_PARAMETER_NAMES, PARAMETER_UNITS, strict=True))


def nine_columns(field: Floats, value: Floats = IDEAL_SENSOR) -> dict[str, Floats]:
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
    k = matrix_parameters(value)
    matrix = np.array([[k[0], k[3], k[4]], [0.0, k[1], k[5]], [0.0, 0.0, k[2]]])
    reading = np.linalg.solve(matrix, field.T)
    x, y, z = direction_of(field).T
    slope = -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    scale = [x * reading[0], y * reading[1], z * reading[2]]
    angles = [x * reading[1] * slope[0], x * reading[2] * slope[1], y * reading[2] * slope[2]]
    offsets = list(-matrix.T @ np.stack([x, y, z]))
    return dict(zip(NINE_PARAMETER_NAMES, [*scale, *angles, *offsets], strict=True))


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
    scale = np.array(
        [
            PARAMETER_SCALE[NINE_PARAMETER_NAMES.index(name)] if name in NINE_PARAMETER_NAMES else 1.0
            for name in names
        ]
    )
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
        # Tukey's weights about the rows' own fit.
        found = np.ones(len(rows))
        for _ in range(ROBUST_ROW_SETTINGS.passes):
            gram = (rows * (weight * found)[:, None]).T @ rows
            change = -solve_scaled(gram[:-1, :-1], gram[:-1, -1], SOLVER_SETTINGS.weak_cut)
            residual_at_fit = rows[:, -1] + rows[:, :-1] @ change
            found = biweight(residual_at_fit / robust_sigma(residual_at_fit, floor=1e-9))
        weight = weight * found
    parts = np.array_split(rows * np.sqrt(weight)[:, None], min(SCALAR_SETTINGS.sub_blocks, len(rows)))
    grams = np.array([part.T @ part for part in parts])
    total = grams.sum(axis=0)
    change = -solve_scaled(total[:-1, :-1], total[:-1, -1], SOLVER_SETTINGS.weak_cut)
    scatter = np.zeros_like(total)
    scatter[:-1, :-1] = score_scatter(grams, change, np.full(len(names) - 1, ROBUST_ROW_SETTINGS.wide))
    reference = np.zeros((1, len(names)))
    return _one_block(
        names,
        total,
        span,
        float(weight.sum()),
        scale,
        reference=reference,
        linearised_at=reference,
        scatter=scatter[None],
        sub_blocks=len(grams),
        attributes=dict(attributes or {}),
    )


def concat_equations(equations: Sequence[NormalEquations]) -> NormalEquations:
    """Return the equations of all blocks, in order of time.

    Raises
    ------
    CalibrationError
        When there are none, they do not belong together, or blocks overlap.
    """
    if not equations:
        raise CalibrationError("there are no normal equations to join", remedy="give at least one block")
    first = equations[0]
    for other in equations[1:]:
        for name in ("comparison", "model", "filter"):
            mine, theirs = first.attributes.get(name), other.attributes.get(name)
            if mine != theirs:
                raise CalibrationError(
                    f"normal equations differ in '{name}': {mine} and {theirs}",
                    remedy="recompute them with one model version",
                )
        for name, same in (
            ("column", first.names == other.names),
            ("scale", np.array_equal(first.scale, other.scale)),
        ):
            if not same:
                raise CalibrationError(
                    f"normal equations differ in '{name}'", remedy="recompute them with one model version"
                )
    return first if len(equations) == 1 else first.join(equations[1:])
