"""State of the search (frozen), options, calibration intervals.

Where calibration intervals are cut, and what of a change at a moment no cut may hide.

Parameters that are fitted anew in every interval take up a step at an interval's edge, and most of one
that is near it. Where intervals begin is nobody's knowledge of the sensors. A change is therefore judged
with intervals whose edges keep away from its moment, as long as the others.

What a search chooses from: options, rules they are taken by, their scores, and the ledger of rounds.

Rounds of the search: score everything, add the best that is beyond doubt, drop what it made superfluous.

All of it is algebra on the evidence. The calibration's own parameters are absorbed, interval by
interval, in three forms: ``raw``; ``within``, where every day is calibrated anew, so that nothing
slow can pass for an effect; ``white``, where each row has lost what the one before foretells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.design import Library
from inflight.diagnosis.scoring import (
    Index,
    Present,
    Scores,
    family_wise,
    fit,
    flip_ratios,
    flip_signs,
    folds_of,
    projected,
    score,
    with_changes,
)
from inflight.diagnosis.time_changes import Carriers, Change, batches, drifts, episodes, steps
from inflight.lsq import GramBlocks

Groups = Sequence[Sequence[int]]

#: Edges keep so far away from moments, in parts of an interval's usual length.
_AWAY = 0.25

#: A change shows in the intervals as they were when it takes off so many times a row's variance at least
#: (three sigma, of residuals correlated over several rows), and this part of what its size promises.
_CLEAR, _KEPT = 50.0, 0.5


def cut_around(evidence: GramBlocks, cut: Groups, moments: Sequence[int]) -> list[list[int]]:
    """Return intervals no edge of which is near some moments.

    An edge that is near one goes half an interval away from it, to both sides: no interval becomes longer
    than the longest. Only where another moment is there the intervals stay together.

    Parameters
    ----------
    cut : sequence of sequence of int
        Consecutive blocks of each interval.
    moments : sequence of int
        TT2000.
    """
    firsts = [*(group[0] for group in cut), len(evidence)]
    length = float(np.median([evidence.end[group[-1]] - evidence.start[group[0]] for group in cut]))
    edges: set[int] = set()
    for before, edge, after in zip(firsts, firsts[1:-1], firsts[2:], strict=False):
        if _is_free(evidence, edge, moments, _AWAY * length):
            edges.add(edge)
        else:
            edges |= {before + (edge - before) // 2, edge + -(-(after - edge) // 2)}
    inner = {one for one in edges if 0 < one < len(evidence)}
    kept = sorted(one for one in inner if _is_free(evidence, one, moments, _AWAY * length))
    return [part.tolist() for part in np.split(np.arange(len(evidence)), kept)]


def _is_free(evidence: GramBlocks, edge: int, moments: Sequence[int], reach: float) -> bool:
    return all(abs(int(evidence.start[edge]) - moment) >= reach for moment in moments)


def is_at_edge(evidence: GramBlocks, cut: Groups, moment: int, sharpness: int) -> bool:
    """Return True when a moment known no better may lie on an edge between intervals."""
    return any(abs(int(evidence.start[group[0]]) - moment) <= sharpness for group in cut[1:])


def shows(
    evidence: GramBlocks, present: Present, columns: Index, gamma: Floats, y: int, variance: float
) -> bool:
    """Return True when a change of a known size takes off of the residual what it should.

    Parameters
    ----------
    evidence : GramBlocks
        With the intervals as they were.
    gamma : ndarray, shape (column,)
        The change's values (scaled), from intervals that do not hide it.
    variance : float
        Of a row, nT^2.
    """
    left = projected(evidence.total, present)
    promised = float(gamma @ left[np.ix_(columns, columns)] @ gamma)
    gained = -2.0 * float(gamma @ left[columns, y]) - promised
    return gained > max(_CLEAR * variance, _KEPT * promised)


#: An effect of which the calibration leaves less than this part cannot be told from the calibration.
LEAST_KEPT = 1e-3

#: An effect of its usual size that explains less than so many times a row's variance could not be seen: three
#: sigma, of residuals correlated over several rows.
_CLEAR_EFFECT = 50.0

#: Part of a column that the calibration leaves, from which on it is no matter of the calibration.
_OWN = 0.05


@dataclass(frozen=True)
class Rules:
    """When a candidate is taken, and what counts as a rival.

    Attributes
    ----------
    t, gain, p : float
        Held-out t and gain at least, family-wise p at most, of an addition.
    keep_t, keep_gain : float
        Of an effect that stays when the others are there.
    rival_t : float
        Rivals lose to the winner by less than this t.
    draws, seed : int
        Flips of signs.
    rounds : int
        Additions at most.
    blocks : int
        Fewest independent blocks a verdict is given from.
    """

    t: float = 3.0
    gain: float = 0.01
    p: float = 0.05
    keep_t: float = 3.0
    keep_gain: float = 0.005
    rival_t: float = 2.0
    draws: int = 2000
    seed: int = 0
    rounds: int = 8
    blocks: int = 20

    def shown(self, scores: Scores, p: Floats) -> npt.NDArray[np.bool_]:
        """Return which candidates gain enough, surely enough, placebos aside."""
        return (scores.t > self.t) & (scores.gain > self.gain) & (p < self.p)

    def standing(self, worth: tuple[float, float]) -> float:
        """Return how far (gain, t) of an effect are above what keeps it: it stays from 1 on."""
        gain, t = worth
        return min(gain / self.keep_gain, t / self.keep_t)


@dataclass(frozen=True, eq=False)
class Option:
    """Something that can be added to the model: a candidate of the library, or a change in time."""

    name: str
    mechanism: str
    family: str
    columns: tuple[str, ...]
    channels: tuple[str, ...] = ()
    terms: tuple[str, ...] = ()
    lag_s: float = 0.0
    agnostic: bool = False
    placebo: bool = False
    change: Change | None = None
    lag_sigma_s: float | None = None

    @property
    def interleaved(self) -> bool:
        """True when blocks around those held out must be among the fitted (see `Change`)."""
        return self.change is not None and self.change.interleaved


@dataclass
class Table:
    """Scores of all options in one round; arrays over options, by form."""

    options: list[Option]
    scores: dict[str, Scores]
    p: dict[str, Floats]
    beats_placebo: dict[str, Floats]

    def light(self) -> Table:
        """Return the table without what was fitted to folds, which holds on to gigabytes of evidence."""
        return replace(self, scores={form: one.light() for form, one in self.scores.items()})

    def passing(self, rules: Rules) -> dict[str, np.ndarray]:
        """Return, a form, which options may be added."""
        real = np.array([not option.placebo for option in self.options], dtype=bool)
        raw = self.scores["raw"]
        # What only a filtered form shows must at least show the right way in the residual itself.
        agreed = {
            "raw": real,
            "within": real & (raw.t > 0),
            "white": real & (raw.gain > 0.5 * rules.gain) & (raw.t > 1),
        }
        return {
            form: agreed[form]
            & rules.shown(self.scores[form], self.p[form])
            & (self.beats_placebo[form] > rules.t)
            for form in self.scores
        }


@dataclass(frozen=True)
class Round:
    """One addition or removal, for the ledger."""

    number: int
    action: str
    name: str
    family: str
    gain: float
    t: float
    p: float
    form: str

    def as_json(self) -> dict[str, object]:
        """Return the fields by name."""
        return dict(vars(self))


def is_seen(
    raw: GramBlocks, form: GramBlocks, columns: Sequence[str], base: Index, usual: Floats, variance: float
) -> bool:
    """Return True when an effect of its usual size would stand out of what the calibration leaves.

    Parameters
    ----------
    raw, form : GramBlocks
        Before and after the calibration was absorbed.
    columns : sequence of str
        Of the effect.
    base : ndarray of int
        Columns of the calibration that the effect may share a constant with.
    usual : ndarray, shape (column,)
        Usual size of each column.
    variance : float
        Of a row, nT^2.
    """
    whole = np.diag(raw.centred(raw.index(columns), base))
    left = np.diag(form.total)[form.index(columns)]
    kept = np.where(whole > 0, left / np.where(whole > 0, whole, 1.0), 0.0)
    # What the calibration hardly touches is seen or not by the data; of what it nearly takes over, the
    # usual size says whether the rest can be.
    own = np.diag(raw.total)[raw.index(columns)]
    clear = left > _OWN * own
    clear |= left * usual[: len(left)] ** 2 > _CLEAR_EFFECT * variance
    return bool(np.any((kept >= LEAST_KEPT) & clear))


__all__ = ["FORMS", "Option", "Round", "Rules", "Search", "Table"]

FORMS = ("raw", "within", "white")


@dataclass
class Search:
    """State of a search: the evidence, what the model holds, what was added.

    Parameters
    ----------
    raw, white : GramBlocks
        Columns as the library has them, the calibration's own among them.
    library : Library
        What the columns are.
    intervals, days : sequence of sequence of int
        Blocks of each calibration interval, and of each day.
    rules : Rules
    within : GramBlocks, optional
        The within-day form of blocks longer than a day, absorbed when they were made.
    """

    raw: GramBlocks
    white: GramBlocks
    library: Library
    intervals: Sequence[Sequence[int]]
    days: Sequence[Sequence[int]]
    rules: Rules = field(default_factory=Rules)
    within: GramBlocks | None = None
    residual: int = 0
    accepted: list[Option] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    forms: dict[str, GramBlocks] = field(default_factory=dict)
    carriers: Carriers = field(default_factory=Carriers)
    #: Mechanisms that were taken back: what they added was others'; and those that were dropped once.
    banned: set[str] = field(default_factory=set)
    dropped: set[str] = field(default_factory=set)
    #: Changes that the calibration's intervals, as they were asked for, take up whole.
    hidden: list[Change] = field(default_factory=list)
    #: The rounds ended because there were as many as the rules allow.
    ran_out: bool = False
    #: Columns on the coarse series, when more were joined to the evidence: names and (sample, row, column).
    wall: tuple[list[str], list[np.ndarray]] = field(default_factory=lambda: ([], []))

    def __post_init__(self) -> None:
        self.options = [
            Option(
                one.name,
                one.mechanism,
                one.family,
                tuple(self.library.columns_of(one)),
                one.channels,
                one.terms,
                one.lag_s,
                one.agnostic,
                one.placebo,
            )
            for one in self.library.candidates
        ]
        self.variance = self._variance()
        #: Intervals as they were asked for; those in use keep their edges away from changes that were taken.
        self.intervals = self.cut = [list(map(int, group)) for group in self.intervals]
        self.absorb()
        self._leave_out()

    def _leave_out(self) -> None:
        """Leave out what the calibration takes over, and say so."""
        seen = {option.name: self._seen(option) for option in self.options}
        visible = {option.mechanism for option in self.options if seen[option.name]}
        told = {
            one.mechanism: one for one in self.options if one.mechanism not in visible and not one.placebo
        }
        self.unscorable = [
            {
                "name": name,
                "family": one.family,
                "channels": list(one.channels),
                "reason": "the calibration takes it over: what is left of it could not be seen",
            }
            for name, one in told.items()
        ]
        self.options = [option for option in self.options if seen[option.name]]

    def _seen(self, option: Option) -> bool:
        base, _ = self.base()
        usual = np.array([size for key in option.terms for size in self.library.terms[key].usual])
        own_base = self.raw.index(base if option.channels else [])
        return is_seen(self.raw, self.forms["raw"], option.columns, own_base, usual, self.variance)

    # The calibration and the model's own parameters.

    def base(self) -> tuple[list[str], Floats]:
        """Return the calibration's own columns and what is known of them beforehand, standard deviations."""
        names = [name for term in self.library.base for name in term.columns]
        sigma = [s for term in self.library.base for s in term.sigma]
        return names, np.asarray(sigma)

    def precision(self, evidence: GramBlocks, names: Sequence[str], sigma: Floats) -> Floats:
        """Return variance over squared prior sigma in scaled units; 0 without a prior."""
        scale = evidence.scale[evidence.index(names)]
        with np.errstate(divide="ignore"):
            return np.asarray(np.where(np.isfinite(sigma), self.variance * (scale / sigma) ** 2, 0.0))

    def _variance(self) -> float:
        """Return the variance of a row that the calibration alone leaves, the quietest half of the blocks."""
        names, _ = self.base()
        free = self.white.marginalise(names, [range(len(self.white))], np.zeros(len(names)))
        y = free.residuals[self.residual]
        each = free.squares[:, y] / np.maximum(free.count, 1.0)
        return float(np.median(each[free.count > 0])) if np.any(free.count > 0) else 1.0

    def absorb(self) -> None:
        """Make the three forms anew from the evidence."""
        names, sigma = self.base()
        precision = self.precision(self.raw, names, sigma)
        self.forms = {
            form: (self.within if form == "within" else None)
            or source.marginalise(names, groups, precision, np.float32)
            for form, (source, groups) in self.sources().items()
        }

    def sources(self) -> dict[str, tuple[GramBlocks, Sequence[Sequence[int]]]]:
        """Return what each form is absorbed from, and the blocks of each of its intervals."""
        return {
            "raw": (self.raw, self.intervals),
            "within": (self.raw, self.days),
            "white": (self.white, self.intervals),
        }

    def y(self, form: str = "raw") -> int:
        """Index of the residual that is searched."""
        return self.forms[form].residuals[self.residual]

    def present(self, form: str = "raw", without: Option | None = None) -> Present:
        """Return the columns of the model beside the calibration, with their priors."""
        return self.present_in(self.forms[form], without)

    def _model_columns(self, without: Option | None = None) -> list[str]:
        """Names of the model's columns beside the calibration: refined ones, then those taken."""
        names = [name for term in self.library.refined for name in term.columns]
        return names + [name for one in self.accepted if one is not without for name in one.columns]

    def present_in(self, evidence: GramBlocks, without: Option | None = None) -> Present:
        """Return the columns of the model in some evidence that has them, with their priors."""
        names = self._model_columns(without)
        sigma = [s for term in self.library.refined for s in term.sigma]
        sigma += [np.inf] * (len(names) - len(sigma))
        return Present(evidence.index(names), self.precision(evidence, names, np.asarray(sigma)))

    def holding(self, options: Sequence[Option]) -> Search:
        """Return the search as if it had taken some options and no others; it shares the evidence."""
        other = copy(self)
        other.accepted = list(options)
        return other

    # Scores.

    def table(self, without: Option | None = None) -> Table:
        """Score everything that is not in the model (an effect of it left out, when one is named)."""
        taken = {name for option in self.accepted if option is not without for name in option.columns}
        itself = without.name if without is not None else ""
        main = [
            one
            for one in self.options
            if one.change is None
            and not set(one.columns) & taken
            and (one.mechanism not in self.banned or one.name == itself)
        ]
        signs, units = flip_signs(len(self.raw), self.rules.draws, self.rules.seed)
        scores: dict[str, Scores] = {}
        ratios: dict[str, tuple[Floats, Floats]] = {}
        for form, evidence in self.forms.items():
            present, y = self.present(form, without), self.y(form)
            columns = [evidence.index(option.columns) for option in main]
            scores[form] = score(evidence, present, columns, y, folds_of(len(evidence)))
            ratios[form] = flip_ratios(evidence, present, columns, y, signs, units)
        options = list(main)
        whole = float(scores["raw"].loss0.sum())
        timed = []
        for more, own, own_present, hidden in self._changes(without):
            y, columns = own.residuals[self.residual], [own.index(option.columns) for option in more]
            found = score(own, own_present, columns, y, folds_of(len(own), more[0].interleaved))
            ratio, flipped = flip_ratios(own, own_present, columns, y, signs, units)
            if hidden is not None:
                kept = self._not_hidden(more, hidden, found.gamma)
                found, ratio, flipped = found.of_whole(whole).only(kept), ratio * kept, flipped * kept
            timed.append((found, (ratio, flipped)))
            options += more
        scores, ratios = with_changes(scores, ratios, timed)
        largest = np.concatenate([flipped for _, flipped in ratios.values()], axis=1)
        real = np.tile(np.array([not option.placebo for option in options], dtype=bool), len(ratios))
        p = {form: family_wise(observed, largest[:, real]) for form, (observed, _) in ratios.items()}
        placebos = [place for place, option in enumerate(options) if option.placebo]
        beats = {
            form: one.beats(placebos, self.rules.shown(one, p[form]), self.rules.rival_t)
            for form, one in scores.items()
        }
        return Table(options, scores, p, beats)

    def _changes(
        self, without: Option | None
    ) -> Iterator[tuple[list[Option], GramBlocks, Present, GramBlocks | None]]:
        """Yield options bound to a time, some at a time with the evidence of their columns alone.

        Where that is of other intervals than those in use, it comes again with those asked for.
        """
        base, _ = self.base()
        own = self._model_columns(without)
        found = drifts(self.raw, self.carriers) + steps(self.raw, self.carriers)
        found += episodes(self.raw, self.forms["raw"], self.carriers.outside(base), self.y())
        gone = self._gone(found, without)
        for cut, batch in self._in_batches([one for one in found if one.name not in gone], without):
            functions = {name: told for change in batch for name, told in change.functions.items()}
            sources = [column for column, _ in functions.values()]
            small = self.raw.select(list(dict.fromkeys([*base, *own, *sources]))).expand(functions)
            wide = self._absorbed(small, cut)
            live = np.diagonal(wide.total) > 0
            options = [
                Option(one.name, one.mechanism, one.family, tuple(one.functions), change=one)
                for one in batch
                if live[wide.index(list(one.functions))].any()
            ]
            if options:
                hidden = None if cut == self.intervals else self._absorbed(small, self.cut)
                yield options, wide, self.present_in(wide, without), hidden
        # Those that were put to their moment have columns of their own.
        for one in self.options:
            if one.change is not None and one.name not in gone:
                cut = self._cut_for(one.change, without)
                small = self.raw.select(list(dict.fromkeys([*base, *own, *one.columns])))
                wide = self._absorbed(small, cut)
                hidden = None if cut == self.intervals else self._absorbed(small, self.cut)
                yield [one], wide, self.present_in(wide, without), hidden

    def _gone(self, found: Sequence[Change], without: Option | None) -> set[str]:
        """Return the names of changes that are not asked about: taken, like one taken, banned, hidden."""
        taken = [option.change for option in self.accepted if option.change and option is not without]
        known = [*found, *(option.change for option in self.options if option.change is not None)]
        gone = {change.name for change in known if any(change.is_like(one) for one in taken)}
        # What is hidden may have been another parameter's change: no data say which.
        gone |= {change.name for change in known if any(change.is_when(one) for one in self.hidden)}
        gone |= {change.name for change in known if change.mechanism in self.banned}
        gone |= {option.name for option in self.accepted}
        return gone - ({without.name} if without is not None else set())

    def _in_batches(
        self, found: Sequence[Change], without: Option | None
    ) -> Iterator[tuple[Groups, list[Change]]]:
        """Yield changes some at a time with the intervals they are judged with."""
        cuts: list[tuple[Groups, list[Change]]] = []
        for change in found:
            cut = self._cut_for(change, without)
            same = next((some for other, some in cuts if other == cut), None)
            if same is None:
                cuts.append((cut, [change]))
            else:
                same.append(change)
        for cut, some in cuts:
            for batch in batches(some):
                yield cut, batch

    def _cut_for(self, change: Change, without: Option | None) -> Groups:
        """Return the intervals to judge a change with: those in use, when none of their edges is near."""
        # What comes and goes within some days, or grows all the time, no interval takes up; and what would
        # take the place of an effect is judged like that one.
        if without is not None or len(change.at) != 1:
            return self.intervals
        return self._cut_of(change.at)

    def _cut_of(self, more: Sequence[int] = ()) -> Groups:
        at = [one.change.at[0] for one in self.accepted if one.change is not None and len(one.change.at) == 1]
        return cut_around(self.raw, self.cut, [*at, *more])

    def _absorbed(self, evidence: GramBlocks, cut: Groups) -> GramBlocks:
        names, sigma = self.base()
        return evidence.marginalise(names, cut, self.precision(evidence, names, sigma))

    def _not_hidden(
        self, options: Sequence[Option], evidence: GramBlocks, values: Sequence[Floats]
    ) -> npt.NDArray[np.bool_]:
        """Return which changes show with the intervals asked for, too, or may do so at their moment."""
        present, y = self.present_in(evidence), evidence.residuals[self.residual]
        out = []
        for option, gamma in zip(options, values, strict=True):
            assert option.change is not None
            at, sharp = option.change.at[0], option.change.sharpness
            columns = evidence.index(option.columns)
            seen = shows(evidence, present, columns, gamma, y, self.variance)
            out.append(seen or is_at_edge(self.raw, self.cut, at, sharp))
        return np.array(out)

    # Additions and removals.

    def add(self, option: Option) -> None:
        """Put an option into the model; a change's columns join the evidence."""
        if option.change is not None and option.change.functions:
            self._forget(option.columns)
            self.raw = self.raw.expand(option.change.functions)
            self.white = self.white.expand(option.change.functions)
            self.absorb()
        self.accepted.append(option)
        self.recut()

    def recut(self) -> None:
        """Keep the edges of the intervals away from what was taken."""
        cut = self._cut_of()
        if cut != self.intervals:
            self.intervals = cut
            self.absorb()

    def swap(self, option: Option, other: Option) -> None:
        """Put an option into the model in the place of one that is there."""
        self.accepted[self.accepted.index(option)] = other
        self.recut()

    def is_hidden(self, option: Option) -> bool:
        """Return True for a change in the model that the intervals asked for take up whole."""
        if option.change is None or len(option.change.at) != 1 or self.intervals == self.cut:
            return False
        if cut_around(self.raw, self.cut, option.change.at) == self.cut:
            return False
        form, present = self.forms["raw"], self.present("raw", option)
        (gamma,), _ = fit(form, present, [form.index(option.columns)], self.y())
        base, _ = self.base()
        evidence = self._absorbed(self.raw.select([*base, *self._model_columns()]), self.cut)
        y, columns = evidence.residuals[self.residual], evidence.index(option.columns)
        return not shows(evidence, self.present_in(evidence, option), columns, gamma, y, self.variance)

    def hide(self, option: Option) -> None:
        """Take out of the model what the intervals asked for take up whole, and say so."""
        assert option.change is not None
        self.drop(option)
        self.hidden.append(option.change)
        self.unscorable.append(
            {
                "name": option.name,
                "family": option.family,
                "channels": [],
                "reason": "it lies at the edge of a calibration interval, whose own parameters take it up",
            }
        )

    def as_found(self) -> Search:
        """Return the search with nothing taken and the intervals asked for; of the raw form alone."""
        other = self.holding([])
        if self.intervals != self.cut:
            base, _ = self.base()
            other.intervals = self.cut
            other.forms = {"raw": self._absorbed(self.raw.select([*base, *other._model_columns()]), self.cut)}
        return other

    def _forget(self, columns: Sequence[str]) -> None:
        """Let go of columns of a change that was dropped: they know nothing of what joined since."""
        if set(columns) & set(self.raw.names):
            kept = [name for name in self.raw.names if name not in columns][: -len(self.raw.residuals)]
            self.raw, self.white = self.raw.select(kept), self.white.select(kept)

    def drop(self, option: Option) -> None:
        """Take an option out of the model."""
        self.accepted = [one for one in self.accepted if one is not option]
        self.recut()

    def worth(self, option: Option) -> tuple[float, float]:
        """Return held-out gain and t of an effect of the model against the model without it, best form."""
        found: list[tuple[float, float]] = []
        for form, evidence in self.forms.items():
            if option.change is not None and form == "within":
                continue
            small = evidence.select([*self._model_columns(option), *option.columns])
            folds = folds_of(len(small), option.interleaved)
            y = small.residuals[self.residual]
            one = score(small, self.present_in(small, option), [small.index(option.columns)], y, folds)
            found.append((float(one.gain[0]), float(one.t[0])))
        return max(found, key=self.rules.standing)
