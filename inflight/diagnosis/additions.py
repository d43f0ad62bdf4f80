"""What is put into a model: its columns of the evidence, and its entries in the model's file.

An addition's columns are called as the model will call its values, so that a fit's result goes into
the model by name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from inflight.arrays import Floats
from inflight.derived import parse
from inflight.diagnosis.changes import Carriers
from inflight.diagnosis.columns import EQUATIONS
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.lags import mixture
from inflight.diagnosis.library import Candidate, Library, Term
from inflight.diagnosis.refit import Column
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, make_effect
from inflight.sensors import sensors_of


@dataclass(frozen=True)
class Addition:
    """Something put into the model.

    Attributes
    ----------
    name : str
        As a person calls it: a candidate's name.
    columns : tuple of Column
    entries : tuple of ModelEffect
        What the model's file gets; at values that do nothing, where the columns are linearised.
    needs : tuple of Term
        Terms whose columns the evidence must hold.
    interleaved : bool
        It lies in few blocks.
    gains : dict of str to ((str, float), ...)
        Value of the model -> columns it is the sum of, and their weights; itself when it is not named.
    unit : str
        Of columns that are no values of the model by themselves.
    """

    name: str
    columns: tuple[Column, ...]
    entries: tuple[ModelEffect, ...]
    needs: tuple[Term, ...] = ()
    interleaved: bool = False
    gains: Mapping[str, tuple[tuple[str, float], ...]] | None = None
    unit: str = ""

    def put_into(self, model: Model, value: Mapping[str, float], sigma: Mapping[str, float]) -> Model:
        """Return the model with the effect at fitted values, which later fits may move.

        Parameters
        ----------
        value, sigma : mapping of str to float
            Change of each column, physical units, and its standard deviation.
        """
        for entry in self.entries:
            filled = self._filled(entry, value, sigma)
            known = entry.name in [one.name for one in model.effects]
            model = model.replace(filled) if known else model.add(filled)
        return model

    def _filled(
        self, entry: ModelEffect, value: Mapping[str, float], sigma: Mapping[str, float]
    ) -> ModelEffect:
        parameters = dict(entry.parameters)
        for key, timed in entry.parameters.items():
            moved, error = {}, {}
            for name, start in zip(timed.columns, timed.value.ravel(), strict=True):
                gains = (self.gains or {}).get(name, ((name, 1.0),))
                if all(column in value for column, _ in gains):
                    moved[name] = float(start) + sum(weight * value[column] for column, weight in gains)
                    error[name] = float(np.hypot.reduce([weight * sigma[column] for column, weight in gains]))
            if moved:
                zero = replace(timed, sigma=np.zeros_like(timed.sigma))
                # A drift is held: what changes with time is no constant that a later fit could move.
                still = timed.time in ("constant", "block")
                parameters[key] = replace(zero.with_columns(moved, error), free=still)
        return entry.with_parameters(parameters)


@dataclass(frozen=True)
class Maker:
    """Makes additions of one mission, one model and one library.

    Attributes
    ----------
    model : Model
        At the values the evidence is linearised at.
    raw : Evidence
        Its blocks say when things change.
    names : frozenset of str
        Names in the model that are not free any more.
    """

    mission: Mission
    model: Model
    library: Library
    carriers: Carriers
    raw: Evidence
    names: frozenset[str] = frozenset()

    def of_candidate(self, candidate: Candidate, name: str = "", lag_s: float | None = None) -> Addition:
        """Return the addition of a candidate, with another lag than the bank's if one is given."""
        if self.own_term(candidate) is not None:
            return self._of_parameter(candidate)
        bank = self.bank(candidate)
        lag = candidate.lag_s if lag_s is None else lag_s
        weights = {candidate.name: 1.0}
        if bank and lag != candidate.lag_s:
            mixed = mixture(lag, tuple(bank))
            weights = {
                one.name: float(w) for one, w in zip(bank.values(), mixed, strict=True) if abs(w) > 1e-12
            }
        by_name = {one.name: one for one in self.library.candidates}
        columns: list[Column] = []
        entries: list[ModelEffect] = []
        for place, key in enumerate(candidate.terms):
            term = self.library.terms[key]
            title = name or self.title(term.entry)
            title += f"_{place + 1}" if place else ""
            entry = self.entry(term.entry, title, lag if bank else None)
            entries.append(entry)
            own = {one: self.library.terms[by_name[one].terms[place]].columns for one in weights}
            for index, column in enumerate(names_of(entry, term.parameters)):
                columns.append(Column(column, tuple((own[one][index], w) for one, w in weights.items())))
        others = list(bank.values()) or [candidate]
        needs = [self.library.terms[key] for one in others for key in one.terms]
        told = candidate.mechanism if bank else candidate.name
        told += f"@lag={lag:.4g}s" if bank and lag else ""
        return Addition(told, tuple(columns), tuple(entries), tuple(needs))

    def bank(self, candidate: Candidate) -> dict[float, Candidate]:
        """Return lag -> candidate of a mechanism that is tried with several lags; empty when it is not."""
        same = {
            one.lag_s: one
            for one in self.library.candidates
            if one.mechanism == candidate.mechanism and "@width=" not in one.name
        }
        return {lag: same[lag] for lag in sorted(same)} if len(same) > 1 else {}

    def own_term(self, candidate: Candidate) -> Term | None:
        """Return the term of a candidate that frees a parameter of the model's own sensor; else None."""
        term = self.library.terms[candidate.terms[0]]
        return term if isinstance(term.entry.effect, EQUATIONS) else None

    def _of_parameter(self, candidate: Candidate) -> Addition:
        term = self.library.terms[candidate.terms[0]]
        names = names_of(term.entry, term.parameters)
        columns = [Column(name, ((own, 1.0),)) for name, own in zip(names, term.columns, strict=True)]
        return Addition(candidate.name, tuple(columns), (term.entry,), (term,))

    def of_term(self, term: Term, name: str = "") -> Addition:
        """Return the addition of an effect of no library; the evidence may not have its columns yet."""
        names = names_of(term.entry, term.parameters)
        columns = [Column(one, ((own, 1.0),)) for one, own in zip(names, term.columns, strict=True)]
        return Addition(name or term.entry.name, tuple(columns), (term.entry,), (term,))

    def of_terms(self, name: str, terms: Sequence[Term]) -> Addition:
        """Return the addition of what a search made of a candidate: a lag, a width, a product of its own."""
        columns: list[Column] = []
        entries: list[ModelEffect] = []
        for place, term in enumerate(terms):
            title = self.title(term.entry) + (f"_{place + 1}" if place else "")
            entries.append(self.entry(term.entry, title))
            names = names_of(entries[-1], term.parameters)
            columns += [Column(one, ((own, 1.0),)) for one, own in zip(names, term.columns, strict=True)]
        return Addition(name, tuple(columns), tuple(entries), tuple(terms))

    def entry(self, origin: ModelEffect, name: str, lag_s: float | None = None) -> ModelEffect:
        """Return an effect like another, with its own name and whole units, at values that do nothing."""
        given = {key: value for key, value in origin.effect.given.items() if key != "lag"}
        if lag_s is None and "lag" in origin.effect.given:
            given["lag"] = origin.effect.given["lag"]
        elif lag_s:
            given["lag"] = f"{lag_s:.6g} s"
        told: dict[str, Any] = {"effect": origin.effect.label(), "name": name, "sensor": origin.sensor.name}
        sensors = sensors_of(self.mission, self.model.comparison)
        return make_effect(told | given, sensors, self.model.own, self.mission)

    def title(self, origin: ModelEffect) -> str:
        """Return a free name for an effect: its label, and its channels where these decide."""
        parts = [origin.effect.label()]
        if "channel" in origin.effect.given:
            parts += [part.channel for part in parse(origin.effect.channels[0]).parts]
        title = "_".join("".join(c if c.isalnum() else "_" for c in part) for part in parts)
        return self.free_name(title)

    def free_name(self, title: str) -> str:
        """Return a name, numbered when an effect of the model has it."""
        found, number = title, 2
        while found in self.names:
            found, number = f"{title}_{number}", number + 1
        return found

    def carrier(self, column: str) -> Term:
        """Return the term a column is of."""
        return next(term for term in self.library.all_terms if column in term.columns)


def names_of(entry: ModelEffect, parameters: Sequence[str]) -> list[str]:
    """Return the names the model calls the values of some parameters by."""
    return [name for key in parameters for name in entry.parameters[key].columns]


def values_of(entry: ModelEffect) -> dict[str, float]:
    """Return every value of an effect by its name in the model."""
    return {
        name: float(value)
        for timed in entry.parameters.values()
        for name, value in zip(timed.columns, timed.value.ravel(), strict=True)
    }


def held_at_nothing(entry: ModelEffect, term: Term) -> dict[str, float] | None:
    """Return the changes of a term's columns that take its effect out; None when they are not all."""
    kinds = type(entry.effect).parameters()
    fitted = [key for key, kind in kinds.items() if np.isfinite(kind.sigma)]
    if not fitted or not set(fitted) <= set(term.parameters):
        return None
    nothing: list[Floats] = [kinds[key].default_values for key in term.parameters]
    start = [term.entry.parameters[key].value[:, 0] for key in term.parameters]
    changes = np.concatenate(nothing) - np.concatenate(start)
    return dict(zip(term.columns, changes.tolist(), strict=True))
