"""What may be wrong, one function a cause: the field, gain, delay or bias it makes, at unit size.

Signs are those of the project: a cause states what it adds to the reading, and the residual is vector
minus scalar. `Cause.seen` is the linear part of that residual, which sizes and scores are made from;
the readings themselves are made in `orbiter.readings`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from .house import Channel
from .orbit import Track
from .response import low_pass, play

AXES = ("x", "y", "z")
#: Channels that can carry a generic field, by the name of the cause.
GENERIC = ("heater_current", "transmitter_current", "payload_current", "wheel_current")
PRODUCTS = (
    ("payload_current", "coil_temperature"),
    ("transmitter_current", "electronics_temperature"),
    ("camera_current", "wheel_current"),
)
FAMILY = {"heater": "current", "voltage": "current", "flag": "current", "other": "current"}
FAMILY |= {"solar_current": "solar", "battery_current": "battery", "camera_current": "camera"}
FAMILY |= {"torquer_current": "torquer", "sunlight": "day_night", "sun_direction": "sun_angle"}


@dataclass(frozen=True, eq=False)
class World:
    """Everything causes are made from: flight, true field in sensor axes (time, 3) nT, channels."""

    track: Track
    field: np.ndarray
    strength: np.ndarray
    rate: np.ndarray
    house: dict[str, Channel]
    orbit_period: float

    @cached_property
    def direction(self) -> np.ndarray:
        """Unit vector of the field; (time, 3)."""
        return self.field / self.strength[:, None]


@dataclass(frozen=True)
class Cause:
    """One cause at one size.

    `field_vector`, `field_scalar` (time, 3) nT at the sensors; `gain` (time, 3) the reading is divided by
    ``1 - gain``; `ageing` (time, 3) relative growth of the scale factors; `bend` quadratic and cubic
    terms (2, 3) of the linearisation, 1/nT and 1/nT^2; `shift` (time,) s by which the scalar sensor is
    early; `bias` (time,) nT of the scalar sensor; `offset` (time, 3) nT of the vector sensor's reading,
    `angle` (time, 3) deg of its axes xy, xz, yz. `coefficients` are dicts quantity, axis, value, unit, at.
    """

    name: str
    families: tuple[str, ...]
    channels: tuple[str, ...] = ()
    field_vector: np.ndarray | None = None
    field_scalar: np.ndarray | None = None
    gain: np.ndarray | None = None
    ageing: np.ndarray | None = None
    bend: np.ndarray | None = None
    shift: np.ndarray | None = None
    bias: np.ndarray | None = None
    offset: np.ndarray | None = None
    angle: np.ndarray | None = None
    coefficients: tuple[dict[str, Any], ...] = ()
    told: dict[str, Any] = field(default_factory=dict)

    def scaled(self, size: float) -> Cause:
        """Return the cause `size` times as large."""
        arrays = (
            "field_vector",
            "field_scalar",
            "gain",
            "ageing",
            "bend",
            "shift",
            "bias",
            "offset",
            "angle",
        )
        changed = {key: getattr(self, key) * size for key in arrays if getattr(self, key) is not None}
        grown = tuple(one | {"value": float(one["value"] * size)} for one in self.coefficients)
        return replace(self, **changed, coefficients=grown)

    def seen(self, world: World) -> np.ndarray:
        """Return what the cause adds to |B_vector| - F, to first order; (time,) nT."""
        b, u = world.field, world.direction
        vector = np.zeros_like(b)
        if self.field_vector is not None:
            vector = vector + self.field_vector
        if self.offset is not None:
            vector = vector + self.offset
        if self.angle is not None:
            xy, xz, yz = np.deg2rad(self.angle).T
            vector = vector + np.stack([xy * b[:, 1] + xz * b[:, 2], yz * b[:, 2], 0.0 * b[:, 2]], axis=1)
        if self.field_scalar is not None:
            vector = vector - self.field_scalar
        if self.gain is not None:
            vector = vector + b * self.gain
        if self.ageing is not None:
            vector = vector - b * self.ageing
        if self.bend is not None:
            vector = vector - b**2 * (self.bend[0] + self.bend[1] * b)
        out = np.einsum("ta,ta->t", u, vector)
        if self.shift is not None:
            out = out + self.shift * world.rate
        return out - self.bias if self.bias is not None else out


Maker = Callable[[World, np.random.Generator], Cause]


def _axis(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _coefficients(quantity: str, values: np.ndarray, unit: str, at: str = "difference") -> tuple[dict, ...]:
    return tuple(
        {"quantity": quantity, "axis": axis, "value": float(value), "unit": unit, "at": at}
        for axis, value in zip(AXES, values, strict=True)
    )


def _follows(
    world: World, rng: np.random.Generator, name: str, series: np.ndarray, quantity: str = "coefficient"
) -> Cause:
    """Return a field that follows a series: at the vector sensor, at the scalar one, or at both."""
    channel, axis = world.house[name], _axis(rng)
    reduced = (0.0, 1.0, 0.35)[rng.integers(3)]
    at_vector = 0.0 if reduced == 1.0 else 1.0
    fields = {"field_vector": at_vector * series[:, None] * axis} if at_vector else {}
    fields |= {"field_scalar": reduced * series[:, None] * axis} if reduced else {}
    family = FAMILY.get(channel.kind, channel.kind)
    coefficients = _coefficients(quantity, (at_vector - reduced) * axis, f"nT/{_unit(channel)}")
    return Cause(f"{name} field", (family,), (name,), coefficients=coefficients, **fields)


def _unit(channel: Channel) -> str:
    return "K" if channel.unit == "degC" else channel.unit


def follows(name: str) -> Maker:
    """Return the maker of a field that follows a channel at once."""
    return lambda world, rng: _follows(world, rng, name, world.house[name].values)


def other_current(world: World, rng: np.random.Generator) -> Cause:
    """Return the field of one of the lesser currents."""
    return follows(GENERIC[rng.integers(len(GENERIC))])(world, rng)


def slowly_follows(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that follows a current through a slow response of unit gain."""
    name = ("battery_current", "solar_current", "payload_current", "camera_current")[rng.integers(4)]
    tau = float(np.exp(rng.uniform(np.log(200.0), np.log(4000.0))))
    made = _follows(world, rng, name, low_pass(world.house[name].values, tau, world.track.step))
    return replace(made, name=f"slow {name} field", told={"lag_s": tau})


def product(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that follows the product of two channels."""
    first, second = PRODUCTS[rng.integers(len(PRODUCTS))]
    series, axis = world.house[first].values * world.house[second].values, _axis(rng)
    return Cause(
        "product field",
        ("unknown", "current"),
        (first, second),
        series[:, None] * axis,
        told={"product": True},
    )


def hysteresis(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that follows the boom temperature with play."""
    series = world.house["boom_temperature"].values
    width = float(rng.uniform(0.8, 1.6) * series.std())
    made = _follows(world, rng, "boom_temperature", play(series, width), "play")
    return replace(made, name="boom hysteresis", families=("hysteresis",), told={"width": width})


def torquer(world: World, rng: np.random.Generator) -> Cause:
    """Return the stray field of the three coils at the vector sensor; nT/mA."""
    matrix = rng.normal(size=(3, 3)) + np.diag(rng.choice([-3.0, 3.0], 3))
    stray = world.house["torquer_current"].values @ matrix.T
    told = tuple(
        {"quantity": "matrix", "axis": f"{a}{b}", "value": float(matrix[i, j]), "unit": "nT/mA",
         "at": "difference"}
        for i, a in enumerate(AXES)
        for j, b in enumerate(AXES)
    )  # fmt: skip
    return Cause("torquer field", ("torquer",), ("torquer_current",), stray, coefficients=told)


def temperature_scale(world: World, rng: np.random.Generator) -> Cause:
    """Return scale factors that follow the coil temperature."""
    channel = world.house["coil_temperature"]
    change, linear = channel.values - channel.values.mean(), rng.choice([-1, 1], 3) * rng.uniform(0.5, 1.5, 3)
    told = _coefficients("linear", linear, "1/K", "vector")
    gain = change[:, None] * linear
    return Cause("scale temperature", ("temperature",), ("coil_temperature",), gain=gain, coefficients=told)


def ageing(world: World, rng: np.random.Generator) -> Cause:
    """Return scale factors that grow by one number a day."""
    days, rate = world.track.seconds / 86_400.0, rng.uniform(0.5, 1.5, 3) * rng.choice([-1, 1])
    told = _coefficients("rate", rate, "1/d", "vector")
    return Cause("ageing", ("ageing",), ageing=days[:, None] * rate, coefficients=told)


def nonlinearity(world: World, rng: np.random.Generator) -> Cause:
    """Return a quadratic (or cubic) bend of the vector sensor."""
    cubic, amount = bool(rng.integers(2)), rng.choice([-1, 1], 3) * rng.uniform(0.5, 1.5, 3) * 1e-9
    amount = amount * (1e-5 if cubic else 1.0)
    told = _coefficients("cubic" if cubic else "quadratic", amount, "1/nT^2" if cubic else "1/nT", "vector")
    bend = np.stack([0 * amount, amount] if cubic else [amount, 0 * amount])
    return Cause("nonlinearity", ("nonlinearity",), bend=bend, coefficients=told)


def clock(world: World, rng: np.random.Generator) -> Cause:
    """Return a scalar sensor that is early (or late) throughout."""
    early = float(rng.choice([-1, 1]))
    told = ({"quantity": "seconds", "axis": "", "value": early, "unit": "s", "at": "scalar"},)
    return Cause("clock shift", ("clock",), shift=np.full(world.rate.size, early), coefficients=told)


def clock_drift(world: World, rng: np.random.Generator) -> Cause:
    """Return a scalar sensor whose clock goes wrong at a steady rate, right in the middle of the span."""
    t = world.track.seconds / 86_400.0
    rate = float(rng.choice([-1, 1]))
    told = ({"quantity": "seconds", "axis": "", "value": rate, "unit": "s/d", "at": "scalar"},)
    return Cause("clock drift", ("clock",), shift=rate * (t - t.mean()), coefficients=told)


def clock_episode(world: World, rng: np.random.Generator) -> Cause:
    """Return a scalar sensor that is early for four days."""
    t = world.track.seconds / 86_400.0
    begin, early = rng.uniform(0.2, 0.8) * (t[-1] - 4.0), float(rng.choice([-1, 1]))
    told = ({"quantity": "seconds", "axis": "", "value": early, "unit": "s", "at": "scalar"},)
    inside = (t >= begin) & (t < begin + 4.0)
    return Cause(
        "clock episode", ("clock",), shift=early * inside, coefficients=told, told={"from_d": float(begin)}
    )


def scalar_bias(world: World, rng: np.random.Generator) -> Cause:
    """Return a constant the scalar sensor adds."""
    sign = float(rng.choice([-1, 1]))
    told = ({"quantity": "bias", "axis": "", "value": sign, "unit": "nT", "at": "scalar"},)
    return Cause("scalar bias", ("bias",), bias=np.full(world.rate.size, sign), coefficients=told)


def offset_step(world: World, rng: np.random.Generator) -> Cause:
    """Return offsets that jump once, at a time nobody told."""
    axis, at = _axis(rng), rng.uniform(0.3, 0.7) * world.track.seconds[-1]
    after = (world.track.seconds >= at)[:, None] * axis
    told = _coefficients("step", axis, "nT", "vector")
    return Cause("offset step", ("offset_step",), offset=after, coefficients=told, told={"at_s": float(at)})


def angle_step(world: World, rng: np.random.Generator) -> Cause:
    """Return misalignment angles that jump once: from then on x reads more of y and z, y more of z."""
    amount, at = _axis(rng), rng.uniform(0.3, 0.7) * world.track.seconds[-1]
    after = (world.track.seconds >= at)[:, None] * amount
    told = tuple(
        {"quantity": "misalignment", "axis": axis, "value": float(value), "unit": "deg", "at": "vector"}
        for axis, value in zip(("xy", "xz", "yz"), amount, strict=True)
    )
    return Cause("angle step", ("sensor",), angle=after, coefficients=told, told={"at_s": float(at)})


def day_night(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that is there in sunlight."""
    axis = _axis(rng)
    lit = world.track.sunlit[:, None] * axis
    return Cause("day field", ("day_night",), ("sunlit",), lit, coefficients=_coefficients("lit", axis, "nT"))


def eclipse_warmth(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that comes and goes with sunlight, slowly, as a body warms and cools."""
    axis, tau = _axis(rng), float(np.exp(rng.uniform(np.log(200.0), np.log(2000.0))))
    lit = low_pass(world.track.sunlit.astype(np.float64), tau, world.track.step)[:, None] * axis
    told = _coefficients("lit", axis, "nT")
    return Cause("slow day field", ("day_night",), ("sunlit",), lit, coefficients=told, told={"lag_s": tau})


def sun_angle(world: World, rng: np.random.Generator) -> Cause:
    """Return a field by where the Sun shines from, in two degrees of harmonics; none in shadow."""
    first, second = world.track.sun @ _axis(rng), (world.track.sun @ _axis(rng)) ** 2 - 1.0 / 3.0
    made = world.track.sunlit[:, None] * (np.outer(first, _axis(rng)) + np.outer(second, _axis(rng)))
    return Cause("Sun angle field", ("sun_angle",), ("sun_direction",), made)


def remanent(world: World, rng: np.random.Generator) -> Cause:
    """Return a constant field at the scalar sensor: the offsets take it up."""
    made = np.broadcast_to(_axis(rng), world.field.shape)
    return Cause("remanent field", ("remanent",), field_scalar=made, told={"unidentifiable": True})


def induced(world: World, rng: np.random.Generator) -> Cause:
    """Return a field at the scalar sensor that follows the ambient one an axis: scale factors take it up."""
    made = world.field * (_axis(rng) * 1e-5)
    return Cause("induced field", ("induced",), field_scalar=made, told={"unidentifiable": True})


def eddy(world: World, rng: np.random.Generator) -> Cause:
    """Return a field that follows the ambient field's change in the body, nT per nT/s, no common part."""
    amount = _axis(rng)
    amount = amount - amount.mean()
    change = np.gradient(world.field, world.track.step, axis=0)
    return Cause(
        "eddy currents",
        ("eddy",),
        field_vector=change * amount,
        coefficients=_coefficients("eddy", amount, "s"),
    )


def tone(world: World, rng: np.random.Generator) -> Cause:
    """Return a sine at a period that the mission records."""
    period = away_from_orbit(world.orbit_period, rng)
    axis = _axis(rng)
    wave = np.cos(2 * np.pi * world.track.seconds / period + rng.uniform(0, 2 * np.pi))[:, None] * axis
    told = _coefficients("amplitude", np.abs(axis), "nT")
    return Cause("recorded tone", ("tone",), (), wave, coefficients=told, told={"period_s": period})


def switch(world: World, rng: np.random.Generator) -> Cause:
    """Return a periodic switch nobody recorded, mostly on one axis."""
    period, duty = away_from_orbit(world.orbit_period, rng), rng.uniform(0.3, 0.6)
    seen = np.flatnonzero(np.sqrt(np.mean(world.direction**2, axis=0)) > 0.4)
    main = int(rng.choice(seen))
    axis = np.eye(3)[main] + rng.normal(0.0, 0.15, 3) * (np.arange(3) != main)
    on = ((world.track.seconds / period + rng.uniform()) % 1.0 < duty).astype(np.float64)
    told = {"period_s": period, "axis": AXES[main], "duty": float(duty), "unrecorded": True}
    return Cause("unrecorded switch", ("unknown",), (), on[:, None] * axis, told=told)


def away_from_orbit(orbit_period: float, rng: np.random.Generator) -> float:
    """Return a period of 15 to 70 min whose harmonics and sidebands keep off those of the orbit, s."""
    while True:
        period = float(np.exp(rng.uniform(np.log(900.0), np.log(4200.0))))
        turns = orbit_period / period
        if min(abs(turns - k / 2) for k in range(1, 16)) > 0.08:
            return period


CAUSES: dict[str, Maker] = {
    "nonlinearity": nonlinearity,
    "temperature_scale": temperature_scale,
    "temperature_offset": follows("boom_temperature"),
    "ageing": ageing,
    "torquer": torquer,
    "solar": follows("solar_current"),
    "battery": follows("battery_current"),
    "camera": follows("camera_current"),
    "other_current": other_current,
    "day_night": day_night,
    "eclipse_warmth": eclipse_warmth,
    "sun_angle": sun_angle,
    "induced": induced,
    "remanent": remanent,
    "eddy": eddy,
    "clock": clock,
    "clock_drift": clock_drift,
    "clock_episode": clock_episode,
    "scalar_bias": scalar_bias,
    "offset_step": offset_step,
    "angle_step": angle_step,
    "tone": tone,
    "hysteresis": hysteresis,
    "slow": slowly_follows,
    "product": product,
    "switch": switch,
}
