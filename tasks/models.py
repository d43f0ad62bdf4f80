"""Which model a workspace uses: the newest in the catalog, begun from the mission's pre-flight file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from inflight.catalog import Catalog
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.model import Model, make_effect
from inflight.sensors import sensors_of


@dataclass(frozen=True)
class UsedModel:
    """A model with the version the catalog knows it by."""

    model: Model
    version: int
    text: str


def preflight_model(cat: Catalog, mission: Mission, comparison: str = "main") -> Model:
    """Return the mission's pre-flight model, or nine parameters of an ideal sensor when it has none.

    Raises
    ------
    MissionError
        When the file the mission names is not in the workspace.
    ModelError
        When it is wrong.
    """
    if mission.preflight is None:
        return ideal_model(mission, comparison)
    path = Path(cat.workspace) / mission.preflight
    if not path.is_file():
        raise MissionError(
            f"preflight: there is no file {mission.preflight!r}",
            file="mission.yaml",
            remedy="put it there, or leave the key out to start from an ideal sensor",
        )
    return Model.parse(path.read_text(encoding="utf-8"), mission, mission.preflight)


def ideal_model(mission: Mission, comparison: str = "main") -> Model:
    """Return a model of an ideal vector sensor with the effect's own wide priors."""
    sensors = sensors_of(mission, comparison)
    vector = next(sensor for sensor in sensors.values() if sensor.role == "vector")
    parts = {part: {"time": "block"} for part in ("scale_factor", "misalignment", "offset")}
    entry = {"effect": "vector_sensor", "sensor": vector.name, **parts}
    return Model(f"{mission.mission}-ideal", mission.mission, comparison, (make_effect(entry, sensors),))


def current_model(cat: Catalog, mission: Mission, comparison: str = "main") -> UsedModel:
    """Return the model to use: the newest version, after taking in a pre-flight file that changed.

    The pre-flight file is the root of the model's history, and each text of it a root of its own: an
    old text put back is the old model again.
    """
    if mission.effects:
        raise MissionError(
            f"effects: files are not read yet, found {', '.join(mission.effects)}",
            file="mission.yaml",
            remedy="offer the effects as a package, through the entry point group inflight.effects",
        )
    start = preflight_model(cat, mission, comparison)
    version = cat.save_model(start.name, start.text, message="pre-flight model")
    newest = version
    for record in cat.models():
        # What was made from the file's text, step by step, goes before it; other texts of the file do not.
        if record.name == start.name and record.parent == newest:
            newest = record.version
    name, version, text = cat.model_text(start.name, newest)
    return UsedModel(Model.parse(text, mission, f"{name} version {version}"), version, text)
