"""Scores of candidates on one form of the Gram blocks: held-out loss, in-sample fit, sign-flip p-values.

Takes Gram blocks with the calibration marginalised, the columns the model holds already and those of the
candidates; makes `Scores` (`score`) and p-values (`sign_flip_ratios`, `family_wise_p`). Candidates are scored
after the model's columns are projected out (Frisch, Waugh, Lovell), all at once, grouped by their number of
columns.

Significance: under the null hypothesis the score statistics of a block could as well have the other sign. The
family-wise p-value of a candidate is the part of sign flips in which *any* candidate reaches its ratio of the
statistic to its mean over the flips (Westfall and Young's maximum).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import BlockProducts, GramBlocks, expected_gain_t, hac_t, inverse_square_root, solve_scaled

Index = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class ScoringSettings:
    """Numbers of the scores.

    Attributes
    ----------
    quiet : float
        A block in which less than this part of a column's largest block is left has no information on it;
        assumed.
    folds : int
        Folds of the cross-validation at most (MISSING_EFFECT 2.3: 13).
    units : int
        Independent spans whose signs are flipped, at most: a bound on time, assumed.
    """

    quiet: float = 1e-2
    folds: int = 13
    units: int = 120


SCORING_SETTINGS = ScoringSettings()


@dataclass(frozen=True)
class ModelColumns:
    """Columns the model holds already, and what is known of them beforehand.

    Attributes
    ----------
    columns : ndarray of int
    precision : ndarray, shape (column,)
        `variance` over squared prior sigma, scaled; 0 without a prior.
    variance : float
        Of a row, nT^2; errors of fits count that of what is known with it.
    """

    columns: Index
    precision: Floats
    variance: float = 0.0

    def solve(self, rows: Floats) -> Floats:
        """Return the projection of all columns on those of the model; (..., present, column).

        Parameters
        ----------
        rows : ndarray, shape (..., present, column)
            Products of the model's columns with all columns.
        """
        if not self.columns.size:
            return np.zeros(rows.shape)
        return solve_scaled(rows[..., self.columns] + np.diag(self.precision), rows)


@dataclass(frozen=True)
class Fits:
    """Fits to all folds but one, kept so that two candidates can be compared block by block.

    Attributes
    ----------
    grams : BlockProducts
    present : ndarray of int
        Columns of the model.
    candidates : sequence of ndarray of int
        Columns of each candidate.
    fold : ndarray of int, shape (block,)
        Fold that each block is held out in.
    own : ndarray, shape (fold, present, column)
        Projection of all columns on those of the model, in the other folds.
    values : list of ndarray, shape (fold, k)
        Of each candidate, fitted to the other folds.
    squares : ndarray, shape (block, candidate)
        Of each candidate's contribution, nT^2.
    """

    grams: BlockProducts
    present: Index
    candidates: Sequence[Index]
    fold: Index
    own: Floats
    values: list[Floats]
    squares: Floats

    def squared_differences(self, places: Sequence[int], other: int) -> Floats | None:
        """Return sums of squares between candidates' contributions and another's; (block, place).

        When one of the two is the truth, it is what each block is expected to prefer it by. None when one of
        them is not here.
        """
        if max(*places, other) >= len(self.candidates):
            return None
        columns = np.concatenate([self.candidates[place] for place in places])
        second, known = self.candidates[other], self.values[other][self.fold]
        # By how much the model's own columns give way to the other candidate; (present, block).
        change = -np.einsum("fpk,fk->pf", self.own[:, :, second], self.values[other])[:, self.fold]
        shared = np.matmul(known[:, None, :], self.grams.rows(second, columns))[:, 0]
        if self.present.size:
            every = np.concatenate([second, self.present, columns])
            rows = self.grams.rows(self.present, every).transpose(1, 0, 2)
            wide, model, tried = np.split(rows, np.cumsum([second.size, self.present.size]), axis=2)
            # Products of its contribution with the columns of the model, and with those of the candidates,
            # the model projected out of them.
            given = np.sum(wide * known, axis=2) + np.einsum("pbq,qb->pb", model, change)
            shared += np.einsum("pbc,pb->bc", tried, change)
            for fold, own in enumerate(self.own[:, :, columns]):
                held = self.fold == fold
                shared[held] -= given[:, held].T @ own
        values = np.concatenate([self.values[place] for place in places], axis=1)[self.fold]
        begins = np.cumsum([0, *(len(self.candidates[place]) for place in places[:-1])])
        mixed = np.add.reduceat(shared * values, begins, axis=1)
        return np.asarray(np.maximum(self.squares[:, places] + self.squares[:, [other]] - 2.0 * mixed, 0.0))


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Scores of candidates on one form.

    Attributes
    ----------
    loss0 : ndarray, shape (block,)
        Held-out sum of squares without any candidate, nT^2.
    loss : ndarray, shape (block, candidate)
        Held-out sum of squares with each.
    gain, t : ndarray, shape (candidate,)
        Part of the held-out loss it removes, and the mean of its block gains over their error.
    gamma : list of ndarray
        In-sample values, scaled.
    explained : ndarray, shape (candidate,)
        In-sample sum of squares explained, nT^2.
    expected : ndarray, shape (block, candidate)
        Expected gain of each block if the effect fitted to the other folds were true, nT^2.
    active : ndarray of bool, shape (block, candidate)
        Blocks in which the calibration leaves anything of it.
    fits : Fits, optional
        Fits to the other folds, by which two candidates are compared.
    """

    loss0: Floats
    loss: Floats
    gain: Floats
    t: Floats
    gamma: list[Floats]
    explained: Floats
    expected: Floats
    active: npt.NDArray[np.bool_]
    fits: Fits | None

    def t_worse_than(self, one: int, other: int) -> float:
        """Return the t by which one candidate leaves more than another, in blocks active for either."""
        if one == other:
            return 0.0
        difference = self.loss[:, [one]] - self.loss[:, [other]]
        active = self.active[:, [one]] | self.active[:, [other]]
        apart = self.fits.squared_differences([one], other) if self.fits is not None else None
        if apart is None:
            return float(hac_t(difference, active)[0])
        return float(expected_gain_t(difference, apart, active)[0])

    def t_over_placebo(
        self, placebos: Sequence[int], pairwise: npt.NDArray[np.bool_], rival_t: float
    ) -> Floats:
        """Return by which t each candidate leaves less than the best placebo; inf when there is none.

        Parameters
        ----------
        placebos : sequence of int
        pairwise : ndarray of bool, shape (candidate,)
            Candidates that are compared with the placebo one by one, whatever the two have in common.
        rival_t : float
            See `_t_over_similar`.
        """
        if not placebos:
            return np.full(self.gain.size, np.inf)
        best = placebos[int(np.argmin(self.loss[:, placebos].sum(axis=0)))]
        if self.gain[best] <= 0:
            return self.t
        # Most have nothing in common with a placebo: their squared difference is the sum of both squares.
        apart = self.expected + self.expected[:, [best]]
        out = expected_gain_t(self.loss[:, [best]] - self.loss, apart, self.active)
        close = np.flatnonzero(pairwise & (self.gain > self.gain[best]))
        fitted = close[close < (len(self.fits.candidates) if self.fits is not None else 0)]
        near = np.zeros(out.size)
        if fitted.size:
            near[fitted] = self._t_over_similar(fitted, best, rival_t)
        out[close] = np.maximum(out[close], near[close])
        return out

    def _t_over_similar(self, places: Index, placebo: int, rival_t: float) -> Floats:
        """Return the t by which candidates leave less than a placebo much like them; 0 when in doubt.

        A channel that repeats every orbit is much like itself a day before. Were the candidate the truth, it
        would leave less by the square of the difference of the two contributions, block by block. Where it
        gains clearly less than that (`rival_t`), the placebo explains something that the candidate does not,
        and neither is the truth.
        """
        apart = self.fits.squared_differences(places.tolist(), placebo) if self.fits is not None else None
        if apart is None:
            return np.zeros(places.size)
        gained = self.loss[:, [placebo]] - self.loss[:, places]
        t = expected_gain_t(gained, apart, self.active[:, places])
        return np.where(t * (apart.sum(axis=0) / gained.sum(axis=0) - 1.0) < rival_t, t, 0.0)

    def without_fits(self) -> Scores:
        """Return the scores without the fits; candidates are then compared by `hac_t` alone."""
        return replace(self, fits=None)

    def rescaled(self, whole: float) -> Scores:
        """Return the scores in units in which the held-out loss without a candidate is `whole`, nT^2."""
        own = float(self.loss0.sum())
        unit = whole / own if own > 0 else 1.0
        return replace(
            self, loss0=self.loss0 * unit, loss=self.loss * unit, expected=self.expected * unit, fits=None
        )

    def keep_only(self, kept: npt.NDArray[np.bool_]) -> Scores:
        """Return the scores with nothing gained by the candidates that are not kept."""
        return replace(
            self,
            loss=np.where(kept, self.loss, self.loss0[:, None]),
            gain=self.gain * kept,
            t=self.t * kept,
            explained=self.explained * kept,
            expected=self.expected * kept,
        )

    def extended(self, found: Scores, seen: bool) -> Scores:
        """Return these scores followed by those of further candidates; zero when this form does not see them.

        Their folds may be others: their gain refers to the same loss as that of all candidates.
        """

        def more(values: Floats) -> Floats:
            return values if seen else np.zeros_like(values)

        gained = more(found.loss0[:, None] - found.loss)
        return Scores(
            loss0=self.loss0,
            loss=np.concatenate([self.loss, self.loss0[:, None] - gained], axis=1),
            gain=np.concatenate([self.gain, more(found.gain)]),
            t=np.concatenate([self.t, more(found.t)]),
            gamma=[*self.gamma, *found.gamma],
            explained=np.concatenate([self.explained, more(found.explained)]),
            expected=np.concatenate([self.expected, more(found.expected)], axis=1),
            active=np.concatenate([self.active, found.active], axis=1),
            fits=self.fits,
        )


def append_changes(
    scores: Mapping[str, Scores],
    ratios: Mapping[str, tuple[Floats, Floats]],
    timed: Sequence[tuple[Scores, tuple[Floats, Floats]]],
) -> tuple[dict[str, Scores], dict[str, tuple[Floats, Floats]]]:
    """Return the scores followed by those of changes; only the raw form can see most of them."""
    out, out_ratios = {}, {}
    for form, one in scores.items():
        seen = form == "raw"
        for found, _ in timed:
            one = one.extended(found, seen)  # noqa: PLW2901 (one form's scores grow)
        own = [(observed * seen, flipped * seen) for _, (observed, flipped) in timed]
        out[form] = one
        out_ratios[form] = (
            np.concatenate([ratios[form][0], *(observed for observed, _ in own)]),
            np.concatenate([ratios[form][1], *(flipped for _, flipped in own)], axis=1),
        )
    return out, out_ratios


def make_folds(blocks: int, interleaved: bool = False, most: int = SCORING_SETTINGS.folds) -> list[Index]:
    """Return the blocks of each fold: contiguous runs, or every k-th for effects bound to a time."""
    count = max(2, min(most, blocks))
    if interleaved:
        return [np.arange(fold, blocks, count) for fold in range(min(count, blocks))]
    return [part for part in np.array_split(np.arange(blocks), count) if part.size]


def active_blocks(grams: GramBlocks, candidates: Sequence[Index]) -> npt.NDArray[np.bool_]:
    """Return in which blocks the calibration leaves anything of each candidate; (block, candidate)."""
    lively = _is_active(grams.squares)
    return (
        np.stack([lively[:, columns].any(axis=1) for columns in candidates], axis=1)
        if candidates
        else lively[:, :0]
    )


def _is_active(squares: Floats) -> npt.NDArray[np.bool_]:
    """Return in which blocks anything is left of columns, by their sums of squares (block, ...)."""
    return np.asarray(squares > SCORING_SETTINGS.quiet * np.maximum(squares.max(axis=0), 1e-300))


def group_by_size(candidates: Sequence[Index]) -> list[tuple[Index, Index]]:
    """Return (positions, columns (candidate, k)) of candidates with the same number of columns."""
    sizes = np.array([len(one) for one in candidates])
    out = []
    for size in np.unique(sizes):
        positions = np.flatnonzero(sizes == size)
        out.append((positions, np.stack([candidates[int(place)] for place in positions])))
    return out


def project_out(gram: Floats, present: ModelColumns) -> Floats:
    """Return the Gram matrix of what the model's columns leave of all others."""
    if not present.columns.size:
        return gram
    return np.asarray(gram - gram[:, present.columns] @ present.solve(gram[present.columns]))


def project_out_of(grams: BlockProducts, present: ModelColumns, columns: Index) -> Floats:
    """Return the Gram matrix over all blocks of what the model's columns leave of some others."""
    p = present.columns
    places = np.concatenate([p, columns])
    total = grams.rows(places, places).sum(axis=0)
    own = ModelColumns(np.arange(p.size), present.precision)
    return project_out(total, own)[p.size :, p.size :]


def _rows_of(grams: BlockProducts, columns: Index) -> Floats:
    """Return the products of some columns with all; (row, block, column)."""
    return np.ascontiguousarray(grams.rows(columns).transpose(1, 0, 2))


def _with_residual(present: ModelColumns, y: int) -> Index:
    """Return the places of the residual, then of the model's columns."""
    return np.concatenate([np.array([y], dtype=np.int64), present.columns])


def _left_weights(own: Floats, y: int) -> Floats:
    """Return by what the residual and the model's columns are weighted in what the model leaves of it.

    `own` (..., present, column) is the projection on the model's columns; weights (..., 1 + present).
    """
    return np.concatenate([np.ones((*own.shape[:-2], 1)), -own[..., y]], axis=-1)


def _projected(rows: Floats, own: Floats, inner: Floats, columns: Index, y: int) -> tuple[Floats, Floats]:
    """Return what the model leaves of candidates; products with each other and with the residual.

    Parameters
    ----------
    rows : ndarray, shape (..., 1 + present, column)
        Of the residual, then of the model's columns.
    own : ndarray, shape (..., present, column)
        Projection on the model's columns.
    inner : ndarray, shape (..., candidate, k, k)
        Products of each candidate's columns.
    columns : ndarray of int, shape (candidate, k)

    Returns
    -------
    (ndarray, ndarray)
        Shapes (..., candidate, k, k) and (..., candidate, k).
    """
    right = rows[..., 0, columns]
    if not own.shape[-2]:
        return inner, right
    across, given = np.moveaxis(rows[..., 1:, columns], -3, -1), np.moveaxis(own[..., columns], -3, -2)
    return inner - across @ given, right - np.matmul(across, own[..., None, :, y, None])[..., 0]


def remaining_of(
    grams: BlockProducts, present: ModelColumns, candidates: Sequence[Index], y: int
) -> list[tuple[Floats, Floats]]:
    """Return what the model leaves of each candidate: products (k, k), and with the residual (k,)."""
    rows = _rows_of(grams, _with_residual(present, y)).sum(axis=1)
    own = present.solve(rows[1:])
    found: list[tuple[Floats, Floats]] = [(np.empty(0), np.empty(0))] * len(candidates)
    for positions, columns in group_by_size(candidates):
        inner = grams.products_within(columns).sum(axis=0)
        for place, *one in zip(positions, *_projected(rows, own, inner, columns, y), strict=True):
            found[place] = (one[0], one[1])
    return found


def _best_values(inner: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Return the values (..., candidate, k) that leave least, and the sums they explain (..., candidate)."""
    half = inverse_square_root(inner)
    score = np.matmul(half.swapaxes(-1, -2), right[..., None])
    return -np.matmul(half, score)[..., 0], np.sum(score[..., 0] ** 2, axis=-1)


def fit(
    grams: BlockProducts, present: ModelColumns, candidates: Sequence[Index], y: int
) -> tuple[list[Floats], Floats]:
    """Return in-sample values (scaled) and explained sums of squares of every candidate."""
    found = [_best_values(*one) for one in remaining_of(grams, present, candidates, y)]
    return [one[0] for one in found], np.array([float(one[1]) for one in found])


def score(
    grams: BlockProducts, present: ModelColumns, candidates: Sequence[Index], y: int, folds: Sequence[Index]
) -> Scores:
    """Score candidates by cross-validation over blocks.

    Parameters
    ----------
    grams : BlockProducts
        One form, the calibration marginalised.
    present : ModelColumns
        The model's columns.
    candidates : sequence of ndarray
        Columns of each.
    y : int
        Index of the residual.
    folds : sequence of ndarray
        Blocks held out together.
    """
    parts = [_as_slice(fold) for fold in folds]
    rows = _rows_of(grams, _with_residual(present, y))
    # Every fold's training blocks, then all blocks: (fold + 1, 1 + present, column).
    train = _left_out([rows[:, part].sum(axis=1) for part in parts])
    own = present.solve(train[:, 1:])
    weights = _left_weights(own, y)
    shape = len(grams), len(candidates)
    change, square = np.zeros((2, *shape))
    active, loss0 = np.zeros(shape, dtype=bool), np.zeros(len(grams))
    gamma: list[Floats] = [np.empty(0)] * len(candidates)
    explained = np.zeros(len(candidates))
    groups = []
    for positions, columns in group_by_size(candidates):
        inner = grams.products_within(columns)
        active[:, positions] = _is_active(np.einsum("bcii->bci", inner)).any(axis=2)
        summed = _left_out([inner[part].sum(axis=0) for part in parts])
        values, sums = _best_values(*_projected(train, own, summed, columns, y))
        explained[positions] = sums[-1]
        for place, value in zip(positions, values.swapaxes(0, 1), strict=True):
            gamma[place] = value
        groups.append(
            _Group(positions, columns, inner, values, -np.einsum("fpck,fck->fpc", own[:, :, columns], values))
        )
    for fold, part in enumerate(parts):
        block = rows[:, part]
        # What the model, fitted elsewhere, leaves of the residual: its products with all columns.
        left = np.matmul(weights[fold], block.swapaxes(0, 1))
        loss0[part] = left[:, y] + left[:, present.columns] @ weights[fold, 1:]
        left -= left[:, present.columns] @ own[fold]
        for group in groups:
            change[part, group.positions], square[part, group.positions] = group.loss_change(
                fold, block[1:], left, group.inner[part], present.columns
            )
    loss = loss0[:, None] + change
    whole = float(loss0.sum())
    at = np.empty(len(grams), dtype=np.int64)
    for fold, part in enumerate(parts):
        at[part] = fold
    return Scores(
        loss0=loss0,
        loss=loss,
        gain=1.0 - loss.sum(axis=0) / whole if whole > 0 else np.zeros(len(candidates)),
        t=expected_gain_t(loss0[:, None] - loss, square, active),
        gamma=[one[-1] for one in gamma],
        explained=explained,
        expected=square,
        active=active,
        fits=Fits(
            grams, present.columns, list(candidates), at, own[:-1], [one[:-1] for one in gamma], square
        ),
    )


def _as_slice(fold: Index) -> slice | Index:
    """Return the blocks of a fold as a slice when they are evenly spaced: it copies nothing."""
    step = int(fold[1] - fold[0]) if len(fold) > 1 else 1
    if step > 0 and np.all(np.diff(fold) == step):
        return slice(int(fold[0]), int(fold[-1]) + 1, step)
    return fold


def _left_out(sums: Sequence[Floats]) -> Floats:
    """Return of sums over folds the sums over all other folds, then over all; (fold + 1, ...)."""
    held = np.stack([*sums, np.zeros_like(sums[0])])
    return np.asarray(held.sum(axis=0) - held)


@dataclass(frozen=True)
class _Group:
    """Candidates with the same number of columns, fitted to all folds but one.

    Attributes
    ----------
    positions : ndarray of int, shape (candidate,)
    columns : ndarray of int, shape (candidate, k)
    inner : ndarray, shape (block, candidate, k, k)
        Products of each candidate's columns.
    values : ndarray, shape (fold, candidate, k)
    model : ndarray, shape (fold, present, candidate)
        By how much the model's own columns give way.
    """

    positions: Index
    columns: Index
    inner: Floats
    values: Floats
    model: Floats

    def loss_change(
        self, fold: int, rows: Floats, left: Floats, inner: Floats, present: Index
    ) -> tuple[Floats, Floats]:
        """Return by how much candidates change the held-out square, and their own; (block, candidate).

        Parameters
        ----------
        rows : ndarray, shape (present, block, column)
            Products of the model's columns in the blocks held out.
        left : ndarray, shape (block, column)
            What columns, the model projected out of them, have in common with what it leaves of the residual.
        inner : ndarray, shape (block, candidate, k, k)
        """
        values, model = self.values[fold], self.model[fold]
        linear = np.einsum("bck,ck->bc", left[:, self.columns], values)
        square = np.einsum("bckl,ck,cl->bc", inner, values, values)
        if present.size:
            # Its columns last but one: sums run along the candidates.
            across = np.einsum("pbkc,kc->pbc", rows[:, :, self.columns.T], 2.0 * values.T)
            across += (rows[:, :, present].reshape(-1, present.size) @ model).reshape(across.shape)
            square += np.einsum("pbc,pc->bc", across, model)
        return np.asarray(2.0 * linear + square), square


def block_scores(grams: BlockProducts, present: ModelColumns, y: int) -> Floats:
    """Return the score statistics of every column at the model's own fit, block by block; (block, column).

    They sum to what the projected columns have in common with the residual.
    """
    rows = _rows_of(grams, _with_residual(present, y))
    return _block_scores(rows, present.solve(rows[1:].sum(axis=1)), present, y)


def _block_scores(rows: Floats, own: Floats, present: ModelColumns, y: int) -> Floats:
    left = np.tensordot(_left_weights(own, y), rows, 1)
    return np.asarray(left - left[:, present.columns] @ own)


def draw_signs(blocks: int, draws: int, seed: int) -> tuple[Floats, list[Index]]:
    """Return random signs (draw, unit) and the blocks of each unit."""
    units: list[Index] = np.array_split(
        np.arange(blocks, dtype=np.int64), min(blocks, SCORING_SETTINGS.units)
    )
    signs = np.random.default_rng(seed).integers(0, 2, (draws, len(units))) * 2.0 - 1.0
    return np.asarray(signs, dtype=np.float64), units


def sign_flip_ratios(
    grams: BlockProducts,
    present: ModelColumns,
    candidates: Sequence[Index],
    y: int,
    signs: Floats,
    units: Sequence[Index],
) -> tuple[Floats, Floats]:
    """Return observed ratios (candidate,) and flipped ones (draw, candidate)."""
    rows = _rows_of(grams, _with_residual(present, y))
    whole = rows.sum(axis=1)
    given = present.solve(whole[1:])
    scores = _block_scores(rows, given, present, y)
    summed = np.stack([scores[unit].sum(axis=0) for unit in units])
    # A ratio is compared with thousands of others: seven digits are enough.
    draws = signs.astype(np.float32)
    observed = np.zeros(len(candidates))
    flipped = np.zeros((len(signs), len(candidates)))
    for positions, columns in group_by_size(candidates):
        inner = grams.products_within(columns).sum(axis=0)
        half = inverse_square_root(_projected(whole, given, inner, columns, y)[0])
        # (unit, k, candidate): the statistics in directions that are independent of each other.
        own = np.matmul(summed[:, columns].transpose(1, 0, 2), half).transpose(1, 2, 0)
        # A ratio has no unit: what single precision could not hold is scaled.
        own /= np.maximum(np.abs(own).max(axis=(0, 1)), 1e-300)
        drawn = draws @ own.astype(np.float32).reshape(len(own), -1)
        squares = np.sum(np.square(drawn, out=drawn).reshape(len(signs), *columns.shape[::-1]), axis=1)
        usual = np.maximum(squares.mean(axis=0, dtype=np.float64), 1e-300)
        observed[positions] = np.sum(own.sum(axis=0) ** 2, axis=0) / usual
        flipped[:, positions] = squares / usual
    return observed, flipped


def family_wise_p(observed: Floats, flipped: Floats) -> Floats:
    """Return p-values (candidate,): how often the largest flipped ratio reaches the observed one."""
    largest = np.sort(flipped.max(axis=1)) if flipped.size else np.zeros(1)
    above = largest.size - np.searchsorted(largest, observed, side="left")
    return np.asarray((1.0 + above) / (1.0 + largest.size))
