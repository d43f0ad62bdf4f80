"""Verdict, findings, unexplained residual.

What was found, in numbers: values with errors, lags, rivals, tables.

What is left and has no name: lines, hints, the signature.

From scores to a verdict: rounds, rivals, values, what is left, and the words for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.design import Term
from inflight.diagnosis.refine import LagProfile, look_again, profile, refine
from inflight.diagnosis.residual import (
    Material,
    Structure,
    effective_blocks,
    floor_left,
    held_out,
    left_of,
    native_rms,
    of_known_rows,
    structure_of,
)
from inflight.diagnosis.result import (
    Coefficient,
    Diagnosis,
    FoundEffect,
    Signature,
    Verdict,
    sentence,
    stopped,
)
from inflight.diagnosis.scoring import fit, folds_of
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.spectra import Fast, Periodogram, describe, fast_part, periodogram, strongest_line
from inflight.diagnosis.stepwise import (
    WEAK,
    Estimate,
    Standing,
    detectable,
    estimate,
    joint_fit,
    look_closer,
    mimics,
    polish,
    run,
    settle,
    within_and_raw,
)
from inflight.effects import coefficient_unit
from inflight.residual import NoiseFloor
from inflight.time import SECOND, utc_text

#: Rows of the candidate table.
_TABLE = 40

#: Blocks named that separate rivals.
_SEPARATING = 3


def effect(search: Search, material: Material, standing: Standing) -> FoundEffect:
    """Return an effect of the model with its values, errors and standing."""
    option = standing.option
    found = estimate(search, option)
    terms = [material.terms[key] for key in option.terms]
    coefficients = _coefficients(search, material, option, terms, found)
    rivals = tuple(rival.mechanism for rival, _ in standing.rivals)
    if found.retained < WEAK:
        rivals += tuple(name for name, _ in _worst_mimics(search, option, found))
    return FoundEffect(
        option.name,
        option.family,
        option.channels,
        tuple(dict.fromkeys(axis(one.name) for one in coefficients if one.stands_out and axis(one.name))),
        coefficients,
        standing.gain,
        standing.t,
        standing.p,
        found.retained,
        option.lag_s,
        _lag_error(search, option),
        standing.placebo_t,
        within_and_raw(search, option),
        found.rms,
        rivals,
        tuple(utc_text(when) for when in option.change.at) if option.change else (),
        option.change.sharpness / SECOND if option.change and option.change.at else None,
        tuple(term.entry.as_yaml() for term in terms if not term.span),
    )


def axis(name: str) -> str:
    """Return the axis a column's name ends with; empty when it has none."""
    return name.rsplit("[", maxsplit=1)[-1].rstrip("]") if "[" in name else ""


def _coefficients(
    search: Search, material: Material, option: Option, terms: list[Term], found: Estimate
) -> tuple[Coefficient, ...]:
    out = []
    for column, value, sigma in zip(found.columns, found.value, found.sigma, strict=True):
        term, parameter = _term_of(option, [*terms, *search.library.all_terms], column)
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


def _term_of(option: Option, terms: list[Term], column: str) -> tuple[Term | None, str]:
    made_of = option.change.functions if option.change is not None else {}
    source = made_of[column][0] if column in made_of else column
    for term in terms:
        if source in term.columns:
            return term, source[len(term.key) + 1 :].split("[")[0]
    return None, ""


def _lag_error(search: Search, option: Option) -> float | None:
    """Return the error of a response's lag; None when its mechanism has no bank of lags."""
    if option.lag_sigma_s is not None or not option.lag_s:
        return option.lag_sigma_s
    found = lag_profile(search, option)
    return None if found is None else found.sigma


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
    """Return the calibration's parameters that shift most, in their usual size, if the effect is ignored."""
    shifts = mimics(search, option, found.value)
    scale = dict(zip(search.raw.names, search.raw.scale, strict=True))
    ordered = sorted(shifts, key=lambda pair: -abs(pair[1]) / scale[pair[0]])
    return ordered[:3]


def confusion(
    search: Search, standings: list[Standing]
) -> tuple[tuple[dict[str, Any], ...], tuple[dict[str, Any], ...]]:
    """Return the rivals of every confounded effect, and the blocks that would separate them."""
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
    (first, second), _ = fit(evidence, present, [one, other], y)
    both = np.concatenate([one, other])
    weights = np.concatenate([first, -second])
    sums = np.einsum("i,bij,j->b", weights, evidence.rows(both, both), weights)
    rms = np.sqrt(np.clip(sums, 0.0, None) / np.maximum(evidence.count, 1.0))
    best = np.argsort(-rms)[:_SEPARATING]
    return [
        {
            "rivals": [option.name, rival.name],
            "start": utc_text(int(evidence.start[place])),
            "end": utc_text(int(evidence.end[place])),
            "difference_nT": float(rms[place]),
        }
        for place in best
    ]


def unscorable(search: Search) -> tuple[dict[str, Any], ...]:
    """Return what these data cannot show, and why; each name once."""
    out: dict[str, dict[str, Any]] = {}
    told: list[dict[str, Any]] = [*search.unscorable, *search.library.unscorable]
    for one in told:
        out.setdefault(str(one["name"]), one)
    return tuple(out.values())


def candidates(search: Search, first: Table, last: Table) -> tuple[dict[str, Any], ...]:
    """Return the best options of the first round, with their gain now: of taken ones nothing is left."""
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


def refined(search: Search) -> tuple[dict[str, Any], ...]:
    """Return the model's own parameters that data moved, within what was known of them."""
    evidence, present = search.forms["raw"], search.present()
    names = [name for term in search.library.refined for name in term.columns]
    sigma = [s for term in search.library.refined for s in term.sigma]
    if not names:
        return ()
    value, covariance = joint_fit(evidence, present, search.y())
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
    return tuple(out)


#: A line that explains less than this part of the residual's square is no effect worth a name.
_LEAST_PART = 0.01

#: Lines beside a harmonic at so many turns of the Earth; resolutions within which they are the same; what a
#: nominal period may be off by; and by how much the field must turn to have a period of its own.
_SPLITS, _APART, _SHARP, _TURNING = 2, 1.5, 2e-4, 0.3

#: Harmonics of a known period that are no news: beyond, any period is near one of a day's.
_HARMONICS = 30

#: Structure below this part of the noise does not make a residual coloured, however sure it is.
_WHITE = 0.1

#: A known period explains a band when it is within it or so many times beside it.
_AROUND = 1.1


@dataclass(frozen=True)
class Unknown:
    """What is left after everything that was taken.

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
        Of what is left, with its interval.
    has_band : bool
        Most of what is missing is too fast for the search and stands in one band no known period explains.
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
        """True when what is left may be more than noise: large, or not white beyond doubt."""
        coloured = self.structure.is_sure and self.structure.rms_nT > _WHITE * self.noise
        certain = self.has_line or self.has_band or self.has_unit
        return certain or self.structure.is_large(self.noise) or coloured

    @property
    def is_sure(self) -> bool:
        """True when what is left is more than noise beyond doubt."""
        certain = self.has_line or self.has_band or self.has_unit
        return certain or (self.structure.is_sure and self.structure.is_large(self.noise))


def look_at(search: Search, material: Material, last: Table, left: Floats, structure: Structure) -> Unknown:
    """Describe what is left: a line, else what the best rejected candidate hints at, else its size."""
    known = 1.0 - material.gaps.part if material.gaps else 1.0
    floor = floor_left(material.series, left, known * material.sums.get("count", 0.0), material.floor)
    noise = floor.level_nT
    if not noise > 0:
        good = material.series["weight"] > 0
        noise = float(np.sqrt(np.mean(left[good] ** 2))) if good.any() else float("nan")
    unit = unit_unseen(material)
    if unit is not None:
        return Unknown(structure, False, unit, noise, floor, has_unit=True)
    line = _line(material, left)
    found = Unknown(structure, line is not None, line, noise, floor)
    if line is not None:
        return found
    size = native_rms(material, search)
    fast = fast_part(material.series, left, size, floor.level_nT, structure)
    found = replace(found, has_band=fast is not None and _is_news(material, fast))
    if not found.is_there:
        return found
    told = _hinted(search, last, structure)
    return replace(found, signature=told if fast is None else _fast(told, fast))


def unit_unseen(material: Material) -> Signature | None:
    """Return the signature of the unit without housekeeping that switches most often, of two sensors."""
    if material.switched is None or not material.switched.unexplained:
        return None
    step, sigma, count = material.switched.units[0]
    return Signature(
        shape="unit without housekeeping",
        axis="xyz"[int(np.argmax(np.abs(step)))],
        amplitude_nT=float(np.abs(step).max()),
        steps={name: (float(a), float(b)) for name, a, b in zip("xyz", step, sigma, strict=True)},
        switchings=count,
    )


def _is_news(material: Material, fast: Fast) -> bool:
    """Return True when a band of periods was found and no known period lies in it."""
    if fast.periods_s is None:
        return False
    short, long = fast.periods_s
    return not any(short / _AROUND <= period <= long * _AROUND for period in known_periods(material))


def _fast(hint: Signature, fast: Fast) -> Signature:
    """Return the signature of what is fast; a channel that the slow part hints at stays beside it."""
    return replace(
        hint if hint.channel else Signature(),
        shape="fast",
        amplitude_nT=fast.rms_nT,
        faster_than_s=fast.faster_than_s,
        periods_s=fast.periods_s,
    )


def _line(material: Material, left: Floats) -> Signature | None:
    """Return the signature of the strongest line, or None when none stands out and matters."""
    found = spectrum_left(material, left) if material.series.turn_rows == 1 else None
    line = strongest_line(found) if found is not None else None
    if found is None or line is None:
        return None
    series = material.series
    told, part = describe(
        series.tt2000, left, series.direction(), series["weight"], line[0], float(found.frequency[1])
    )
    if part < _LEAST_PART or _is_known(material, float(told.period_s or 0.0)):
        return None
    return told


def _is_known(material: Material, period: float) -> bool:
    """Return True for a harmonic of a known period, or one that the turning Earth splits from it.

    Judged at the resolution of the whole span, which is finer than that of the periodogram's segments.
    """
    series = material.series
    span = float(series.tt2000[-1] - series.tt2000[0]) / SECOND
    frequency = 1.0 / period if period > 0 else 0.0
    for known in known_periods(material):
        for split in range(-_SPLITS, _SPLITS + 1):
            offset = frequency - split / 86_400.0
            harmonic = round(offset * known)
            if 1 <= harmonic <= _HARMONICS and abs(offset - harmonic / known) < _APART * max(
                1.0 / span, _SHARP * frequency
            ):
                return True
    return False


def _own_period(material: Material) -> list[float]:
    """Return the period with which the field turns in the sensor, s: the orbit's, or the spin's."""
    series = material.series
    direction = series.direction()[:, 0]
    good = (series["weight"] > 0) & np.isfinite(direction).all(axis=1)
    if good.sum() < 64 or float(np.ptp(direction[good], axis=0).max()) < _TURNING:
        return []
    even = np.where(good[:, None], direction - direction[good].mean(axis=0), 0.0)
    power = (np.abs(np.fft.rfft(even, 4 * len(even), axis=0)) ** 2).sum(axis=1)
    at = int(np.argmax(power[8:])) + 8
    return [4 * len(even) * series.step_s / at]


def known_periods(material: Material) -> list[float]:
    """Return the periods whose harmonics are no news: orbit, day, and those of the mission; seconds."""
    periods = {name: period / SECOND for name, period in material.mission.periods.items()}
    known = [86_400.0, *(period for period in periods.values() if period > 2 * material.series.step_s)]
    return known + _own_period(material)


def spectrum_left(material: Material, left: Floats) -> Periodogram | None:
    """Return the periodogram of what is left, demodulated along each axis."""
    series = material.series
    return periodogram(series.tt2000, left, series.direction(), series["weight"], known_periods(material))


def _hinted(search: Search, last: Table, structure: Structure) -> Signature:
    """Return the signature that the best rejected candidate hints at."""
    hint = _hint(search, last)
    if hint is None:
        return Signature(shape="wander", amplitude_nT=structure.rms_nT)
    option, gain = hint
    along = None
    if option.change is None and len(option.columns) == 3:
        along = axis(option.columns[int(np.argmax(_strength(search, option)))])
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
    )


def _strength(search: Search, option: Option) -> Floats:
    """Return how far a rejected candidate's coefficients are from nothing, in units of what is detectable."""
    evidence = search.forms["raw"]
    gamma, _ = fit(evidence, search.present(), [evidence.index(option.columns)], search.y())
    physical = gamma[0] * evidence.scale[evidence.index(option.columns)]
    return np.abs(physical) / np.maximum(detectable(search, option), 1e-300)


def _hint(search: Search, last: Table) -> tuple[Option, float] | None:
    """Return the best option that was not beyond doubt, if it explains anything held out."""
    scores = last.scores["raw"]
    real = [
        place for place, option in enumerate(last.options) if not option.placebo and scores.t[place] > 2.0
    ]
    if not real:
        return None
    best = max(real, key=lambda place: (last.options[place].change is None, float(scores.gain[place])))
    return last.options[best], float(scores.gain[best])


#: A search that leaves no more than so many times as much explains as much.
_AS_MUCH = 1.003

__all__ = ["Material", "conclude", "held_out", "known_periods", "lag_profile"]


def conclude(search: Search, material: Material) -> Diagnosis:
    """Run the rounds and say what they mean."""
    first = search.table().light()
    last = _rounds(search, material, first) if search.rules.rounds else first
    standings = sorted(settle(search, partial(refine, search, material)), key=lambda one: -one.gain)
    if standings:
        last = search.table().light()
    effects = tuple(effect(search, material, one) for one in standings)
    seen = of_known_rows(search, material)
    left = left_of(search, seen)
    blocks = effective_blocks(search, seen, left)
    unknown = look_at(search, seen, last, left, structure_of(seen.series, left))
    remaining = _remaining(unknown, blocks["independent"], search.rules.blocks)
    verdict = _verdict(effects, standings, remaining)
    residual = _sizes(search, seen, unknown)
    signature = unknown.signature if remaining == "UNKNOWN_EFFECT" else None
    own = signature if verdict != "UNKNOWN_EFFECT" or not effects else _of_shape(effects[0])
    told: dict[str, Any] = {
        "effects": effects,
        "signature": signature,
        "residual": residual,
        "remaining": remaining,
        "blocks": blocks,
        "outliers": material.outliers.as_json(),
        "unscorable": unscorable(search),
        "fewest": search.rules.blocks,
    }
    rivals, separating = confusion(search, standings)
    return Diagnosis(
        verdict,
        sentence(told),
        effects,
        rivals,
        separating,
        told["unscorable"],
        own if verdict == "UNKNOWN_EFFECT" else None,
        {"verdict": remaining, "signature": signature},
        residual,
        tuple(one.as_json() for one in search.rounds),
        candidates(search, first, last),
        refined(search),
        blocks,
        stopped(told, search.rules.rounds, search.ran_out),
        material.model.comparison,
        {"name": material.model.name, "version": material.model.version},
        material.context,
        material.run,
        told["outliers"],
    )


def _sizes(search: Search, material: Material, unknown: Unknown) -> dict[str, Any]:
    """Return the sizes of the residual, nT at the cadence of the comparison, all of the same rows."""
    nothing = search.as_found()
    return {
        "before_nT": native_rms(material, nothing),
        "after_nT": native_rms(material, search),
        "held_out_before_nT": held_out(nothing, material),
        "held_out_after_nT": held_out(search, material),
        # A record without a fast part, filtered or rounded away, tells no floor.
        "noise_floor_nT": unknown.floor.level_nT or float("nan"),
        "noise_floor_low_nT": unknown.floor.low_nT,
        "noise_floor_high_nT": unknown.floor.high_nT,
        "structure_nT": unknown.structure.rms_nT,
        "structure_t": unknown.structure.t,
        "uncorrected": material.gaps.as_json() if material.gaps else [],
    }


def _rounds(search: Search, material: Material, first: Table) -> Table:
    """Run the rounds, again with products when something is left, and from shapes if need be."""
    refiner, closer = partial(refine, search, material), partial(look_closer, search, material)
    last = run(search, refiner=refiner, closer=closer)
    known = of_known_rows(search, material)
    left = left_of(search, known)
    seen = look_at(search, known, last, left, structure_of(known.series, left))
    more = len(search.accepted) < search.rules.rounds and (seen.is_sure or search.accepted)
    if more and look_again(search, material, [first, last], seen.is_sure):
        last = run(search, refiner=refiner, closer=closer)
    if _stands_in(search):
        last = _from_shapes(search, material, last, partial(run, search, refiner=refiner, closer=closer))
    polish(search, refiner)
    return last


def _stands_in(search: Search) -> bool:
    """Return True when named causes were taken and yet shapes that name none had to complete them.

    Either both are there, or the named ones together stand in for something that no effect here describes.
    """
    shapes = [one for one in search.accepted if _is_shape(one)]
    return bool(shapes) and len(search.accepted) > len(shapes) and len(search.accepted) > 2


def _from_shapes(search: Search, material: Material, last: Table, again: Callable[..., Table]) -> Table:
    """Search anew with shapes first; keep it when fewer effects explain as much, else what was found."""
    before = held_out(search, material)
    kept = search.accepted, search.rounds, search.banned, search.dropped, search.ran_out
    search.accepted, search.rounds, search.banned, search.dropped = [], [], set(), set()
    search.recut()
    other = again(shapes_first=True)
    if len(search.accepted) < len(kept[0]) and held_out(search, material) <= _AS_MUCH * before:
        return other
    search.accepted, search.rounds, search.banned, search.dropped, search.ran_out = kept
    search.recut()
    return last


def _verdict(effects: tuple[FoundEffect, ...], standings: list[Standing], remaining: Verdict) -> Verdict:
    """Return the verdict about the residual as found."""
    if not effects:
        return remaining
    if any(one.rivals or one.retained < WEAK for one in effects):
        return "CONFOUNDED"
    # The largest of them first: where it names no cause, nor do the smaller ones name the cause of most.
    return "UNKNOWN_EFFECT" if _is_shape(standings[0].option) else "FOUND"


def _is_shape(option: Option) -> bool:
    """Return True for what was taken for its shape and names no cause."""
    return option.agnostic or option.family == "unknown"


def _of_shape(effect: FoundEffect) -> Signature:
    """Return the signature of an effect that was taken for its shape and names no cause."""
    return Signature(
        channel="*".join(effect.channels) or None,
        lag_s=effect.lag_s,
        axis=effect.axes[0] if len(effect.axes) == 1 else None,
        shape=effect.name,
        amplitude_nT=effect.rms_nT,
        gain=effect.gain,
    )


def _remaining(unknown: Unknown, independent: float, fewest: int) -> Verdict:
    """Return what is to be said of what is left."""
    if not unknown.is_there:
        return "NOTHING_LEFT"
    return "UNKNOWN_EFFECT" if unknown.is_sure and independent >= fewest else "NOT_IDENTIFIABLE"
