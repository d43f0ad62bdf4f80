"""Columns times functions of the block, as a calibration leaves them: only the products that scores ask for.

A change in time is a column of a library times a function of the block. There are hundreds of them, and none
is compared with another: what is asked for are its products with the model's columns and with the residual,
and those of its own few columns with each other. With A = X'X and B = X'Z the calibration's products in a
block, f the function, and G the fit of an interval's calibration to f Z,

    (f Z - X G)'(Y - X H)      =  f (Z'Y - B'H) - G'(X'Y - A H),
    (f Z - X G)'(f Z - X G)    =  f f Z'Z - G'(f B - A G / 2) - (f B - A G / 2)'G,

H being the fit to a column Y of the model. No Gram matrix of all of them is made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq.gram_blocks import LEAST_KEPT, GramArrays, is_residual, places_of
from inflight.lsq.solver import Indices, solve_scaled


class CalibratedBlocks:
    """Gram blocks with the fit of a calibration in each interval, that columns times functions start from.

    Parameters
    ----------
    grams : GramArrays
        The calibration's columns, the model's, those that functions multiply, and the residuals.
    base : sequence of str
        The calibration's columns.
    groups : sequence of sequence of int
        Blocks of each interval, consecutive.
    precision : ndarray, shape (base,)
        As of `GramArrays.marginalise`.
    """

    def __init__(
        self, grams: GramArrays, base: Sequence[str], groups: Sequence[Sequence[int]], precision: Floats
    ) -> None:
        self.grams, self.base = grams, grams.index(base)
        self.begins = np.array([group[0] for group in groups], dtype=np.int64)
        self.interval = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
        #: Products of the calibration's columns with each other and with all; (block, base, ...).
        self.own, self.given = grams.rows(self.base, self.base), grams.rows(self.base)
        total = np.add.reduceat(self.own, self.begins, axis=0)
        unit = np.broadcast_to(np.eye(self.base.size), total.shape)
        self._inverse = solve_scaled(total, unit, precision=precision) if self.base.size else total

    def fit(self, products: Floats) -> Floats:
        """Return the fit of each block's interval to columns, from the products (block, base, column)."""
        each = self._inverse @ np.add.reduceat(products, self.begins, axis=0)
        return np.asarray(each[self.interval])

    @cached_property
    def fitted(self) -> Floats:
        """Fit to all columns; (block, base, column)."""
        return self.fit(self.given)

    @cached_property
    def missed(self) -> Floats:
        """What the calibration's columns have in common with what it leaves of all; (block, base, column)."""
        return np.asarray(self.given - self.own @ self.fitted)

    def rows(self, columns: Indices) -> Floats:
        """Return the products of what is left of some columns with all as they are; (row, block, column)."""
        key = tuple(columns.tolist())
        if key not in self._rows:
            fitted = self.fitted[:, :, columns].swapaxes(1, 2)
            made = self.grams.rows(columns) - fitted @ self.given
            self._rows[key] = np.ascontiguousarray(made.swapaxes(0, 1))
        return self._rows[key]

    @cached_property
    def _rows(self) -> dict[tuple[int, ...], Floats]:
        """Rows of the model: all that change ask for the same ones."""
        return {}

    def among(self, columns: Indices, others: Indices) -> Floats:
        """Return the products of what is left of some columns and of others; (row, block, other)."""
        key = (tuple(columns.tolist()), tuple(others.tolist()))
        if key not in self._among:
            given = self.rows(columns).take(others, axis=2)
            self._among[key] = self.less_fit(given, columns, self.fitted[:, :, others])
        return self._among[key]

    @cached_property
    def _among(self) -> dict[tuple[tuple[int, ...], tuple[int, ...]], Floats]:
        """The same of the model's columns among themselves."""
        return {}

    def less_fit(self, rows: Floats, columns: Indices, fitted: Floats) -> Floats:
        """Take the calibration's fit to others (block, base, other) off products with `columns`, in place."""
        rows -= (self.missed[:, :, columns].swapaxes(1, 2) @ fitted).swapaxes(0, 1)
        return rows


@dataclass(frozen=True, eq=False)
class TimedGrams:
    """Gram blocks of a model's columns, of columns times functions of the block, and of the residuals.

    Attributes
    ----------
    blocks : CalibratedBlocks
    names : tuple of str
        Columns of the model, then functions, then residuals.
    places : ndarray of int, shape (column,)
        Column of `blocks` that each is, or is a function of.
    factor : ndarray, shape (block, function)
    """

    blocks: CalibratedBlocks
    names: tuple[str, ...]
    places: Indices
    factor: Floats

    @classmethod
    def of(
        cls, blocks: CalibratedBlocks, model: Sequence[str], functions: Mapping[str, tuple[str, Floats]]
    ) -> TimedGrams:
        """Return the blocks of a model and of functions: new name -> (column, factor of each block)."""
        residuals = [blocks.grams.names[place] for place in blocks.grams.residuals]
        sources = [*model, *(column for column, _ in functions.values()), *residuals]
        factor = np.stack([values for _, values in functions.values()], axis=1)
        return cls(blocks, (*model, *functions, *residuals), blocks.grams.index(sources), factor)

    def __len__(self) -> int:
        return len(self.blocks.grams)

    @property
    def scale(self) -> Floats:
        """Physical size of one unit of each column; (column,)."""
        return self.blocks.grams.scale[self.places]

    @property
    def start(self) -> npt.NDArray[np.int64]:
        """First instant of each block, TT2000; (block,)."""
        return self.blocks.grams.start

    @cached_property
    def residuals(self) -> list[int]:
        """Places of the residuals."""
        return [place for place, name in enumerate(self.names) if is_residual(name)]

    @cached_property
    def _by_name(self) -> dict[str, int]:
        return {name: place for place, name in enumerate(self.names)}

    def index(self, names: Sequence[str]) -> Indices:
        """Return the places of columns by name; `CalibrationError` when one is not there."""
        return places_of(names, self._by_name)

    @property
    def _functions(self) -> slice:
        last = len(self.names) - len(self.residuals)
        return slice(last - self.factor.shape[1], last)

    @cached_property
    def _given(self) -> Floats:
        """Products of the calibration's columns with the functions' columns; (block, base, function)."""
        return self.blocks.given[:, :, self.places[self._functions]] * self.factor[:, None, :]

    @cached_property
    def _fitted(self) -> Floats:
        """Fit of the calibration to the functions' columns; (block, base, function)."""
        return self.blocks.fit(self._given)

    def rows(self, columns: Indices, others: Indices | None = None) -> Floats:
        """Return the products of columns of the model, or residuals, with others; (block, column, other).

        Raises
        ------
        ValueError
            When one of `columns` is a function: what two of them have in common is not made.
        """
        key = tuple(columns.tolist())
        if key not in self._known:
            self._known[key] = self._made_rows(columns)
        out = self._known[key]
        return np.asarray((out if others is None else out[:, :, others]).swapaxes(0, 1))

    @cached_property
    def _known(self) -> dict[tuple[int, ...], Floats]:
        """What scores and sign flips ask for, one after the other; (row, block, other)."""
        return {}

    def _made_rows(self, columns: Indices) -> Floats:
        functions, at = self._functions, self.places[columns]
        if np.any((columns >= functions.start) & (columns < functions.stop)):
            raise ValueError("products of functions with each other are those within a group")
        blocks, rest = self.blocks, np.r_[: functions.start, functions.stop : len(self.names)]
        given, same = blocks.rows(at), self.places[rest]
        out = np.empty((*given.shape[:2], len(self.names)))
        changing = given.take(self.places[functions], axis=2)
        changing *= self.factor
        out[:, :, functions] = blocks.less_fit(changing, at, self._fitted)
        # The model's columns among the others have lost their calibration, too.
        out[:, :, rest] = blocks.among(at, same)
        dead = self._dead
        out[:, :, dead] = 0.0
        out[dead[columns]] = 0.0
        return np.asarray(out)

    def products_within(self, groups: Indices) -> Floats:
        """Return the products of the functions of each group with each other; (block, group, k, k)."""
        out = self._products_within(groups - self._functions.start)
        dead = self._dead[groups]
        out *= ~(dead[:, :, None] | dead[:, None, :])
        return out

    def _products_within(self, groups: Indices) -> Floats:
        """The same of groups of functions, counted from the first; rounding is not yet 0."""
        at = self.places[self._functions][groups]
        out = self.blocks.grams.products_within(at)
        factor = self.factor[:, groups]
        out *= factor[..., :, None] * factor[..., None, :]
        half = self._given - 0.5 * self.blocks.own @ self._fitted
        first, second = (np.moveaxis(one[:, :, groups], 1, -1) for one in (self._fitted, half))
        cross = first @ second.swapaxes(-1, -2)
        out -= cross + cross.swapaxes(-1, -2)
        return np.asarray(out)

    @cached_property
    def _dead(self) -> npt.NDArray[np.bool_]:
        """Columns of which the calibration leaves nothing but rounding; (column,)."""
        functions = self._functions
        every = np.arange(self.factor.shape[1])[:, None]
        whole = np.einsum("bii->bi", self.blocks.grams.gram)[:, self.places]
        cross = 2.0 * self.blocks.given - self.blocks.own @ self.blocks.fitted
        left = whole - np.sum(self.blocks.fitted * cross, axis=1)[:, self.places]
        left[:, functions] = self._products_within(every)[:, :, 0, 0]
        whole[:, functions] *= self.factor**2
        dead = left.sum(axis=0) <= LEAST_KEPT * whole.sum(axis=0)
        dead[self.residuals] = False
        return np.asarray(dead)

    def is_live(self, columns: Indices) -> npt.NDArray[np.bool_]:
        """Return of which columns the calibration leaves more than rounding; (column,)."""
        return np.asarray(~self._dead[columns])
