"""The model as a value: read from YAML, immutable, hashed; effects are added and dropped by copies."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy.typing as npt
import xarray as xr
from ruamel.yaml import YAML

from inflight.arrays import Floats
from inflight.comparison import Layout, rows_of
from inflight.effects import Effect, effect_class
from inflight.errors import InflightError, ModelError
from inflight.model import chain
from inflight.model.timed import TimedValue, parse_timed
from inflight.sensors import Sensor, sensors_of

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

    def values(self, tt2000: npt.ArrayLike) -> dict[str, Floats]:
        """Return every parameter's value at a time, or at times."""
        return {name: timed.at(tt2000) for name, timed in self.parameters.items()}

    def as_yaml(self) -> dict[str, Any]:
        """Return the entry of the model YAML."""
        entry: dict[str, Any] = {"effect": type(self.effect).label()}
        if self.effect.name != type(self.effect).label():
            entry["name"] = self.effect.name
        return (
            entry
            | self.effect.given
            | {"sensor": self.sensor.name}
            | {name: timed.as_yaml() for name, timed in self.parameters.items()}
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
        Kind and sensors of the comparison; a model without one knows the sensors its effects act on.
    """

    name: str
    mission: str
    comparison: str
    effects: tuple[ModelEffect, ...]
    version: int = 0
    parent: int | None = None
    layout: Layout | None = None

    @classmethod
    def parse(cls, text: str, mission: Mission, source: str = "model.yaml") -> Model:
        """Read a model from YAML text; sensors and positions come from the mission.

        Raises
        ------
        ModelError
            Naming `source` and the effect that is wrong.
        """
        tree = YAML(typ="safe").load(text)
        if not isinstance(tree, dict) or "effects" not in tree:
            raise ModelError(
                "the file holds no list 'effects'",
                file=source,
                remedy="missions/models/champ-preflight.yaml shows one",
            )
        comparison = str(tree.get("comparison", "main"))
        if comparison not in mission.comparisons:
            raise ModelError(
                f"mission '{mission.mission}' has no comparison {comparison!r}",
                file=source,
                remedy=f"one of {', '.join(mission.comparisons)}",
            )
        sensors = sensors_of(mission, comparison)
        effects = tuple(
            _parse_effect(entry, sensors, f"{source}: effect {index + 1}")
            for index, entry in enumerate(tree["effects"])
        )
        names = [entry.name for entry in effects]
        if len(set(names)) != len(names):
            raise ModelError(
                f"effects have the same name: {', '.join(names)}", file=source, remedy="give 'name' to one"
            )
        return cls(
            str(tree.get("model", mission.mission)),
            mission.mission,
            comparison,
            effects,
            int(tree.get("version", 0)),
            tree.get("parent"),
            Layout.of(mission, comparison),
        )

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

    def add(self, effect: ModelEffect, before: str | None = None) -> Model:
        """Return a model with one more effect, at the end or before a named one."""
        names = [entry.name for entry in self.effects]
        if effect.name in names:
            raise ModelError(
                f"there is an effect {effect.name!r} already", remedy="give the new one a 'name'"
            )
        index = names.index(self.effect(before).name) if before else len(names)
        return replace(self, effects=(*self.effects[:index], effect, *self.effects[index:]))

    def drop(self, name: str) -> Model:
        """Return a model without an effect."""
        gone = self.effect(name)
        return replace(self, effects=tuple(entry for entry in self.effects if entry is not gone))

    def bind(self, table: xr.Dataset) -> Model:
        """Return a model whose block parameters take their values from a calibration table."""
        return replace(
            self,
            effects=tuple(
                replace(entry, parameters={k: v.bind(table) for k, v in entry.parameters.items()})
                for entry in self.effects
            ),
        )

    def correct(self, samples: xr.Dataset) -> xr.Dataset:
        """Take the effects out of the readings: see `inflight.model.chain.correct`."""
        return chain.correct(self.effects, samples)

    def disturb(self, samples: xr.Dataset) -> xr.Dataset:
        """Put the effects into true fields: the exact inverse of `correct`."""
        return chain.disturb(self.effects, samples)

    def residual(self, samples: xr.Dataset) -> Floats:
        """Return the residual of the corrected samples, (time, row) nT: see `inflight.comparison.rows_of`."""
        return rows_of(self, samples).residual

    def correction_terms(self, samples: xr.Dataset) -> dict[str, Floats]:
        """Return what each additive effect takes out: see `inflight.model.chain.correction_terms`."""
        return chain.correction_terms(self.effects, samples)

    def diff(self, other: Model) -> list[str]:
        """Return, as sentences, what `other` has that this model has not, and the other way round."""
        mine = {entry.name: entry.as_yaml() for entry in self.effects}
        theirs = {entry.name: entry.as_yaml() for entry in other.effects}
        return (
            [f"added {name}" for name in theirs if name not in mine]
            + [f"dropped {name}" for name in mine if name not in theirs]
            + [
                f"changed {name}.{key}: {mine[name].get(key)} -> {theirs[name].get(key)}"
                for name in mine
                if name in theirs
                for key in sorted(set(mine[name]) | set(theirs[name]))
                if mine[name].get(key) != theirs[name].get(key)
            ]
        )


def make_effect(entry: Mapping[str, Any], sensors: Mapping[str, Sensor]) -> ModelEffect:
    """Make an effect from one entry of the model YAML.

    Raises
    ------
    ModelError
        When effect, sensor, option or parameter is unknown.
    """
    given = dict(entry)
    kind = effect_class(str(given.pop("effect", "")))
    name = str(given.pop("name", ""))
    sensor_name = str(given.pop("sensor", next(iter(sensors))))
    if sensor_name not in sensors:
        raise ModelError(
            f"effect '{kind.label()}' acts on {sensor_name!r}, which the comparison has not",
            remedy=f"its sensors are {', '.join(sensors)}",
        )
    parameters = kind.parameters()
    options = {key: given.pop(key) for key in list(given) if key not in parameters}
    effect = kind(name, **options)
    timed = {
        key: parse_timed(f"{effect.name}.{key}", parameter, given.get(key))
        for key, parameter in parameters.items()
    }
    return ModelEffect(effect, sensors[sensor_name], timed)


def _parse_effect(entry: Any, sensors: Mapping[str, Sensor], place: str) -> ModelEffect:
    try:
        return make_effect(entry, sensors)
    except InflightError as error:
        raise ModelError(error.message, file=place, remedy=error.remedy) from None
