"""Effects the model knows by a wrong number that is no coefficient: a lag, a width, a delay, a reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .causes import FAMILY, Cause, World
from .response import low_pass, play
from .rivals import retained

#: Rms of the whole contribution, nT.
SIZE = (0.5, 3.0)
#: Parts of the way from the true number to the farthest one that are tried, until enough is left.
PARTS = np.geomspace(0.01, 1.0, 60)


@dataclass(frozen=True)
class HeldCause:
    """A cause with a number in its form.

    `of` returns what multiplies a vector, for a value of the number, (time,); `entry` the effect of the
    model with it. `number` is the name by which a diagnosis calls it, `farthest` a value of it that is
    as wrong as it may be.
    """

    family: str
    channels: tuple[str, ...]
    number: str
    unit: str
    true: float
    farthest: float
    of: Callable[[float], np.ndarray]
    entry: Callable[[float], dict[str, Any]] = lambda _: {}
    gain: bool = False

    def cause(self, world: World, value: float, vector: np.ndarray) -> Cause:
        """Return what it adds to the readings with a value of the number."""
        made = self.of(value)[:, None] * vector
        told = ({"quantity": "number", "axis": "", "value": self.true - value, "unit": self.unit, "at": ""},)
        kind = {"gain": made} if self.gain else {"field_vector": made}
        return Cause(
            f"{self.number}", (self.family,), self.channels, coefficients=told if self.unit else (), **kind
        )


def wrong_value(held: HeldCause, world: World, vector: np.ndarray, wanted: float) -> tuple[float, Cause]:
    """Return a value so wrong that the calibration leaves an rms of what it misses, nT, and what that is."""
    right = held.cause(world, held.true, vector)
    for part in PARTS:
        value = held.true + part * (held.farthest - held.true)
        wrong = held.cause(world, value, vector)
        key = "gain" if held.gain else "field_vector"
        missed = Cause(
            right.name, right.families, right.channels, coefficients=wrong.coefficients,
            **{key: getattr(right, key) - getattr(wrong, key)},
        )  # fmt: skip
        if np.std(retained(world, missed.seen(world))) >= wanted:
            break
    return value, missed


def _family(world: World, name: str) -> str:
    kind = world.house[name].kind
    return FAMILY.get(kind, kind)


def _field(sensor: str, vector: np.ndarray, **options: Any) -> dict[str, Any]:
    size = float(np.abs(vector).max())
    coefficient = {"value": vector.tolist(), "unit": "nT", "sigma": [0.02 * size] * 3}
    return {
        "effect": "channel_field",
        "name": "stray",
        "sensor": sensor,
        **options,
        "coefficient": coefficient,
    }


def draw_held(
    name: str,
    world: World,
    rng: np.random.Generator,
    sensor: str,
    names: dict[str, str],
    about: np.ndarray,
) -> tuple[HeldCause, np.ndarray]:
    """Return a held cause and the vector its factor multiplies, of a usual size.

    Parameters
    ----------
    names : dict of str
        Telling name of a channel -> the name it is delivered under.
    about : ndarray, shape (3,)
        Offsets of the vector sensor, nT.
    """
    if name == "scale_lag":
        return _slow_scale(world, rng, sensor, names, about)
    maker = {"lag": _slow_field, "delay": _late_field, "width": _play_field, "reference": _product_field}[
        name
    ]
    held, options = maker(world, rng, names)
    vector = rng.normal(size=3)
    series = held.of(held.true)
    vector *= rng.uniform(*SIZE) / np.linalg.norm(vector) / series.std()
    return replace(held, entry=lambda value: _field(sensor, vector, **options(value))), vector


Options = Callable[[float], dict[str, Any]]


def _slow_field(world: World, rng: np.random.Generator, names: dict[str, str]) -> tuple[HeldCause, Options]:
    """Return a field that follows a current through a slow response."""
    name, step, far = "payload_current", world.track.step, float(rng.choice([0.3, 3.0]))
    series, true = world.house[name].values, float(np.exp(rng.uniform(*np.log([200.0, 1200.0]))))
    held = HeldCause(
        _family(world, name), (name,), "stray.lag", "s", true, far * true,
        lambda tau: low_pass(series, tau, step),
    )  # fmt: skip
    return held, lambda tau: {"channel": names[name], "lag": f"{tau:.6g} s"}


def _late_field(world: World, rng: np.random.Generator, names: dict[str, str]) -> tuple[HeldCause, Options]:
    """Return the field of a current whose stamps are late, by another time than the mission file says."""
    name, seconds = "battery_current", world.track.seconds
    series, true = world.house[name].values, float(rng.uniform(20.0, 120.0))
    held = HeldCause(
        _family(world, name), (name,), f"{names[name]}.lag", "s", true, true - 400.0,
        lambda delay: np.interp(seconds - delay, seconds, series),
    )  # fmt: skip
    return held, lambda delay: {"channel": names[name]}


def _play_field(world: World, rng: np.random.Generator, names: dict[str, str]) -> tuple[HeldCause, Options]:
    """Return a field that follows a temperature with play."""
    name, far = "boom_temperature", float(rng.choice([0.3, 3.0]))
    series = world.house[name].values
    true = float(rng.uniform(0.8, 1.6) * series.std())
    held = HeldCause(
        "hysteresis", (name,), "stray.width", world.house[name].unit, true, far * true,
        lambda width: play(series, width),
    )  # fmt: skip
    return held, lambda width: {"channel": names[name], "width": float(f"{width:.6g}")}


def _product_field(
    world: World, rng: np.random.Generator, names: dict[str, str]
) -> tuple[HeldCause, Options]:
    """Return the field of a current that grows with a temperature above a reference value."""
    pair = ("payload_current", "coil_temperature")
    current, warm = (world.house[name] for name in pair)
    true, product = float(warm.values.mean()), "*".join(names[name] for name in pair)
    held = HeldCause(
        _family(world, pair[0]), pair, f"stray.about[{names[pair[1]]}]", warm.unit, true,
        true + 20.0 * float(rng.choice([-1.0, 1.0])),
        lambda zero: current.values * (warm.values - zero),
    )  # fmt: skip
    return held, lambda zero: {"channel": f"{product}@about={zero:.6g}"}


def _slow_scale(
    world: World, rng: np.random.Generator, sensor: str, names: dict[str, str], about: np.ndarray
) -> tuple[HeldCause, np.ndarray]:
    """Return scale factors that follow the coil's temperature slowly."""
    warm, step, far = world.house["coil_temperature"], world.track.step, float(rng.choice([0.3, 3.0]))
    true, zero = float(np.exp(rng.uniform(*np.log([300.0, 1500.0])))), float(warm.values.mean())
    held = HeldCause(
        "temperature", ("coil_temperature",), "warmth.lag", "s", true, far * true,
        lambda tau: low_pass(warm.values, tau, step) - zero, gain=True,
    )  # fmt: skip
    linear = rng.choice([-1, 1], 3) * rng.uniform(0.5, 1.5, 3)
    linear *= rng.uniform(*SIZE) / np.sqrt(np.mean((held.of(true) * world.strength) ** 2))
    tree = {
        "effect": "temperature",
        "name": "warmth",
        "sensor": sensor,
        "channel": names["coil_temperature"],
        "linear": {
            "unit": "1/K",
            "value": linear.tolist(),
            "sigma": [0.02 * float(np.abs(linear).max())] * 3,
        },
        "quadratic": {"unit": "1/K^2", "value": [0.0] * 3, "free": False},
        "reference": {"unit": "degC", "value": zero, "free": False},
        "about": {"value": about.tolist(), "unit": "nT", "free": False},
    }
    return replace(held, entry=lambda tau: tree | {"lag": f"{tau:.6g} s"}), linear
