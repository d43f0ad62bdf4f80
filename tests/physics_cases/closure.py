"""The project's chain on a case: the residual under the true model, with the truth as an effect if wished."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive import ArchiveIndex, load_samples, needs_of

from .orbiter.case import Case

#: Effect of the library and its parameter that says what a cause is, by the quantity of its coefficients.
SAID = {
    "coefficient": "channel_field",
    "play": "hysteresis",
    "matrix": "torquer",
    "linear": "temperature",
    "quadratic": "nonlinearity",
    "cubic": "nonlinearity",
    "bias": "scalar_bias",
    "lit": "day_night",
    "step": "offset_step",
    "misalignment": "angle_step",
    "eddy": "eddy",
}
#: Where the library calls a quantity otherwise.
PARAMETERS = {"lit": "vector", "step": "vector", "eddy": "diagonal", "misalignment": "change"}


def true_model(case: Case, mission: Mission, more: dict[str, Any] | None = None) -> Model:
    """Return the case's model with true values instead of the pre-flight ones, and one effect more."""
    tree = json.loads(json.dumps(case.model))
    for entry in tree["effects"]:
        if entry["effect"] == "vector_sensor":
            for part in ("scale_factor", "misalignment", "offset"):
                entry[part]["value"] = getattr(case.nine, part).tolist()
        for cause in case.known.values():
            for quantity in {one["quantity"] for one in cause.coefficients} & set(entry):
                true = [one["value"] for one in cause.coefficients if one["quantity"] == quantity]
                if entry[quantity]["unit"] == "nT/A":
                    true = [1e3 * value for value in true]
                entry[quantity]["value"] = true if len(true) > 1 else true[0]
    if more is not None:
        first = more["effect"] in ("temperature", "nonlinearity", "angle_step")
        tree["effects"].insert(0 if first else len(tree["effects"]), more)
    return Model.parse(json.dumps(tree), mission)


def residual_of(case: Case, root: Path, more: dict[str, Any] | None = None) -> np.ndarray:
    """Return the residual of every day, through archive and chain, under the true model; (time,) nT."""
    cat, mission = Catalog(root), Workspace.open(root).mission()
    model = true_model(case, mission, more)
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    days = [load_samples(cat, mission, model, day, needs, index) for day in case.days]
    return np.concatenate([model.residual(samples)[:, 0] for samples in days])


def as_effect(case: Case, told: dict[str, Any]) -> dict[str, Any]:
    """Return the truth about a hidden cause as an entry of the model YAML."""
    sensors, coefficients = case.truth["sensors"], told["coefficients"]
    quantity, values = coefficients[0]["quantity"], [one["value"] for one in coefficients]
    vector = {"name": "hidden", "sensor": sensors["vector"]}
    fixed = {"value": case.nine.offset.tolist(), "unit": "nT", "free": False}
    if quantity == "seconds":
        entry = {"effect": "time_shift", "name": "hidden", "sensor": sensors["scalar"]}
        if "from_d" in told:
            bounds = [
                case.start.astype("datetime64[ms]") + int(86_400e3 * (told["from_d"] + d)) for d in (0, 4)
            ]
            entry |= {"effect": "clock_episode", "from": f"{bounds[0]}Z", "to": f"{bounds[1]}Z"}
        return entry | {"seconds": {"value": values[0]}}
    effect = SAID[quantity]
    if effect == "scalar_bias":
        return {"effect": effect, "name": "hidden", "sensor": sensors["scalar"], "bias": {"value": values[0]}}
    entry = vector | {"effect": effect, PARAMETERS.get(quantity, quantity): {"value": values}}
    if effect in ("channel_field", "hysteresis", "torquer", "temperature"):
        entry["channel"] = told["channels"][0]
    if effect == "torquer":
        entry["matrix"]["value"] = [1e3 * value for value in values]
    if effect in ("temperature", "nonlinearity", "angle_step"):
        entry["about"] = fixed
    if effect == "temperature":
        mean = float(case.world.house["coil_temperature"].values.mean())
        entry["reference"] = {"value": mean, "free": False}
    if effect in ("offset_step", "angle_step"):
        entry["at"] = _utc(case, told["at_s"])
    extra = {"lag": f"{told['lag_s']} s"} if "lag_s" in told else {}
    return entry | extra | ({"width": told["width"]} if "width" in told else {})


def _utc(case: Case, seconds: float) -> str:
    """Return a time so many seconds after a case's start, as the YAML writes it."""
    return f"{case.start.astype('datetime64[ms]') + int(1e3 * seconds)}Z"
