"""Lag, width, moment, interactions.

Lags between those of the bank: a response is a combination of its neighbours' responses.

A second look: fields that follow the product of two channels.

All pairs of all channels would be too many columns for every mission. When the rounds leave something
unexplained, the pairs of the most telling channels are made from the coarse series, with all their
products with every other column, and join the evidence as candidates like any other.

When exactly something changed: the moment of a step, begin and end of an episode, to a row of the series.

The search knows moments to a block. Beside everything else that was taken, a change of known size gains or
loses by every row it is moved over; the sum of these from row to row is what each moment would leave.

Forms of one effect tried on the coarse series: what each leaves beside everything else of the model.

The form of what was taken, before the next effect is sought: its lag, its width, its moment.

An effect in a form that is nearly right leaves a remnant that wrong companions would explain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.design import Rows, Term, design, within_span
from inflight.diagnosis.candidates import SLOW
from inflight.diagnosis.residual import (
    Material,
    correlation_s,
    joint_values,
    made_channels,
    model_columns,
    residual_left,
)
from inflight.diagnosis.scoring import Index, Present, folds_of, projected
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.time_changes import Change, moment_text
from inflight.errors import InflightError
from inflight.frames import GEOMETRY, SLOW_GEOMETRY
from inflight.lsq import GramBlocks, hac_t, inverse_square_root, jackknife, prewhiten, solve_scaled
from inflight.mission import sensors_of
from inflight.model import make_effect
from inflight.samples import Derived, parse
from inflight.time import DAY, SECOND, Int64, to_tt2000, to_utc

#: Angular frequencies a combination must be right at: from two days to a minute.
_SLOWEST, _FASTEST, _FREQUENCIES = 2 * np.pi / 172_800.0, 2 * np.pi / 60.0, 120

#: Lags the profile is drawn at, from a part of the bank's smallest to a multiple of its largest.
_GRID = 60


@lru_cache(maxsize=4096)
def _mixture(lag: float, bank: tuple[float, ...]) -> tuple[float, ...]:
    omega = np.geomspace(_SLOWEST, _FASTEST, _FREQUENCIES)
    known = 1.0 / (1.0 + 1j * omega[:, None] * np.asarray(bank)[None, :])
    wanted = 1.0 / (1.0 + 1j * omega * lag)
    rows = np.concatenate([known.real, known.imag]), np.concatenate([wanted.real, wanted.imag])
    return tuple(np.linalg.lstsq(rows[0], rows[1], rcond=1e-4)[0].tolist())


def mixture(lag: float, bank: Sequence[float]) -> Floats:
    """Return the weights of the bank's responses that together respond with another lag.

    Parameters
    ----------
    lag : float
        Seconds.
    bank : sequence of float
        Time constants of the columns there are, seconds; 0 is the channel itself.

    Returns
    -------
    ndarray, shape (bank,)
        Right to one to three hundredths of the response between neighbours of a bank whose lags grow
        three times a step, to seven where they grow four times.
    """
    return np.array(_mixture(float(lag), tuple(float(one) for one in bank)))


@dataclass(frozen=True)
class LagProfile:
    """How well each lag explains the residual.

    Attributes
    ----------
    lags : ndarray
        Seconds.
    left : ndarray
        Sum of squares left at each, nT^2 (in-sample).
    best, sigma : float
        The lag that leaves least and its jackknife error over folds of blocks, seconds.
    """

    lags: Floats
    left: Floats
    best: float
    sigma: float

    def as_json(self) -> dict[str, object]:
        """Return the fields as plain numbers."""
        return {
            "lags_s": self.lags.tolist(),
            "left_nT2": self.left.tolist(),
            "best_s": self.best,
            "sigma_s": self.sigma,
        }


def profile(
    evidence: GramBlocks,
    present: Present,
    bank: Mapping[float, Index],
    y: int,
    folds: Sequence[Index],
) -> LagProfile:
    """Return the profile of a response's lag.

    Parameters
    ----------
    bank : mapping of float to ndarray
        Lag in seconds -> its columns, the same number for each.
    folds : sequence of ndarray
        Blocks left out together for the error.
    """
    lags = np.array(sorted(bank))
    largest = float(lags[-1])
    smallest = float(lags[lags > 0][0]) if np.any(lags > 0) else 1.0
    grid = np.concatenate([[0.0], np.geomspace(smallest / 4.0, 1.5 * largest, _GRID)])
    columns = np.concatenate([bank[lag] for lag in lags])
    size = len(bank[lags[0]])
    mixed = np.array([mixture(lag, tuple(lags)) for lag in grid])

    def explained(gram: Floats) -> Floats:
        left = projected(gram, present)
        own = left[np.ix_(columns, columns)].reshape(lags.size, size, lags.size, size)
        cross = left[columns, y].reshape(lags.size, size)
        matrices = np.einsum("gi,iajb,gj->gab", mixed, own, mixed, optimize=True)
        half = inverse_square_root(matrices)
        return np.asarray(np.sum(np.einsum("gak,ga->gk", half, mixed @ cross) ** 2, axis=1))

    total = evidence.total
    whole = explained(total)
    others = [_peak(grid, explained(total - held)) for held in evidence.sums(folds)]
    best = _peak(grid, whole)
    sigma = float(jackknife(np.array(others)))
    base = float(projected(total, present)[y, y])
    return LagProfile(grid, base - whole, best, sigma)


def _peak(grid: Floats, explained: Floats) -> float:
    """Return the lag of the largest sum explained, by a parabola through its neighbours."""
    at = int(np.argmax(explained))
    if at == 0 or at == grid.size - 1:
        return float(grid[at])
    x, v = grid[at - 1 : at + 2], explained[at - 1 : at + 2]
    a, b, _ = np.polyfit(x - x[1], v, 2)
    return float(np.clip(x[1] - b / (2.0 * a), x[0], x[2])) if a < 0 else float(grid[at])


#: Channels that are paired: the most telling ones.
_CHANNELS, _PAIRS = 8, 60

#: A factor that varies by less than this part of its size is a constant.
_STEADY = 1e-3

#: Angles: a field may follow them, but no product with them means anything.
NO_FACTOR = frozenset({"longitude", "orbit_phase", "sun_phase", "local_time"})

#: Rows of the series at most: of longer records a user asks for a product by name.
MOST_ROWS = 400_000


def look_again(search: Search, material: Material, tables: Sequence[Table], unexplained: bool) -> bool:
    """Add products of channels to the search's candidates; return whether there were any.

    Parameters
    ----------
    unexplained : bool
        Something is left: all pairs of the most telling channels are tried. Else only pairs with a
        channel that was taken, because its field may depend on another channel.
    """
    if not can_join(search, material):
        return False
    known = {option.mechanism for option in search.options}
    terms = [
        term
        for one, other in _pairs(search, material, tables, unexplained)
        if (term := _product(material, one, other)) is not None and term.key not in known
    ]
    if not terms:
        return False
    join_terms(search, material, terms)
    for term in terms:
        channels = tuple(term.entry.effect.channels[0].split("*"))
        search.options.append(
            Option(term.key, term.key, "unknown", tuple(term.columns), channels, (term.key,))
        )
    return True


def join_terms(search: Search, material: Material, terms: Sequence[Term]) -> None:
    """Join the columns of new terms to the evidence and its forms, with their products with all others."""
    names = [name for term in terms for name in term.columns]
    scale = np.array([one for term in terms for one in term.scale])
    raw, white = _borders(search, material, terms)
    base, sigma = search.base()
    precision = search.precision(search.raw, base, sigma)
    for form, (source, groups) in search.sources().items():
        left = source.marginalised_border(base, groups, precision, *(white if form == "white" else raw))
        search.forms[form] = search.forms[form].bordered(names, scale, *left)
    search.raw = search.raw.bordered(names, scale, *raw)
    search.white = search.white.bordered(names, scale, *white)
    for term in terms:
        search.library.terms[term.key] = material.terms[term.key] = term


def can_join(search: Search, material: Material) -> bool:
    """Return True when columns can still be made: of long records the days' own equations are gone."""
    return search.within is None and len(material.series.tt2000) <= MOST_ROWS


def _pairs(
    search: Search, material: Material, tables: Sequence[Table], unexplained: bool
) -> list[tuple[str, str]]:
    """Return the pairs to try: a channel that was taken with every other one; of the telling ones all."""
    series = material.series
    scalars = [name for name in series.channels if series[name].ndim == 1 and _varies(series[name], name)]
    taken = [name for option in search.accepted for name in option.channels if name in scalars]
    pairs = [(one, other) for one in dict.fromkeys(taken) for other in scalars if other != one]
    if unexplained:
        pairs += combinations(telling_channels(search, material, tables), 2)
    first: dict[frozenset[str], tuple[str, str]] = {}
    for pair in pairs:
        first.setdefault(frozenset(pair), pair)
    return list(first.values())[:_PAIRS]


def _varies(values: Floats, name: str) -> bool:
    """Return True when a product with the channel is another thing than the other channel alone."""
    known = values[np.isfinite(values)]
    return name not in NO_FACTOR and known.size > 0 and bool(np.std(known) > _STEADY * np.abs(known).mean())


def telling_channels(search: Search, material: Material, tables: Sequence[Table]) -> list[str]:
    """Return the channels whose own effects explain most, by any round's scores; those taken come first."""
    there = set(material.series.channels)
    gains = {channel: np.inf for option in search.accepted for channel in option.channels if channel in there}
    for table in tables:
        scores = table.scores["raw"]
        for place, option in enumerate(table.options):
            if option.placebo or len(option.channels) != 1 or option.channels[0] not in there:
                continue
            name = option.channels[0]
            if material.series[name].ndim == 1 and scores.t[place] > 1.0:
                gains[name] = max(gains.get(name, 0.0), float(scores.gain[place]))
    scalars = [name for name in gains if material.series[name].ndim == 1]
    return sorted(sorted(scalars), key=lambda name: -gains[name])[:_CHANNELS]


def _product(material: Material, one: str, other: str) -> Term | None:
    sensors = sensors_of(material.mission, material.model.comparison)
    first = next(iter(material.series.features.sensors))
    entry = {"effect": "channel_field", "channel": f"{one}*{other}", "sensor": first}
    try:
        made = make_effect(entry, sensors, material.model.own, material.mission)
    except InflightError:
        return None
    return Term(f"channel_field({one}*{other})", made, ("coefficient",), (np.inf,) * 3)


def _wall(search: Search, material: Material, terms: Sequence[Term]) -> tuple[list[str], list[np.ndarray]]:
    """Return the names of the columns of all terms, and pieces of them on the coarse series.

    Pieces are (sample, row, column) float32. They are kept: each further column costs its own making only.
    """
    series = material.series
    known, kept = search.wall
    new = [term for term in [*search.library.all_terms, *terms] if not set(term.columns) <= set(known)]
    channels = {name for term in new for name in term.entry.effect.channels if name}
    rows = series.rows(material.turn, made_channels(series, channels, search.library.placebos))
    made = [design([term], rows).astype(np.float32) for term in new]
    search.wall = [*known, *(name for term in new for name in term.columns)], [*kept, *made]
    return search.wall


#: Products of new columns with every column there is, and with each other; (block, ...) each.
Border = tuple[Floats, Floats]


def _borders(search: Search, material: Material, terms: Sequence[Term]) -> tuple[Border, Border]:
    """Return the terms' products with all columns, raw and prewhitened."""
    series = material.series
    names, wall = _wall(search, material, terms)
    fresh = [name for term in terms for name in term.columns]
    places = [names.index(name) for name in fresh]
    residual = series["residual"].reshape(len(series.tt2000), -1, 1)
    grams = [np.zeros((len(search.raw), len(names) + 1, len(fresh))) for _ in range(2)]
    day = (series.tt2000 - series.tt2000[0]) // DAY
    for part in _runs(day):
        weight, stamps, block = series["weight"][part], series.tt2000[part], series.block[part]
        used = np.where((weight > 0)[:, None, None], np.nan_to_num(residual[part]), 0.0)
        columns = np.concatenate([*(piece[part] for piece in wall), used], axis=2)
        for gram, values in zip(
            grams, (columns, prewhiten(columns, weight, stamps, material.memory_s)), strict=True
        ):
            _add(gram, values, weight, block, places)
    changes = {
        name: told
        for option in search.accepted
        if option.change
        for name, told in option.change.functions.items()
    }
    return (
        _border(search.raw, grams[0], names, terms, changes),
        _border(search.white, grams[1], names, terms, changes),
    )


def _runs(day: np.ndarray) -> list[slice]:
    edges = [0, *(np.flatnonzero(np.diff(day)) + 1).tolist(), len(day)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _add(gram: Floats, values: Floats, weight: Floats, block: np.ndarray, places: list[int]) -> None:
    """Add products of all columns with the fresh ones, block by block; the residual stands last."""
    root = np.sqrt(weight)[:, None, None]
    scaled = values * root
    for one in np.unique(block):
        flat = scaled[block == one].reshape(-1, values.shape[2])
        gram[one] += flat.T @ flat[:, places]


def _border(
    evidence: GramBlocks,
    gram: Floats,
    names: Sequence[str],
    terms: Sequence[Term],
    changes: dict[str, tuple[str, Floats]],
) -> Border:
    """Return the fresh columns' products with those of the evidence, changes in time among them."""
    fresh = [name for term in terms for name in term.columns]
    places = {name: place for place, name in enumerate([*names, "residual"])}
    across = np.zeros((len(evidence), len(evidence.names), len(fresh)))
    for place, name in enumerate(evidence.names):
        source, factor = changes.get(name, (name, None))
        if source in places:
            piece = gram[:, places[source]]
            across[:, place] = piece if factor is None else piece * np.asarray(factor)[:, None]
    return across, gram[:, [places[name] for name in fresh]]


#: Size and moments are sought in turn, so many times at most.
_TURNS = 4

#: Moments are whole seconds where rows are at least so many seconds apart, else milliseconds.
_COARSE_S = 2.0

#: A moment that is known already is moved when it is off by more than this part of its error.
_NEAR_MOMENT = 0.5


def at_its_moment(search: Search, material: Material, option: Option) -> Option:
    """Return a step or an episode at the moment that leaves least; its columns join the evidence.

    Returns
    -------
    Option
        Its `change.sharpness` is the moment's standard deviation, the larger one of an episode's two. The
        option itself when it is a drift, or at that moment already.
    """
    change, carriers = option.change, _carriers(search, option)
    if change is None or not change.at or not carriers:
        return option
    at, sigma = _moments(search, material, option, carriers)
    moved = max(abs(new - old) for new, old in zip(at, change.at, strict=True))
    if option.terms and moved <= max(_NEAR_MOMENT * sigma, material.series.step_s * SECOND):
        return option
    made = _all_kinds(search, at, round(sigma))
    known = {one.name for one in search.options}
    terms = [_term(search, one) for one in made if one.name not in search.library.terms]
    if terms:
        join_terms(search, material, terms)
    search.options += [one for one in made if one.name not in known]
    return next(one for one in made if one.mechanism == option.mechanism)


def _all_kinds(search: Search, at: tuple[int, ...], sigma: int) -> list[Option]:
    """Return what may change at some moments: one at its moment must not be held against others at edges."""
    made = []
    form = "episode" if len(at) == 2 else "step"
    for kind, (family, carriers) in search.carriers.kinds.items():
        if form == "episode" and len(carriers) > 1:
            continue
        name = f"{kind}_{form}@{'/'.join(moment_text(one) for one in at)}"
        change = Change(name, f"{kind}_{form}", family, {}, at, sharpness=sigma)
        columns = tuple(dated_columns(_source(search, carriers), carriers, name))
        made.append(Option(name, change.mechanism, family, columns, terms=(name,), change=change))
    return made


def _carriers(search: Search, option: Option) -> tuple[str, ...]:
    found: tuple[str, ...] = getattr(search.carriers, option.mechanism.rsplit("_", 1)[0], ())
    return found


def _source(search: Search, carriers: tuple[str, ...]) -> Term:
    return next(term for term in search.library.all_terms if carriers[0] in term.columns)


def _term(search: Search, option: Option) -> Term:
    assert option.change is not None
    carriers = _carriers(search, option)
    return dated_term(_source(search, carriers), carriers, option.name, option.change.at)


def dated_term(source: Term, carriers: tuple[str, ...], name: str, at: tuple[int, ...]) -> Term:
    """Return the term of some columns of another one that hold from a moment on, or within a span."""
    suffixes = [one.removeprefix(f"{source.key}.") for one in carriers]
    parameters = tuple(dict.fromkeys(one.split("[")[0] for one in suffixes))
    size = sum(source.entry.effect.parameters()[one].size for one in parameters)
    return Term(name, source.entry, parameters, (np.inf,) * size, at)


def dated_columns(source: Term, carriers: tuple[str, ...], name: str) -> list[str]:
    """Return the columns of a dated term that are those of the carriers."""
    return [f"{name}.{one.removeprefix(f'{source.key}.')}" for one in carriers]


def _moments(
    search: Search, material: Material, option: Option, carriers: tuple[str, ...]
) -> tuple[tuple[int, ...], float]:
    """Return when a change begins, and ends if it does, TT2000, and the standard deviation, ns."""
    assert option.change is not None
    series, at = material.series, option.change.at
    beside, left, columns = _beside(search, material, option, carriers)
    noise = _noise(material, left)
    windows = [_window(search, option, place) for place in range(len(at))]
    sigma = 0.0
    for _ in range(_TURNS):
        inside = within_span(series.tt2000, at) & (series["weight"] > 0)
        if not inside.any():
            break
        flat = columns[inside].reshape(-1, columns.shape[2]), beside[inside].reshape(-1)
        with_it = beside - columns @ np.linalg.lstsq(*flat, rcond=None)[0]
        gained = np.sum(with_it**2 - beside**2, axis=1) * series["weight"]
        found = [
            _moment(series.tt2000, gained * (-1.0) ** place, window, noise)
            for place, window in enumerate(windows)
        ]
        before, at = at, tuple(_rounded(one[0], series.step_s) for one in found)
        sigma = max(one[1] for one in found)
        if at == before or (len(at) == 2 and at[0] >= at[1]):
            break
    return (
        (option.change.at, float(option.change.sharpness))
        if not sigma or list(at) != sorted(at)
        else (at, sigma)
    )


def _beside(
    search: Search, material: Material, option: Option, carriers: tuple[str, ...]
) -> tuple[Floats, Floats, Floats]:
    """Return the residual without and with an option, and its columns as if it held always.

    Each is (sample, row) or (sample, row, column).
    """
    rows, names, columns = model_columns(
        search, material.series, material.terms, material.turn, search.accepted
    )
    left = residual_left(search, material.series, material.terms, material.turn)
    taken = [name for one in search.accepted for name in one.columns]
    values, known = joint_values(search, taken)[0]
    value = dict(zip(known, values[len(values) - len(known) :], strict=True))
    own = columns[:, :, [names.index(name) for name in option.columns]]
    beside = left - own @ np.array([value[name] for name in option.columns])
    source = _source(search, carriers)
    every = design([source], rows)
    return beside, left, every[:, :, [source.columns.index(name) for name in carriers]]


def _noise(material: Material, left: Floats) -> float:
    """Return the variance of what a row adds to a sum over many, correlation with its neighbours counted."""
    series = material.series
    used = series["weight"] > 0
    memory = 2.0 * correlation_s(series, left) / series.step_s
    return float(np.mean(left[used] ** 2)) * max(memory, 1.0)


def _window(search: Search, option: Option, place: int) -> tuple[int, int]:
    """Return from when to when a moment may be: a block around it, or as far as it was known before."""
    assert option.change is not None
    at, raw = option.change.at, search.raw
    block = int(np.clip(np.searchsorted(raw.start, at[place], side="right") - 1, 0, len(raw) - 1))
    around = slice(max(block - 1, 0), block + 2)
    reach = max(option.change.sharpness, int(np.max(raw.end[around] - raw.start[around])))
    low, high = at[place] - reach, at[place] + reach
    if len(at) == 2:
        middle = at[0] + (at[1] - at[0]) // 2
        low, high = (low, min(high, middle)) if place == 0 else (max(low, middle), high)
    return low, high


def _moment(stamps: Int64, gained: Floats, window: tuple[int, int], noise: float) -> tuple[int, float]:
    """Return the median moment of those that leave little, and the root mean square of the others about it.

    Parameters
    ----------
    gained : ndarray, shape (sample,)
        By how much the residual's square grows when a row lies behind the moment, nT^2.
    noise : float
        Variance of a row, nT^2: it tells what is little.
    """
    first, last = np.searchsorted(stamps, window)
    places = np.arange(max(int(first), 1), min(int(last), len(stamps) - 1) + 1)
    if places.size < 2:
        return sum(window) // 2, (window[1] - window[0]) / np.sqrt(12.0)
    left = -np.concatenate([[0.0], np.cumsum(gained)])[places]
    width = (stamps[places] - stamps[places - 1]).astype(np.float64)
    offset = (stamps[places - 1] - stamps[0]) + 0.5 * width
    chance = width * np.exp(-(left - left.min()) / (2.0 * noise))
    chance /= chance.sum()
    passed = np.cumsum(chance)
    middle = int(np.searchsorted(passed, 0.5))
    part = (0.5 - passed[middle] + chance[middle]) / chance[middle]
    best = offset[middle] + (part - 0.5) * width[middle]
    spread = np.sum(chance * ((offset - best) ** 2 + width**2 / 12.0))
    return int(stamps[0]) + round(float(best)), float(np.sqrt(spread))


def _rounded(when: int, step_s: float) -> int:
    unit = "datetime64[s]" if step_s >= _COARSE_S else "datetime64[ms]"
    return int(to_tt2000(to_utc(when).astype(unit)))


class Trials:
    """Trials of forms of an option that the model holds; the option itself is taken off the model."""

    def __init__(self, search: Search, material: Material, option: Option) -> None:
        self.search, self.material = search, material
        self.series = material.series
        others = [one for one in search.accepted if one is not option and one.terms]
        keys = sorted({key for one in others for key in one.terms})
        kept = [*search.library.refined, *(material.terms[key] for key in keys)]
        self.rows = self._rows([*search.library.base, *kept])
        self.block = np.repeat(self.series.block, self.rows.residual.shape[1])
        self.root = np.sqrt(np.repeat(self.rows.weight, self.rows.residual.shape[1]))
        base = self._flat(search.library.base, self.rows)
        self.groups = [np.isin(self.block, np.asarray(group)) for group in search.intervals]
        self.basis = [np.linalg.qr(base[group])[0] for group in self.groups] if base.shape[1] else []
        self.y = self._absorbed((self.rows.residual.reshape(-1) * self.root)[:, None])[:, 0]
        self.model = self._absorbed(self._flat(kept, self.rows))
        self._known: dict[str, Floats] = {}

    def left(self, terms: Sequence[Term]) -> Floats:
        """Return what the terms together leave in each block; (block,) nT^2."""
        columns = np.concatenate([self.model, *(self._columns(term) for term in terms)], axis=1)
        value = solve_scaled(columns.T @ columns, columns.T @ self.y)
        rest = self.y - columns @ value
        return np.asarray(
            np.bincount(self.block, weights=rest**2, minlength=len(self.search.raw)), dtype=np.float64
        )

    def contribution(self, option: Option, terms: Sequence[Term]) -> tuple[Floats, Floats]:
        """Return the residual beside the rest of the model, without and with an option; (row,) nT, weighted.

        Parameters
        ----------
        option : Option
            Of the library, or a change in time: then `terms` are those whose columns change.
        """
        flat = self._flat(terms, self._rows(terms))
        if option.change is not None and option.change.functions:
            names = [name for term in terms for name in term.columns]
            flat = np.stack(
                [
                    flat[:, names.index(column)] * np.asarray(factor)[self.block]
                    for column, factor in option.change.functions.values()
                ],
                axis=1,
            )
        own = self._absorbed(flat)
        if self.model.shape[1]:
            inner = self.model.T @ self.model
            own -= self.model @ solve_scaled(inner, self.model.T @ own)
            before = self.y - self.model @ solve_scaled(inner, self.model.T @ self.y)
        else:
            before = self.y
        return before, before - own @ solve_scaled(own.T @ own, own.T @ before)

    def _columns(self, term: Term) -> Floats:
        if term.key not in self.material.terms:
            return self._absorbed(self._flat([term], self._rows([term])))
        if term.key not in self._known:
            self._known[term.key] = self._absorbed(self._flat([term], self._rows([term])))
        return self._known[term.key]

    def _rows(self, terms: Sequence[Term]) -> Rows:
        channels = {name for term in terms for name in term.entry.effect.channels if name}
        return self.series.rows(self.material.turn, made_channels(self.series, channels))

    def _flat(self, terms: Sequence[Term], rows: Rows) -> Floats:
        columns = design(terms, rows)
        return np.asarray(columns.reshape(len(self.root), columns.shape[2]) * self.root[:, None])

    def _absorbed(self, values: Floats) -> Floats:
        out = values.copy()
        for group, basis in zip(self.groups, self.basis, strict=False):
            out[group] -= basis @ (basis.T @ values[group])
        return out


def like(
    search: Search,
    material: Material,
    source: Term,
    key: str,
    options: dict[str, Any],
    parameters: Sequence[str],
) -> Term:
    """Return a term like another one with other options; everything of it is free."""
    given = {name: value for name, value in source.entry.effect.given.items() if name not in ("lag", "width")}
    wanted = {
        "effect": type(source.entry.effect).label(),
        "sensor": source.entry.sensor.name,
        **given,
        **options,
    }
    made = make_effect(
        wanted, sensors_of(material.mission, material.model.comparison), material.model.own, material.mission
    )
    size = sum(made.effect.parameters()[name].size for name in parameters)
    return Term(key, made, tuple(parameters), (np.inf,) * size)


#: A lag is refined when it is off by more than this part.
_NEAR = 0.02

#: Widths tried, as parts of the channel's range, and lags from this part of a row's spacing up to this, s.
_WIDTHS = np.geomspace(0.02, 0.9, 16)

_SHORTEST, _LONGEST, _RESPONSES = 0.5, 8000.0, 12

#: The channel itself stays beside its play when it helps by more than this t.
_NEEDED = 2.0


def refine(search: Search, material: Material, option: Option) -> Option:
    """Return the option in its best form; the option itself when the bank has it already.

    The new columns join the evidence, from the coarse series.
    """
    if not can_join(search, material):
        return option
    if option.change is not None:
        return at_its_moment(search, material, option)
    if not option.channels or set(option.channels) & search.library.unlagged:
        return option
    return _of_channel(search, material, option)


def _of_channel(search: Search, material: Material, option: Option) -> Option:
    if option.mechanism.startswith("hysteresis("):
        return _with_width(search, material, option)
    if option.mechanism.split("(")[0] in SLOW and len(option.channels) == 1:
        return _with_lag(search, material, option)
    if len(option.terms) == 1:
        return _with_response(search, material, option)
    return option


def _with_lag(search: Search, material: Material, option: Option) -> Option:
    """Return the option with the lag that explains most; without one when that is not clearly more."""
    source = search.library.terms[option.terms[0]]
    trials = Trials(search, material, option)

    def term(lag: float, key: str = "trial") -> Term:
        given = {"lag": f"{lag:g} s"} if lag else {}
        return like(search, material, source, key, given, source.parameters)

    def left(lag: float) -> Floats:
        return trials.left([term(lag)])

    best, sigma = _best_lag(search, material, left)
    if float(hac_t((left(0.0) - left(best))[:, None])[0]) < search.rules.t:
        plain = [one for one in search.options if one.mechanism == option.mechanism and one.lag_s == 0.0]
        return plain[0] if plain else option
    if abs(best - option.lag_s) <= _NEAR * best:
        return option
    return _joined(search, material, option, term(best, f"{option.mechanism}@lag={best:g}s"), best, sigma)


def _best_lag(
    search: Search, material: Material, left: Callable[[float], Floats]
) -> tuple[float, float | None]:
    """Return the lag that leaves least, s, and its error by leaving out folds of blocks."""
    lags = np.geomspace(_SHORTEST * material.series.step_s, _LONGEST, _RESPONSES)
    best = _least(lags, left, (0.7, 1.43))
    beside = best * np.array([0.9, 1.0, 1.0 / 0.9])
    each = np.stack([left(float(one)) for one in beside])
    total = each.sum(axis=1)
    folds = folds_of(each.shape[1])
    others = [_vertex(np.log(beside), total - each[:, fold].sum(axis=1)) for fold in folds]
    if not np.all(np.isfinite(others)):
        return best, None
    return best, best * float(jackknife(np.array(others)))


def _with_response(search: Search, material: Material, option: Option) -> Option:
    """Return an effect whose channel, or a factor of it, acts slowly, when that explains clearly more."""
    made = option
    parts = _channel_of(search.library.terms[option.terms[0]]).parts
    if any(part.channel not in material.series.channels or part.width for part in parts):
        return option
    for place, part in enumerate(parts):
        if part.channel not in GEOMETRY or part.channel in SLOW_GEOMETRY:
            made = _slower(search, material, option, made, place)
    return made


def _channel_of(term: Term) -> Derived:
    """Return the one channel an effect follows, as option `channel` may name it; without parts if none."""
    channel = term.entry.effect.given.get("channel")
    return parse(channel) if isinstance(channel, str) else Derived(())


def _slower(search: Search, material: Material, option: Option, now: Option, place: int) -> Option:
    """Return the option with the best lag of one factor of its channel; the present one if none is better."""
    source = search.library.terms[now.terms[0]]
    parts = list(_channel_of(source).parts)
    old = parts[place].lag_s
    trials = Trials(search, material, option)

    def term(lag: float, key: str) -> Term:
        parts[place] = replace(parts[place], lag_s=lag, text="")
        return like(search, material, source, key, {"channel": Derived(tuple(parts)).name}, source.parameters)

    def left(lag: float) -> Floats:
        return trials.left([term(lag, f"{option.mechanism}@trial")])

    best, sigma = _best_lag(search, material, left)
    if old and abs(best - old) <= _NEAR * old:
        return now
    before, after = trials.left([source]), left(best)
    gained = before - after
    worth = (
        float(hac_t(gained[:, None])[0]) > search.rules.t and gained.sum() > search.rules.gain * before.sum()
    )
    if not (worth or (old and gained.sum() > 0)):
        return now
    made = term(best, "")
    name = made.entry.effect.channels[0]
    key = (
        f"{option.mechanism}@lag={best:g}s"
        if len(parts) == 1
        else f"{type(made.entry.effect).label()}({name})"
    )
    return _joined(search, material, option, replace(made, key=key), best, sigma)


def _with_width(search: Search, material: Material, option: Option) -> Option:
    """Return the play of the best width, with the channel itself where it is needed."""
    trials = Trials(search, material, option)
    source = search.library.terms[option.terms[-1]]
    direct = [search.library.terms[option.terms[0]]] if len(option.terms) > 1 else []
    low, high = np.nanquantile(material.series[option.channels[0]], [0.02, 0.98])
    widths = _WIDTHS * float(high - low)

    def term(width: float, key: str) -> Term:
        return like(search, material, source, key, {"width": width}, ("play",))

    def left(width: float, beside: list[Term]) -> Floats:
        return trials.left([*beside, term(width, f"{option.mechanism}@trial")])

    alone = _least(widths, lambda width: left(width, []), (0.85, 1.18))
    width = _least(widths, lambda width: left(width, direct), (0.85, 1.18)) if direct else alone
    needed = bool(direct) and float(hac_t((left(alone, []) - left(width, direct))[:, None])[0]) > _NEEDED
    width = width if needed else alone
    key = f"{option.mechanism}@width={width:g}"
    made = _joined(search, material, option, term(width, key), 0.0)
    if not needed:
        return made
    whole = replace(made, terms=(direct[0].key, key), columns=(*direct[0].columns, *made.columns))
    search.options[-1] = whole
    return whole


def _least(grid: Floats, left: Callable[[float], Floats], around: tuple[float, float]) -> float:
    """Return where least is left: on the whole grid, then twice on finer ones around it; four digits."""
    best = 0.0
    for part in (1.0, 0.25, 0.0):
        best = _lowest(grid, np.array([left(float(one)).sum() for one in grid]))
        if part:
            grid = best * np.geomspace(*around, 7) ** part
    return float(f"{best:.4g}")


def _lowest(grid: Floats, sums: Floats) -> float:
    """Return where the sums are least, by a parabola in the logarithm."""
    at = int(np.argmin(sums))
    if at in (0, len(sums) - 1):
        return float(grid[at])
    x = np.log(grid[at - 1 : at + 2])
    found = _vertex(x, sums[at - 1 : at + 2])
    return float(np.exp(np.clip(found, x[0], x[2]))) if np.isfinite(found) else float(grid[at])


def _vertex(x: Floats, y: Floats) -> float:
    """Return where the parabola through three points is least; NaN when it opens downward."""
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2.0 * a)) if a > 0 else float("nan")


def _joined(
    search: Search,
    material: Material,
    option: Option,
    term: Term,
    lag: float,
    sigma: float | None = None,
) -> Option:
    """Return the option with another term, its columns in the evidence and it among the candidates."""
    made = replace(
        option, name=term.key, terms=(term.key,), columns=tuple(term.columns), lag_s=lag, lag_sigma_s=sigma
    )
    if term.key not in search.library.terms:
        join_terms(search, material, [term])
    search.options.append(made)
    return made
