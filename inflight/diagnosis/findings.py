"""What was found, in numbers: values with errors, lags, rivals, tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from inflight.diagnosis.diagnosis import Coefficient, FoundEffect
from inflight.diagnosis.estimates import Estimate, estimate, mimics, sandwich, within_and_raw
from inflight.diagnosis.lags import LagProfile, profile
from inflight.diagnosis.library import Term
from inflight.diagnosis.material import Material
from inflight.diagnosis.rounds import WEAK
from inflight.diagnosis.scoring import fit, folds_of
from inflight.diagnosis.search import Option, Search, Table
from inflight.diagnosis.standing import Standing
from inflight.effects.coefficients import coefficient_unit
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
    sums = np.einsum("i,bij,j->b", weights, evidence.gram[:, both[:, None], both[None, :]], weights)
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
    return tuple(out)
