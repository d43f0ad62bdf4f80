"""Forward and backward selection, rivals, and the few-block test.

Takes a state of the search (`inflight.diagnosis.search`); makes the next one, step by step, until nothing
more is justified (`select_effects`), and holds what was taken against everything that could take its place
(`exchange_and_check`). Values with errors (`estimate`) come from the joint fit of the whole model, with a
covariance clustered by block (Bartlett's kernel; `joint_fit`).

The few-block test: signs of six blocks can be flipped in 64 ways, so that whatever lies in them can never be
significant, however clearly each of them shows it. Where blocks are much longer than the residual's
correlation time, they are divided, and each part's gain is held against what the other parts predict (see
`inflight.lsq.covariance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.refine import FormTrials, can_add_columns, refine, with_value
from inflight.diagnosis.residual import DiagnosisData, correlation_s
from inflight.diagnosis.scoring import ModelColumns, fit, make_folds, project_out_of, score
from inflight.diagnosis.search import FORMS, Option, Rules, ScoreTable, Search
from inflight.lsq import (
    GramBlocks,
    bartlett_covariance,
    expected_gain_p,
    gram_inverse,
    hac_t,
    inverse_square_root,
    regression_coefficients,
    sandwich,
    with_variance_floor,
)
from inflight.progress import Progress, silent, tell_each
from inflight.samples import base_channels
from inflight.time import SECOND


@dataclass(frozen=True, kw_only=True)
class SelectionSettings:
    """Numbers of the selection that are not in `Rules`.

    Attributes
    ----------
    bartlett : int
        Reach of the scores' correlation in the covariance, in blocks; assumed. (MISSING_EFFECT 2.3 sums 15
        days; a block is no shorter than the residual's correlation time.)
    rival_own_t, rival_gain : float
        A rival must itself reach this t and this part of the winner's gain (MISSING_EFFECT 2.4).
    contained : float
        A rival that reproduces this part of an effect's square holds it as a special case; assumed.
    weak : float
        An effect of which the calibration and the rest of the model leave less than this part is weakly
        known; assumed (MISSING_EFFECT 2.4 warns below 0.01).
    large_gain : float
        Held-out gain from which an addition may make others weakly known; assumed.
    most_taken : float
        Factor by which an addition of less gain may lower what the model leaves of another effect; stated:
        its error doubles.
    near : int
        Other mechanisms, those that lose by least, that an effect is held against again with other choices of
        numbers; a bound on time, assumed.
    exchanges : int
        Exchanges of an effect for a better one at most, so that a search ends; assumed.
    most_sigmas : float
        A number of the model that had to be off by more of its sigmas is no explanation of what follows a
        channel that is none of its own; assumed.
    quick : float
        A lag or a delay that is off by no more than so many samples of the search may be either; assumed.
    few_columns, part_of_best : int, float
        Coefficients of a cause at most that goes before wider forms, and the part of their gain it must
        reach; assumed.
    """

    bartlett: int = 3
    rival_own_t: float = 2.0
    rival_gain: float = 0.02
    contained: float = 0.9999
    weak: float = 0.02
    large_gain: float = 0.1
    most_taken: float = 4.0
    near: int = 6
    exchanges: int = 3
    most_sigmas: float = 30.0
    quick: float = 4.0
    few_columns: int = 12
    part_of_best: float = 0.3


@dataclass(frozen=True, kw_only=True)
class FewBlockSettings:
    """Numbers of the few-block test.

    Attributes
    ----------
    correlation_times, rows : float, int
        Parts are at least so many correlation times of the residual, and so many rows, long; assumed.
    options : int
        Options tested at most: the best of those that only their p-value keeps out; a bound on time, assumed.
    """

    correlation_times: float = 10.0
    rows: int = 20
    options: int = 6


SELECTION_SETTINGS = SelectionSettings()
FEW_BLOCK_SETTINGS = FewBlockSettings()


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Values of some columns, all in the model together.

    Attributes
    ----------
    columns : tuple of str
    value, sigma : ndarray, shape (column,)
        Physical units.
    covariance : ndarray, shape (column, column)
        Physical units.
    retained : float
        Part of the effect's own variance the rest of the model leaves.
    rms : float
        Size of the contribution that the rest of the model leaves, nT.
    """

    columns: tuple[str, ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    retained: float
    rms: float

    def shift_in_sigmas(self, other: Estimate) -> float:
        """Return by how many of its sigmas the value that differs most from another estimate's does so."""
        known = self.sigma > 0
        return float(np.max(np.abs(self.value - other.value)[known] / self.sigma[known], initial=0.0))

    def with_least_error(self, error: float) -> Estimate:
        """Return the estimate of one value with an error that is no smaller than another one of it."""
        sigma = np.maximum(self.sigma, error)
        return replace(self, sigma=sigma, covariance=np.diag(sigma**2))

    def with_error(self, error: Floats) -> Estimate:
        """Return the estimate with a further error of each value, physical units, independent of its own."""
        sigma = np.hypot(self.sigma, error)
        wider = np.divide(sigma, self.sigma, out=np.ones_like(sigma), where=self.sigma > 0)
        return replace(self, sigma=sigma, covariance=self.covariance * np.outer(wider, wider))

    def between(self, one: Estimate, other: Estimate) -> Estimate:
        """Return the estimate as far from one as it lies beyond the values between that and another."""
        low, high = np.minimum(one.value, other.value), np.maximum(one.value, other.value)
        return replace(self, value=one.value + self.value - np.clip(self.value, low, high))

    def covering(self, other: Estimate) -> Estimate:
        """Return the estimate with sigmas that reach as far as another estimate of the same data."""
        sigma = np.maximum(self.sigma, np.abs(self.value - other.value))
        wider = np.divide(sigma, self.sigma, out=np.ones_like(sigma), where=self.sigma > 0)
        return replace(self, sigma=sigma, covariance=self.covariance * np.outer(wider, wider))


@dataclass(frozen=True)
class BlockwiseFit:
    """Values of the model's columns, scaled, all together.

    Attributes
    ----------
    value : ndarray, shape (column,)
    moved : ndarray, shape (block, column)
        By how much each block's scores move the values. What is known beforehand pulls the fit off what the
        data alone say, where scores sum to nothing; they are those there, since how far the fit was pulled is
        no scatter of blocks.
    inverse : ndarray, shape (column, column)
        Of the Gram matrix and what is known beforehand.
    white : ndarray, shape (column, column)
        Covariance, were rows independent, of the variance that is left.
    """

    value: Floats
    moved: Floats
    inverse: Floats
    white: Floats

    @classmethod
    def of(cls, grams: GramBlocks, present: ModelColumns, y: int) -> BlockwiseFit:
        """Return the fit of the model's columns to a residual."""
        p = present.columns
        blocks = grams.rows(p, np.append(p, y))
        matrix, right = blocks[:, :, :-1].sum(axis=0), blocks[:, :, -1].sum(axis=0)
        inverse = gram_inverse(matrix + np.diag(present.precision))
        value = -inverse @ right
        scores = blocks[:, :, -1] + np.einsum("bij,j->bi", blocks[:, :, :-1], value)
        if present.precision.any():
            pulled = gram_inverse(matrix) @ scores.sum(axis=0)
            scores = scores - np.einsum("bij,j->bi", blocks[:, :, :-1], pulled)
        remaining = grams.squares[:, y].sum() + 2.0 * right @ value + value @ matrix @ value
        white = max(float(remaining), 0.0) / max(float(grams.count.sum()), 1.0) * matrix
        return cls(value, -scores @ inverse, inverse, sandwich(inverse, white))


def joint_fit(grams: GramBlocks, present: ModelColumns, y: int) -> tuple[Floats, Floats]:
    """Return values and covariance of the model's columns, scaled; clustered by block (Bartlett's kernel).

    The scatter of few blocks that hold nearly all information on a column comes out too small, for the fit
    follows them. No sigma is smaller than that from rows of white noise of the residual's size. Scatter is
    made no smaller than that of uncorrelated blocks in values, never in scores: of two columns that do nearly
    the same, the difference of scores is what tells them apart, and nothing is right of it once each is made
    larger by itself.

    What is known beforehand is one more measurement, with an error of its own: a column the data do not see
    keeps its prior's sigma.
    """
    fit = BlockwiseFit.of(grams, present, y)
    count, inverse = len(fit.moved), fit.inverse
    free = max(count - present.columns.size / 3.0, 2.0)
    scatter = bartlett_covariance(fit.moved, SELECTION_SETTINGS.bartlett) * count / free
    covariance = with_variance_floor(scatter, fit.white)
    return fit.value, covariance + present.variance * (inverse * present.precision) @ inverse


def estimate(search: Search, option: Option, form: str = "raw") -> Estimate:
    """Return the values of an accepted option's columns, in the joint fit of the whole model."""
    return estimate_in(search, option, search.forms[form])


def estimate_in(search: Search, option: Option, grams: GramBlocks) -> Estimate:
    """Return the values of an accepted option's columns from Gram blocks that have the model's columns."""
    present, y = search.present_in(grams), grams.residuals[search.residual]
    value, covariance = joint_fit(grams, present, y)
    columns = grams.index(option.columns)
    places = np.array([int(np.flatnonzero(present.columns == column)[0]) for column in columns])
    scale = grams.scale[columns]
    own, block = value[places], covariance[np.ix_(places, places)]
    kept = float(own @ project_out_of(grams, search.present_in(grams, option), columns) @ own)
    # Its own variance is that about a constant channel: a temperature of 293 K that moves by one kelvin
    # moves by one kelvin.
    whole = float(own @ centred(search, option) @ own)
    rows = max(float(grams.count.sum()), 1.0)
    return Estimate(
        columns=option.columns,
        value=own * scale,
        sigma=np.sqrt(np.clip(np.diag(block), 0.0, None)) * scale,
        covariance=block * np.outer(scale, scale),
        retained=min(kept / whole, 1.0) if whole > 0 else 0.0,
        rms=float(np.sqrt(max(kept, 0.0) / rows)),
    )


def centred(search: Search, option: Option) -> Floats:
    """Return the Gram matrix of an option's columns about constant channels (see `GramArrays.centred`)."""
    own = search.raw.index(option.columns)
    # Only a channel has a mean that is none of the effect's doing.
    base = [name for term in search.library.base for name in term.columns] if option.channels else []
    return search.raw.centred(own, search.raw.index(base))


def detectable_amplitude(search: Search, option: Option, form: str = "raw") -> Floats:
    """Return the amplitude of each column that would stand out by three sigma; physical units.

    From the scatter of the blocks' scores around the present model, the option not being in it.
    """
    grams, y = search.forms[form], search.y(form)
    present = search.present(form, option)
    columns = grams.index(option.columns)
    both = ModelColumns(
        np.concatenate([present.columns, columns]),
        np.append(present.precision, np.zeros(columns.size)),
        present.variance,
    )
    _, covariance = joint_fit(grams, both, y)
    sigma = np.sqrt(np.clip(np.diag(covariance)[-columns.size :], 0.0, None))
    return np.asarray(3.0 * sigma * grams.scale[columns])


def calibration_shifts(search: Search, option: Option, gamma: Floats) -> list[tuple[str, float]]:
    """Return by how much the calibration's parameters shift when the effect is there but ignored.

    Parameters
    ----------
    gamma : ndarray
        Values of its columns, physical units.

    Returns
    -------
    list of (str, float)
        Column of the calibration and its shift, physical units, one interval over the whole span.
    """
    raw = search.raw
    names = [name for term in search.library.base for name in term.columns]
    base, own = raw.index(names), raw.index(option.columns)
    places = np.concatenate([base, own])
    total, at = raw.rows(places, places).sum(axis=0), np.arange(places.size)
    shift = regression_coefficients(total, at[: base.size], at[base.size :]) @ (gamma / raw.scale[own])
    return list(zip(names, (shift * raw.scale[base]).tolist(), strict=True))


def form_disagreement(search: Search, option: Option) -> float | None:
    """Return how far the raw and the within-day values of an effect disagree, per column (W / k).

    Large values hint at a wrong effect or a wrong form; it is no test.
    """
    if option.change is not None:
        return None
    raw, within = estimate(search, option, "raw"), estimate(search, option, "within")
    difference = raw.value - within.value
    both = raw.covariance + within.covariance
    seen = np.sqrt(np.clip(np.diag(both), 0, None)) > 0
    if not seen.any():
        return None
    inverse = gram_inverse(both[np.ix_(seen, seen)])
    return float(difference[seen] @ inverse @ difference[seen] / seen.sum())


@dataclass(frozen=True, kw_only=True)
class RivalCheck:
    """How an effect of the model stands against everything that could take its place.

    Attributes
    ----------
    option : Option
    gain, t, p : float
        Held-out, against the model without it; p family-wise.
    placebo_t : float
        By which t it leaves less than the best placebo.
    form : str
        The form these were found in.
    rivals : tuple of (Option, float)
        Options of other mechanisms that do as well, with the t by which they lose.
    near : tuple of Option
        Those that lose, but by least: what another choice of numbers might prefer.
    """

    option: Option
    gain: float
    t: float
    p: float
    placebo_t: float
    form: str
    rivals: tuple[tuple[Option, float], ...]
    near: tuple[Option, ...] = ()


def _explained_after(last: ScoreTable, rival: Option, form: str) -> float:
    """Return the sum of squares a rival explains after all that was taken; 0 when it is taken itself."""
    place = place_in(last, rival)
    scores = last.scores[form]
    return float(scores.loss0.sum() * scores.gain[place]) if place is not None else 0.0


def same_cause(one: Option, other: Option) -> bool:
    """Return True for two forms of one cause."""
    if one.number or other.number:
        if one.number and other.number:
            return one.number == other.number
        # A number of the model that follows a channel, and another effect that does.
        return bool(set(one.channels) & set(other.channels)) or one.family == other.family
    same = one.channels == other.channels and one.family == other.family
    # These families hold several parameters: a scale that steps or drifts is no angle that does.
    same &= bool(one.channels) or one.family not in ("sensor", "ageing")
    return same or one.mechanism == other.mechanism


def _contains(search: Search, rival: Option, option: Option, form: str) -> bool:
    """Return True when a rival of more coefficients holds the option as a special case.

    A free delay of each axis holds a delay of all; unless it explains more, it is a wider form and no rival.
    """
    if len(rival.columns) <= len(option.columns) or rival.change is not None or option.change is not None:
        return False
    grams = search.forms[form]
    own, wide = grams.index(option.columns), grams.index(rival.columns)
    present = search.present(form, option)
    gamma, _ = fit(grams, present, [own], search.y(form))
    rest = project_out_of(grams, present, np.concatenate([own, wide]))
    shared = rest[own.size :, : own.size] @ gamma[0]
    half = inverse_square_root(rest[None, own.size :, own.size :])[0]
    whole = float(gamma[0] @ rest[: own.size, : own.size] @ gamma[0])
    return whole > 0 and float(np.sum((half.T @ shared) ** 2)) > SELECTION_SETTINGS.contained * whole


def place_in(table: ScoreTable, option: Option) -> int | None:
    """Return where an option stands in a table; None when it is not there."""
    for place, other in enumerate(table.options):
        if other.name == option.name:
            return place
    return None


def clearest_form(table: ScoreTable, place: int) -> str:
    """Return the first form that shows an option clearly, else the one where its t is largest."""
    return max(
        FORMS, key=lambda form: float(table.scores[form].t[place]) if form in table.scores else -np.inf
    )


def check_rivals(
    search: Search, option: Option, table: ScoreTable, last: ScoreTable | None = None
) -> RivalCheck:
    """Return how an effect of the model stands against everything that could take its place.

    Another form of the same cause, the same channels in the same family, is no rival; nor is what explains
    as much after the effect (in the `last` table) as in its place: that is another effect.
    """
    place = place_in(table, option)
    if place is None:
        gain, t = search.held_out_worth(option)
        return RivalCheck(option=option, gain=gain, t=t, p=1.0, placebo_t=0.0, form="raw", rivals=())
    form = "raw" if table.scores["raw"].t[place] > search.rules.t else clearest_form(table, place)
    scores = table.scores[form]
    # Of a mechanism the option that leaves least. A change at a wrong time misses by much in few blocks:
    # hardly any t separates it from the right one.
    best: dict[str, int] = {}
    for other in np.argsort(scores.loss.sum(axis=0), kind="stable").tolist():
        best.setdefault(table.options[other].mechanism, other)
    found: dict[str, tuple[Option, float]] = {}
    for other, rival in enumerate(table.options):
        if same_cause(rival, option) or rival.placebo or (rival.agnostic and not option.agnostic):
            continue
        if rival.change is not None and other != best[rival.mechanism]:
            continue
        if rival.family == "unknown" and set(option.channels) < set(rival.channels):
            continue
        if last is not None and _explained_after(last, rival, form) > 0.5 * float(
            scores.loss0.sum() * scores.gain[other]
        ):
            continue
        if (
            scores.t[other] < SELECTION_SETTINGS.rival_own_t
            or scores.gain[other] < SELECTION_SETTINGS.rival_gain * scores.gain[place]
        ):
            continue
        behind = scores.t_worse_than(other, place)
        nearer = behind < found.get(rival.mechanism, (rival, np.inf))[1]
        if nearer and not (behind < search.rules.rival_t and _contains(search, rival, option, form)):
            found[rival.mechanism] = (rival, behind)
    ordered = sorted(found.values(), key=lambda pair: pair[1])
    rivals = tuple(pair for pair in ordered if pair[1] < search.rules.rival_t)
    others = ordered[len(rivals) : len(rivals) + SELECTION_SETTINGS.near]
    p = [table.p[one][place] for one in table.p]
    p += [one.p for one in search.rounds if one.name == option.name and one.action == "add"]
    return RivalCheck(
        option=option,
        gain=float(scores.gain[place]),
        t=float(scores.t[place]),
        p=float(min(p)),
        placebo_t=float(table.t_over_placebo[form][place]),
        form=form,
        rivals=rivals,
        near=tuple(rival for rival, _ in others),
    )


def select_effects(
    search: Search,
    data: DiagnosisData,
    shapes_first: bool = False,
    progress: Progress = silent,
    stage: str = "search",
) -> tuple[Search, ScoreTable, ScoreTable]:
    """Add and drop until nothing more is justified; return the state, the first and the last table of scores.

    Each round scores everything, adds the best option that passes `Rules` (asking the few-block test when
    none does), refines its form before the next one is sought, and drops what it made superfluous.

    Parameters
    ----------
    shapes_first : bool
        What explains most goes first, though it names no cause.
    progress : callable
        Told the rounds made; there is at least one more until none is justified.
    stage : str
        What the rounds are called there.
    """
    first, made = None, 0
    for made in range(search.rules.rounds):
        progress(stage, made, made + 1)
        table = search.table()
        first = first or table.without_fits()
        found = best_passing(table, search, shapes_first)
        if found is None:
            table = few_block_test(search, data, table)
            found = best_passing(table, search, shapes_first)
        # What was fitted to folds holds on to the Gram blocks, which grow when the option is refined.
        table = table.without_fits()
        if found is None:
            progress(stage, made + 1, made + 1)
            return replace(search, ran_out=False), first, table
        joined = with_numbers_of(search, data, table, found)
        if joined is not search:
            search, table = joined, joined.table()
            found = best_passing(table, search, shapes_first) or found
            table = table.without_fits()
            if found[0].name not in {option.name for option in table.options}:
                continue
        number = number_that_explains(search, found[0])
        if number is not None:
            search = search.with_freed(number, found[0]).with_round("free", found[0], name=number)
            continue
        search = hold_what_others_explain(_one_round(search, data, table, *found))
    last = search.table().without_fits()
    progress(stage, made + 1, made + 1)
    return replace(search, ran_out=bool(search.rules.rounds)), first or last, last


def with_numbers_of(
    search: Search, data: DiagnosisData, table: ScoreTable, found: tuple[Option, str]
) -> Search:
    """Return the state with the best values of held numbers that may explain what an option does.

    Those are numbers that follow a channel of the option, and all that explain a large part of it by their
    derivative. The state itself when there are none, or their best values are known.
    """
    option, form = found
    if option.change is not None or not can_add_columns(search, data):
        return search
    scores = table.scores[form]
    least = SELECTION_SETTINGS.part_of_best * float(scores.gain[table.options.index(option)])
    for place, one in enumerate(table.options):
        if one.number and one.number_sigma is None and scores.t[place] > search.rules.rival_t:
            close = bool(set(one.channels) & set(option.channels)) or scores.gain[place] > least
            if close and scores.gain[place] > SELECTION_SETTINGS.rival_gain * least:
                search, _ = with_value(search, data, one)
    return search


def number_that_explains(search: Search, option: Option) -> str | None:
    """Return the number of the model that, free, leaves an option nothing to explain; None when none does.

    A wrong number is the commonest cause of a residual. Its columns are there, but held by what the model
    states of it, which an option that does nearly the same is not: it would be taken in its place.
    """
    if option.change is not None:
        # What changes at a time no constant is.
        return None
    numbers = {name.partition("[")[0] for term in search.library.refined for name in term.columns}
    found, of_forms = [], search.grams_with(option)
    for number in sorted(numbers - set(search.freed)):
        free = search.with_freed(number, option)
        if search.rules.margin(free.held_out_worth(option, of_forms)) < 1.0:
            found.append((_sigmas_moved(free, number), number))
    # Several may do: the one that has to move least of what the model states of it is the likeliest.
    for moved, number in sorted(found):
        if moved < SELECTION_SETTINGS.most_sigmas or uses_channel_of(search, number, option):
            return number
    return None


def rivals_of_number(search: Search, number: str) -> tuple[str, ...]:
    """Return the mechanisms of other channels that do as well as a number of the model, were it held.

    Parameters
    ----------
    number : str
        Such as ``model:temperature.linear``.
    """
    freed = {one: at for one, at in search.freed.items() if one != number}
    held = replace(search, freed=freed, held=search.held | {number})
    table = held.table()
    scores, grams = table.scores["raw"], search.forms["raw"]
    moved = score(grams, search.present(), [], search.y(), make_folds(len(grams))).loss0
    passing = table.passing(search.rules)["raw"]
    behind = hac_t(scores.loss - moved[:, None])
    found = {
        table.options[place].mechanism: None
        for place in np.argsort(scores.loss.sum(axis=0), kind="stable")
        if passing[place]
        and behind[place] < search.rules.rival_t
        and not table.options[place].agnostic
        and (table.options[place].number or not uses_channel_of(search, number, table.options[place]))
    }
    return tuple(found)


def uses_channel_of(search: Search, number: str, option: Option) -> bool:
    """Return True when the effect a number of the model belongs to follows a channel of an option."""
    return any(
        not channels_under(term.entry.effect.channels).isdisjoint(option.channels)
        for term in search.library.refined
        if number in {name.partition("[")[0] for name in term.columns}
    )


def channels_under(names: Sequence[str]) -> set[str]:
    """Return the channels of the mission that derived ones are made from."""
    return {one for name in names if name for one in base_channels(name)}


def hold_what_others_explain(search: Search) -> Search:
    """Return the state without the freedom of numbers that what was taken since explains as well."""
    for number in search.freed:
        held = replace(search, freed={one: at for one, at in search.freed.items() if one != number})
        if held.held_out_t_worse_than(search) < search.rules.keep_t:
            search = held
    return search


def _sigmas_moved(search: Search, number: str) -> float:
    """Return how far data move a number of the model that is free, in the sigmas the model states of it."""
    known = {
        name: sigma
        for term in search.library.refined
        for name, sigma in zip(term.columns, term.sigma, strict=True)
        if name.partition("[")[0] == number
    }
    present = search.present()
    value, covariance = joint_fit(search.forms["raw"], present, search.y())
    columns = search.forms["raw"].index(list(known))
    places = np.array([int(np.flatnonzero(present.columns == column)[0]) for column in columns])
    scale = search.raw.scale[search.raw.index(list(known))]
    spread = np.hypot(np.array(list(known.values())), np.sqrt(np.diag(covariance)[places]) * scale)
    return float(np.sqrt(np.sum((value[places] * scale / spread) ** 2)))


def _one_round(search: Search, data: DiagnosisData, table: ScoreTable, option: Option, form: str) -> Search:
    """Return the state after an option was taken, refined, and kept or taken back."""
    place = table.options.index(option)
    scores = table.scores[form]
    gain = float(scores.gain[place])
    numbers: Any = {"gain": gain, "t": float(scores.t[place]), "p": float(table.p[form][place]), "form": form}
    before = {one: estimate(search, one).retained for one in search.accepted}
    search, taken = _add_refined(search, data, option)
    search = search.with_round("add", option, name=taken.name, **numbers)
    if any(set(taken.columns) & set(one.columns) for one in before):
        # One form of the blocks asks for another lag than the model has, and all samples for the same one.
        search = search.with_accepted(tuple(before)).with_safe_intervals().with_banned(option.mechanism)
        return search.with_round("undo", option, **numbers)
    if search.is_hidden(taken):
        return search.hide(taken).with_round("undo", taken, **numbers)
    search = _drop_superfluous(search)
    if option.mechanism not in {one.mechanism for one in search.accepted}:
        search = search.with_banned(option.mechanism)
    # A form much like another effect, or a wide one, can for a small gain take over what is known of it.
    if gain < SELECTION_SETTINGS.large_gain and any(
        _takes_over(before.get(one, 0.0), estimate(search, one).retained) for one in search.accepted
    ):
        search = search.with_accepted(tuple(before)).with_safe_intervals().with_banned(option.mechanism)
        return search.with_round("undo", option, **numbers)
    return search


def _takes_over(before: float, after: float) -> bool:
    """Return True when an addition leaves so little of an effect that it is weakly known, or far less so."""
    weak = before >= SELECTION_SETTINGS.weak > after
    return weak or after * SELECTION_SETTINGS.most_taken < before


def _add_refined(search: Search, data: DiagnosisData, option: Option) -> tuple[Search, Option]:
    """Return the state with an option in the model, in its best form, and that form."""
    search, better = refine(search.add(option), data, option)
    return search.exchange(option, better), better


def refine_all(search: Search, data: DiagnosisData) -> Search:
    """Refine everything once more: what was taken early was refined while the others were missing."""
    for option in search.accepted:
        search, better = refine(search, data, option)
        search = search.exchange(option, better)
    return search


def best_passing(table: ScoreTable, search: Search, shapes_first: bool = False) -> tuple[Option, str] | None:
    """Return what to add next and the form that shows it, or None when nothing is beyond doubt.

    One that names a cause goes before one that describes a shape (see `_named_causes`), and of the same
    channels the one with fewer coefficients, when it does equally well.
    """
    passing = table.passing(search.rules)
    for form in FORMS:
        places = np.flatnonzero(passing[form])
        if not places.size:
            continue
        scores = table.scores[form]
        loss = scores.loss
        named = places.tolist() if shapes_first else _named_causes(table, places.tolist(), scores.gain)
        first = min(named, key=lambda place: float(loss[:, place].sum()))
        best = table.options[first]
        # Forms of one cause; a change in time is none of another parameter's change.
        same = [
            place
            for place in named
            if table.options[place].channels == best.channels
            and (
                table.options[place].mechanism == best.mechanism
                or (table.options[place].change is None and best.change is None)
            )
            and _simplicity(table.options[place]) < _simplicity(table.options[first])
            and _does_as_well(table, place, first, form, search.rules)
        ]
        simplest = min((_simplicity(table.options[place]) for place in same), default=None)
        chosen = min(
            (place for place in same if _simplicity(table.options[place]) == simplest),
            key=lambda place: float(loss[:, place].sum()),
            default=first,
        )
        chosen = _number_before(table, named, chosen, form, search.rules)
        return table.options[_best_time(table, places.tolist(), chosen, form, search.rules.rival_t)], form
    return None


def _number_before(table: ScoreTable, places: list[int], chosen: int, form: str, rules: Rules) -> int:
    """Return a number that the model holds instead of an effect that does no better; of several the best."""
    if table.options[chosen].number:
        return chosen
    loss = table.scores[form].loss.sum(axis=0)
    numbers = [
        place
        for place in places
        if table.options[place].number and _does_as_well(table, place, chosen, form, rules)
    ]
    return min(numbers, key=lambda place: float(loss[place]), default=chosen)


def _best_time(table: ScoreTable, places: list[int], chosen: int, form: str, rival_t: float) -> int:
    """Return what to take for a change in time: its steady cause if that does as well, else the best time."""
    option, scores = table.options[chosen], table.scores[form]
    if option.change is None:
        return chosen
    steady = [
        place
        for place in places
        if table.options[place].change is None
        and same_cause(table.options[place], option)
        and scores.t_worse_than(place, chosen) < rival_t
    ]
    if steady:
        return min(steady, key=lambda place: float(scores.loss[:, place].sum()))
    same = [place for place in places if table.options[place].mechanism == option.mechanism]
    return min(same, key=lambda place: float(scores.loss[:, place].sum()))


def _does_as_well(table: ScoreTable, simple: int, wide: int, form: str, rules: Rules) -> bool:
    """Return True when a wider form is no surer, or leaves but a little less: its shape is not seen.

    Little is a hundredth of what is left; of forms with as many coefficients, also of what the effect itself
    takes off: so much of a shape the interpolation between a channel's readings makes.
    """
    scores = table.scores[form]
    loss = scores.loss.sum(axis=0)
    size = float(loss[simple])
    if len(table.options[simple].columns) == len(table.options[wide].columns):
        size = max(size, float(scores.loss0.sum() - loss[wide]))
    little = float(loss[simple] - loss[wide]) < rules.gain * size
    return little or scores.t_worse_than(simple, wide) < rules.rival_t


def _named_causes(table: ScoreTable, places: list[int], gain: Floats) -> list[int]:
    """Return those of the passing options that go first: named causes of few coefficients.

    A shape in a coordinate, or a form of dozens of coefficients, can mimic several causes at once. It waits
    for those, unless they explain but a small part of what it does; what it mimicked is then left to it.
    """
    best = max(float(gain[place]) for place in places)
    named = [
        place
        for place in places
        if not table.options[place].agnostic and gain[place] > SELECTION_SETTINGS.part_of_best * best
    ]
    few = [place for place in named if len(table.options[place].columns) <= SELECTION_SETTINGS.few_columns]
    return few or named or places


def _simplicity(option: Option) -> tuple[int, bool]:
    """Order forms of one cause: fewer coefficients first, then a field straight in its channel."""
    return len(option.columns), not option.mechanism.startswith("channel_field")


def _drop_superfluous(search: Search) -> Search:
    """Return the state without effects that the others have made superfluous, the least useful first."""
    while len(search.accepted) > 1:
        worths = [search.held_out_worth(option) for option in search.accepted]
        place = int(np.argmin([search.rules.margin(worth) for worth in worths]))
        gain, t = worths[place]
        if search.rules.margin(worths[place]) >= 1.0:
            break
        option = search.accepted[place]
        # One chance to come back, when others are there: more would go round in circles.
        again = option.mechanism in search.dropped
        search = search.drop(option).with_round("drop", option, gain=gain, t=t, p=1.0)
        if again:
            search = search.with_banned(option.mechanism)
        else:
            search = replace(search, dropped=search.dropped | {option.mechanism})
    return search


def exchange_and_check(
    search: Search, data: DiagnosisData, progress: Progress = silent
) -> tuple[Search, list[RivalCheck], ScoreTable | None]:
    """Compare every effect of the model with all that could take its place; exchange what does better.

    The scores of everything else, which come last, are None when the model holds nothing.

    An effect taken early was compared with rivals while the others were still missing; now they are there.
    """
    tables: dict[str, ScoreTable] = {}
    for _ in range(SELECTION_SETTINGS.exchanges):
        tables = {}
        for option in tell_each(progress, "rivals", search.accepted):
            table = tables[option.name] = search.table(without=option)
            better = better_option(search, option, table) or _simpler_form(option, table, search.rules)
            if better is not None:
                search, better = _add_refined(search.drop(option), data, better)
                search = search.with_round("exchange", better)
                break
        else:
            break
    slimmer = _drop_superfluous(search)
    if slimmer is not search:
        search, tables = slimmer, {}
    last = search.table() if search.accepted else None
    checks = [
        _with_quick_forms(
            search,
            data,
            check_rivals(search, option, tables.get(option.name) or search.table(without=option), last),
        )
        for option in search.accepted
    ]
    return search, checks, None if last is None else last.without_fits()


def _with_quick_forms(search: Search, data: DiagnosisData, check: RivalCheck) -> RivalCheck:
    """Return how an effect stands, a lag or a delay of few samples with the other one as its rival.

    To first order both do the same, and what is left of a switch within few samples is taken for a spike.
    """
    term = search.library.by_key[check.option.terms[0]] if check.option.number else None
    if term is None or term.difference is None or term.difference.number.key not in ("lag", "delay"):
        return check
    number = term.difference.number
    if abs(term.difference.between[1] - number.value) > SELECTION_SETTINGS.quick * data.cadence_s:
        return check
    known = {rival.number for rival, _ in check.rivals}
    more = []
    for option in search.options:
        other = search.library.by_key[option.terms[0]].difference if option.number else None
        same = other is not None and other.number.channel == number.channel
        same &= other is not None and {other.number.key, number.key} == {"lag", "delay"}
        if same and option.number not in known:
            known.add(option.number)
            more.append((option, 0.0))
    return replace(check, rivals=(*check.rivals, *more))


def better_option(search: Search, option: Option, table: ScoreTable) -> Option | None:
    """Return an option that leaves significantly less than an accepted one in its place; None without."""
    place = place_in(table, option)
    if place is None:
        return None
    form = clearest_form(table, place)
    scores = table.scores[form]
    loss = scores.loss
    passing = table.passing(search.rules)[form]
    others = [
        other
        for other in np.flatnonzero(passing)
        if not (table.options[other].agnostic and not option.agnostic)
        and not same_cause(table.options[other], option)
        and scores.t_worse_than(place, int(other)) > search.rules.rival_t
        and _is_worth(table, int(other), place, form, search.rules.gain)
    ]
    if not others:
        return None
    best = min(others, key=lambda other: float(loss[:, other].sum()))
    return table.options[best] if table.options[best].mechanism != option.mechanism else None


def _simpler_form(option: Option, table: ScoreTable, rules: Rules) -> Option | None:
    """Return an option that follows the same channels with fewer coefficients and leaves no more held out."""
    place = place_in(table, option)
    if place is None or option.change is not None or not option.channels:
        return None
    form = clearest_form(table, place)
    loss = table.scores[form].loss.sum(axis=0)
    simpler = [
        other
        for other in np.flatnonzero(table.passing(rules)[form])
        if set(table.options[other].channels) == set(option.channels)
        and table.options[other].change is None
        and len(table.options[other].columns) < len(option.columns)
        and loss[other] <= loss[place]
    ]
    return table.options[min(simpler, key=lambda other: float(loss[other]))] if simpler else None


def _is_worth(table: ScoreTable, other: int, place: int, form: str, gain: float) -> bool:
    """Return True unless the other, a product or a wider form of the same channels, explains hardly more."""
    mine, wide = table.options[place], table.options[other]
    same = mine.channels == wide.channels and _simplicity(mine) < _simplicity(wide)
    if wide.family != "unknown" and not (same and mine.channels):
        return True
    loss = table.scores[form].loss.sum(axis=0)
    return float(loss[place] - loss[other]) > gain * float(loss[place])


def few_block_test(search: Search, data: DiagnosisData, table: ScoreTable) -> ScoreTable:
    """Return the table with p-values of options that lie in too few blocks for flips, where all else speaks.

    Each is a bound of Student's distribution times the number of options: family-wise, as flips are.
    """
    rules, raw = search.rules, table.scores["raw"]
    real = np.array([not option.placebo for option in table.options], dtype=bool)
    almost = real & (raw.t > rules.t) & (raw.gain > rules.gain) & (table.t_over_placebo["raw"] > rules.t)
    almost &= table.p["raw"] >= rules.p
    places = sorted(np.flatnonzero(almost).tolist(), key=lambda place: float(raw.loss[:, place].sum()))
    if not places:
        return table
    tried = int(real.sum()) * len(table.scores)
    p = table.p["raw"].copy()
    for place in places[: FEW_BLOCK_SETTINGS.options]:
        p[place] = min(p[place], tried * _few_block_p(search, data, table.options[place]))
    return replace(table, p=table.p | {"raw": p})


def _few_block_p(search: Search, data: DiagnosisData, option: Option) -> float:
    """Return the probability that an option gains by chance what it gains in parts of blocks."""
    known = search.library.by_key
    if option.change is None or option.terms:
        terms = [known[key] for key in option.terms if key in known]
        complete = len(terms) == len(option.terms)
    else:
        changing = {column for column, _ in option.change.functions.values()}
        terms = [term for term in known.values() if changing & set(term.columns)]
        complete = bool(terms)
    if not complete:
        # The series cannot make the option's columns.
        return 1.0
    trials = FormTrials(search, data, option)
    before, after = trials.contribution(option, terms)
    series = data.series
    correlation = correlation_s(
        series, (after / np.where(trials.root > 0, trials.root, 1.0)).reshape(len(series.tt2000), -1)
    )
    length = max(FEW_BLOCK_SETTINGS.correlation_times * correlation, FEW_BLOCK_SETTINGS.rows * series.step_s)
    part = ((series.tt2000 - series.tt2000[0]) / (length * SECOND)).astype(np.int64)
    part = np.repeat(part, len(before) // len(part))
    _, part = np.unique(part, return_inverse=True)
    gained, expected = (
        np.bincount(part, weights=values).astype(np.float64)[:, None]
        for values in (before**2 - after**2, (before - after) ** 2)
    )
    return float(expected_gain_p(gained, expected, expected > 0)[0])
