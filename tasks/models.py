"""Which model a workspace uses: the newest in the catalog, begun from the mission's pre-flight file."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from inflight.catalog import Catalog
from inflight.comparison import Layout
from inflight.effects import EffectSource
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.model import Model, make_effect
from inflight.sensors import sensors_of

#: What a model's text says of the files its effects come from.
_SOURCE = re.compile(r"^\s*source: (\S+)\n", re.MULTILINE)


@dataclass(frozen=True)
class UsedModel:
    """A model with the version the catalog knows it by; 0 before it is saved."""

    model: Model
    version: int
    text: str


def effect_sources(cat: Catalog, mission: Mission) -> tuple[EffectSource, ...]:
    """Return the files with effects that the mission names, read from the workspace.

    Raises
    ------
    MissionError
        When a file is not there, or is no text.
    """
    return tuple(_source(Path(cat.workspace), name) for name in mission.effects)


def _source(workspace: Path, name: str) -> EffectSource:
    try:
        return EffectSource(name, (workspace / name).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        told = "is no text" if isinstance(error, UnicodeDecodeError) else "is not there"
        raise MissionError(
            f"effects: the file {name!r} {told}",
            file="mission.yaml",
            remedy="put it into the workspace, or take its name out of 'effects'",
        ) from None


def preflight_model(cat: Catalog, mission: Mission, comparison: str = "main") -> Model:
    """Return a comparison's pre-flight model, or that of ideal sensors when it has none.

    Its own file goes before the mission's, which is for the comparison that file names.

    Raises
    ------
    MissionError
        When a file the mission names is not in the workspace.
    ModelError
        When it is wrong.
    """
    own = effect_sources(cat, mission)
    stated = mission.comparisons[comparison].preflight
    name = stated or mission.preflight
    if name is None:
        return ideal_model(mission, comparison, own)
    key = f"comparisons.{comparison}.preflight" if stated else "preflight"
    path = Path(cat.workspace) / name
    if not path.is_file():
        raise MissionError(
            f"{key}: there is no file {name!r}",
            file="mission.yaml",
            remedy="put it there, or leave the key out to start from an ideal sensor",
        )
    model = Model.parse(path.read_text(encoding="utf-8"), mission, name, own)
    if stated and model.comparison != comparison:
        raise MissionError(
            f"{key}: {name!r} is a model of comparison '{model.comparison}'",
            file="mission.yaml",
            remedy=f"write 'comparison: {comparison}' into the model, or name another file",
        )
    return model if model.comparison == comparison else ideal_model(mission, comparison, own)


def ideal_model(mission: Mission, comparison: str = "main", own: tuple[EffectSource, ...] = ()) -> Model:
    """Return a model of ideal sensors.

    Against a scalar sensor the vector sensor's nine parameters are free, in a spin comparison the eight
    that the spin tells, with the effect's own wide priors; else readings are taken as delivered.
    """
    name, layout = f"{mission.mission}-ideal", Layout.of(mission, comparison)
    if layout.kind not in ("scalar", "spin"):
        return Model(name, mission.mission, comparison, (), layout=layout, own=own)
    sensors = sensors_of(mission, comparison)
    vector = next(sensor for sensor in sensors.values() if sensor.role == "vector")
    names: tuple[str, ...] = ("scale_factor", "misalignment", "offset")
    kind = "vector_sensor"
    if layout.kind == "spin":
        kind, names = "spinning_sensor", tuple(SpinningSensor.SPIN_RELATED)
    parts = {part: {"time": "block"} for part in names}
    entry = {"effect": kind, "sensor": vector.name, **parts}
    effects = (make_effect(entry, sensors, mission=mission),)
    return Model(name, mission.mission, comparison, effects, layout=layout, own=own)


def current_model(cat: Catalog, mission: Mission, comparison: str = "main") -> UsedModel:
    """Return the model to use: the newest version, after taking in files that changed.

    The pre-flight file is the root of the model's history, and each text of it a root of its own: an
    old text put back is the old model again. A file with effects that changed is a step in that
    history: the newest version, with the effects of the file as it is now.
    """
    found = find_model(cat, mission, comparison)
    if found.version and _sources(found.model.text) == _sources(found.text):
        return found
    text = found.model.text
    if not found.version:
        return UsedModel(
            found.model, cat.save_model(found.model.name, text, message="pre-flight model"), text
        )
    files = ", ".join(mission.effects)
    version = cat.save_model(found.model.name, text, parent=found.version, message=f"{files} changed")
    return UsedModel(found.model, version, text)


def find_model(cat: Catalog, mission: Mission, comparison: str = "main") -> UsedModel:
    """Return the newest version as the catalog has it, made with the effects' files as they are now.

    Nothing is saved. Version 0 is a pre-flight model the catalog does not know yet.
    """
    start = preflight_model(cat, mission, comparison)
    records = [record for record in cat.models() if record.name == start.name]
    plain = _SOURCE.sub("", start.text)
    newest = 0
    for record in records:
        # What was made from the file's text, step by step, goes before it; other texts of the file do not.
        is_root = record.parent is None and _SOURCE.sub("", _text(cat, record.name, record.version)) == plain
        if is_root or (newest and record.parent == newest):
            newest = record.version
    if not newest:
        return UsedModel(start, 0, start.text)
    text = _text(cat, start.name, newest)
    return UsedModel(Model.parse(text, mission, f"{start.name} version {newest}", start.own), newest, text)


def _text(cat: Catalog, name: str, version: int) -> str:
    return cat.model_text(name, version)[2]


def _sources(text: str) -> list[str]:
    return _SOURCE.findall(text)
