"""The model revised: an effect added, dropped or taken back, everything fitted anew, a new version saved.

Takes a catalog, a mission and a span, as `inflight.tasks.analysis.compare` and `diagnose` do; `Workbench`
holds the Gram blocks of one pass in memory. Its *root* is the version of the model they were made at; what
later versions added or dropped is algebra on them. Only an effect whose columns are not among them costs a
pass, over the model's columns and its own. Each change makes a `Revision`: the residual before and after,
the effect's numbers, and which other parameters moved.

`diagnose_span` is a diagnosis as the command line and the flow run it; `last_diagnosis` reads its result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.catalog import Catalog, Workspace
from inflight.design import SENSOR_EQUATIONS, Library, Term, sensor_matrices
from inflight.diagnosis import (
    DRIFTS,
    VISIBILITY_SETTINGS,
    Addition,
    AdditionMaker,
    BeforeAfter,
    Column,
    Diagnosis,
    DiagnosisData,
    FitSetup,
    JointFit,
    Request,
    Rules,
    Search,
    Series,
    addition_of,
    addition_of_entry,
    best_lag,
    effects_at,
    find_request,
    held_already,
    held_numbers,
    holds_every_sample,
    line_of,
    neutral_changes,
    plain_json,
    remaining_floor,
    require_known,
    residual_with,
    row_variance,
    time_variable_columns,
    values_of,
    with_blocks,
)
from inflight.effects import Remanent, RemanentMoment
from inflight.errors import InflightError, ModelError, did_you_mean
from inflight.lsq import GramBlocks
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, make_effect, with_dipole
from inflight.progress import Progress, silent
from inflight.residual import above_floor
from inflight.samples import parse_channel
from inflight.tasks.analysis.diagnosis import (
    Examined,
    PassResult,
    begin_search,
    diagnosis_data,
    intervals_of,
    make_pass,
    native_estimator,
    search_on_one_thread,
)
from inflight.tasks.analysis.gram_pass import PassPlan
from inflight.tasks.analysis.kept_diagnosis import asked_of, last_diagnosis, save_diagnosis
from inflight.tasks.analysis.later_days import check_later_days, note_compared_days, standing_of
from inflight.tasks.analysis.plumbing import faults_in_errors, faults_of
from inflight.tasks.analysis.settings import DiagnoseSettings, require_sampled
from inflight.tasks.analysis.stored_effects import pinned_table, stored_entry
from inflight.tasks.models import (
    REFIT,
    SET,
    TAKE,
    VersionedModel,
    current_model,
    stored_table,
    version_before_change,
    version_with_gram_blocks,
)
from inflight.tasks.pipelines import spacecraft_units_of, trend_of_products
from inflight.time import SECOND, DayLike, Int64, parse_duration

#: What `Workbench.set_numbers` calls the place of an effect's source.
DIPOLE = ".dipole"
#: A parameter's uncertainty that changes by this factor shows cross-talk made or removed; assumed.
_CROSS_TALK = 1.5
#: Fits that a workbench holds; assumed.
_FITS = 4
#: Records in which values of an effect that is not there are further from nothing; stated.
_CHANCE = 0.05


@dataclass(frozen=True, kw_only=True)
class Revision:
    """What a change of the model did.

    Attributes
    ----------
    command, effect : str
        What was asked for.
    model : VersionedModel
        The new version.
    parent : int
        The version before.
    in_sample, held_out : tuple of float
        Residual before and after, nT rms at the cadence of the comparison.
    floor : float
        Noise floor of the residual, nT; NaN where there is none.
    days : int
        Days of the record all of it is told from.
    moved : list of dict
        Other parameters that moved, or whose uncertainty did.
    values : list of dict
        The effect's own numbers, when one was added.
    not_justified : str
        Why these data do not speak for what was added; empty when they do.
    about : int
        Version of the model about whose numbers the equations are made.
    told_before : float or None
        What the version before was told to leave of days not used in the fit when it was made, nT.
    """

    command: str
    effect: str
    model: VersionedModel
    parent: int
    in_sample: tuple[float, float]
    held_out: tuple[float, float]
    moved: list[dict[str, Any]]
    floor: float = float("nan")
    days: int = 0
    values: list[dict[str, Any]] = field(default_factory=list)
    about: int = 0
    not_justified: str = ""
    told_before: float | None = None
    run: str = ""
    context: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the command line's JSON."""
        return {
            "command": self.command,
            "run": self.run,
            "context": self.context,
            "effect": self.effect,
            "model": {"name": self.model.model.name, "version": self.model.version, "parent": self.parent},
            "error": plain_json(self.change),
            "not_justified": self.not_justified,
            "residual_rose": self.rose,
            "told_before_nT": self.told_before,
            "moved": self.moved,
            "coefficients": self.values,
            "empirical": self.model.model.empirical,
            "told_by_difference": self.model.model.told_by_difference,
        }

    @property
    def rose(self) -> bool:
        """True when more is left of days not used in the fit than before, by what counts as a gain."""
        before, after = self.held_out
        return after**2 > (1.0 + Rules().keep_gain) * before**2

    @property
    def change(self) -> dict[str, Any]:
        """What the change did to the residual, as the catalog keeps it with the version."""
        return {
            "in_sample_nT": list(self.in_sample),
            "held_out_nT": list(self.held_out),
            "noise_floor_nT": self.floor,
            "above_floor_nT": [above_floor(one, self.floor) for one in self.held_out],
            "days": self.days,
            "about": self.about,
        }


def moved_parameters(before: JointFit, after: JointFit, units: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the parameters of two fits that moved by more than a sigma, or whose sigma did.

    Parameters
    ----------
    units : mapping of str to str
        By the model's names.

    Returns
    -------
    list of dict
        ``parameter``, ``by``, ``sigma`` (after), ``sigma_before``, ``unit`` and ``why``: moved, cross-talk
        made or cross-talk removed. The calibration's parameters are means over its intervals.
    """
    found = []
    for was, now, was_sigma, sigma in (
        (before.value, after.value, before.sigma, after.sigma),
        (before.base_value, after.base_value, before.base_sigma, after.base_sigma),
    ):
        for name in (name for name in was if name in now):
            by = now[name] - was[name]
            why = _why_moved(by, was_sigma[name], sigma[name])
            if why:
                plain = name.removeprefix("model:")
                found.append(
                    {
                        "parameter": plain,
                        "by": by,
                        "sigma": sigma[name],
                        "sigma_before": was_sigma[name],
                        "unit": units.get(plain, ""),
                        "why": why,
                    }
                )
    return sorted(found, key=lambda one: -abs(one["by"]) / max(one["sigma_before"], 1e-300))


def _why_moved(by: float, was: float, now: float) -> str:
    if now > _CROSS_TALK * was:
        return "cross-talk made"
    if was > _CROSS_TALK * now:
        return "cross-talk removed"
    return "moved" if abs(by) > min(was, now) else ""


def why_not_justified(addition: Addition, before: JointFit, after: JointFit) -> str:
    """Return why data do not speak for an addition; empty when they do.

    They do not when its values are nothing within their errors (chi-squared, one record in twenty), and what
    is left of days not used in the fit is no smaller with it (`Rules.keep_gain`).
    """
    gain = 1.0 - after.held_out / before.held_out if before.held_out > 0 else 0.0
    known = [one.name for one in addition.columns if after.sigma.get(one.name, 0.0) > 0]
    square = sum((after.value[name] / after.sigma[name]) ** 2 for name in known)
    if gain >= Rules().keep_gain or square > scipy.special.chdtri(max(len(known), 1), _CHANCE):
        return ""
    return (
        f"its {len(known)} numbers are nothing within their errors, and it takes "
        f"{100.0 * max(gain, 0.0):.1f} % off of days not used in the fit"
    )


def fitted_values(model: Model, entries: Sequence[ModelEffect]) -> list[dict[str, Any]]:
    """Return the fitted numbers of some of a model's effects: name, value, sigma and unit."""
    return [
        {
            "name": name,
            "value": float(value),
            "sigma": float(sigma),
            # The growth of a trend is per day, as additions write it.
            "unit": timed.parameter.unit + ("/d" if name.endswith("*b") else ""),
        }
        for entry in entries
        for timed in model.effect(entry.name).parameters.values()
        for name, value, sigma in zip(timed.columns, timed.value.ravel(), timed.sigma.ravel(), strict=True)
        if 0 < sigma < np.inf
    ]


class _Fitted(NamedTuple):
    """A model as it was fitted: on which series, how, with which additions and changes, and what came out."""

    series: Series
    linearised: Model
    setup: FitSetup
    fixed: Mapping[str, float]
    additions: Sequence[Addition]
    fit: JointFit

    @property
    def factors(self) -> dict[str, Floats]:
        """What each column of the Gram blocks is multiplied by."""
        columns = [column for one in self.additions for column in one.columns]
        return self.setup.block_factors(columns, self.fixed, self.fit)

    def residual(self) -> Floats:
        """Return what it leaves of the series; (sample, row), nT."""
        series, factors = self.series, self.factors
        every = [*self.setup.base, *self.setup.refined, *self._needs]
        # Terms of one sensor share their key; columns are of one term.
        used = {tuple(term.columns): term for term in every if factors.keys() & set(term.columns)}
        matrices = sensor_matrices(self.linearised, int(series.tt2000[len(series.tt2000) // 2]))
        return residual_with(series, matrices, list(used.values()), factors)

    @property
    def _needs(self) -> list[Term]:
        return [term for one in self.additions for term in one.needs]

    @property
    def _channels(self) -> set[str]:
        """Recorded channels of what was added."""
        names = {name for term in self._needs for name in term.channels}
        return {part.channel for name in names for part in parse_channel(name).parts}

    @property
    def is_complete(self) -> bool:
        """True when the series has every channel of what was added."""
        return self._channels <= set(self.series.channels)

    @property
    def unknown(self) -> npt.NDArray[np.bool_]:
        """Samples of the series in which a channel of what was added is not known; (sample,)."""
        lost = [self.series.missing[name] for name in self._channels if name in self.series.missing]
        return np.any(lost, axis=0) if lost else np.zeros(len(self.series.tt2000), dtype=bool)


@dataclass
class Workbench:
    """The Gram blocks of a span in memory, and the model that is being revised with them.

    Parameters
    ----------
    cat : Catalog
    mission : Mission
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    settings : DiagnoseSettings
    fresh : bool
        Make the Gram blocks at the present version, even if an earlier one has some.
    client, progress
        As of `inflight.tasks.analysis.diagnosis.diagnose`.
    """

    cat: Catalog
    mission: Mission
    start: DayLike | None = None
    end: DayLike | None = None
    settings: DiagnoseSettings = field(default_factory=DiagnoseSettings)
    _: KW_ONLY
    fresh: bool = False
    client: Any = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self.current = current_model(self.cat, self.mission, self.settings.comparison)
        root = version_with_gram_blocks(self.cat, self.mission, self.current)
        if self.fresh and root and root[0].text != self.current.text:
            root = None
        #: The mission as it was when the Gram blocks were made; it is part of their key.
        used, self._measured = root or (self.current, self.mission)
        # Who searches asks for faults of plumbing first; who adds an effect has searched.
        self._faults = self._plumbing() if self.fresh else None
        with faults_in_errors(self._faults or ()):
            self.made = self._prepared(used, None)
        if used.text == self.current.text:
            self.made = replace(self.made, used=self.current)
        self._narrow: tuple[tuple[str, ...], PassResult] | None = None
        self._refitted = False
        #: What the last search keeps of its model for later days (`standing_of`).
        self.standing: dict[str, Any] | None = None
        #: The model before the last change or preview and after it, as they were fitted.
        self._change: tuple[_Fitted, _Fitted] | None = None
        self._seen: tuple[tuple[_Fitted, _Fitted], BeforeAfter] | None = None
        #: Fits made last: that of the present model, and what was previewed, are needed again.
        self._last: list[tuple[GramBlocks, tuple[Any, ...], JointFit]] = []
        self._restore()

    def _plumbing(self) -> list[dict[str, Any]]:
        """Return the faults of plumbing in the span."""
        return faults_of(self.cat, self.mission, self.start, self.end, self.settings.comparison)

    def _prepared(self, used: VersionedModel, needs: Sequence[Term] | None) -> PassResult:
        def narrow(plan: PassPlan) -> PassPlan:
            own = plan.library
            there = {name for term in (*own.base, *own.refined) for name in term.columns}
            more = {term.key: term for term in needs or () if not set(term.columns) <= there}
            return replace(plan, library=Library(own.base, own.refined, more))

        narrower = None if needs is None else narrow
        how: Any = {"client": self.client, "progress": self.progress, "used": used, "narrow": narrower}
        return make_pass(self.cat, self._measured, self.start, self.end, self.settings, **how)

    def _restore(self) -> None:
        """Find out what the present version added to the root, and dropped of it."""
        root = {entry.name for entry in self.root.model.effects}
        now = {entry.name for entry in self.current.model.effects}
        self.dropped = sorted(root - now)
        added = [entry for entry in self.current.model.effects if entry.name not in root]
        self.additions: list[Addition] = [addition_of_entry(self.maker, entry) for entry in added]
        # The sensor's own parameters that the present version lets free and the root did not.
        candidates = {one.name: one for one in self.made.plan.library.candidates}
        for was in self.root.model.effects:
            if isinstance(was.effect, SENSOR_EQUATIONS) and was.name in now:
                free = self.current.model.effect(was.name).parameters
                keys = [key for key, timed in was.parameters.items() if free[key].free and not timed.free]
                names = [f"{was.name}.{key}" for key in keys]
                self.additions += [
                    self.maker.of_candidate(candidates[name]) for name in names if name in candidates
                ]

    @property
    def root(self) -> VersionedModel:
        """The version the Gram blocks were made at."""
        return self.made.used

    @property
    def maker(self) -> AdditionMaker:
        """What makes additions, with names that are free now."""
        return self._maker_of(self.made)

    def _maker_of(self, made: PassResult) -> AdditionMaker:
        names = {one.name for model in (self.root.model, self.current.model) for one in model.effects}
        return AdditionMaker(
            mission=self.mission,
            model=made.plan.model,
            library=made.plan.library,
            time_variable=time_variable_columns(made.plan.library),
            raw=made.loaded.raw,
            names=frozenset(names),
        )

    def candidates(self) -> list[str]:
        """Return the names of everything that `add` knows without a pass, in the library's order."""
        columns = self.maker.time_variable
        kinds = [kind for kind in DRIFTS if getattr(columns, kind.removesuffix("_drift"))]
        return [
            one.name for one in self.made.plan.library.candidates if not (one.placebo or one.number)
        ] + kinds

    def before_after(self) -> BeforeAfter | None:
        """Return the residual of every sample of the pass before and after the last change or preview.

        Returns
        -------
        BeforeAfter or None
            At the cadence of the search, nT, everything fitted in both. None without a change, and after one
            that made a pass of its own: its samples are others.
        """
        if self._change is None or self._change[0].series is not self._change[1].series:
            return None
        if not all(one.is_complete for one in self._change):
            return None
        # Asked for by the noise floor, and by who draws it.
        if self._seen is None or self._seen[0] is not self._change:
            before, after = self._change
            series, unknown = before.series, before.unknown | after.unknown
            series = series.without(unknown) if unknown.any() else series
            self._seen = self._change, with_blocks(series, before.residual(), after.residual())
        return self._seen[1]

    def contributions(self) -> tuple[Int64, dict[str, Floats]]:
        """Return the times of the pass's samples, and what each effect of the model makes of the residual.

        Returns
        -------
        times : ndarray of int64, shape (sample,)
            TT2000.
        effects : dict of str to ndarray, shape (sample,)
            By name in the model, nT, of the first component: the columns of its numbers that a fit may move,
            times their values; an effect that is not linear in them is drawn as if it were. Without the
            sensors' own equations. NaN where nothing was measured.
        """
        setup, model, series = self._whole, self.current.model, self.made.loaded.series
        values = {name: value for entry in model.effects for name, value in values_of(entry).items()}
        terms = {tuple(term.columns): term for term in setup.refined} | {
            tuple(term.columns): term for one in self.additions for term in one.needs
        }
        columns = [
            (entry.name, Column(name, ((raw, 1.0),)))
            for term in setup.refined
            for entry in model.effects
            if entry.name == term.entry.name and not isinstance(entry.effect, SENSOR_EQUATIONS)
            for raw in term.columns
            for name in [raw.removeprefix("model:")]
        ]
        columns += [(one.entries[0].name, column) for one in self.additions for column in one.columns]
        factors: dict[str, dict[str, Floats]] = {}
        for effect, column in columns:
            for raw, weight in column.parts:
                if column.name not in values or raw not in setup.raw.names:
                    continue
                size = weight * values[column.name] / setup.raw.scale[setup.raw.index([raw])[0]]
                each = np.ones(len(setup.raw)) if column.factor is None else column.factor
                own = factors.setdefault(effect, {})
                own[raw] = own.get(raw, 0.0) - size * each
        matrices = sensor_matrices(self.made.plan.model, int(series.tt2000[len(series.tt2000) // 2]))
        zero, known = residual_with(series, matrices, [], {})[:, 0], series["weight"] > 0
        made = {}
        for effect, own in factors.items():
            used = [term for term in terms.values() if own.keys() & set(term.columns)]
            with_it = residual_with(series, matrices, used, own)[:, 0]
            made[effect] = np.where(known, with_it - zero, np.nan)
        return series.tt2000, made

    # Changes of the model.

    def add(self, effect: str | Mapping[str, Any], *, empirical: bool = False) -> Revision:
        """Put an effect into the model and fit everything anew.

        Parameters
        ----------
        effect : str or mapping
            A candidate's name, mechanism, effect or channel; ``offset_step@2024-03-01``; an entry of
            the model YAML, as text or mapping; ``z_offset`` or ``remanent_moment``, whose values are those
            of a stored table. An effect of the bank gets the lag that fits best.
        empirical : bool
            Mark it as there for what it looks like: its cause is not known.

        Raises
        ------
        ModelError
            When nothing is called so, or it cannot be fitted.
        """
        self._rebase_refitted()
        comparison = self.settings.comparison
        if (stored := stored_entry(self.cat, self.mission, comparison, effect)) is not None:
            return self._take(stored)
        addition = self._addition(effect)
        addition = addition.as_empirical() if empirical else addition
        more = [*self.additions, addition]
        return self._revise("add", f"add {addition.name}", more, self.dropped, addition)

    def preview(self, effect: str | Mapping[str, Any]) -> Revision:
        """Fit the model with one effect more, as `add` does, and save nothing.

        Returns
        -------
        Revision
            With the version in use as `model` and `parent`: there is no other.

        Raises
        ------
        ModelError
            As `add`, and for values of a stored table, which take a pass.
        """
        self._rebase_refitted()
        if stored_entry(self.cat, self.mission, self.settings.comparison, effect) is not None:
            raise ModelError(
                f"{effect!r} takes its values from a stored table, which cannot be previewed",
                remedy="add it, and undo it if it does not help",
            )
        addition = self._addition(effect)
        more = [*self.additions, addition]
        before, after, setup = self._fits(more, self.dropped)
        model = self._model(setup, more, self.dropped, after)
        return replace(
            self._revision("try", f"try {addition.name}", self.current.version, before, after, more),
            values=fitted_values(model, addition.entries),
            not_justified=why_not_justified(addition, before, after),
        )

    def _addition(self, effect: str | Mapping[str, Any]) -> Addition:
        """Return what is asked for, at the lag that fits best; ModelError when it cannot be fitted."""
        request = find_request(self.maker, effect)
        self._require_new(request)
        addition = request.addition
        if request.bank:
            setup, fixed = self._fit_setup([*self.additions, addition], self.dropped)
            lag = best_lag(setup, fixed, [c for one in self.additions for c in one.columns], request.bank)
            addition = request.at_lag(lag)
        self._require_separable(addition)
        return addition

    def _take(self, given: Mapping[str, Any]) -> Revision:
        """Put an effect into the model whose values over time are a stored table; all else is fitted anew."""
        model = self.current.model
        sensors = sensors_of(self.mission, model.comparison)
        entry = make_effect(given, sensors, model.own, self.mission)
        entry = entry.with_tables(partial(stored_table, self.cat))
        instead = [one.name for one in model.effects if replaces_constant(entry, one)]
        for name in instead:
            model = model.drop(name)
        tables = ", ".join(timed.table_name for timed in entry.tables.values())
        message = f"{TAKE} {entry.name} from {tables}"
        message += f", instead of {', '.join(instead)}" if instead else ""
        found = self._replaced(model.add(entry), "add", message)
        return replace(found, values=fitted_values(self.current.model, [entry]))

    def _require_new(self, request: Request) -> None:
        """Raise ModelError for an effect whose numbers the model holds already, and fits."""
        own = held_already(self.current.model, request)
        if own is None:
            return
        numbers = [f"{own.name}.{key}" for key, timed in own.parameters.items() if timed.free]
        # The lag of a bank's first is none that was asked for.
        name = request.addition.name.partition("@lag=")[0] if request.bank else request.addition.name
        raise ModelError(
            f"the model has {name} already, as '{own.name}': twice, its numbers would be "
            "shared out between the two at random",
            remedy=f"'inflight refit {' '.join(numbers)}' fits its numbers anew; another response of its "
            "channel is added by its lag or width, such as channel_field(NAME)@lag=240s",
        )

    def _require_separable(self, addition: Addition) -> None:
        """Raise ModelError for an effect of which calibration and model leave next to nothing."""
        setup, fixed = self._fit_setup([*self.additions, addition], self.dropped)
        columns = [column for one in self.additions for column in one.columns]
        retained = setup.retained(columns, addition.columns, fixed)
        if retained >= VISIBILITY_SETTINGS.least_retained:
            return
        # Of the calibration alone, or of what was added since?
        alone = setup.retained([], addition.columns, fixed)
        twin = next(
            (
                one.name
                for one in self.additions
                if setup.retained(one.columns, addition.columns, fixed) < VISIBILITY_SETTINGS.least_retained
            ),
            "",
        )
        what = "the calibration's own parameters" if alone < VISIBILITY_SETTINGS.least_retained else twin
        raise ModelError(
            f"these data cannot tell {addition.name} from {what or 'what the model has'}: that leaves "
            f"{retained:.1g} of it, too little for numbers of its own",
            remedy="drop what stands in its place first, or take a span in which the two differ",
        )

    def drop(self, name: str) -> Revision:
        """Take an effect out of the model and fit everything anew.

        Raises
        ------
        ModelError
            When the model has none of that name, or cannot be without it.
        """
        self._rebase_refitted()
        added = [one for one in self.additions if name in (one.name, *(entry.name for entry in one.entries))]
        if added:
            rest = [one for one in self.additions if one is not added[0]]
            return self._revise("drop", f"drop {added[0].name}", rest, self.dropped)
        known = [entry.name for entry in self.current.model.effects]
        if name not in known:
            raise _no_effect(self.current.model, name, known)
        if isinstance(self.current.model.effect(name).effect, SENSOR_EQUATIONS):
            raise ModelError(
                f"'{name}' holds the parameters every calibration fits",
                remedy="drop another, or hold its parameters by 'free: false' in the pre-flight model",
            )
        return self._revise("drop", f"drop {name}", self.additions, [*self.dropped, name])

    def refit(self, *numbers: str) -> Revision:
        """Fit the model's own numbers anew: those named as data have them, others within what they state.

        Parameters
        ----------
        numbers : str
            Of the model, such as ``temperature.linear``: all components of the parameter.

        Raises
        ------
        ModelError
            When the model has no such number that may be fitted.
        """
        self._rebase_refitted()
        setup, fixed = self._fit_setup(self.additions, self.dropped)
        names = [name for term in setup.refined for name in term.columns]
        known = sorted({name.partition("[")[0].removeprefix("model:") for name in names})
        if unknown := next((one for one in numbers if one not in known), None):
            raise ModelError(
                f"model '{self.current.model.name}' has no number {unknown!r} that may be fitted"
                f"{did_you_mean(unknown, known)}",
                remedy=f"it has {', '.join(known)}" if known else "give its parameters a 'sigma'",
            )
        columns = [column for one in self.additions for column in one.columns]
        apart = any(one.interleaved for one in self.additions)
        before = setup.fit(columns, dict.fromkeys(names, 0.0) | fixed, interleaved=apart)
        free = replace(setup, refined=tuple(_without_sigma(term, numbers) for term in setup.refined))
        after = free.fit(columns, fixed, interleaved=apart)
        message = f"{REFIT} {', '.join(numbers) or 'all numbers'}"
        self._change = None
        model, parent = self._model(free, self.additions, self.dropped, after), self.current.version
        self.current = self._saved(model, message, model.text, before, after)
        self._last, self._refitted = [], True
        return self._revision("refit", message, parent, before, after)

    def set_numbers(self, *settings: str) -> Revision:
        """Give numbers of the model other values and fit everything else anew, within what the model states.

        Parameters
        ----------
        settings : str
            Such as ``stray.lag=410s``, ``stray.width=2.5`` or ``temperature.linear[x]=1.2e-5``, in the
            model's units. ``stray.dipole=0.3 0 0.1 +- 0.2`` says where the source stands, m, so that the
            other sensor sees it, too; ``stray.dipole=none`` takes that back. Its numbers are then fitted
            as if nothing were known of them. ``z_offset.vector=main-z-offset`` takes the newest table of
            that name.

        Raises
        ------
        ModelError
            When the model has no such number, or it cannot have that value.
        """
        self._rebase_refitted()
        return self._set(dict(map(_setting, settings)))

    def _set(self, settings: Mapping[str, str], verb: str = "set") -> Revision:
        plan, model = self.made.plan, self.current.model
        spacing = plan.cadence_ns / SECOND
        held = held_numbers(self.mission, model, plan.channel_summaries, spacing, plan.library.unlagged)
        numbers = {one.name: one for one in held}
        freed: list[str] = []
        for name, text in settings.items():
            if name.endswith(DIPOLE):
                entry = model.effect(name.removesuffix(DIPOLE))
                sensors = sensors_of(self.mission, model.comparison)
                model = model.replace(with_dipole(entry, _source(name, text), sensors))
                freed += [f"{entry.name}.{key}" for key in entry.parameters]
                continue
            owner, _, key = name.rpartition(".")
            taken = {f"{one.name}.{key}" for one in model.effects for key in one.tables}
            if name in taken:
                model = model.replace(self._with_newer(model.effect(owner), key, text))
                continue
            known = [*numbers, *model.columns, *taken]
            if name not in known:
                raise _no_number(model, name, known, "'inflight model show' lists its values")
            if name in numbers and numbers[name].path:
                raise ModelError(
                    f"{name!r} is no number of the model",
                    remedy=f"write it into mission.yaml: {line_of(numbers[name], _number(name, text))}",
                )
            if name in model.columns and name not in numbers:
                model = model.with_values({name: _number(name, text)})
                continue
            for entry in effects_at(numbers[name], _number(name, text), model, self.mission):
                model = model.replace(entry)
        message = f"{SET} {', '.join('='.join(one) for one in settings.items())}"
        return self._replaced(model, verb, message, freed)

    def _with_newer(self, entry: ModelEffect, key: str, named: str) -> ModelEffect:
        """Return an effect whose parameter takes another table, the newest of the name."""
        table = pinned_table(self.cat, self.mission, self.settings.comparison, named)
        parameters = {**entry.parameters, key: replace(entry.parameters[key], table_name=table, table=None)}
        return entry.with_parameters(parameters).with_tables(partial(stored_table, self.cat))

    def _replaced(self, model: Model, verb: str, message: str, freed: Sequence[str] = ()) -> Revision:
        """Fit a model that Gram blocks do not hold, and save it.

        Parameters
        ----------
        freed : sequence of str
            Parameters that are fitted as if nothing were known of them.
        """
        setup, fixed = self._fit_setup(self.additions, self.dropped)
        before = self._fit(setup.where_told(model), fixed, self.additions)
        used = VersionedModel(model, self.root.version, model.text)
        setup = _fit_setup_of(self._prepared(used, []), self.settings)
        setup = replace(setup, refined=tuple(_without_sigma(term, freed) for term in setup.refined))
        after = setup.fit([], {})
        self._change = None
        value, sigma = _fitted_of(setup.refined, after)
        model, parent = model.with_values(value, sigma), self.current.version
        self.current = self._saved(model, message, model.text, before, after)
        self._last, self._refitted = [], True
        return self._revision(verb, message, parent, before, after)

    def _rebase_refitted(self) -> None:
        """Make the Gram blocks at the present version, where those there are hold its numbers otherwise."""
        if self._refitted:
            self._rebase()

    def _rebase(self) -> None:
        self._measured, self._refitted = self.mission, False
        self.made = self._prepared(self.current, None)
        self._narrow = None
        self.__dict__.pop("_whole", None)
        self._restore()

    def undo(self) -> Revision:
        """Go back to the version before the last change: a new version with its text.

        Raises
        ------
        ModelError
            When there is nothing to go back to.
        """
        self._rebase_refitted()
        found = version_before_change(self.cat, self.mission, self.current)
        setup, fixed = self._fit_setup(self.additions, self.dropped)
        before, first = self._fit(setup, fixed, self.additions), self.current
        was = self._fitted(setup, fixed, self.additions, before)
        message = f"undo version {first.version}: back to version {found.version}"
        # Fitted as the version it is, before it is saved with what that leaves; on other Gram blocks where
        # those there are hold its numbers elsewhere.
        self.current = found
        blocks = version_with_gram_blocks(self.cat, self.mission, found) or (found, self.mission)
        if blocks[0].text != self.root.text:
            self._measured, self._narrow = blocks[1], None
            self.made = self._prepared(blocks[0], None)
            self.__dict__.pop("_whole", None)
        self._restore()
        setup, fixed = self._fit_setup(self.additions, self.dropped)
        after = self._fit(setup, fixed, self.additions)
        self._change = was, self._fitted(setup, fixed, self.additions, after)
        self.current = first
        self.current = self._saved(found.model, message, found.text, before, after)
        return self._revision("undo", message, first.version, before, after)

    def _revise(
        self,
        command: str,
        message: str,
        additions: list[Addition],
        dropped: list[str],
        addition: Addition | None = None,
    ) -> Revision:
        before, after, setup = self._fits(additions, dropped)
        model, parent = self._model(setup, additions, dropped, after), self.current.version
        self.current = self._saved(model, message, model.text, before, after)
        self.additions, self.dropped = additions, dropped
        found = self._revision(command, message, parent, before, after)
        if addition is None:
            return found
        values = fitted_values(model, addition.entries)
        return replace(found, values=values, not_justified=why_not_justified(addition, before, after))

    def _fits(
        self, additions: Sequence[Addition], dropped: Sequence[str]
    ) -> tuple[JointFit, JointFit, FitSetup]:
        """Return the fit of the present model and of a changed one, and what that was made with."""
        setup, fixed = self._fit_setup(additions, dropped)
        interleaved = any(one.interleaved for one in (*additions, *self.additions))
        same = self._held(dropped)[1] == self._held(self.dropped)[1]
        old = self._fit_setup(self.additions, self.dropped, setup if same else None)
        before = self._fit(*old, self.additions, interleaved)
        after = self._fit(setup, fixed, additions, interleaved)
        self._change = (
            self._fitted(*old, self.additions, before),
            self._fitted(setup, fixed, additions, after),
        )
        return before, after, setup

    def _fitted(
        self, setup: FitSetup, fixed: Mapping[str, float], additions: Sequence[Addition], fit: JointFit
    ) -> _Fitted:
        """Return a fit with the series it is of: a pass over few columns has few channels in its own."""
        made = self.made
        if self._narrow is not None and self._narrow[1].loaded.raw is setup.raw:
            narrow = self._narrow[1]
            made = made if narrow.plan.model.text == made.plan.model.text else narrow
        return _Fitted(made.loaded.series, made.plan.model, setup, fixed, additions, fit)

    def _saved(
        self, model: Model, message: str, text: str, before: JointFit, after: JointFit
    ) -> VersionedModel:
        """Save a version, with what it did to the residual."""
        change = plain_json(self._sizes(before, after).change)
        version = self.cat.save_model(
            model.name, text, self.current.version, message, new_version=True, change=change
        )
        return VersionedModel(model, version, text)

    # The fit.

    def _fit(
        self,
        setup: FitSetup,
        fixed: Mapping[str, float],
        additions: Sequence[Addition],
        interleaved: bool | None = None,
    ) -> JointFit:
        columns = [column for one in additions for column in one.columns]
        apart = any(one.interleaved for one in additions) if interleaved is None else interleaved
        blocks = () if setup.blocks is None else tuple(setup.blocks.tolist())
        key = (tuple(one.name for one in additions), tuple(sorted(fixed)), apart, blocks)
        made = next((fit for raw, known, fit in self._last if raw is setup.raw and known == key), None)
        if made is None:
            made = setup.fit(columns, fixed, interleaved=apart)
        self._last = [(setup.raw, key, made), *(one for one in self._last if one[2] is not made)][:_FITS]
        return made

    def _fit_setup(
        self, additions: Sequence[Addition], dropped: Sequence[str], same: FitSetup | None = None
    ) -> tuple[FitSetup, dict[str, float]]:
        """Return what a fit needs, and the changes of parameters that take out what was dropped.

        Parameters
        ----------
        same : FitSetup, optional
            Taken when it has all columns: what is compared should come from the same Gram blocks.
        """
        held, hard = self._held(dropped)
        names = {part for one in additions for column in one.columns for part, _ in column.parts}
        if same is not None and names <= set(same.raw.names):
            return same, held
        if names <= set(self.made.loaded.raw.names) and not hard:
            return self._whole, held
        needs = [term for one in additions for term in one.needs]
        key = (*sorted(names), "", *hard)
        if self._narrow is None or self._narrow[0] != key:
            model = self.root.model
            for name in hard:
                model = model.drop(name)
            used = VersionedModel(model, self.root.version, model.text)
            self._narrow = key, self._prepared(used, needs)
        return _fit_setup_of(self._narrow[1], self.settings), held

    @cached_property
    def _whole(self) -> FitSetup:
        return _fit_setup_of(self.made, self.settings)

    def _held(self, dropped: Sequence[str]) -> tuple[dict[str, float], tuple[str, ...]]:
        """Return changes that take dropped effects out, and those that ask for a pass without them."""
        held: dict[str, float] = {}
        hard = []
        terms = {term.entry.name: term for term in self.made.plan.library.refined}
        for name in dropped:
            found = neutral_changes(self.root.model.effect(name), terms[name]) if name in terms else None
            if found is None:
                hard.append(name)
            else:
                held |= found
        return held, tuple(hard)

    def _model(
        self, setup: FitSetup, additions: Sequence[Addition], dropped: Sequence[str], fitted: JointFit
    ) -> Model:
        """Return the root's model with everything at its fitted values."""
        model = self.root.model.with_values(*_fitted_of(setup.refined, fitted))
        for name in dropped:
            model = model.drop(name)
        for one in additions:
            model = one.put_into(model, fitted.value, fitted.sigma)
        return model

    # What a change did.

    def _revision(
        self,
        command: str,
        effect: str,
        parent: int,
        before: JointFit,
        after: JointFit,
        additions: Sequence[Addition] | None = None,
    ) -> Revision:
        additions = self.additions if additions is None else additions
        entries = [*self.made.plan.model.effects, *(one.entry for one in self.made.plan.library.base)]
        entries += [entry for one in additions for entry in one.entries]
        units = {column.name: one.unit for one in additions for column in one.columns} | {
            name: timed.parameter.unit
            for entry in entries
            for timed in entry.parameters.values()
            for name in timed.columns
        }
        return replace(
            self._sizes(before, after),
            command=command,
            effect=effect,
            model=self.current,
            parent=parent,
            told_before=self._told(parent),
            moved=moved_parameters(before, after, units),
        )

    def _told(self, version: int) -> float | None:
        """Return what a version was told to leave of days not used in the fit, nT; None of a first one."""
        name = self.current.model.name
        made = next(one for one in self.cat.models() if (one.name, one.version) == (name, version))
        return float(made.change["held_out_nT"][1]) if made.change else None

    def _sizes(self, before: JointFit, after: JointFit) -> Revision:
        """Return a revision that tells the residual before and after, and nothing else yet."""
        loaded = self.made.loaded
        inside = loaded.sums["inside"] / max(loaded.sums["count"], 1.0)
        sizes = [
            float(np.sqrt(one + inside))
            for one in (before.in_sample, after.in_sample, before.held_out, after.held_out)
        ]
        return Revision(
            command="",
            effect="",
            model=self.current,
            parent=self.current.version,
            in_sample=(sizes[0], sizes[1]),
            held_out=(sizes[2], sizes[3]),
            moved=[],
            floor=self._floor(),
            days=sum(map(len, self.made.plan.blocks)) - len(self.made.failed),
            about=self.root.version,
            run=self.made.run,
            context=self.made.context,
        )

    def _floor(self) -> float:
        """Return the noise floor of what the last change leaves, nT: a fast cause looks like noise."""
        loaded = self.made.loaded
        samples = loaded.sums["count"]
        if self._change is None or not holds_every_sample(loaded.series, samples):
            return loaded.floor.level_nT
        seen = self.before_after()
        if seen is None:
            return loaded.floor.level_nT
        return remaining_floor(seen.series, seen.after, samples, loaded.floor).level_nT

    # The search.

    def diagnose(self) -> Diagnosis:
        """Search what is missing from the present version; its Gram blocks are made when there are none."""
        return self.examine().found

    def examine(self) -> Examined:
        """Search as `diagnose`, and return with the result what it was made from."""
        found, search, data = self._searched()
        model = self._model_found(search)
        if model is not None:
            plan, variance = self.made.plan, search.variance
            self.standing = standing_of(self.cat, self.mission, plan, model, variance, self.settings)
        units = self.units
        facts = {
            "evidence key": self.made.plan.key,
            "days that failed": len(self.made.failed) or None,
            "units that switch": "; ".join(one["sentence"] for one in units) if units else None,
        }
        return Examined(search, data, found, self.settings, facts)

    @cached_property
    def units(self) -> list[dict[str, Any]] | None:
        """The units of the spacecraft that switch, when first asked for; None where no states are learnt."""
        return spacecraft_units_of(self.cat, self.mission, self.settings.comparison, self.start, self.end)

    def _model_found(self, search: Search) -> Model | None:
        """Return the model with all that a search took, fitted; None where no entries of a model are that."""
        if any(option.number for option in search.accepted):
            return None
        loaded = self.made.loaded.with_raw(search.raw)
        made = replace(self.made, plan=replace(self.made.plan, library=search.library), loaded=loaded)
        maker, additions = self._maker_of(made), list[Addition]()
        for option in search.accepted:
            try:
                additions.append(addition_of(maker, option))
            except ModelError:
                return None
            more = {entry.name for entry in additions[-1].entries}
            maker = replace(maker, names=maker.names | more)
        setup = _fit_setup_of(made, self.settings)
        columns = [column for one in additions for column in one.columns]
        fitted = setup.fit(columns, {}, interleaved=any(one.interleaved for one in additions))
        return self._model(setup, additions, [], fitted)

    def _searched(self) -> tuple[Diagnosis, Search, DiagnosisData]:
        if self.root.version != self.current.version or self.additions or self.dropped:
            self._rebase()
        self.__dict__.pop("_whole", None)
        self._restore()
        data = diagnosis_data(self.made, self.mission)
        data = replace(data, model=replace(data.model, version=self.root.version))
        listener = self.progress or silent
        native = native_estimator(self.cat, self._measured, self.made, self.settings, self.client, listener)
        begun = begin_search(self.made, self.settings)
        found, search = search_on_one_thread(begun, data, native, listener)
        faults = self._plumbing() if self._faults is None else self._faults
        trend = trend_of_products(self.cat, self.settings.comparison, self.root.version, self.start, self.end)
        return found.after_plumbing(faults).with_products(trend), search, data

    def auto(self) -> tuple[Diagnosis, list[Revision]]:
        """Search, and save one version for every effect the search took, in order.

        None is saved while the data are known to be wrong: what was found would stand for their faults.
        """
        found, search, _ = self._searched()
        if any(fault["sure"] for fault in found.plumbing):
            return found, []
        # Lags, widths and products that the search made have their columns in its Gram blocks.
        loaded = self.made.loaded.with_raw(search.raw)
        self.made = replace(self.made, plan=replace(self.made.plan, library=search.library), loaded=loaded)
        self.__dict__.pop("_whole", None)
        steps = []
        # Numbers that the model holds are fitted with the others, and set at the end: that takes a pass.
        numbers = [option for option in search.accepted if option.number]
        self.additions += [addition_of(self.maker, option) for option in numbers]
        for option in search.accepted:
            if option.number:
                continue
            addition = addition_of(self.maker, option)
            message = f"auto: add {addition.name}"
            steps.append(self._revise("auto", message, [*self.additions, addition], self.dropped, addition))
        if numbers:
            steps += self._set_found([search.library.by_key[option.terms[0]] for option in numbers])
        return found, steps

    def _set_found(self, terms: Sequence[Term]) -> list[Revision]:
        """Set the numbers of the model that a search found; those of the mission file are a person's."""
        fitted = self._fit(*self._fit_setup(self.additions, self.dropped), self.additions)
        self.additions = [one for one in self.additions if one.entries]
        settings = {}
        for term in terms:
            assert term.difference is not None
            number = term.difference.number
            if not number.path:
                value = number.value + fitted.value[term.columns[0]]
                settings[number.name] = f"{value:.6g}{'s' if number.unit == 's' else ''}"
        return [self._set(settings, "auto")] if settings else []


def replaces_constant(entry: ModelEffect, other: ModelEffect) -> bool:
    """Return True when the body's field from the torquers' mean stands for another effect's constant one."""
    moment = isinstance(entry.effect, RemanentMoment)
    return moment and isinstance(other.effect, Remanent) and not other.tables


def _fitted_of(refined: Sequence[Term], fitted: JointFit) -> tuple[dict[str, float], dict[str, float]]:
    """Return values and sigmas of the model's own numbers after a fit."""
    value, sigma = {}, {}
    for term in refined:
        starts = values_of(term.entry)
        for name in (name for name in starts if f"model:{name}" in fitted.value):
            value[name] = starts[name] + fitted.value[f"model:{name}"]
            sigma[name] = fitted.sigma[f"model:{name}"]
    return value, sigma


def _setting(text: str) -> tuple[str, str]:
    """Return name and value of a setting such as ``stray.lag=410s``."""
    name, equals, value = text.partition("=")
    if not (equals and name.strip() and value.strip()):
        raise ModelError(f"{text!r} sets no number", remedy="write such as stray.lag=410s")
    return name.strip(), value.strip()


def _source(name: str, text: str) -> dict[str, Any] | None:
    """Return where a dipole stands, as a model's file says it; None for none."""
    if text == "none":
        return None
    try:
        place, _, sigma = text.replace("±", "+-").partition("+-")
        return {"position": [float(one) for one in place.replace(",", " ").split()], "sigma": float(sigma)}
    except ValueError:
        raise ModelError(
            f"{name}: {text!r} is no place", remedy="write such as '0.3 0 0.1 +- 0.2', m, or none"
        ) from None


def _number(name: str, text: str) -> float:
    """Return a value as a number, of a duration in seconds."""
    try:
        return float(text)
    except ValueError:
        try:
            return parse_duration(text) / SECOND
        except ValueError:
            raise ModelError(
                f"{name}: {text!r} is no number", remedy="write such as 0.25, or 410s of a duration"
            ) from None


def _without_sigma(term: Term, numbers: Sequence[str]) -> Term:
    """Return a term without what the model states of some of its numbers."""
    free = [name.partition("[")[0].removeprefix("model:") in numbers for name in term.columns]
    sigma = tuple(np.inf if is_free else one for is_free, one in zip(free, term.sigma, strict=True))
    return replace(term, sigma=sigma)


def _fit_setup_of(made: PassResult, settings: DiagnoseSettings) -> FitSetup:
    library = made.plan.library
    base = [name for term in library.base for name in term.columns]
    setup = FitSetup(
        made.loaded.raw,
        tuple(library.base),
        tuple(library.refined),
        intervals_of(made, settings),
        row_variance(made.loaded.white_of_base, base),
    )
    return setup.where_told(made.used.model)


def diagnose_span(
    workspace: Workspace,
    start: str | None = None,
    end: str | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    save: bool = False,
    search: bool = False,
    keep: bool = True,
    client: Any = None,
    progress: Progress | None = None,
    finished: Callable[[Examined, Mapping[str, Any]], object] | None = None,
) -> dict[str, Any]:
    """Diagnose a span, and keep the result in the workspace's reports.

    Where only few days came after the last search of the same, and its verdict stands for them, they are held
    against it and nothing is searched (`inflight.tasks.analysis.later_days.check_later_days`).

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    save : bool
        Save one version of the model for every effect that was found, in the order they were taken.
    search : bool
        Search though the last verdict may stand for the days since.
    keep : bool
        Make the result of a search the last diagnosis of the workspace.
    finished : callable, optional
        Called in the end with the search and what was asked (`asked_of`); not where there was
        no search, nor when versions are saved.

    Returns
    -------
    dict
        `Diagnosis.as_json`; when versions are saved, ``command`` is ``auto`` and ``versions`` has what
        `Revision.as_json` gives of each. With ``later_days`` where days were held against a verdict: the last
        one, which stands, or one searched anew because it did not.

    Raises
    ------
    SettingsError
        When the mission has no such comparison, or one without a residual at every sample.
    InflightError
        As `inflight.tasks.analysis.diagnosis.diagnose`.
    """
    settings = settings or DiagnoseSettings()
    mission = workspace.mission()
    require_sampled(mission, settings.comparison)
    listener = progress or silent
    stands = None if save or search else check_later_days(workspace, start, end, settings, listener)
    if stands is not None and stands["later_days"]["stands"]:
        save_diagnosis(workspace, stands, stands.pop("asked"))
        return stands
    cat = Catalog(workspace.root)
    asked = asked_of(cat, mission, start, end, settings)
    bench = Workbench(cat, mission, start, end, settings, fresh=True, client=client, progress=progress)
    examined = None
    if save:
        found, steps = bench.auto()
        fields = found.as_json() | {"command": "auto", "versions": [one.as_json() for one in steps]}
    else:
        examined = bench.examine()
        fields = examined.found.as_json()
    if bench.units is not None:
        fields["units"] = bench.units
    kept = dict(asked)
    if save:
        # It is of the model before the versions that were saved.
        del kept["made_from"]
    elif keep and bench.standing is not None:
        # The diagnosis was asked for, and is there: what is wrong with a day is told with the next one.
        with suppress(InflightError):
            note_compared_days(bench.cat, mission, bench.standing, listener)
        kept["standing"] = bench.standing
    if stands is not None:
        fields["later_days"] = stands["later_days"]
    if keep:
        save_diagnosis(workspace, fields, kept)
    if finished is not None and examined is not None:
        finished(examined, asked)
    return fields


def open_workbench(
    workspace: Workspace,
    comparison: str = "main",
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> Workbench:
    """Return a workbench with the Gram blocks of the last diagnosis; without one, they are made of all days.

    Raises
    ------
    SettingsError, InflightError
        As `diagnose_span`.
    """
    mission = workspace.mission()
    require_sampled(mission, comparison)
    asked = (last_diagnosis(workspace, comparison) or {}).get("asked") or {}
    settings = DiagnoseSettings.model_validate(asked.get("settings") or {"comparison": comparison})
    span = asked.get("start"), asked.get("end")
    return Workbench(Catalog(workspace.root), mission, *span, settings, client=client, progress=progress)


def require_change(workspace: Workspace, comparison: str, verb: str, *names: str) -> None:
    """Refuse at once a change that names what the model has not; no measurement is read.

    Parameters
    ----------
    verb : str
        ``add``, ``drop``, ``refit``, ``set`` or ``undo``.
    names : str
        What the verb was given. What only the Gram blocks can tell is left to the change itself.

    Raises
    ------
    SettingsError, ModelError
        As the change itself raises them.
    """
    mission = workspace.mission()
    require_sampled(mission, comparison)
    cat = Catalog(workspace.root)
    current = current_model(cat, mission, comparison)
    model = current.model
    effects = [entry.name for entry in model.effects]
    if verb == "add" and stored_entry(cat, mission, comparison, names[0]) is None:
        require_known(names[0], model, mission)
    if verb == "undo":
        version_before_change(cat, mission, current)
    # Additions go by the name that a search gave them, too: it has more than a word.
    if verb == "drop" and names[0].isidentifier() and names[0] not in effects:
        raise _no_effect(model, names[0], effects)
    if verb == "refit":
        known = sorted({name.partition("[")[0] for name in model.columns})
        if unknown := next((one for one in names if one not in known), None):
            raise _no_number(model, unknown, known, f"it has {', '.join(known)}")
    if verb == "set":
        for name in dict(map(_setting, names)):
            channels = {channel for _, channel, _ in mission.channel_instruments()}
            owner = name.partition("[")[0].rpartition(".")[0]
            if owner not in effects and not channels & set(owner.split(".")):
                raise _no_number(model, name, model.columns, "'inflight model show' lists its values")


def _no_effect(model: Model, name: str, known: Sequence[str]) -> ModelError:
    return ModelError(
        f"model '{model.name}' has no effect {name!r}{did_you_mean(name, known)}",
        remedy=f"it has {', '.join(known)}",
    )


def _no_number(model: Model, name: str, known: Sequence[str], remedy: str) -> ModelError:
    return ModelError(
        f"model '{model.name}' has no number {name!r}{did_you_mean(name, known)}", remedy=remedy
    )
