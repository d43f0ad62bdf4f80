"""A CHAMP-like mission, fields with channels, and models of every effect with values of either sign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.effects import known_effects
from inflight.mission import Mission, sensors_of
from inflight.model import Model, make_effect
from inflight.samples.derived import play
from inflight.time import SECOND, day_bounds, to_utc

ROOT = Path(__file__).parents[2]
MISSION = Mission.parse((ROOT / "missions" / "champ.yaml").read_text(encoding="utf-8"))
PREFLIGHT = (ROOT / "missions" / "models" / "champ-preflight.yaml").read_text(encoding="utf-8")
SENSORS = sensors_of(MISSION)
#: On which sensor each effect of the library acts, and what it needs beside its parameters.
PLACES: dict[str, tuple[str, dict[str, Any]]] = {
    "vector_sensor": ("fgm", {}),
    "affine": ("fgm", {}),
    "spinning_sensor": ("fgm", {}),
    "nonlinearity": ("fgm", {}),
    "temperature": ("fgm", {"channel": "coil_temperature"}),
    "torquer": ("fgm", {"channel": "torquer_current"}),
    "remanent": ("fgm", {}),
    "remanent_moment": ("fgm", {}),
    "channel_field": ("fgm", {"channel": "solar_current"}),
    "time_shift": ("ovm", {}),
    "scalar_response": ("ovm", {}),
    "oscillator": ("ovm", {"channel": "frequency_ratio"}),
    "scalar_bias": ("ovm", {}),
    "heading": ("ovm", {}),
    "heading_anisotropy": ("ovm", {}),
    "induced": ("ovm", {}),
    "soft_iron": ("ovm", {}),
    "eddy": ("fgm", {}),
    "tolles_lawson": ("ovm", {}),
    "cross_talk": ("fgm", {}),
    "channel_scale": ("fgm", {"channel": "coil_temperature"}),
    "channel_angle": ("fgm", {"channel": "coil_temperature"}),
    "vector_clock": ("fgm", {}),
    "channel_turn": ("fgm", {"channel": "coil_temperature"}),
    "channel_bias": ("ovm", {"channel": "electronics_temperature"}),
    "channel_clock": ("ovm", {"channel": "electronics_temperature"}),
    "adc_temperature": ("fgm", {"channel": "electronics_temperature"}),
    "solar_array": ("fgm", {"channel": "solar_current", "normals": [[1, 0, 1], [-1, 0, 1], [0, 1, 0]]}),
    "channel_power": ("fgm", {"channel": "coil_temperature"}),
    "channel_matrix": ("ovm", {"channel": "torquer_current"}),
    "channel_rate": ("fgm", {"channel": "coil_temperature"}),
    "hysteresis": ("fgm", {"channel": "coil_temperature", "width": 2}),
    "response_curve": ("fgm", {"knots": [-60_000.0, -20_000.0, 0.0, 20_000.0, 60_000.0]}),
    "function_of_channel": ("fgm", {"channel": "coil_temperature", "knots": [0.0, 10.0, 15.0, 30.0]}),
    "function_of_two": (
        "fgm",
        {
            "channel": "coil_temperature",
            "knots": [0.0, 30.0],
            "second": "solar_current",
            "second_knots": [0.0, 3e3, 1e4],
        },
    ),
    "formula_field": ("fgm", {"formula": "solar_current * (coil_temperature < 15) + torquer_current[1]"}),
    "day_night": ("fgm", {}),
    "sun_direction_field": ("fgm", {"degree": 2}),
    "orbit_periodic": ("fgm", {"order": 3}),
    "sun_periodic": ("fgm", {}),
    "day_night_series": ("fgm", {}),
    "local_time_periodic": ("ovm", {"order": 1}),
    "tone": ("fgm", {"period": "37.3 s"}),
    "offset_step": ("fgm", {"at": "2004-05-01T00:03:20Z"}),
    "offset_episode": ("ovm", {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:05:00Z"}),
    "scale_step": ("fgm", {"at": "2004-05-01T00:03:20Z"}),
    "scale_episode": ("fgm", {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:05:00Z"}),
    "angle_step": ("fgm", {"at": "2004-05-01T00:03:20Z"}),
    "angle_episode": ("fgm", {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:05:00Z"}),
    "bias_step": ("ovm", {"at": "2004-05-01T00:03:20Z"}),
    "clock_step": ("ovm", {"at": "2004-05-01T00:03:20Z"}),
    "wander": ("fgm", {"of": "misalignment[yz]"}),
    "clock_episode": ("ovm", {"from": "2004-05-01T00:01:00Z", "to": "2004-05-01T00:05:00Z"}),
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
        "electronics_temperature": (20 + 5 * np.sin(turn), "degC"),
        "sunlit": ((turn < 4).astype(float), "1"),
        "orbit_phase": (np.rad2deg(turn), "deg"),
        "sun_phase": (np.rad2deg(turn + 0.3) % 360, "deg"),
        "local_time": (np.where(turn < 3, 9.0, 21.0), "h"),
    }
    rows["coil_temperature@width=2"] = (play(rows["coil_temperature"][0], 2.0), "degC")
    sun = np.stack([np.cos(turn), np.sin(turn), np.full(count, 0.5)], axis=1)
    out = xr.Dataset(
        {
            "vector": (("time", "axis"), field, {"units": "nT"}),
            "scalar": ("time", np.linalg.norm(field, axis=1), {"units": "nT"}),
            "sun_direction": (("time", "axis"), sun / np.linalg.norm(sun, axis=1)[:, None], {"units": "1"}),
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
    for key, parameter in known_effects()[name](name, **options).parameters().items():
        known = parameter.sigma if np.isfinite(parameter.sigma) else _SIZES.get(key, 1.0)
        size = min(known, _SIZES.get(key, np.inf))
        value = parameter.default_values + size * generator.uniform(-1, 1, parameter.size)
        rows = value[:, None]
        told: dict[str, Any] = {"time": time, "unit": parameter.unit}
        if time in ("event", "spline"):
            rows = value[:, None] + size * generator.uniform(-1, 1, (parameter.size, 3))
            at = ["2004-05-01T00:02:00Z", "2004-05-01T00:04:00Z", "2004-05-01T00:06:00Z"]
            told["at"] = at[:2] if time == "event" else at
        if time in ("linear", "log"):
            rows = np.stack([value, 0.2 * size * generator.uniform(-1, 1, parameter.size)], axis=1)
            told |= {"t0": "2000-05-30", "per": "1000 d"}
        plain = [row[0] if len(row) == 1 else row for row in rows.tolist()]
        told["value"] = dict(zip(parameter.axes, plain, strict=True)) if parameter.axes else plain[0]
        entry[key] = told
    return entry


def model_of(*entries: dict[str, Any]) -> Model:
    return Model("case", "champ", "main", tuple(make_effect(entry, SENSORS) for entry in entries))
