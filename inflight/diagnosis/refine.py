"""The best form of what was taken, before the next effect is sought: lag, width, time.

Takes a state of the search, its `DiagnosisData` with the coarse series, and an option of the model; makes the
next state, in which the option has its best form (`refine`). An effect in a form that is nearly right leaves
a remnant that wrong companions would explain (MISSING_EFFECT, failure F3).

Forms are tried on the coarse series: what each leaves when everything else of the model is fitted with it
(`FormTrials`). The columns of the best one join the Gram blocks with their products with every other column
(`join_terms`). The best lag or width is the vertex of a parabola; its error is a jackknife over folds of
blocks.

The time of a step or an episode (`refine_change_time`): a change of known size gains or loses by every row
it is moved over; the sum of these from row to row is what each time would leave. With the noise of a row
that makes the posterior of the time, whose median and standard deviation are returned.

A lag between two of the bank is a combination of their responses (`lag_weights`); `profile_lag` returns how
well each lag explains the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.design import HeldNumber, Term, design_matrix, within_span
from inflight.diagnosis.candidates import SLOW
from inflight.diagnosis.model_numbers import difference_of
from inflight.diagnosis.residual import (
    DiagnosisData,
    correlation_s,
    derived_channels,
    iter_model_columns,
    joint_values,
    remaining_residual,
)
from inflight.diagnosis.scoring import Index, ModelColumns, make_folds, project_out
from inflight.diagnosis.search import Border, CachedDesign, Option, Search
from inflight.diagnosis.series import Series
from inflight.diagnosis.time_changes import Change, time_text
from inflight.frames import GEOMETRY, SLOW_GEOMETRY
from inflight.lsq import (
    LEAST_KEPT,
    GramArrays,
    GramBlocks,
    hac_t,
    in_turns,
    inverse_square_root,
    jackknife,
    prewhiten,
    solve_scaled,
)
from inflight.mission import sensors_of
from inflight.model import make_effect
from inflight.samples import DerivedChannel, parse_channel
from inflight.time import DAY, SECOND, Int64, to_tt2000, to_utc


@dataclass(frozen=True, kw_only=True)
class LagSettings:
    """How the lag of a response is found.

    Attributes
    ----------
    slowest, fastest, frequencies : float, float, int
        Angular frequencies a combination of the bank's responses must be right at, from two days to a minute,
        1/s, and how many of them; assumed: the band of thermal responses.
    cutoff : float
        Singular values of the bank below this part of the largest are no information; assumed.
    profile : int
        Lags a profile is drawn at.
    lower, upper : float
        The profile goes from this part of the bank's smallest lag to so many times its largest; assumed.
    shortest, longest : float, float
        Lags tried on the series: from this part of a row's spacing, up to this, s; assumed: a body that warms
        for two hours.
    tried : int
        Lags of the first grid; finer ones follow around its best.
    fewest, close, around : int, int, float
        Where the bank has so many lags, their Gram blocks say about which lag is best, and only so many are
        tried first, from one part in `around` of it to `around` times it: wider than the bank's combinations
        are wrong.
    bracket : tuple of float
        Range of the finer grids, as parts of the best lag: one step of the first grid to both sides.
    spread : float
        Neighbours of the best lag that the jackknife's parabola is fitted to, as a part of it; assumed.
    near : float
        A lag that is off by no more than this part stays as it is; assumed: less than the usual error.
    """

    slowest: float = 2 * np.pi / 172_800.0
    fastest: float = 2 * np.pi / 60.0
    frequencies: int = 120
    cutoff: float = 1e-4
    profile: int = 60
    lower: float = 0.25
    upper: float = 1.5
    shortest: float = 0.5
    longest: float = 8000.0
    tried: int = 12
    fewest: int = 3
    close: int = 5
    around: float = 2.0
    bracket: tuple[float, float] = (0.7, 1.43)
    spread: float = 0.9
    near: float = 0.02


@dataclass(frozen=True, kw_only=True)
class WidthSettings:
    """How the width of a play (hysteresis) is found.

    Attributes
    ----------
    quantiles : tuple of float
        They bound the channel's range.
    narrowest, widest, tried : float, float, int
        Widths of the first grid, as parts of that range; assumed.
    bracket : tuple of float
        Range of the finer grids, as parts of the best width.
    needed_t : float
        The channel itself stays in the model with its play when it helps by more than this t: two sigma.
    """

    quantiles: tuple[float, float] = (0.02, 0.98)
    narrowest: float = 0.02
    widest: float = 0.9
    tried: int = 16
    bracket: tuple[float, float] = (0.85, 1.18)
    needed_t: float = 2.0


@dataclass(frozen=True, kw_only=True)
class ChangeTimeSettings:
    """How the time of a change is found.

    Attributes
    ----------
    iterations : int
        Size and time are found in turn, so many times at most.
    coarse_s : float
        Times are whole seconds where rows are at least so many seconds apart, else milliseconds.
    near : float
        A time that is known already is moved when it is off by more than this part of its error; assumed.
    """

    iterations: int = 4
    coarse_s: float = 2.0
    near: float = 0.5


@dataclass(frozen=True, kw_only=True)
class DesignSettings:
    """How columns are made of the coarse series: bounds on memory and time, assumed.

    Attributes
    ----------
    kept, part : int
        Numbers that all columns of the series may hold to be kept for later, and those that are made at once
        where they may not.
    before_days : int
        Slow responses begin so long before a part: many times the longest lag.
    margin : int
        Rows around a part that rates of change need.
    most_rows : int
        Rows of the series at most: in longer records the best of the bank's forms stands.
    """

    kept: int = 20_000_000
    part: int = 10_000_000
    before_days: int = 3
    margin: int = 4
    most_rows: int = 450_000


@dataclass(frozen=True, kw_only=True)
class NumberSettings:
    """How the value of a number that the model holds is found.

    Attributes
    ----------
    tried : int
        Values of a lag or a width to begin with; assumed.
    narrowest : float
        The smallest width tried, as a part of the largest.
    turns : tuple of float
        Turns of panels to begin with, as parts of the largest; assumed.
    steps : int
        Gauss and Newton's steps at most.
    parts : tuple of float
        Parts of a step that are tried until one leaves less.
    settled : float
        It has settled when a step is below this part of what its derivative is made over.
    near : float
        A value that is off by no more than this part of its error stays as it is; assumed.
    """

    tried: int = 9
    narrowest: float = 0.02
    turns: tuple[float, ...] = (-0.5, -0.25, -0.1, 0.1, 0.25, 0.5)
    steps: int = 8
    parts: tuple[float, ...] = (1.0, 0.5, 0.2, 0.05)
    settled: float = 0.01
    near: float = 0.3


LAG_SETTINGS = LagSettings()
WIDTH_SETTINGS = WidthSettings()
CHANGE_TIME_SETTINGS = ChangeTimeSettings()
NUMBER_SETTINGS = NumberSettings()
DESIGN_SETTINGS = DesignSettings()

#: Angles: a field may follow them, but no product with them means anything.
ANGLES = frozenset({"longitude", "orbit_phase", "sun_phase", "local_time"})

#: The next state of the search, and the option in its new form.
Refined = tuple[Search, Option]


def refine(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return the state with the best form of an option, and that form.

    Both are as they were when the bank has the best form already. New columns come from the coarse
    series; the model still holds the option itself (see `Search.exchange`).
    """
    if not can_add_columns(search, data):
        return _with_lag(search, data, option) if _has_bank(search, option) else (search, option)
    if option.change is not None or option.number:
        special = with_value if option.number else refine_change_time
        return special(search, data, option)
    if not option.channels or set(option.channels) & search.library.unlagged:
        return search, option
    if option.mechanism.startswith("hysteresis("):
        return _with_width(search, data, option)
    if option.mechanism.split("(")[0] in SLOW and len(option.channels) == 1:
        return _with_lag(search, data, option)
    return _with_response(search, data, option) if len(option.terms) == 1 else (search, option)


# Numbers that the model holds.


def with_value(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return the option of a held number with its best value; its column is all that this value changes.

    What moves the number out of its plausible range is no explanation: its options are gone then, unless
    the model has it already.
    """
    term = search.library.by_key[option.terms[0]]
    assert term.difference is not None
    number = term.difference.number
    found = _best_value(FormTrials(search, data, option), data, number)
    if found is None:
        return (
            (search, option) if option in search.accepted else (search.without_options(option.name), option)
        )
    value, sigma = found
    known = term.difference.between[1] if option.number_sigma else None
    if known is not None and abs(value - known) < NUMBER_SETTINGS.near * sigma:
        return search, option
    made = difference_of(
        number, data.linearised, data.mission, value, f"{number.name}@{value:.6g}{number.unit}"
    )
    exact = replace(option, name=made.key, terms=(made.key,), columns=tuple(made.columns), number_sigma=sigma)
    if made.key not in search.library.terms:
        search = join_terms(search, data, [made])
    return search.without_options(option.mechanism).with_options([exact]), exact


@dataclass(frozen=True)
class _NumberTrials:
    """What other values of a number leave of the residual: each changes a known amount, unscaled."""

    trials: FormTrials
    data: DiagnosisData
    number: HeldNumber

    def rest(self, value: float) -> Floats:
        """Return the residual that a value leaves; (row,) nT, weighted."""
        rest: Floats = self.trials.rest
        if value != self.number.value:
            term = difference_of(self.number, self.data.linearised, self.data.mission, value, "trial")
            rest = rest + self.trials.columns(term)[0]
        return rest

    def slope(self, value: float) -> Floats:
        """Return its change by one unit of the number; (row,)."""
        term = difference_of(self.number, self.data.linearised, self.data.mission, key="slope", around=value)
        slope: Floats = self.trials.columns(term)[0] / term.scale[0]
        return slope

    def descend(self, value: float) -> float:
        """Return where Gauss and Newton's steps end that begin at a value."""
        rest = self.rest(value)
        for _ in range(NUMBER_SETTINGS.steps):
            tangent = self.slope(value)
            step = -float(tangent @ rest) / max(float(tangent @ tangent), 1e-300)
            for part in NUMBER_SETTINGS.parts:
                at = float(np.clip(value + part * step, *self.number.bounds))
                other = self.rest(at)
                if other @ other < rest @ rest:
                    break
            else:
                break
            moved, value, rest = abs(at - value), at, other
            if moved < NUMBER_SETTINGS.settled * self.number.step:
                break
        return value

    def error(self, value: float) -> float:
        """Return the error of the best value: a jackknife over folds of blocks."""
        tangent, rest = self.slope(value), self.rest(value)
        right, inner = (
            np.bincount(self.trials.block, weights=tangent * one, minlength=self.trials.blocks)
            for one in (rest, tangent)
        )
        steps = [
            (right.sum() - right[fold].sum()) / (inner.sum() - inner[fold].sum())
            for fold in make_folds(self.trials.blocks)
        ]
        return float(jackknife(np.array(steps)))


def _best_value(trials: FormTrials, data: DiagnosisData, number: HeldNumber) -> tuple[float, float] | None:
    """Return the value of a number that leaves least, and its error; None out of its plausible range.

    Of values all over that range the best one is where the search for the least begins.
    """
    own = _NumberTrials(trials, data, number)
    tried = {one: float(np.sum(own.rest(one) ** 2)) for one in [number.value, *_values_to_try(number)]}
    value = own.descend(min(tried, key=lambda one: tried[one]))
    low, high = number.bounds
    if not low < value < high or not float(np.sum(own.rest(value) ** 2)) < tried[number.value]:
        return None
    return float(f"{value:.6g}"), own.error(value)


def _values_to_try(number: HeldNumber) -> list[float]:
    """Return values a number may have far from the one that is held: lags and widths, by factors; turns."""
    if number.key.startswith("turn"):
        return [part * number.bounds[1] for part in NUMBER_SETTINGS.turns]
    if number.key not in ("lag", "width"):
        return []
    low = number.step if number.key == "lag" else NUMBER_SETTINGS.narrowest * number.bounds[1]
    return [float(one) for one in np.geomspace(low, 0.9 * number.bounds[1], NUMBER_SETTINGS.tried)]


# Lags and widths.


def _with_lag(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return the option with the lag that explains most; without one when that is not clearly more."""
    source = search.library.terms[option.terms[0]]
    trials = FormTrials(search, data, option)

    def term(lag: float, key: str = "trial") -> Term:
        given = {"lag": f"{lag:g} s"} if lag else {}
        return similar_term(data, source, key, given, source.parameters)

    def loss(lag: float) -> Floats:
        return trials.loss([term(lag)])

    best, sigma = best_lag(search, data, loss, _lag_of_bank(search, option))
    if float(hac_t((loss(0.0) - loss(best))[:, None])[0]) < search.rules.t:
        plain = [one for one in search.options if one.mechanism == option.mechanism and one.lag_s == 0.0]
        return search, plain[0] if plain else option
    if abs(best - option.lag_s) <= LAG_SETTINGS.near * best:
        return search, option
    return _with_term(search, data, option, term(best, f"{option.mechanism}@lag={best:g}s"), best, sigma)


def error_by_lag(search: Search, data: DiagnosisData, option: Option, lag_sigma: float) -> Floats | None:
    """Return by how much an error of the lag moves an effect's values; (column,), physical units.

    Half of the difference between the values at both ends of the lag's error, everything else fitted with
    them. None where the effect has no lag of its own, or the series cannot make its columns.
    """
    plain = len(option.terms) == 1 and option.change is None and option.lag_s > lag_sigma > 0
    if not plain or not can_add_columns(search, data):
        return None
    source = search.library.by_key[option.terms[0]]
    if len(_channel_of(source).parts) > 1:
        return None
    trials, ends = FormTrials(search, data, option), []
    for place, lag in enumerate((option.lag_s - lag_sigma, option.lag_s + lag_sigma)):
        columns = trials.columns(term_at_lag(data, source, f"end {place}", lag))
        ends.append(solve_scaled(columns @ columns.T, columns @ trials.rest))
    return np.asarray(np.abs(ends[1] - ends[0]) / 2.0 * np.array(source.scale))


def term_at_lag(data: DiagnosisData, source: Term, key: str, lag: float) -> Term:
    """Return the term of a lagged effect of one channel with another lag, s."""
    parts = _channel_of(source).parts
    given: dict[str, Any] = {"lag": f"{lag:g} s"}
    if parts and parts[0].lag_s:
        given = {"channel": replace(parts[0], lag_s=lag, text="").name}
    return similar_term(data, source, key, given, source.parameters)


def bank_of(search: Search, option: Option) -> dict[float, Index]:
    """Return the columns (of the raw form) of every lag that an option's mechanism has; lag in s."""
    form = search.forms["raw"]
    return {
        other.lag_s: form.index(other.columns)
        for other in search.options
        if other.mechanism == option.mechanism and len(other.columns) == len(option.columns)
    }


def _has_bank(search: Search, option: Option) -> bool:
    """Return True for an effect of one slow channel whose mechanism has enough lags to combine."""
    is_slow = option.mechanism.split("(")[0] in SLOW and len(option.channels) == 1
    if option.change is not None or not is_slow or set(option.channels) & search.library.unlagged:
        return False
    return len(bank_of(search, option)) >= LAG_SETTINGS.fewest


def _lag_of_bank(search: Search, option: Option) -> float | None:
    """Return about which lag explains most, by the Gram blocks alone; None when the bank is too small."""
    if not _has_bank(search, option):
        return None
    bank = bank_of(search, option)
    form, present = search.forms["raw"], search.present("raw", option)
    blocks, own, places, y = _of_lags(form, present, bank, search.y())
    return peak_of(*scan_lags(blocks.sum(axis=0), own, places, y))


def best_lag(
    search: Search, data: DiagnosisData, loss: Callable[[float], Floats], about: float | None = None
) -> tuple[float, float | None]:
    """Return the lag that leaves least, s, and its error by leaving out folds of blocks.

    Parameters
    ----------
    about : float, optional
        About which lag that is; all lags are tried when it is absent, or when the best is not around it.
    """
    low, high, loss = LAG_SETTINGS.shortest * data.series.step_s, LAG_SETTINGS.longest, cache(loss)
    grid, parts = np.geomspace(low, high, LAG_SETTINGS.tried), _FINER
    if about is not None:
        middle = min(max(about, low), high)
        close = middle * np.geomspace(1.0 / LAG_SETTINGS.around, LAG_SETTINGS.around, LAG_SETTINGS.close)
        close = np.append(low, close[close > low]) if about <= low else close[close <= high]
        at = int(np.argmin([loss(float(lag)).sum() for lag in close]))
        if at == 0 and about <= low and loss(0.0).sum() <= loss(float(low)).sum():
            return float(low), None
        # No lag is below the shortest: the least may lie there.
        if (0 if about <= low else 1) <= at < close.size - 1:
            grid, parts = close, _FINER[1:]
    best = _minimise(grid, loss, LAG_SETTINGS.bracket, parts)
    near = best * np.array([LAG_SETTINGS.spread, 1.0, 1.0 / LAG_SETTINGS.spread])
    each = np.stack([loss(float(one)) for one in near])
    total = each.sum(axis=1)
    folds = make_folds(each.shape[1])
    others = [_vertex(np.log(near), total - each[:, fold].sum(axis=1)) for fold in folds]
    if not np.all(np.isfinite(others)):
        return best, None
    return best, best * float(jackknife(np.array(others)))


def _with_response(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return an effect whose channel, or a factor of it, acts slowly, when that explains clearly more."""
    made = option
    parts = _channel_of(search.library.terms[option.terms[0]]).parts
    if any(part.channel not in data.series.channels or part.width for part in parts):
        return search, option
    for place, part in enumerate(parts):
        if part.channel not in GEOMETRY or part.channel in SLOW_GEOMETRY:
            search, made = _with_slow_factor(search, data, option, made, place)
    return search, made


def _channel_of(term: Term) -> DerivedChannel:
    """Return the one channel an effect follows, as option `channel` may name it; without parts if none."""
    channel = term.entry.effect.given.get("channel")
    return parse_channel(channel) if isinstance(channel, str) else DerivedChannel(())


def _with_slow_factor(
    search: Search, data: DiagnosisData, option: Option, now: Option, place: int
) -> Refined:
    """Return the option with the best lag of one factor of its channel; `now` if none is better."""
    source = search.library.terms[now.terms[0]]
    parts = list(_channel_of(source).parts)
    old = parts[place].lag_s
    trials = FormTrials(search, data, option)

    def term(lag: float, key: str) -> Term:
        parts[place] = replace(parts[place], lag_s=lag, text="")
        channel = DerivedChannel(tuple(parts)).name
        return similar_term(data, source, key, {"channel": channel}, source.parameters)

    def loss(lag: float) -> Floats:
        return trials.loss([term(lag, f"{option.mechanism}@trial")])

    best, sigma = best_lag(search, data, loss)
    if old and abs(best - old) <= LAG_SETTINGS.near * old:
        return search, now
    before, after = trials.loss([source]), loss(best)
    gained = before - after
    clear = (
        float(hac_t(gained[:, None])[0]) > search.rules.t and gained.sum() > search.rules.gain * before.sum()
    )
    if not (clear or (old and gained.sum() > 0)):
        return search, now
    made = term(best, "")
    name = made.entry.effect.channels[0]
    key = (
        f"{option.mechanism}@lag={best:g}s"
        if len(parts) == 1
        else f"{type(made.entry.effect).label()}({name})"
    )
    return _with_term(search, data, option, replace(made, key=key), best, sigma)


def _with_width(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return the play of the best width, with the channel itself where it is needed."""
    trials = FormTrials(search, data, option)
    source = search.library.terms[option.terms[-1]]
    direct = [search.library.terms[option.terms[0]]] if len(option.terms) > 1 else []
    low, high = np.nanquantile(data.series[option.channels[0]], WIDTH_SETTINGS.quantiles)
    widths = np.geomspace(WIDTH_SETTINGS.narrowest, WIDTH_SETTINGS.widest, WIDTH_SETTINGS.tried) * float(
        high - low
    )

    def term(width: float, key: str) -> Term:
        return similar_term(data, source, key, {"width": width}, ("play",))

    channel = [trials.columns(one) for one in direct]
    first = set(widths.tolist())
    known: dict[tuple[float, bool], Floats] = {}

    def loss(width: float, whole: bool) -> Floats:
        """Return what the play leaves in each block, by itself or with the channel (`whole`)."""
        if (width, whole) not in known:
            own = trials.columns(term(width, f"{option.mechanism}@trial"))
            # Both are asked for at every width of the first grid: its columns are made once.
            for one in {False, bool(channel)} if width in first else {whole}:
                known[width, one] = trials.remaining([*channel, own] if one else [own])
        return known[width, whole]

    alone = _minimise(widths, lambda width: loss(width, False), WIDTH_SETTINGS.bracket)
    width = _minimise(widths, lambda width: loss(width, True), WIDTH_SETTINGS.bracket) if direct else alone
    needed = (
        bool(direct)
        and float(hac_t((loss(alone, False) - loss(width, True))[:, None])[0]) > WIDTH_SETTINGS.needed_t
    )
    width = width if needed else alone
    key = f"{option.mechanism}@width={width:g}"
    search, made = _with_term(search, data, option, term(width, key), 0.0)
    if not needed:
        return search, made
    whole = replace(made, terms=(direct[0].key, key), columns=(*direct[0].columns, *made.columns))
    return replace(search, options=(*search.options[:-1], whole)), whole


#: Finer grids after the first one, as powers of their range; 0 ends.
_FINER: tuple[float, ...] = (1.0, 0.25, 0.0)


def _minimise(
    grid: Floats,
    loss: Callable[[float], Floats],
    around: tuple[float, float],
    parts: Sequence[float] = _FINER,
) -> float:
    """Return where the loss is least: on the whole grid, then on finer ones around it; four digits."""
    best = 0.0
    for part in parts:
        sums = np.array([loss(float(one)).sum() for one in grid])
        at = int(np.argmin(sums))
        best = float(grid[at])
        if 0 < at < len(sums) - 1:
            # The vertex of a parabola in the logarithm.
            x = np.log(grid[at - 1 : at + 2])
            vertex = _vertex(x, sums[at - 1 : at + 2])
            best = float(np.exp(np.clip(vertex, x[0], x[2]))) if np.isfinite(vertex) else best
        if part:
            grid = best * np.geomspace(*around, 7) ** part
    return float(f"{best:.4g}")


def _vertex(x: Floats, y: Floats) -> float:
    """Return where the parabola through three points is least; NaN when it opens downward."""
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2.0 * a)) if a > 0 else float("nan")


def _with_term(
    search: Search, data: DiagnosisData, option: Option, term: Term, lag: float, sigma: float | None = None
) -> Refined:
    """Return the option with another term, its columns in the Gram blocks and it among the options."""
    made = replace(
        option, name=term.key, terms=(term.key,), columns=tuple(term.columns), lag_s=lag, lag_sigma_s=sigma
    )
    if term.key not in search.library.terms:
        joins = can_add_columns(search, data)
        search = join_terms(search, data, [term]) if joins else _join_combination(search, option, term, lag)
    return search.with_options([made]), made


def similar_term(
    data: DiagnosisData, source: Term, key: str, options: dict[str, Any], parameters: Sequence[str]
) -> Term:
    """Return a term like another one with other options; everything of it is free."""
    given = {name: value for name, value in source.entry.effect.given.items() if name not in ("lag", "width")}
    entry = {
        "effect": type(source.entry.effect).label(),
        "sensor": source.entry.sensor.name,
        **given,
        **options,
    }
    sensors = sensors_of(data.mission, data.model.comparison)
    made = make_effect(entry, sensors, data.model.own, data.mission)
    size = sum(made.effect.parameters()[name].size for name in parameters)
    return Term(key, made, tuple(parameters), (np.inf,) * size)


#: Columns of the series that calibration and model are taken off at a time: a bound on memory.
_COLUMNS_AT_ONCE = 8


class FormTrials:
    """Trials of forms of an option that the model holds; the option itself, if any, is taken off the model.

    Rows of the coarse series, weighted, with the calibration marginalised interval by interval. Columns lie
    one after another in memory: (column, row).
    """

    def __init__(self, search: Search, data: DiagnosisData, option: Option | None) -> None:
        self.data, self.series, self.blocks = data, data.series, len(search.raw)
        self.terms = search.library.by_key
        others = [one for one in search.accepted if one is not option and one.terms]
        keys = sorted({key for one in others for key in one.terms})
        kept = [*search.fitted_terms, *(self.terms[key] for key in keys)]
        residual = self.series["residual"].reshape(len(self.series.tt2000), -1)
        self.block = np.repeat(self.series.block, residual.shape[1])
        self.root = np.sqrt(np.repeat(self.series["weight"], residual.shape[1]))
        base = self._kept_columns(search.library.base)
        # Rows are in order of time, and so are the blocks of each interval.
        edges = [np.searchsorted(self.block, [group[0], group[-1] + 1]) for group in search.intervals]
        self.groups = [slice(int(first), int(last)) for first, last in edges]
        # Group by group, and no array of all of them: of a long record that is hundreds of megabytes.
        inside = (np.concatenate([columns[:, group] for columns in base]) for group in self.groups)
        self.basis = [np.ascontiguousarray(np.linalg.qr(own.T)[0].T) for own in inside] if base else []
        self.y = self._marginalised((residual.reshape(-1) * self.root)[None])[0]
        self.model = self._marginalised(
            np.concatenate([np.zeros((0, self.root.size)), *self._kept_columns(kept)])
        )
        self.rest = self._without_model(self.y[None])[0]
        self._known: dict[str, Floats] = {}

    def loss(self, terms: Sequence[Term]) -> Floats:
        """Return the sum of squares that the terms together leave in each block; (block,) nT^2."""
        return self.remaining([self.columns(term) for term in terms])

    def columns(self, term: Term) -> Floats:
        """Return what calibration and model leave of the columns of a term; (column, row)."""
        columns = self._known.get(term.key)
        if columns is None:
            columns = self.kept(self._flat([term]))
        if term.key in self.terms:
            self._known[term.key] = columns
        return columns

    def kept(self, flat: Floats) -> Floats:
        """Return what calibration and model leave of weighted columns (column, row), in their place."""
        self._marginalised(flat)
        for some in in_turns(slice(0, len(flat)), _COLUMNS_AT_ONCE):
            flat[some] = self._without_model(flat[some])
        return flat

    def remaining(self, parts: Sequence[Floats]) -> Floats:
        """Return the sum of squares that columns (column, row) leave together in a block; (block,) nT^2."""
        columns = parts[0] if len(parts) == 1 else np.concatenate(parts)
        rest = self.rest - solve_scaled(columns @ columns.T, columns @ self.rest) @ columns
        return np.asarray(np.bincount(self.block, weights=rest**2, minlength=self.blocks), dtype=np.float64)

    def grams(self, like: GramBlocks, parts: Sequence[Floats]) -> GramArrays:
        """Return the Gram blocks of columns (column, row) and of the residual, in blocks like others."""
        every = [*parts, self.rest[None]]
        edges = np.searchsorted(self.block, np.arange(self.blocks + 1)).tolist()
        count = sum(map(len, every))
        gram = np.empty((self.blocks, count, count))
        for own, (first, last) in zip(gram, pairwise(edges), strict=True):
            inside = np.concatenate([part[:, first:last] for part in every])
            np.matmul(inside, inside.T, out=own)
        names = (*map(str, range(count - 1)), "residual")
        return GramArrays(names, gram, like.start, like.end, like.count, np.ones(count))

    def contribution(self, option: Option, terms: Sequence[Term]) -> tuple[Floats, Floats]:
        """Return the residual after the rest of the model, without and with an option; (row,) nT, weighted.

        Parameters
        ----------
        option : Option
            Of the library, or a change in time: then `terms` are those whose columns change.
        """
        flat = self._flat(terms)
        if option.change is not None and option.change.functions:
            names = [name for term in terms for name in term.columns]
            flat = np.stack(
                [
                    flat[names.index(column)] * np.asarray(factor)[self.block]
                    for column, factor in option.change.functions.values()
                ]
            )
        own = self.kept(flat)
        return self.rest, self.rest - solve_scaled(own @ own.T, own @ self.rest) @ own

    def _without_model(self, values: Floats) -> Floats:
        """Return what the rest of the model leaves of columns (column, row)."""
        if not len(self.model):
            return values
        left = (values @ self.model.T @ self._inverse) @ self.model
        np.subtract(values, left, out=left)
        # What is left of a combination of the model's columns is rounding.
        remaining, whole = (np.einsum("cr,cr->c", one, one) for one in (left, values))
        left[remaining <= LEAST_KEPT * whole] = 0.0
        return np.asarray(left)

    @cached_property
    def _inverse(self) -> Floats:
        inner = self.model @ self.model.T
        return solve_scaled(inner, np.eye(len(inner)))

    def _kept_columns(self, terms: Sequence[Term]) -> list[Floats]:
        """Return the columns of each of the model's terms, which further trials need again."""
        kept = self.data.columns
        # The calibration's terms share one key: each is known by its columns.
        keys = [" ".join(term.columns) for term in terms]
        for key, term in zip(keys, terms, strict=True):
            if key not in kept:
                kept[key] = self._flat([term])
        return [kept[key] for key in keys]

    def _flat(self, terms: Sequence[Term]) -> Floats:
        derived = derived_channels(self.series, _channels_of(terms))
        columns = design_matrix(terms, self.series.rows(self.data.sensor_matrices, derived))
        return np.asarray(np.moveaxis(columns, -1, 0).reshape(columns.shape[2], self.root.size) * self.root)

    def _marginalised(self, values: Floats) -> Floats:
        """Return what the calibration leaves of columns (column, row), in their place."""
        for group, basis in zip(self.groups, self.basis, strict=False):
            for some in in_turns(slice(0, len(values)), _COLUMNS_AT_ONCE):
                values[some, group] -= (values[some, group] @ basis.T) @ basis
        return values


# The time of a change.


def refine_change_time(search: Search, data: DiagnosisData, option: Option) -> Refined:
    """Return the state with a step or an episode at the time that leaves least, and that option.

    Its `change.sharpness` is the time's standard deviation, the larger one of an episode's two; an episode
    that turns out to reach an end of the record comes back as the step it is. All that may
    change at that time joins the options: one at its time must not be held against others at edges. The
    option itself comes back when it is a drift, or at that time already.
    """
    change, columns = option.change, _changing_columns(search, option)
    if change is None or not change.at or not columns:
        return search, option
    at, sigma = _change_times(search, data, option, columns)
    moved = max(abs(new - old) for new, old in zip(at, change.at, strict=True))
    at = _within_record(data.series, at, sigma)
    still = len(at) == len(change.at)
    near = max(CHANGE_TIME_SETTINGS.near * sigma, data.series.step_s * SECOND)
    if still and option.terms and moved <= near:
        return search, option
    made = _every_kind(search, at, round(sigma))
    terms = []
    for one in made:
        if one.name not in search.library.terms:
            changing = _changing_columns(search, one)
            terms.append(dated_term(_source(search, changing), changing, one.name, at))
    known = {one.name for one in search.options}
    if terms:
        search = join_terms(search, data, terms)
    search = search.with_options([one for one in made if one.name not in known])
    kind = option.mechanism.rsplit("_", 1)[0]
    return search, next(one for one in made if one.mechanism.rsplit("_", 1)[0] == kind)


def _within_record(series: Series, at: tuple[int, ...], sigma: float) -> tuple[int, ...]:
    """Return when a change begins, and ends if it does; one that reaches an end of the record is a step.

    It reaches it when its time is no further from that end than its standard deviation `sigma`, ns.
    """
    used = series.tt2000[series["weight"] > 0]
    inner = tuple(when for when in at if used[0] + sigma < when < used[-1] - sigma)
    return inner if len(at) == 2 and len(inner) == 1 else at


def _every_kind(search: Search, at: tuple[int, ...], sigma: int) -> list[Option]:
    """Return everything that may change at some times."""
    made = []
    form = "episode" if len(at) == 2 else "step"
    for kind, (family, changing) in search.time_variable.kinds.items():
        if form == "episode" and len(changing) > 1:
            continue
        name = f"{kind}_{form}@{'/'.join(time_text(one) for one in at)}"
        change = Change(name, f"{kind}_{form}", family, {}, at, sharpness=sigma)
        columns = tuple(dated_columns(_source(search, changing), changing, name))
        made.append(
            Option(
                name=name,
                mechanism=change.mechanism,
                family=family,
                columns=columns,
                terms=(name,),
                change=change,
            )
        )
    return made


def _changing_columns(search: Search, option: Option) -> tuple[str, ...]:
    found: tuple[str, ...] = getattr(search.time_variable, option.mechanism.rsplit("_", 1)[0], ())
    return found


def _source(search: Search, changing: tuple[str, ...]) -> Term:
    return next(term for term in search.library.all_terms if changing[0] in term.columns)


def dated_term(source: Term, changing: tuple[str, ...], name: str, at: tuple[int, ...]) -> Term:
    """Return the term of some columns of another one that hold from a time on, or within a span."""
    suffixes = [one.removeprefix(f"{source.key}.") for one in changing]
    parameters = tuple(dict.fromkeys(one.split("[")[0] for one in suffixes))
    size = sum(source.entry.effect.parameters()[one].size for one in parameters)
    return Term(name, source.entry, parameters, (np.inf,) * size, at)


def dated_columns(source: Term, changing: tuple[str, ...], name: str) -> list[str]:
    """Return the columns of a dated term that are those of the changing ones."""
    return [f"{name}.{one.removeprefix(f'{source.key}.')}" for one in changing]


def _change_times(
    search: Search, data: DiagnosisData, option: Option, changing: tuple[str, ...]
) -> tuple[tuple[int, ...], float]:
    """Return when a change begins, and ends if it does, TT2000, and the standard deviation, ns."""
    assert option.change is not None
    series, at = data.series, option.change.at
    rows, made = iter_model_columns(search, series, data.sensor_matrices, search.accepted, option.columns)
    own = np.empty((*rows.residual.shape, len(option.columns)))
    for place, column in made:
        own[:, :, place] = column
    residual = remaining_residual(search, data)
    taken = [name for one in search.accepted for name in one.columns]
    values, known = joint_values(search, taken)[0]
    value = dict(zip(known, values[len(values) - len(known) :], strict=True))
    # The residual without the option, and its columns as if it held always.
    without = residual - own @ np.array([value[name] for name in option.columns])
    source = _source(search, changing)
    columns = design_matrix([source], rows)[:, :, [source.columns.index(name) for name in changing]]
    used = series["weight"] > 0
    # Variance of what a row adds to a sum over many, correlation with its neighbours counted.
    correlated_rows = 2.0 * correlation_s(series, residual) / series.step_s
    noise = float(np.mean(residual[used] ** 2)) * max(correlated_rows, 1.0)
    windows = [_window(search, option, place) for place in range(len(at))]
    unit = "datetime64[s]" if series.step_s >= CHANGE_TIME_SETTINGS.coarse_s else "datetime64[ms]"
    sigma = 0.0
    for _ in range(CHANGE_TIME_SETTINGS.iterations):
        inside = within_span(series.tt2000, at) & (series["weight"] > 0)
        if not inside.any():
            break
        flat = columns[inside].reshape(-1, columns.shape[2]), without[inside].reshape(-1)
        with_it = without - columns @ np.linalg.lstsq(*flat, rcond=None)[0]
        gained = np.sum(with_it**2 - without**2, axis=1) * series["weight"]
        found = [
            _change_time(series.tt2000, gained * (-1.0) ** place, window, noise)
            for place, window in enumerate(windows)
        ]
        before, at = at, tuple(int(to_tt2000(to_utc(one[0]).astype(unit))) for one in found)
        sigma = max(one[1] for one in found)
        if at == before or (len(at) == 2 and at[0] >= at[1]):
            break
    return (
        (option.change.at, float(option.change.sharpness))
        if not sigma or list(at) != sorted(at)
        else (at, sigma)
    )


def _window(search: Search, option: Option, place: int) -> tuple[int, int]:
    """Return from when to when a change may be: a block around it, or as far as it was known before."""
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


def _change_time(stamps: Int64, gained: Floats, window: tuple[int, int], noise: float) -> tuple[int, float]:
    """Return the median of the posterior of a change's time, and its root mean square about that; ns.

    Parameters
    ----------
    gained : ndarray, shape (sample,)
        By how much the residual's square grows when a row lies behind the change, nT^2.
    noise : float
        Variance of a row, nT^2.
    """
    first, last = np.searchsorted(stamps, window)
    places = np.arange(max(int(first), 1), min(int(last), len(stamps) - 1) + 1)
    if places.size < 2:
        return sum(window) // 2, (window[1] - window[0]) / np.sqrt(12.0)
    loss = -np.concatenate([[0.0], np.cumsum(gained)])[places]
    width = (stamps[places] - stamps[places - 1]).astype(np.float64)
    offset = (stamps[places - 1] - stamps[0]) + 0.5 * width
    chance = width * np.exp(-(loss - loss.min()) / (2.0 * noise))
    chance /= chance.sum()
    passed = np.cumsum(chance)
    middle = int(np.searchsorted(passed, 0.5))
    part = (0.5 - passed[middle] + chance[middle]) / chance[middle]
    best = offset[middle] + (part - 0.5) * width[middle]
    spread = np.sum(chance * ((offset - best) ** 2 + width**2 / 12.0))
    return int(stamps[0]) + round(float(best)), float(np.sqrt(spread))


# Columns that join.


def can_add_columns(search: Search, data: DiagnosisData) -> bool:
    """Return True when columns can be made of the series: its rows are those of the Gram blocks."""
    rows, found = data.series.tt2000.size, data.series
    return rows <= DESIGN_SETTINGS.most_rows and found.step_s < 1.5 * data.cadence_s


def join_terms(search: Search, data: DiagnosisData, terms: Sequence[Term]) -> Search:
    """Return the state with the columns of new terms in its Gram blocks."""
    names, cache, parts = _library_columns(search, data, terms)
    sums = _BorderSums.of(search, names, terms)
    for part, columns in parts:
        sums.add(data, part, columns)
    return replace(search.join(terms, *sums.borders(search)), design_cache=cache)


def _join_combination(search: Search, option: Option, term: Term, lag: float) -> Search:
    """Return the state with a response of another lag, as a combination of the bank's; see `lag_weights`."""
    names = search.forms["raw"].names
    bank = {one: [names[place] for place in places] for one, places in bank_of(search, option).items()}
    lags = tuple(sorted(bank))
    weights = lag_weights(lag, lags)
    return search.join_combination(
        term, [(weight, bank[one]) for weight, one in zip(weights, lags, strict=True)]
    )


def _library_columns(
    search: Search, data: DiagnosisData, terms: Sequence[Term]
) -> tuple[list[str], CachedDesign, Iterator[tuple[slice, Floats]]]:
    """Return the names of all columns, those to be kept, and all columns of some days at a time.

    Where the columns of the whole series are few enough they are kept: a further one costs its own making
    only. Else they are made again, some days at a time.
    """
    series, known = data.series, search.design_cache
    every = [*search.library.all_terms, *terms]
    days = _days_of(series)
    size = sum(len(term.columns) for term in every) * series.features.rows
    if series.row_filter is None and size * len(series.tt2000) > DESIGN_SETTINGS.kept:
        names = [name for term in every for name in term.columns]
        usual = len(series.tt2000) / len(days)
        count = max(1, int(DESIGN_SETTINGS.part / (size * usual)))
        spans = [slice(days[at].start, days[at : at + count][-1].stop) for at in range(0, len(days), count)]
        return names, CachedDesign(), ((span, _columns_of_part(search, data, every, span)) for span in spans)
    new = [term for term in every if not set(term.columns) <= set(known.names)]
    rows = series.rows(
        data.sensor_matrices, derived_channels(series, _channels_of(new), search.library.placebos)
    )
    made = [design_matrix([term], rows).astype(np.float32) for term in new]
    names = [*known.names, *(name for term in new for name in term.columns)]
    pieces = (*known.pieces, *made)
    parts = ((day, np.concatenate([piece[day] for piece in pieces], axis=2)) for day in days)
    return names, CachedDesign(tuple(names), pieces), parts


def _days_of(series: Series) -> list[slice]:
    """Return the rows of each day."""
    day = (series.tt2000 - series.tt2000[0]) // DAY
    edges = [0, *(np.flatnonzero(np.diff(day)) + 1).tolist(), len(day)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _channels_of(terms: Sequence[Term]) -> set[str]:
    return {name for term in terms for name in term.channels}


def _columns_of_part(search: Search, data: DiagnosisData, terms: Sequence[Term], part: slice) -> Floats:
    """Return the columns of a part of the series; slow responses begin some days before it."""
    series = data.series
    begin = int(np.searchsorted(series.tt2000, series.tt2000[part.start] - DESIGN_SETTINGS.before_days * DAY))
    wide = slice(begin, min(part.stop + DESIGN_SETTINGS.margin, len(series.tt2000)))
    derived = derived_channels(series, _channels_of(terms), search.library.placebos, wide)
    rows = series.part(wide).rows(data.sensor_matrices, derived)
    first = max(part.start - begin - DESIGN_SETTINGS.margin, 0)
    found = design_matrix(terms, rows.part(slice(first, None)))
    return found[part.start - begin - first :][: part.stop - part.start]


@dataclass
class _BorderSums:
    """Products of the fresh columns with all columns, raw and prewhitened.

    Attributes
    ----------
    names : sequence of str
        All columns.
    terms : sequence of Term
        Whose columns are fresh.
    fresh, base : ndarray of int
        Places of the fresh ones and of the calibration's own.
    raw, white : ndarray, shape (block, column + 1, fresh column)
        The residual last.
    given : ndarray, shape (block, fit, base, fresh column)
        Products with the calibration's columns, for each fit of a block.
    begins : ndarray of int64, shape (block, fit)
        First instant of each fit, TT2000.
    """

    names: Sequence[str]
    terms: Sequence[Term]
    fresh: Index
    base: Index
    raw: Floats
    white: Floats
    given: Floats
    begins: Int64

    @classmethod
    def of(cls, search: Search, names: Sequence[str], terms: Sequence[Term]) -> _BorderSums:
        places = {name: place for place, name in enumerate(names)}
        fresh = np.array([places[name] for term in terms for name in term.columns], dtype=np.int64)
        base = np.array([places[name] for name in search.base()[0]], dtype=np.int64)
        shape, begins = (len(search.raw), len(names) + 1, fresh.size), search.raw.begins
        given = np.zeros((*begins.shape, base.size, fresh.size))
        return cls(names, terms, fresh, base, np.zeros(shape), np.zeros(shape), given, begins)

    def add(self, data: DiagnosisData, part: slice, columns: Floats) -> None:
        """Add the rows of some days."""
        series = data.series.part(part)
        residual = series["residual"].reshape(len(series.tt2000), -1, 1)
        used = np.where((series["weight"] > 0)[:, None, None], np.nan_to_num(residual), 0.0)
        for day in _days_of(series):
            weight, stamps = series["weight"][day], series.tt2000[day]
            fresh = columns[day][:, :, self.fresh]
            white = prewhiten(fresh, weight, stamps, data.correlation_time_s)
            # What prewhitening takes off each row of the one before it.
            memory = prewhiten(np.ones((len(weight), 1, 1)), weight, stamps, data.correlation_time_s)
            for number in np.unique(series.block[day]):
                own = np.where(series.block[day] == number, weight, 0.0)[:, None, None]
                # Products of prewhitened columns are those of the columns as they are with fresh ones that
                # went through the filter twice, the second time backwards: only these are filtered.
                twice = own * white
                twice[:-1] -= (own * (1.0 - memory) * white)[1:]
                inside = np.flatnonzero(own[:, 0, 0])
                if not inside.size:
                    continue
                rows = slice(max(int(inside[0]) - 1, 0), int(inside[-1]) + 1)
                right = np.concatenate([own * fresh, twice], axis=2)[rows]
                right = right.reshape(-1, right.shape[2])
                every = np.concatenate(
                    [one[day][rows].reshape(-1, one.shape[2]).T @ right for one in (columns, used)]
                )
                products = every[:, : self.fresh.size]
                self.raw[number] += products
                self.white[number] += every[:, self.fresh.size :]
                fit = int(np.searchsorted(self.begins[number], stamps[inside[-1]], side="right")) - 1
                self.given[number, max(fit, 0)] += products[self.base]

    def borders(self, search: Search) -> tuple[Border, Border]:
        """Return the borders of the raw and the prewhitened Gram blocks."""
        changes = {
            name: source
            for option in search.accepted
            if option.change
            for name, source in option.change.functions.items()
        }
        raw = self._border(search.raw, self.raw, changes)
        return raw._replace(given=self.given), self._border(search.white, self.white, changes)

    def _border(self, grams: GramBlocks, gram: Floats, changes: Mapping[str, tuple[str, Floats]]) -> Border:
        """Return the fresh columns' products with those of Gram blocks, changes in time among them."""
        places = {name: place for place, name in enumerate([*self.names, "residual"])}
        across = np.zeros((len(grams), len(grams.names), self.fresh.size))
        for place, name in enumerate(grams.names):
            source, factor = changes.get(name, (name, None))
            if source in places:
                piece = gram[:, places[source]]
                across[:, place] = piece if factor is None else piece * np.asarray(factor)[:, None]
        return Border(across, gram[:, self.fresh])


# Lags of the bank.


@lru_cache(maxsize=4096)
def _lag_weights(lag: float, bank: tuple[float, ...]) -> tuple[float, ...]:
    omega = np.geomspace(LAG_SETTINGS.slowest, LAG_SETTINGS.fastest, LAG_SETTINGS.frequencies)
    known = 1.0 / (1.0 + 1j * omega[:, None] * np.asarray(bank)[None, :])
    target = 1.0 / (1.0 + 1j * omega * lag)
    rows = np.concatenate([known.real, known.imag]), np.concatenate([target.real, target.imag])
    return tuple(np.linalg.lstsq(rows[0], rows[1], rcond=LAG_SETTINGS.cutoff)[0].tolist())


def lag_weights(lag: float, bank: Sequence[float]) -> Floats:
    """Return the weights of the bank's responses that together respond with another lag.

    Least squares of the transfer functions 1 / (1 + i omega lag).

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
    return np.array(_lag_weights(float(lag), tuple(float(one) for one in bank)))


@dataclass(frozen=True)
class LagProfile:
    """How well each lag explains the residual.

    Attributes
    ----------
    lags : ndarray
        Seconds.
    remaining : ndarray
        Sum of squares left at each, nT^2 (in-sample).
    best, sigma : float
        The lag that leaves least and its jackknife error over folds of blocks, seconds.
    """

    lags: Floats
    remaining: Floats
    best: float
    sigma: float

    def as_json(self) -> dict[str, object]:
        """Return the fields as plain numbers."""
        return {
            "lags_s": self.lags.tolist(),
            "left_nT2": self.remaining.tolist(),
            "best_s": self.best,
            "sigma_s": self.sigma,
        }


def scan_lags(
    gram: Floats, present: ModelColumns, bank: Mapping[float, Index], y: int
) -> tuple[Floats, Floats]:
    """Return lags (lag,), s, and the sum of squares each explains by combinations of the bank (lag,), nT^2.

    Parameters
    ----------
    gram : ndarray, shape (column, column)
        The calibration marginalised.
    bank : mapping of float to ndarray
        Lag in seconds -> its columns, the same number for each.
    """
    lags = np.array(sorted(bank))
    largest = float(lags[-1])
    smallest = float(lags[lags > 0][0]) if np.any(lags > 0) else 1.0
    lowest, highest = smallest * LAG_SETTINGS.lower, LAG_SETTINGS.upper * largest
    grid = np.concatenate([[0.0], np.geomspace(lowest, highest, LAG_SETTINGS.profile)])
    columns = np.concatenate([bank[lag] for lag in lags])
    size = len(bank[lags[0]])
    mixed = np.array([lag_weights(lag, tuple(lags)) for lag in grid])
    remaining = project_out(gram, present)
    own = remaining[np.ix_(columns, columns)].reshape(lags.size, size, lags.size, size)
    cross = remaining[columns, y].reshape(lags.size, size)
    matrices = np.einsum("gi,iajb,gj->gab", mixed, own, mixed, optimize=True)
    half = inverse_square_root(matrices)
    return grid, np.asarray(np.sum(np.einsum("gak,ga->gk", half, mixed @ cross) ** 2, axis=1))


def _of_lags(
    grams: GramBlocks, present: ModelColumns, bank: Mapping[float, Index], y: int
) -> tuple[Floats, ModelColumns, dict[float, Index], int]:
    """Return the Gram matrices of the model, a bank and the residual alone, and their places in these."""
    places = np.concatenate([present.columns, *bank.values(), [y]])
    at, moved = present.columns.size, {}
    for lag, columns in bank.items():
        moved[lag] = np.arange(at, at + len(columns))
        at += len(columns)
    own = ModelColumns(np.arange(present.columns.size), present.precision)
    return grams.rows(places, places), own, moved, at


def profile_lag(
    grams: GramBlocks,
    present: ModelColumns,
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
    blocks, own, places, y = _of_lags(grams, present, bank, y)
    total = blocks.sum(axis=0)
    grid, whole = scan_lags(total, own, places, y)
    others = [peak_of(*scan_lags(total - blocks[fold].sum(axis=0), own, places, y)) for fold in folds]
    best = peak_of(grid, whole)
    sigma = float(jackknife(np.array(others)))
    base = float(project_out(total, own)[y, y])
    return LagProfile(grid, base - whole, best, sigma)


def peak_of(grid: Floats, explained: Floats) -> float:
    """Return the lag of the largest sum explained, by a parabola through its neighbours."""
    at = int(np.argmax(explained))
    if at == 0 or at == grid.size - 1:
        return float(grid[at])
    x, v = grid[at - 1 : at + 2], explained[at - 1 : at + 2]
    a, b, _ = np.polyfit(x - x[1], v, 2)
    return float(np.clip(x[1] - b / (2.0 * a), x[0], x[2])) if a < 0 else float(grid[at])
