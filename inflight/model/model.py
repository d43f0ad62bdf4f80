"""The model as a value: read from YAML, immutable, hashed; effects are added and dropped by copies.

`Model.parse` makes effects from the entries of the YAML (`make_effect`): class, sensor, options, and the
values of parameters with their time dependence. `Model.text` is the YAML again, whose sha256 names a model.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from ruamel.yaml import YAML

from inflight.arrays import Floats
from inflight.dipole import DipoleSource
from inflight.effects import (
    AXES,
    CURRENT_FAMILIES,
    Effect,
    EffectSource,
    Parameter,
    Remanent,
    RemanentMoment,
    Torquer,
    VectorSensor,
    channel_unit,
    coefficient_unit,
    effect_class,
    family_of,
)
from inflight.errors import InflightError, ModelError, SettingsError, did_you_mean
from inflight.mission import Sensor, sensors_of
from inflight.model.apply import (
    ModelEffect,
    before_corrections,
    correct,
    correct_plain,
    correction_terms,
    disturb,
)
from inflight.model.diff import changes, parse_tree
from inflight.model.rows import ResidualDefinition, rows_of
from inflight.model.time_dependence import TimedValue, parse_timed
from inflight.samples import PlainSamples
from inflight.units import product_factor

if TYPE_CHECKING:
    import xarray as xr

    from inflight.mission import Mission

#: Least part of a dipole's field that the difference of two sensors must hold to tell the field.
_ALIKE = 1e-3


def make_effect(
    entry: Mapping[str, Any],
    sensors: Mapping[str, Sensor],
    own: Iterable[EffectSource] = (),
    mission: Mission | None = None,
) -> ModelEffect:
    """Make an effect from one entry of the model YAML.

    A key ``source`` is what `ModelEffect.as_yaml` wrote of the user's file; it is not read, since
    the class is that of the file as it is now.

    Parameters
    ----------
    sensors : mapping of str to Sensor
        The comparison's, by instrument.
    own : iterable of EffectSource
        Files with effects that the mission names.
    mission : Mission, optional
        Tells units of channels, the effect's family and events.

    Raises
    ------
    ModelError
        When effect, sensor, option or parameter is unknown.
    """
    if not isinstance(entry, Mapping) or "effect" not in entry:
        raise ModelError(f"{entry!r} names no effect", remedy="write {effect: NAME, sensor: INSTRUMENT, ...}")
    given = {str(key): value for key, value in entry.items() if key != "source"}
    kind = effect_class(str(given.pop("effect")), own)
    name = str(given.pop("name", None) or "")
    sensor = _sensor_of(kind, given.pop("sensor", None), sensors)
    dipole = given.pop("dipole", None)
    # What is no parameter of the class is an option: the effect itself refuses unknown ones.
    options = {key: given.pop(key) for key in list(given) if key not in kind.parameters()}
    effect = kind(name, **options)
    timed = {
        key: _timed_value(effect, key, parameter, given.get(key), mission)
        for key, parameter in effect.parameters().items()
    }
    effect.units = {key: value.parameter.unit for key, value in timed.items()}
    if mission is not None:
        effect.family = family_of(effect, mission)
    made = ModelEffect(effect, sensor, timed)
    return made if dipole is None else with_dipole(made, dipole, sensors)


def with_dipole(entry: ModelEffect, given: Any, sensors: Mapping[str, Sensor]) -> ModelEffect:
    """Return an effect as a dipole's that all sensors of the comparison see.

    Parameters
    ----------
    given : mapping or None
        ``position`` (m, three numbers; the origin of the mission's positions when absent) and ``sigma``, m;
        None takes a dipole away.
    sensors : mapping of str to Sensor
        The comparison's, by instrument.

    Raises
    ------
    ModelError
        When the effect is no added field of a vector sensor, a position is unknown, or both sensors would
        see the same field.
    """
    if given is None:
        return replace(entry, dipole=None, others=())
    if not entry.effect.is_additive:
        raise ModelError(
            f"'{entry.name}' has a dipole and does more than add a field", remedy="take 'dipole' out"
        )
    if entry.sensor.is_scalar:
        raise ModelError(
            f"'{entry.name}' has a dipole and acts on {entry.sensor.name}, a scalar sensor",
            remedy="name the vector sensor: its field is what the numbers of a dipole are",
        )
    dipole = _dipole_of(entry.name, given)
    others = tuple(one for one in sensors.values() if one.name != entry.sensor.name)
    unknown = [one.name for one in (entry.sensor, *others) if one.position is None]
    if unknown or not others:
        raise ModelError(
            f"'{entry.name}' has a dipole, and "
            + (f"the mission does not say where {' and '.join(unknown)} stands" if unknown else "one sensor"),
            remedy="state the instruments' 'position', m, in the mission file"
            if unknown
            else "drop 'dipole'",
        )
    made = replace(entry, dipole=dipole, others=others)
    try:
        errors, transfers = made.place_errors(), made.transfers()
    except (SettingsError, np.linalg.LinAlgError) as error:
        raise ModelError(f"'{entry.name}': dipole: {error}", remedy="give its true position, m") from None
    alike = min(np.linalg.svd(np.eye(3) - one, compute_uv=False)[-1] for one in transfers.values())
    if alike < _ALIKE or not all(np.isfinite(one).all() for one in errors.values()):
        raise ModelError(
            f"'{entry.name}': a dipole at {list(dipole.position)} m makes nearly the same field at both "
            "sensors: their difference does not hold it",
            remedy="give its true position, m, or drop 'dipole'",
        )
    return made


def _dipole_of(name: str, given: Any) -> DipoleSource:
    try:
        unknown = set(given) - {"position", "sigma"}
        position = tuple(float(one) for one in given.get("position", (0.0, 0.0, 0.0)))
        sigma = float(given["sigma"])
    except (TypeError, KeyError, ValueError, AttributeError):
        unknown, position, sigma = {""}, (), -1.0
    if unknown or len(position) != len(AXES) or not np.isfinite([*position, sigma]).all() or sigma < 0:
        raise ModelError(
            f"'{name}': dipole: {given!r}",
            remedy="write such as dipole: {position: [0.3, 0, 0.1], sigma: 0.2}, both in m",
        )
    return DipoleSource((position[0], position[1], position[2]), sigma)


def _sensor_of(kind: type[Effect], named: Any, sensors: Mapping[str, Sensor]) -> Sensor:
    """Return the sensor an entry names, or the first one the effect may act on."""
    allowed = {name: sensor for name, sensor in sensors.items() if sensor.role in kind.acts_on}
    name = str(named) if named is not None else next(iter(allowed), "")
    if name not in sensors:
        raise ModelError(
            f"effect '{kind.label()}' acts on {name!r}, which the comparison has not"
            f"{did_you_mean(name, sensors)}",
            remedy=f"its sensors are {', '.join(sensors)}",
        )
    if name not in allowed:
        raise ModelError(
            f"effect '{kind.label()}' acts on a {' or '.join(kind.acts_on)} sensor, "
            f"'{name}' is a {sensors[name].role} one",
            remedy=f"name {', '.join(allowed) or 'none: the comparison has no such sensor'}",
        )
    return sensors[name]


def _timed_value(
    effect: Effect, key: str, parameter: Parameter, given: Any, mission: Mission | None
) -> TimedValue:
    """Return a parameter's value in the unit the entry states, or the one its channel gives it."""
    stated = given.get("unit") if isinstance(given, Mapping) else None
    full = f"{effect.name}.{key}"
    if parameter.per_channel:
        channel = effect.channels[0]
        if stated is not None:
            unit = _checked_unit(full, str(stated), parameter, channel, mission)
        else:
            unit = coefficient_unit(parameter, mission, channel) if mission else parameter.unit
        parameter = replace(parameter, unit=unit)
    return parse_timed(full, parameter, given, mission.events if mission else ())


def _checked_unit(key: str, stated: str, parameter: Parameter, channel: str, mission: Mission | None) -> str:
    """Return a stated unit of a coefficient; with the mission, refuse one that is of no use."""
    unit = channel_unit(mission, channel) if mission else None
    if stated == parameter.unit or unit is None or mission is None:
        return stated
    try:
        product_factor(stated, unit, parameter.per_channel, parameter.unit)
    except ValueError as error:
        fitting = coefficient_unit(parameter, mission, channel)
        raise ModelError(f"'{key}': {error}", channel=channel, remedy=f"give it in {fitting}") from None
    return stated


@dataclass(frozen=True, eq=False)
class _OfMission:
    """A mission as what something is kept by: equal ones are one."""

    mission: Mission

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _OfMission) and self.mission == other.mission

    def __hash__(self) -> int:
        return hash(self.mission.text)


@lru_cache(maxsize=64)
def _parsed(text: str, of: _OfMission, source: str, own: tuple[EffectSource, ...]) -> Model:
    """Return a model from YAML text; a process asks for the present one again and again."""
    tree, mission = parse_tree(text, source), of.mission
    comparison = str(tree.get("comparison", "main"))
    if comparison not in mission.comparisons:
        raise ModelError(
            f"mission '{mission.mission}' has no comparison {comparison!r}"
            f"{did_you_mean(comparison, mission.comparisons)}",
            file=source,
            remedy=f"one of {', '.join(mission.comparisons)}",
        )
    effects = _parse_effects(tree["effects"], sensors_of(mission, comparison), source, own, mission)
    return Model(
        str(tree.get("model", mission.mission)),
        mission.mission,
        comparison,
        effects,
        int(tree.get("version", 0)),
        tree.get("parent"),
        ResidualDefinition.of(mission, comparison),
        own,
    )


@dataclass(frozen=True)
class Model:
    """An ordered set of effects of one comparison, in the order of correction.

    Attributes
    ----------
    name, mission, comparison : str
        What it is called and what it belongs to.
    version, parent : int
        Number in the catalog, and the version it was made from.
    effects : tuple of ModelEffect
        In the order of correction; `disturb` runs it backwards.
    layout : Layout, optional
        Kind and sensors of the comparison; of a model without one, those its effects act on.
    own : tuple of EffectSource
        Files with effects of the mission's own that `parse` was given.
    """

    name: str
    mission: str
    comparison: str
    effects: tuple[ModelEffect, ...]
    version: int = 0
    parent: int | None = None
    layout: ResidualDefinition | None = None
    own: tuple[EffectSource, ...] = ()

    @staticmethod
    def parse(
        text: str, mission: Mission, source: str = "model.yaml", own: Iterable[EffectSource] = ()
    ) -> Model:
        """Read a model from YAML text; sensors, positions and units of channels come from the mission.

        Parameters
        ----------
        source : str
            Name of the file, for errors.
        own : iterable of EffectSource
            Files with effects that the mission names.

        Raises
        ------
        ModelError
            Naming `source` and the effect that is wrong.
        """
        return _parsed(text, _OfMission(mission), source, tuple(own))

    @cached_property
    def text(self) -> str:
        """The model as YAML; parsing it gives an equal model."""
        tree: dict[str, Any] = {
            "model": self.name,
            "mission": self.mission,
            "comparison": self.comparison,
            "effects": [entry.as_yaml() for entry in self.effects],
        }
        stream = io.StringIO()
        yaml = YAML()
        yaml.width = 110
        yaml.dump(tree, stream)
        return stream.getvalue()

    @property
    def sha(self) -> str:
        """sha256 of the text: equal models have equal hashes, whatever their version."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def effect(self, name: str) -> ModelEffect:
        """Return an effect by its name in the model.

        Raises
        ------
        ModelError
            When there is none.
        """
        for entry in self.effects:
            if entry.name == name:
                return entry
        raise ModelError(
            f"model '{self.name}' has no effect {name!r}",
            remedy=f"it has {', '.join(entry.name for entry in self.effects)}",
        )

    @property
    def empirical(self) -> list[str]:
        """Names of the effects that are there for what they look like, and whose cause is not known."""
        return [entry.name for entry in self.effects if entry.effect.empirical]

    @property
    def told_by_difference(self) -> str:
        """Which currents' fields are known as a difference of two sensors only, and how to tell them; or "".

        What the other sensor sees of such a source stays in the first one's field, and no residual shows it.
        """
        sensors = self.known_layout.sensors
        first = next((one for role, one in sensors.items() if role in ("vector", "inboard")), None)
        others = [one for one in sensors.values() if first is not None and one.name != first.name]
        if first is None or len(others) != 1 or first.position is None or others[0].position is None:
            return ""
        elsewhere = {
            name for entry in self.effects if entry.sensor != first for name in entry.effect.channels[:1]
        }
        names = [
            entry.name
            for entry in self.effects
            if entry.sensor == first
            and entry.is_additive
            and entry.dipole is None
            and (
                isinstance(entry.effect, RemanentMoment)
                or (entry.effect.family in CURRENT_FAMILIES and entry.effect.channels[0] not in elsewhere)
            )
        ]
        if not names:
            return ""
        return (
            f"{', '.join(names)}: known by the difference of {first.name} and {others[0].name}; what "
            f"{others[0].name} sees of {'this source' if len(names) == 1 else 'these sources'} stays in "
            f"the field of {first.name}, and no residual shows it. Say where the source stands, m: "
            f"inflight set {names[0]}.dipole='x y z +- sigma'"
        )

    @property
    def torquers_alone(self) -> str:
        """Where the torquers' field is taken off a scalar sensor without the body's, and what to do; or "".

        The torquers cancel the body's moment on average: without their field the sensor sees the body's,
        which changes over years (Yin 2010, section 3.4.4).
        """
        alone = [
            entry for entry in self.effects if isinstance(entry.effect, Torquer) and entry.sensor.is_scalar
        ]
        if not alone or any(isinstance(entry.effect, RemanentMoment) for entry in self.effects):
            return ""
        constant = any(isinstance(entry.effect, Remanent) for entry in self.effects)
        return (
            f"{', '.join(entry.name for entry in alone)}: the torquers' field is taken off and the body's, "
            f"which they cancel on average, {'is held constant' if constant else 'is not'}; its change over "
            "years goes into the offsets. With 260 days: inflight reprocess --table continuous, then "
            "inflight add remanent_moment"
        )

    def add(self, effect: ModelEffect, before: str | None = None) -> Model:
        """Return a model with one more effect, before a named one or in its usual place.

        That is the end; an effect that does more than add a field stands before its sensor's nine
        parameters, which are fitted to readings corrected for it.

        Raises
        ------
        ModelError
            When there is an effect of that name.
        """
        names = [entry.name for entry in self.effects]
        if effect.name in names:
            raise ModelError(
                f"there is an effect {effect.name!r} already", remedy="give the new one a 'name'"
            )
        nine = [
            place
            for place, entry in enumerate(self.effects)
            if isinstance(entry.effect, VectorSensor) and entry.sensor.name == effect.sensor.name
        ]
        if before:
            index = names.index(self.effect(before).name)
        else:
            index = nine[0] if nine and not effect.is_additive else len(names)
        return replace(self, effects=(*self.effects[:index], effect, *self.effects[index:]))

    def drop(self, name: str) -> Model:
        """Return a model without an effect."""
        gone = self.effect(name)
        return replace(self, effects=tuple(entry for entry in self.effects if entry is not gone))

    def replace(self, effect: ModelEffect) -> Model:
        """Return a model with another effect in the place of the one of its name.

        Raises
        ------
        ModelError
            When there is none of that name.
        """
        old = self.effect(effect.name)
        return replace(self, effects=tuple(effect if entry is old else entry for entry in self.effects))

    @property
    def columns(self) -> list[str]:
        """Names of all values the model itself holds; those with time ``block`` or ``table`` are a table's.

        ``effect.parameter[axis]``; with several coefficients as `TimedValue.columns` says.
        """
        return [
            name
            for entry in self.effects
            for timed in entry.parameters.values()
            if timed.time not in ("block", "table")
            for name in timed.columns
        ]

    def with_values(self, value: Mapping[str, float], sigma: Mapping[str, float] | None = None) -> Model:
        """Return a model with new values, and standard deviations, of the named columns.

        Parameters
        ----------
        value, sigma : mapping of str to float
            By names of `columns`, in the units the model states.

        Raises
        ------
        ModelError
            When the model holds no such value.
        """
        sigma, known = sigma or {}, self.columns
        for name in [*value, *sigma]:
            if name not in known:
                raise ModelError(
                    f"model '{self.name}' holds no value {name!r}{did_you_mean(name, known)}",
                    remedy="name one of model.columns; values with time 'block' lie in a table",
                )
        return replace(self, effects=tuple(entry.with_columns(value, sigma) for entry in self.effects))

    def bind(self, table: xr.Dataset) -> Model:
        """Return a model whose block parameters take their values from a calibration table."""
        return replace(
            self,
            effects=tuple(
                entry.with_parameters({k: v.bind(table) for k, v in entry.parameters.items()})
                for entry in self.effects
            ),
        )

    @property
    def known_layout(self) -> ResidualDefinition:
        """The layout; of a model without one, from the sensors of its effects."""
        return self.layout or ResidualDefinition.of_sensors(entry.sensor for entry in self.effects)

    @property
    def taken_tables(self) -> list[int]:
        """Ids in the catalog of the tables that parameters of time ``table`` have the values of."""
        tables = [timed.table for entry in self.effects for timed in entry.tables.values()]
        return sorted({int(one.attrs["id"]) for one in tables if one is not None and one.attrs["id"]})

    def with_tables(self, find: Callable[[str], xr.Dataset | None]) -> Model:
        """Return a model whose parameters of time ``table`` have the values of stored tables.

        Parameters
        ----------
        find : callable
            Returns a table by the name that the model states, None where there is none.

        Raises
        ------
        ModelError
            When a table is of another form or unit.
        """
        if not any(entry.tables for entry in self.effects):
            return self
        return replace(self, effects=tuple(entry.with_tables(find) for entry in self.effects))

    def correct(self, samples: xr.Dataset) -> xr.Dataset:
        """Take the effects out of the readings: see `inflight.model.apply.correct`."""
        return correct(self.effects, samples)

    def corrected(self, samples: xr.Dataset | PlainSamples) -> PlainSamples:
        """Take the effects out of the readings, as plain variables: see `model.apply.correct_plain`."""
        return correct_plain(self.effects, samples)

    def disturb(self, samples: xr.Dataset) -> xr.Dataset:
        """Put the effects into true fields: the exact inverse of `correct`."""
        return disturb(self.effects, samples)

    def residual(self, samples: xr.Dataset) -> Floats:
        """Return the residual of the corrected samples, (time, row) nT: see `inflight.model.rows.rows_of`."""
        return rows_of(self, samples).residual

    def correction_terms(self, samples: xr.Dataset) -> dict[str, Floats]:
        """Return what each additive effect subtracts: see `inflight.model.apply.correction_terms`."""
        return correction_terms(self.effects, samples)

    def before_corrections(self, samples: xr.Dataset, terms: Mapping[str, Floats]) -> Floats | None:
        """Return the field with these terms still in: see `inflight.model.apply.before_corrections`."""
        return before_corrections(self.effects, samples, terms)

    def changes(self, other: Model) -> list[dict[str, Any]]:
        """Return what `other` changes of this model: see `inflight.model.diff.changes`."""
        return changes(*([entry.as_yaml() for entry in model.effects] for model in (self, other)))

    def diff(self, other: Model) -> list[str]:
        """Return, as sentences, what `other` has that this model has not, and the other way round."""
        return [str(change["sentence"]) for change in self.changes(other)]


def _parse_effects(
    entries: Sequence[Any],
    sensors: Mapping[str, Sensor],
    source: str,
    own: tuple[EffectSource, ...],
    mission: Mission,
) -> tuple[ModelEffect, ...]:
    effects = []
    for index, entry in enumerate(entries):
        try:
            effects.append(make_effect(entry, sensors, own, mission))
            effects[-1].effect.require_complete()
        except InflightError as error:
            place = f"{source}: effect {index + 1}" if error.file == "" else f"{source}: {error.file}"
            raise ModelError(error.message, file=place, channel=error.channel, remedy=error.remedy) from None
    names = [entry.name for entry in effects]
    if len(set(names)) != len(names):
        raise ModelError(
            f"effects have the same name: {', '.join(names)}", file=source, remedy="give 'name' to one"
        )
    return tuple(effects)
