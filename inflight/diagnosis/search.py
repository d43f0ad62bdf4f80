"""State of a search: one frozen record of what the model holds, and the steps that make a new one.

Takes the Gram blocks of a pass, raw and prewhitened, and the library their columns belong to. The
calibration's own parameters are marginalised interval by interval in three forms: ``raw``; ``within``, where
every day is calibrated anew, so that nothing slow can pass for an effect; ``white``, where each row has lost
what the row before predicts. `Search.table` scores everything that may be added (`inflight.diagnosis.scoring`
has the formulas); `Search.add`, `drop`, `exchange`, `hide` and `join` return the next state.

Parameters that are fitted anew in every interval take up a step at an interval's edge, and most of one that
is near it. A change is therefore judged with intervals whose edges keep away from its time
(`intervals_around`). A change that the requested intervals take up whole is hidden and listed as unscorable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.design import Library, Term
from inflight.diagnosis.scoring import (
    Index,
    ModelColumns,
    Scores,
    append_changes,
    draw_signs,
    family_wise_p,
    fit,
    make_folds,
    remaining_of,
    score,
    sign_flip_ratios,
)
from inflight.diagnosis.time_changes import (
    Change,
    TimeVariableColumns,
    batch_changes,
    drifts,
    episodes,
    steps,
)
from inflight.frames import SHADOW
from inflight.lsq import BlockProducts, CalibratedBlocks, FactoredGrams, GramBlocks, TimedGrams, hac_t

Groups = Sequence[Sequence[int]]


class Border(NamedTuple):
    """Products of new columns with those there are, as `FactoredGrams.bordered` takes them."""

    across: Floats
    inner: Floats
    given: Floats | None = None


#: A number that is held keeps this part of the sigma it states: next to nothing, and no trouble to solvers.
HELD = 1e-3

#: Forms of the Gram blocks, in the order of preference.
FORMS = ("raw", "within", "white")


@dataclass(frozen=True, kw_only=True)
class Rules:
    """When a candidate is taken, and what counts as a rival.

    Attributes
    ----------
    t, gain, p : float
        Held-out t and gain at least, family-wise p at most, of an addition. Three sigma, one hundredth of the
        mean square, and a stated level of significance (MISSING_EFFECT 2.3; chosen on its 27 runs).
    keep_t, keep_gain : float
        Of an effect that stays when the others are there (MISSING_EFFECT 2.3: half the gain of an addition).
    rival_t : float
        Rivals lose to the winner by less than this t: two sigma, a model confidence set (MISSING_EFFECT 2.4).
    draws, seed : int
        Sign flips; 2000 give a p of 0.05 to 0.005.
    rounds : int
        Additions at most: a bound on time, assumed.
    blocks : int
        Fewest independent blocks a verdict is given from (MISSING_EFFECT, failure F2).
    raw_gain, raw_t : float
        What only the within-day or the prewhitened form shows must show in the raw form by this part of
        `gain` and this t; assumed.
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
    raw_gain: float = 0.5
    raw_t: float = 1.0

    def significant(self, scores: Scores, p: Floats) -> npt.NDArray[np.bool_]:
        """Return which candidates gain enough, significantly enough; placebos included."""
        return (scores.t > self.t) & (scores.gain > self.gain) & (p < self.p)

    def margin(self, worth: tuple[float, float]) -> float:
        """Return how far (gain, t) of an effect are above what keeps it: it stays from 1 on."""
        gain, t = worth
        return min(gain / self.keep_gain, t / self.keep_t)

    def firm(self, worth: tuple[float, float]) -> bool:
        """Return True when an effect of this (gain, t) would stay were its gain one sigma smaller."""
        gain, t = worth
        return t > 1.0 and self.margin((gain - gain / t, t - 1.0)) >= 1.0


@dataclass(frozen=True, kw_only=True)
class VisibilitySettings:
    """When an effect, or a change in time, can be seen next to the calibration.

    Attributes
    ----------
    edge_distance : float
        Edges of intervals keep so far away from changes, in parts of an interval's usual length; assumed.
    clear : float
        Sum of squares explained at least, in variances of a row: three sigma of residuals that are
        correlated over several rows (9 times about 5.6 rows); assumed.
    expected_part : float
        Part of its expected gain that a change must show with the requested intervals; assumed.
    least_retained : float
        An effect of which the calibration leaves less than this part cannot be separated from it; assumed
        (MISSING_EFFECT 2.4 warns below 0.01).
    own_part : float
        Part of a column that the calibration leaves, from which on the data alone decide; assumed.
    twin : float
        A column of which another one explains this part of the square is that one in other units: the rest is
        what interpolation between readings makes of it; assumed.
    """

    edge_distance: float = 0.25
    clear: float = 50.0
    expected_part: float = 0.5
    least_retained: float = 1e-3
    own_part: float = 0.05
    twin: float = 0.99


VISIBILITY_SETTINGS = VisibilitySettings()


@dataclass(frozen=True, eq=False, kw_only=True)
class Option:
    """Something that can be added to the model: a candidate of the library, or a change in time.

    Attributes
    ----------
    name, mechanism, family, channels, terms, lag_s, agnostic, placebo
        As of `inflight.design.Candidate`.
    columns : tuple of str
        Its columns of the Gram blocks.
    change : Change, optional
        When it is bound to a time.
    lag_sigma_s : float, optional
        Error of a refined lag, s.
    of_more : float
        It was the best of so many times as many as those it is scored with: its p-value counts them.
    number : str
        Name of the number of the model that it changes (see `inflight.design.HeldNumber`).
    number_sigma : float, optional
        Error of its value once that was found, in its unit; None of a derivative.
    """

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
    of_more: float = 1.0
    number: str = ""
    number_sigma: float | None = None

    @property
    def interleaved(self) -> bool:
        """True when blocks around those held out must be among the fitted (see `Change`)."""
        return self.change is not None and self.change.interleaved

    @property
    def sources(self) -> set[str]:
        """Columns of the library that its own are made from."""
        functions = {} if self.change is None else self.change.functions
        return {functions[name][0] if name in functions else name for name in self.columns}


@dataclass(frozen=True)
class ScoreTable:
    """Scores of all options in one round; arrays over options, by form of the Gram blocks."""

    options: list[Option]
    scores: dict[str, Scores]
    p: dict[str, Floats]
    t_over_placebo: dict[str, Floats]

    def without_fits(self) -> ScoreTable:
        """Return the table without what was fitted to folds, which references gigabytes of Gram blocks."""
        return replace(self, scores={form: one.without_fits() for form, one in self.scores.items()})

    def passing(self, rules: Rules) -> dict[str, np.ndarray]:
        """Return which options may be added, by form."""
        real = np.array([not option.placebo for option in self.options], dtype=bool)
        raw = self.scores["raw"]
        # What only a filtered form shows must at least have the same sign in the residual itself.
        agreed = {
            "raw": real,
            "within": real & (raw.t > 0),
            "white": real & (raw.gain > rules.raw_gain * rules.gain) & (raw.t > rules.raw_t),
        }
        return {
            form: agreed[form]
            & rules.significant(self.scores[form], self.p[form])
            & (self.t_over_placebo[form] > rules.t)
            for form in self.scores
        }


@dataclass(frozen=True, kw_only=True)
class Round:
    """One entry of the ledger: `action` is add, drop, undo or exchange."""

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


@dataclass(frozen=True)
class CachedDesign:
    """Cached design matrix of the coarse series: names of columns, and pieces (sample, row, column) of it."""

    names: tuple[str, ...] = ()
    pieces: tuple[npt.NDArray[np.float32], ...] = ()


@dataclass(kw_only=True, eq=False)
class SharedGrams:
    """Gram blocks of a search. There are gigabytes of them, so all states share this one copy.

    Columns are added in place; no product of columns that are there ever changes, so an earlier state still
    reads what it read before. Forms are made for one set of calibration intervals, when they are asked for.

    Attributes
    ----------
    raw, white : FactoredGrams
        Columns as the library has them, the calibration's own among them.
    days : sequence of sequence of int
        Blocks of each day; those of blocks longer than a day hold a fit of each day.
    base : sequence of str
        The calibration's own columns.
    precision : ndarray, shape (column,)
        Prior precision of these, scaled.
    intervals : sequence of sequence of int
        Calibration intervals the forms were made for.
    forms : dict of str to GramBlocks
        The calibration marginalised: ``raw``, ``within``, ``white``; empty when they must be made anew.
    changes : dict
        Drifts, steps and episodes: by first blocks of the intervals, and the residual.
    """

    raw: FactoredGrams
    white: FactoredGrams
    days: Groups
    base: Sequence[str]
    precision: Floats
    intervals: Groups = ()
    forms: dict[str, GramBlocks] = field(default_factory=dict)
    changes: dict[tuple[tuple[int, ...], int], list[Change]] = field(default_factory=dict)
    _earlier: dict[str, GramBlocks] = field(default_factory=dict, init=False, repr=False)

    def forms_for(self, intervals: Groups) -> dict[str, GramBlocks]:
        """Return the three forms with some calibration intervals."""
        if not self.forms or self.intervals != intervals:
            same = self.intervals == intervals
            earlier = self._earlier | self.forms
            self.intervals, self.forms, self._earlier = intervals, {}, {}

            def left(form: str, blocks: FactoredGrams, groups: Groups | None) -> FactoredGrams:
                known = earlier.pop(form, None) if same or form == "within" else None
                known = known if isinstance(known, FactoredGrams) else None
                return blocks.marginalise(self.base, groups, self.precision, earlier=known)

            self.forms = {
                "raw": left("raw", self.raw, intervals),
                "within": left("within", self.raw, None if self.raw.fits > 1 else self.days),
                "white": left("white", self.white, intervals),
            }
        return self.forms

    def outdate(self) -> None:
        """Let the forms be made anew, from what they hold of the columns that are still there."""
        self.forms, self._earlier = {}, self._earlier | self.forms

    def forget_products(self) -> None:
        """Let go of the products that blocks keep to be quick: hundreds of megabytes of a long record."""
        for form in (self.raw, self.white, *(self.forms | self._earlier).values()):
            if isinstance(form, FactoredGrams):
                form.forget_products()

    def expand(self, functions: Mapping[str, tuple[str, Floats]]) -> None:
        """Add columns that are others times a function of the block (see `GramBlocks.expand`)."""
        if set(functions) & set(self.raw.names):
            # Columns of a change that was dropped lack the products with what joined since.
            self.raw, self.white = self.raw.without(functions), self.white.without(functions)
        self.raw, self.white = self.raw.expand(functions), self.white.expand(functions)
        self.outdate()

    def join(self, names: Sequence[str], scale: Floats, raw: Border, white: Border) -> None:
        """Add columns to the Gram blocks.

        Parameters
        ----------
        names : sequence of str
        scale : ndarray, shape (column,)
            Physical size of one unit of each new column.
        raw, white : Border
        """
        self.raw = self.raw.bordered(names, scale, *raw)
        self.white = self.white.bordered(names, scale, *white)
        self.outdate()

    def join_combinations(self, names: Sequence[str], parts: Sequence[tuple[float, Sequence[str]]]) -> None:
        """Add columns that are sums of weights times others; see `FactoredGrams.with_combinations`."""
        self.raw = self.raw.with_combinations(names, parts)
        self.white = self.white.with_combinations(names, parts)
        self.outdate()


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """State of a search. Nothing changes it: every step returns another one. `Search.begin` makes the first.

    Attributes
    ----------
    shared : SharedGrams
        Gram blocks of all states of the search; `raw`, `white` and `forms` read them.
    library : Library
        What the columns are; terms that joined are among its terms.
    requested_intervals, intervals : sequence of sequence of int
        Blocks of each calibration interval: as they were requested, and those in use, whose edges keep away
        from changes that were taken.
    rules : Rules
    variance : float
        Of a row that the calibration alone leaves, nT^2.
    options : tuple of Option
        What may be added, changes in time aside.
    unscorable : tuple of dict
        What these data cannot show, and why.
    residual : int
        Which residual of the Gram blocks is searched.
    time_variable : TimeVariableColumns
    accepted : tuple of Option
        What was added to the model, in order.
    rounds : tuple of Round
        The ledger.
    banned, dropped : frozenset of str
        Mechanisms that were taken back, because what they added was others'; and that were dropped once.
    hidden : tuple of Change
        Changes that the requested intervals take up whole.
    freed : dict of str to str
        Numbers of the model, such as ``model:temperature.linear``, that data may move freely, and
        the option whose place that took: what the model states of them does not fit.
    held : frozenset of str
        Numbers of the model that data may not move at all.
    ran_out : bool
        The rounds ended because there were as many as the rules allow.
    design_cache : CachedDesign
        Columns on the coarse series, once terms joined.
    """

    shared: SharedGrams
    library: Library
    requested_intervals: Groups
    intervals: Groups
    rules: Rules
    variance: float
    options: tuple[Option, ...]
    unscorable: tuple[Mapping[str, object], ...] = ()
    residual: int = 0
    time_variable: TimeVariableColumns = field(default_factory=TimeVariableColumns)
    accepted: tuple[Option, ...] = ()
    rounds: tuple[Round, ...] = ()
    banned: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()
    hidden: tuple[Change, ...] = ()
    freed: Mapping[str, str] = field(default_factory=dict)
    held: frozenset[str] = frozenset()
    ran_out: bool = False
    design_cache: CachedDesign = field(default_factory=CachedDesign)

    @classmethod
    def begin(
        cls,
        raw: GramBlocks,
        white: GramBlocks,
        library: Library,
        intervals: Groups,
        days: Groups,
        rules: Rules | None = None,
        *,
        time_variable: TimeVariableColumns | None = None,
        residual: int = 0,
    ) -> Search:
        """Return the first state: nothing taken, without options that the calibration takes over.

        Parameters are those of `Search` and `SharedGrams`; `intervals` are the requested ones. Gram blocks
        that are not factored are made so.
        """
        groups = [list(map(int, group)) for group in intervals]
        base, sigma = base_columns(library)
        variance = row_variance(white, base, residual)
        factored = [
            one if isinstance(one, FactoredGrams) else FactoredGrams.of(one, base) for one in (raw, white)
        ]
        search = cls(
            shared=SharedGrams(
                raw=factored[0],
                white=factored[1],
                days=days,
                base=base,
                precision=prior_precision(raw, base, sigma, variance),
            ),
            library=library,
            requested_intervals=groups,
            intervals=groups,
            rules=rules or Rules(),
            variance=variance,
            options=tuple(
                Option(
                    name=one.name,
                    mechanism=one.mechanism,
                    family=one.family,
                    columns=tuple(library.columns_of(one)),
                    channels=one.channels,
                    terms=one.terms,
                    lag_s=one.lag_s,
                    agnostic=one.agnostic,
                    placebo=one.placebo,
                    number=one.number,
                )
                for one in library.candidates
            ),
            residual=residual,
            time_variable=time_variable or TimeVariableColumns(),
        )
        return search._without_invisible()._without_twins()

    def _without_invisible(self) -> Search:
        """Return the state without options that the calibration takes over; they are unscorable."""
        base, _ = self.base()
        visible = {
            option.name: is_visible(
                self.raw,
                self.forms["raw"],
                option.columns,
                self.raw.index(base if option.channels else []),
                np.array([size for key in option.terms for size in self.library.terms[key].usual]),
                self.variance,
            )
            for option in self.options
        }
        mechanisms = {option.mechanism for option in self.options if visible[option.name]}
        invisible = {
            one.mechanism: one for one in self.options if one.mechanism not in mechanisms and not one.placebo
        }
        return replace(
            self,
            options=tuple(option for option in self.options if visible[option.name]),
            unscorable=tuple(
                {
                    "name": name,
                    "family": one.family,
                    "channels": list(one.channels),
                    "reason": "the calibration takes it over: what is left of it could not be seen",
                }
                for name, one in invisible.items()
            ),
        )

    def _without_twins(self) -> Search:
        """Return the state without squares of channels that are the channel itself; they are unscorable.

        The square of a channel with two levels, or of one that hardly changes, is a multiple of it.
        """
        grams = self.forms["raw"]
        plain = {
            one.channels: one
            for one in self.options
            if one.mechanism.startswith("channel_field(") and not one.lag_s and not one.placebo
        }
        twins: dict[str, Option] = {}
        for option in self.options:
            other = plain.get(option.channels)
            if not option.mechanism.startswith("channel_power(") or other is None:
                continue
            if len(option.columns) == len(other.columns) and not option.placebo:
                places = np.concatenate([grams.index(option.columns), grams.index(other.columns)])
                total = grams.rows(places, places).sum(axis=0)
                k = len(option.columns)
                size = np.sqrt(np.clip(np.diag(total), 1e-300, None))
                alike = np.diag(total[:k, k:]) ** 2 / (size[:k] * size[k:]) ** 2
                if np.all(alike > VISIBILITY_SETTINGS.twin):
                    twins[option.mechanism] = option
        entries = tuple(
            {
                "name": name,
                "family": one.family,
                "channels": list(one.channels),
                "reason": "in these data the square of the channel is a multiple of the channel itself",
            }
            for name, one in twins.items()
        )
        options = tuple(option for option in self.options if option.mechanism not in twins)
        return replace(self, options=options, unscorable=(*self.unscorable, *entries))

    # The Gram blocks, the calibration's columns and the model's.

    @property
    def raw(self) -> FactoredGrams:
        """Columns as the library has them, the calibration's own among them."""
        return self.shared.raw

    @property
    def white(self) -> FactoredGrams:
        """The same, prewhitened."""
        return self.shared.white

    @property
    def forms(self) -> Mapping[str, GramBlocks]:
        """The calibration marginalised: ``raw``, ``within``, ``white``."""
        return self.shared.forms_for(self.intervals)

    def base(self) -> tuple[list[str], Floats]:
        """Return the calibration's own columns and what is known of them beforehand, standard deviations."""
        return base_columns(self.library)

    def precision(self, grams: BlockProducts, names: Sequence[str], sigma: Floats) -> Floats:
        """Return variance over squared prior sigma in scaled units; 0 without a prior."""
        return prior_precision(grams, names, sigma, self.variance)

    def y(self, form: str = "raw") -> int:
        """Index of the residual that is searched."""
        return self.forms[form].residuals[self.residual]

    def present(self, form: str = "raw", without: Option | None = None) -> ModelColumns:
        """Return the columns of the model without those of the calibration, with their priors."""
        return self.present_in(self.forms[form], without)

    @property
    def fitted_terms(self) -> list[Term]:
        """What is fitted with all that was taken: numbers of the model, and the edges of a shadow in use."""
        in_use = self.library.edged or any(SHADOW in one.channels for one in self.accepted)
        return [*self.library.refined, *(self.library.edges if in_use else [])]

    def model_columns(self, without: Option | None = None) -> list[str]:
        """Return the model's columns without those of the calibration: `fitted_terms`, then those taken."""
        names = [name for term in self.fitted_terms for name in term.columns]
        return names + [name for one in self.accepted if one is not without for name in one.columns]

    def present_in(self, grams: BlockProducts, without: Option | None = None) -> ModelColumns:
        """Return the columns of the model in Gram blocks that have them, with their priors."""
        names = self.model_columns(without)
        sigma = self.sigma_of_model(len(names))
        return ModelColumns(grams.index(names), self.precision(grams, names, sigma), self.variance)

    def sigma_of_model(self, count: int) -> Floats:
        """Return what is known beforehand of the model's columns, in their order; (count,)."""
        numbers = [
            (name.partition("[")[0], sigma)
            for term in self.fitted_terms
            for name, sigma in zip(term.columns, term.sigma, strict=True)
        ]
        known = [
            np.inf if name in self.freed else sigma * (HELD if name in self.held else 1.0)
            for name, sigma in numbers
        ]
        return np.array([*known, *[np.inf] * (count - len(known))])

    def _marginalised(self, grams: GramBlocks, intervals: Groups) -> GramBlocks:
        names, sigma = self.base()
        return grams.marginalise(names, intervals, self.precision(grams, names, sigma))

    # Scores.

    def table(self, without: Option | None = None) -> ScoreTable:
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
        signs, units = draw_signs(len(self.raw), self.rules.draws, self.rules.seed)
        scores: dict[str, Scores] = {}
        ratios: dict[str, tuple[Floats, Floats]] = {}
        for form, grams in self.forms.items():
            present, y = self.present(form, without), self.y(form)
            columns = [grams.index([*option.columns, *self._edges_of(option)]) for option in main]
            scores[form] = score(grams, present, columns, y, make_folds(len(grams)))
            ratios[form] = sign_flip_ratios(grams, present, columns, y, signs, units)
        options = list(main)
        whole = float(scores["raw"].loss0.sum())
        timed = []
        for more, own, present, requested in self._changes(without):
            y, columns = own.residuals[self.residual], [own.index(option.columns) for option in more]
            found = score(own, present, columns, y, make_folds(len(own), more[0].interleaved))
            ratio, flipped = sign_flip_ratios(own, present, columns, y, signs, units)
            if requested is not None:
                kept = self._not_hidden(more, requested, self.present_in(requested, without), found.gamma)
                found, ratio, flipped = found.rescaled(whole).keep_only(kept), ratio * kept, flipped * kept
            timed.append((found.without_fits(), (ratio, flipped)))
            options += more
        scores, ratios = append_changes(scores, ratios, timed)
        real = np.array([not option.placebo for option in options], dtype=bool)
        largest = [flipped[:, real].max(axis=1, initial=0.0) for _, flipped in ratios.values()]
        most = np.max(largest, axis=0)[:, None]
        of_more = np.array([option.of_more for option in options])
        p = {
            form: np.asarray(np.minimum(of_more * family_wise_p(observed, most), 1.0))
            for form, (observed, _) in ratios.items()
        }
        placebos = [place for place, option in enumerate(options) if option.placebo]
        over_placebo = {
            form: one.t_over_placebo(placebos, self.rules.significant(one, p[form]), self.rules.rival_t)
            for form, one in scores.items()
        }
        return ScoreTable(options, scores, p, over_placebo)

    def _edges_of(self, option: Option) -> list[str]:
        """Return the columns that an option is tried with: of the shadow it follows, where none is in use."""
        if SHADOW not in option.channels or len(self.fitted_terms) > len(self.library.refined):
            return []
        return [name for term in self.library.edges for name in term.columns]

    def _changes(
        self, without: Option | None
    ) -> Iterator[tuple[list[Option], TimedGrams, ModelColumns, TimedGrams | None]]:
        """Yield options bound to a time, some at a time with the Gram blocks of their columns.

        Where their intervals are not those in use, the blocks come again with the requested ones.
        """
        base, _ = self.base()
        own = self.model_columns(without)
        found = self._possible_changes()
        excluded = self._excluded(found, without)
        # Those whose time was refined have columns of their own.
        dated = {one.name: one for one in self.options if one.change is not None and one.name not in excluded}
        # Of gigabytes of Gram blocks the few columns that change in time are read once.
        columns = [name for one in dated.values() for name in one.columns]
        core = self.raw.select(list(dict.fromkeys([*base, *own, *self.time_variable.names, *columns])))
        calibrated: dict[tuple[int, ...], CalibratedBlocks] = {}
        always_asked = tuple(group[0] for group in self.requested_intervals)

        def blocks(intervals: Groups, functions: Mapping[str, tuple[str, Floats]]) -> TimedGrams:
            key = tuple(group[0] for group in intervals)
            if key not in calibrated:
                # Of a long record hundreds of steps have intervals of their own, one after the other: those
                # of the steps before would be gigabytes.
                for done in calibrated.keys() - {always_asked}:
                    del calibrated[done]
                precision = self.precision(core, *self.base())
                calibrated[key] = CalibratedBlocks(core, base, intervals, precision)
            return TimedGrams.of(calibrated[key], own, functions)

        fresh = [one for one in found if one.name not in excluded]
        always = np.ones(len(core))
        changes = [one.change for one in dated.values() if one.change is not None]
        for intervals, batch in [*self._in_batches(fresh, without), *self._in_batches(changes, without)]:
            functions = {
                name: source
                for one in batch
                for name, source in (
                    {name: (name, always) for name in dated[one.name].columns}
                    if one.name in dated
                    else one.functions
                ).items()
            }
            wide = blocks(intervals, functions)
            options = [
                dated.get(one.name)
                or Option(
                    name=one.name,
                    mechanism=one.mechanism,
                    family=one.family,
                    columns=tuple(one.functions),
                    change=one,
                )
                for one in batch
                if one.name in dated or wide.is_live(wide.index(list(one.functions))).any()
            ]
            if options:
                same = intervals == self.intervals
                requested = None if same else blocks(self.requested_intervals, functions)
                yield options, wide, self.present_in(wide, without), requested

    def _possible_changes(self) -> list[Change]:
        """Return drifts, steps and episodes; they are those of the intervals, whatever was taken."""
        known, key = self.shared.changes, (tuple(group[0] for group in self.intervals), self.residual)
        if key not in known:
            found = drifts(self.raw, self.time_variable) + steps(self.raw, self.time_variable)
            lone = self.time_variable.outside(self.base()[0])
            found += episodes(self.raw, self.forms["raw"], lone, self.y())
            # An episode that ends with the record is a step, which may be among them.
            known[key] = list({one.name: one for one in found}.values())
        return known[key]

    def _excluded(self, found: Sequence[Change], without: Option | None) -> set[str]:
        """Return the names of changes that are not scored: taken, like one taken, banned, hidden."""
        taken = [option.change for option in self.accepted if option.change and option is not without]
        known = [*found, *(option.change for option in self.options if option.change is not None)]
        names = {change.name for change in known if any(change.is_like(one) for one in taken)}
        # What is hidden may have been another parameter's change: the data cannot separate them.
        names |= {change.name for change in known if any(change.is_when(one) for one in self.hidden)}
        names |= {change.name for change in known if change.mechanism in self.banned}
        names |= {option.name for option in self.accepted}
        return names - ({without.name} if without is not None else set())

    def _in_batches(
        self, found: Sequence[Change], without: Option | None
    ) -> Iterator[tuple[Groups, list[Change]]]:
        """Yield changes some at a time with the intervals they are judged with."""
        known: dict[tuple[int, ...], Groups] = {}
        by_intervals: dict[tuple[int, ...], tuple[Groups, list[Change]]] = {}
        for change in found:
            if change.at not in known:
                known[change.at] = self._intervals_for(change, without)
            intervals = known[change.at]
            by_intervals.setdefault(tuple(group[0] for group in intervals), (intervals, []))[1].append(change)
        for intervals, some in by_intervals.values():
            for batch in batch_changes(some):
                yield intervals, batch

    def _intervals_for(self, change: Change, without: Option | None) -> Groups:
        """Return the intervals to judge a change with: those in use, when none of their edges is near."""
        # What comes and goes within some days, or grows all the time, no interval takes up; and what would
        # take the place of an effect is judged like that one.
        if without is not None or len(change.at) != 1:
            return self.intervals
        return self._intervals_around_changes(change.at)

    def _intervals_around_changes(self, more: Sequence[int] = ()) -> Groups:
        at = [one.change.at[0] for one in self.accepted if one.change is not None and len(one.change.at) == 1]
        return intervals_around(self.raw, self.requested_intervals, [*at, *more])

    def _not_hidden(
        self, options: Sequence[Option], grams: TimedGrams, present: ModelColumns, values: Sequence[Floats]
    ) -> npt.NDArray[np.bool_]:
        """Return which changes show with the requested intervals, too, or may do so at their time."""
        y, columns = grams.residuals[self.residual], [grams.index(option.columns) for option in options]
        out = []
        remaining = remaining_of(grams, present, columns, y)
        for option, gamma, (inner, right) in zip(options, values, remaining, strict=True):
            assert option.change is not None
            at, sharp = option.change.at[0], option.change.sharpness
            visible = is_visible_change(inner, right, gamma, self.variance)
            out.append(visible or is_at_edge(self.raw, self.requested_intervals, at, sharp))
        return np.array(out)

    def grams_with(self, option: Option) -> list[GramBlocks]:
        """Return each form's Gram blocks of the model and an option alone: what its worth is told from."""
        names = [*self.model_columns(option), *option.columns]
        return [
            grams.select(names)
            for form, grams in self.forms.items()
            if option.change is None or form != "within"
        ]

    def held_out_worth(
        self, option: Option, of_forms: Sequence[GramBlocks] | None = None
    ) -> tuple[float, float]:
        """Return held-out gain and t of an effect of the model against the model without it, best form.

        Parameters
        ----------
        of_forms : sequence of GramBlocks, optional
            As `grams_with` returns them.
        """
        found: list[tuple[float, float]] = []
        for small in of_forms or self.grams_with(option):
            folds = make_folds(len(small), option.interleaved)
            y = small.residuals[self.residual]
            one = score(small, self.present_in(small, option), [small.index(option.columns)], y, folds)
            found.append((float(one.gain[0]), float(one.t[0])))
        return max(found, key=self.rules.margin)

    def held_out_t_worse_than(self, other: Search) -> float:
        """Return by what t this state leaves more of held-out blocks than another one of the same blocks."""
        losses = []
        interleaved = any(option.interleaved for option in (*self.accepted, *other.accepted))
        for one in (self, other):
            grams, none = one.forms["raw"], list[Index]()
            folds = make_folds(len(grams), interleaved)
            losses.append(score(grams, one.present(), none, one.y(), folds).loss0)
        return float(hac_t((losses[0] - losses[1])[:, None])[0])

    def is_hidden(self, option: Option) -> bool:
        """Return True for a change in the model that the requested intervals take up whole."""
        requested = self.requested_intervals
        if option.change is None or len(option.change.at) != 1 or self.intervals == requested:
            return False
        if intervals_around(self.raw, requested, option.change.at) == requested:
            return False
        form, present = self.forms["raw"], self.present("raw", option)
        (gamma,), _ = fit(form, present, [form.index(option.columns)], self.y())
        base, _ = self.base()
        grams = self._marginalised(self.raw.select([*base, *self.model_columns()]), requested)
        y, columns = grams.residuals[self.residual], grams.index(option.columns)
        ((inner, right),) = remaining_of(grams, self.present_in(grams, option), [columns], y)
        return not is_visible_change(inner, right, gamma, self.variance)

    # The next state.

    def add(self, option: Option) -> Search:
        """Return the state with an option in the model; a change's columns join the Gram blocks."""
        if option.change is not None and option.change.functions:
            self.shared.expand(option.change.functions)
        return self.with_accepted((*self.accepted, option)).with_safe_intervals()

    def drop(self, option: Option) -> Search:
        """Return the state without an option in the model."""
        return self.with_accepted([one for one in self.accepted if one is not option]).with_safe_intervals()

    def exchange(self, option: Option, other: Option) -> Search:
        """Return the state with another option in the place of one of the model."""
        accepted = [other if one is option else one for one in self.accepted]
        return self.with_accepted(accepted).with_safe_intervals()

    def hide(self, option: Option) -> Search:
        """Return the state without a change that the requested intervals take up whole; it is unscorable."""
        assert option.change is not None
        reason = "it lies at the edge of a calibration interval, whose own parameters take it up"
        entry = {"name": option.name, "family": option.family, "channels": [], "reason": reason}
        return replace(
            self.drop(option), hidden=(*self.hidden, option.change), unscorable=(*self.unscorable, entry)
        )

    def with_accepted(self, options: Sequence[Option]) -> Search:
        """Return the state as if it had taken some options and no others, with the same intervals."""
        return replace(self, accepted=tuple(options))

    def with_choices_of(self, other: Search) -> Search:
        """Return the state with what another one had chosen; columns and options that joined since stay."""
        return replace(
            self,
            accepted=other.accepted,
            rounds=other.rounds,
            banned=other.banned,
            dropped=other.dropped,
            freed=other.freed,
            ran_out=other.ran_out,
        ).with_safe_intervals()

    def with_safe_intervals(self) -> Search:
        """Return the state with intervals whose edges keep away from the changes it has taken."""
        intervals = self._intervals_around_changes()
        if intervals == self.intervals:
            return self
        self.shared.outdate()
        return replace(self, intervals=intervals)

    def with_round(
        self,
        action: str,
        option: Option,
        *,
        name: str = "",
        gain: float = 0.0,
        t: float = 0.0,
        p: float = 0.0,
        form: str = "raw",
    ) -> Search:
        """Return the state with a round in its ledger; `name` is the option's own when absent."""
        entry = Round(
            number=len(self.rounds) + 1,
            action=action,
            name=name or option.name,
            family=option.family,
            gain=gain,
            t=t,
            p=p,
            form=form,
        )
        return replace(self, rounds=(*self.rounds, entry))

    def with_freed(self, number: str, option: Option) -> Search:
        """Return the state in which data may move a number of the model instead of taking an option."""
        return replace(self, freed={**self.freed, number: option.name})

    def with_banned(self, mechanism: str) -> Search:
        """Return the state that will not take a mechanism again."""
        return replace(self, banned=self.banned | {mechanism})

    def with_options(self, options: Sequence[Option]) -> Search:
        """Return the state with more options to choose from."""
        return replace(self, options=(*self.options, *options))

    def without_options(self, mechanism: str) -> Search:
        """Return the state with the options of a mechanism gone."""
        return replace(self, options=tuple(one for one in self.options if one.mechanism != mechanism))

    def with_grams(self, raw: FactoredGrams, library: Library) -> Search:
        """Return what was taken on Gram blocks of another cadence, of the raw form alone.

        Parameters
        ----------
        raw : FactoredGrams
            Of blocks with the same edges, with the columns that `sources` of the options taken are.
        library : Library
            What its columns are.
        """
        base, sigma = base_columns(library)
        for option in self.accepted:
            if option.change is not None and option.change.functions:
                raw = raw.expand(option.change.functions)
        # Nothing is whitened here: what was taken is structure, and would make what is known of the model's
        # numbers beforehand weigh more than it does.
        variance = row_variance(raw, [*base, *replace(self, library=library).model_columns()], self.residual)
        precision = prior_precision(raw, base, sigma, variance)
        shared = replace(
            self.shared,
            raw=raw,
            white=raw,
            precision=precision,
            intervals=self.intervals,
            forms={"raw": raw.marginalise(base, self.intervals, precision)},
            changes={},
        )
        return replace(self, shared=shared, library=library, variance=variance)

    def join(self, terms: Sequence[Term], raw: Border, white: Border) -> Search:
        """Return the state with the columns of new terms in its Gram blocks; see `SharedGrams.join`."""
        names = [name for term in terms for name in term.columns]
        scale = np.array([one for term in terms for one in term.scale])
        self.shared.join(names, scale, raw, white)
        return self._with_terms(terms)

    def join_combination(self, term: Term, parts: Sequence[tuple[float, Sequence[str]]]) -> Search:
        """Return the state with a new term whose columns are sums of weights times columns there are."""
        self.shared.join_combinations(term.columns, parts)
        return self._with_terms([term])

    def _with_terms(self, terms: Sequence[Term]) -> Search:
        library = replace(self.library, terms=self.library.terms | {term.key: term for term in terms})
        return replace(self, library=library)

    def of_model(self, more: Sequence[str] = ()) -> Search:
        """Return the state with its model's columns and some more; what joins it does not join this one."""
        sources = {
            source
            for one in self.accepted
            if one.change is not None
            for source, _ in one.change.functions.values()
        }
        names = {*self.base()[0], *self.model_columns(), *sources, *more}
        terms = {key: term for key, term in self.library.terms.items() if names & set(term.columns)}
        names |= {name for term in terms.values() for name in term.columns}
        shared = replace(
            self.shared,
            raw=self.raw.restricted(names),
            white=self.white.restricted(names),
            forms={},
            changes={},
        )
        library = replace(self.library, terms=terms)
        return replace(self, shared=shared, library=library, options=(), design_cache=CachedDesign())

    def as_found(self) -> Search:
        """Return the search with nothing taken and the requested intervals; of the raw form alone."""
        other = replace(self.with_accepted([]), freed={})
        if self.intervals == self.requested_intervals:
            return other
        base, _ = self.base()
        small = self.raw.select([*base, *other.model_columns()])
        raw = self._marginalised(small, self.requested_intervals)
        shared = replace(self.shared, intervals=self.requested_intervals, forms={"raw": raw})
        return replace(other, intervals=self.requested_intervals, shared=shared)


def base_columns(library: Library) -> tuple[list[str], Floats]:
    """Return the calibration's own columns and what is known of them beforehand, standard deviations."""
    names = [name for term in library.base for name in term.columns]
    return names, np.asarray([sigma for term in library.base for sigma in term.sigma])


def prior_precision(grams: BlockProducts, names: Sequence[str], sigma: Floats, variance: float) -> Floats:
    """Return `variance` (of a row, nT^2) over squared prior sigma in scaled units; 0 without a prior."""
    scale = grams.scale[grams.index(names)]
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(np.isfinite(sigma), variance * (scale / sigma) ** 2, 0.0))


def row_variance(grams: GramBlocks, fitted: Sequence[str], residual: int = 0) -> float:
    """Return the variance of a row that columns fitted to the whole span leave: the median of blocks, nT^2.

    Parameters
    ----------
    grams : GramBlocks
        Prewhitened, or with all that has structure among what is fitted.
    fitted : sequence of str
        The calibration's own, and what else.
    """
    names = list(fitted)
    free = grams.select(names).marginalise(names, [range(len(grams))], np.zeros(len(names)))
    y = free.residuals[residual]
    each = free.squares[:, y] / np.maximum(free.count, 1.0)
    return float(np.median(each[free.count > 0])) if np.any(free.count > 0) else 1.0


def is_visible(
    raw: GramBlocks,
    form: GramBlocks,
    columns: Sequence[str],
    base: Index,
    usual: Floats,
    variance: float,
    settings: VisibilitySettings = VISIBILITY_SETTINGS,
) -> bool:
    """Return True when an effect of its usual size would stand out of what the calibration leaves.

    Parameters
    ----------
    raw, form : GramBlocks
        Before and after the calibration was marginalised.
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
    remaining = form.squares[:, form.index(columns)].sum(axis=0)
    kept = np.where(whole > 0, remaining / np.where(whole > 0, whole, 1.0), 0.0)
    # What the calibration hardly touches is seen or not by the data; of what it nearly takes over, the
    # usual size says whether the rest can be.
    own = raw.squares[:, raw.index(columns)].sum(axis=0)
    clear = remaining > settings.own_part * own
    clear |= remaining * usual[: len(remaining)] ** 2 > settings.clear * variance
    return bool(np.any((kept >= settings.least_retained) & clear))


def is_visible_change(
    inner: Floats,
    right: Floats,
    gamma: Floats,
    variance: float,
    settings: VisibilitySettings = VISIBILITY_SETTINGS,
) -> bool:
    """Return True when a change of a known size takes off of the residual what it should.

    Parameters
    ----------
    inner, right : ndarray, shapes (column, column) and (column,)
        What the model leaves of the change's columns with the requested intervals: products with each other
        and with the residual.
    gamma : ndarray, shape (column,)
        The change's values (scaled), from intervals that do not hide it.
    variance : float
        Of a row, nT^2.
    """
    expected = float(gamma @ inner @ gamma)
    gained = -2.0 * float(gamma @ right) - expected
    return gained > max(settings.clear * variance, settings.expected_part * expected)


def intervals_around(
    grams: GramBlocks,
    intervals: Groups,
    at: Sequence[int],
    settings: VisibilitySettings = VISIBILITY_SETTINGS,
) -> list[list[int]]:
    """Return calibration intervals no edge of which is near some times.

    An edge that is near one goes half an interval away from it, to both sides: no interval becomes longer
    than the longest. Only where another such time is there the intervals stay together.

    Parameters
    ----------
    intervals : sequence of sequence of int
        Consecutive blocks of each interval.
    at : sequence of int
        TT2000.
    """
    firsts = [*(group[0] for group in intervals), len(grams)]
    length = float(np.median([grams.end[group[-1]] - grams.start[group[0]] for group in intervals]))

    def is_free(edge: int) -> bool:
        reach = settings.edge_distance * length
        return all(abs(int(grams.start[edge]) - when) >= reach for when in at)

    edges: set[int] = set()
    for before, edge, after in zip(firsts, firsts[1:-1], firsts[2:], strict=False):
        if is_free(edge):
            edges.add(edge)
        else:
            edges |= {before + (edge - before) // 2, edge + -(-(after - edge) // 2)}
    inner = {one for one in edges if 0 < one < len(grams)}
    kept = sorted(one for one in inner if is_free(one))
    return [part.tolist() for part in np.split(np.arange(len(grams)), kept)]


def is_at_edge(grams: GramBlocks, intervals: Groups, when: int, sharpness: int) -> bool:
    """Return True when a time known no better may lie on an edge between intervals."""
    return any(abs(int(grams.start[group[0]]) - when) <= sharpness for group in intervals[1:])
