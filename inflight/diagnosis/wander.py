"""How each parameter of the calibration depends on time: constant, a drift, steps, or irregular.

Takes a state of the search; makes `InTime` of each parameter (`parameters_in_time`), and a state in which
those that wander have a value a window, with lines between (`with_wander`). All is made of block products.

Irregular is a random walk w over the blocks, beside everything the model has and what each calibration
interval fits anew. Its scores v have the covariance ``s (M + r M K M)``: M is what the model leaves of the
parameter's columns block by block, K that of the walk, s a row's variance and r the walk's over it. Both
are estimated by restricted likelihood (Patterson and Thompson, Biometrika 58, 545, 1971), in the
eigenvectors in which that covariance is diagonal. Whether r is more than 0 is told by the likelihood ratio,
whose distribution at r = 0 is exact by simulation (Crainiceanu and Ruppert, J. R. Stat. Soc. B 66, 165,
2004).

Of the forms the simplest stays beside which no walk is left. What it takes off is measured on blocks that are
held out, every k-th of them: what wanders is not foretold, only followed. A dependence on time is no cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.diagnosis.scoring import Scores, make_folds, score
from inflight.diagnosis.search import Option, Search
from inflight.diagnosis.stepwise import RivalCheck
from inflight.diagnosis.time_changes import Change, block_length, lines_between_windows, time_text
from inflight.effects import Affine
from inflight.lsq import CalibratedBlocks, TimedGrams, gram_inverse, hac_t
from inflight.residual import format_period
from inflight.time import DAY, SECOND, Int64


@dataclass(frozen=True, kw_only=True)
class WanderSettings:
    """How a dependence on time is told.

    Attributes
    ----------
    chance : float
        Records of constant parameters in which any of them is called irregular; stated.
    draws, first_draws, seed : int
        Simulated likelihood ratios; the first ones are enough where a chance is `common`: a bound on time.
    common : float
        Chance that is far from telling anything.
    ratios : int
        Ratios of the walk's variance to a row's that are tried, over twelve decades.
    least : float
        Eigenvalues below this part of the largest one are rounding.
    windows : tuple of int
        Blocks of a window, tried; with fewer than two, nothing is left of a window that is held out.
    steps, parameters : int
        Steps of one parameter, and parameters that wander, at most: a bound on time, assumed.
    """

    chance: float = 0.01
    draws: int = 10_000
    first_draws: int = 500
    common: float = 0.05
    seed: int = 0
    ratios: int = 49
    least: float = 1e-9
    windows: tuple[int, ...] = (2, 3, 4, 6, 8, 12, 16, 24, 32)
    steps: int = 3
    parameters: int = 3


WANDER_SETTINGS = WanderSettings()


@dataclass(frozen=True, kw_only=True)
class InTime:
    """How a parameter depends on time.

    Attributes
    ----------
    parameter : str
        Such as ``scale_factor[z]``.
    form : str
        ``constant``, ``drift``, ``steps`` or ``irregular``.
    p : float
        Chance that a constant parameter looks as irregular.
    size, sigma : float
        What a random walk changes it by in a day (rms), and its error; unit of the parameter.
    window_blocks : int
        Blocks of the windows that follow it best; 0 of another form.
    window_s : float
        The same, seconds.
    gain, t : float
        Part of the mean square that the form takes off of held-out blocks, every k-th of them, and over its
        error.
    contiguous_gain : float
        The same of runs of blocks.
    at : tuple of int
        TT2000 of its steps.
    alike : tuple of str
        Other parameters that follow held-out blocks as well by windows as long: it may be one of them.
    column : str
        Of the library.
    """

    parameter: str
    form: str = "constant"
    p: float = 1.0
    size: float = 0.0
    sigma: float = 0.0
    window_blocks: int = 0
    window_s: float = 0.0
    gain: float = 0.0
    t: float = 0.0
    contiguous_gain: float = 0.0
    at: tuple[int, ...] = ()
    alike: tuple[str, ...] = ()
    column: str = ""

    @property
    def name(self) -> str:
        """What `inflight add` takes to put it into the model."""
        return f"wander({self.parameter}, {self.window_s / 86_400:.6g} d)"

    def words(self, unit: str) -> str:
        """Return what it does, for a physicist."""
        per = "" if unit in ("", "1") else f" {unit}"
        days = self.window_s / 86_400
        length = f"{days:.3g} {'day' if days == 1 else 'days'}" if days >= 1 else format_period(self.window_s)
        size = f"{self.size:.2g} +- {self.sigma:.1g}{per}"
        text = f"the parameter {self.parameter} wanders by {size} in 1 d: windows of {length} are best"
        return text + (f"; these data cannot tell it from {', '.join(self.alike)}" if self.alike else "")

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name; times in UTC."""
        kept = {key: value for key, value in vars(self).items() if key not in ("column", "window_blocks")}
        return kept | {"at": [f"{time_text(one)}Z" for one in self.at]}


@dataclass(frozen=True)
class Walk:
    """A random walk of a parameter.

    `row` and `day` are the variances of a row and of what a day adds to the walk, `day_sigma` the latter's
    error; `p` the chance of a constant parameter to look so, `clear` by how much likelier the walk makes the
    residual (its logarithm, twice) where the variance of a row is given.
    """

    row: float = 0.0
    day: float = 0.0
    day_sigma: float = 0.0
    p: float = 1.0
    clear: float = 0.0


def walk_covariance(start: Int64, end: Int64) -> Floats:
    """Return the covariance of a random walk's means over blocks; (block, block), days.

    Parameters
    ----------
    start, end : ndarray of int64, shape (block,)
        TT2000.
    """
    middle = (start / 2 + end / 2 - float(start[0])) / DAY
    # A mean over a block varies less than its middle.
    return np.minimum.outer(middle, middle) - np.diag((end - start) / (6.0 * DAY))


def fit_walk(matrix: Floats, scores: Floats, covariance: Floats, variance: float = 0.0) -> Walk:
    """Return the random walk of a parameter by restricted likelihood.

    Parameters
    ----------
    matrix : ndarray, shape (block, block)
        What the rest of the model leaves of the parameter's columns, one a block.
    scores : ndarray, shape (block,)
        Their products with the residual.
    covariance : ndarray, shape (block, block)
        Of the walk; see `walk_covariance`.
    variance : float
        Of a row, nT^2, for `Walk.clear`.
    """
    steps = np.linalg.cholesky(covariance)
    own, vectors = np.linalg.eigh(steps.T @ matrix @ steps)
    kept = own > WANDER_SETTINGS.least * max(float(own[-1]), 1e-300)
    if kept.sum() < 3:
        return Walk()
    own = own[kept]
    square = (vectors.T @ (steps.T @ scores))[kept] ** 2 / own
    ratios = np.logspace(-6.0, 6.0, WANDER_SETTINGS.ratios) / float(np.median(own))
    found = _log_likelihood(square[None], own, ratios)[0]
    none = float(_log_likelihood(square[None], own, np.zeros(1))[0, 0])
    best, ratio = int(np.argmax(found)), 2.0 * (float(found.max()) - none)
    if ratio <= 0.0:
        return Walk(row=float(square.mean()))

    def loss(power: float) -> float:
        return -float(_log_likelihood(square[None], own, np.exp([power]))[0, 0])

    low, high = np.log(ratios[[max(best - 1, 0), min(best + 1, ratios.size - 1)]])
    exact = float(np.exp(scipy.optimize.minimize_scalar(loss, bounds=(low, high), method="bounded").x))
    row = float(np.mean(square / (1.0 + exact * own)))
    # Fisher's information on both variances.
    whole = row * (1.0 + exact * own)
    slopes = np.stack([np.ones_like(own), own]) / whole
    sigma = float(np.sqrt(gram_inverse(0.5 * slopes @ slopes.T)[1, 1]))
    grown = 1.0 + ratios[:, None] * own
    clear = square @ (1.0 - 1.0 / grown).T / variance - np.log(grown).sum(axis=1) if variance else np.zeros(1)
    return Walk(row, exact * row, sigma, _chance(ratio, own, ratios), float(clear.max()))


def _log_likelihood(square: Floats, own: Floats, ratios: Floats) -> Floats:
    """Return the restricted log likelihood at each ratio, the row's variance at its best; (draw, ratio)."""
    grown = 1.0 + ratios[:, None] * own
    row = square @ (1.0 / grown).T / own.size
    return np.asarray(-0.5 * (own.size * np.log(np.maximum(row, 1e-300)) + np.log(grown).sum(axis=1)))


def _chance(ratio: float, own: Floats, ratios: Floats) -> float:
    """Return how often a constant parameter reaches a likelihood ratio, of what is common from few draws."""
    found = 1.0
    for few in (True, False):
        square = _drawn_squares(own.size, few)
        drawn = _log_likelihood(square, own, ratios).max(axis=1)
        drawn -= _log_likelihood(square, own, np.zeros(1))[:, 0]
        found = float((1 + np.sum(2.0 * drawn >= ratio)) / (1 + len(drawn)))
        if found > WANDER_SETTINGS.common:
            break
    return found


@lru_cache(maxsize=4)
def _drawn_squares(size: int, few: bool) -> Floats:
    """Return squares of normal deviates, the first draws or the many that follow them; (draw, size)."""
    generator = np.random.default_rng(WANDER_SETTINGS.seed)
    first = generator.standard_normal((WANDER_SETTINGS.first_draws, size))
    deviates = first if few else generator.standard_normal((WANDER_SETTINGS.draws, size))
    return np.asarray(deviates**2)


@dataclass(frozen=True)
class BlockScores:
    """What a state of the search leaves of each parameter, block by block.

    Attributes
    ----------
    search : Search
    """

    search: Search

    @property
    def parameters(self) -> list[str]:
        """Columns of everything that may depend on time and can be added so."""
        return [
            name
            for name in self.search.time_variable.names
            if not isinstance(self.search.library.by_key[name.rpartition(".")[0]].entry.effect, Affine)
        ]

    @cached_property
    def names(self) -> list[str]:
        """The calibration's columns, the model's, and constants of parameters that neither has."""
        base, model = self.search.base()[0], self.search.model_columns()
        return list(dict.fromkeys([*base, *model, *self.parameters]))

    @cached_property
    def _products(self) -> Floats:
        raw = self.search.raw
        places = np.append(raw.index(self.names), raw.residuals[self.search.residual])
        return np.asarray(raw.rows(places, places))

    @cached_property
    def _inverses(self) -> list[Floats]:
        """Inverse of the calibration's own matrix in each interval."""
        base = len(self.search.base()[0])
        prior = np.diag(self.search.precision(self.search.raw, *self.search.base()))
        return [
            gram_inverse(self._products[group, :base, :base].sum(axis=0) + prior)
            for group in self.search.intervals
        ]

    @cached_property
    def _across(self) -> tuple[Floats, Floats]:
        """What the calibration leaves of products with model and residual (block, column, other); sums."""
        base = len(self.search.base()[0])
        left = self._products[:, :, base:].copy()
        for group, inverse in zip(self.search.intervals, self._inverses, strict=True):
            fitted = inverse @ self._products[group, :base, base:].sum(axis=0)
            left[group] -= self._products[group, :, :base] @ fitted
        return left, left[:, base:].sum(axis=0)

    @cached_property
    def _model_inverse(self) -> Floats:
        _, whole = self._across
        base = self.names[len(self.search.base()[0]) :]
        present = self.search.present_in(self.search.raw)
        known = dict(zip(self.search.model_columns(), present.precision, strict=True))
        precision = np.array([known.get(name, 0.0) for name in base])
        return gram_inverse(whole[:-1, :-1] + np.diag(precision))

    def of(self, column: str) -> tuple[Floats, Floats]:
        """Return matrix (block, block) and scores (block,) of a parameter; see `fit_walk`."""
        base, place = len(self.search.base()[0]), self.names.index(column)
        matrix = np.diag(self._products[:, place, place])
        for group, inverse in zip(self.search.intervals, self._inverses, strict=True):
            own = self._products[group, place, :base]
            matrix[np.ix_(group, group)] -= own @ inverse @ own.T
        left, whole = self._across
        model, scores = left[:, place, :-1], left[:, place, -1]
        fitted = model @ self._model_inverse
        return matrix - fitted @ model.T, scores - fitted @ whole[:-1, -1]


def parameters_in_time(search: Search) -> tuple[list[InTime], InTime | None]:
    """Return how each parameter depends on time beside the model, and the clearest one if it wanders.

    Only the clearest of those that chance does not make is held against other forms: what it does may be in
    the scores of others.
    """
    blocks, raw = BlockScores(search), search.raw
    found, walks = [], {}
    if len(raw) < search.rules.blocks:
        return [], None
    covariance = walk_covariance(raw.start, raw.end)
    taken = {source for one in search.accepted if one.change and one.change.windows for source in one.sources}
    for column in [one for one in blocks.parameters if one not in taken]:
        walk = fit_walk(*blocks.of(column), covariance, search.variance)
        scale = float(raw.scale[raw.index([column])[0]])
        size = float(np.sqrt(walk.day))
        walks[column] = walk
        found.append(
            InTime(
                parameter=column.rsplit(".", 1)[-1],
                p=walk.p,
                size=size * scale,
                sigma=walk.day_sigma / (2.0 * size) * scale if size > 0 else 0.0,
                column=column,
            )
        )
    unlikely = [one for one in found if one.p * len(found) < WANDER_SETTINGS.chance]
    if not unlikely:
        return found, None
    clearest = max(unlikely, key=lambda one: walks[one.column].clear)
    told = _with_form(search, clearest, blocks, covariance, WANDER_SETTINGS.chance / len(found))
    if told.form == "irregular":
        told = replace(told, alike=_alike(search, told, [one for one in unlikely if one is not clearest]))
    return [told if one is clearest else one for one in found], told if told.form == "irregular" else None


def _with_form(search: Search, one: InTime, blocks: BlockScores, covariance: Floats, chance: float) -> InTime:
    """Return a parameter with the simplest form beside which chance makes what is left of a walk.

    It must take enough off of held-out blocks; of windows, those that leave least of them are the best.
    """
    matrix, scores = blocks.of(one.column)
    days = (search.raw.start / 2 + search.raw.end / 2 - float(search.raw.start[0])) / DAY
    edges = _step_edges(matrix, scores)
    after = np.tri(len(days))[:, edges]
    simple: list[tuple[str, Floats, tuple[int, ...]]] = [("drift", days[:, None], ())]
    simple += [("steps", after[:, :count], tuple(edges[:count])) for count in range(1, len(edges) + 1)]
    for form, functions, at in simple:
        if fit_walk(*_beside(matrix, scores, functions), covariance).p >= chance:
            change = Change(form, form, "unknown", _functions(form, one.column, functions))
            told = _held_out(search, one, [(change, 0)])
            times = tuple(int(search.raw.start[edge]) for edge in sorted(at))
            return replace(told, at=times) if told.form == form else told
    windows = [(windows_of(search, one, width), width) for width in WANDER_SETTINGS.windows]
    return _held_out(search, one, [tried for tried in windows if len(tried[0].functions) > 1])


def _functions(form: str, column: str, functions: Floats) -> dict[str, tuple[str, Floats]]:
    return {f"{form}.{place}": (column, factor) for place, factor in enumerate(functions.T)}


def _beside(matrix: Floats, scores: Floats, functions: Floats) -> tuple[Floats, Floats]:
    """Return matrix and scores of a parameter beside functions (block, function) of it."""
    across = matrix @ functions
    fitted = across @ gram_inverse(functions.T @ across)
    return matrix - fitted @ across.T, scores - fitted @ (functions.T @ scores)


def _held_out(search: Search, one: InTime, forms: Sequence[tuple[Change, int]]) -> InTime:
    """Return a parameter with the form of some that leaves least of held-out blocks; constant when all do."""
    apart, rules = _scores(search, [change for change, _ in forms]), search.rules
    best = int(np.argmin(apart.loss.sum(axis=0)))
    if not (apart.gain[best] > rules.gain and apart.t[best] > rules.t):
        return one
    change, width = forms[best]
    runs = _scores(search, [change], interleaved=False)
    return replace(
        one,
        form="irregular" if width else change.name,
        gain=float(apart.gain[best]),
        t=float(apart.t[best]),
        contiguous_gain=float(runs.gain[0]),
        window_blocks=width,
        window_s=width * block_length(search.raw) / SECOND,
    )


def _scores(search: Search, changes: Sequence[Change], interleaved: bool = True) -> Scores:
    """Return how changes of parameters follow held-out blocks: every k-th of them, or runs of them."""
    base, own = search.base()[0], search.model_columns()
    functions = {name: source for change in changes for name, source in change.functions.items()}
    sources = [source for source, _ in functions.values()]
    core = search.raw.select(list(dict.fromkeys([*base, *own, *sources])))
    calibrated = CalibratedBlocks(core, base, search.intervals, search.precision(core, *search.base()))
    grams = TimedGrams.of(calibrated, own, functions)
    columns = [grams.index(list(change.functions)) for change in changes]
    y, present = grams.residuals[0], search.present_in(grams)
    return score(grams, present, columns, y, make_folds(len(grams), interleaved))


def _alike(search: Search, one: InTime, others: Sequence[InTime]) -> tuple[str, ...]:
    """Return parameters by which windows as long leave no clearly more of held-out blocks, as of rivals."""

    def loss(each: InTime) -> Floats:
        # One after the other: a record of years has hundreds of windows.
        return _scores(search, [windows_of(search, each, one.window_blocks)]).loss

    least = loss(one)
    return tuple(each.parameter for each in others if hac_t(loss(each) - least)[0] < search.rules.rival_t)


def _step_edges(matrix: Floats, scores: Floats) -> list[int]:
    """Return the edges of blocks at which steps explain most, one after the other."""
    after = np.tri(len(scores))[:, 1:]
    products, right = after.T @ matrix @ after, after.T @ scores
    edges: list[int] = []
    for _ in range(min(WANDER_SETTINGS.steps, right.size)):
        inner = np.diagonal(products)
        clear = inner > WANDER_SETTINGS.least * max(float(inner.max()), 1e-300)
        best = int(np.argmax(np.where(clear, right**2 / np.where(clear, inner, 1.0), -1.0)))
        if not clear[best]:
            break
        edges.append(best + 1)
        share = products[:, best] / inner[best]
        right = right - share * right[best]
        products = products - np.outer(share, products[best])
    return edges


def windows_of(search: Search, one: InTime, blocks: int) -> Change:
    """Return the change that gives a parameter a value in the middle of each window of so many blocks."""
    raw = search.raw
    told = replace(one, window_s=blocks * block_length(raw) / SECOND)
    basis = lines_between_windows(raw, blocks).basis(raw.start // 2 + raw.end // 2)
    functions = {f"{told.name}.k{place}": (one.column, factor) for place, factor in enumerate(basis.T)}
    return Change(told.name, f"wander({one.parameter})", "unknown", functions, windows=blocks)


def with_wander(
    search: Search, checks: Sequence[RivalCheck]
) -> tuple[Search, list[RivalCheck], list[InTime]]:
    """Return the state in which what wanders has a value a window, checks of its effects, and parameters.

    Steps and drifts that were taken stand in for what wanders when it leaves less of held-out blocks than
    they do: it takes their place.
    """
    if not search.rules.rounds:
        return search, list(checks), []
    lasting = [one for one in search.accepted if one.change is None]
    start = search.of_model(search.time_variable.names)
    state = start.with_accepted(lasting).with_safe_intervals()
    every, wandering = parameters_in_time(state)
    told: list[InTime] = []
    while wandering is not None and len(told) < WANDER_SETTINGS.parameters:
        told.append(wandering)
        state = state.add(_option(state, wandering))
        _, wandering = parameters_in_time(state)
    if not told or not _leaves_less(state, start):
        changes = [one.change for one in start.accepted if one.change is not None]
        return search, list(checks), _beside_changes(start, changes) if changes else every
    search = search.with_accepted(lasting).with_safe_intervals()
    kept = [one for one in checks if one.option.change is None]
    for one in told:
        option = _option(search, one)
        search = search.add(option).with_round("add", option, gain=one.gain, t=one.t, p=one.p)
        kept.append(
            RivalCheck(
                option=option, gain=one.gain, t=one.t, p=one.p, placebo_t=np.inf, form="raw", rivals=()
            )
        )
    names = {one.parameter: one for one in told}
    return search, kept, [names.get(one.parameter, one) for one in every]


def _beside_changes(search: Search, changes: Sequence[Change]) -> list[InTime]:
    """Return how parameters depend on time: by the drifts, steps and episodes that were taken, and beside."""
    forms: dict[str, tuple[str, tuple[int, ...]]] = {}
    for change in changes:
        columns = getattr(search.time_variable, change.mechanism.rsplit("_", 1)[0], ())
        forms |= dict.fromkeys(columns, ("steps" if change.at else "drift", change.at))
    return [
        replace(one, form=forms[one.column][0], at=forms[one.column][1]) if one.column in forms else one
        for one in parameters_in_time(search)[0]
    ]


def _option(search: Search, one: InTime) -> Option:
    change = windows_of(search, one, one.window_blocks)
    return Option(
        name=change.name,
        mechanism=change.mechanism,
        family=change.family,
        columns=tuple(change.functions),
        change=change,
    )


def _leaves_less(state: Search, other: Search) -> bool:
    """Return True when a state leaves clearly less of held-out blocks than another one."""
    if not any(one.change is not None for one in other.accepted):
        return True
    return other.held_out_t_worse_than(state) > state.rules.rival_t
