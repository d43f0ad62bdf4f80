"""What an effect acts on, and how it follows a channel: every combination of both, beside the library's core.

`ACTS_ON` times `follows` is the whole table. The core of the library (`inflight.diagnosis.candidates`) has
the cells that are causes of their own, with products of every column with every other; all other cells are
tried here once the rounds are over (`add_forms`), and products of two channels last (`add_interactions`).

A cell's columns are those of its effect with a channel that is 1, times the series that follows the channel.
Its products with calibration, model and residual are therefore matrix products of a few columns with all
series at once (`CellProducts`): they grow with the number of cells, not with its square. Only what explains
something beside the model, or instead of an effect of it, joins the Gram blocks with all its products.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import NamedTuple, TypeVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats, straight_pieces
from inflight.design import Term, design_matrix, term_of
from inflight.diagnosis.attenuation import ATTENUATION_SETTINGS, noise_bound
from inflight.diagnosis.candidates import BANK_SETTINGS, acting_sensors, effect_or_none
from inflight.diagnosis.refine import (
    ANGLES,
    WIDTH_SETTINGS,
    FormTrials,
    best_lag,
    can_add_columns,
    join_terms,
)
from inflight.diagnosis.residual import DiagnosisData, derived_channels, iter_model_columns
from inflight.diagnosis.scoring import (
    Index,
    ModelColumns,
    draw_signs,
    family_wise_p,
    make_folds,
    score,
    sign_flip_ratios,
)
from inflight.diagnosis.search import VISIBILITY_SETTINGS, Option, ScoreTable, Search
from inflight.diagnosis.stepwise import channels_under
from inflight.effects import family_of, known_effects
from inflight.frames import GEOMETRY, SLOW_GEOMETRY
from inflight.lsq import GramArrays, hac_t, in_turns, inverse_square_root, solve_scaled
from inflight.model import ModelEffect
from inflight.samples import base_channels, slow_response

#: An effect that was taken, or its place.
Taken = TypeVar("Taken")

#: What a channel may act on, and the effect that does it: ``effect(channel)``.
ACTS_ON: Mapping[str, str] = {
    "field at the sensor": "channel_field",
    "scale factors": "channel_scale",
    "angles": "channel_angle",
    "mounting": "channel_turn",
    "bias of the scalar sensor": "channel_bias",
    "clock of the scalar sensor": "channel_clock",
}

#: Effects of which a constant channel is a constant that the calibration has anyway; the others' channels
#: are taken about their mean.
_HAS_CONSTANT = frozenset({"channel_field", "channel_scale", "channel_angle", "channel_turn"})

#: Effects of the core that are cells by another name: effect, and how its channel is followed.
_SAME = {"channel_power": "square", "hysteresis": "play"}


@dataclass(frozen=True, kw_only=True)
class FormSettings:
    """Which cells, and which products of channels, are tried.

    Attributes
    ----------
    joining : int
        Cells that join at most: a bound on time, assumed.
    channels, pairs : int
        The strongest channels that are paired, and pairs at most: a bound on memory, assumed.
    steady : float
        A factor that varies by less than this part of its size is a constant; assumed.
    own_t : float
        A channel is strong when its own effect reaches this t; assumed.
    related : float
        A cell that explains this part of what an effect does, in its place, is related to it; assumed.
    small_mean : float
        A channel whose mean is no more than this part of its spread is taken as it is; assumed.
    levels : int
        Levels of the field along an axis between which a reading's deviation is a straight line; assumed.
    in_place : int
        Other channels at most that are held against an effect with their noise; a bound on time, assumed.
    nearly : float
        Cells and products that reach this part of the t and of the gain of an addition are held against
        everything.
    """

    joining: int = 12
    channels: int = 8
    pairs: int = 60
    steady: float = 1e-3
    own_t: float = 1.0
    related: float = 0.5
    small_mean: float = 0.02
    levels: int = 9
    in_place: int = 4
    nearly: float = 0.5


FORM_SETTINGS = FormSettings()


@dataclass(frozen=True)
class Followed:
    """One way to follow a channel.

    `how` is ``value``, ``response``, ``play`` or ``square``; `name` is the derived channel.
    """

    how: str
    channel: str
    name: str
    lag_s: float = 0.0

    @property
    def lag_text(self) -> str:
        """How its name writes the lag."""
        return f"@lag={self.lag_s:g}s" if self.lag_s else ""


def follows(
    channel: str, mean: float, spread: float, has_history: bool = True, about_mean: bool = False
) -> list[Followed]:
    """Return every way to follow a channel.

    Parameters
    ----------
    mean, spread : float
        Of the channel, in its unit; the spread is its range without outliers.
    has_history : bool
        Slow responses and plays make sense: between the samples of a synthetic turn there is no time.
    about_mean : bool
        The channel is taken about its mean, as a square always is.
    """
    centred = f"{channel}@about={mean:.4g}" if abs(mean) > FORM_SETTINGS.small_mean * spread else channel
    own = centred if about_mean else channel
    out = [Followed("value", channel, own), Followed("square", channel, f"{centred}*{centred}")]
    if has_history:
        lags = [lag for lag in BANK_SETTINGS.lags if lag]
        out += [Followed("response", channel, f"{own}@lag={lag:g}s", lag) for lag in lags]
        widths = [part * spread for part in BANK_SETTINGS.widths]
        out += [Followed("play", channel, f"{own}@width={width:.3g}") for width in widths]
    return out


class _Shortlisted(NamedTuple):
    """A cell that may join: its gain, and whether it alone does as well as all that was taken together."""

    gain: float
    cell: Followed
    entry: ModelEffect
    alone: bool


def add_forms(search: Search, data: DiagnosisData) -> tuple[Search, bool]:
    """Return the state with cells of the table among its options; the state itself when there are none.

    Also where nothing is left: what was taken may stand in for another channel, or for another form. True
    comes with it when one of them alone does as well as all that was taken together.
    """
    if not can_add_columns(search, data):
        return search, False
    channels = driving_channels(data)
    cells = {label: _cells(search, data, label, channels) for label in ACTS_ON.values()}
    tried = sum(len(own) for own in cells.values())
    found = [one for row in _table_rows(search, data, cells).values() for one in _shortlisted(search, row)]
    # Of a channel the best way to follow it: what it lacks of lag or width is found once it is taken.
    best: dict[tuple[str, str], _Shortlisted] = {}
    for one in sorted(found, key=lambda one: -one.gain):
        best.setdefault((one.entry.effect.label(), one.cell.channel), one)
    joining = list(best.values())[: FORM_SETTINGS.joining]
    made = [_option(search, data, one.cell, one.entry) for one in joining]
    if not made:
        return search, False
    more = 1.0 + tried / max(len(search.options), 1)
    search = join_terms(search, data, [term for term, _ in made]).with_options(
        [replace(option, of_more=more) for _, option in made]
    )
    return search, any(one.alone for one in joining)


def left_follows(search: Search, data: DiagnosisData) -> dict[str, str]:
    """Return effects that may stand in for another form of their cause: effect -> what is left follows.

    Of each effect the related cells: those that follow a channel of it, or that explain half as much in its
    place. What is left follows one of them where its t passes, and sign flips of blocks say that the largest
    of them all is no chance.
    """
    options = [one for one in search.accepted if one.change is None and not one.agnostic]
    if not options or not can_add_columns(search, data):
        return {}
    signs, units = draw_signs(len(search.raw), search.rules.draws, search.rules.seed)
    folds, channels = make_folds(len(search.raw)), driving_channels(data)
    cells = {label: _cells(search, data, label, channels, held=True) for label in ACTS_ON.values()}
    names: list[str] = []
    t, observed, flipped = [], [], []
    related: dict[str, list[np.ndarray]] = {option.name: [] for option in options}
    for label, row in _table_rows(search, data, cells).items():
        products, every = row.products, row.places
        y, present = products.residuals[0], search.present_in(products)
        t.append(score(products, present, every, y, folds).t)
        ratios = sign_flip_ratios(products, present, every, y, signs, units)
        observed.append(ratios[0])
        flipped.append(ratios[1])
        names += [f"{label}({one.name})" for one in row.cells]
        for option in options:
            present = search.present_in(products, option)
            own = score(products, present, [products.index(option.columns)], y, folds)
            found = score(products, present, every, y, folds)
            same = np.array([one.channel in option.channels for one in row.cells])
            related[option.name].append(same | (found.gain > FORM_SETTINGS.related * own.gain[0]))
    if not names:
        return {}
    all_t, all_observed, all_flipped = np.concatenate(t), np.concatenate(observed), np.concatenate(flipped, 1)
    out = {}
    for name, parts in related.items():
        mask = np.concatenate(parts)
        if not mask.any():
            continue
        p = family_wise_p(all_observed, all_flipped[:, mask].max(axis=1, keepdims=True))
        clear = mask & (all_t > search.rules.t) & (p < search.rules.p)
        if clear.any():
            out[name] = names[int(np.argmax(np.where(clear, all_t, -np.inf)))]
    return out


def left_follows_field(search: Search, data: DiagnosisData) -> dict[str, str]:
    """Return effects of the field itself, without a channel, when what is left is a function of the field.

    Non-linearity, heading errors and the like are forms of one question: how a reading deviates from a
    straight line at each level. Were the form taken the right one, nothing would be left that any function
    ``f_x(B_x) u_x + f_y(B_y) u_y + f_z(B_z) u_z`` of the readings explains, piecewise straight between
    quantiles of each; sign flips of blocks say whether it is chance.
    """
    taken = [one for one in search.accepted if not (one.change or one.agnostic or one.channels or one.number)]
    series = data.series
    if not taken or "vector" not in series.features.names or not can_add_columns(search, data):
        return {}
    trials = FormTrials(search, data, None)
    reading, direction = series["vector"], series.direction()
    there = series["weight"] > 0
    flat = []
    for axis in range(3):
        flat += [
            (piece[:, None] * direction[:, :, axis]).reshape(-1) * trials.root
            for piece in _by_level(reading[:, axis], there)
        ]
    columns = trials.kept(np.nan_to_num(np.array(flat)))
    half = inverse_square_root(columns @ columns.T)
    each = [np.bincount(trials.block, weights=one * trials.rest, minlength=trials.blocks) for one in columns]
    scores = np.array(each).T @ half
    signs, units = draw_signs(trials.blocks, search.rules.draws, search.rules.seed)
    summed = np.stack([scores[unit].sum(axis=0) for unit in units])
    flipped = np.sum((signs @ summed) ** 2, axis=1)
    (p,) = family_wise_p(np.sum(summed.sum(axis=0) ** 2, keepdims=True), flipped[:, None])
    return dict.fromkeys((one.name for one in taken if p < search.rules.p), "the field along the axes")


def instead_of_several(search: Search, data: DiagnosisData) -> dict[str, str]:
    """Return effects that may be parts of one: effect -> the cell that does as well as it and others do.

    Cells that the search could not take: what it could, it held against every effect already. Where one of
    them explains as much as two effects or more, these stand in for one cause that the library has not.
    """
    taken = [one for one in search.accepted if one.change is None and not one.agnostic]
    if len(taken) < 2 or not can_add_columns(search, data):
        return {}
    options = {one.name for one in search.options}
    channels, folds = driving_channels(data), make_folds(len(search.raw))
    cells = {}
    for label in ACTS_ON.values():
        tried = {one.name for one in _cells(search, data, label, channels)}
        cells[label] = [
            one
            for one in _cells(search, data, label, channels, held=True)
            if one.name not in tried and not {f"{label}({one.name})", _core_name(label, one)} & options
        ]
    out: dict[str, tuple[float, str]] = {}
    for label, row in _table_rows(search, data, cells).items():
        products, every = row.products, row.places
        residual = products.residuals[0]
        together = score(products, search.present_in(products), [], residual, folds).loss0
        for without in _several(taken):
            kept = search.with_accepted([one for one in search.accepted if one not in without])
            found = score(products, kept.present_in(products), every, residual, folds)
            as_well = (found.t > search.rules.t) & (found.gain > search.rules.gain)
            as_well &= hac_t(found.loss - together[:, None]) < search.rules.rival_t
            if not as_well.any():
                continue
            best = int(np.argmax(np.where(as_well, found.gain, -np.inf)))
            name = f"{label}({row.cells[best].name})"
            for one in without:
                out[one.name] = max(out.get(one.name, (0.0, "")), (float(found.gain[best]), name))
    return {name: cell for name, (_, cell) in out.items()}


def _several(taken: Sequence[Taken]) -> list[tuple[Taken, ...]]:
    """Return all pairs of what was taken, and all of it together."""
    return [*combinations(taken, 2), *([tuple(taken)] if len(taken) > 2 else [])]


def by_one_channel(search: Search, data: DiagnosisData) -> dict[str, str]:
    """Return effects that one channel explains together, in a way of its own: effect -> what is said of it.

    Effects of several channels can make up one shape that the library lacks. A field that follows one
    channel in any way (`_in_any_way`) is held against them. They are parts of it where blocks that were left
    out do not clearly lose when it takes their place, nor gain when they join it: a cause of its own, which
    is no function of that channel, would be missed.
    """
    taken = [one for one in search.accepted if one.terms and not (one.change or one.agnostic or one.number)]
    if len(taken) < 2 or not can_add_columns(search, data):
        return {}
    kept = search.with_accepted([one for one in search.accepted if one not in taken])
    trials, folds = FormTrials(kept, data, None), make_folds(len(search.raw), interleaved=True)
    own = [np.concatenate([trials.columns(trials.terms[key]) for key in one.terms]) for one in taken]
    # No further trial is made here.
    data.columns.clear()
    edges = np.cumsum([0, *map(len, own)]).tolist()
    places = [np.arange(first, last) for first, last in pairwise(edges)]
    # An effect that follows no channel is something of its own.
    follow = [channels_under(one.channels) or {one.name} for one in taken]
    fields = {
        channel: entry
        for channel in driving_channels(data)
        if (entry := _entry(data, "channel_field", Followed("value", channel, channel))) is not None
    }
    if not fields:
        return {}
    # Along which directions a channel acts is the same for all.
    acting = _acting_columns(data, next(iter(fields.values())))
    out: dict[str, tuple[float, str]] = {}
    for channel in fields:
        grams = trials.grams(search.raw, [*own, _in_any_way(search, trials, channel, acting)])
        any_way = np.arange(edges[-1], len(grams.columns))
        together, joined = (
            _left_out_loss(grams, np.arange(count), folds) for count in (edges[-1], len(grams.columns))
        )
        for some in _several(range(len(taken))):
            if set().union(*(follow[at] for at in some)) == {channel}:
                continue
            others = [place for at, place in enumerate(places) if at not in some]
            alone = _left_out_loss(grams, np.concatenate([*others, any_way]), folds)
            missed = np.stack([alone - together, alone - joined], axis=1)
            is_small = missed.sum(axis=0) < search.rules.gain * together.sum()
            if np.all(is_small & (hac_t(missed) < search.rules.rival_t)):
                lost = float((alone - together).sum())
                for name in (taken[at].name for at in some):
                    out[name] = min(out.get(name, (lost, channel)), (lost, channel))
    return {name: f"a field that follows {channel} in a way of its own" for name, (_, channel) in out.items()}


def _left_out_loss(grams: GramArrays, columns: Index, folds: Sequence[Index]) -> Floats:
    """Return what columns, fitted to the other folds, leave in each block; (block,)."""
    model = ModelColumns(columns, np.zeros(columns.size))
    return score(grams, model, [], grams.residuals[0], folds).loss0


def _in_any_way(search: Search, trials: FormTrials, channel: str, acting: Floats) -> Floats:
    """Return what calibration and model leave of a field that follows a channel in any way; (column, row).

    Parameters
    ----------
    acting : ndarray, shape (sample, row, k)
        Columns of a field whose channel is 1.
    """
    series = trials.data.series
    values = np.asarray(series[channel])
    lags = [f"{channel}@lag={lag:g}s" for lag in BANK_SETTINGS.lags if lag and _has_history(search, channel)]
    slow = derived_channels(series, set(lags))
    ways = [*_by_level(values, np.isfinite(values)), *(np.asarray(slow[name].values) for name in lags)]
    along = np.moveaxis(acting, 2, 0) * trials.root.reshape(values.size, -1)
    columns = np.empty((len(ways), *along.shape))
    for own, way in zip(columns, ways, strict=True):
        np.multiply(along, np.nan_to_num(way)[:, None], out=own)
    return trials.kept(columns.reshape(-1, trials.root.size))


def _by_level(values: Floats, there: np.ndarray) -> Floats:
    """Return functions of the level of a series, straight between its quantiles; (level, sample)."""
    knots = np.unique(np.quantile(values[there], np.linspace(0.0, 1.0, FORM_SETTINGS.levels)))
    return straight_pieces(values, knots).T


def alike_but_for_noise(search: Search, data: DiagnosisData) -> dict[str, tuple[str, ...]]:
    """Return effects that another channel explains as well, but for noise of its own readings.

    A temperature that a current makes is read with noise or in coarse steps; the current's slow response has
    none of it and leaves less, whichever of both is the cause. Noise of variance v in what is followed leaves
    ``v |A b|^2``, with b the coefficients and A what a channel of 1 makes; where a channel leaves no more
    than that beyond the effect, the data cannot tell. A response is tried with the lag that is best for it.
    """
    taken = [
        one
        for one in search.accepted
        if one.change is None and not one.agnostic and not one.number and one.channels
    ]
    if not taken or not can_add_columns(search, data):
        return {}
    noise = {name: noise_bound(data, name) for name in driving_channels(data) if name not in GEOMETRY}
    noise = {name: one for name, one in noise.items() if one < _most_noise(data, name)}
    near = {one: cells for one, cells in _near_in_place(search, data, taken, list(noise)).items() if cells}
    found = {one.name: _as_good_but_for_noise(search, data, one, cells, noise) for one, cells in near.items()}
    return {name: tuple(one for _, one in sorted(alike.values())) for name, alike in found.items() if alike}


def _as_good_but_for_noise(
    search: Search,
    data: DiagnosisData,
    option: Option,
    near: Sequence[tuple[str, Followed, ModelEffect]],
    noise: Mapping[str, float],
) -> dict[str, tuple[float, str]]:
    """Return channels that explain an effect as well but for noise: how far behind they are, and as what."""
    trials = FormTrials(search, data, option)
    own = trials.loss([search.library.by_key[key] for key in option.terms])
    found: dict[str, tuple[float, str]] = {}
    for label, cell, entry in near:
        cell, entry = _at_best_lag(search, data, trials, label, cell) or (cell, entry)  # noqa: PLW2901
        columns = trials.columns(term_of(entry, f"{label}({cell.name}) in place"))
        values = solve_scaled(columns @ columns.T, columns @ trials.rest)
        made = trials.root * (_acting_columns(data, entry) @ values).reshape(-1)
        variance = noise[cell.channel] * _noise_kept(data, cell)
        by_noise = np.bincount(trials.block, weights=variance * made**2, minlength=trials.blocks)
        behind = float(hac_t((trials.remaining([columns]) - own - by_noise)[:, None])[0])
        name = f"{label}({cell.channel}){cell.lag_text}"
        if behind < min(search.rules.rival_t, found.get(cell.channel, (np.inf, ""))[0]):
            found[cell.channel] = behind, name
    return found


def _near_in_place(
    search: Search, data: DiagnosisData, taken: Sequence[Option], channels: Sequence[str]
) -> dict[Option, list[tuple[str, Followed, ModelEffect]]]:
    """Return the values and responses of other channels that explain much in the place of an effect.

    Of each row of the table and channel the best one, those that explain most first; what explains as much
    beside the effect as in its place is another effect.
    """
    folds, rules = make_folds(len(search.raw)), search.rules
    cells = {
        label: [
            one
            for one in _cells(search, data, label, channels, held=True)
            if one.how in ("value", "response")
        ]
        for label in ACTS_ON.values()
    }
    found: dict[Option, dict[tuple[str, str], tuple[float, Followed, ModelEffect]]] = {}
    for label, row in _table_rows(search, data, cells).items():
        products, y = row.products, row.products.residuals[0]
        beside = score(products, search.present_in(products), row.places, y, folds)
        for option in taken:
            present = search.present_in(products, option)
            own = score(products, present, [products.index(option.columns)], y, folds)
            scores = score(products, present, row.places, y, folds)
            near = (scores.t > rules.t) & (scores.gain > FORM_SETTINGS.related * own.gain[0])
            near &= beside.gain * beside.loss0.sum() < 0.5 * scores.gain * scores.loss0.sum()
            best = found.setdefault(option, {})
            for number in np.flatnonzero(near):
                cell, gain = row.cells[number], float(scores.gain[number])
                key = label, cell.channel
                if cell.channel not in option.channels and gain > best.get(key, (0.0,))[0]:
                    best[key] = gain, cell, row.entries[cell]
    return {
        option: [
            (label, cell, entry)
            for (label, _), (_, cell, entry) in sorted(best.items(), key=lambda one: -one[1][0])[
                : FORM_SETTINGS.in_place
            ]
        ]
        for option, best in found.items()
    }


def _at_best_lag(
    search: Search, data: DiagnosisData, trials: FormTrials, label: str, cell: Followed
) -> tuple[Followed, ModelEffect] | None:
    """Return a response with the lag that leaves least, and its effect; None of a value."""
    if cell.how != "response":
        return None

    def at(lag: float) -> tuple[Followed, ModelEffect]:
        other = replace(cell, lag_s=float(f"{lag:.4g}"))
        other = replace(other, name=f"{cell.name.replace(cell.lag_text, '')}{other.lag_text}")
        entry = _entry(data, label, other)
        assert entry is not None  # the mission has the sensor: it had it for another lag
        return other, entry

    def loss(lag: float) -> Floats:
        return trials.loss([term_of(at(lag)[1], f"lag {lag:.6g}")])

    return at(best_lag(search, data, loss)[0])


def _most_noise(data: DiagnosisData, channel: str) -> float:
    """Return the variance of noise from which on a channel says nothing."""
    return ATTENUATION_SETTINGS.most * float(np.nanvar(data.series[channel]))


def _noise_kept(data: DiagnosisData, cell: Followed) -> float:
    """Return which part of the variance of white noise is left in what follows a channel."""
    if not cell.lag_s:
        return 1.0
    noise = np.random.default_rng(ATTENUATION_SETTINGS.seed).normal(size=len(data.series.tt2000))
    return float(np.var(slow_response(noise, data.series.step_s, cell.lag_s)))


def _core_name(label: str, cell: Followed) -> str:
    """Return what the core calls a cell."""
    own = {how: name for name, how in _SAME.items()}
    return f"{own[cell.how]}({cell.channel})" if label == "channel_field" and cell.how in own else ""


def scalar_channels(data: DiagnosisData) -> list[str]:
    """Return the channels of one number a time that change and are no angles."""
    series, out = data.series, []
    for name in series.channels:
        values = series[name]
        known = values[np.isfinite(values)] if values.ndim == 1 and name not in ANGLES else np.zeros(0)
        # A product with a constant is the other channel alone.
        if known.size and np.std(known) > FORM_SETTINGS.steady * np.abs(known).mean():
            out.append(name)
    return out


def driving_channels(data: DiagnosisData) -> list[str]:
    """Return the channels that may drive something: those recorded, and of geometry sunlight."""
    return [name for name in scalar_channels(data) if name not in GEOMETRY or name == "sunlit"]


def _cells(
    search: Search, data: DiagnosisData, label: str, channels: Sequence[str], held: bool = False
) -> list[Followed]:
    """Return the cells of one row of the table; those that the core has only when they are asked for.

    None where the comparison has no sensor that would show them: what is not tried counts in no p-value.
    """
    if not acting_sensors(known_effects(data.model.own)[label], data.mission, data.model):
        return []
    core = {
        (term.entry.effect.label(), *term.entry.effect.channels)
        for term in search.library.all_terms
        if term.entry.effect.channels
    }
    known = {(one[0], name) for one in core for name in one[1:]} if not held else set()
    same = {
        (_SAME[one], base)
        for one, name in known
        if one in _SAME and label == "channel_field" and name
        for base in base_channels(name)
    }
    out = []
    for channel in channels:
        values = data.series[channel]
        low, high = np.nanquantile(values, WIDTH_SETTINGS.quantiles)
        slow, about_mean = _has_history(search, channel), label not in _HAS_CONSTANT
        found = follows(channel, float(np.nanmean(values)), float(high - low), slow, about_mean)
        if _is_own_square(values):
            # A channel with two levels.
            found = [one for one in found if one.how != "square"]
        out += [one for one in found if (label, one.name) not in known and (one.how, channel) not in same]
    return out


def _has_history(search: Search, channel: str) -> bool:
    """Return whether slow responses to a channel make sense."""
    return channel not in search.library.unlagged and (channel not in GEOMETRY or channel in SLOW_GEOMETRY)


def _is_own_square(values: Floats) -> bool:
    """Return True for a channel whose square about its mean is a multiple of itself: one of two levels."""
    good = values[np.isfinite(values)].astype(np.float64)
    if not good.size or np.all((good == good.min()) | (good == good.max())):
        # Of two levels held equally long the square is constant, and correlates with nothing.
        return True
    centred = good - good.mean()
    alike = np.corrcoef(centred, centred**2)[0, 1] ** 2
    return bool(alike > VISIBILITY_SETTINGS.twin)


def _entry(data: DiagnosisData, label: str, cell: Followed) -> ModelEffect | None:
    """Return the effect of a cell; None where the mission has no sensor for it."""
    kind = known_effects(data.model.own)[label]
    sensors = acting_sensors(kind, data.mission, data.model)
    if not sensors:
        return None
    given = {"effect": label, "sensor": sensors[0].name, "channel": cell.name}
    if cell.lag_s:
        # As an option of the effect, which a refined lag replaces.
        given |= {"channel": cell.name.replace(cell.lag_text, ""), "lag": f"{cell.lag_s:g} s"}
    return effect_or_none(given, data.mission, data.model)


def _option(search: Search, data: DiagnosisData, cell: Followed, entry: ModelEffect) -> tuple[Term, Option]:
    """Return the term of a cell and the option that takes it."""
    label = entry.effect.label()
    mechanism = key = f"{label}({cell.name})"
    if cell.how == "response":
        # The refined lag takes the place of this one.
        mechanism = f"{label}({cell.name.replace(cell.lag_text, '')})"
        key = f"{mechanism}{cell.lag_text}"
    term = term_of(entry, key)
    # Another form of the same channel is no other cause: its family is that of the channel itself.
    plain = _entry(data, label, Followed("value", cell.channel, cell.channel))
    family = family_of((plain or entry).effect, data.mission)
    return term, Option(
        name=key,
        mechanism=mechanism,
        family=family,
        columns=tuple(term.columns),
        channels=base_channels(cell.name),
        terms=(key,),
        lag_s=cell.lag_s,
    )


def _shortlisted(search: Search, row: _TableRow) -> list[_Shortlisted]:
    """Return cells that nearly pass beside the model, or do as well as an effect of it, with their gain."""
    products, every = row.products, row.places
    rules, folds = search.rules, make_folds(len(products))
    together = score(products, search.present_in(products), [], products.residuals[0], folds).loss0
    gains, alone = np.zeros(len(every)), np.zeros(len(every), dtype=bool)
    taken = [[one] for one in search.accepted if one.change is None and one.channels]
    # Beside the model, in the place of each effect of it, and in the place of all of them.
    for without in ([], *taken, *([list(search.accepted)] if len(search.accepted) > 1 else [])):
        kept = search.with_accepted([one for one in search.accepted if one not in without])
        present = kept.present_in(products)
        found = score(products, present, every, products.residuals[0], folds)
        passing = found.t > FORM_SETTINGS.nearly * rules.t
        passing &= found.gain > FORM_SETTINGS.nearly * rules.gain
        if without:
            columns = [products.index(one.columns) for one in without]
            own = score(products, present, columns, products.residuals[0], folds)
            best = own.loss[:, [int(np.argmin(own.loss.sum(axis=0)))]]
            passing &= hac_t(found.loss - best) < rules.rival_t
        gains = np.maximum(gains, np.where(passing, found.gain, 0.0))
        if without and len(without) == len(search.accepted):
            alone = passing & (hac_t(found.loss - together[:, None]) < rules.rival_t)
    return [
        _Shortlisted(float(gain), cell, entry, bool(as_well))
        for gain, as_well, (cell, entry) in zip(gains, alone, row.entries.items(), strict=True)
        if gain > 0
    ]


#: Numbers of the series of cells that are formed at once: a bound on memory, 128 MB.
_AT_ONCE = 16_000_000


class CellRows:
    """The series' rows that the cells of every row of the table share.

    Attributes
    ----------
    left : ndarray, shape (sample, row, column)
        Columns of calibration and model, then the residual, weighted.
    parts : list of slice
        Rows of each block.
    given : ndarray, shape (block, column, column)
        Products of `left` with itself.
    """

    def __init__(self, search: Search, data: DiagnosisData) -> None:
        self.search, self.data = search, data
        series = data.series
        wanted = [*search.base()[0], *search.model_columns()]
        rows, made = iter_model_columns(search, series, data.sensor_matrices, search.accepted, wanted)
        root = np.sqrt(series["weight"])[:, None]
        self.left = np.empty((*rows.residual.shape, len(wanted) + 1))
        for at, column in made:
            np.multiply(column, root, out=self.left[:, :, at])
        self.left[:, :, -1] = np.where(root > 0, np.nan_to_num(rows.residual), 0.0) * root
        edges = np.searchsorted(series.block, np.arange(len(search.raw) + 1))
        self.parts = [slice(int(a), int(b)) for a, b in pairwise(edges)]
        flat = [self.left[part].reshape(-1, self.left.shape[2]) for part in self.parts]
        self.given = np.stack([one.T @ one for one in flat])

    def followed(self, cells: Sequence[Followed], about_mean: bool) -> Floats:
        """Return the series that follow channels; (sample, cell). What is constant anyway loses its mean."""
        series = self.data.series
        derived = derived_channels(series, {one.name for one in cells})
        # Cell by cell in memory, as they are written.
        out = np.empty((len(cells), len(series.tt2000)))
        for own, one in zip(out, cells, strict=True):
            values = np.asarray(derived[one.name].values) if one.name in derived else series[one.name]
            known = np.isfinite(values)
            own[:] = values - values[known].mean() if about_mean else values
            own[~known] = 0.0
        return out.T


class _CellSums:
    """Products, block by block, of cells of one row of the table, before the calibration is marginalised.

    Attributes
    ----------
    acting : ndarray, shape (sample, row, k)
        Columns of the effect with a channel that is 1, weighted.
    place : dict of Followed to int
    cross : ndarray, shape (block, column of `left`, k, cell)
    inner : ndarray, shape (block, k, k, cell)
    """

    def __init__(self, rows: CellRows, acting: Floats, cells: Sequence[Followed]) -> None:
        self.acting, self.place = acting, {one: place for place, one in enumerate(cells)}
        blocks, k = len(rows.parts), acting.shape[2]
        self.cross = np.zeros((blocks, rows.left.shape[2], k, len(cells)))
        self.inner = np.zeros((blocks, k, k, len(cells)))

    def add(self, rows: CellRows, cells: Sequence[Followed], values: Floats) -> None:
        """Add the products of those of some cells that are of this row, from their series (sample, cell)."""
        own = [place for place, one in enumerate(cells) if one in self.place]
        at = [self.place[cells[place]] for place in own]
        if not own:
            return
        for block, part in enumerate(rows.parts):
            left, on, f = rows.left[part], self.acting[part], values[part][:, own]
            for place in range(on.shape[2]):
                both = np.einsum("trm,tr->tm", left, on[..., place])
                self.cross[block][:, place, at] = both.T @ f
            square = np.einsum("trk,trl->tkl", on, on).reshape(len(f), -1)
            self.inner[block][..., at] = (square.T @ f**2).reshape(*self.inner.shape[1:3], -1)


@dataclass(frozen=True, eq=False)
class CellProducts:
    """Products of the cells of one row of the table with the model and the residual, and of each with itself.

    The calibration is marginalised. It answers what scores ask of Gram blocks (`BlockProducts`) for the
    model's columns, which come first, and the cells', k each; the residual comes last.

    Attributes
    ----------
    names : tuple of str
        Columns of the model.
    table : ndarray, shape (block, model + 1, column)
        Products of the model's columns and of the residual with all.
    inner : ndarray, shape (block, cell, k, k)
    scale : ndarray, shape (column,)
    """

    names: tuple[str, ...]
    table: Floats
    inner: Floats
    scale: Floats

    @classmethod
    def of(
        cls, rows: CellRows, asked: Mapping[str, Mapping[Followed, ModelEffect]]
    ) -> dict[str, CellProducts]:
        """Return the products of cells of several rows of the table, which follow nearly the same series.

        Parameters
        ----------
        rows : CellRows
        asked : mapping of str to mapping of Followed to ModelEffect
            Effect of the row -> its cells, with their effects: all the same but for the channel.
        """
        made: dict[str, CellProducts] = {}
        for about_mean in (False, True):
            labels = [label for label in asked if (label in _HAS_CONSTANT) == about_mean]
            made |= cls._alike(rows, {label: asked[label] for label in labels}, about_mean)
        return {label: made[label] for label in asked}

    @classmethod
    def _alike(
        cls,
        rows: CellRows,
        asked: Mapping[str, Mapping[Followed, ModelEffect]],
        about_mean: bool,
    ) -> dict[str, CellProducts]:
        """Return the same of rows that all follow channels about their means, or all as they are."""
        root = np.sqrt(rows.data.series["weight"])[:, None, None]
        sums = {
            label: _CellSums(rows, _acting_columns(rows.data, next(iter(cells.values()))) * root, list(cells))
            for label, cells in asked.items()
        }
        every = list(dict.fromkeys(cell for cells in asked.values() for cell in cells))
        for some in in_turns(slice(0, len(every)), max(1, _AT_ONCE // max(len(rows.left), 1))):
            values = rows.followed(every[some], about_mean)
            for one in sums.values():
                one.add(rows, every[some], values)
        # What one row was made of is let go before the next is made.
        return {label: cls._of_sums(rows, sums.pop(label)) for label in list(sums)}

    @classmethod
    def _of_sums(cls, rows: CellRows, sums: _CellSums) -> CellProducts:
        search, given = rows.search, rows.given.copy()
        b, k, count = len(search.base()[0]), *sums.inner.shape[2:]
        # Cell by cell: (block, left, cell * k).
        cross = np.ascontiguousarray(sums.cross.transpose(0, 1, 3, 2)).reshape(*given.shape[:2], -1)
        inner = np.ascontiguousarray(sums.inner.transpose(0, 3, 1, 2))
        _marginalise(search, cross, given, inner, b)
        table = np.concatenate([given[:, b:, b:-1], cross[:, b:], given[:, b:, -1:]], axis=2)
        model = search.model_columns()
        scale = np.concatenate([search.raw.scale[search.forms["raw"].index(model)], np.ones(count * k + 1)])
        return cls(tuple(model), table, inner, scale)

    def __len__(self) -> int:
        return len(self.table)

    @property
    def residuals(self) -> list[int]:
        """Place of the residual."""
        return [self.table.shape[2] - 1]

    def index(self, names: Sequence[str]) -> Index:
        """Return the places of columns of the model."""
        return np.array([self.names.index(name) for name in names], dtype=np.int64)

    def places(self, cell: int) -> Index:
        """Return the places of the columns of a cell."""
        k = self.inner.shape[2]
        return np.asarray(len(self.names) + cell * k + np.arange(k))

    def rows(self, columns: Index, others: Index | None = None) -> Floats:
        """Return the products of residual and columns of the model with others; (block, column, other)."""
        at = np.where(np.asarray(columns) == self.residuals[0], len(self.names), columns)
        found = self.table[:, at]
        return found if others is None else found[:, :, others]

    def products_within(self, groups: Index) -> Floats:
        """Return the products of each group's columns with each other; (block, group, k, k)."""
        first = np.asarray(groups)[:, 0]
        if first.size and first[0] < len(self.names):
            return np.stack([self.table[:, group][:, :, group] for group in groups], axis=1)
        return self.inner[:, (first - len(self.names)) // self.inner.shape[2]]


@dataclass(frozen=True, eq=False)
class _TableRow:
    """Cells of one row of the table that the mission has a sensor for, with their effects and products."""

    entries: Mapping[Followed, ModelEffect]
    products: CellProducts

    @property
    def cells(self) -> list[Followed]:
        """Which they are."""
        return list(self.entries)

    @property
    def places(self) -> list[Index]:
        """Places of the columns of each among the products."""
        return [self.products.places(number) for number in range(len(self.entries))]


def _table_rows(
    search: Search, data: DiagnosisData, cells: Mapping[str, Sequence[Followed]]
) -> dict[str, _TableRow]:
    """Return rows of the table, by their effect; only those that the mission has a sensor for."""
    entries = {
        label: {one: entry for one in own if (entry := _entry(data, label, one)) is not None}
        for label, own in cells.items()
    }
    entries = {label: own for label, own in entries.items() if own}
    if not entries:
        return {}
    products = CellProducts.of(CellRows(search, data), entries)
    return {label: _TableRow(own, products[label]) for label, own in entries.items()}


def _marginalise(search: Search, cross: Floats, given: Floats, inner: Floats, base: int) -> None:
    """Take off what the calibration, the first `base` columns, explains in each interval; in place."""
    if not base:
        return
    k = inner.shape[2]
    names, sigma = search.base()
    prior = np.diag(search.precision(search.raw, names, sigma))
    for group in search.intervals:
        at = np.asarray(group)
        normal = given[at, :base, :base].sum(axis=0) + prior
        both = np.concatenate([given[at, :base, base:].sum(axis=0), cross[at, :base].sum(axis=0)], axis=1)
        solved = solve_scaled(normal, both)
        theta, own = np.split(solved, [given.shape[2] - base], axis=1)
        cells = own.reshape(base, -1, k)
        for block in at:
            n, x, z = given[block, :base, :base], given[block, :base, base:], cross[block, :base]
            part = z.reshape(base, -1, k)
            mixed = np.einsum("nck,ncl->ckl", cells, part)
            inner[block] += np.einsum("nck,nm,mcl->ckl", cells, n, cells, optimize=True)
            inner[block] -= mixed + mixed.swapaxes(1, 2)
            left = n @ own
            cross[block, base:] += theta.T @ (left - z) - x.T @ own
            given[block, base:, base:] += theta.T @ n @ theta - theta.T @ x - x.T @ theta


def _acting_columns(data: DiagnosisData, entry: ModelEffect) -> Floats:
    """Return the columns of an effect whose channel is 1; (sample, row, k)."""
    series = data.series
    (channel,) = entry.effect.channels
    unit = derived_channels(series, {channel}).get(channel)
    attrs = (
        unit.attrs
        if unit is not None
        else {"units": series.features.units[series.features.names.index(channel)]}
    )
    one = xr.Variable(("time",), np.ones(len(series.tt2000)), attrs)
    columns = design_matrix([term_of(entry, "cell")], series.rows(data.sensor_matrices, {channel: one}))
    return np.where((series["weight"] > 0)[:, None, None], np.nan_to_num(columns), 0.0)


# Products of two channels.


def add_interactions(
    search: Search, data: DiagnosisData, tables: Sequence[ScoreTable], unexplained: bool
) -> Search:
    """Return the state with products of channels among its options; the state itself when there are none.

    Parameters
    ----------
    unexplained : bool
        Something is left: all pairs of the strongest channels are tried. Else only pairs with a channel that
        was taken, because its field may depend on another channel.
    """
    if not can_add_columns(search, data):
        return search
    known = {option.mechanism for option in search.options}
    terms = [
        term
        for one, other in _channel_pairs(search, data, tables, unexplained)
        if (term := _product(data, one, other)) is not None and term.key not in known
    ]
    terms = _promising(search, data, terms)
    if not terms:
        return search
    return join_terms(search, data, terms).with_options(
        [
            Option(
                name=term.key,
                mechanism=term.key,
                family="unknown",
                columns=tuple(term.columns),
                channels=tuple(term.entry.effect.channels[0].split("*")),
                terms=(term.key,),
            )
            for term in terms
        ]
    )


def _channel_pairs(
    search: Search, data: DiagnosisData, tables: Sequence[ScoreTable], unexplained: bool
) -> list[tuple[str, str]]:
    """Return the pairs to try: a channel that was taken with every other one; of the strongest ones all."""
    scalars = scalar_channels(data)
    taken = [name for option in search.accepted for name in option.channels if name in scalars]
    pairs = [(one, other) for one in dict.fromkeys(taken) for other in scalars if other != one]
    if unexplained:
        pairs += combinations(strongest_channels(search, data, tables), 2)
    first: dict[frozenset[str], tuple[str, str]] = {}
    for pair in pairs:
        first.setdefault(frozenset(pair), pair)
    return list(first.values())[: FORM_SETTINGS.pairs]


def strongest_channels(search: Search, data: DiagnosisData, tables: Sequence[ScoreTable]) -> list[str]:
    """Return the channels whose own effects explain most, by any round's scores; those taken come first."""
    there = set(data.series.channels)
    gains = {channel: np.inf for option in search.accepted for channel in option.channels if channel in there}
    for table in tables:
        scores = table.scores["raw"]
        for place, option in enumerate(table.options):
            if option.placebo or len(option.channels) != 1 or option.channels[0] not in there:
                continue
            name = option.channels[0]
            if data.series[name].ndim == 1 and scores.t[place] > FORM_SETTINGS.own_t:
                gains[name] = max(gains.get(name, 0.0), float(scores.gain[place]))
    scalars = [name for name in gains if data.series[name].ndim == 1]
    return sorted(sorted(scalars), key=lambda name: -gains[name])[: FORM_SETTINGS.channels]


def _product(data: DiagnosisData, one: str, other: str) -> Term | None:
    first = next(iter(data.series.features.sensors))
    entry = {"effect": "channel_field", "channel": f"{one}*{other}", "sensor": first}
    made = effect_or_none(entry, data.mission, data.model)
    return None if made is None else term_of(made, f"channel_field({one}*{other})")


def _promising(search: Search, data: DiagnosisData, terms: Sequence[Term]) -> list[Term]:
    """Return the terms that would by themselves be taken, or nearly, beside what the model has.

    Their products with the columns of the model and with the residual say so; those with all other columns of
    the library, many times as many, are made for them alone.
    """
    if not terms:
        return []
    small = join_terms(search.of_model(), data, terms)
    best = np.zeros(len(terms), dtype=bool)
    for form, grams in small.forms.items():
        columns = [grams.index(term.columns) for term in terms]
        found = score(grams, small.present(form), columns, small.y(form), make_folds(len(grams)))
        rules = search.rules
        best |= (found.t > FORM_SETTINGS.nearly * rules.t) & (found.gain > FORM_SETTINGS.nearly * rules.gain)
    return [term for term, one in zip(terms, best.tolist(), strict=True) if one]
