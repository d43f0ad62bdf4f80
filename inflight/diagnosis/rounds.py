"""Forward and backward rounds, and the rivals of what they took."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from inflight.arrays import Floats
from inflight.diagnosis.estimates import estimate
from inflight.diagnosis.search import FORMS, Option, Round, Rules, Search, Table
from inflight.diagnosis.standing import Standing, form_of, place_of, same_cause, standing

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
