"""Forward/backward selection, rivals, few-block test.

Values of what the search took: joint fit, errors that know how the residual is correlated.

How what was taken stands against everything that could take its place.

Forward and backward rounds, and the rivals of what they took.

A closer look at what lies in few blocks: its gain in spans no longer than the residual's memory asks for.

Signs of six blocks can be flipped in 64 ways: whatever lies in them can never be sure, however clearly each
of them tells of it. Where blocks are much longer than the residual remembers, they are cut, and each part's
gain is held against what the other parts promise (see `inflight.lsq.covariance`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.design import Term
from inflight.diagnosis.refine import Trials
from inflight.diagnosis.residual import Material, correlation_s
from inflight.diagnosis.scoring import Present, fit, projected
from inflight.diagnosis.search import FORMS, Option, Round, Rules, Search, Table
from inflight.lsq import (
    GramBlocks,
    bartlett_covariance,
    expected_gain_p,
    gram_inverse,
    inverse_square_root,
    regression,
    sandwich,
)
from inflight.time import SECOND

#: Reach of the scores' correlation, in blocks.
_BARTLETT = 3


@dataclass(frozen=True)
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
        Size of the contribution that is left beside the rest of the model, nT.
    """

    columns: tuple[str, ...]
    value: Floats
    sigma: Floats
    covariance: Floats
    retained: float
    rms: float


def joint_fit(evidence: GramBlocks, present: Present, y: int) -> tuple[Floats, Floats]:
    """Return values and covariance of the model's columns, scaled; clustered by block (Bartlett's kernel).

    Scatter of few blocks that tell nearly all of a column comes out too small, for the fit follows them. No
    value is surer than rows of white noise of the size of what is left would make it.
    """
    total = evidence.total
    p = present.columns
    matrix = total[np.ix_(p, p)] + np.diag(present.precision)
    inverse = gram_inverse(matrix)
    value = -inverse @ total[p, y]
    blocks = evidence.rows(p, np.append(p, y))
    scores = blocks[:, :, -1] + np.einsum("bij,j->bi", blocks[:, :, :-1], value)
    count = len(scores)
    meat = bartlett_covariance(scores, _BARTLETT)
    free = max(count - p.size / 3.0, 2.0)
    left = total[y, y] + 2.0 * total[y, p] @ value + value @ total[np.ix_(p, p)] @ value
    white = max(float(left), 0.0) / max(float(evidence.count.sum()), 1.0) * total[np.ix_(p, p)]
    return value, sandwich(inverse, meat * count / free, sandwich(inverse, white))


def estimate(search: Search, option: Option, form: str = "raw") -> Estimate:
    """Return the values of an accepted option's columns, in the joint fit of the whole model."""
    evidence, present, y = search.forms[form], search.present(form), search.y(form)
    value, covariance = joint_fit(evidence, present, y)
    columns = evidence.index(option.columns)
    places = np.array([int(np.flatnonzero(present.columns == column)[0]) for column in columns])
    scale = evidence.scale[columns]
    own, block = value[places], covariance[np.ix_(places, places)]
    kept, rms = _retained(search, option, own, form)
    return Estimate(
        option.columns,
        own * scale,
        np.sqrt(np.clip(np.diag(block), 0.0, None)) * scale,
        block * np.outer(scale, scale),
        kept,
        rms,
    )


def _retained(search: Search, option: Option, gamma: Floats, form: str) -> tuple[float, float]:
    """Return which part of an effect's variance no other column explains, and the rms that is left, nT.

    Its own variance is that about a constant channel: a temperature of 293 K that moves by one kelvin
    moves by one kelvin.
    """
    evidence = search.forms[form]
    columns = evidence.index(option.columns)
    left = projected(evidence.total, search.present(form, option))
    kept = float(gamma @ left[np.ix_(columns, columns)] @ gamma)
    whole = float(gamma @ centred(search, option) @ gamma)
    rows = max(float(evidence.count.sum()), 1.0)
    return min(kept / whole, 1.0) if whole > 0 else 0.0, float(np.sqrt(max(kept, 0.0) / rows))


def centred(search: Search, option: Option) -> Floats:
    """Return the Gram matrix of an option's columns about constant channels (see `GramArrays.centred`)."""
    own = search.raw.index(option.columns)
    # Only a channel has a mean that is none of the effect's doing.
    base = [name for term in search.library.base for name in term.columns] if option.channels else []
    return search.raw.centred(own, search.raw.index(base))


def detectable(search: Search, option: Option, form: str = "raw") -> Floats:
    """Return the amplitude of each column that would stand out by three sigma; physical units.

    From the scatter of the blocks' scores around the present model, the option not being in it.
    """
    evidence, y = search.forms[form], search.y(form)
    present = search.present(form, option)
    columns = evidence.index(option.columns)
    both = Present(
        np.concatenate([present.columns, columns]), np.append(present.precision, np.zeros(columns.size))
    )
    _, covariance = joint_fit(evidence, both, y)
    sigma = np.sqrt(np.clip(np.diag(covariance)[-columns.size :], 0.0, None))
    return np.asarray(3.0 * sigma * evidence.scale[columns])


def mimics(search: Search, option: Option, gamma: Floats) -> list[tuple[str, float]]:
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
    total = raw.total
    shift = regression(total, base, own) @ (gamma / raw.scale[own])
    return list(zip(names, (shift * raw.scale[base]).tolist(), strict=True))


def within_and_raw(search: Search, option: Option) -> float | None:
    """Return how far the raw and the within-day values of an effect disagree, per column (W / k).

    Large values tell of a wrong effect or a wrong form; it is a hint, not a test.
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
    half = inverse_square_root(left[np.ix_(wide, wide)][None])[0]
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


#: An effect of which the calibration and the rest of the model take over all but this part is weakly known.
WEAK = 0.02

#: Held-out gain from which an addition may make others weakly known.
_GREAT = 0.1

#: Exchanges of an effect for a better one at most: a search must end.
_EXCHANGES = 3

#: Coefficients of a cause at most that goes before wider forms, and the part of their gain it must reach.
_FEW, _PART = 12, 0.3

#: Puts what was taken into its best form.
Refiner = Callable[[Option], Option]

#: Returns a table with p-values of what flips of signs cannot be sure of.
Closer = Callable[[Table], Table]


def run(
    search: Search,
    most: int | None = None,
    refiner: Refiner | None = None,
    shapes_first: bool = False,
    closer: Closer | None = None,
) -> Table:
    """Add and drop until nothing more is justified; return the last table of scores.

    Parameters
    ----------
    refiner : callable, optional
        Returns an accepted option in its best form (a lag, a width), before the next one is sought.
    most : int, optional
        Additions at most; the rules' own number when absent.
    shapes_first : bool
        What explains most goes first, though it names no cause.
    closer : callable, optional
        Asked when nothing passes: returns the table with surer p-values.
    """
    most = search.rules.rounds if most is None else most
    for _ in range(most):
        table = search.table()
        found = winner(table, search, shapes_first)
        if found is None and closer is not None:
            table = closer(table)
            found = winner(table, search, shapes_first)
        if found is None:
            search.ran_out = False
            return table.light()
        option, form = found
        # What was fitted to folds holds on to the evidence, which grows when the option is refined.
        table = table.light()
        place = table.options.index(option)
        before = {one: estimate(search, one).retained for one in search.accepted}
        _note(search, "add", option, table, place, form)
        taken = _taken(search, option, refiner)
        search.rounds[-1] = replace(search.rounds[-1], name=taken.name)
        if search.is_hidden(taken):
            search.hide(taken)
            _note(search, "undo", taken, table, place, form)
            continue
        _drop_idle(search)
        if option.mechanism not in {one.mechanism for one in search.accepted}:
            search.banned.add(option.mechanism)
        if table.scores[form].gain[place] < _GREAT and _swallowed(search, before):
            search.accepted = list(before)
            search.recut()
            search.banned.add(option.mechanism)
            _note(search, "undo", option, table, place, form)
    search.ran_out = True
    return search.table().light()


def _taken(search: Search, option: Option, refiner: Refiner | None) -> Option:
    """Put an option into the model, in its best form; return that."""
    search.add(option)
    if refiner is not None:
        search.swap(option, better := refiner(option))
        return better
    return option


def polish(search: Search, refiner: Refiner) -> None:
    """Refine everything once more: what was taken early was refined while the others were missing."""
    for option in list(search.accepted):
        search.swap(option, refiner(option))


def _swallowed(search: Search, before: dict[Option, float]) -> bool:
    """Return True when an effect that stood by itself no longer does beside what was added.

    A wide form can hold what is left of several causes and, for a small gain, take them over.
    """
    return any(
        before.get(option, 0.0) >= WEAK and estimate(search, option).retained < WEAK
        for option in search.accepted
    )


def winner(table: Table, search: Search, shapes_first: bool = False) -> tuple[Option, str] | None:
    """Return what to add next and the form that shows it, or None when nothing is beyond doubt.

    One that names a cause goes before one that describes a shape (see `_named`), and of the same
    channels the one with fewer coefficients, when it does equally well.
    """
    passing = table.passing(search.rules)
    for form in FORMS:
        places = np.flatnonzero(passing[form])
        if not places.size:
            continue
        scores = table.scores[form]
        loss = scores.loss
        named = places.tolist() if shapes_first else _named(table, places.tolist(), scores.gain)
        first = min(named, key=lambda place: float(loss[:, place].sum()))
        same = [
            place
            for place in named
            if _are_forms(table.options[place], table.options[first])
            and _simplicity(table.options[place]) < _simplicity(table.options[first])
            and _does_as_well(table, place, first, form, search.rules)
        ]
        simplest = min((_simplicity(table.options[place]) for place in same), default=None)
        chosen = min(
            (place for place in same if _simplicity(table.options[place]) == simplest),
            key=lambda place: float(loss[:, place].sum()),
            default=first,
        )
        return table.options[_timely(table, places.tolist(), chosen, form, search.rules.rival_t)], form
    return None


def _timely(table: Table, places: list[int], chosen: int, form: str, rival_t: float) -> int:
    """Return what to take for a change in time: its steady cause if that does as well, else the best time."""
    option, scores = table.options[chosen], table.scores[form]
    if option.change is None:
        return chosen
    steady = [
        place
        for place in places
        if table.options[place].change is None
        and same_cause(table.options[place], option)
        and scores.behind(place, chosen) < rival_t
    ]
    if steady:
        return min(steady, key=lambda place: float(scores.loss[:, place].sum()))
    same = [place for place in places if table.options[place].mechanism == option.mechanism]
    return min(same, key=lambda place: float(scores.loss[:, place].sum()))


def _are_forms(one: Option, other: Option) -> bool:
    """Return True for forms of one cause; a change in time is none of another parameter's change."""
    in_time = one.change is not None or other.change is not None
    return one.channels == other.channels and (one.mechanism == other.mechanism or not in_time)


def _does_as_well(table: Table, simple: int, wide: int, form: str, rules: Rules) -> bool:
    """Return True when a wider form is no surer, or leaves but a little less: its shape is not seen."""
    scores = table.scores[form]
    left = scores.loss.sum(axis=0)
    little = float(left[simple] - left[wide]) < rules.gain * float(left[simple])
    return little or scores.behind(simple, wide) < rules.rival_t


def _named(table: Table, places: list[int], gain: Floats) -> list[int]:
    """Return those of the passing options that go first: named causes of few coefficients.

    A shape in a coordinate, or a form of dozens of coefficients, can mimic several causes at once. It waits
    for those, unless they explain but a small part of what it does; what it mimicked is then left to it.
    """
    best = max(float(gain[place]) for place in places)
    named = [place for place in places if not table.options[place].agnostic and gain[place] > _PART * best]
    few = [place for place in named if len(table.options[place].columns) <= _FEW]
    return few or named or places


def _simplicity(option: Option) -> tuple[int, bool]:
    """Order forms of one cause: fewer coefficients first, then a field straight in its channel."""
    return len(option.columns), not option.mechanism.startswith("channel_field")


def _drop_idle(search: Search) -> bool:
    """Drop effects that the others have made superfluous, the idlest first; return whether any was."""
    dropped = False
    while len(search.accepted) > 1:
        worths = [search.worth(option) for option in search.accepted]
        place = int(np.argmin([search.rules.standing(worth) for worth in worths]))
        gain, t = worths[place]
        if search.rules.standing(worths[place]) >= 1.0:
            return dropped
        option, dropped = search.accepted[place], True
        search.drop(option)
        # One chance to come back, when others are there: more would go round in circles.
        (search.banned if option.mechanism in search.dropped else search.dropped).add(option.mechanism)
        search.rounds.append(
            Round(len(search.rounds) + 1, "drop", option.name, option.family, gain, t, 1.0, "raw")
        )
    return dropped


def _note(search: Search, action: str, option: Option, table: Table, place: int, form: str) -> None:
    scores = table.scores[form]
    search.rounds.append(
        Round(
            len(search.rounds) + 1,
            action,
            option.name,
            option.family,
            float(scores.gain[place]),
            float(scores.t[place]),
            float(table.p[form][place]),
            form,
        )
    )


def settle(search: Search, refiner: Refiner | None = None) -> list[Standing]:
    """Compare every effect of the model with all that could take its place; exchange what does better.

    An effect taken early was compared with rivals while the others were still missing; now they are there.
    """
    tables: dict[str, Table] = {}
    for _ in range(_EXCHANGES):
        tables = {}
        for option in list(search.accepted):
            tables[option.name] = search.table(without=option)
            better = _better(search, option, tables[option.name])
            if better is not None:
                search.drop(option)
                better = _taken(search, better, refiner)
                told = len(search.rounds) + 1, "exchange", better.name, better.family
                search.rounds.append(Round(*told, 0.0, 0.0, 0.0, "raw"))
                break
        else:
            break
    if _drop_idle(search):
        tables = {}
    last = search.table() if search.accepted else None
    return [
        standing(search, option, tables.get(option.name) or search.table(without=option), last)
        for option in search.accepted
    ]


def _better(search: Search, option: Option, table: Table) -> Option | None:
    """Return an option that leaves significantly less than an accepted one in its place."""
    place = place_of(table, option)
    if place is None:
        return None
    form = form_of(table, place)
    scores = table.scores[form]
    loss = scores.loss
    passing = table.passing(search.rules)[form]
    others = [
        other
        for other in np.flatnonzero(passing)
        if not (table.options[other].agnostic and not option.agnostic)
        and not same_cause(table.options[other], option)
        and scores.behind(place, int(other)) > search.rules.rival_t
        and _is_worth(table, int(other), place, form, search.rules.gain)
    ]
    if not others:
        return None
    best = min(others, key=lambda other: float(loss[:, other].sum()))
    return table.options[best] if table.options[best].mechanism != option.mechanism else None


def _is_worth(table: Table, other: int, place: int, form: str, gain: float) -> bool:
    """Return True unless the other, a product or a wider form of the same channels, explains hardly more."""
    mine, wide = table.options[place], table.options[other]
    same = mine.channels == wide.channels and _simplicity(mine) < _simplicity(wide)
    if wide.family != "unknown" and not (same and mine.channels):
        return True
    left = table.scores[form].loss.sum(axis=0)
    return float(left[place] - left[other]) > gain * float(left[place])


#: Parts are at least so many correlation times of what is left, and so many rows, long.
_MEMORIES, _ROWS = 10.0, 20

#: Options looked at closely at most: the best of those that only their p-value keeps out.
_MOST = 6


def look_closer(search: Search, material: Material, table: Table) -> Table:
    """Return the table with p-values of options that lie in too few blocks for flips, where all else speaks.

    Each is a bound of Student's distribution times the number of options: family-wise, as flips are.
    """
    rules, raw = search.rules, table.scores["raw"]
    real = np.array([not option.placebo for option in table.options], dtype=bool)
    almost = real & (raw.t > rules.t) & (raw.gain > rules.gain) & (table.beats_placebo["raw"] > rules.t)
    almost &= table.p["raw"] >= rules.p
    places = sorted(np.flatnonzero(almost).tolist(), key=lambda place: float(raw.loss[:, place].sum()))
    if not places:
        return table
    tried = int(real.sum()) * len(table.scores)
    p = table.p["raw"].copy()
    for place in places[:_MOST]:
        p[place] = min(p[place], tried * _p_of(search, material, table.options[place]))
    return replace(table, p=table.p | {"raw": p})


def _p_of(search: Search, material: Material, option: Option) -> float:
    """Return the probability that an option gains by chance what it gains in parts of blocks."""
    terms = _terms_of(material, option)
    if terms is None:
        return 1.0
    trials = Trials(search, material, option)
    before, after = trials.contribution(option, terms)
    series = material.series
    memory = correlation_s(
        series, (after / np.where(trials.root > 0, trials.root, 1.0)).reshape(len(series.tt2000), -1)
    )
    length = max(_MEMORIES * memory, _ROWS * series.step_s)
    part = ((series.tt2000 - series.tt2000[0]) / (length * SECOND)).astype(np.int64)
    part = np.repeat(part, len(before) // len(part))
    _, part = np.unique(part, return_inverse=True)
    gained, promised = _summed(before**2 - after**2, part), _summed((before - after) ** 2, part)
    return float(expected_gain_p(gained, promised, promised > 0)[0])


def _summed(values: Floats, part: npt.NDArray[np.int64]) -> Floats:
    """Return the sums of rows (row,) by their part; (part, 1)."""
    return np.bincount(part, weights=values).astype(np.float64)[:, None]


def _terms_of(material: Material, option: Option) -> list[Term] | None:
    """Return the terms whose columns an option is made of; None when the series cannot make them."""
    if option.change is None or option.terms:
        keys = list(option.terms)
        return [material.terms[key] for key in keys] if set(keys) <= set(material.terms) else None
    carried = {column for column, _ in option.change.functions.values()}
    found = [term for term in material.terms.values() if carried & set(term.columns)]
    return found or None
