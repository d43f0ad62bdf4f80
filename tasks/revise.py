"""The model revised: an effect added, dropped or taken back, everything fitted anew, a new version saved.

`Workbench` holds the evidence of one pass in memory. Its *root* is the version of the model the
evidence was made at; what later versions added or dropped is algebra on that evidence. Only an effect
whose columns are not in it costs a pass, over the model's columns and its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from inflight.catalog import Catalog
from inflight.diagnosis.additions import Addition, Maker, held_at_nothing, values_of
from inflight.diagnosis.carriers import carriers_of
from inflight.diagnosis.changes import DRIFTS
from inflight.diagnosis.columns import EQUATIONS
from inflight.diagnosis.diagnosis import Diagnosis
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.library import Library, Term
from inflight.diagnosis.refit import Fitted, Ground, variance_of
from inflight.diagnosis.search import Search
from inflight.diagnosis.timed_additions import addition_of
from inflight.diagnosis.verdict import conclude
from inflight.diagnosis.wanted import best_lag, find_wanted, known_addition
from inflight.effects.naming import did_you_mean
from inflight.errors import ModelError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.diagnose import (
    DiagnoseSettings,
    Prepared,
    intervals_of,
    material_of,
    prepare,
    search_of,
)
from inflight.tasks.evidence import PassPlan
from inflight.tasks.history import before_last, evidence_root
from inflight.tasks.models import UsedModel, current_model
from inflight.tasks.report import Progress
from inflight.tasks.revision import Revision, moved, numbers
from inflight.time import DayLike


@dataclass
class Workbench:
    """The evidence of a span in memory, and the model that is being revised on it.

    Parameters
    ----------
    cat : Catalog
    mission : Mission
    settings : DiagnoseSettings
    start, end : UTC date or None
        The span of the evidence.
    fresh : bool
        Make the evidence at the present version, even if an earlier one has some.
    client, progress
        As of `inflight.tasks.diagnose.diagnose`.
    """

    cat: Catalog
    mission: Mission
    settings: DiagnoseSettings = field(default_factory=DiagnoseSettings)
    start: DayLike | None = None
    end: DayLike | None = None
    fresh: bool = False
    client: Any = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self.current = current_model(self.cat, self.mission, self.settings.comparison)
        root = evidence_root(self.cat, self.mission, self.current)
        if self.fresh and root and root[0].text != self.current.text:
            root = None
        #: The mission as it was when the evidence was made; it keys the evidence.
        used, self._measured = root or (self.current, self.mission)
        self.made = self._prepared(used, None)
        if used.text == self.current.text:
            self.made = replace(self.made, used=self.current)
        self._narrow: tuple[tuple[str, ...], Prepared] | None = None
        #: The fit of the model as it stands is asked for again with the next change.
        self._last: tuple[Evidence, tuple[Any, ...], Fitted] | None = None
        self._restore()

    def _prepared(self, used: UsedModel, needs: Sequence[Term] | None) -> Prepared:
        def narrow(plan: PassPlan) -> PassPlan:
            own = plan.library
            there = {name for term in (*own.base, *own.refined) for name in term.columns}
            more = {term.key: term for term in needs or () if not set(term.columns) <= there}
            return replace(plan, library=Library(own.base, own.refined, more))

        narrower = None if needs is None else narrow
        how: Any = {"client": self.client, "progress": self.progress, "used": used, "narrow": narrower}
        return prepare(self.cat, self._measured, self.start, self.end, self.settings, **how)

    def _restore(self) -> None:
        """Find out what the present version added to the root, and dropped of it."""
        root = {entry.name for entry in self.root.model.effects}
        now = {entry.name for entry in self.current.model.effects}
        self.dropped = sorted(root - now)
        added = [entry for entry in self.current.model.effects if entry.name not in root]
        self.additions: list[Addition] = [known_addition(self.maker, entry) for entry in added]
        for entry in self.root.model.effects:
            if isinstance(entry.effect, EQUATIONS) and entry.name in now:
                self.additions += self._freed(entry.name)

    def _freed(self, name: str) -> list[Addition]:
        """Return the sensor's own parameters that the present version lets free and the root did not."""
        was, now = self.root.model.effect(name), self.current.model.effect(name)
        keys = [key for key in was.parameters if now.parameters[key].free and not was.parameters[key].free]
        candidates = {one.name: one for one in self.made.plan.library.candidates}
        return [
            self.maker.of_candidate(candidates[f"{name}.{key}"])
            for key in keys
            if f"{name}.{key}" in candidates
        ]

    @property
    def root(self) -> UsedModel:
        """The version the evidence was made at."""
        return self.made.used

    @property
    def maker(self) -> Maker:
        """What makes additions, with names that are free now."""
        names = {one.name for model in (self.root.model, self.current.model) for one in model.effects}
        plan = self.made.plan
        return Maker(
            self.mission,
            plan.model,
            plan.library,
            carriers_of(plan.library),
            self.made.loaded.raw,
            frozenset(names),
        )

    @cached_property
    def _search(self) -> Search:
        return search_of(self.made, self.settings)

    def candidates(self) -> list[str]:
        """Return the names of everything that `add` knows without a pass, in the library's order."""
        kinds = [kind for kind in DRIFTS if self._has_carrier(kind)]
        return [one.name for one in self.made.plan.library.candidates if not one.placebo] + kinds

    def _has_carrier(self, drift: str) -> bool:
        return bool(getattr(self.maker.carriers, drift.removesuffix("_drift")))

    # Changes of the model.

    def add(self, effect: str | Mapping[str, Any]) -> Revision:
        """Put an effect into the model and fit everything anew.

        Parameters
        ----------
        effect : str or mapping
            A candidate's name, mechanism, effect or channel; ``offset_step@2024-03-01``; or an entry of
            the model YAML, as text or mapping. An effect of the bank gets the lag that fits best.

        Raises
        ------
        ModelError
            When nothing is called so, or it cannot be fitted.
        """
        wanted = find_wanted(self.maker, effect)
        addition = wanted.addition
        if wanted.bank:
            ground, fixed = self._ground([*self.additions, addition], self.dropped)
            lag = best_lag(ground, fixed, [c for one in self.additions for c in one.columns], wanted.bank)
            addition = wanted.at_lag(lag)
        more = [*self.additions, addition]
        return self._revise("add", f"add {addition.name}", more, self.dropped, addition)

    def drop(self, name: str) -> Revision:
        """Take an effect out of the model and fit everything anew.

        Raises
        ------
        ModelError
            When the model has none of that name, or cannot be without it.
        """
        added = [one for one in self.additions if name in (one.name, *(entry.name for entry in one.entries))]
        if added:
            rest = [one for one in self.additions if one is not added[0]]
            return self._revise("drop", f"drop {added[0].name}", rest, self.dropped)
        known = [entry.name for entry in self.current.model.effects]
        if name not in known:
            raise ModelError(
                f"model '{self.current.model.name}' has no effect {name!r}{did_you_mean(name, known)}",
                remedy=f"it has {', '.join(known)}",
            )
        if isinstance(self.current.model.effect(name).effect, EQUATIONS):
            raise ModelError(
                f"'{name}' holds the parameters every calibration fits",
                remedy="drop another, or hold its parameters by 'free: false' in the pre-flight model",
            )
        return self._revise("drop", f"drop {name}", self.additions, [*self.dropped, name])

    def undo(self) -> Revision:
        """Go back to the version before the last change: a new version with its text.

        Raises
        ------
        ModelError
            When there is nothing to go back to.
        """
        found = before_last(self.cat, self.mission, self.current)
        ground, fixed = self._ground(self.additions, self.dropped)
        before, first = self._fit(ground, fixed, self.additions), self.current
        message = f"undo version {first.version}: back to version {found.version}"
        self.current = self._saved(found.model, message, found.text)
        self._restore()
        ground, fixed = self._ground(self.additions, self.dropped)
        after = self._fit(ground, fixed, self.additions)
        return self._told("undo", message, first.version, before, after)

    def _revise(
        self,
        command: str,
        message: str,
        additions: list[Addition],
        dropped: list[str],
        addition: Addition | None = None,
    ) -> Revision:
        ground, fixed = self._ground(additions, dropped)
        interleaved = any(one.interleaved for one in (*additions, *self.additions))
        same = self._held(dropped)[1] == self._held(self.dropped)[1]
        old = self._ground(self.additions, self.dropped, ground if same else None)
        before = self._fit(*old, self.additions, interleaved)
        after = self._fit(ground, fixed, additions, interleaved)
        model, parent = self._model(ground, additions, dropped, after), self.current.version
        self.current = self._saved(model, message, model.text)
        self.additions, self.dropped = additions, dropped
        told = self._told(command, message, parent, before, after)
        told.values = numbers(model, addition.entries) if addition else []
        return told

    def _saved(self, model: Model, message: str, text: str) -> UsedModel:
        version = self.cat.save_model(model.name, text, self.current.version, message, again=True)
        return UsedModel(model, version, text)

    # The fit.

    def _fit(
        self,
        ground: Ground,
        fixed: Mapping[str, float],
        additions: Sequence[Addition],
        interleaved: bool | None = None,
    ) -> Fitted:
        columns = [column for one in additions for column in one.columns]
        apart = any(one.interleaved for one in additions) if interleaved is None else interleaved
        key = (tuple(one.name for one in additions), tuple(sorted(fixed)), apart)
        if self._last is None or self._last[0] is not ground.raw or self._last[1] != key:
            self._last = ground.raw, key, ground.fit(columns, fixed, interleaved=apart)
        return self._last[2]

    def _ground(
        self, additions: Sequence[Addition], dropped: Sequence[str], beside: Ground | None = None
    ) -> tuple[Ground, dict[str, float]]:
        """Return what a fit stands on, and the parameters held at nothing for what was dropped.

        Parameters
        ----------
        beside : Ground, optional
            Taken when it serves: what is compared should stand on the same.
        """
        held, hard = self._held(dropped)
        names = {part for one in additions for column in one.columns for part, _ in column.parts}
        if beside is not None and names <= set(beside.raw.names):
            return beside, held
        if names <= set(self.made.loaded.raw.names) and not hard:
            return self._whole, held
        needs = [term for one in additions for term in one.needs]
        key = (*sorted(names), "", *hard)
        if self._narrow is None or self._narrow[0] != key:
            model = self.root.model
            for name in hard:
                model = model.drop(name)
            used = UsedModel(model, self.root.version, model.text)
            self._narrow = key, self._prepared(used, needs)
        return _ground_of(self._narrow[1], self.settings), held

    @cached_property
    def _whole(self) -> Ground:
        return _ground_of(self.made, self.settings)

    def _held(self, dropped: Sequence[str]) -> tuple[dict[str, float], tuple[str, ...]]:
        """Return changes that take dropped effects out, and those that ask for a pass without them."""
        held: dict[str, float] = {}
        hard = []
        terms = {term.entry.name: term for term in self.made.plan.library.refined}
        for name in dropped:
            found = held_at_nothing(self.root.model.effect(name), terms[name]) if name in terms else None
            if found is None:
                hard.append(name)
            else:
                held |= found
        return held, tuple(hard)

    def _model(
        self, ground: Ground, additions: Sequence[Addition], dropped: Sequence[str], fitted: Fitted
    ) -> Model:
        """Return the root's model with everything at its fitted values."""
        model = self.root.model
        value, sigma = {}, {}
        for term in ground.refined:
            starts = values_of(term.entry)
            for name in (name for name in starts if f"model:{name}" in fitted.value):
                value[name] = starts[name] + fitted.value[f"model:{name}"]
                sigma[name] = fitted.sigma[f"model:{name}"]
        model = model.with_values(value, sigma)
        for name in dropped:
            model = model.drop(name)
        for one in additions:
            model = one.put_into(model, fitted.value, fitted.sigma)
        return model

    # What is told.

    def _told(self, command: str, effect: str, parent: int, before: Fitted, after: Fitted) -> Revision:
        inside = self.made.loaded.sums["inside"] / max(self.made.loaded.sums["count"], 1.0)
        sizes = [
            float(np.sqrt(one + inside))
            for one in (before.in_sample, after.in_sample, before.held_out, after.held_out)
        ]
        return Revision(
            command,
            effect,
            self.current,
            parent,
            (sizes[0], sizes[1]),
            (sizes[2], sizes[3]),
            moved(before, after, self._units()),
            run=self.made.run,
            context=self.made.context,
        )

    def _units(self) -> dict[str, str]:
        entries = [*self.made.plan.model.effects, *(one.entry for one in self.made.plan.library.base)]
        entries += [entry for one in self.additions for entry in one.entries]
        made = {column.name: one.unit for one in self.additions for column in one.columns}
        return made | {
            name: timed.parameter.unit
            for entry in entries
            for timed in entry.parameters.values()
            for name in timed.columns
        }

    # The search.

    def diagnose(self) -> Diagnosis:
        """Search what is missing from the present version; its evidence is made anew when it has none."""
        self._refresh()
        material = material_of(self.made, self.mission)
        model = replace(material.model, version=self.root.version)
        return conclude(self._search, replace(material, model=model))

    def auto(self) -> tuple[Diagnosis, list[Revision]]:
        """Search, and save one version for every effect the search took, in order."""
        found = self.diagnose()
        # Lags, widths and products that the search made have their columns in its evidence.
        self.made = replace(self.made, loaded=replace(self.made.loaded, raw=self._search.raw))
        self.__dict__.pop("_whole", None)
        steps = []
        for option in self._search.accepted:
            addition = addition_of(self.maker, option)
            message = f"auto: add {addition.name}"
            steps.append(self._revise("auto", message, [*self.additions, addition], self.dropped, addition))
        return found, steps

    def _refresh(self) -> None:
        if self.root.version != self.current.version or self.additions or self.dropped:
            self._measured = self.mission
            self.made = self._prepared(self.current, None)
            self._narrow = None
        for name in ("_search", "_whole"):
            self.__dict__.pop(name, None)
        self._restore()


def _ground_of(made: Prepared, settings: DiagnoseSettings) -> Ground:
    library = made.plan.library
    return Ground(
        made.loaded.raw,
        tuple(library.base),
        tuple(library.refined),
        intervals_of(made, settings),
        variance_of(made.loaded.white, library.base),
    )
