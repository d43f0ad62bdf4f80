"""Gram blocks in little memory: what each interval's calibration leaves, in single precision, and rows of it.

A search asks for the same blocks in several forms: as they are, with the calibration fitted anew every day,
with it fitted anew in each of its intervals. All of these are one matrix that the forms share, plus a product
of low rank. With X the columns of the calibration and Z all columns of a block, A = X'X, B = X'Z, and F the
block's own fit of X to Z, what is kept is

- ``rest`` = (Z - X F)'(Z - X F), in single precision: nothing large cancels in it any more;
- ``given`` = B, in double precision: the calibration's products with every column.

A fit G of X, any one, explains

    S(G)  =  G'H + H'G,  H = B - A G / 2,

of the products Z'Z, exactly, whether A can be inverted or not. With another fit G in the place of F

    (Z - X G)'(Z - X G)  =  rest + S(F) - S(G).

G = 0 gives the block as it was, G = F what its own calibration leaves. Blocks of several days hold one pair
(A, B) a day, and `rest` is their sum, as S(F) is; a fit G of all of them needs the sums of A and of B alone.

F itself is not kept. It is P B, with P the inverse of A in the directions that A determines, and 1 for the
calibration's own columns; a product of few columns i with many others j needs the fits to the few alone:

    F_i'B_j + (B_i - A F_i)'F_j  =  (F_i + P (B_i - A F_i))'B_j.

Columns that join (`FactoredGrams.bordered`, `expand`) are appended to what all forms share; a form that
was made before does not see them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.lsq.gram_blocks import (
    LEAST_KEPT,
    Columns,
    GramArrays,
    GramBlocks,
    centred_gram,
    in_turns,
    is_residual,
    places_of,
)
from inflight.lsq.solver import SOLVER_SETTINGS, Indices, ScaledSystems, solve_scaled
from inflight.lsq.triangles import Triangles, are_neighbours, places_of_entries

#: Begin of a fit that a block does not have.
NO_FIT = int(np.iinfo(np.int64).max)

#: Columns that may join before the shared arrays are made anew, as a part of those there are.
_ROOM = 0.1


class _Shared:
    """Arrays that all forms of some blocks share; columns are appended, never changed.

    Attributes
    ----------
    rest : Triangles
        Of all columns.
    given : ndarray, shape (block, fit, base, column)
        B of each fit of the calibration; the calibration's own columns come first.
    base : int
        Columns of the calibration.
    """

    def __init__(self, rest: Triangles, given: Floats) -> None:
        self.rest, self.given, self.base = rest, given, given.shape[2]

    @property
    def width(self) -> int:
        """Columns in use."""
        return self.rest.width

    @cached_property
    def systems(self) -> ScaledSystems:
        """A of each fit, to be solved."""
        return ScaledSystems(self.own)

    def fits(self, blocks: Indices, columns: Indices) -> Floats:
        """Return F of some blocks and columns; (block, fit, base, column).

        They are made whenever they are asked for: kept, they would take as much memory as `given`.
        """
        out = self.systems.solve(_part_of(self.given, blocks, columns), blocks)
        own = np.flatnonzero(columns < self.base)
        out[..., own] = np.eye(self.base)[:, columns[own]]
        return out

    @property
    def own(self) -> Floats:
        """The calibration's products with itself; (block, fit, base, base)."""
        return self.given[..., : self.base]

    def append(self, across: Floats, inner: Floats, given: Floats) -> None:
        """Append columns.

        Parameters
        ----------
        across : ndarray, shape (block, column, new column)
        inner : ndarray, shape (block, new column, new column)
        given : ndarray, shape (block, fit, base, new column)
        """
        old, new = self.width, self.width + inner.shape[-1]
        if new > self.given.shape[-1]:
            wider = np.zeros((*self.given.shape[:3], new + int(_ROOM * new)))
            wider[..., :old] = self.given[..., :old]
            self.given = wider
        self.rest.append(across, inner, self.given.shape[-1])
        self.given[..., old:new] = given


@dataclass(frozen=True, eq=False)
class FactoredGrams:
    """Gram blocks that share one matrix of single precision with their other forms; see the module.

    Attributes
    ----------
    names : tuple of str
        Columns, then residuals.
    places : ndarray of int, shape (column,)
        Where they are in the shared arrays.
    start, end : ndarray of int64, shape (block,)
        TT2000, half-open.
    count : ndarray, shape (block,)
        Sum of weights: good rows.
    scale : ndarray, shape (column,)
        Physical size of one unit of each column; 1 for residuals.
    begins : ndarray of int64, shape (block, fit)
        First instant of each fit of the calibration in a block, TT2000; ``NO_FIT`` where there are fewer.
    shared : object
        `rest` and `given` of all forms.
    taken : ndarray, shape (interval, base, column), optional
        The fit G of the calibration that is taken off, in each interval; nothing when absent.
    interval : ndarray of int, shape (block,), optional
        Interval of each block. Absent, with `taken` absent, of blocks less each fit of their own.
    dead : ndarray of bool, shape (column,)
        Columns of which nothing is left but rounding: 0.
    """

    names: tuple[str, ...]
    places: Indices
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    count: Floats
    scale: Floats
    begins: npt.NDArray[np.int64]
    shared: _Shared = field(repr=False)
    taken: Floats | None = None
    interval: Indices | None = None
    dead: npt.NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, grams: GramBlocks, base: Sequence[str]) -> Self:
        """Return the factored form of Gram blocks.

        Parameters
        ----------
        grams : GramBlocks
        base : sequence of str
            Columns of the calibration.
        """
        order = _stored_order(grams.names, base)
        places, k = grams.index(order), len(base)
        given = grams.rows(places[:k], places)[:, None]
        fitted = _own_fits(given)
        rest = Triangles.zeros(len(grams), places.size)
        for block in range(len(grams)):
            b, f = given[block, 0], fitted[block, 0][:, k:]
            cross = f.T @ (b[:, k:] - 0.5 * b[:, :k] @ f)
            left = grams.rows(places[k:], places[k:], np.array([block]))[0]
            left -= cross
            left -= cross.T
            rest.put(block, left)
        known = grams.start, grams.end, grams.count, grams.scale
        return cls._stored(grams.names, places, *known, rest, given)

    @classmethod
    def of_rows(
        cls,
        names: Sequence[str],
        columns: Floats,
        residuals: Floats,
        weight: Floats,
        parts: Sequence[slice],
        span: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
        scale: Floats,
        base: Sequence[str],
    ) -> Self:
        """Return the blocks of consecutive parts of some rows.

        What the calibration leaves of the rows is multiplied: single precision loses nothing then, and takes
        half the time; see `inflight.lsq.gram_of` for the same in double precision.

        Parameters
        ----------
        names : sequence of str
            Columns, then residuals.
        columns : ndarray, shape (time, row, column)
        residuals : ndarray, shape (time, row, residual)
        weight : ndarray, shape (time,)
            Every good sample counts once.
        parts : sequence of slice
            Of the time.
        span : pair of ndarray of int64, shape (part,)
            First instant and end of each part, TT2000.
        scale : ndarray, shape (column + residual,)
        base : sequence of str
            Columns of the calibration.
        """
        k, rows, count = len(base), columns.shape[1], columns.shape[2]
        places = places_of(_stored_order(names, base), {name: place for place, name in enumerate(names)})
        # Columns lie one after another, those of the calibration first.
        values, residual = columns.transpose(2, 1, 0), residuals.transpose(2, 1, 0)
        if not np.array_equal(places, np.arange(places.size)):
            values = values[places[:count]]
        given = np.zeros((len(parts), 1, k, places.size))
        pieces = [[(row, some) for row in range(rows) for some in in_turns(part, _ROWS)] for part in parts]
        for at, own in enumerate(pieces):
            for row, some in own:
                weighted = values[:k, row, some] * weight[some]
                given[at, 0, :, :count] += weighted @ values[:, row, some].T
                given[at, 0, :, count:] += weighted @ residual[:, row, some].T
        fitted, root = _own_fits(given), np.sqrt(np.clip(weight, 0.0, None)).astype(np.float32)
        rest, whole = Triangles.zeros(len(parts), places.size), bool(np.all(root == 1.0))
        for at, own in enumerate(pieces):
            fit, total = fitted[at, 0].T, np.zeros((places.size - k, places.size - k), dtype=np.float32)
            for row, some in own:
                left = np.empty((places.size - k, some.stop - some.start), dtype=np.float32)
                calibration, library = values[:k, row, some], values[k:, row, some]
                np.subtract(library, fit[k:count] @ calibration, out=left[: count - k], casting="same_kind")
                other = residual[:, row, some]
                np.subtract(other, fit[count:] @ calibration, out=left[count - k :], casting="same_kind")
                if not whole:
                    left *= root[some]
                total += left @ left.T
            rest.put(at, total)
        good = np.array([weight[part].sum() * rows for part in parts])
        return cls._stored(tuple(names), places, *span, good, scale, rest, given)

    @classmethod
    def _stored(
        cls,
        names: tuple[str, ...],
        places: Indices,
        start: npt.NDArray[np.int64],
        end: npt.NDArray[np.int64],
        count: Floats,
        scale: Floats,
        rest: Triangles,
        given: Floats,
    ) -> Self:
        """Return blocks of one fit each; `places` are those in `names` of the columns as they are stored."""
        return cls(names, np.argsort(places), start, end, count, scale, start[:, None], _Shared(rest, given))

    def merged(self, others: Sequence[Self], fits: int = 0) -> Self:
        """Return blocks to each of which one of each of some others, later and of the same columns, is added.

        Parameters
        ----------
        others : sequence of FactoredGrams
            As many blocks; every one keeps its own fits of the calibration.
        fits : int
            Fits that there is room for in a block, at least.
        """
        every = [self, *others]
        rest = Triangles.sum([one.shared.rest for one in every])
        given = np.concatenate([one.shared.given for one in every], axis=1)
        begins = np.concatenate([one.begins for one in every], axis=1)
        room = max(fits - begins.shape[1], 0)
        given = np.pad(given, ((0, 0), (0, room), (0, 0), (0, 0)))
        begins = np.pad(begins, ((0, 0), (0, room)), constant_values=NO_FIT)
        return replace(
            self,
            end=every[-1].end,
            count=np.sum([one.count for one in every], axis=0),
            begins=begins,
            shared=_Shared(rest, given),
        )

    def in_one_fit(self) -> Self:
        """Return the blocks with one fit of the calibration each, of all that is in them."""
        if self.fits == 1:
            return self
        given = self.shared.given.sum(axis=1, keepdims=True)
        fitted, stored = _own_fits(given), np.argsort(self.places)
        left = replace(self, taken=fitted[:, 0][..., self.places], interval=np.arange(len(self)))
        others = stored[self.shared.base :]
        rest = Triangles.zeros(len(self), stored.size)
        for block in range(len(self)):
            rest.put(block, left.rows(others, others, np.array([block]))[0])
        return replace(self, begins=self.begins[:, :1], shared=_Shared(rest, given))

    # In a store.

    def as_dataset(self) -> xr.Dataset:
        """Return the blocks as a Dataset for a store; `FactoredGrams.read` makes blocks of such."""
        k = self.shared.base
        rest = self.shared.rest.values.take(_stored_entries(self.shared.width, k), axis=1)
        given = {"given": (("block", "fit", "base", "column"), self.shared.given, {"units": "nT2"})}
        return xr.Dataset(
            {
                "rest": (("block", "entry"), rest, {"units": "nT2"}),
                # A store has no arrays without an element: a calibration without columns is not kept.
                **(given if k else {}),
                "begins": (("block", "fit"), self.begins, {"units": "ns", "scale": "TT2000"}),
                "start": ("block", self.start, {"units": "ns", "scale": "TT2000"}),
                "end": ("block", self.end, {"units": "ns", "scale": "TT2000"}),
                "count": ("block", self.count),
            }
        )

    @classmethod
    def read(
        cls,
        parts: Iterable[xr.Dataset],
        blocks: int,
        names: Sequence[str],
        scale: Floats,
        base: Sequence[str],
        columns: Collection[str] | None = None,
    ) -> Self:
        """Return blocks of Datasets of `as_dataset`, in order of time; of gigabytes there is one copy only.

        Parameters
        ----------
        parts : iterable of xarray.Dataset
            Each is let go before the next is asked for.
        blocks : int
            Of all parts together.
        names, scale, base
            Columns and residuals in their order, their units, and those of the calibration.
        columns : collection of str, optional
            Only these beside the calibration's and the residuals; all when absent.
        """
        stored, k = _stored_order(names, base), len(base)
        kept = np.array(
            [
                place
                for place, name in enumerate(stored)
                if columns is None or place < k or name in columns or is_residual(name)
            ],
            dtype=np.int64,
        )
        order, width = [stored[place] for place in kept], kept.size
        places = {name: place for place, name in enumerate(order)}
        own = [place for place, name in enumerate(names) if name in places]
        # Where each entry is in a store: its upper triangle, row by row.
        first, second = (kept[places + k] - k for places in np.triu_indices(width - k))
        table = first * (2 * (len(stored) - k) - first - 1) // 2 + second
        entries = _stored_entries(width, k)
        rest = Triangles.zeros(blocks, width)
        known: dict[str, Any] = {}
        at = 0
        for part in parts:
            some = part["rest"].values
            for place, packed in enumerate(some, start=at):
                rest.values[place, entries] = packed[table]
            nothing = np.zeros((*part["begins"].shape, 0, len(stored)))
            for name in ("given", "begins", "start", "end", "count"):
                values = part[name].values if name in part else nothing
                if name == "given" and columns is not None:
                    values = values.take(kept, axis=-1)
                whole = known.setdefault(name, np.empty((blocks, *values.shape[1:]), dtype=values.dtype))
                whole[at : at + len(some)] = values
            at += len(some)
        shared = _Shared(rest, known["given"])
        return cls(
            tuple(names[place] for place in own),
            np.array([places[names[place]] for place in own], dtype=np.int64),
            known["start"],
            known["end"],
            known["count"],
            np.asarray(scale)[own],
            known["begins"],
            shared,
        )

    def __len__(self) -> int:
        return len(self.start)

    @property
    def reference(self) -> None:
        """The residual refers to where the columns were formed."""
        return

    linearised_at = scatter = reference

    @cached_property
    def _by_name(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def index(self, names: Sequence[str]) -> Indices:
        """Return the places of columns by name; `CalibrationError` when one is not there."""
        return places_of(names, self._by_name)

    @cached_property
    def residuals(self) -> list[int]:
        """Places of the residuals."""
        return [place for place, name in enumerate(self.names) if is_residual(name)]

    @property
    def columns(self) -> list[str]:
        """Names of the columns, without the residuals."""
        return [name for name in self.names if not is_residual(name)]

    @property
    def fits(self) -> int:
        """Fits of the calibration that a block holds at most."""
        return int(self.begins.shape[1])

    # The product of low rank.

    @property
    def _is_raw(self) -> bool:
        """True of blocks as they are, nothing taken off."""
        return self.taken is None and self.dead is None

    @property
    def _is_rest(self) -> bool:
        """True of blocks less each fit of their own: `rest` as it is."""
        return self.taken is None and self.dead is not None

    def _factors(self, columns: Indices, blocks: Indices) -> Iterator[tuple[Floats, Floats]]:
        """Yield pairs L and R of some blocks: `rest` lacks the sum of L'R + R'L; (block, m, column) each.

        In double precision: where a block hardly determines the calibration, its own fit F is huge along what
        it does not, and only what it explains is small.
        """
        at, shared, own = self.places[columns], self.shared, self.shared.own[blocks]
        fitted, given = shared.fits(blocks, at), _part_of(shared.given, blocks, at)
        yield _in_one(fitted), _in_one(_half_explained(own, given, fitted))
        if self.taken is not None and self.interval is not None:
            taken = _part_of(self.taken, self.interval[blocks], columns)
            yield -taken, _half_explained(own.sum(axis=1), given.sum(axis=1), taken)

    def _add_factors(self, out: Floats, own: Indices, other: Indices, blocks: Indices) -> None:
        """Add to products (block, column, other) what `rest` lacks, where `own` are few columns."""
        at, shared, squares = self.places[own], self.shared, self.shared.own[blocks]
        fitted, given = shared.fits(blocks, at), _part_of(shared.given, blocks, at)
        # What rounding leaves of `given` is multiplied by the fits to `other`: (B - A F)'P B, see the module.
        off = fitted + shared.systems.solve(given - squares @ fitted, blocks)
        missed = given.sum(axis=1)
        if self.taken is not None and self.interval is not None:
            taken, others = (_part_of(self.taken, self.interval[blocks], some) for some in (own, other))
            off -= taken[:, None]
            missed -= squares.sum(axis=1) @ taken
            out -= missed.swapaxes(1, 2) @ others
        # Others are read where they lie, with those between them, which are then left out.
        at = self.places[other]
        span = np.arange(at.min(), at.max() + 1) if at.size >= _FEW else at
        made = _in_one(off).swapaxes(1, 2) @ _in_one(_part_of(shared.given, blocks, span))
        # The calibration's own columns are fitted by 1, whether that can be told from the products or not.
        base = np.flatnonzero(span < shared.base)
        made[..., base] = missed[:, span[base]].swapaxes(1, 2)
        out += made if span is at else made.take(at - span[0], axis=2)

    # Products.

    def _at(self, columns: Columns) -> Indices:
        return columns if isinstance(columns, np.ndarray) else self.index(columns)

    def _which(self, blocks: Indices | slice | None) -> Indices:
        return np.arange(len(self))[slice(None) if blocks is None else blocks]

    def rows(
        self, columns: Columns, others: Columns | None = None, blocks: Indices | slice | None = None
    ) -> Floats:
        """Return the products of some columns with others; (block, column, other); see `GramArrays.rows`."""
        own = self._at(columns)
        other = np.arange(len(self.names)) if others is None else self._at(others)
        which = self._which(blocks)
        raw = self._is_raw
        if blocks is None and not raw and (others is None or self._kept_rows.hold(own)):
            return self._kept(own, None if others is None else other)
        return self._made_rows(own, other, which)

    def _made_rows(self, own: Indices, other: Indices, which: Indices | None = None) -> Floats:
        """Return the products of some columns with others, read and made; (block, column, other)."""
        which, raw = self._which(which), self._is_raw
        if raw and np.all(self.places[own] < self.shared.base):
            given = self.shared.given[which[:, None, None], :, self.places[own][:, None], self.places[other]]
            return np.asarray(given.sum(axis=3))
        matrix, places, factored = self.shared.rest, self.places, not self._is_rest
        out = np.empty((which.size, own.size, other.size))
        entries = places_of_entries(places[own][:, None], places[other])
        rank = 2 * self.fits * self.shared.base if factored else 1
        # Of many others all columns between them are read.
        read = self.shared.width if factored and other.size >= _FEW else other.size
        for some in _in_parts(which.size, max(own.size, rank) * read):
            blocks = which[some]
            out[some] = matrix.at(blocks, entries)
            if factored:
                self._add_factors(out[some], own, other, blocks)
        self._clear(out, own, other)
        return out

    def _kept(self, columns: Indices, others: Indices | None = None) -> Floats:
        """Return the products of some columns with others; (block, column, other).

        A search asks for those of its model and its residual with all again and again: they are kept, and
        where they lie together nothing is copied.
        """
        known = self._kept_rows
        new = [place for place in dict.fromkeys(columns.tolist()) if place not in known.places]
        if new:
            known.append(new, self._made_rows(np.array(new), np.arange(len(self.names))))
        return known.of(columns.tolist(), others).transpose(1, 0, 2)

    @cached_property
    def _kept_rows(self) -> _KeptRows:
        return _KeptRows()

    def forget_products(self) -> None:
        """Let go of the products that were kept: they are made again when they are asked for."""
        for name in _CARRIED:
            self.__dict__.pop(name, None)

    def _clear(self, out: Floats, own: Indices, other: Indices) -> None:
        """Set the products of dead columns to 0."""
        if self.dead is not None and self.dead.any():
            out[..., self.dead[own], :] = 0.0
            out[..., self.dead[other]] = 0.0

    def products_within(self, groups: Indices, blocks: Indices | slice | None = None) -> Floats:
        """Return the products of the columns of each group with each other; (block, group, k, k)."""
        if blocks is not None:
            return self._products_within(groups, self._which(blocks))
        known, keys = self._kept_within, [tuple(group) for group in groups.tolist()]
        new = [place for place, key in enumerate(keys) if key not in known]
        if new:
            made = self._products_within(groups[new], np.arange(len(self))).swapaxes(0, 1)
            known.update(zip([keys[place] for place in new], made, strict=True))
        out = np.empty((len(self), *groups.shape, groups.shape[-1]))
        for place, key in enumerate(keys):
            out[:, place] = known[key]
        return out

    @cached_property
    def _kept_within(self) -> dict[tuple[int, ...], Floats]:
        """Products of a candidate's own columns, by these; (block, k, k): the same in every round."""
        return {}

    def _products_within(self, groups: Indices, which: Indices) -> Floats:
        matrix, factored, at = self.shared.rest, not self._is_rest, self.places[groups]
        out = np.empty((which.size, *groups.shape, groups.shape[-1]))
        entries = places_of_entries(at[:, :, None], at[:, None, :])
        size = groups.size * max(groups.shape[-1], 2 * self.fits * self.shared.base)
        for some in _in_parts(which.size, size):
            part = which[some]
            out[some] = matrix.at(part, entries)
            if factored:
                for left, right in self._factors(groups.ravel(), part):
                    product = _within(left, right, groups.shape[-1])
                    out[some] += product + product.swapaxes(2, 3)
        if self.dead is not None and self.dead.any():
            dead = self.dead[groups]
            out *= ~(dead[:, :, None] | dead[:, None, :])
        return out

    @cached_property
    def squares(self) -> Floats:
        """Sum of squares of every column in each block; (block, column)."""
        return self._squares_of(np.arange(len(self.names)))

    def _squares_of(self, columns: Indices) -> Floats:
        out = self.shared.rest.diagonal(self.places[columns]).astype(np.float64)
        for some in _in_parts(len(self), 4 * self.fits * max(self.shared.base, 1) * columns.size):
            if not self._is_rest:
                for left, right in self._factors(columns, np.arange(len(self))[some]):
                    out[some] += 2.0 * np.einsum("bmi,bmi->bi", left, right)
        if self.dead is not None:
            out[:, self.dead[columns]] = 0.0
        return np.asarray(out)

    @cached_property
    def total(self) -> Floats:
        """Sum over all blocks; (column, column)."""
        return np.asarray(self.sums([np.arange(len(self))])[0])

    @cached_property
    def _sums(self) -> dict[tuple[tuple[int, ...], ...], list[Floats]]:
        return {}

    def sums(self, folds: Sequence[Indices]) -> list[Floats]:
        """Return the sum over the blocks of each fold; kept, because every question asks for them."""
        key = tuple(tuple(np.asarray(fold).tolist()) for fold in folds)
        if key not in self._sums:
            every = np.arange(len(self.names))
            entries = places_of_entries(self.places[:, None], self.places)
            out = [self.shared.rest.sum_of(fold, entries) for fold in folds]
            if not self._is_rest:
                size = 4 * self.fits * max(self.shared.base, 1) * every.size
                for place, fold in enumerate(folds):
                    for some in _in_parts(len(fold), size):
                        for pair in self._factors(every, np.asarray(fold)[some]):
                            left, right = (part.reshape(-1, every.size) for part in pair)
                            product = left.T @ right
                            out[place] += product + product.T
            for one in out:
                self._clear(one, every, every)
            self._sums[key] = out
        return self._sums[key]

    def centred(self, columns: Indices, base: Indices) -> Floats:
        """Return the total matrix of columns about what they share with one column of the base."""
        places = np.concatenate([columns, base])
        total, at = self.rows(places, places).sum(axis=0), np.arange(places.size)
        return centred_gram(total, at[: columns.size], at[columns.size :])

    # Other blocks and columns.

    def select(self, names: Sequence[str]) -> GramArrays:
        """Return some columns, with all residuals behind them, as matrices of their own."""
        kept = np.concatenate([self.index(names), np.array(self.residuals, dtype=np.int64)])
        return GramArrays(
            tuple(self.names[place] for place in kept),
            # Of a form that is searched these are columns of its model, whose rows are asked for anyway.
            self.rows(kept, kept) if self._is_raw else self._kept(kept, kept),
            self.start,
            self.end,
            self.count,
            self.scale[kept],
        )

    def restricted(self, names: Collection[str]) -> Self:
        """Return the calibration's columns, some others and the residuals, in arrays of their own."""
        if self.taken is not None or self.dead is not None:
            raise ValueError("blocks are restricted as they are, not as a calibration leaves them")
        kept = np.array(
            [
                place < self.shared.base or name in names or is_residual(name)
                for name, place in zip(self.names, self.places.tolist(), strict=True)
            ]
        )
        stored = np.sort(self.places[kept])
        return replace(
            self,
            names=tuple(name for name, one in zip(self.names, kept.tolist(), strict=True) if one),
            places=np.searchsorted(stored, self.places[kept]),
            scale=self.scale[kept],
            shared=_Shared(
                self.shared.rest.select(stored),
                np.ascontiguousarray(self.shared.given[..., stored]),
            ),
        )

    def without(self, names: Collection[str]) -> Self:
        """Return the blocks without some columns."""
        kept = np.array([place for place, name in enumerate(self.names) if name not in set(names)])
        return replace(
            self, names=tuple(self.names[i] for i in kept), places=self.places[kept], scale=self.scale[kept]
        )

    def merge(self, edges: Sequence[int]) -> GramArrays:
        """Return wider blocks; see `GramArrays.merge`."""
        return self.select(self.columns).merge(edges)

    def join(self, others: Sequence[FactoredGrams]) -> GramArrays:
        """Return the blocks of several, in order of time."""
        return self.select(self.columns).join([one.select(self.columns) for one in others])

    def combine(self, names: Sequence[str], weights: Floats, scale: Floats) -> GramArrays:
        """Return blocks whose columns and residuals are linear combinations of these."""
        return self.select(self.columns).combine(names, weights, scale)

    def expand(self, functions: Mapping[str, tuple[str, Floats]]) -> Self:
        """Return the blocks with columns added that are others times a function of the block."""
        sources = self.index([column for column, _ in functions.values()])
        factors = np.stack([factor for _, factor in functions.values()], axis=1)
        across = self.rows(np.arange(len(self.names)), sources) * factors[:, None, :]
        inner = self.rows(sources, sources) * factors[:, :, None] * factors[:, None, :]
        given = self.shared.given[..., self.places[sources]] * factors[:, None, None, :]
        return self.bordered(tuple(functions), self.scale[sources], across, inner, given)

    def with_combinations(self, names: Sequence[str], parts: Sequence[tuple[float, Sequence[str]]]) -> Self:
        """Return the blocks with columns added that are sums of weights times columns there are.

        Parameters
        ----------
        names : sequence of str
            Of the new columns.
        parts : sequence of (float, sequence of str)
            A weight, and the columns it multiplies, one for each new one.
        """
        every = np.arange(len(self.names))
        weights = np.zeros((every.size, len(names)))
        for weight, columns in parts:
            weights[self.index(columns), np.arange(len(names))] += weight
        used = np.flatnonzero(weights.any(axis=1))
        across = self.rows(every, used) @ weights[used]
        given = self.shared.given[..., self.places[used]] @ weights[used]
        scale = self.scale[self.index(parts[0][1])]
        return self.bordered(names, scale, across, weights[used].T @ across[:, used], given)

    def bordered(
        self,
        names: Sequence[str],
        scale: Floats,
        across: Floats,
        inner: Floats,
        given: Floats | None = None,
    ) -> Self:
        """Return the blocks with columns added before the residuals; the calibration must not be taken off.

        Parameters
        ----------
        names : sequence of str
        scale : ndarray, shape (new column,)
        across : ndarray, shape (block, column, new column)
            Their products with every column and residual there is.
        inner : ndarray, shape (block, new column, new column)
        given : ndarray, shape (block, fit, base, new column), optional
            Products with the calibration's columns, for each of the fits of a block that has several.
        """
        shared, k = self.shared, self.shared.base
        if self.taken is not None or self.dead is not None:
            raise ValueError("columns join the blocks as they are, not what a calibration leaves")
        if given is None:
            if shared.given.shape[1] > 1:
                raise ValueError("blocks of several fits need the products with the calibration of each")
            at = {place: index for index, place in enumerate(self.places.tolist())}
            given = across[:, None, [at[place] for place in range(k)]]
        fitted = shared.systems.solve(given)
        explained = shared.own @ fitted
        off = _in_one(fitted + shared.systems.solve(given - explained))
        left = np.zeros((len(self), shared.width, len(names)))
        rest = np.empty_like(inner)
        others = self.places >= k
        for block in range(len(self)):
            b, f = given[block].reshape(-1, len(names)), fitted[block].reshape(-1, len(names))
            own = explained[block].reshape(-1, len(names))
            was = shared.given[block][..., self.places[others]].reshape(-1, int(others.sum()))
            left[block, self.places[others]] = across[block, others] - was.T @ off[block]
            cross = f.T @ (b - 0.5 * own)
            rest[block] = inner[block] - cross - cross.T
        gone = np.einsum("bii->i", rest) <= LEAST_KEPT * np.einsum("bii->i", inner)
        for array in (left, rest, rest.swapaxes(1, 2)):
            array[..., gone] = 0.0
        fresh = np.arange(shared.width, shared.width + len(names))
        shared.append(left, rest, given)
        at_end = len(self.names) - len(self.residuals)
        made = replace(
            self,
            names=(*self.names[:at_end], *names, *self.names[at_end:]),
            places=np.insert(self.places, at_end, fresh),
            scale=np.insert(self.scale, at_end, scale),
        )
        if "squares" in vars(self):
            new = np.einsum("bii->ib", inner)
            made.__dict__["squares"] = np.insert(self.squares, [at_end] * len(names), new.T, axis=1)
        return made

    def marginalise(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]] | None = None,
        precision: Floats | None = None,
        dtype: npt.DTypeLike = np.float64,
        *,
        cut: float = SOLVER_SETTINGS.eigen_cut,
        least_kept: float = LEAST_KEPT,
        earlier: Self | None = None,
    ) -> Self:
        """Return what is left of every column after the calibration is fitted anew in each interval.

        Parameters are those of `GramArrays.marginalise`; without `groups` each fit of a block is one
        interval, whose own values nothing is known of beforehand. `dtype` is that of the shared matrix.
        `earlier` is what the same call returned before some columns joined: what it holds is not made again.
        """
        del dtype
        base = self.index(names)
        if set(self.places[base].tolist()) != set(range(self.shared.base)):
            raise ValueError("only the columns of the calibration can be marginalised")
        kept = np.setdiff1d(np.arange(len(self.names)), base)
        small = replace(
            self,
            names=tuple(self.names[place] for place in kept),
            places=self.places[kept],
            scale=self.scale[kept],
            dead=np.zeros(kept.size, dtype=bool),
        )
        if groups is not None:
            order = self.places[base]
            blocks = np.concatenate([np.asarray(group) for group in groups])
            begins = np.cumsum([0, *(len(group) for group in groups)])
            total = np.add.reduceat(self.shared.given[blocks].sum(axis=1), begins[:-1], axis=0)[:, order]
            taken = np.empty((len(groups), self.shared.base, kept.size))
            taken[:, order] = solve_scaled(total[:, :, order], total[:, :, small.places], cut, precision)
            interval = np.empty(len(self), dtype=np.int64)
            interval[blocks] = np.repeat(np.arange(len(groups)), np.diff(begins))
            small = replace(small, taken=taken, interval=interval)
        if earlier is not None:
            small._take_over(earlier)
        whole = self.squares.sum(axis=0)[kept]
        dead = small.squares.sum(axis=0) <= least_kept * whole
        dead[small.residuals] = False
        made = replace(small, dead=dead)
        # What was made to tell which columns are dead holds for the others; those of dead ones are cleared.
        made.__dict__.update({name: value for name, value in vars(small).items() if name in _CARRIED})
        made.__dict__["squares"] = np.where(dead, 0.0, small.squares)
        if "_kept_rows" in vars(made):
            made._kept_rows.clear(np.flatnonzero(dead))
        return made

    def _take_over(self, earlier: Self) -> None:
        """Take what was made of the columns that an earlier form of the same blocks has.

        Only what joined since is made. Nothing is taken where one of its columns was replaced.
        """
        places = {place: at for at, place in enumerate(self.places.tolist())}
        if earlier.shared is not self.shared or not set(earlier.places.tolist()) <= set(places):
            return
        old = np.array([places[place] for place in earlier.places.tolist()], dtype=np.int64)
        new = np.setdiff1d(np.arange(len(self.names)), old)
        made, known = self.__dict__, earlier.__dict__
        squares = np.empty((len(self), len(self.names)))
        squares[:, old], squares[:, new] = earlier.squares, self._squares_of(new)
        made["squares"] = squares
        if "_kept_within" in known:
            pairs = known["_kept_within"].items()
            made["_kept_within"] = {tuple(old[list(key)].tolist()): values for key, values in pairs}
        if "_kept_rows" in known and known["_kept_rows"].places:
            columns = old[list(known["_kept_rows"].places)]
            rows = np.empty((len(self), columns.size, len(self.names)))
            kept = known["_kept_rows"].values[: columns.size]
            rows[:, :, old], rows[:, :, new] = kept.swapaxes(0, 1), self._made_rows(columns, new)
            made["_kept_rows"] = _KeptRows()
            made["_kept_rows"].append(columns.tolist(), rows)


class _KeptRows:
    """Products of some columns with all others, column by column: those of a model grow with it.

    Attributes
    ----------
    places : dict of int to int
        Column -> its place in `values`.
    values : ndarray, shape (row, block, column)
        With room for more rows.
    """

    def __init__(self) -> None:
        self.places: dict[int, int] = {}
        self.values = np.zeros((0, 0, 0))

    def hold(self, columns: Indices) -> bool:
        """Return True when the rows of all of some columns are there."""
        return all(column in self.places for column in columns.tolist())

    def append(self, columns: Sequence[int], rows: Floats) -> None:
        """Add the rows (block, row, column) of some columns."""
        used, count = len(self.places), len(self.places) + len(columns)
        if count > len(self.values):
            wider = np.empty((count + _SPARE_ROWS, rows.shape[0], rows.shape[2]))
            if used:
                wider[:used] = self.values[:used]
            self.values = wider
        self.values[used:count] = rows.swapaxes(0, 1)
        self.places.update(zip(columns, range(used, count), strict=True))

    def clear(self, columns: Indices) -> None:
        """Set the products of some columns to 0."""
        self.values[:, :, columns] = 0.0
        self.values[[self.places[column] for column in columns.tolist() if column in self.places]] = 0.0

    def of(self, columns: Sequence[int], others: Indices | None = None) -> Floats:
        """Return the rows of some columns; (row, block, other). Not a copy where they lie together."""
        at = [self.places[column] for column in columns]
        if others is not None:
            out = np.empty((len(at), self.values.shape[1], others.size))
            for row, place in zip(out, at, strict=True):
                # Places are known to be there; numpy would copy once more to raise where one is not.
                np.take(self.values[place], others, axis=1, out=row, mode="clip")
            return out
        if at == list(range(len(at))):
            return self.values[: len(at)]
        return self.values[at]


#: Rows that may join those that are kept before they are copied.
_SPARE_ROWS = 8
#: Cached properties that do not depend on which columns are dead.
_CARRIED = ("_kept_rows", "_kept_within")
#: Columns from which on whole rows are read and the others left out.
_FEW = 100
#: Columns of groups that are multiplied with each other.
_TOGETHER = 12
#: Rows that are multiplied at a time: what is made of them fits a cache.
_ROWS = 4_320
#: Numbers that are made at once.
_AT_ONCE = 200_000


@lru_cache(maxsize=1)
def _stored_entries(width: int, base: int) -> Indices:
    """Return which entries a store has: the upper triangle row by row, without the calibration's columns."""
    first, second = np.triu_indices(width - base)
    return places_of_entries(first + base, second + base)


def _part_of(array: Floats, blocks: Indices, columns: Indices) -> Floats:
    """Return some columns (the last axis) of some blocks (the first one); of neighbours nothing is copied."""
    if columns.size < _FEW and not are_neighbours(columns):
        return np.asarray(np.moveaxis(array[blocks[:, None], ..., columns], 1, -1))
    some = array[blocks[0] : blocks[-1] + 1] if are_neighbours(blocks) else array[blocks]
    if are_neighbours(columns):
        return some[..., columns[0] : columns[-1] + 1]
    return some.take(columns, axis=-1)


def _half_explained(own: Floats, given: Floats, fit: Floats) -> Floats:
    """Return H, with which a fit explains ``fit' H + H' fit`` of products; (..., base, column)."""
    half = np.asarray(-0.5 * own @ fit)
    half += given
    return half


def _in_one(each: Floats) -> Floats:
    """Return an array (block, fit, base, column) as (block, fit * base, column)."""
    blocks, fits, base, columns = each.shape
    return np.asarray(each.reshape(blocks, fits * base, columns))


def _within(left: Floats, right: Floats, k: int) -> Floats:
    """Return the products of k columns each, that follow each other, with k others; (block, group, k, k).

    Some groups at a time are multiplied with each other, and what lies between two of them is left out: a
    matrix product of a dozen columns takes less time than one of three.
    """
    groups, some = left.shape[2] // k, max(_TOGETHER // k, 1)
    whole = groups - groups % some
    out = np.empty((left.shape[0], groups, k, k))
    for first, last, together in ((0, whole, some), (whole, groups, 1)):
        if last > first:
            shape = (*left.shape[:2], (last - first) // together, together * k)
            one, other = (array[..., first * k : last * k].reshape(shape) for array in (left, right))
            product = one.transpose(0, 2, 3, 1) @ other.transpose(0, 2, 1, 3)
            product = product.reshape(*product.shape[:2], together, k, together, k)
            own = np.einsum("ngiaib->ngiab", product)
            out[:, first:last] = own.reshape(left.shape[0], -1, k, k)
    return out


def _in_parts(blocks: int, size: int) -> Iterator[slice]:
    """Yield the blocks some at a time, so that what is made of them, `size` numbers each, fits into it."""
    count = max(1, _AT_ONCE // max(size, 1))
    return in_turns(slice(0, blocks), count)


def _stored_order(names: Sequence[str], base: Sequence[str]) -> list[str]:
    """Return the calibration's columns, then all others."""
    own = set(base)
    return [*base, *(name for name in names if name not in own)]


def _own_fits(given: Floats) -> Floats:
    """Return each fit of the calibration to every column, 1 for its own; (block, fit, base, column)."""
    k = given.shape[2]
    out = np.asarray(solve_scaled(given[..., :k], given)) if k else np.zeros_like(given)
    out[..., :k] = np.eye(k)
    return out
