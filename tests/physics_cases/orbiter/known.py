"""What the ground tests have told: causes that act and that the pre-flight model knows, nearly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .causes import CAUSES, Cause, World
from .readings import Nine

#: Causes that may be known beforehand, and the rms of their contribution, nT.
KNOWABLE = {
    "torquer": (0.3, 2.0),
    "temperature_scale": (0.3, 2.0),
    "nonlinearity": (0.2, 1.0),
    "clock": (0.1, 0.4),
}
#: What a pre-flight error leaves of a known cause, in parts of the noise: a third of what is detectable.
LEFT = 0.03


@dataclass(frozen=True)
class Error:
    """By what part of themselves numbers are wrong, and how many stated sigmas that is."""

    part: float
    sigmas: float
    held: bool


def _held(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an effect of the model YAML whose parameters have no sigma."""
    return {
        key: {name: one for name, one in value.items() if name != "sigma"} | {"free": False}
        if isinstance(value, dict)
        else value
        for key, value in entry.items()
    }


def draw_known(
    world: World, hidden: tuple[str, ...], count: int, rng: np.random.Generator, wrong: str = ""
) -> dict[str, Cause]:
    """Return so many known causes by name, none of them like a hidden one, the wrong one among them."""
    taken = set(hidden) | ({"clock"} if {"clock_episode", "eddy"} & set(hidden) else set())
    free = [name for name in KNOWABLE if name not in taken]
    chosen = rng.permutation(free)[:count].tolist()
    if wrong:
        chosen = [wrong, *(name for name in chosen if name != wrong)][: max(count, 1)]
    made = {}
    for name in chosen:
        cause = CAUSES[name](world, rng)
        rms = float(np.sqrt(np.mean(cause.seen(world) ** 2)))
        low, high = KNOWABLE[name]
        made[name] = cause.scaled(rng.uniform(low, high) / max(rms, 1e-12))
    return made


def model_tree(
    mission: str,
    sensors: tuple[str, str],
    nine: Nine,
    known: dict[str, Cause],
    world: World,
    names: dict[str, str],
    noise: float,
    rng: np.random.Generator,
    errors: dict[str, Error] | None = None,
) -> dict[str, Any]:
    """Return the pre-flight model; every value is off by about its stated sigma.

    Parameters
    ----------
    sensors : tuple of str
        Vector and scalar instrument.
    names : dict of str
        Telling name of a channel -> the name it is delivered under.
    noise : float
        White noise of the residual, nT.
    errors : dict of str to Error
        Of known causes whose numbers are wrong.
    """
    near = Nine(
        nine.scale_factor + rng.normal(0, 2e-5, 3),
        nine.misalignment + rng.normal(0, 1.5e-3, 3),
        nine.offset + rng.normal(0, 1.0, 3),
    )
    before, behind = [], []
    for name, cause in known.items():
        error = (errors or {}).get(name)
        entry = _entry(name, cause, sensors, nine.offset, world, names, noise, rng, error)
        (behind if name in ("torquer", "clock") else before).append(entry)
    order = ("nonlinearity", "temperature")
    before.sort(key=lambda entry: order.index(entry["effect"]))
    own = {
        "effect": "vector_sensor",
        "sensor": sensors[0],
        "scale_factor": _block("1", near.scale_factor, 2e-3),
        "misalignment": _block("deg", near.misalignment, 0.02),
        "offset": _block("nT", near.offset, 10.0),
    }
    effects = [*before, own, *behind]
    return {"model": f"{mission}-preflight", "mission": mission, "comparison": "main", "effects": effects}


def _block(unit: str, value: np.ndarray, sigma: float) -> dict[str, Any]:
    return {"time": "block", "unit": unit, "value": value.tolist(), "sigma": [sigma] * 3}


def _entry(
    name: str,
    cause: Cause,
    sensors: tuple[str, str],
    about: np.ndarray,
    world: World,
    names: dict[str, str],
    noise: float,
    rng: np.random.Generator,
    error: Error | None,
) -> dict[str, Any]:
    """Return one effect of the model YAML."""
    true = np.array([one["value"] for one in cause.coefficients])
    off = LEFT * noise / max(float(np.sqrt(np.mean(cause.seen(world) ** 2))), 1e-12)
    sigma = np.abs(true).max() * off / np.sqrt(true.size) * np.ones_like(true)
    value = true + rng.normal(0, 1, true.size) * sigma
    if error is not None:
        value = true - error.part * true
        sigma = np.maximum(np.abs(error.part * true), np.abs(error.part * true).max() / 10.0) / error.sigmas
    fixed = {"value": about.tolist(), "unit": "nT", "free": False}
    if error is not None and error.held:
        return _held(
            _entry(name, cause, sensors, about, world, names, noise, rng, replace(error, held=False))
        )
    if name == "torquer":
        stated = {"unit": "nT/A", "value": (1e3 * value).tolist(), "sigma": (1e3 * sigma).tolist()}
        return {
            "effect": "torquer",
            "sensor": sensors[0],
            "channel": names["torquer_current"],
            "matrix": stated,
        }
    if name == "clock":
        return {"effect": "time_shift", "sensor": sensors[1],
                "seconds": {"unit": "s", "value": float(value[0]), "sigma": float(sigma[0])}}  # fmt: skip
    if name == "temperature_scale":
        reference = float(world.house["coil_temperature"].values.mean())
        return {
            "effect": "temperature",
            "sensor": sensors[0],
            "channel": names["coil_temperature"],
            "linear": {"unit": "1/K", "value": value.tolist(), "sigma": sigma.tolist()},
            "quadratic": {"unit": "1/K^2", "value": [0.0] * 3, "free": False},
            "reference": {"unit": "degC", "value": reference, "free": False},
            "about": fixed,
        }
    quantity, unit = cause.coefficients[0]["quantity"], cause.coefficients[0]["unit"]
    other, other_unit = ("cubic", "1/nT^2") if quantity == "quadratic" else ("quadratic", "1/nT")
    return {
        "effect": "nonlinearity",
        "sensor": sensors[0],
        quantity: {"unit": unit, "value": value.tolist(), "sigma": sigma.tolist()},
        other: {"unit": other_unit, "value": [0.0] * 3, "free": False},
        "about": fixed,
    }
