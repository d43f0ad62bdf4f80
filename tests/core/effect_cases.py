"""A CHAMP-like mission, fields with channels, and models of every effect with values of either sign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.effects import known_effects
from inflight.mission import Mission
from inflight.model import Model, make_effect
from inflight.sensors import sensors_of
from inflight.time import SECOND, day_bounds, to_utc

ROOT = Path(__file__).parents[2]
MISSION = Mission.parse((ROOT / "missions" / "champ.yaml").read_text(encoding="utf-8"))
PREFLIGHT = (ROOT / "missions" / "models" / "champ-preflight.yaml").read_text(encoding="utf-8")
SENSORS = sensors_of(MISSION)
#: On which sensor each effect of the library acts, and what it needs beside its parameters.
PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "vector_sensor": ("fgm", {}),
    "affine": ("fgm", {}),
    "nonlinearity": ("fgm", {}),
    "temperature": ("fgm", {"channel": "coil_temperature"}),
    "torquer": ("fgm", {"channel": "torquer_current"}),
    "remanent": ("fgm", {}),
    "channel_field": ("fgm", {"channel": "solar_current"}),
    "time_shift": ("ovm", {}),
    "oscillator": ("ovm", {"channel": "frequency_ratio"}),
    "scalar_bias": ("ovm", {}),
    "heading": ("ovm", {}),
    "induced": ("ovm", {}),
}
#: Sizes a parameter may honestly have, where neither its sigma nor its step says so.
_SIZES = {"about": 30.0, "reference": 10.0, "shift": 300.0, "matrix": 0.01, "coefficient": 3.0, "bias": 1.0}


def true_samples(seed: int = 0, count: int = 400) -> xr.Dataset:
    """True fields of low and high latitudes with every channel of the mission."""
    g = np.random.default_rng(seed)
    stamps = day_bounds("2004-05-01")[0] + SECOND * np.arange(count)
    turn = np.linspace(0, 2 * np.pi, count)
    field = np.stack(
        [25_000 * np.cos(turn), 4_000 * np.sin(turn + 1), -48_000 * np.sin(turn)], axis=1
    ) + g.normal(0, 20, (count, 3))
    rows = {
        "coil_temperature": (g.normal(15, 8, count), "degC"),
        "solar_current": (g.uniform(0, 10_000, count), "mA"),
        "frequency_ratio": (1 + g.normal(0, 1e-6, count), "1"),
    }
    out = xr.Dataset(
        {
            "vector": (("time", "axis"), field, {"units": "nT"}),
            "scalar": ("time", np.linalg.norm(field, axis=1), {"units": "nT"}),
            "torquer_current": (("time", "axis"), g.uniform(-150, 150, (count, 3)), {"units": "mA"}),
            "flag": ("time", np.zeros(count, dtype=np.uint32)),
            "tt2000": ("time", stamps),
        },
        coords={"time": to_utc(stamps)},
    )
    return out.assign({name: ("time", values, {"units": unit}) for name, (values, unit) in rows.items()})


def entry_of(name: str, generator: np.random.Generator, time: str = "constant") -> dict[str, Any]:
    """One entry of a model YAML with values of either sign, as large as a real one may be."""
    sensor, options = PLACES[name]
    entry: dict[str, Any] = {"effect": name, "sensor": sensor, **options}
    for key, parameter in known_effects()[name].parameters().items():
        known = parameter.sigma if np.isfinite(parameter.sigma) else _SIZES.get(key, 1.0)
        size = min(known, _SIZES.get(key, np.inf))
        value = parameter.default_values + size * generator.uniform(-1, 1, parameter.size)
        rows = value[:, None]
        told: dict[str, Any] = {"time": time, "unit": parameter.unit}
        if time in ("linear", "log"):
            rows = np.stack([value, 0.2 * size * generator.uniform(-1, 1, parameter.size)], axis=1)
            told |= {"t0": "2000-05-30", "per": "1000 d"}
        plain = [row[0] if len(row) == 1 else row for row in rows.tolist()]
        told["value"] = dict(zip(parameter.axes, plain, strict=True)) if parameter.axes else plain[0]
        entry[key] = told
    return entry


def model_of(*entries: dict[str, Any]) -> Model:
    return Model("case", "champ", "main", tuple(make_effect(entry, SENSORS) for entry in entries))
