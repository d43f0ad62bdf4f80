"""How what was taken stands against everything that could take its place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.diagnosis.options import Option, Table
from inflight.diagnosis.scoring import fit, projected
from inflight.diagnosis.search import FORMS, Search
from inflight.estimators.absorption import half_inverse

#: A rival must itself be worth this t, and this part of the winner's gain.
_RIVAL_OWN_T, _RIVAL_GAIN = 2.0, 0.02
#: A rival that reproduces this part of an effect's square holds it as a special case.
_CONTAINED = 0.9999


@dataclass(frozen=True)
class Standing:
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
    """

    option: Option
    gain: float
    t: float
    p: float
    placebo_t: float
    form: str
    rivals: tuple[tuple[Option, float], ...]


def _still(last: Table, rival: Option, form: str) -> float:
    """Return the sum of squares a rival explains beside all that was taken; 0 when it is taken itself."""
    place = place_of(last, rival)
    scores = last.scores[form]
    return float(scores.loss0.sum() * scores.gain[place]) if place is not None else 0.0


def same_cause(one: Option, other: Option) -> bool:
    """Return True for two forms of one cause."""
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
    evidence = search.forms[form]
    own, wide = evidence.index(option.columns), evidence.index(rival.columns)
    left = projected(evidence.total, search.present(form, option))
    gamma, _ = fit(evidence, search.present(form, option), [own], search.y(form))
    shared = left[np.ix_(wide, own)] @ gamma[0]
    half = half_inverse(left[np.ix_(wide, wide)][None])[0]
    whole = float(gamma[0] @ left[np.ix_(own, own)] @ gamma[0])
    return whole > 0 and float(np.sum((half.T @ shared) ** 2)) > _CONTAINED * whole


def place_of(table: Table, option: Option) -> int | None:
    """Return where an option stands in a table; None when it is not there."""
    for place, other in enumerate(table.options):
        if other.name == option.name:
            return place
    return None


def form_of(table: Table, place: int) -> str:
    """Return the first form that shows an option clearly, else the one where its t is largest."""
    return max(
        FORMS, key=lambda form: float(table.scores[form].t[place]) if form in table.scores else -np.inf
    )


def _best_of_each(table: Table, form: str) -> dict[str, int]:
    """Return which option of each mechanism leaves least.

    A change at a wrong moment misses by much in few blocks: hardly any t tells it from the right one.
    """
    left = table.scores[form].loss.sum(axis=0)
    best: dict[str, int] = {}
    for place in np.argsort(left, kind="stable").tolist():
        best.setdefault(table.options[place].mechanism, place)
    return best


def standing(search: Search, option: Option, table: Table, last: Table | None = None) -> Standing:
    """Return how an effect of the model stands against everything that could take its place.

    Another form of the same cause, the same channels in the same family, is no rival; nor is what explains
    as much beside the effect (in the `last` table) as in its place: that is another effect.
    """
    place = place_of(table, option)
    if place is None:
        gain, t = search.worth(option)
        return Standing(option, gain, t, 1.0, 0.0, "raw", ())
    form = "raw" if table.scores["raw"].t[place] > search.rules.t else form_of(table, place)
    scores = table.scores[form]
    best = _best_of_each(table, form)
    rivals: dict[str, tuple[Option, float]] = {}
    for other, rival in enumerate(table.options):
        if same_cause(rival, option) or rival.placebo or (rival.agnostic and not option.agnostic):
            continue
        if rival.change is not None and other != best[rival.mechanism]:
            continue
        if rival.family == "unknown" and set(option.channels) < set(rival.channels):
            continue
        if last is not None and _still(last, rival, form) > 0.5 * float(
            scores.loss0.sum() * scores.gain[other]
        ):
            continue
        if scores.t[other] < _RIVAL_OWN_T or scores.gain[other] < _RIVAL_GAIN * scores.gain[place]:
            continue
        behind = scores.behind(other, place)
        near = behind < search.rules.rival_t and not _contains(search, rival, option, form)
        if near and behind < rivals.get(rival.mechanism, (rival, np.inf))[1]:
            rivals[rival.mechanism] = (rival, behind)
    return Standing(
        option,
        float(scores.gain[place]),
        float(scores.t[place]),
        float(
            min(
                [table.p[one][place] for one in table.p]
                + [one.p for one in search.rounds if one.name == option.name and one.action == "add"]
            )
        ),
        float(table.beats_placebo[form][place]),
        form,
        tuple(sorted(rivals.values(), key=lambda pair: pair[1])),
    )
