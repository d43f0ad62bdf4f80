"""One effect in a model: the cause, the sensor it acts on, and its values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects import Effect, EffectSource, effect_class
from inflight.effects.base import Parameter
from inflight.effects.coefficients import channel_unit, coefficient_unit, product_factor
from inflight.effects.families import family_of
from inflight.effects.naming import did_you_mean
from inflight.errors import ModelError
from inflight.model.timed import TimedValue, parse_timed
from inflight.sensors import Sensor

if TYPE_CHECKING:
    from inflight.mission import Mission


@dataclass(frozen=True)
class ModelEffect:
    """One effect of a model: the cause, the sensor it acts on, and its values."""

    effect: Effect
    sensor: Sensor
    parameters: Mapping[str, TimedValue]

    @property
    def name(self) -> str:
        """Name in the model."""
        return self.effect.name

    @property
    def is_additive(self) -> bool:
        """True when at its sensor it only adds a field that does not depend on the sensor's reading."""
        follows = self.effect.follows_field and type(self.effect).correct is Effect.correct
        return self.effect.is_additive or (follows and self.sensor.is_scalar)

    def values(self, tt2000: npt.ArrayLike) -> dict[str, Floats]:
        """Return every parameter's value at a time, or at times."""
        return {name: timed.at(tt2000) for name, timed in self.parameters.items()}

    def with_parameters(self, parameters: Mapping[str, TimedValue]) -> ModelEffect:
        """Return a copy with other values."""
        return replace(self, parameters=dict(parameters))

    def with_columns(self, value: Mapping[str, float], sigma: Mapping[str, float]) -> ModelEffect:
        """Return a copy with new values of named columns; itself when none of them is here."""
        named = value.keys() | sigma.keys()
        if not any(named & set(timed.columns) for timed in self.parameters.values()):
            return self
        return self.with_parameters(
            {key: timed.with_columns(value, sigma) for key, timed in self.parameters.items()}
        )

    def as_yaml(self) -> dict[str, Any]:
        """Return the entry of the model YAML."""
        entry: dict[str, Any] = {"effect": self.effect.label()}
        if self.effect.source is not None:
            entry["source"] = self.effect.source.sha
        if self.effect.name != self.effect.label():
            entry["name"] = self.effect.name
        return (
            entry
            | self.effect.given
            | {"sensor": self.sensor.name}
            | {name: timed.as_yaml() for name, timed in self.parameters.items()}
        )


def make_effect(
    entry: Mapping[str, Any],
    sensors: Mapping[str, Sensor],
    own: Iterable[EffectSource] = (),
    mission: Mission | None = None,
) -> ModelEffect:
    """Make an effect from one entry of the model YAML.

    A key ``source`` is what `ModelEffect.as_yaml` wrote of the user's file; it is not looked at, since
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
    sensor = _sensor(kind, given.pop("sensor", None), sensors)
    # What is no parameter of the class is an option: the effect itself knows which there are.
    options = {key: given.pop(key) for key in list(given) if key not in kind.parameters()}
    effect = kind(name, **options)
    timed = {
        key: _timed(effect, key, parameter, given.get(key), mission)
        for key, parameter in effect.parameters().items()
    }
    effect.units = {key: value.parameter.unit for key, value in timed.items()}
    if mission is not None:
        effect.family = family_of(effect, mission)
    return ModelEffect(effect, sensor, timed)


def _sensor(kind: type[Effect], named: Any, sensors: Mapping[str, Sensor]) -> Sensor:
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


def _timed(effect: Effect, key: str, parameter: Parameter, given: Any, mission: Mission | None) -> TimedValue:
    """Return a parameter's value in the unit the entry states, or the one its channel gives it."""
    stated = given.get("unit") if isinstance(given, Mapping) else None
    full = f"{effect.name}.{key}"
    if parameter.per_channel:
        channel = effect.channels[0]
        if stated is not None:
            unit = _checked(full, str(stated), parameter, channel, mission)
        else:
            unit = coefficient_unit(parameter, mission, channel) if mission else parameter.unit
        parameter = replace(parameter, unit=unit)
    return parse_timed(full, parameter, given, mission.events if mission else ())


def _checked(key: str, stated: str, parameter: Parameter, channel: str, mission: Mission | None) -> str:
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
