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
from inflight.diagnosis.columns import turns_of
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.lags import mixture
from inflight.diagnosis.library import Candidate, Library, Term
from inflight.diagnosis.refit import Column
from inflight.diagnosis.search import Option
from inflight.effects.vector_sensor import ANGLES, VectorSensor
from inflight.errors import ModelError
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, make_effect
from inflight.sensors import sensors_of
from inflight.time import DAY, to_utc

#: Parameters of a drift's effect and their neutral values, by what drifts.
_DRIFTING: dict[str, tuple[str, list[float]]] = {
    "scale": ("matrix", np.eye(3).ravel().tolist()),
    "angle": ("matrix", np.eye(3).ravel().tolist()),
    "offset": ("shift", [0.0, 0.0, 0.0]),
}


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
                parameters[key] = replace(zero.with_columns(moved, error), free=timed.time == "constant")
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
        return term if isinstance(term.entry.effect, VectorSensor) else None

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

    def of_option(self, option: Option) -> Addition:
        """Return the addition of what a search took."""
        if option.change is not None:
            if not option.change.at:
                return self.drift(option.name)
            return self.step(option.name.split("_")[0], option.change.at)
        candidates = {one.name: one for one in self.library.candidates}
        if option.name in candidates:
            return self.of_candidate(candidates[option.name])
        return self.of_terms(option.name, [self.library.terms[key] for key in option.terms])

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

    # What is bound to a time.

    def drift(self, kind: str, name: str = "") -> Addition:
        """Return a drift of the scale factors, the angles or the offsets, straight in time.

        It stands before the nine parameters, as an affine change of the reading that grows from
        nothing at the middle of the span: calibration intervals still have their own nine.

        Raises
        ------
        ModelError
            When the comparison has no such parameters.
        """
        what = kind.removesuffix("_drift")
        columns = getattr(self.carriers, what)
        if not columns:
            raise ModelError(f"this comparison has nothing that '{kind}' could be of", remedy="try another")
        middle = self.raw.start / 2 + self.raw.end / 2
        origin = float(middle.mean())
        days = (middle - origin) / DAY
        term = self._carrier(columns[0])
        entry = self._drifting(what, name or self.free_name(kind), term, int(origin))
        axes = ANGLES if what == "angle" else tuple("xyz")
        titles = [f"{entry.name}.{what}[{axis}]" for axis in axes]
        made = tuple(
            Column(title, ((column, 1.0),), days) for title, column in zip(titles, columns, strict=True)
        )
        part = _DRIFTING[what][0]
        turn = self._before_the_nine(what, term) * (-np.deg2rad(1.0) if what == "angle" else 1.0)
        values = [f"{entry.name}.{part}[{2 * axis if what == 'scale' else axis}]*b" for axis in axes]
        gains = {value: _weighted(titles, row) for value, row in zip(values, turn, strict=True)}
        unit = {"scale": "1/d", "angle": "deg/d", "offset": "nT/d"}[what]
        return Addition(kind, made, (entry,), (term,), gains=gains, unit=unit)

    def _drifting(self, what: str, name: str, term: Term, origin: int) -> ModelEffect:
        part, unit = _DRIFTING[what]
        timed = {
            "time": "linear",
            "t0": f"{to_utc(origin)}Z",
            "per": "1 d",
            "value": [[one, 0.0] for one in unit],
            "free": False,
        }
        told = {"effect": "affine", "name": name, "sensor": term.entry.sensor.name, part: timed}
        return make_effect(told, sensors_of(self.mission, self.model.comparison), mission=self.mission)

    def _before_the_nine(self, what: str, term: Term) -> Floats:
        """Return what changes of the sensor's own parameters are as changes of its reading; (3, 3).

        Rows are those of the reading: relative ones of its axes, or of angles of its own next to 90 deg. A
        change D of K (Yin 2010, eq. 2.5) is the reading's own change S before it, with ``K S = D``.
        """
        if what == "offset":
            return np.eye(3) * (1.0 if term.entry.effect.label() == "affine" else -1.0)
        own = term.entry.parameters
        kx, ky, _ = own["scale_factor"].value[:, 0]
        if what == "scale":
            return np.diag(1.0 / own["scale_factor"].value[:, 0])
        angles = np.deg2rad(own["misalignment"].value[:, 0])
        xy, xz, yz = np.sin(angles)
        across = -np.cos(angles[0]) * yz / (kx * ky)
        return np.array([[xy / kx, 0.0, 0.0], [0.0, xz / kx, across], [0.0, 0.0, yz / ky]])

    def step(self, kind: str, at: Sequence[int], name: str = "") -> Addition:
        """Return a step of a sensor's parameter at a block's edge, or an episode between two.

        Parameters
        ----------
        kind : str
            ``offset``, ``scale``, ``angle``, ``bias`` or ``clock``.
        at : sequence of int
            TT2000: when it begins, and when it ends if it does.

        Raises
        ------
        ModelError
            When the comparison has no such parameter.
        """
        found = tuple(getattr(self.carriers, kind))
        if not found:
            raise ModelError(f"this comparison has no {kind} that could change", remedy="try another")
        inside = self.raw.start >= at[0]
        if len(at) == 2:
            inside = inside & (self.raw.start < at[1])
        label = f"{kind}_{'episode' if len(at) == 2 else 'step'}"
        title = name or self.free_name(f"{label}_{_stamp(at[0])}")
        entries = self._dated(kind, title, at, self._carrier(found[0]))
        values = [names_of(entry, (_only(entry),)) for entry in entries]
        made = tuple(
            Column(one, ((column, 1.0),), inside.astype(np.float64))
            for one, column in zip(values[0], found, strict=True)
        )
        gains = self._gains(kind, values, self._carrier(found[0]))
        told = f"{label}@{'/'.join(str(to_utc(when)) for when in at)}"
        return Addition(told, made, entries, (self._carrier(found[0]),), True, gains)

    def _dated(self, kind: str, title: str, at: Sequence[int], term: Term) -> tuple[ModelEffect, ...]:
        """Return the effects that say it; a bias that comes and goes is two steps."""
        sensors = sensors_of(self.mission, self.model.comparison)
        when = [f"{to_utc(one)}Z" for one in at]
        if kind != "bias" and len(at) == 2:
            told = [{"effect": f"{kind}_episode", "name": title, "from": when[0], "to": when[1]}]
        else:
            names = [title, f"{title}_end"]
            told = [
                {"effect": f"{kind}_step", "name": name, "at": one}
                for name, one in zip(names, when, strict=False)
            ]
        given: dict[str, Any] = {"sensor": term.entry.sensor.name}
        if kind in ("scale", "angle"):
            # The sensor's equation takes the offset off before it scales and turns.
            offset = term.entry.parameters["offset"].value[:, 0].tolist()
            given["about"] = {"value": offset, "free": False}
        return tuple(make_effect(one | given, sensors, mission=self.mission) for one in told)

    def _gains(
        self, kind: str, values: Sequence[Sequence[str]], term: Term
    ) -> dict[str, tuple[tuple[str, float], ...]]:
        """Return how the model's values follow from those of the carrier's columns."""
        first = values[0]
        turn = np.eye(len(first))
        if kind == "offset":
            turns = turns_of(self.model, int(self.raw.start[0]))
            # Behind the sensor's equation a step of its offset is that step through K.
            affine = term.entry.effect.label() == "affine"
            turn = -np.eye(3) if affine else np.reshape(turns.get(term.entry.sensor.name, np.eye(3)), (3, 3))
        elif kind in ("scale", "angle"):
            turn = self._before_the_nine(kind, term)
        gains = {}
        for sign, names in zip((1.0, -1.0), values, strict=False):
            for row, name in enumerate(names):
                gains[name] = _weighted(first, sign * turn[row])
        return gains

    def _carrier(self, column: str) -> Term:
        return next(term for term in self.library.all_terms if column in term.columns)


def _weighted(names: Sequence[str], weights: Floats) -> tuple[tuple[str, float], ...]:
    return tuple((name, float(weight)) for name, weight in zip(names, weights, strict=True))


def _only(entry: ModelEffect) -> str:
    return next(iter(type(entry.effect).parameters()))


def names_of(entry: ModelEffect, parameters: Sequence[str]) -> list[str]:
    """Return the names the model calls the values of some parameters by."""
    return [name for key in parameters for name in entry.parameters[key].columns]


def _stamp(when: int) -> str:
    """Return a moment as a part of a name."""
    return "".join(c for c in str(to_utc(when))[:16] if c.isalnum())


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
