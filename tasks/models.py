"""Models, versions, history.

Which model a workspace uses: the newest in the catalog, begun from the mission's pre-flight file.

The versions of a workspace's models: found by name, listed with the one in use.

The history of a model: which version its evidence was made at, and which one came before the last change.

History only grows. Going back is a version like any other, whose text is an older one's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inflight.catalog import Catalog, ModelRecord
from inflight.effects import EffectSource, SpinningSensor, did_you_mean
from inflight.errors import CatalogError, MissionError, ModelError, SettingsError
from inflight.mission import Mission, sensors_of
from inflight.model import Layout, Model, make_effect

#: What a model's text says of the files its effects come from.
_SOURCE = re.compile(r"^\s*source: (\S+)\n", re.MULTILINE)

#: What is free of an ideal vector sensor, by what it is held against: its effect and parameters.
_FREE: dict[str, tuple[str, tuple[str, ...]]] = {
    "scalar": ("vector_sensor", ("scale_factor", "misalignment", "offset")),
    "spin": ("spinning_sensor", tuple(SpinningSensor.SPIN_RELATED)),
}


@dataclass(frozen=True)
class VersionedModel:
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
    if layout.kind not in _FREE:
        return Model(name, mission.mission, comparison, (), layout=layout, own=own)
    sensors = sensors_of(mission, comparison)
    vector = next(sensor for sensor in sensors.values() if sensor.role == "vector")
    kind, names = _FREE[layout.kind]
    parts = {part: {"time": "block"} for part in names}
    entry = {"effect": kind, "sensor": vector.name, **parts}
    effects = (make_effect(entry, sensors, mission=mission),)
    return Model(name, mission.mission, comparison, effects, layout=layout, own=own)


def current_model(cat: Catalog, mission: Mission, comparison: str = "main") -> VersionedModel:
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
        return VersionedModel(
            found.model, cat.save_model(found.model.name, text, message="pre-flight model"), text
        )
    files = ", ".join(mission.effects)
    version = cat.save_model(found.model.name, text, parent=found.version, message=f"{files} changed")
    return VersionedModel(found.model, version, text)


def find_model(cat: Catalog, mission: Mission, comparison: str = "main") -> VersionedModel:
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
        return VersionedModel(start, 0, start.text)
    text = _text(cat, start.name, newest)
    return VersionedModel(
        Model.parse(text, mission, f"{start.name} version {newest}", start.own), newest, text
    )


def _text(cat: Catalog, name: str, version: int) -> str:
    return cat.model_text(name, version)[2]


def _sources(text: str) -> list[str]:
    return _SOURCE.findall(text)


def comparison_of(mission: Mission, named: str | None) -> str:
    """Return the comparison that is named, else ``main``, else the mission's first.

    Raises
    ------
    SettingsError
        When the mission has no such comparison.
    """
    name = named or ("main" if "main" in mission.comparisons else next(iter(mission.comparisons), "main"))
    if name not in mission.comparisons:
        raise SettingsError(
            f"comparison: the mission has no {name!r}{did_you_mean(name, mission.comparisons)}",
            remedy=f"it has {', '.join(mission.comparisons) or 'none'}",
        )
    return name


@dataclass(frozen=True)
class ModelVersion:
    """A text of a model, and what the catalog knows of it."""

    name: str
    version: int
    text: str
    record: ModelRecord | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """Name, version and parent; version and parent are None for a model not used yet."""
        parent = self.record.parent if self.record else None
        return {"name": self.name, "version": self.version or None, "parent": parent}

    @property
    def told(self) -> str:
        """How a person calls it."""
        return f"{self.name} version {self.version}" if self.version else f"{self.name}, not used yet"


class ModelHistory:
    """The models of a workspace; nothing is saved by looking at them."""

    def __init__(self, cat: Catalog, mission: Mission, comparison: str = "main") -> None:
        self._cat = cat
        used = find_model(cat, mission, comparison)
        self._records = {(record.name, record.version): record for record in self._cat.models()}
        self.used = self._version(used.model.name, used.version, used.text)

    def _version(self, name: str, version: int, text: str) -> ModelVersion:
        return ModelVersion(name, version, text, self._records.get((name, version)))

    def named(self, text: str | None) -> ModelVersion:
        """Return the version a person names: its number, a name's newest, or ``name:number``."""
        if text is None:
            return self.used
        name, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        if not number.isdigit():
            name, number = text, ""
        name = name or self.used.name
        known = [key for key in self._records if key[0] == name and number in ("", str(key[1]))]
        if not known:
            listed = [f"{one}:{version}" for one, version in self._records]
            names = [one for one, _ in self._records]
            raise CatalogError(
                f"there is no model {text!r}{did_you_mean(text, [*listed, *names])}",
                remedy=f"the catalog has {', '.join(listed) or 'none yet; reprocess saves the first'}",
            )
        return self._version(*self._cat.model_text(*known[-1]))

    def items(self) -> list[dict[str, Any]]:
        """Return every version, oldest first, with a mark at the one in use."""
        return [
            {
                "name": record.name,
                "version": record.version,
                "parent": record.parent,
                "message": record.message,
                "created": record.created,
                "sha256": record.sha256,
                "used": key == (self.used.name, self.used.version),
            }
            for key, record in self._records.items()
        ]


#: How the message of a version begins that is an older one again.
UNDO = "undo"


def version_of(cat: Catalog, mission: Mission, like: VersionedModel, version: int) -> VersionedModel:
    """Return another version of a model, made with the effects' files as they are now."""
    name = like.model.name
    text = cat.model_text(name, version)[2]
    return VersionedModel(
        Model.parse(text, mission, f"{name} version {version}", like.model.own), version, text
    )


def version_with_gram_blocks(
    cat: Catalog, mission: Mission, current: VersionedModel
) -> tuple[VersionedModel, Mission] | None:
    """Return the nearest version with evidence, the present one or one it came from, and its mission.

    The mission is the text the evidence was made with: naming another file with effects changes
    nothing of what was made before. None when no version has evidence.
    """
    dataset = f"equations/{current.model.comparison}/library"
    contexts = {day.context for day in cat.days(dataset, states=("published",))} - {None}
    versions = {}
    for record in (cat.context(str(one)) for one in contexts):
        before = mission if record.mission_text == mission.text else Mission.parse(record.mission_text)
        if record.model_name == current.model.name and _measures_as(before, mission):
            versions[record.model_version] = before
    records = _records(cat, current)
    at: int | None = current.version
    while at is not None:
        if at in versions:
            used = current if at == current.version else version_of(cat, mission, current, at)
            return used, versions[at]
        at = records[at].parent
    return None


def _measures_as(one: Mission, other: Mission) -> bool:
    """Return True when two missions differ in nothing but words and the files of a user's own effects."""
    words = {"effects", "description", "acknowledgement"}
    return one is other or one.model_dump(exclude=words) == other.model_dump(exclude=words)


def version_before_change(cat: Catalog, mission: Mission, current: VersionedModel) -> VersionedModel:
    """Return the version before the last change; one that was taken back does not count.

    Raises
    ------
    ModelError
        When nothing was changed.
    """
    records = _records(cat, current)
    parent = _before(records, current.version)
    if parent is None:
        raise ModelError(
            f"version {current.version} of model '{current.model.name}' is where it began",
            remedy="'inflight model history' lists the versions; there is nothing to take back",
        )
    return version_of(cat, mission, current, parent)


def _before(records: dict[int, ModelRecord], version: int) -> int | None:
    return records[_meant(records, version)].parent


def _meant(records: dict[int, ModelRecord], version: int) -> int:
    """Return the version that a version is again: itself, unless it takes something back."""
    record = records[version]
    if record.parent is None or not record.message.startswith(UNDO):
        return version
    found = _before(records, record.parent)
    if found is None:
        raise CatalogError(
            f"version {version} takes back version {record.parent}, before which there is none",
            remedy="the history of the model is damaged: 'inflight catalog verify'",
        )
    return _meant(records, found)


def _records(cat: Catalog, current: VersionedModel) -> dict[int, ModelRecord]:
    return {one.version: one for one in cat.models() if one.name == current.model.name}
