"""Cases of spinning spacecraft: what is hidden in the readings, or held wrongly by the pre-flight model."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from inflight.catalog import Workspace
from inflight.simulate.spinning import SpinningSettings
from inflight.tasks.archive import simulate

#: Size of a wrong gain ratio, and of the field of a coil at its usual current (nT), a case draws up to.
_WRONG, _COIL_NT = (3e-4, 2e-3), (0.08, 0.5)
#: What a shadow's cold does to the spin-plane offsets, nT/K.
_COLD = (0.003, 0.012)
#: Spread of the true twelve about the simulator's own.
_SPREAD = 0.3
#: Sizes that the truth tells of each cause: quantity, axes and unit.
_TOLD = {"torquer": ("coefficient", "nT/A"), "eclipse_shift": ("coefficient", "nT/K")}
_FAMILY = {"torquer": ["torquer"], "eclipse_shift": ["temperature"], "gain_ratio": ["sensor"]}
_CHANNELS = {"torquer": ["coil_current"], "eclipse_shift": ["sensor_temperature"], "gain_ratio": []}


@dataclass(frozen=True)
class TurningScenario:
    """What is hidden aboard which spinning spacecraft, and which verdicts are right about it.

    Attributes
    ----------
    hidden : str
        ``torquer``, ``eclipse_shift``, ``gain_ratio`` (held at a wrong value by the model), or nothing.
    """

    name: str
    hidden: str = ""
    craft: str = "imp8"
    days: int = 3
    verdicts: tuple[str, ...] = ("FOUND", "CONFOUNDED")
    defects: tuple[str, ...] = ("missing_pulses", "gaps", "spikes")
    files: bool = field(default=True, init=False)


@dataclass(frozen=True)
class TurningCase:
    """A drawn case: the simulation, and the value the model holds the gain ratio at."""

    scenario: TurningScenario
    seed: int
    settings: SpinningSettings
    held: float | None
    truth: dict[str, Any]

    def write(self, root: Path) -> tuple[Path, Path]:
        """Write workspace and truth to folders of their own; return both paths."""
        label = f"{self.scenario.name}-{self.seed}"
        made = Workspace.create(root / "work" / label, self.scenario.craft)
        simulate(self.settings, made.data, workers=1)
        shutil.rmtree(made.data / "truth")
        if self.held is not None:
            hold(made.models / f"{self.scenario.craft}-preflight.yaml", self.held)
        path = root / "truth" / f"{label}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.truth, indent=1), encoding="utf-8")
        return made.root, path


def hold(path: Path, value: float) -> None:
    """Hold the gain ratio of a model's file at a value."""
    yaml = YAML()
    tree = yaml.load(path.read_text(encoding="utf-8"))
    (entry,) = [one for one in tree["effects"] if one["effect"] == "spinning_sensor"]
    entry["gain_ratio"] = {"time": "constant", "unit": "1", "value": value, "free": False}
    with path.open("w", encoding="utf-8") as file:
        yaml.dump(tree, file)


def make_turning_case(scenario: TurningScenario, seed: int) -> TurningCase:
    """Return one case; equal scenario and seed give equal data."""
    rng = np.random.default_rng([seed, *scenario.name.encode()])
    usual = SpinningSettings(craft=scenario.craft).parameters
    overrides: dict[str, Any] = {
        name: np.multiply(getattr(usual, name), 1.0 + _SPREAD * rng.standard_normal()).tolist()
        for name in ("elevation", "spin_axis", "offset", "azimuth")
    }
    ratio = 1.0 + 1.2e-3 * rng.standard_normal()
    overrides |= {"gain_ratio": ratio}
    values, held = _drawn(scenario.hidden, rng), None
    if scenario.hidden == "torquer":
        overrides["torquer_field"] = values
    elif scenario.hidden == "eclipse_shift":
        overrides["eclipse_shift"] = values
    elif scenario.hidden == "gain_ratio":
        held = ratio - values[0]
    settings = SpinningSettings(
        craft=scenario.craft,
        days=scenario.days,
        seed=int(rng.integers(1_000_000)),
        hide=(scenario.hidden,) if scenario.hidden in _TOLD else (),
        without=("zero_drift",),
        defects=scenario.defects,
        overrides=overrides,
    )
    return TurningCase(scenario, seed, settings, held, _truth(scenario, seed, settings, values))


def _drawn(hidden: str, rng: np.random.Generator) -> list[float]:
    """Return the size of what is hidden, of either sign."""
    if hidden == "gain_ratio":
        return [float(rng.choice([-1.0, 1.0]) * rng.uniform(*_WRONG))]
    if hidden == "torquer":
        return (rng.choice([-1.0, 1.0], 3) * rng.uniform(*_COIL_NT, 3)).tolist()
    if hidden == "eclipse_shift":
        return [*(rng.choice([-1.0, 1.0], 2) * rng.uniform(*_COLD, 2)).tolist(), 0.0]
    return []


def _truth(
    scenario: TurningScenario, seed: int, settings: SpinningSettings, values: list[float]
) -> dict[str, Any]:
    truth: dict[str, Any] = {
        "scenario": scenario.name,
        "seed": seed,
        "verdicts": list(scenario.verdicts),
        "floor_nT": None,
        "effects": [],
        "settings": settings.model_dump(mode="json"),
    }
    if not scenario.hidden:
        return truth
    told = []
    if scenario.hidden in _TOLD:
        quantity, unit = _TOLD[scenario.hidden]
        current = settings.parameters.torquer_current if scenario.hidden == "torquer" else 1.0
        told = [
            {"quantity": quantity, "axis": axis, "value": one / current, "unit": unit, "at": "difference"}
            for axis, one in zip("xyz", values, strict=True)
        ]
    truth["effects"] = [
        {
            "name": scenario.hidden,
            "families": _FAMILY[scenario.hidden],
            "channels": _CHANNELS[scenario.hidden],
            "coefficients": told,
            "identifiable": True,
            "equivalents": [],
            "retained_rms_nT": float("nan"),
            "size": values,
        }
    ]
    return truth
