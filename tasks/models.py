"""The model that a workspace uses, and its history in the catalog.

`current_model` returns the newest version; the first is the mission's pre-flight file, and a changed file
with effects makes another. `ModelHistory` lists versions and finds one by name. History only grows: an undo
is a version like any other, whose text is that of an older one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from inflight.catalog import Catalog, ModelRecord, TableRecord
from inflight.effects import EffectSource, SpinningSensor
from inflight.errors import CatalogError, MissionError, ModelError, SettingsError, did_you_mean
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ResidualDefinition, make_effect

if TYPE_CHECKING:
    import xarray as xr

#: Where the text of a model states the files its effects come from.
_SOURCE = re.compile(r"^\s*source: (\S+)\n", re.MULTILINE)

#: Free parameters of an ideal vector sensor, by the kind of comparison: its effect and their names.
_FREE: dict[str, tuple[str, tuple[str, ...]]] = {
    "scalar": ("vector_sensor", ("scale_factor", "misalignment", "offset")),
    "spin": ("spinning_sensor", tuple(SpinningSensor.SPIN_RELATED)),
    "field_model": ("affine", ("matrix", "shift")),
}


@dataclass(frozen=True)
class VersionedModel:
    """A model with the version the catalog knows it by; 0 before it is saved."""

    model: Model
    version: int
    text: str


def model_label(name: str, version: int) -> str:
    """Return how a person and a product's header name a version of a model."""
    return f"{name} version {version}" if version else f"{name}, not used yet"


def effect_sources(cat: Catalog, mission: Mission) -> tuple[EffectSource, ...]:
    """Return the files with effects that the mission names, read from the workspace.

    Raises
    ------
    MissionError
        When a file is not there, or is no text.
    """
    sources = []
    for name in mission.effects:
        try:
            sources.append(EffectSource(name, (Path(cat.workspace) / name).read_text(encoding="utf-8")))
        except (OSError, UnicodeDecodeError) as error:
            fault = "is no text" if isinstance(error, UnicodeDecodeError) else "is not there"
            raise MissionError(
                f"effects: the file {name!r} {fault}",
                file="mission.yaml",
                remedy="put it into the workspace, or take its name out of 'effects'",
            ) from None
    return tuple(sources)


def find_table(cat: Catalog, named: str) -> TableRecord:
    """Return the record of a table ``main-span:12``, or the newest one called ``main-span``.

    In place of the number stands the key, or its first digits, that the header of a product has.

    Raises
    ------
    CatalogError
        When there is none, or it is damaged.
    """
    name, _, number = named.partition(":")
    records = cat.tables(name)
    known = [
        one
        for one in records
        if (number in ("", str(one.id)) or (len(number) > 7 and one.key.startswith(number)))
        and not one.damaged
    ]
    if not known:
        numbers = ", ".join(f"{name}:{one.id}" for one in records)
        names = sorted({one.name for one in cat.tables()})
        raise CatalogError(
            f"there is no whole table {named!r}{did_you_mean(name, names)}",
            remedy=f"the catalog has {numbers or ', '.join(names) or 'none yet'}",
        )
    return known[-1]


def parse_model(
    cat: Catalog, text: str, mission: Mission, source: str, own: tuple[EffectSource, ...] = ()
) -> Model:
    """Return a model from its text, with the values of the tables of the catalog that it names.

    A table that is not there is missed when its values are used.

    Raises
    ------
    ModelError
        As `Model.parse`, and when a table is of another form.
    """
    return Model.parse(text, mission, source, own).with_tables(partial(stored_table, cat))


def stored_table(cat: Catalog, named: str) -> xr.Dataset | None:
    """Return a table by the name that `find_table` takes; None where there is none."""
    try:
        record = find_table(cat, named)
    except CatalogError:
        return None
    return cat.table_by_id(record.id).assign_attrs(id=record.id)


def preflight_model(cat: Catalog, mission: Mission, comparison: str = "main") -> Model:
    """Return a comparison's pre-flight model, or that of ideal sensors when it has none.

    The comparison's own file has priority over the mission's, which is for the comparison that it names.

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
    model = parse_model(cat, path.read_text(encoding="utf-8"), mission, name, own)
    if stated and model.comparison != comparison:
        raise MissionError(
            f"{key}: {name!r} is a model of comparison '{model.comparison}'",
            file="mission.yaml",
            remedy=f"write 'comparison: {comparison}' into the model, or name another file",
        )
    return model if model.comparison == comparison else ideal_model(mission, comparison, own)


def ideal_model(mission: Mission, comparison: str = "main", own: tuple[EffectSource, ...] = ()) -> Model:
    """Return a model of ideal sensors.

    Against a scalar sensor the vector sensor's nine parameters are free, against a field model matrix and
    shift, in a spin comparison the eight that the spin determines, with the effect's own wide priors; else
    readings are taken as delivered.
    """
    name, layout = f"{mission.mission}-ideal", ResidualDefinition.of(mission, comparison)
    if layout.kind not in _FREE:
        return Model(name, mission.mission, comparison, (), layout=layout, own=own)
    sensors = sensors_of(mission, comparison)
    vector = next(sensor for sensor in sensors.values() if sensor.role == "vector")
    kind, names = _FREE[layout.kind]
    entry = {"effect": kind, "sensor": vector.name, **{part: {"time": "block"} for part in names}}
    effects = (make_effect(entry, sensors, mission=mission),)
    return Model(name, mission.mission, comparison, effects, layout=layout, own=own)


def current_model(cat: Catalog, mission: Mission, comparison: str = "main") -> VersionedModel:
    """Return the model to use: the newest version, after taking in files that changed.

    The pre-flight file is the root of the model's history, and each text of it a root of its own: an
    old text put back is the old model again. A file with effects that changed is a step in that
    history: the newest version, with the effects of the file as it is now.
    """
    found = find_model(cat, mission, comparison)
    text = found.model.text
    if not found.version:
        version = cat.save_model(found.model.name, text, message="pre-flight model")
    elif _SOURCE.findall(text) != _SOURCE.findall(found.text):
        message = f"{', '.join(mission.effects)} changed"
        version = cat.save_model(found.model.name, text, parent=found.version, message=message)
    else:
        return found
    return VersionedModel(found.model, version, text)


def find_model(cat: Catalog, mission: Mission, comparison: str = "main") -> VersionedModel:
    """Return the newest version as the catalog has it, made with the effects' files as they are now.

    Nothing is saved. Version 0 is a pre-flight model the catalog does not know yet.
    """
    start = preflight_model(cat, mission, comparison)
    plain, newest = _SOURCE.sub("", start.text), 0
    for record in cat.models():
        if record.name != start.name:
            continue
        # What was made from the file's present text, step by step; other texts of the file do not count.
        if record.parent is None:
            text = cat.model_text(record.name, record.version)[2]
            follows = _SOURCE.sub("", text) == plain
        else:
            follows = record.parent == newest
        if follows:
            newest = record.version
    unsaved = VersionedModel(start, 0, start.text)
    return version_of(cat, mission, start.name, newest, start.own) if newest else unsaved


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
class HistoryEntry:
    """A version of a model: its text, and its record in the catalog; none for a model not used yet."""

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
    def label(self) -> str:
        """Name and version in words."""
        return model_label(self.name, self.version)


class ModelHistory:
    """The models of a workspace, read from the catalog; nothing is saved."""

    def __init__(self, cat: Catalog, mission: Mission, comparison: str = "main") -> None:
        self._cat, self._mission = cat, mission
        used = find_model(cat, mission, comparison)
        self._used = used.model
        self._records = {(record.name, record.version): record for record in self._cat.models()}
        self.used = self._version(used.model.name, used.version, used.text)

    def _version(self, name: str, version: int, text: str) -> HistoryEntry:
        return HistoryEntry(name, version, text, self._records.get((name, version)))

    def find(self, text: str | None) -> HistoryEntry:
        """Return a version by number, by name (the newest) or as ``name:number``; None is the one in use.

        Raises
        ------
        CatalogError
            When there is none.
        """
        if text is None:
            return self.used
        name, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        if not number.isdigit():
            name, number = text, ""
        name = name or self.used.name
        known = [key for key in self._records if key[0] == name and number in ("", str(key[1]))]
        if not known:
            listed = [f"{model}:{version}" for model, version in self._records]
            names = [model for model, _ in self._records]
            raise CatalogError(
                f"there is no model {text!r}{did_you_mean(text, [*listed, *names])}",
                remedy=f"the catalog has {', '.join(listed) or 'none yet; reprocess saves the first'}",
            )
        return self._version(*self._cat.model_text(*known[-1]))

    def model(self, entry: HistoryEntry) -> Model:
        """Return the model of a version, with the effects' files as they are now."""
        if not entry.version:
            return self._used
        return version_of(self._cat, self._mission, entry.name, entry.version, self._used.own).model

    def same(self, one: int | None, other: int | None) -> bool:
        """Return True for two versions of the model in use with one text: an undo has an older one's."""
        name = self.used.name
        first, second = (self._records.get((name, version or 0)) for version in (one, other))
        if first is None or second is None:
            return one == other
        return first.sha256 == second.sha256

    def stale_contexts(self, made: Iterable[str | None]) -> set[str]:
        """Return those of some contexts that have another model than the one in use."""
        contexts = {name: self._cat.context(name) for name in set(made) if name}
        return {
            name
            for name, made in contexts.items()
            if made.model_name != self.used.name or not self.same(made.model_version, self.used.version)
        }

    def items(self) -> list[dict[str, Any]]:
        """Return every version, oldest first, with a mark at the one in use.

        One model has one residual: what a version leaves is what the last change that began with it measured,
        with equations about its own numbers, where there is one.
        """
        last: dict[str, dict[str, Any]] = {}
        for record in self._records.values():
            before = self._records.get((record.name, record.parent or 0))
            about = self._records.get((record.name, (record.change or {}).get("about", 0)))
            if record.change and before and about and before.sha256 == about.sha256:
                last[before.sha256] = record.change

        def change_of(record: ModelRecord) -> dict[str, Any] | None:
            if not record.change:
                return record.change
            measured = last.get(record.sha256) or {}
            own = {
                key: [both[0], measured[key][0] if key in measured else both[1]]
                for key, both in record.change.items()
                if isinstance(both, list)
            }
            return {**record.change, **own}

        return [
            {
                "name": record.name,
                "version": record.version,
                "parent": record.parent,
                "message": record.message,
                "created": record.created,
                "change": change_of(record),
                "sha256": record.sha256,
                "used": key == (self.used.name, self.used.version),
            }
            for key, record in self._records.items()
        ]


#: Beginning of the message of a version that undoes another.
UNDO = "undo"
#: Of one whose own numbers were fitted anew: Gram blocks of the versions before hold them where they were.
REFIT = "refit"
#: Of one in which numbers were set that its effects depend on not only in proportion.
SET = "set"
#: Of one that takes values over time from a stored table.
TAKE = "take"


def version_of(
    cat: Catalog, mission: Mission, name: str, version: int, own: tuple[EffectSource, ...]
) -> VersionedModel:
    """Return a version of a model, made with some files' effects: those as they are now, usually."""
    text = cat.model_text(name, version)[2]
    return VersionedModel(parse_model(cat, text, mission, model_label(name, version), own), version, text)


def as_first_saved(cat: Catalog, used: VersionedModel) -> VersionedModel:
    """Return a model as the first version with its text: what an undo went back to has products already."""
    records = {one.version: one for one in cat.models() if one.name == used.model.name}
    sha256 = records[used.version].sha256
    return replace(used, version=min(one.version for one in records.values() if one.sha256 == sha256))


def version_as_it_was(cat: Catalog, mission: Mission, name: str, version: int) -> VersionedModel:
    """Return a version of a model; its own effects' files must not have changed since.

    Raises
    ------
    CatalogError
        When they have.
    """
    found = version_of(cat, mission, name, version, effect_sources(cat, mission))
    record = next(one for one in cat.models() if (one.name, one.version) == (name, version))
    if found.model.sha != record.sha256:
        raise CatalogError(
            f"{model_label(name, version)} cannot be read as it was: a file with effects changed since",
            remedy=f"put back the old text of {', '.join(mission.effects) or 'its effects'}",
        )
    return found


def preflight_of(cat: Catalog, mission: Mission, name: str, version: int) -> Model:
    """Return the model that the history of a version began with: that from before flight."""
    parents = {one.version: one.parent for one in cat.models() if one.name == name}
    while (before := parents[version]) is not None:
        version = before
    return version_as_it_was(cat, mission, name, version).model


def version_with_gram_blocks(
    cat: Catalog, mission: Mission, current: VersionedModel
) -> tuple[VersionedModel, Mission] | None:
    """Return the nearest version with Gram blocks, the present one or an ancestor, and its mission.

    The mission is the text that the blocks were made with: naming another file with effects changes nothing
    of what was made before. None when no version has Gram blocks.
    """
    dataset = f"equations/{current.model.comparison}/library"
    contexts = {day.context for day in cat.days(dataset, states=("published",))} - {None}
    words = {"effects", "description", "acknowledgement", "release"}
    records = _records(cat, current)
    versions: dict[int, tuple[int, Mission]] = {}
    for record in (cat.context(str(context)) for context in contexts):
        before = mission if record.mission_text == mission.text else Mission.parse(record.mission_text)
        # Missions that differ only in words and in the files of a user's own effects measure the same.
        same = before is mission or before.model_dump(exclude=words) == mission.model_dump(exclude=words)
        if record.model_name == current.model.name and same and record.model_version in records:
            # An undo is the version it went back to, with whose blocks numbers are where it has them.
            versions[_without_undo(records, record.model_version)] = record.model_version, before
    version: int | None = _without_undo(records, current.version)
    while version is not None and version not in versions:
        record_of = records[version]
        refitted = record_of.message.startswith((REFIT, SET, TAKE)) or record_of.parent is None
        version = None if refitted else _without_undo(records, int(str(record_of.parent)))
    if version is None:
        return None
    made_at, measured = versions[version]
    used = (
        current
        if made_at == current.version
        else version_of(cat, mission, current.model.name, made_at, current.model.own)
    )
    return used, measured


def version_before_change(cat: Catalog, mission: Mission, current: VersionedModel) -> VersionedModel:
    """Return the version before the last change; a change that was undone does not count.

    Raises
    ------
    ModelError
        When nothing was changed.
    """
    records = _records(cat, current)
    parent = records[_without_undo(records, current.version)].parent
    if parent is None:
        raise ModelError(
            f"version {current.version} of model '{current.model.name}' is where it began",
            remedy="'inflight model history' lists the versions; there is nothing to take back",
        )
    return version_of(cat, mission, current.model.name, parent, current.model.own)


def _without_undo(records: dict[int, ModelRecord], version: int) -> int:
    """Return the version whose text a version has again: itself, unless it is an undo."""
    record = records[version]
    if record.parent is None or not record.message.startswith(UNDO):
        return version
    restored = records[_without_undo(records, record.parent)].parent
    if restored is None:
        raise CatalogError(
            f"version {version} takes back version {record.parent}, before which there is none",
            remedy="the history of the model is damaged: 'inflight catalog verify'",
        )
    return _without_undo(records, restored)


def _records(cat: Catalog, current: VersionedModel) -> dict[int, ModelRecord]:
    return {record.version: record for record in cat.models() if record.name == current.model.name}
