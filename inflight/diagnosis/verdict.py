"""From scores to a verdict: rounds, rivals, values, what is left, and the words for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.diagnosis import Coefficient, Diagnosis, FoundEffect, Signature, Verdict
from inflight.diagnosis.estimates import Estimate, detectable, estimate, mimics, within_and_raw
from inflight.diagnosis.lags import LagProfile, profile
from inflight.diagnosis.left import Structure, residual_left, structure_of
from inflight.diagnosis.library import Term
from inflight.diagnosis.rounds import Standing, run, settle
from inflight.diagnosis.scoring import Present, folds_of, score
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.series import Series
from inflight.diagnosis.signature import Periodogram, describe, periodogram, strongest_line
from inflight.diagnosis.words import sentence, stopped
from inflight.effects.coefficients import coefficient_unit
from inflight.mission import Mission
from inflight.model import Model
from inflight.noise import NoiseFloor
from inflight.time import SECOND, to_utc

#: An effect of which the calibration takes over all but this part is known through a magnifying glass only.
WEAK = 0.02
#: Rows of the candidate table.
_TABLE = 40
#: Blocks named that separate rivals.
_SEPARATING = 3


@dataclass(frozen=True)
class Material:
    """What a verdict needs beside the search.

    Attributes
    ----------
    model : Model
        The model diagnosed.
    linearised : Model
        The same at the values the evidence was linearised at.
    terms : mapping of str to Term
    series : Series
    sums : mapping of str to float
        Over native samples: count, square, inside, spikes, and of the noise floor.
    cadence_s : float
        Of the search.
    """

    mission: Mission
    model: Model
    linearised: Model
    terms: Mapping[str, Term]
    series: Series
    sums: Mapping[str, float]
    cadence_s: float
    floor: NoiseFloor
    context: str = ""
    run: str = ""
    turn: Mapping[str, Floats] | None = None


def conclude(search: Search, material: Material) -> Diagnosis:
    """Run the rounds and say what they mean."""
    first = search.table()
    before = held_out(search, material)
    left_before = _left(search, material, accepted=False)
    last = run(search) if search.rules.rounds else first
    standings = settle(search)
    if standings:
        last = search.table()
    effects = tuple(_effect(search, material, one) for one in standings)
    after = held_out(search, material)
    left = _left(search, material) if search.accepted else left_before
    floor = material.floor.level_nT
    structure = structure_of(material.series, left)
    line = _line(material, left)
    blocks = effective_blocks(search, material, left)
    remaining = _remaining(search, last, structure, line, floor, blocks["independent"])
    signature = (
        _signature(search, material, last, left, line, structure) if remaining == "UNKNOWN_EFFECT" else None
    )
    verdict = _verdict(effects, standings, remaining)
    residual = {
        "before_nT": _native_rms(material, search, accepted=False),
        "after_nT": _native_rms(material, search, accepted=True),
        "held_out_before_nT": before,
        "held_out_after_nT": after,
        "noise_floor_nT": floor,
        "noise_floor_low_nT": material.floor.low_nT,
        "noise_floor_high_nT": material.floor.high_nT,
        "structure_nT": structure.rms_nT,
        "structure_t": structure.t,
    }
    confusion, separating = _confusion(search, standings)
    told = {
        "verdict": verdict,
        "effects": effects,
        "confusion_set": confusion,
        "signature": signature,
        "residual": residual,
        "remaining": remaining,
        "unscorable": tuple(search.unscorable + search.library.unscorable),
        "blocks": blocks,
    }
    return Diagnosis(
        verdict,
        sentence(told),
        effects,
        confusion,
        separating,
        _unscorable(search),
        signature if not effects else None,
        {"verdict": remaining, "signature": signature},
        residual,
        tuple(one.as_json() for one in search.rounds),
        _candidates(search, first, last),
        _refined(search, material),
        blocks,
        stopped(told, len(search.rounds), search.rules.rounds),
        material.model.comparison,
        {"name": material.model.name, "version": material.model.version},
        material.context,
        material.run,
    )


def _left(search: Search, material: Material, accepted: bool = True) -> Floats:
    return residual_left(search, material.series, material.terms, dict(material.turn or {}), accepted)


def _verdict(effects: tuple[FoundEffect, ...], standings: list[Standing], remaining: Verdict) -> Verdict:
    if not effects:
        return remaining
    if any(one.rivals or one.retained < WEAK for one in effects):
        return "CONFOUNDED"
    if all(one.option.agnostic for one in standings):
        return "UNKNOWN_EFFECT"
    return "FOUND"


def _remaining(
    search: Search,
    last: Table,
    structure: Structure,
    line: tuple[float, float] | None,
    floor: float,
    independent: float,
) -> Verdict:
    """Return what is to be said of what is left."""
    clear = structure.is_clear(floor) or line is not None
    if not clear:
        return "NOTHING_LEFT"
    if independent < search.rules.blocks:
        return "NOT_IDENTIFIABLE"
    return "UNKNOWN_EFFECT"


# Sizes.


def held_out(search: Search, material: Material) -> float:
    """Return the held-out rms at the cadence of the comparison, nT: of the blocks' means, and what is inside bins."""
    evidence = search.forms["raw"]
    interleaved = any(option.interleaved for option in search.accepted)
    present = search.present()
    empty: list[Any] = []
    found = score(evidence, present, empty, search.y(), folds_of(len(evidence), interleaved))
    mean = float(found.loss0.sum() / max(evidence.count.sum(), 1.0))
    return float(np.sqrt(max(mean, 0.0) + _inside(material)))


def _inside(material: Material) -> float:
    return material.sums.get("inside", 0.0) / max(material.sums.get("count", 1.0), 1.0)


def _native_rms(material: Material, search: Search, accepted: bool) -> float:
    evidence = search.forms["raw"]
    present = search.present()
    if not accepted:
        taken = sum(len(option.columns) for option in search.accepted)
        keep = present.columns.size - taken
        present = Present(present.columns[:keep], present.precision[:keep])
    total = evidence.total
    y = search.y()
    left = total[y, y] - (
        total[y, present.columns] @ present.solve(total)[:, y] if present.columns.size else 0.0
    )
    return float(np.sqrt(max(left, 0.0) / max(evidence.count.sum(), 1.0) + _inside(material)))


def effective_blocks(search: Search, material: Material, left: Floats) -> dict[str, Any]:
    """Return number and length of the blocks, and how many independent ones the residual's correlation leaves."""
    raw = search.raw
    length = float(np.median(raw.end - raw.start)) / SECOND
    memory = _correlation_s(material.series, left)
    used = int(np.sum(raw.count > 0))
    span = float(raw.end[-1] - raw.start[0]) / SECOND
    independent = min(float(used), span / max(2.0 * memory, 1e-9))
    return {"count": used, "length_s": length, "correlation_s": memory, "independent": independent}


def _correlation_s(series: Series, residual: Floats) -> float:
    """Return the residual's integrated correlation time, s, summed up to its first zero."""
    good = series["weight"] > 0
    y = np.where(good[:, None], residual, 0.0)
    size = float(np.sum(y**2)) / max(good.sum(), 1)
    if size <= 0:
        return series.step_s
    total, lag = 0.5, 1
    while lag < min(len(y) // 4, 5000):
        both = good[lag:] & good[:-lag]
        value = float(np.sum(y[lag:] * y[:-lag])) / max(both.sum(), 1) / size
        if value <= 0.02:
            break
        step = max(1, lag // 8)
        total += value * step
        lag += step
    return total * series.step_s


# Effects.


def _effect(search: Search, material: Material, standing: Standing) -> FoundEffect:
    option = standing.option
    found = estimate(search, option)
    lag, sigma = _lag(search, option)
    terms = [material.terms[key] for key in option.terms]
    coefficients = _coefficients(material, option, terms, found)
    rivals = tuple(rival.mechanism for rival, _ in standing.rivals)
    if found.retained < WEAK:
        rivals += tuple(name for name, _ in _worst_mimics(search, option, found))
    return FoundEffect(
        option.name,
        option.family,
        option.channels,
        tuple(dict.fromkeys(_axis(one.name) for one in coefficients if one.stands_out and _axis(one.name))),
        coefficients,
        standing.gain,
        standing.t,
        standing.p,
        found.retained,
        lag,
        sigma,
        standing.placebo_t,
        within_and_raw(search, option),
        found.rms,
        rivals,
        tuple(f"{to_utc(when)}Z" for when in option.change.at) if option.change else (),
        tuple(term.entry.as_yaml() for term in terms),
    )


def _axis(name: str) -> str:
    return name.split("[")[-1].rstrip("]") if "[" in name else ""


def _coefficients(
    material: Material, option: Option, terms: list[Term], found: Estimate
) -> tuple[Coefficient, ...]:
    out = []
    for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True):
        term, parameter = _term_of(material, option, terms, column)
        unit, at = "", "difference"
        if term is not None:
            kind = term.entry.effect.parameters()[parameter]
            channel = term.entry.effect.channels[0] if term.entry.effect.channels else ""
            unit = coefficient_unit(kind, material.mission, channel) if channel else kind.unit
            at = "difference" if term.entry.is_additive else term.entry.sensor.name
        if option.change is not None:
            unit += option.change.unit
        out.append(Coefficient(column.rsplit(".", 1)[-1], float(value), float(sigma), unit, at))
    return tuple(out)


def _term_of(material: Material, option: Option, terms: list[Term], column: str) -> tuple[Term | None, str]:
    source = option.change.functions[column][0] if option.change is not None else column
    for term in [*terms, *material.terms.values()]:
        if source in term.columns:
            return term, source[len(term.key) + 1 :].split("[")[0]
    return None, ""


def _lag(search: Search, option: Option) -> tuple[float, float | None]:
    """Return the refined lag of a response and its error; a lag of the bank is only the nearest one."""
    found = lag_profile(search, option)
    if found is None:
        return option.lag_s, None
    return found.best, found.sigma


def lag_profile(search: Search, option: Option) -> LagProfile | None:
    """Return how well each lag would do in an option's place; None when its mechanism has no lags."""
    form = search.forms["raw"]
    bank = {
        other.lag_s: form.index(other.columns)
        for other in search.options
        if other.mechanism == option.mechanism and len(other.columns) == len(option.columns)
    }
    if len(bank) < 3 or option.change is not None:
        return None
    return profile(form, search.present("raw", option), bank, search.y(), folds_of(len(form)))


def _worst_mimics(search: Search, option: Option, found: Estimate) -> list[tuple[str, float]]:
    """Return the calibration's parameters that shift most, in their own usual size, when the effect is ignored."""
    shifts = mimics(search, option, found.value)
    scale = dict(zip(search.raw.names, search.raw.scale, strict=True))
    ordered = sorted(shifts, key=lambda pair: -abs(pair[1]) / scale[pair[0]])
    return ordered[:3]


# Rivals, tables, what cannot be told.


def _confusion(
    search: Search, standings: list[Standing]
) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    confusion: list[dict[str, Any]] = []
    separating: list[dict[str, Any]] = []
    for one in standings:
        found = estimate(search, one.option)
        weak = found.retained < WEAK
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
    evidence = search.forms["raw"]
    one, other = evidence.index(option.columns), evidence.index(rival.columns)
    present, y = search.present("raw", option), search.y()
    from inflight.diagnosis.scoring import fit

    (first, second), _ = fit(evidence, present, [one, other], y)
    both = np.concatenate([one, other])
    weights = np.concatenate([first, -second])
    sums = np.einsum("i,bij,j->b", weights, evidence.gram[:, both[:, None], both[None, :]], weights)
    rms = np.sqrt(np.clip(sums, 0.0, None) / np.maximum(evidence.count, 1.0))
    best = np.argsort(-rms)[:_SEPARATING]
    return [
        {
            "rivals": [option.name, rival.name],
            "start": f"{to_utc(int(evidence.start[place]))}Z",
            "end": f"{to_utc(int(evidence.end[place]))}Z",
            "difference_nT": float(rms[place]),
        }
        for place in best
    ]


def _unscorable(search: Search) -> tuple[dict[str, Any], ...]:
    out: dict[str, dict[str, Any]] = {}
    for one in [*search.unscorable, *search.library.unscorable]:
        out.setdefault(one["name"], one)
    return tuple(out.values())


def _candidates(search: Search, first: Table, last: Table) -> tuple[dict[str, Any], ...]:
    """Return the best options of the first round, with their gain now: those of taken ones fall to nothing."""
    now = {option.name: place for place, option in enumerate(last.options)}
    best: dict[str, dict[str, Any]] = {}
    scores = first.scores["raw"]
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
            "t": float(scores.t[place]),
            "p": float(min(first.p[form][place] for form in first.p)),
            "placebo_t": float(first.beats_placebo["raw"][place]),
            "gain_now": after,
        }
    rows = list(best.values())
    real = [row for row in rows if not row["placebo"]][:_TABLE]
    return tuple(real + [row for row in rows if row["placebo"]][:_TABLE])


def _refined(search: Search, material: Material) -> tuple[dict[str, Any], ...]:
    """Return the model's own parameters that data moved, within what was known of them."""
    from inflight.diagnosis.estimates import sandwich

    evidence, present = search.forms["raw"], search.present()
    names = [name for term in search.library.refined for name in term.columns]
    sigma = [s for term in search.library.refined for s in term.sigma]
    if not names:
        return ()
    value, covariance = sandwich(evidence, present, search.y())
    scale = evidence.scale[present.columns]
    out = []
    for place, name in enumerate(names):
        moved = float(value[place] * scale[place])
        error = float(np.sqrt(max(covariance[place, place], 0.0)) * scale[place])
        out.append(
            {
                "name": name.removeprefix("model:"),
                "moved": moved,
                "sigma": error,
                "known": float(sigma[place]),
            }
        )
    del material
    return tuple(out)


# What is left.


def _line(material: Material, left: Floats) -> tuple[float, float] | None:
    found = spectrum_left(material, left)
    return strongest_line(found) if found is not None else None


def known_periods(material: Material) -> list[float]:
    """Return the periods whose harmonics are no news: orbit, day, and those of the mission; seconds."""
    periods = {name: period / SECOND for name, period in material.mission.periods.items()}
    return [86_400.0, *(period for period in periods.values() if period > 2 * material.series.step_s)]


def spectrum_left(material: Material, left: Floats) -> Periodogram | None:
    """Return the periodogram of what is left, demodulated along each axis."""
    series = material.series
    return periodogram(series.tt2000, left, series.direction(), series["weight"], known_periods(material))


def _signature(
    search: Search,
    material: Material,
    last: Table,
    left: Floats,
    line: tuple[float, float] | None,
    structure: Structure,
) -> Signature:
    series = material.series
    hint = _hint(search, last)
    if line is not None:
        found = spectrum_left(material, left)
        assert found is not None
        spread = float(found.frequency[1])
        told = describe(series.tt2000, left, series.direction(), series["weight"], line[0], spread)
        return told
    if hint is None:
        return Signature(shape="wander", amplitude_nT=structure.rms_nT)
    option, gain = hint
    values = detectable(search, option)
    axis = _axis(option.columns[int(np.argmin(values))]) if len(option.columns) == 3 else None
    shape = (
        "step"
        if option.change is not None
        else "follows the channel"
        if option.channels
        else option.mechanism
    )
    return Signature(
        channel="*".join(option.channels) or None,
        lag_s=option.lag_s if option.channels else None,
        axis=axis,
        shape=shape,
        amplitude_nT=structure.rms_nT,
        gain=gain,
    )


def _hint(search: Search, last: Table) -> tuple[Option, float] | None:
    """Return the best option that was not beyond doubt, if it explains anything held out."""
    scores = last.scores["raw"]
    real = [
        place for place, option in enumerate(last.options) if not option.placebo and scores.t[place] > 2.0
    ]
    if not real:
        return None
    best = max(real, key=lambda place: float(scores.gain[place]))
    return last.options[best], float(scores.gain[best])
