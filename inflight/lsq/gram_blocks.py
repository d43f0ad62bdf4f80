"""THE per-block Gram container: select, absorb, expand, border, pack.

One block's sufficient statistics: the Gram matrix of [columns | residuals], raw and prewhitened.

Everything that is said about candidates is computed from these matrices (see `inflight.diagnosis.scoring`);
no sample is read again.

Normal equations of the whole library: Gram matrices of [columns | residuals], one a block.

`Evidence` is to the search what `NormalEquations` is to the calibration: blocks add, columns are
chosen and multiplied by functions of time, and nothing reads the archive again. It holds several
residuals at once (one a noise seed costs nothing) and no scatter, because blocks are many.

Sums over blocks of what functions of time make of their equations, without a matrix for each of them.

Of seventy parameters a few depend on time: only their rows have to be looked at block by block, all others
are in the plain sum. Three thousand days so take milliseconds, and no memory of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.time import GAP, SECOND


def root_weights(weight: Floats) -> Floats:
    """Return the factor of each row, so that every good sample counts once; (time,)."""
    return np.sqrt(np.clip(weight, 0.0, None))


def prewhiten(values: Floats, weight: Floats, stamps: npt.NDArray[np.int64], memory_s: float) -> Floats:
    """Take from every row what the one before it foretells: ``v_t - exp(-dt / memory) v_(t-1)``.

    Parameters
    ----------
    values : ndarray, shape (time, ...)
    weight : ndarray, shape (time,)
        Rows of weight 0, and the first ones after a gap, become 0.
    memory_s : float
        Correlation time that is assumed, seconds.
    """
    step = np.diff(stamps) / SECOND
    usual = float(np.median(step)) if step.size else 1.0
    follows = (step <= GAP * usual) & (weight[1:] > 0) & (weight[:-1] > 0)
    phi = np.where(follows, np.exp(-step / memory_s), 0.0)
    shape = (-1,) + (1,) * (values.ndim - 1)
    out = np.empty_like(values)
    out[0] = 0.0
    np.multiply(values[:-1], -phi.reshape(shape), out=out[1:])
    out[1:] += values[1:]
    out[1:][~follows] = 0.0
    return out


def gram_of(columns: Floats, residuals: Floats, weight: Floats, parts: Sequence[slice]) -> Floats:
    """Return the Gram matrices of consecutive parts of a block; (part, column, column), nT^2.

    Parameters
    ----------
    columns : ndarray, shape (time, row, column)
    residuals : ndarray, shape (time, row, residual)
    weight : ndarray, shape (time,)
    parts : sequence of slice
        Of the time.
    """
    width = columns.shape[-1] + residuals.shape[-1]
    out = np.zeros((len(parts), width, width))
    root = root_weights(weight)[:, None]
    kinds = columns.shape[-1]
    for index, part in enumerate(parts):
        # One run of memory a column, whatever the order the columns come in.
        flat = np.empty((width, *root[part].shape[:1], columns.shape[1]))
        np.multiply(np.moveaxis(columns[part], -1, 0), root[part], out=flat[:kinds])
        np.multiply(np.moveaxis(residuals[part], -1, 0), root[part], out=flat[kinds:])
        flat = flat.reshape(width, -1)
        out[index] = flat @ flat.T
    return out


def pack(gram: Floats) -> Floats:
    """Return the upper triangles of symmetric matrices; (block, entry)."""
    upper = np.triu_indices(gram.shape[-1])
    return np.asarray(gram[:, upper[0], upper[1]])


def unpack(packed: Floats) -> Floats:
    """Return the symmetric matrices of their upper triangles; (block, column, column)."""
    width = int((np.sqrt(8 * packed.shape[1] + 1) - 1) / 2)
    out = np.zeros((packed.shape[0], width, width))
    upper = np.triu_indices(width)
    out[:, upper[0], upper[1]] = packed
    out[:, upper[1], upper[0]] = packed
    return out


def parts_of(stamps: npt.NDArray[np.int64], edges: Sequence[int]) -> list[slice]:
    """Return the rows between consecutive TT2000 edges."""
    places = np.searchsorted(stamps, np.asarray(edges, dtype=np.int64)).tolist()
    return [slice(a, b) for a, b in pairwise(places)]


#: Part of a column that must be left after absorbing the calibration, or rounding is all there is.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Evidence:
    """Sufficient statistics of one form.

    Attributes
    ----------
    names : tuple of str
        Columns, then residuals (``residual``, ``residual~1``, ...).
    gram : ndarray, shape (block, column, column)
        nT^2 in scaled columns.
    start, end : ndarray of int64, shape (block,)
        TT2000.
    count : ndarray, shape (block,)
        Sum of weights: good rows.
    scale : ndarray, shape (column,)
        Physical size of one unit of each column; 1 for residuals.
    """

    names: tuple[str, ...]
    gram: Floats
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    count: Floats
    scale: Floats

    def __len__(self) -> int:
        return len(self.gram)

    @cached_property
    def total(self) -> Floats:
        """Sum over all blocks; (column, column)."""
        return np.asarray(self.gram.sum(axis=0, dtype=np.float64))

    @cached_property
    def _sums(self) -> dict[tuple[tuple[int, ...], ...], list[Floats]]:
        return {}

    def sums(self, folds: Sequence[npt.NDArray[np.int64]]) -> list[Floats]:
        """Return the sum over the blocks of each fold; kept, because every question asks for them."""
        key = tuple(tuple(fold.tolist()) for fold in folds)
        if key not in self._sums:
            self._sums[key] = [np.asarray(self.gram[fold].sum(axis=0, dtype=np.float64)) for fold in folds]
        return self._sums[key]

    @property
    def residuals(self) -> list[int]:
        """Indices of the residual columns."""
        return [index for index, name in enumerate(self.names) if name.split("~")[0] == "residual"]

    def index(self, names: Sequence[str]) -> npt.NDArray[np.int64]:
        """Return the indices of columns by name.

        Raises
        ------
        CalibrationError
            When one is not there.
        """
        places = {name: index for index, name in enumerate(self.names)}
        missing = [name for name in names if name not in places]
        if missing:
            raise CalibrationError(
                f"the library's equations have no column {', '.join(missing[:3])}",
                remedy="run 'inflight diagnose' again: it makes the columns that are missing",
            )
        return np.array([places[name] for name in names], dtype=np.int64)

    def centred(self, columns: npt.NDArray[np.int64], base: npt.NDArray[np.int64]) -> Floats:
        """Return the total Gram matrix of columns, each less what it shares with one column of the base.

        It is an effect's own variance about a constant channel: a temperature of 293 K that moves by one
        kelvin moves by one kelvin.
        """
        total = self.total
        if not base.size:
            return np.asarray(total[np.ix_(columns, columns)])
        size = np.sqrt(np.clip(np.diag(total), 1e-300, None))
        likeness = np.abs(total[np.ix_(columns, base)]) / size[columns][:, None] / size[base][None, :]
        nearest = base[np.argmax(likeness, axis=1)]
        share = total[columns, nearest] / np.clip(total[nearest, nearest], 1e-300, None)
        out = total[np.ix_(columns, columns)] - share[:, None] * total[np.ix_(nearest, columns)]
        out = out - share[None, :] * total[np.ix_(columns, nearest)]
        return np.asarray(out + np.outer(share, share) * total[np.ix_(nearest, nearest)])

    def select(self, names: Sequence[str]) -> Evidence:
        """Return some columns, with all residuals behind them."""
        kept = np.concatenate([self.index(names), np.array(self.residuals, dtype=np.int64)])
        return replace(
            self,
            names=tuple(self.names[index] for index in kept),
            gram=self.gram[:, kept[:, None], kept[None, :]],
            scale=self.scale[kept],
        )

    def expand(self, functions: Mapping[str, tuple[str, Floats]]) -> Evidence:
        """Return the evidence with columns added that are others times a function of the block.

        Parameters
        ----------
        functions : mapping of str to (str, ndarray)
            New name -> (column, factor of each block).
        """
        places = self.index([column for column, _ in functions.values()])
        factors = np.stack([factor for _, factor in functions.values()], axis=1)
        own = len(self.names) - len(self.residuals)
        order = [*range(own), *(own + np.arange(len(functions))), *range(own, len(self.names))]
        origin = np.insert(np.arange(len(self.names)), own, places)
        turn = np.ones((len(self), len(order)))
        turn[:, own : own + len(functions)] = factors
        gram = self.gram[:, origin[:, None], origin[None, :]] * turn[:, :, None] * turn[:, None, :]
        names = list(self.names)
        return replace(
            self,
            names=(*names[:own], *functions, *names[own:]),
            gram=gram,
            scale=self.scale[origin],
        )

    def merged(self, groups: Sequence[Sequence[int]]) -> Evidence:
        """Return wider blocks: each the sum of some consecutive ones."""
        pieces = [np.asarray(group) for group in groups if len(group)]
        return replace(
            self,
            gram=np.stack([self.gram[group].sum(axis=0) for group in pieces]),
            start=np.array([self.start[group[0]] for group in pieces]),
            end=np.array([self.end[group[-1]] for group in pieces]),
            count=np.array([self.count[group].sum() for group in pieces]),
        )

    def joined(self, others: Sequence[Evidence]) -> Evidence:
        """Return the blocks of several, in order of time.

        Raises
        ------
        CalibrationError
            When columns or scales differ, or blocks overlap.
        """
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
        return replace(
            self,
            gram=_in_order([one.gram for one in every], order),
            start=start[order],
            end=end,
            count=np.concatenate([one.count for one in every])[order],
        )

    def absorbed(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]],
        precision: Floats,
        dtype: npt.DTypeLike = np.float64,
    ) -> Evidence:
        """Return what is left of every column after some are fitted anew in each interval.

        Frisch, Waugh and Lovell: the columns that stay, and the residuals, are replaced by their
        parts no combination of the absorbed ones explains within the interval.

        Parameters
        ----------
        names : sequence of str
            Columns to absorb.
        groups : sequence of sequence of int
            Blocks of each interval.
        precision : ndarray, shape (absorbed column,)
            What is known of them beforehand, 1 / sigma^2 in scaled units times the residual's variance.
        dtype : dtype
            Of the result. Single precision holds seven digits of what is left, in half the memory.
        """
        gone = self.index(names)
        kept = np.setdiff1d(np.arange(len(self.names)), gone)
        out = np.empty((len(self), kept.size, kept.size), dtype=dtype)
        before = np.diagonal(self.total)[kept]
        for group in groups:
            total = self.gram[np.ix_(np.asarray(group), gone)].sum(axis=0)
            turn = solve_scaled(total[:, gone] + np.diag(precision), total[:, kept])
            for place in group:
                gram = self.gram[place]
                cross = turn.T @ (gram[np.ix_(gone, kept)] - 0.5 * gram[np.ix_(gone, gone)] @ turn)
                out[place] = gram[np.ix_(kept, kept)] - cross - cross.T
        names_left = tuple(self.names[index] for index in kept)
        dead = np.diagonal(out.sum(axis=0, dtype=np.float64)) <= _ROUNDING * before
        residual = np.array([name.split("~")[0] == "residual" for name in names_left])
        dead &= ~residual
        out[:, dead, :] = 0.0
        out[:, :, dead] = 0.0
        return replace(self, names=names_left, gram=out, scale=self.scale[kept])

    def bordered(self, names: Sequence[str], scale: Floats, across: Floats, inner: Floats) -> Evidence:
        """Return the evidence with columns before its residuals.

        Parameters
        ----------
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
        return replace(
            self,
            names=(*self.names[:own], *names, *self.names[own:]),
            gram=out,
            scale=np.insert(self.scale, own, scale),
        )

    def absorbed_border(
        self,
        names: Sequence[str],
        groups: Sequence[Sequence[int]],
        precision: Floats,
        across: Floats,
        inner: Floats,
    ) -> tuple[Floats, Floats]:
        """Return what `absorbed` leaves of columns that are about to join, as `bordered` takes it.

        Parameters
        ----------
        names, groups, precision
            As of `absorbed`.
        across, inner : ndarray
            Products of the new columns with those there are, and with each other, nothing absorbed.
        """
        gone = self.index(names)
        kept = np.setdiff1d(np.arange(len(self.names)), gone)
        out, own = np.empty((len(self), kept.size, across.shape[2])), np.empty(inner.shape)
        for group in groups:
            place = np.asarray(group)
            of_gone, others = self.gram[np.ix_(place, gone)], across[place]
            total = of_gone.sum(axis=0)
            matrix = total[:, gone] + np.diag(precision)
            turn = solve_scaled(matrix, total[:, kept])
            fresh = solve_scaled(matrix, others[:, gone].sum(axis=0))
            left = others[:, gone] - of_gone[:, :, gone] @ fresh
            out[place] = others[:, kept] - turn.T @ left - of_gone[:, :, kept].transpose(0, 2, 1) @ fresh
            shared = fresh.T @ (others[:, gone] - 0.5 * of_gone[:, :, gone] @ fresh)
            own[place] = inner[place] - shared - shared.transpose(0, 2, 1)
        before = np.diagonal(inner.sum(axis=0))
        dead = np.diagonal(own.sum(axis=0)) <= _ROUNDING * before
        out[:, :, dead] = 0.0
        own[:, dead, :] = 0.0
        own[:, :, dead] = 0.0
        return out, own

    def as_dataset(self) -> xr.Dataset:
        """Return the blocks as a Dataset for a store: packed upper triangles."""
        return xr.Dataset(
            {
                "gram": (("block", "entry"), pack(self.gram), {"units": "nT2"}),
                "start": ("block", self.start, {"units": "ns", "scale": "TT2000"}),
                "end": ("block", self.end, {"units": "ns", "scale": "TT2000"}),
                "count": ("block", self.count),
            }
        )

    @classmethod
    def of(cls, dataset: xr.Dataset, names: Sequence[str], scale: Floats, variable: str = "gram") -> Evidence:
        """Return the evidence a Dataset of `as_dataset` holds."""
        return cls(
            tuple(names),
            unpack(dataset[variable].values),
            dataset["start"].values,
            dataset["end"].values,
            dataset["count"].values,
            scale,
        )


def _in_order(pieces: Sequence[Floats], order: npt.NDArray[np.int64]) -> Floats:
    """Return the pieces as one array in an order; of gigabytes only one copy is made."""
    place = np.argsort(order, kind="stable")
    out = np.empty((order.size, *pieces[0].shape[1:]))
    at = 0
    for piece in pieces:
        out[place[at : at + len(piece)]] = piece
        at += len(piece)
    return out


def solve_scaled(matrix: Floats, right: Floats, least: float = 1e-12) -> Floats:
    """Solve a symmetric system in units of its own diagonal; what it does not determine stays 0.

    Parameters
    ----------
    matrix : ndarray, shape (n, n)
    right : ndarray, shape (n,) or (n, m)
    least : float
        Eigenvalues of the unit-diagonal matrix below it are no information.
    """
    size = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    own, vectors = np.linalg.eigh(matrix * unit[:, None] * unit[None, :])
    inverse = np.where(own > least, 1.0 / np.where(own > least, own, 1.0), 0.0)
    scaled = right * (unit[:, None] if right.ndim == 2 else unit)
    found = vectors @ ((vectors.T @ scaled) * (inverse[:, None] if right.ndim == 2 else inverse))
    return np.asarray(found * (unit[:, None] if right.ndim == 2 else unit))


Owners = npt.NDArray[np.int64]


@dataclass(frozen=True)
class BlockSums:
    """Gram matrices of blocks and how much each block says.

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
            What the owner's column is multiplied with.
        owners : ndarray of int, shape (function,)
            Column of the matrices each function belongs to.

        Returns
        -------
        ndarray, shape (function + 1, function + 1)
            The residual last.
        """
        every = np.append(owners, self.plain.shape[0] - 1)
        still = np.append(values[0], 1.0)
        out = self.plain[np.ix_(every, every)] * np.outer(still, still)
        moving = np.flatnonzero(np.ptp(values, axis=0) > 0)
        heavy = self.weight[:, None] * values
        for owner in np.unique(owners[moving]):
            mine = moving[owners[moving] == owner]
            row = heavy[:, mine].T @ self.gram[:, owner, :]
            out[mine, :] = row[:, every] * still
            out[:, mine] = out[mine, :].T
        for one in np.unique(owners[moving]):
            for other in np.unique(owners[moving]):
                mine, theirs = (moving[owners[moving] == owner] for owner in (one, other))
                own = self.gram[:, one, other, None] * values[:, theirs]
                out[np.ix_(mine, theirs)] = heavy[:, mine].T @ own
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
        turned = np.concatenate([parameters, np.ones((len(parameters), 1))], axis=1)
        slopes = np.matmul(self.gram, turned[:, :, None])[:, :, 0]
        return np.asarray(self.weight[:, None] * slopes[:, owners] * values)
