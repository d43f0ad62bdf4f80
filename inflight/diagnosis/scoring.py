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
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq import GramBlocks, expected_gain_t, hac_t, inverse_square_root, solve_scaled

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
    """Columns the model holds already, and their prior precision (1/sigma^2, scaled)."""

    columns: Index
    precision: Floats

    def solve(self, gram: Floats) -> Floats:
        """Return the projection of all columns on those of the model; (present, column)."""
        if not self.columns.size:
            return np.zeros((0, gram.shape[0]))
        inner = gram[np.ix_(self.columns, self.columns)] + np.diag(self.precision)
        return solve_scaled(inner, gram[self.columns])


@dataclass
class Fits:
    """Fits to all folds but one, kept so that two candidates can be compared block by block.

    Parameters
    ----------
    grams : GramBlocks
    present : ndarray of int
        Columns of the model.
    candidates : list of ndarray of int
        Columns of each candidate.
    """

    grams: GramBlocks
    present: Index
    candidates: list[Index]
    folds: list[tuple[Index, Floats, list[Floats]]] = field(default_factory=list)

    @cached_property
    def _own(self) -> Floats:
        """Products of the model's columns; (block, present, present)."""
        return self.grams.rows(self.present, self.present)

    def begin_fold(self, fold: Index, own: Floats) -> None:
        """Begin a fold with its blocks, and the projection (present, column) that the other blocks give."""
        self.folds.append((fold, own, [np.empty(0)] * len(self.candidates)))

    def store(self, positions: Sequence[int] | Index, gamma: Floats) -> None:
        """Store the values (candidate, k) of some candidates in the fold begun last."""
        fitted = self.folds[-1][2]
        for place, values in zip(positions, gamma, strict=True):
            fitted[int(place)] = values

    def squared_difference(self, one: int, other: int) -> Floats | None:
        """Return the sum of squares between two candidates' contributions; (block,), None if one is not here.

        When one of the two is the truth, it is what each block is expected to prefer it by.
        """
        if max(one, other) >= len(self.candidates):
            return None
        first, second = self.candidates[one], self.candidates[other]
        both = np.concatenate([first, second])
        values = np.zeros((len(self.grams), both.size))
        model = np.zeros((len(self.grams), self.present.size))
        for fold, own, fitted in self.folds:
            values[fold] = np.concatenate([fitted[one], -fitted[other]])
            # The model's own columns give way.
            model[fold] = -own[:, both] @ values[fold[0]]
        rows = np.matmul(self.grams.rows(np.append(both, self.present), both), values[:, :, None])[:, :, 0]
        out = np.sum(rows[:, : both.size] * values, axis=1)
        if self.present.size:
            inner = np.matmul(self._own, model[:, :, None])[:, :, 0]
            out += np.sum((2.0 * rows[:, both.size :] + inner) * model, axis=1)
        return np.asarray(np.maximum(out, 0.0))


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
        apart = self.fits.squared_difference(one, other) if self.fits is not None else None
        if apart is None:
            return float(hac_t(difference, active)[0])
        return float(expected_gain_t(difference, apart[:, None], active)[0])

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
        for place in np.flatnonzero(pairwise & (self.gain > self.gain[best])).tolist():
            out[place] = max(out[place], self._t_over_similar(place, best, rival_t))
        return out

    def _t_over_similar(self, place: int, placebo: int, rival_t: float) -> float:
        """Return the t by which a candidate leaves less than a placebo much like it; 0 when in doubt.

        A channel that repeats every orbit is much like itself a day before. Were the candidate the truth, it
        would leave less by the square of the difference of the two contributions, block by block. Where it
        gains clearly less than that (`rival_t`), the placebo explains something that the candidate does not,
        and neither is the truth.
        """
        apart = self.fits.squared_difference(placebo, place) if self.fits is not None else None
        if apart is None:
            return 0.0
        gained = self.loss[:, placebo] - self.loss[:, place]
        t = float(expected_gain_t(gained[:, None], apart[:, None], self.active[:, [place]])[0])
        return t if t * (float(apart.sum() / gained.sum()) - 1.0) < rival_t else 0.0

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
    own = grams.squares
    peak = np.maximum(own.max(axis=0), 1e-300)
    lively = own > SCORING_SETTINGS.quiet * peak
    return (
        np.stack([lively[:, columns].any(axis=1) for columns in candidates], axis=1)
        if candidates
        else lively[:, :0]
    )


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
    return np.asarray(gram - gram[:, present.columns] @ present.solve(gram))


def fit(
    grams: GramBlocks, present: ModelColumns, candidates: Sequence[Index], y: int
) -> tuple[list[Floats], Floats]:
    """Return in-sample values (scaled) and explained sums of squares of every candidate."""
    gram = project_out(grams.total, present)
    gamma: list[Floats] = [np.empty(0)] * len(candidates)
    explained = np.zeros(len(candidates))
    for positions, columns in group_by_size(candidates):
        half = inverse_square_root(gram[columns[:, :, None], columns[:, None, :]])
        score = np.einsum("cik,ci->ck", half, gram[columns, y])
        values = -np.einsum("cik,ck->ci", half, score)
        explained[positions] = np.sum(score**2, axis=1)
        for place, value in zip(positions, values, strict=True):
            gamma[place] = value
    return gamma, explained


def score(
    grams: GramBlocks, present: ModelColumns, candidates: Sequence[Index], y: int, folds: Sequence[Index]
) -> Scores:
    """Score candidates by cross-validation over blocks.

    Parameters
    ----------
    grams : GramBlocks
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
    total = grams.total
    loss0 = np.zeros(len(grams))
    loss, expected = np.zeros((2, len(grams), len(candidates)))
    p = present.columns
    given = grams.rows(np.append(p, y))
    fits = Fits(grams, p, list(candidates))
    groups = group_by_size(candidates)
    for fold, held in zip(folds, grams.sums(folds), strict=True):
        blocks = given[fold]
        train = total - held
        own = present.solve(train)
        fits.begin_fold(fold, own)
        base = _model_loss(blocks, p, own[:, y], y)
        loss0[fold] = base
        for positions, columns in groups:
            inner = train[columns[:, :, None], columns[:, None, :]]
            right = train[columns, y]
            if p.size:
                across = train[columns[:, :, None], p]
                inner = inner - across @ own[:, columns].transpose(1, 0, 2)
                right = right - across @ own[:, y]
            half = inverse_square_root(inner)
            gamma = -np.einsum("cik,ck->ci", half, np.einsum("cik,ci->ck", half, right))
            fits.store(positions, gamma)
            inner = grams.products_within(columns, fold)
            change, square = _loss_change(blocks, inner, p, own, columns, gamma, y)
            loss[np.ix_(fold, positions)] = base[:, None] + change
            expected[np.ix_(fold, positions)] = square
    whole = float(loss0.sum())
    gain = 1.0 - loss.sum(axis=0) / whole if whole > 0 else np.zeros(len(candidates))
    gamma_all, explained = fit(grams, present, candidates, y)
    active = active_blocks(grams, candidates)
    t = expected_gain_t(loss0[:, None] - loss, expected, active)
    return Scores(
        loss0=loss0,
        loss=loss,
        gain=gain,
        t=t,
        gamma=gamma_all,
        explained=explained,
        expected=expected,
        active=active,
        fits=fits,
    )


def _model_loss(blocks: Floats, present: Index, own_y: Floats, y: int) -> Floats:
    """Return the sum of squares of the residual after the model's own columns; (block,).

    `blocks` (block, present + 1, column) are the rows of the model's columns, then of the residual.
    """
    out = blocks[:, -1, y].copy()
    if present.size:
        out -= 2.0 * blocks[:, :-1, y] @ own_y
        out += np.einsum("i,bij,j->b", own_y, blocks[:, :-1, present], own_y)
    return np.asarray(out)


def _loss_change(
    blocks: Floats, inner: Floats, present: Index, own: Floats, columns: Index, gamma: Floats, y: int
) -> tuple[Floats, Floats]:
    """Return by how much candidates change the held-out sum of squares, and their own; (block, candidate).

    `blocks` (block, present + 1, column) are the rows of the model's columns, then of the residual;
    `inner` (block, candidate, k, k) the products of each candidate's own columns.
    """
    linear = np.sum(blocks[:, -1, columns] * gamma, axis=2)
    square = np.sum(np.matmul(inner, gamma[:, :, None])[:, :, :, 0] * gamma, axis=2)
    if not present.size:
        return np.asarray(2.0 * linear + square), square
    # The model's own columns give way: their change is minus the candidate's projection on them.
    beta = -np.einsum("pck,ck->cp", own[:, columns], gamma)
    own_y = own[:, y]
    model = blocks[:, :-1, present]
    across = np.einsum("bpck,ck->bcp", blocks[:, :-1, columns], gamma)
    linear = linear - across @ own_y + (blocks[:, :-1, y] - model @ own_y) @ beta.T
    square = square + 2.0 * np.sum(across * beta, axis=2) + np.sum(np.matmul(beta, model) * beta, axis=2)
    return np.asarray(2.0 * linear + square), square


def block_scores(grams: GramBlocks, present: ModelColumns, y: int) -> Floats:
    """Return the score statistics of every column at the model's own fit, block by block; (block, column).

    They sum to what the projected columns have in common with the residual.
    """
    total = grams.total
    own = present.solve(total)
    p = present.columns
    given = grams.rows(np.append(p, y))
    if not p.size:
        return np.asarray(given[:, -1])
    right = given[:, -1] - np.einsum("bpc,p->bc", given[:, :-1], own[:, y])
    inner = right[:, p]
    return np.asarray(right - inner @ own)


def draw_signs(blocks: int, draws: int, seed: int) -> tuple[Floats, list[Index]]:
    """Return random signs (draw, unit) and the blocks of each unit."""
    units: list[Index] = np.array_split(
        np.arange(blocks, dtype=np.int64), min(blocks, SCORING_SETTINGS.units)
    )
    signs = np.random.default_rng(seed).integers(0, 2, (draws, len(units))) * 2.0 - 1.0
    return np.asarray(signs, dtype=np.float64), units


def sign_flip_ratios(
    grams: GramBlocks,
    present: ModelColumns,
    candidates: Sequence[Index],
    y: int,
    signs: Floats,
    units: Sequence[Index],
) -> tuple[Floats, Floats]:
    """Return observed ratios (candidate,) and flipped ones (draw, candidate)."""
    scores = block_scores(grams, present, y)
    summed = np.stack([scores[unit].sum(axis=0) for unit in units])
    gram = project_out(grams.total, present)
    observed = np.zeros(len(candidates))
    flipped = np.zeros((len(signs), len(candidates)))
    for positions, columns in group_by_size(candidates):
        half = inverse_square_root(gram[columns[:, :, None], columns[:, None, :]])
        # (unit, candidate, k): the statistics in directions that are independent of each other.
        own = np.matmul(summed[:, columns].transpose(1, 0, 2), half).transpose(1, 0, 2)
        drawn = (signs @ own.reshape(len(own), -1)).reshape(len(signs), *columns.shape)
        squares = np.sum(drawn**2, axis=2)
        usual = np.maximum(squares.mean(axis=0), 1e-300)
        observed[positions] = np.sum(own.sum(axis=0) ** 2, axis=1) / usual
        flipped[:, positions] = squares / usual
    return observed, flipped


def family_wise_p(observed: Floats, flipped: Floats) -> Floats:
    """Return p-values (candidate,): how often the largest flipped ratio reaches the observed one."""
    largest = np.sort(flipped.max(axis=1)) if flipped.size else np.zeros(1)
    above = largest.size - np.searchsorted(largest, observed, side="left")
    return np.asarray((1.0 + above) / (1.0 + largest.size))
