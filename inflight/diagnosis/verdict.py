"""From scores to a verdict: the rounds, rivals, values with errors, and what remains.

Takes the first state of a search and its `DiagnosisData`; makes the `Diagnosis` and the last state
(`run_search`). The order of the work: score table, rounds (`inflight.diagnosis.stepwise`), interactions when
something is left, rounds with shapes first when named causes may be substitutes, rivals, values, and the
description of what remains: a line, a fast band, a unit that switches without housekeeping, or what the best
rejected candidate hints at.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.design import Term
from inflight.diagnosis.attenuation import ATTENUATION_SETTINGS, Freed, Told, of_samples, without_attenuation
from inflight.diagnosis.choices import nearest_rivals, turned_over
from inflight.diagnosis.forms import (
    add_forms,
    add_interactions,
    alike_but_for_noise,
    by_one_channel,
    instead_of_several,
    left_follows,
    left_follows_field,
)
from inflight.diagnosis.model_numbers import line_of, rounded, words_of
from inflight.diagnosis.refine import (
    LAG_SETTINGS,
    LagProfile,
    bank_of,
    can_add_columns,
    error_by_lag,
    profile_lag,
)
from inflight.diagnosis.residual import (
    DiagnosisData,
    Native,
    Structure,
    contribution,
    effective_blocks,
    held_out_rms,
    native_rms,
    remaining_floor,
    remaining_residual,
    structure_of,
    with_correctable_rows,
)
from inflight.diagnosis.result import (
    LEFT,
    Coefficient,
    Diagnosis,
    FoundEffect,
    Signature,
    Status,
    Turn,
    Verdict,
    ranked_entries,
    sentence,
    stop_reason,
)
from inflight.diagnosis.scoring import ModelColumns, fit, make_folds, project_out_of
from inflight.diagnosis.search import Option, ScoreTable, Search
from inflight.diagnosis.signature import fast_part, is_unknown_band, line_signature, part_at_period
from inflight.diagnosis.stamps import stamp_readings
from inflight.diagnosis.stepwise import (
    SELECTION_SETTINGS,
    Estimate,
    RivalCheck,
    calibration_shifts,
    channels_under,
    detectable_amplitude,
    estimate,
    exchange_and_check,
    form_disagreement,
    joint_fit,
    refine_all,
    rivals_of_number,
    select_effects,
    uses_channel_of,
)
from inflight.diagnosis.wander import InTime, with_wander
from inflight.effects import channel_unit, coefficient_unit
from inflight.lsq import GramBlocks
from inflight.mission import Mission
from inflight.model import Model, ModelEffect
from inflight.progress import Progress, silent
from inflight.residual import NoiseFloor
from inflight.time import SECOND, utc_text


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """How much a diagnosis lists.

    Attributes
    ----------
    candidates : int
        Rows of the candidate table; assumed.
    separating : int
        Blocks named that separate two rivals; assumed.
    mimics : int
        Parameters of the calibration named that mimic an effect; assumed.
    chance : float
        Records without a wrong number in which one of the model's own is called wrong; stated.
    numbers : int
        Components of a wrong number that are told; assumed.
    unlike : float
        Probability below which two directions are not one; stated.
    by_chance : float
        Sets of effects in which any two happen to have one direction; stated.
    """

    candidates: int = 40
    separating: int = 3
    mimics: int = 3
    chance: float = 0.01
    numbers: int = 3
    unlike: float = 0.01
    by_chance: float = 0.01


@dataclass(frozen=True, kw_only=True)
class RemainingSettings:
    """When what remains is more than noise, and when it is news.

    Attributes
    ----------
    white : float
        Structure below this part of the noise does not make a residual coloured, however sure it is, and less
        than it within the search's means is not looked for; assumed.
    hint_t : float
        A rejected candidate hints at what remains from this held-out t on: two sigma.
    as_much : float
        A search that leaves no more than so many times as much explains as much; assumed.
    shares : float
        Part of what is left at a line's period from which on an effect has that period, too; assumed.
    nearly : float
        What is left, as a part of an effect, below which its form is nearly right though what is left follows
        another one of its kind: a wrong form would have to be 0.9987 correlated with the cause; assumed.
    """

    white: float = 0.1
    hint_t: float = 2.0
    as_much: float = 1.003
    shares: float = 1.0 / 3.0
    nearly: float = 0.05


REPORT_SETTINGS = ReportSettings()
REMAINING_SETTINGS = RemainingSettings()

#: Steps of a verdict: parameters in time, noise of readings, values, other choices, what is left, other
#: causes.
_STEPS = 6

#: Returns what a search took, and columns of other options, at the data's own cadence, for estimates;
#: None where there is nothing to estimate. The model's own numbers are something when asked for.
AtNativeCadence = Callable[[Search, bool, Sequence[Option]], Native | None]


def run_search(
    search: Search,
    data: DiagnosisData,
    native: AtNativeCadence | None = None,
    progress: Progress = silent,
) -> tuple[Diagnosis, Search]:
    """Run the search and return what it found, and its last state.

    Parameters
    ----------
    search : Search
        The first state: nothing taken yet.
    native : callable, optional
        Puts what was taken on Gram blocks at the data's own cadence; values are the search's without it.
    progress : callable
        Told the rounds, the rivals looked for, then the steps of what is said of each effect.
    """
    search, first, last = run_rounds(search, data, progress)
    search, checks, after_checks = exchange_and_check(search, data, progress)
    progress("verdict", 0, _STEPS)
    checks.sort(key=lambda one: -one.gain)
    last = after_checks or last
    # What follows needs the memory of what is only kept to be quick.
    search.shared.forget_products()
    data.columns.clear()
    other, checks, in_time = with_wander(search, checks)
    if other is not search:
        search, last = other, other.table()
    is_fast = is_left_within_bins(search, data)
    search.shared.forget_products()
    nearest = nearest_rivals(checks)
    at_native = native(search, is_fast, nearest) if native else None
    progress("verdict", 1, _STEPS)
    freed = without_attenuation(search, data, at_native)
    told_of = told_values(search, data, at_native, freed)
    progress("verdict", 2, _STEPS)
    effects = tuple(
        describe_effect(
            search, data, one, at_native, freed.get(one.option.name), told_of.get(one.option.name)
        )
        for one in checks
    )
    progress("verdict", 3, _STEPS)
    told = {one.name: np.array([number.sigma for number in one.coefficients]) for one in effects}
    turns = turned_over(search, data, checks, told, at_native, freed, told_of if at_native else None)
    progress("verdict", 4, _STEPS)
    effects = tuple(_turned(one, turns[one.name]) for one in effects)
    fast_numbers = at_native.search if is_fast and at_native else None
    effects = tuple(_in_words(one, in_time) for one in effects)
    known = with_correctable_rows(search, data)
    residual = remaining_residual(search, known)
    lost = {str(day): reason for day, reason in sorted(data.lost.items())}
    blocks = effective_blocks(search, known, residual) | {
        "lost": lost,
        "start": utc_text(int(search.raw.start[0])),
        "end": utc_text(int(search.raw.end[-1])),
        "samples": int(data.sums.get("count", 0.0)),
    }
    structure = structure_of(known.series, residual)
    remaining = describe_remaining(search, known, last, residual, structure, fast_numbers)
    progress("verdict", 5, _STEPS)
    after = remaining.verdict(blocks["independent"], search.rules.blocks)
    effects = held_against_others(search, known, effects, residual, remaining)
    progress("verdict", _STEPS, _STEPS)
    effects = tuple(sorted(effects, key=lambda one: -one.rms_nT))
    signature = remaining.signature if after == "UNKNOWN_EFFECT" else None
    facts: dict[str, Any] = {
        "effects": effects,
        "signature": signature,
        "residual": _residual_sizes(search, known, remaining, fast_numbers),
        "remaining": after,
        "blocks": blocks,
        "outliers": data.outliers.as_json(),
        "unscorable": unscorable(search),
        "fewest": search.rules.blocks,
        "refined": refined_at_both(search, fast_numbers),
        "empirical": tuple(data.model.empirical),
    }
    entries = ranked_entries(facts)
    verdict = entries[0].verdict if entries else after
    own = signature
    if entries and entries[0].status == "unknown" and entries[0].name != LEFT:
        # The largest effect was taken for its shape and names no cause.
        own = Signature(
            channel="*".join(effects[0].channels) or None,
            lag_s=effects[0].lag_s,
            axis=effects[0].axes[0] if len(effects[0].axes) == 1 else None,
            shape=effects[0].name,
            amplitude_nT=effects[0].rms_nT,
            gain=effects[0].gain,
        )
    rivals, separating = confusion(search, checks)
    found = Diagnosis(
        verdict=verdict,
        sentence=sentence(facts),
        entries=entries,
        effects=effects,
        confusion_set=rivals,
        separating=separating,
        unscorable=facts["unscorable"],
        signature=own if verdict == "UNKNOWN_EFFECT" else None,
        remaining={"verdict": after, "signature": signature},
        residual=facts["residual"],
        rounds=tuple(one.as_json() for one in search.rounds),
        candidates=candidate_rows(search, first, last),
        refined=facts["refined"],
        in_time=tuple(one.as_json() for one in in_time),
        blocks=blocks,
        stopped=stop_reason(facts, search.rules.rounds, search.ran_out),
        comparison=data.model.comparison,
        model={
            "name": data.model.name,
            "version": data.model.version,
            "empirical": list(facts["empirical"]),
        },
        context=data.context_id,
        run=data.run,
        outliers=facts["outliers"],
    )
    return found, search


def is_left_within_bins(search: Search, data: DiagnosisData) -> bool:
    """Return True when more than noise is left, and it is faster than the samples of the search."""
    more = native_rms(data, search) ** 2 - data.floor.high_nT**2
    return bool(more > (REMAINING_SETTINGS.white * data.floor.level_nT) ** 2)


def held_against_others(
    search: Search,
    data: DiagnosisData,
    effects: Sequence[FoundEffect],
    residual: Floats,
    remaining: Remaining,
) -> tuple[FoundEffect, ...]:
    """Return effects with the other forms, sums and channels that do as well, and what is left of their kind.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        What the search leaves of the series, nT.
    """
    left = left_follows_field(search, data) | left_follows(search, data) if remaining.is_there else {}
    shared = share_line(search, data, residual, remaining.signature)
    instead = of_one_direction(effects) | of_one_response(effects) | by_one_channel(search, data)
    # Of a long record all columns together are hundreds of megabytes: each of these makes its own.
    data.columns.clear()
    instead |= instead_of_several(search, data)
    alike = alike_but_for_noise(search, data)
    out = []
    for effect in effects:
        one = replace(
            _with_rivals(effect, alike.get(effect.name, ())),
            left_follows=left.get(effect.name, ""),
            instead=instead.get(effect.name, ""),
            shares_line=effect.name in shared,
        )
        is_nearly_right = remaining.structure.rms_nT < REMAINING_SETTINGS.nearly * one.rms_nT
        is_other = bool(one.left_follows) and not is_nearly_right
        is_stand_in = one.status == "sure" and (is_other or bool(one.instead))
        out.append(replace(one, status="stand-in") if is_stand_in else one)
    return tuple(out)


def _with_rivals(effect: FoundEffect, more: Sequence[str]) -> FoundEffect:
    """Return an effect with further causes that do as well in its place."""
    rivals = tuple(dict.fromkeys((*effect.rivals, *more)))
    # What a choice of numbers turns over stays fragile, with its rival named.
    is_unsure = effect.status in ("fragile", "unknown")
    return replace(effect, rivals=rivals, status="rivals" if more and not is_unsure else effect.status)


def share_line(
    search: Search, data: DiagnosisData, residual: Floats, signature: Signature | None
) -> set[str]:
    """Return the effects that make a line of the period of the one that is left, no smaller than a third."""
    if signature is None or not signature.period_s:
        return set()
    period = signature.period_s
    least = REMAINING_SETTINGS.shares * part_at_period(data, residual, period)
    return {
        one.name
        for one in search.accepted
        if part_at_period(data, contribution(search, data, one), period) > least
    }


def of_one_direction(effects: Sequence[FoundEffect]) -> dict[str, str]:
    """Return the fields that may be one: effect -> the sum of channels that all of them together follow.

    Fields of independent sources have directions of their own. Where two channels of one unit make the same
    field, or the opposite one, or three or more make fields of one direction, one source does as well: a
    current that nobody records and that is a sum of others (Kirchhoff), a difference of temperatures. Two
    directions are one within their errors when ``min_k (w - k v)' (S_w + k^2 S_v)^-1 (w - k v)`` is as
    small as chi-square of two degrees of freedom; it counts where so near a direction is no chance: a part
    ``1 - cos(angle)`` of all directions lies within an angle of a line.
    """
    limit = -2.0 * np.log(REPORT_SETTINGS.unlike)
    fields = [
        one
        for one in effects
        if one.name == f"channel_field({one.channels[0] if len(one.channels) == 1 else ''})"
        and len(one.coefficients) == 3
        and all(part.sigma > 0 for part in one.coefficients)
    ]
    pairs = max(len(fields) * (len(fields) - 1) // 2, 1)
    out: dict[str, str] = {}
    vectors = {
        one.name: np.array([[part.value, part.sigma] for part in one.coefficients]).T for one in fields
    }

    # The best known direction first: others are held against it.
    for first in sorted(fields, key=lambda one: _squared_angle(vectors[one.name], limit)):
        if first.name in out:
            continue
        parts, same, own = [(1.0, first)], 0, vectors[first.name]
        for other in fields:
            is_alike = other.coefficients[0].unit == first.coefficients[0].unit
            if other is first or other.name in out or not is_alike:
                continue
            found = vectors[other.name]
            ratio, error, apart = _ratio(found, own)
            angle = np.sqrt(_squared_angle(own, limit) + _squared_angle(found, limit))
            by_chance = 1.0 - np.cos(min(angle, np.pi / 2))
            if apart < limit and pairs * by_chance < REPORT_SETTINGS.by_chance:
                parts.append((ratio, other))
                same += (abs(ratio) - 1.0) ** 2 < limit * error**2
        if len(parts) > 2 or same:
            whole = first.channels[0]
            for ratio, one in parts[1:]:
                whole += f" {'-' if ratio < 0 else '+'} {abs(ratio):.3g} * {one.channels[0]}"
            out |= dict.fromkeys((one.name for _, one in parts), f"a field that follows {whole}")
    return out


def of_one_response(effects: Sequence[FoundEffect]) -> dict[str, str]:
    """Return the lagged fields that may be one: effect -> the one response that does as well as both.

    A channel whose field is taken twice, with two lags, is either two sources or one whose response is no
    single lag: a delay is nearly a difference of lags. One source has one direction, or one matrix but for a
    factor. Where both are that within their errors (`_ratio`, with a degree of freedom less than numbers),
    the data do not tell; one source is taken for two in a part `unlike` of all cases, or in fewer: errors of
    similar lags are correlated.
    """
    out: dict[str, str] = {}
    for first, second in combinations(effects, 2):
        both = first.coefficients, second.coefficients
        same = first.name.partition("@")[0] == second.name.partition("@")[0] and first.channels
        if (
            not same
            or first.lag_s == second.lag_s
            or [one.unit for one in both[0]] != [one.unit for one in both[1]]
        ):
            continue
        parts = [np.array([[one.value, one.sigma] for one in each]).T for each in both]
        if len(both[0]) < 2 or min(float(part[1].min()) for part in parts) <= 0:
            continue
        if _ratio(*parts)[2] < scipy.special.chdtri(len(both[0]) - 1, REPORT_SETTINGS.unlike):
            words = f"one response to {' and '.join(first.channels)} that is no single lag, such as a delay,"
            out |= {first.name: words, second.name: words}
    return out


def _squared_angle(vector: Floats, limit: float) -> float:
    """Return the square of the angle within which a direction is known, by a limit of chi-square; rad^2."""
    value, sigma = vector
    return float(limit * np.mean(sigma**2) / np.sum(value**2))


def _ratio(vector: Floats, other: Floats) -> tuple[float, float, float]:
    """Return how many times another vector a vector is, the error of that, and chi-square of what is left.

    Both are (2, axis): values and their sigmas.
    """
    (found, error), (value, sigma) = vector, other
    ratio, apart, ratio_error = 0.0, np.inf, 0.0
    for _ in range(4):
        weight = 1.0 / (error**2 + (ratio * sigma) ** 2)
        ratio = float(np.sum(weight * value * found) / np.sum(weight * value**2))
        apart = float(np.sum(weight * (found - ratio * value) ** 2))
        ratio_error = float(np.sum(weight * value**2) ** -0.5)
    return ratio, ratio_error, apart


def _turned(effect: FoundEffect, turns: Sequence[Turn]) -> FoundEffect:
    """Return an effect with the choices of numbers that turn it over: it is not sure then."""
    if not turns:
        return effect
    status = "fragile" if effect.status in ("sure", "weak") else effect.status
    return replace(effect, turned_over_by=tuple(turns), status=status)


def _in_words(effect: FoundEffect, in_time: Sequence[InTime]) -> FoundEffect:
    """Return an effect with the words for a parameter that wanders, if it is one."""
    for one in in_time:
        if one.window_blocks and one.name == effect.name:
            return replace(effect, said=one.words(effect.coefficients[0].unit))
    return effect


def run_rounds(
    search: Search, data: DiagnosisData, progress: Progress = silent
) -> tuple[Search, ScoreTable, ScoreTable]:
    """Return the state after all rounds, the first table and the last one.

    Interactions are tried when something is left, shapes first when named causes may be substitutes.
    """
    search, first, last = select_effects(search, data, progress=progress)
    if not search.rules.rounds:
        return search, first, last
    known = with_correctable_rows(search, data)
    residual = remaining_residual(search, known)
    remaining = describe_remaining(search, known, last, residual, structure_of(known.series, residual))
    for forms in (True, False):
        # Products come last, when each factor was tried in all its forms.
        if len(search.accepted) < search.rules.rounds and (remaining.is_sure or search.accepted):
            options, alone = search.options, False
            stage = "other forms" if forms else "products"
            progress(stage, 0, 1)
            if forms:
                search, alone = add_forms(search, data)
            else:
                search = add_interactions(search, data, [first, last], remaining.is_sure)
            if search.options is not options:
                search, _, last = select_effects(search, data, progress=progress, stage=stage)
            else:
                progress(stage, 1, 1)
            if alone and len(search.accepted) > 1:
                # One cause in the form that is there now may be what several stood in for.
                search, last = _afresh(search, data, last, progress)
    # Named causes that shapes without a name had to complete: either both are there, or the named ones
    # together substitute something that no effect here describes.
    shapes = [one for one in search.accepted if _is_shape(one)]
    if shapes and len(search.accepted) > max(len(shapes), 2):
        search, last = _afresh(search, data, last, progress, shapes_first=True)
    return refine_all(search, data), first, last


def _afresh(
    search: Search, data: DiagnosisData, last: ScoreTable, progress: Progress, shapes_first: bool = False
) -> tuple[Search, ScoreTable]:
    """Search anew; keep it when fewer effects explain as much, else what was found.

    Fewer effects that name causes must have no more coefficients together: one wide form of two dozens of
    them explains what several causes make as well, and is none of them. Of a shape without a name that is no
    objection: it claims no cause.
    """
    before = held_out_rms(search, data)
    blank = replace(search, accepted=(), rounds=(), banned=frozenset(), dropped=frozenset(), freed={})
    other, _, table = select_effects(blank.with_safe_intervals(), data, shapes_first, progress, "search anew")
    fewer = len(other.accepted) < len(search.accepted)
    if not any(_is_shape(one) for one in other.accepted):
        fewer &= _coefficients_of(other) <= _coefficients_of(search)
    if fewer and held_out_rms(other, data) <= REMAINING_SETTINGS.as_much * before:
        return other, table
    return other.with_choices_of(search), last


def _coefficients_of(search: Search) -> int:
    """Return how many coefficients the effects have that a search took."""
    return sum(len(one.columns) for one in search.accepted)


def describe_effect(
    search: Search,
    data: DiagnosisData,
    check: RivalCheck,
    native: Native | None = None,
    freed: Freed | None = None,
    told: Told | None = None,
) -> FoundEffect:
    """Return an effect of the model with its values and errors, and how it stands against rivals.

    Parameters
    ----------
    native : Native, optional
        What was taken, at the cadence of the samples.
    freed : Freed, optional
        Its values without what noise of the readings takes off them. Where it takes more off those of the
        samples, and these are too many for it to be taken off, theirs are not told.
    told : Told, optional
        Its values from the samples (`told_values`); those of the search when absent.
    """
    option = check.option
    found = estimate(search, option) if freed is None else freed.estimate
    value, takes, from_samples = found, freed, None
    if told is not None:
        value, takes = told
        from_samples = None if native is None else value
    elif native is not None and not _is_noisier(freed):
        from_samples = estimate(native.search, option)
        # What depends on the cadence of the samples is known no better than that.
        value = from_samples.covering(found)
    terms = [search.library.by_key[key] for key in option.terms]
    lag_sigma = option.lag_sigma_s
    if lag_sigma is None and option.lag_s:
        profile = lag_profile(search, option)
        lag_sigma = None if profile is None else profile.sigma
    if lag_sigma and freed is not None:
        lag_sigma = float(np.hypot(lag_sigma, freed.lag_error_s))
    if lag_sigma and (by_lag := error_by_lag(search, data, option, lag_sigma)) is not None:
        # Values and lag were fitted together: what the lag does not know they do not.
        value = value.with_error(by_lag)
    if option.number_sigma and terms[0].difference:
        # A fit of the whole change is no better than where the search, at its own cadence, put the number.
        off = abs(float(value.value[0]) - terms[0].difference.apart)
        value = value.with_least_error(max(option.number_sigma, off))
    coefficients = _coefficients(search, data, option, terms, value)
    said, command = _of_number(data, option, terms, coefficients)
    rivals = tuple(rival.mechanism for rival, _ in check.rivals)
    if found.retained < SELECTION_SETTINGS.weak and not _is_shape(option):
        rivals += tuple(name for name, _ in _worst_mimics(search, option, found))
    return FoundEffect(
        name=option.name,
        family=option.family,
        channels=option.channels,
        axes=tuple(
            dict.fromkeys(axis(one.name) for one in coefficients if one.stands_out and axis(one.name))
        ),
        coefficients=coefficients,
        gain=check.gain,
        t=check.t,
        flip_p=check.p,
        retained=found.retained,
        lag_s=option.lag_s,
        lag_sigma_s=lag_sigma,
        placebo_t=check.placebo_t,
        consistency=form_disagreement(search, option),
        rms_nT=found.rms,
        rivals=rivals,
        at=tuple(utc_text(when) for when in option.change.at) if option.change else (),
        at_sigma_s=option.change.sharpness / SECOND if option.change and option.change.at else None,
        entries=tuple(term.entry.as_yaml() for term in terms if not term.span and term.difference is None),
        cadence_s=native.cadence_s if native is not None and from_samples is not None else data.cadence_s,
        cadence_shift=from_samples.shift_in_sigmas(found) if from_samples is not None else None,
        status=_status(search, check, rivals),
        model_effects=() if option.number else _sharing(data.model, option),
        said=said,
        command=command,
        stamp_readings=_stamp_readings(data, option, coefficients),
        noise_of=takes.source if takes else None,
        noise_part=takes.part if takes else None,
        first_in_nT=estimate(search.with_accepted([option]), option).rms,
    )


def told_values(
    search: Search, data: DiagnosisData, native: Native | None, freed: Mapping[str, Freed]
) -> dict[str, Told]:
    """Return the values of effects from the samples, by name; nothing where these are too many.

    They do not depend on the cadence of the search, so that the same is told at any.
    """
    if native is None:
        return of_samples(search, data, freed) if can_add_columns(search, data) else {}
    own = native.data(data)
    if own is None or not can_add_columns(native.search, own):
        return {}
    return of_samples(native.search, own, without_attenuation(native.search, own))


def _is_noisier(freed: Freed | None) -> bool:
    """Return True when noise takes more off the samples' values than these are worth."""
    return freed is not None and freed.at_native > ATTENUATION_SETTINGS.native


def _of_number(
    data: DiagnosisData, option: Option, terms: Sequence[Term], coefficients: Sequence[Coefficient]
) -> tuple[str, str]:
    """Return what the data say of numbers that the model holds, and what mends them; nothing of an effect."""
    if len(terms) != 1 or option.change is not None:
        return "", ""
    if terms[0].difference is not None:
        number, only = terms[0].difference.number, coefficients[0]
        value = number.value + only.value
        return words_of(number, value, only.sigma, only.unit), line_of(number, value, only.sigma)
    own = next((one for one in data.model.effects if _is_held_as(one, terms[0].entry)), None)
    if own is None:
        return "", ""
    # The same effect once more: what it adds is what the model's own numbers lack.
    held = {
        name: (float(value), timed.parameter.unit)
        for timed in own.parameters.values()
        for name, value in zip(timed.columns, timed.value[:, 0], strict=True)
    }
    words, settings = [], []
    for one in coefficients:
        name = f"{own.name}.{one.name}"
        value, unit = held.get(name, (0.0, ""))
        if name not in held or unit != one.unit:
            return "", ""
        settings.append(f'"{name}={rounded(value + one.value, one.sigma)}"')
        if one.stands_out:
            says = f"the data say {rounded(value + one.value, one.sigma)} +- {one.sigma:.2g} {unit}"
            words.append(f"{one.name} is {value:.3g} {unit}, {says}")
    more = ", ..." if len(words) > REPORT_SETTINGS.numbers else ""
    listed = "; ".join(words[: REPORT_SETTINGS.numbers]) + more
    said = f"numbers that {own.name} of the model holds are wrong ({listed})"
    return (said, f"inflight set {' '.join(settings)}") if words else ("", "")


def _is_held_as(own: ModelEffect, entry: ModelEffect) -> bool:
    """Return True for an effect that the model has, with the same options and all its numbers held."""
    same = type(own.effect) is type(entry.effect) and own.effect.channels == entry.effect.channels
    same &= own.effect.given == entry.effect.given and own.sensor.name == entry.sensor.name
    still = all(timed.time == "constant" and not timed.free for timed in own.parameters.values())
    return bool(same and still)


def _stamp_readings(
    data: DiagnosisData, option: Option, coefficients: Sequence[Coefficient]
) -> tuple[str, ...]:
    """Return what a clock that is off all the time may be instead."""
    if option.family != "clock" or option.change or [one.unit for one in coefficients] != ["s"]:
        return ()
    only = coefficients[0]
    sign = -1.0 if option.mechanism == "vector_clock" else 1.0
    return stamp_readings(data.mission, data.model.comparison, sign * only.value, only.sigma)


def _sharing(model: Model, option: Option) -> tuple[str, ...]:
    """Return the effects of the model that use a channel of an option; without one, those of its kind."""
    label, own = option.mechanism.split("(")[0], set(option.channels)
    return tuple(
        entry.name
        for entry in model.effects
        if (own & channels_under(entry.effect.channels) if own else entry.effect.label() == label)
    )


def _status(search: Search, check: RivalCheck, rivals: Sequence[str]) -> Status:
    """Return how sure an effect is, by its rivals and by what it takes off with all others in the model."""
    if rivals:
        return "rivals"
    if _is_shape(check.option):
        return "unknown"
    return "sure" if search.rules.firm((check.gain, check.t)) else "weak"


def axis(name: str) -> str:
    """Return the axis a column's name ends with; empty when it has none."""
    return name.rsplit("[", maxsplit=1)[-1].rstrip("]") if "[" in name else ""


def _coefficients(
    search: Search, data: DiagnosisData, option: Option, terms: list[Term], found: Estimate
) -> tuple[Coefficient, ...]:
    out = []
    for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True):
        # A change in time has the unit of what changes.
        source = option.change.functions.get(column, (column,))[0] if option.change is not None else column
        every = [*terms, *search.library.all_terms]
        term = next((term for term in every if source in term.columns), None)
        unit, at = "", "difference"
        if term is not None:
            unit = column_unit(data.mission, term, source)
            at = "difference" if term.entry.is_additive else term.entry.sensor.name
        if option.change is not None:
            unit += option.change.unit
        out.append(Coefficient(column.rsplit(".", 1)[-1], float(value), float(sigma), unit, at))
    return tuple(out)


def column_unit(mission: Mission, term: Term, column: str) -> str:
    """Return the unit of the coefficient of a term's column."""
    if term.difference is not None:
        number = term.difference.number
        return number.unit or (channel_unit(mission, number.channel) or "" if number.channel else "")
    kind = term.entry.effect.parameters()[column[len(term.key) + 1 :].split("[", maxsplit=1)[0]]
    channel = term.entry.effect.channels[0] if term.entry.effect.channels else ""
    return coefficient_unit(kind, mission, channel) if channel else kind.unit


def lag_profile(search: Search, option: Option) -> LagProfile | None:
    """Return how well each lag would do in an option's place; None when its mechanism has no lags."""
    form, bank = search.forms["raw"], bank_of(search, option)
    if len(bank) < LAG_SETTINGS.fewest or option.change is not None:
        return None
    return profile_lag(form, search.present("raw", option), bank, search.y(), make_folds(len(form)))


def _worst_mimics(search: Search, option: Option, found: Estimate) -> list[tuple[str, float]]:
    """Return the calibration's parameters that shift most, in their usual size, if the effect is ignored."""
    shifts = calibration_shifts(search, option, found.value)
    scale = dict(zip(search.raw.names, search.raw.scale, strict=True))
    ordered = sorted(shifts, key=lambda pair: -abs(pair[1]) / scale[pair[0]])
    return ordered[: REPORT_SETTINGS.mimics]


def confusion(
    search: Search, checks: list[RivalCheck]
) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    """Return the rivals of every confounded effect, and the blocks that would separate them."""
    confusion: list[dict[str, Any]] = []
    separating: list[dict[str, Any]] = []
    for one in checks:
        found = estimate(search, one.option)
        weak = found.retained < SELECTION_SETTINGS.weak
        if not one.rivals and not weak:
            continue
        confusion.append(
            {
                "name": one.option.name,
                "family": one.option.family,
                "channels": one.option.channels,
                "behind_t": 0.0,
            }
        )
        for rival, behind in one.rivals:
            confusion.append(
                {"name": rival.name, "family": rival.family, "channels": rival.channels, "behind_t": behind}
            )
            separating += _separating(search, one.option, rival)
        if weak:
            for name, shift in _worst_mimics(search, one.option, found):
                confusion.append({"name": name, "family": "sensor", "channels": (), "shift": shift})
    return tuple(confusion), tuple(separating)


def _separating(search: Search, option: Option, rival: Option) -> list[dict[str, Any]]:
    """Return the blocks in which two rivals' contributions differ most, and by how much there."""
    if option.change is not None or rival.change is not None:
        return []
    grams = search.forms["raw"]
    one, other = grams.index(option.columns), grams.index(rival.columns)
    present, y = search.present("raw", option), search.y()
    (first, second), _ = fit(grams, present, [one, other], y)
    both = np.concatenate([one, other])
    weights = np.concatenate([first, -second])
    sums = np.einsum("i,bij,j->b", weights, grams.rows(both, both), weights)
    rms = np.sqrt(np.clip(sums, 0.0, None) / np.maximum(grams.count, 1.0))
    best = np.argsort(-rms)[: REPORT_SETTINGS.separating]
    return [
        {
            "rivals": [option.name, rival.name],
            "start": utc_text(int(grams.start[place])),
            "end": utc_text(int(grams.end[place])),
            "difference_nT": float(rms[place]),
        }
        for place in best
    ]


def unscorable(search: Search) -> tuple[dict[str, Any], ...]:
    """Return what these data cannot show, and why; each name once."""
    out: dict[str, dict[str, Any]] = {}
    for one in [*search.unscorable, *search.library.unscorable]:
        out.setdefault(str(one["name"]), dict(one))
    return tuple(out.values())


def candidate_rows(search: Search, first: ScoreTable, last: ScoreTable) -> tuple[dict[str, Any], ...]:
    """Return the best options of the first round, with their gain now: of taken ones it is nothing."""
    now = {option.name: place for place, option in enumerate(last.options)}
    best: dict[str, dict[str, Any]] = {}
    scores = first.scores["raw"]
    square = float(scores.loss0.sum()) / max(float(search.forms["raw"].count.sum()), 1.0)
    for place in np.argsort(-scores.gain):
        option = first.options[place]
        if option.mechanism in best:
            continue
        after = float(last.scores["raw"].gain[now[option.name]]) if option.name in now else 0.0
        best[option.mechanism] = {
            "name": option.name,
            "family": option.family,
            "channels": option.channels,
            "placebo": option.placebo,
            "gain": float(scores.gain[place]),
            "takes_off_nT": float(np.sqrt(max(float(scores.gain[place]), 0.0) * square)),
            "t": float(scores.t[place]),
            "p": float(min(first.p[form][place] for form in first.p)),
            "placebo_t": float(first.t_over_placebo["raw"][place]),
            "gain_now": after,
        }
    rows = list(best.values())
    real = [row for row in rows if not row["placebo"]][: REPORT_SETTINGS.candidates]
    return tuple(real + [row for row in rows if row["placebo"]][: REPORT_SETTINGS.candidates])


def refined_parameters(search: Search, with_rivals: bool = True) -> tuple[dict[str, Any], ...]:
    """Return the model's own parameters that data moved, within what was known of them.

    Those that are wrong come with what explains as much, which takes the options of a search (`with_rivals`).
    A number that moves only beside what was taken was fitted while that was missing: it is not wrong by
    itself, and moves with the addition.
    """
    grams, present = search.forms["raw"], search.present()
    names = [name for term in search.library.refined for name in term.columns]
    sigma = [s for term in search.library.refined for s in term.sigma]
    if not names:
        return ()
    value, covariance = joint_fit(grams, present, search.y())
    rows = max(float(grams.count.sum()), 1.0)
    square = float(grams.squares[:, search.y()].sum()) / rows
    groups: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        groups.setdefault(name.removeprefix("model:").partition("[")[0], []).append(place)
    far_of = _far_numbers(grams, present, search.y(), list(groups.values()), sigma)
    nothing = replace(search.with_accepted([]), freed={}).present() if search.accepted else present
    far_alone = _far_numbers(grams, nothing, search.y(), list(groups.values()), sigma)
    scale = grams.scale[present.columns]
    out: list[dict[str, Any]] = []
    for (name, places), far, alone in zip(groups.items(), far_of, far_alone, strict=True):
        others = np.setdiff1d(np.arange(present.columns.size), places)
        rest = ModelColumns(present.columns[others], present.precision[others])
        left = project_out_of(grams, rest, present.columns[places])
        moved = value[places]
        # What all of its components take off when everything else is fitted anew without them.
        size = float(np.sqrt(max(float(moved @ left @ moved), 0.0) / rows))
        group: list[dict[str, Any]] = [
            {
                "name": names[place].removeprefix("model:"),
                "moved": float(value[place] * scale[place]),
                "sigma": float(np.sqrt(max(covariance[place, place], 0.0)) * scale[place]),
                "known": float(sigma[place]),
                "rms_nT": size,
                "wrong": False,
                "rivals": (),
            }
            for place in places
        ]
        out += group
        # Below what an addition must explain, what is only nearly right elsewhere moves numbers as far.
        matters = size**2 > search.rules.gain * square
        number = f"model:{name}"
        freed = search.freed.get(number)
        if freed and any(uses_channel_of(search, number, one) for one in search.accepted):
            # The response to its channel is another one: the number is a part of that.
            wrong = False
        else:
            wrong = bool(far and (freed or (matters and alone)))
        rivals = rivals_of_number(search, number) if wrong and with_rivals else ()
        for one in group:
            one["wrong"], one["instead_of"], one["rivals"] = wrong, freed, rivals
    return tuple(out)


def _far_numbers(
    grams: GramBlocks, present: ModelColumns, y: int, groups: Sequence[Sequence[int]], known: Sequence[float]
) -> list[bool]:
    """Return which groups of the model's own numbers data move further than is stated of them.

    In one record of a hundred one of all the numbers is further off by chance, or one component.

    Parameters
    ----------
    groups : sequence of sequence of int
        Places of each group's numbers among the columns of the model.
    known : sequence of float
        What is stated of each number, physical units.
    """
    value, covariance = joint_fit(grams, present, y)
    scale = grams.scale[present.columns]
    error = np.sqrt(np.clip(np.diag(covariance), 0.0, None)) * scale
    count = len(known)
    off = (value[:count] * scale[:count] / np.hypot(known, error[:count])) ** 2
    chance = 0.5 * REPORT_SETTINGS.chance
    return [
        bool(
            off[list(places)].sum() > scipy.special.chdtri(len(places), chance / len(groups))
            or off[list(places)].max() > scipy.special.chdtri(1, chance / count)
        )
        for places in groups
    ]


def refined_at_both(search: Search, at_native: Search | None) -> tuple[dict[str, Any], ...]:
    """Return the model's own parameters as the search moved them; those only faster samples show wrong, so.

    A torquer that pulses every second hardly shows in means of ten.
    """
    found = refined_parameters(search)
    if at_native is None:
        return found
    known = {one["name"].partition("[")[0] for one in found if one["wrong"]}
    fast = {one["name"]: one for one in refined_parameters(at_native, with_rivals=False) if one["wrong"]}
    return tuple(
        one if one["name"].partition("[")[0] in known else fast.get(one["name"], one) for one in found
    )


@dataclass(frozen=True)
class Remaining:
    """What remains after everything that was taken.

    Attributes
    ----------
    structure : Structure
    has_line : bool
        A line stands out that no known period explains.
    signature : Signature or None
        None when nothing is there.
    noise : float
        Noise floor, nT; of a record without one, the residual's own size.
    floor : NoiseFloor
        Of what remains, with its interval.
    has_band : bool
        Most of what is missing is too fast for the search and lies in one band no known period explains.
    has_unit : bool
        Two sensors show that something switches without housekeeping.
    """

    structure: Structure
    has_line: bool
    signature: Signature | None
    noise: float
    floor: NoiseFloor
    has_band: bool = False
    has_unit: bool = False

    @property
    def is_there(self) -> bool:
        """True when what remains may be more than noise: large, or significantly not white."""
        coloured = self.structure.is_sure and self.structure.rms_nT > REMAINING_SETTINGS.white * self.noise
        certain = self.has_line or self.has_band or self.has_unit
        return certain or self.structure.is_large(self.noise) or coloured

    @property
    def is_sure(self) -> bool:
        """True when what remains is significantly more than noise."""
        certain = self.has_line or self.has_band or self.has_unit
        return certain or (self.structure.is_sure and self.structure.is_large(self.noise))

    def verdict(self, independent: float, fewest: int) -> Verdict:
        """Return the verdict on what remains, from so many independent blocks of the fewest that it takes."""
        if not self.is_there:
            return "NOTHING_LEFT"
        return "UNKNOWN_EFFECT" if self.is_sure and independent >= fewest else "NOT_IDENTIFIABLE"


def describe_remaining(
    search: Search,
    data: DiagnosisData,
    last: ScoreTable,
    residual: Floats,
    structure: Structure,
    at_native: Search | None = None,
) -> Remaining:
    """Describe what remains: a line, else what the best rejected candidate hints at, else its size.

    With `at_native`, the size is that which the model's numbers leave of all samples.
    """
    known = 1.0 - data.gaps.part if data.gaps else 1.0
    floor = remaining_floor(data.series, residual, known * data.sums.get("count", 0.0), data.floor)
    noise = floor.level_nT
    if not noise > 0:
        good = data.series["weight"] > 0
        noise = float(np.sqrt(np.mean(residual[good] ** 2))) if good.any() else float("nan")
    unit = unrecorded_unit(data)
    if unit is not None:
        return Remaining(structure, False, unit, noise, floor, has_unit=True)
    line = line_signature(data, residual)
    found = Remaining(structure, line is not None, line, noise, floor)
    if line is not None:
        return found
    size, _ = sizes_left(search, data, at_native)
    fast = fast_part(data.series, residual, size, floor.level_nT, structure)
    found = replace(found, has_band=fast is not None and is_unknown_band(data, fast))
    if not found.is_there:
        return found
    hint = _hint_signature(search, last, structure)
    if fast is not None:
        # A channel that the slow part hints at stays in the signature of what is fast.
        hint = replace(
            hint if hint.channel else Signature(),
            shape="fast",
            amplitude_nT=fast.rms_nT,
            faster_than_s=fast.faster_than_s,
            periods_s=fast.periods_s,
        )
    return replace(found, signature=hint)


def sizes_left(search: Search, data: DiagnosisData, at_native: Search | None) -> tuple[float, float]:
    """Return the rms that is left, in sample and held out, nT; with `at_native`, all samples' own.

    Where rows lack a channel of what was taken, those of the search are told that have it.
    """
    if at_native is None or data.gaps is not None:
        return native_rms(data, search), held_out_rms(search, data)
    whole = replace(data, gaps=None, sums={})
    return native_rms(whole, at_native), held_out_rms(at_native, whole)


def unrecorded_unit(data: DiagnosisData) -> Signature | None:
    """Return the signature of the unit without housekeeping that switches most often, of two sensors."""
    if data.switched is None or not data.switched.unexplained:
        return None
    step, sigma, count = data.switched.units[0]
    return Signature(
        shape="unit without housekeeping",
        axis="xyz"[int(np.argmax(np.abs(step)))],
        amplitude_nT=float(np.abs(step).max()),
        steps={name: (float(a), float(b)) for name, a, b in zip("xyz", step, sigma, strict=True)},
        switchings=count,
    )


def _hint_signature(search: Search, last: ScoreTable, structure: Structure) -> Signature:
    """Return the signature that the best rejected candidate hints at, if it explains anything held out."""
    scores = last.scores["raw"]
    real = [
        place
        for place, option in enumerate(last.options)
        if not option.placebo and scores.t[place] > REMAINING_SETTINGS.hint_t
    ]
    if not real:
        return Signature(shape="wander", amplitude_nT=structure.rms_nT)
    best = max(real, key=lambda place: (last.options[place].change is None, float(scores.gain[place])))
    option, gain = last.options[best], float(scores.gain[best])
    along = None
    if option.change is None and len(option.columns) == 3:
        # The largest coefficient, in units of what is detectable.
        grams = search.forms["raw"]
        columns = grams.index(option.columns)
        gamma, _ = fit(grams, search.present(), [columns], search.y())
        detectable = np.maximum(detectable_amplitude(search, option), 1e-300)
        along = axis(option.columns[int(np.argmax(np.abs(gamma[0] * grams.scale[columns]) / detectable))])
    shape = option.mechanism
    if option.change is not None:
        shape = "step" if option.change.at else "drift"
    elif option.channels:
        shape = "follows the channel"
    return Signature(
        channel="*".join(option.channels) or None,
        lag_s=option.lag_s if option.channels else None,
        axis=along,
        shape=shape,
        amplitude_nT=structure.rms_nT,
        gain=gain,
        # It is named for what it looks like, not as the cause: shapes in time say so of themselves.
        added_by=f'"{option.name}"'
        + ("" if option.agnostic or (option.change and option.change.at) else " --empirical"),
    )


def _residual_sizes(
    search: Search, data: DiagnosisData, remaining: Remaining, at_native: Search | None
) -> dict[str, Any]:
    """Return the sizes of the residual, nT at the cadence of the comparison, all of the same rows."""
    nothing = search.as_found()
    after = sizes_left(search, data, at_native)
    return {
        "before_nT": native_rms(data, nothing),
        "after_nT": after[0],
        "held_out_before_nT": held_out_rms(nothing, data),
        "held_out_after_nT": after[1],
        # A record without a fast part, filtered or rounded away, has no floor.
        "noise_floor_nT": remaining.floor.level_nT or float("nan"),
        "noise_floor_low_nT": remaining.floor.low_nT,
        "noise_floor_high_nT": remaining.floor.high_nT,
        "structure_nT": remaining.structure.rms_nT,
        "structure_t": remaining.structure.t,
        "shadow_edges_nT": _rms_at_edges(search),
        "uncorrected": data.gaps.as_json() if data.gaps else [],
    }


def _rms_at_edges(search: Search) -> float:
    """Return what is fitted at the edges of the Earth's shadow beside what follows it; nT rms.

    0 where nothing follows it, and where it is less than an addition must explain.
    """
    edges = {name for term in search.library.edges for name in term.columns}
    places = np.flatnonzero([name in edges for name in search.model_columns()])
    if not places.size:
        return 0.0
    grams, present = search.forms["raw"], search.present()
    value, _ = joint_fit(grams, present, search.y())
    others = np.setdiff1d(np.arange(present.columns.size), places)
    rest = ModelColumns(present.columns[others], present.precision[others])
    left = project_out_of(grams, rest, present.columns[places])
    size = max(float(value[places] @ left @ value[places]), 0.0)
    if size <= search.rules.gain * float(grams.squares[:, search.y()].sum()):
        return 0.0
    return float(np.sqrt(size / max(float(grams.count.sum()), 1.0)))


def _is_shape(option: Option) -> bool:
    """Return True for what was taken for its shape and names no cause."""
    return option.agnostic or option.family == "unknown"
