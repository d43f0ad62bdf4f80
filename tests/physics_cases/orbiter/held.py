"""Effects the model knows by a wrong number that is no coefficient: a lag, a width, a delay, a reference value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .causes import FAMILY, Cause, World
from .response import low_pass, play
from .rivals import retained

#: Rms of the whole contribution, nT.
SIZE = (0.5, 3.0)
#: Fractions of the way from the true number to one twice or half as large that are tried, until enough is left.
PARTS = np.geomspace(0.01, 1.0, 60)


@dataclass(frozen=True)
class HeldCause:
    """A cause with a number in its form.

    `of` returns the contribution's factor of `vector` for a value of the number, (time,); `entry` the effect of
    the model with it. `number` is the name by which a diagnosis calls it, `farthest` a value of it that is
    as wrong as it may be.
    """

    family: str
    channels: tuple[str, ...]
    number: str
    unit: str
    true: float
    farthest: float
    of: Callable[[float], np.ndarray]
    entry: Callable[[float], dict[str, Any]]
    gain: bool = False

    def cause(self, world: World, value: float, vector: np.ndarray) -> Cause:
        """Return what it adds to the readings with a value of the number."""
        made = self.of(value)[:, None] * vector
        told = ({"quantity": "number", "axis": "", "value": self.true - value, "unit": self.unit, "at": ""},)
        kind = {"gain": made} if self.gain else {"field_vector": made}
        return Cause(
            f"{self.number}", (self.family,), self.channels, coefficients=told if self.unit else (), **kind
        )


def wrong_value(
    held: HeldCause, world: World, vector: np.ndarray, wanted: float
) -> tuple[float, Cause]:
    """Return a value so wrong that the calibration leaves an rms of what it misses, nT, and what that is."""
    for part in PARTS:
        value = held.true + part * (held.farthest - held.true)
        right, wrong = (held.cause(world, one, vector) for one in (held.true, value))
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
    return {"effect": "channel_field", "name": "stray", "sensor": sensor, **options, "coefficient": coefficient}


def draw_held(
    name: str,
    world: World,
    rng: np.random.Generator,
    sensor: str,
    names: dict[str, str],
    about: np.ndarray,
) -> tuple[HeldCause, np.ndarray]:
    """Return a held cause and the vector its factor multiplies, of a usual size."""
    vector = rng.normal(size=3)
    vector /= np.linalg.norm(vector)
    step, far = world.track.step, float(rng.choice([0.3, 3.0]))

    def made(channel: str, key: str, true: float, of: Callable[[float], np.ndarray], farthest: float, **more: Any):
        unit = "s" if key in ("lag", "delay") else world.house[channel].unit
        size = rng.uniform(*SIZE) / np.sqrt(np.mean(_centred(of(true)) ** 2))
        scaled = vector * size
        named = names[channel]

        def entry(value: float) -> dict[str, Any]:
            if key == "lag":
                return _field(sensor, scaled, channel=named, lag=f"{value:.6g} s")
            if key == "width":
                return _field(sensor, scaled, channel=named, width=float(f"{value:.6g}"))
            return _field(sensor, scaled, channel=named)

        number = f"{named}.lag" if key == "delay" else f"stray.{key}"
        family = more.get("family", _family(world, channel))
        return HeldCause(family, (channel,), number, unit, true, farthest, of, entry), scaled

    if name == "lag":
        series, true = world.house["payload_current"].values, float(np.exp(rng.uniform(*np.log([200.0, 1200.0]))))
        return made("payload_current", "lag", true, lambda tau: low_pass(series, tau, step), far * true)
    if name == "delay":
        series, seconds = world.house["transmitter_current"].values, world.track.seconds
        true = float(rng.uniform(20.0, 120.0))

        def late(delay: float) -> np.ndarray:
            return np.interp(seconds - delay, seconds, series)

        return made("transmitter_current", "delay", true, late, 0.0)
    if name == "width":
        series = world.house["boom_temperature"].values
        true = float(rng.uniform(0.8, 1.6) * series.std())
        return made(
            "boom_temperature", "width", true, lambda w: play(series, w), far * true, family="hysteresis"
        )
    if name == "reference":
        current, warm = world.house["payload_current"], world.house["coil_temperature"]
        true = float(warm.values.mean())
        # As a laboratory has it: a coefficient of a current's field that grows with temperature from there on.
        scaled = vector * rng.uniform(*SIZE) / np.sqrt(np.mean(_centred(current.values * (warm.values - true)) ** 2))
        product = f"{names['payload_current']}*{names['coil_temperature']}"
        return (
            HeldCause(
                _family(world, "payload_current"),
                ("payload_current", "coil_temperature"),
                f"stray.about[{names['coil_temperature']}]",
                warm.unit,
                true,
                true + 20.0 * rng.choice([-1.0, 1.0]),
                lambda zero: current.values * (warm.values - zero),
                lambda zero: _field(sensor, scaled, channel=f"{product}@about={zero:.6g}"),
            ),
            scaled,
        )
    if name == "scale_lag":
        warm = world.house["coil_temperature"]
        true, zero = float(np.exp(rng.uniform(*np.log([300.0, 1500.0])))), float(warm.values.mean())

        def gain(tau: float) -> np.ndarray:
            return low_pass(warm.values, tau, step) - zero

        unit = rng.choice([-1, 1], 3) * rng.uniform(0.5, 1.5, 3)
        size = rng.uniform(*SIZE) / np.sqrt(np.mean((gain(true) * world.strength) ** 2))

        def entry(tau: float) -> dict[str, Any]:
            linear = (unit * size).tolist()
            return {
                "effect": "temperature", "name": "warmth", "sensor": sensor,
                "channel": names["coil_temperature"], "lag": f"{tau:.6g} s",
                "linear": {"unit": "1/K", "value": linear, "sigma": [0.02 * float(np.abs(linear).max())] * 3},
                "quadratic": {"unit": "1/K^2", "value": [0.0] * 3, "free": False},
                "reference": {"unit": "degC", "value": zero, "free": False},
                "about": {"value": about.tolist(), "unit": "nT", "free": False},
            }  # fmt: skip

        return HeldCause(
            "temperature", ("coil_temperature",), "warmth.lag", "s", true, far * true, gain, entry, gain=True
        ), unit * size
    raise ValueError(f"no held cause {name!r}")


def _centred(series: np.ndarray) -> np.ndarray:
    return series - series.mean()
