"""Gram matrices of blocks of time: the sufficient statistics that every linear fit is made from.

A block is a half-open span of TT2000. What is kept of it is the weighted Gram matrix of
[columns | residuals], in columns divided by their `scale`, with the sum of its weights. Blocks add
up; columns are chosen, multiplied by functions of time, combined and marginalised; nothing reads
the samples again. Calibration, the fit of a whole mission and the diagnosis all compute with
these:

- `GramBlocks` is the protocol. Whoever computes with blocks asks for `rows`, `select`, `expand`,
  `merge`, `marginalise` and sums, and never indexes the matrices; so they may lie in memory or be
  read from a store as they are asked for.
- `GramArrays` is the implementation in memory; `inflight.lsq.factored_grams` has the one of a search, whose
  forms share one matrix.
- `BlockSums` sums blocks whose columns are multiplied by functions of time, without a matrix of
  the expanded columns for every block.
- `gram_of` makes the matrices from rows, `prewhiten` the rows of a first-order autoregression.
- `pack`, `unpack` and `GramArrays.as_dataset` are the packed triangles of a store; `full_dataset`
  and `arrays_of` the whole matrices with their names.

Marginalising is the theorem of Frisch, Waugh and Lovell; see `inflight.lsq.solver.marginalise`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq.solver import SOLVER_SETTINGS, Indices, residual_sum, solve_scaled
from inflight.time import GAP, SECOND

if TYPE_CHECKING:
    import xarray as xr

#: Columns, by name or by place.
Columns = Sequence[str] | Indices

#: Name of the residual among the columns; further ones are ``residual~1``, ``residual~2``, ...
RESIDUAL = "residual"

#: A column of which marginalising leaves less than this part of its square is nothing but rounding.
LEAST_KEPT = 1e-9


def prewhiten(values: Floats, weight: Floats, stamps: npt.NDArray[np.int64], correlation_s: float) -> Floats:
    """Return rows less what the row before predicts: ``v_t - exp(-dt / correlation_s) v_(t-1)``.

    Parameters
    ----------
    values : ndarray, shape (time, ...)
    weight : ndarray, shape (time,)
        Rows of weight 0, and the first ones after a gap, become 0.
    stamps : ndarray of int64, shape (time,)
        TT2000.
    correlation_s : float
        Correlation time of the first-order autoregression, seconds.
    """
    step = np.diff(stamps) / SECOND
    usual = float(np.median(step)) if step.size else 1.0
    follows = (step <= GAP * usual) & (weight[1:] > 0) & (weight[:-1] > 0)
    phi = np.where(follows, np.exp(-step / correlation_s), 0.0)
    shape = (-1,) + (1,) * (values.ndim - 1)
    out = np.empty_like(values)
    out[0] = 0.0
    np.multiply(values[:-1], -phi.reshape(shape), out=out[1:])
    out[1:] += values[1:]
    out[1:][~follows] = 0.0
    return out


#: Samples that are multiplied at a time.
_AT_ONCE = 16_384


def gram_of(columns: Floats, residuals: Floats, weight: Floats, parts: Sequence[slice]) -> Floats:
    """Return the Gram matrices of consecutive parts of a block; (part, column, column), nT^2.

    Parameters
    ----------
    columns : ndarray, shape (time, row, column)
    residuals : ndarray, shape (time, row, residual)
    weight : ndarray, shape (time,)
        Every good sample counts once.
    parts : sequence of slice
        Of the time.
    """
    kinds = columns.shape[-1]
    out = np.zeros((len(parts), kinds + residuals.shape[-1], kinds + residuals.shape[-1]))
    for gram, part in zip(out, parts, strict=True):
        # Samples of a whole day at their own cadence are taken in turn: a copy of all would not fit a cache.
        for some in in_turns(part, _AT_ONCE):
            for row in range(columns.shape[1]):
                own, left = (_weighted(values[some, row], weight[some]) for values in (columns, residuals))
                gram[:kinds, :kinds] += own.T @ own
                gram[:kinds, kinds:] += own.T @ left
                gram[kinds:, kinds:] += left.T @ left
        gram[kinds:, :kinds] = gram[:kinds, kinds:].T
    return out


def _weighted(values: Floats, weight: Floats) -> Floats:
    """Return values (time, column) times the root of each weight: themselves where that is the same."""
    lost = weight == 0.0
    if np.all(lost | (weight == 1.0)) and not values[lost].any():
        return np.asarray(values, dtype=np.float64)
    return values * np.sqrt(np.clip(weight, 0.0, None))[:, None]


def in_turns(part: slice, count: int) -> Iterator[slice]:
    """Yield so many of a part's places at a time."""
    return (slice(at, min(at + count, part.stop)) for at in range(part.start, part.stop, count))


def parts_of(stamps: npt.NDArray[np.int64], edges: Sequence[int]) -> list[slice]:
    """Return the rows between consecutive TT2000 edges."""
    places = np.searchsorted(stamps, np.asarray(edges, dtype=np.int64)).tolist()
    return [slice(a, b) for a, b in pairwise(places)]


def pack(gram: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the upper triangles of symmetric matrices; (block, entry)."""
    width = gram.shape[-1]
    begins = np.cumsum([0, *range(width, 0, -1)]).tolist()
    out = np.empty((len(gram), begins[-1]), dtype=gram.dtype)
    # Row by row, each a run of memory: in a quarter of the time that places of single entries take.
    for row, (begin, end) in enumerate(pairwise(begins)):
        out[:, begin:end] = gram[:, row, row:]
    return out


def unpack(packed: Floats) -> Floats:
    """Return the symmetric matrices of their upper triangles; (block, column, column)."""
    width = int((np.sqrt(8 * packed.shape[1] + 1) - 1) / 2)
    out = np.zeros((packed.shape[0], width, width))
    upper = np.triu_indices(width)
    out[:, upper[0], upper[1]] = packed
    out[:, upper[1], upper[0]] = packed
    return out


def shift_reference(gram: Floats, change: Floats) -> Floats:
    """Express the residual column after a scaled change of the parameters: y becomes ``y + X change``.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Gram matrix of [X | y], scaled columns, nT^2.
    change : ndarray, shape (parameter,)
        Scaled.
    """
    weights = np.eye(gram.shape[0])
    weights[-1, :-1] = change
    return np.asarray(weights @ gram @ weights.T)


class BlockProducts(Protocol):
    """What scores ask blocks for: products of a model's columns with all, and of a candidate's own."""

    @property
    def residuals(self) -> list[int]:
        """Places of the residuals."""

    @property
    def scale(self) -> Floats:
        """Physical size of one unit of each column; (column,)."""

    def __len__(self) -> int:
        """Return the number of blocks."""

    def index(self, names: Sequence[str]) -> Indices:
        """Return the places of columns by name."""

    def rows(self, columns: Indices, others: Indices | None = None) -> Floats:
        """Return the products of some columns with others; (block, column, other)."""

    def products_within(self, groups: Indices) -> Floats:
        """Return the products of the columns of each group with each other; (block, group, k, k)."""


class GramBlocks(Protocol):
    """Sufficient statistics of blocks, in memory or on disk; see `GramArrays` for the shapes."""

    @property
    def names(self) -> tuple[str, ...]:
        """Columns, then residuals."""

    @property
    def scale(self) -> Floats:
        """Physical size of one unit of each column; (column,)."""

    @property
    def start(self) -> npt.NDArray[np.int64]:
        """First instant of each block, TT2000; (block,)."""

    @property
    def end(self) -> npt.NDArray[np.int64]:
        """End of each block, TT2000, not in it; (block,)."""

    @property
    def count(self) -> Floats:
        """Sum of the weights of each block; (block,)."""

    @property
    def reference(self) -> Floats | None:
        """Parameters that the residual refers to, physical units; (block, column)."""

    @property
    def linearised_at(self) -> Floats | None:
        """Parameters at which the columns were formed, physical units; (block, column)."""

    @property
    def scatter(self) -> Floats | None:
        """Long-run scatter of the scores within each block; (block, column, column)."""

    def __len__(self) -> int:
        """Return the number of blocks."""

    def index(self, names: Sequence[str]) -> Indices:
        """Return the places of columns by name."""

    @property
    def residuals(self) -> list[int]:
        """Places of the residuals."""

    def rows(
        self, columns: Columns, others: Columns | None = None, blocks: Indices | slice | None = None
    ) -> Floats:
        """Return the products of some columns with others; (block, column, other)."""

    def products_within(self, groups: Indices, blocks: Indices | slice | None = None) -> Floats:
        """Return the products of the columns of each group with each other; (block, group, k, k)."""

    @property
    def squares(self) -> Floats:
        """Sum of squares of every column in each block; (block, column)."""

    @property
    def total(self) -> Floats:
        """Sum over all blocks; (column, column)."""

    def sums(self, folds: Sequence[Indices]) -> list[Floats]:
        """Return the sum over the blocks of each fold."""

    def centred(self, columns: Indices, base: Indices) -> Floats:
        """Return the total matrix of columns about what they share with one column of the base."""

    def select(self, names: Sequence[str]) -> GramBlocks:
        """Return some columns, with all residuals behind them."""

    def expand(self, functions: Mapping[str, tuple[str, Floats]]) -> GramBlocks:
        """Return the blocks with columns added that are others times a function of the block."""

    def merge(self, edges: Sequence[int]) -> GramBlocks:
        """Return wider blocks: all blocks between two edges become one."""

    def join(self, others: Sequence[Any]) -> GramBlocks:
        """Return the blocks of several, in order of time."""

    def combine(self, names: Sequence[str], weights: Floats, scale: Floats) -> GramArrays:
        """Return blocks whose columns and residuals are linear combinations of these."""

    def bordered(self, names: Sequence[str], scale: Floats, across: Floats, inner: Floats) -> GramBlocks:
        """Return the blocks with columns added before the residuals."""

    def marginalise(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]] | None = None,
        precision: Floats | None = None,
        dtype: npt.DTypeLike = np.float64,
    ) -> GramBlocks:
        """Return the residual of every column after some are fitted anew in each interval."""


@dataclass(frozen=True, eq=False)
class GramArrays:
    """Gram matrices of blocks in memory.

    Attributes
    ----------
    names : tuple of str
        Columns, then residuals (``residual``, ``residual~1``, ...).
    gram : ndarray, shape (block, column, column)
        nT^2 in scaled columns. Who computes with it asks for `rows` and the like.
    start, end : ndarray of int64, shape (block,)
        TT2000, half-open.
    count : ndarray, shape (block,)
        Sum of weights: good rows.
    scale : ndarray, shape (column,)
        Physical size of one unit of each column; 1 for residuals.
    reference : ndarray, shape (block, column), optional
        Parameters that the residual refers to, physical units; 0 for the residual itself.
    linearised_at : ndarray, shape (block, column), optional
        Parameters at which the columns were formed, physical units.
    scatter : ndarray, shape (block, column, column), optional
        Long-run scatter of the scores of sub-blocks at the block's own fit, nT^4.
    sub_blocks : int
        Sub-blocks that the scatter was made from; 0 when that is not known.
    attributes : mapping
        What holds for all blocks, such as comparison, model and filter.
    more : xarray.Dataset, optional
        Further variables along ``block`` (and ``column``, ``other``) that are carried along.
    """

    names: tuple[str, ...]
    gram: Floats
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    count: Floats
    scale: Floats
    reference: Floats | None = field(default=None, kw_only=True)
    linearised_at: Floats | None = field(default=None, kw_only=True)
    scatter: Floats | None = field(default=None, kw_only=True)
    sub_blocks: int = field(default=0, kw_only=True)
    attributes: Mapping[str, Any] = field(default_factory=dict, kw_only=True)
    more: xr.Dataset | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.gram)

    def _with(self, **changes: Any) -> Self:
        """Return the same with other fields, of the same class."""
        return object.__new__(type(self))._filled_with(self, **changes)

    def _filled_with(self, blocks: GramArrays, **changes: Any) -> Self:
        """Fill a new object with the fields of another one; subclasses have constructors of their own."""
        kept = {one.name: getattr(blocks, one.name) for one in fields(GramArrays)}
        GramArrays.__init__(self, **(kept | changes))
        return self

    @property
    def columns(self) -> list[str]:
        """Names of the columns, without the residuals."""
        return [name for name in self.names if not is_residual(name)]

    @property
    def middle(self) -> npt.NDArray[np.int64]:
        """Middle of each block, TT2000; (block,)."""
        return np.asarray(self.start // 2 + self.end // 2)

    @property
    def first_reference(self) -> Floats:
        """What the residual of the first block refers to, physical units; (parameter,)."""
        return np.zeros(self.scale.size - 1) if self.reference is None else self.reference[0, :-1]

    @property
    def residuals(self) -> list[int]:
        """Places of the residuals."""
        return [index for index, name in enumerate(self.names) if is_residual(name)]

    def index(self, names: Sequence[str]) -> Indices:
        """Return the places of columns by name.

        Raises
        ------
        CalibrationError
            When one is not there.
        """
        return places_of(names, {name: index for index, name in enumerate(self.names)})

    def _at(self, columns: Columns) -> Indices:
        return columns if isinstance(columns, np.ndarray) else self.index(columns)

    def _which(self, blocks: Indices | slice) -> Indices:
        return np.arange(len(self))[blocks]

    def rows(
        self, columns: Columns, others: Columns | None = None, blocks: Indices | slice | None = None
    ) -> Floats:
        """Return the products of some columns with others; (block, column, other), nT^2.

        Parameters
        ----------
        columns, others : sequence of str, or ndarray of int
            Names, or places as `index` returns them; all columns and residuals when `others` is
            absent.
        blocks : ndarray of int or slice, optional
            All when absent.
        """
        own = self._at(columns)
        if others is None:
            return self.gram[:, own] if blocks is None else self.gram[self._which(blocks)[:, None], own]
        grid = (own[:, None], self._at(others))
        if blocks is None:
            return self.gram[:, grid[0], grid[1]]
        return self.gram[self._which(blocks)[:, None, None], grid[0], grid[1]]

    def products_within(self, groups: Indices, blocks: Indices | slice | None = None) -> Floats:
        """Return the products of the columns of each group with each other; (block, group, k, k).

        Parameters
        ----------
        groups : ndarray of int, shape (group, k)
            Places of columns.
        blocks : ndarray of int or slice, optional
            All when absent.
        """
        which = self._which(slice(None) if blocks is None else blocks)
        return self.gram[which[:, None, None, None], groups[:, :, None], groups[:, None, :]]

    @property
    def squares(self) -> Floats:
        """Sum of squares of every column in each block; (block, column)."""
        return np.asarray(np.einsum("bii->bi", self.gram))

    @cached_property
    def total(self) -> Floats:
        """Sum over all blocks; (column, column)."""
        return np.asarray(self.gram.sum(axis=0, dtype=np.float64))

    @cached_property
    def _sums(self) -> dict[tuple[tuple[int, ...], ...], list[Floats]]:
        return {}

    def sums(self, folds: Sequence[Indices]) -> list[Floats]:
        """Return the sum over the blocks of each fold; kept, because every question asks for them."""
        key = tuple(tuple(fold.tolist()) for fold in folds)
        if key not in self._sums:
            self._sums[key] = [np.asarray(self.gram[fold].sum(axis=0, dtype=np.float64)) for fold in folds]
        return self._sums[key]

    @property
    def in_units(self) -> Floats:
        """Gram matrices of columns in physical units; (block, column, column)."""
        return np.asarray(self.gram / np.outer(self.scale, self.scale))

    def centred(self, columns: Indices, base: Indices) -> Floats:
        """Return the total Gram matrix of columns, each less what it shares with one column of the base.

        It is an effect's own variance about a constant channel: a temperature of 293 K that moves by one
        kelvin moves by one kelvin.
        """
        return centred_gram(self.total, columns, base)

    # Other blocks.

    def of_blocks(self, blocks: Indices | slice) -> Self:
        """Return some blocks."""

        def some(values: Any) -> Any:
            return None if values is None else values[blocks]

        return self._with(
            gram=self.gram[blocks],
            start=self.start[blocks],
            end=self.end[blocks],
            count=self.count[blocks],
            reference=some(self.reference),
            linearised_at=some(self.linearised_at),
            scatter=some(self.scatter),
            more=None if self.more is None else self.more.isel(block=blocks),
        )

    @property
    def bare(self) -> Self:
        """The blocks without further variables, which cost more to select than all the rest."""
        return self if self.more is None else self._with(more=None)

    @property
    def filled(self) -> Self:
        """The blocks that have rows: days without their housekeeping leave empty ones."""
        full = np.flatnonzero(self.count > 0)
        return self if full.size == len(self) else self.of_blocks(full)

    def within(self, start: int, end: int) -> Self:
        """Return the blocks that lie in a half-open TT2000 span."""
        return self.of_blocks(np.flatnonzero((self.start >= start) & (self.end <= end)))

    def merge(self, edges: Sequence[int]) -> Self:
        """Return wider blocks: all blocks between two TT2000 edges become one.

        Gram matrices, scores' scatter and counts add up, at the reference of the first block; scatter
        between the blocks is not in it.

        Raises
        ------
        CalibrationError
            When a block lies across an edge or outside the edges: it would be lost.
        """
        groups = [np.flatnonzero((self.start >= a) & (self.end <= b)) for a, b in pairwise(edges)]
        if sum(group.size for group in groups) != len(self):
            raise CalibrationError("a block lies across or outside the edges", remedy="use edges of blocks")
        return self.merge_groups([group for group in groups if group.size])

    def merge_groups(self, groups: Sequence[Sequence[int] | Indices]) -> Self:
        """Return wider blocks: each the sum of some consecutive ones; see `merge`."""
        pieces = [np.asarray(group) for group in groups if len(group)]
        first = [group[0] for group in pieces]
        common = self if self.reference is None else self.at_one_reference()
        return common._with(
            gram=np.stack([common.gram[group].sum(axis=0) for group in pieces]),
            start=self.start[first],
            end=np.array([self.end[group[-1]] for group in pieces]),
            count=np.array([self.count[group].sum() for group in pieces]),
            reference=None if common.reference is None else common.reference[first],
            linearised_at=None,
            scatter=None
            if common.scatter is None
            else np.stack([common.scatter[group].sum(axis=0) for group in pieces]),
            more=None,
        )

    def join(self, others: Sequence[Self]) -> Self:
        """Return the blocks of several, in order of time.

        Raises
        ------
        CalibrationError
            When columns or scales differ, or blocks overlap.
        """
        import xarray as xr

        every = [self, *others]
        if any(one.names != self.names or not np.array_equal(one.scale, self.scale) for one in every):
            raise CalibrationError(
                "the blocks were made from different libraries", remedy="run 'inflight diagnose' again"
            )
        start = np.concatenate([one.start for one in every])
        order = np.argsort(start, kind="stable")
        end = np.concatenate([one.end for one in every])[order]
        if np.any(start[order][1:] < end[:-1]):
            raise CalibrationError("blocks overlap", remedy="add each block once")

        def whole(name: str) -> Any:
            pieces = [getattr(one, name) for one in every]
            return None if any(one is None for one in pieces) else _in_order(pieces, order)

        more = [one.more for one in every]
        known = [one for one in more if one is not None]
        return self._with(
            gram=whole("gram"),
            start=start[order],
            end=end,
            count=np.concatenate([one.count for one in every])[order],
            reference=whole("reference"),
            linearised_at=whole("linearised_at"),
            scatter=whole("scatter"),
            more=xr.concat(known, "block", join="exact").isel(block=order)
            if len(known) == len(more)
            else None,
        )

    # Other columns.

    def select(self, names: Sequence[str]) -> Self:
        """Return some columns, with all residuals behind them; the others stay at their reference."""
        kept = np.concatenate([self.index(names), np.array(self.residuals, dtype=np.int64)])
        grid = (slice(None), kept[:, None], kept[None, :])
        along = dict.fromkeys(("column", "other"), kept)
        return self._with(
            names=tuple(self.names[index] for index in kept),
            gram=self.gram[grid],
            scale=self.scale[kept],
            reference=None if self.reference is None else self.reference[:, kept],
            linearised_at=None if self.linearised_at is None else self.linearised_at[:, kept],
            scatter=None if self.scatter is None else self.scatter[grid],
            more=None if self.more is None else self.more.isel(along, missing_dims="ignore"),
        )

    def expand(self, functions: Mapping[str, tuple[str, Floats]]) -> Self:
        """Return the blocks with columns added that are others times a function of the block.

        Parameters
        ----------
        functions : mapping of str to (str, ndarray)
            New name -> (column, factor of each block (block,)).
        """
        places = self.index([column for column, _ in functions.values()])
        factors = np.stack([factor for _, factor in functions.values()], axis=1)
        if self.reference is None and self.scatter is None:
            across = self.gram[:, :, places] * factors[:, None, :]
            inner = self.gram[:, places[:, None], places] * factors[:, :, None] * factors[:, None, :]
            return self.bordered(tuple(functions), self.scale[places], across, inner)
        own = len(self.names) - len(self.residuals)
        origin = np.insert(np.arange(len(self.names)), own, places)
        weight = np.ones((len(self), origin.size))
        weight[:, own : own + len(functions)] = factors
        names = (*self.names[:own], *functions, *self.names[own:])
        return self._times(names, origin, weight)

    def _times(self, names: Sequence[str], origin: Indices, weight: Floats) -> Self:
        """Return blocks of columns that are those at `origin` times a factor of each block."""
        grid = (slice(None), origin[:, None], origin[None, :])
        factor = weight[:, :, None], weight[:, None, :]
        return self._with(
            names=tuple(names),
            gram=self.gram[grid] * factor[0] * factor[1],
            scale=self.scale[origin],
            reference=None if self.reference is None else self.reference[:, origin],
            linearised_at=None,
            scatter=None if self.scatter is None else self.scatter[grid] * factor[0] * factor[1],
            more=None,
        )

    def combine(
        self, names: Sequence[str], weights: Floats, scale: Floats, reference: Floats | None = None
    ) -> Self:
        """Return blocks whose columns and residuals are linear combinations of these.

        Parameters
        ----------
        names : sequence of str
            Of the new columns and residuals.
        weights : ndarray, shape (block, new column, column)
            In scaled columns.
        scale : ndarray, shape (new column,)
        reference : ndarray, shape (block, new column), optional
            What the new residual refers to.
        """
        return self._with(
            names=tuple(names),
            gram=np.asarray(weights @ self.gram @ weights.swapaxes(1, 2)),
            scale=np.asarray(scale),
            reference=reference,
            linearised_at=None,
            scatter=None,
            more=None,
        )

    def bordered(self, names: Sequence[str], scale: Floats, across: Floats, inner: Floats) -> Self:
        """Return the blocks with columns added before the residuals; their reference is 0.

        Parameters
        ----------
        names : sequence of str
        scale : ndarray, shape (new column,)
        across : ndarray, shape (block, column, new column)
            Their products with every column and residual there is.
        inner : ndarray, shape (block, new column, new column)
        """
        width, count = len(self.names), len(names)
        own, last = width - len(self.residuals), slice(width - len(self.residuals) + count, width + count)
        out = np.empty((len(self), width + count, width + count), dtype=self.gram.dtype)
        first, fresh = slice(0, own), slice(own, own + count)
        for to, source in ((first, slice(0, own)), (last, slice(own, width))):
            out[:, to, first] = self.gram[:, source, :own]
            out[:, to, last] = self.gram[:, source, own:]
            out[:, to, fresh] = across[:, source]
            out[:, fresh, to] = across[:, source].transpose(0, 2, 1)
        out[:, fresh, fresh] = inner
        reference = self.reference
        return self._with(
            names=(*self.names[:own], *names, *self.names[own:]),
            gram=out,
            scale=np.insert(self.scale, own, scale),
            reference=None if reference is None else np.insert(reference, [own] * count, 0.0, axis=1),
            linearised_at=None,
            scatter=None,
            more=None,
        )

    def with_added_residual(self, products: Floats, square: Floats) -> Self:
        """Return blocks whose (last) residual has a series added to it.

        Parameters
        ----------
        products : ndarray, shape (block, column)
            Of the series with every column and residual.
        square : ndarray, shape (block,)
            Sum of squares of the series.
        """
        gram = self.gram.copy()
        gram[:, -1, :] += products
        gram[:, :, -1] += products
        gram[:, -1, -1] += square
        return self._with(gram=gram)

    # Marginalising.

    def marginalise(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]] | None = None,
        precision: Floats | None = None,
        dtype: npt.DTypeLike = np.float64,
        *,
        cut: float = SOLVER_SETTINGS.eigen_cut,
        least_kept: float = LEAST_KEPT,
    ) -> Self:
        """Return what is left of every column after some are fitted anew in each interval.

        Frisch, Waugh and Lovell: the columns that stay, and the residuals, are replaced by their
        parts no combination of the marginalised ones explains within the interval.

        Parameters
        ----------
        names : sequence of str
            Columns to marginalise.
        groups : sequence of sequence of int, optional
            Blocks of each interval; each block is one when absent.
        precision : ndarray, shape (marginalised column,), optional
            What is known of them beforehand, 1 / sigma^2 in scaled units times the residual's variance;
            nothing when absent.
        dtype : dtype
            Of the result. Single precision holds seven digits of what is left, in half the memory.
        cut : float
            See `inflight.lsq.solver.solve_scaled`.
        least_kept : float
            Columns of which less than this part of their square is left become 0.
        """
        gone = self.index(names)
        kept = np.setdiff1d(np.arange(len(self.names)), gone)
        out = np.empty((len(self), kept.size, kept.size), dtype=dtype)
        every = [[block] for block in range(len(self))] if groups is None else groups
        order = np.concatenate([np.asarray(group) for group in every])
        begins = np.cumsum([0, *(len(group) for group in every)])
        total = np.add.reduceat(self.gram[order[:, None], gone], begins[:-1], axis=0)
        fitted = solve_scaled(total[:, :, gone], total[:, :, kept], cut, precision)
        interval = np.repeat(np.arange(len(every)), np.diff(begins))
        # Small matrices many at a time, large ones one by one: what lies between fits into the cache.
        at_once = max(1, 100_000 // kept.size**2)
        for at in range(0, order.size, at_once):
            some, own = order[at : at + at_once], fitted[interval[at : at + at_once]]
            rows = self.gram[some[:, None], gone]
            cross = own.swapaxes(1, 2) @ (rows[:, :, kept] - 0.5 * rows[:, :, gone] @ own)
            out[some] = self.gram[np.ix_(some, kept, kept)] - cross - cross.swapaxes(1, 2)
        names_kept = tuple(self.names[index] for index in kept)
        dead = np.diagonal(out.sum(axis=0, dtype=np.float64)) <= least_kept * np.diagonal(self.total)[kept]
        dead &= ~np.array([is_residual(name) for name in names_kept])
        out[:, dead, :] = 0.0
        out[:, :, dead] = 0.0
        return self._with(
            names=names_kept,
            gram=out,
            scale=self.scale[kept],
            reference=None if self.reference is None else self.reference[:, kept],
            linearised_at=None,
            scatter=None,
            more=None,
        )

    # At values of the parameters: one residual, the last column, and a reference.

    def at(self, reference: Floats) -> Self:
        """Return the blocks with the residual expressed at one reference, or at one of each block.

        Parameters
        ----------
        reference : ndarray, shape (parameter,) or (block, parameter)
            Physical units.
        """
        change = self.change(reference)
        if not change.any():
            return self
        gram = [shift_reference(one, step) for one, step in zip(self.gram, change, strict=True)]
        each = np.broadcast_to(reference, change.shape)
        return self._with(
            gram=np.array(gram).reshape(self.gram.shape),
            reference=np.concatenate([each, np.zeros((len(self), 1))], axis=1),
        )

    def at_one_reference(self) -> Self:
        """Return the blocks at the reference of the first one."""
        if self.reference is None or not len(self) or not np.ptp(self.reference, axis=0).any():
            return self
        return self.at(self.reference[0, :-1])

    def change(self, value: Floats) -> Floats:
        """Return values as scaled changes from the reference; (block, parameter).

        Parameters
        ----------
        value : ndarray, shape (parameter,) or (block, parameter)
            Physical units.
        """
        reference = 0.0 if self.reference is None else self.reference[:, :-1]
        change = (value - reference) / self.scale[:-1]
        return np.asarray(np.broadcast_to(change, (len(self), self.scale.size - 1)))

    def scores(self, value: Floats) -> Floats:
        """Return each block's scores ``X^T y`` at values of the parameters; (block, parameter).

        Parameters
        ----------
        value : ndarray, shape (parameter,) or (block, parameter)
            Physical units.

        Returns
        -------
        ndarray, shape (block, parameter)
            nT^2 per scaled unit; they sum to zero at a least-squares solution.
        """
        slopes = np.einsum("bij,bj->bi", self.gram[:, :-1, :-1], self.change(value))
        return np.asarray(self.gram[:, :-1, -1] + slopes)

    def squares_at(self, value: Floats) -> Floats:
        """Return each block's sum of squared residuals at values of the parameters; (block,) nT^2.

        Parameters
        ----------
        value : ndarray, shape (parameter,) or (block, parameter)
            Physical units.
        """
        change = self.change(value)
        return np.array([residual_sum(one, step) for one, step in zip(self.gram, change, strict=True)])

    def weighted(self, weight: Floats) -> BlockSums:
        """Return sums over the blocks with weights (block,), whose columns may be functions of time."""
        return BlockSums(self.gram, weight)

    def weighted_scatter(self, weight: Floats) -> BlockSums:
        """Return sums of the scores' scatter within the blocks with weights (block,); 0 without a scatter."""
        return BlockSums(self._scatter, weight**2)

    @property
    def _scatter(self) -> Floats:
        return np.broadcast_to(0.0, self.gram.shape) if self.scatter is None else self.scatter

    # In a store.

    def as_dataset(self) -> xr.Dataset:
        """Return the blocks as a Dataset for a store: packed upper triangles."""
        import xarray as xr

        return xr.Dataset(
            {
                "gram": (("block", "entry"), pack(self.gram), {"units": "nT2"}),
                "start": ("block", self.start, {"units": "ns", "scale": "TT2000"}),
                "end": ("block", self.end, {"units": "ns", "scale": "TT2000"}),
                "count": ("block", self.count),
            }
        )


def places_of(names: Sequence[str], places: Mapping[str, int]) -> Indices:
    """Return the places of columns by name.

    Raises
    ------
    CalibrationError
        When one is not there.
    """
    missing = [name for name in names if name not in places]
    if missing:
        raise CalibrationError(
            f"the library's equations have no column {', '.join(missing[:3])}",
            remedy="run 'inflight diagnose' again: it makes the columns that are missing",
        )
    return np.array([places[name] for name in names], dtype=np.int64)


def centred_gram(total: Floats, columns: Indices, base: Indices) -> Floats:
    """Return the Gram matrix of columns about what they share with one column of the base.

    `total` (column, column) is that of all columns; see `GramArrays.centred`.
    """
    if not base.size:
        return np.asarray(total[np.ix_(columns, columns)])
    size = np.sqrt(np.clip(np.diag(total), 1e-300, None))
    likeness = np.abs(total[np.ix_(columns, base)]) / size[columns][:, None] / size[base][None, :]
    nearest = base[np.argmax(likeness, axis=1)]
    share = total[columns, nearest] / np.clip(total[nearest, nearest], 1e-300, None)
    out = total[np.ix_(columns, columns)] - share[:, None] * total[np.ix_(nearest, columns)]
    out = out - share[None, :] * total[np.ix_(columns, nearest)]
    return np.asarray(out + np.outer(share, share) * total[np.ix_(nearest, nearest)])


def is_residual(name: str) -> bool:
    """Return True for the name of a residual."""
    return name.split("~", maxsplit=1)[0] == RESIDUAL


def _in_order(pieces: Sequence[Floats], order: Indices) -> Floats:
    """Return the pieces as one array in an order; of gigabytes only one copy is made."""
    place = np.argsort(order, kind="stable")
    out = np.empty((order.size, *pieces[0].shape[1:]))
    at = 0
    for piece in pieces:
        out[place[at : at + len(piece)]] = piece
        at += len(piece)
    return out


#: Variables of `full_dataset`; a store may hold more.
_OWN = ("gram", "scatter", "reference", "linearised_at", "start", "end", "count", "scale")


def full_dataset(blocks: GramArrays) -> xr.Dataset:
    """Return blocks as a Dataset of whole matrices with names; further variables of the blocks stay in it.

    Returns
    -------
    xarray.Dataset
        dims block, column, other (= column): `gram` (block, column, other) nT^2 in scaled columns,
        residual last; `scatter`, `reference`, `linearised_at` where there are; `start`, `end` (block)
        TT2000; `count` (block) sum of weights; `scale` (column); what else the blocks carry.
    """
    import xarray as xr

    row, each = ("block", "column", "other"), ("block", "column")
    sub_blocks = {"sub_blocks": blocks.sub_blocks} if blocks.sub_blocks else {}
    found: dict[str, Any] = {"gram": (row, blocks.gram, {"units": "nT2"})}
    if blocks.scatter is not None:
        found["scatter"] = (row, blocks.scatter, {"units": "nT4", **sub_blocks})
    if blocks.reference is not None:
        found["reference"] = (each, blocks.reference)
    if blocks.linearised_at is not None:
        found["linearised_at"] = (each, blocks.linearised_at)
    found["start"] = ("block", blocks.start, {"units": "ns", "scale": "TT2000"})
    found["end"] = ("block", blocks.end, {"units": "ns", "scale": "TT2000"})
    found["count"] = ("block", blocks.count)
    found["scale"] = ("column", blocks.scale)
    names = list(blocks.names)
    made = xr.Dataset(found, coords={"column": names, "other": names}, attrs=dict(blocks.attributes))
    return made if blocks.more is None else made.assign(blocks.more.data_vars)


def arrays_of(dataset: xr.Dataset) -> dict[str, Any]:
    """Return the fields of `GramArrays` that a Dataset of `full_dataset` holds."""
    blocks = dataset["gram"].shape[0]

    def known(name: str, dtype: type = np.float64) -> Any:
        return dataset[name].values if name in dataset else np.zeros(blocks, dtype=dtype)

    def optional(name: str) -> Any:
        return dataset[name].values if name in dataset else None

    scatter = dataset.get("scatter")
    return {
        "names": tuple(str(name) for name in dataset["column"].values),
        "gram": dataset["gram"].values,
        "start": known("start", np.int64),
        "end": known("end", np.int64),
        "count": known("count"),
        "scale": dataset["scale"].values,
        "reference": optional("reference"),
        "linearised_at": optional("linearised_at"),
        "scatter": optional("scatter"),
        "sub_blocks": 0 if scatter is None else int(scatter.attrs.get("sub_blocks", 0)),
        "attributes": dict(dataset.attrs),
        "more": dataset.drop_vars([name for name in _OWN if name in dataset])
        if set(map(str, dataset.data_vars)) - set(_OWN)
        else None,
    }


Owners = npt.NDArray[np.int64]


@dataclass(frozen=True)
class BlockSums:
    """Gram matrices of blocks and the weight of each.

    Attributes
    ----------
    gram : ndarray, shape (block, column + 1, column + 1)
        The residual last.
    weight : ndarray, shape (block,)
    """

    gram: Floats
    weight: Floats

    @cached_property
    def plain(self) -> Floats:
        """The weighted sum of the matrices; (column + 1, column + 1)."""
        return np.asarray(np.tensordot(self.weight, self.gram, 1))

    def expanded(self, values: Floats, owners: Owners) -> Floats:
        """Return the sum for columns that are functions of time.

        Parameters
        ----------
        values : ndarray, shape (block, function)
            Factor of the owner's column.
        owners : ndarray of int, shape (function,)
            Column of the matrices each function belongs to.

        Returns
        -------
        ndarray, shape (function + 1, function + 1)
            The residual last.
        """
        with_residual = np.append(owners, self.plain.shape[0] - 1)
        constant = np.append(values[0], 1.0)
        out = self.plain[np.ix_(with_residual, with_residual)] * np.outer(constant, constant)
        varying = np.flatnonzero(np.ptp(values, axis=0) > 0)
        functions = {int(owner): varying[owners[varying] == owner] for owner in np.unique(owners[varying])}
        weighted = self.weight[:, None] * values
        for owner, rows in functions.items():
            products = weighted[:, rows].T @ self.gram[:, owner, :]
            out[rows, :] = products[:, with_residual] * constant
            out[:, rows] = out[rows, :].T
        for owner, rows in functions.items():
            for other, columns in functions.items():
                products = self.gram[:, owner, other, None] * values[:, columns]
                out[np.ix_(rows, columns)] = weighted[:, rows].T @ products
        return np.asarray(out)

    def scores(self, values: Floats, owners: Owners, parameters: Floats) -> Floats:
        """Return each block's scores at parameters of its own; (block, function).

        Parameters
        ----------
        values, owners
            As in `expanded`.
        parameters : ndarray, shape (block, column)
            Scaled changes from the reference.
        """
        change = np.concatenate([parameters, np.ones((len(parameters), 1))], axis=1)
        slopes = np.matmul(self.gram, change[:, :, None])[:, :, 0]
        return np.asarray(self.weight[:, None] * slopes[:, owners] * values)
