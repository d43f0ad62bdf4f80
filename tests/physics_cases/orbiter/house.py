"""Housekeeping: currents with real duty cycles, temperatures that lag, what the attitude control does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .orbit import Track
from .response import low_pass, ornstein, telegraph

#: Ground stations, latitude and longitude in degrees.
STATIONS = ((67.9, 21.1), (78.2, 15.4), (-35.4, 148.9), (5.2, -52.8))
#: Node spacing of the loops over battery and thermostat, s.
SLOW_STEP = 60.0


@dataclass(frozen=True)
class Channel:
    """A series on the base grid and how it is delivered: (time,) or (time, 3)."""

    name: str
    values: np.ndarray
    unit: str
    kind: str
    instrument: str
    resolution: float
    cadence: float = 10.0

    def renamed(self, name: str, keep_kind: bool = True) -> Channel:
        """Return the channel under another name, and of no kind when so wished."""
        return replace(self, name=name, kind=self.kind if keep_kind else "other")


def keep_house(track: Track, rng: np.random.Generator) -> dict[str, Channel]:
    """Return every real channel of the spacecraft by its telling name."""
    t, step = track.seconds, track.step
    transmitter = _passes(track) * (0.7 + 0.02 * ornstein(rng, t.size, step, 300.0, 1.0))
    payload = telegraph(rng, t.size, step, 2500.0, 5200.0)
    camera = _camera(track, rng)
    light = _panel_light(track, rng)
    boom, heater = _boom(track, light, rng)
    load = 1.8 + transmitter + 0.5 * payload + camera + 0.6 * heater
    solar, battery = _power(track, light, load, rng)
    electronics = (
        18.0
        + 6.0 * low_pass(load, 9000.0, step) / load.mean()
        + 2.5 * ornstein(rng, t.size, step, 60_000.0, 1.0)
    )
    coil = -4.0 + 5.0 * low_pass(0.6 * light + 0.4 * track.sunlit, 2600.0, step)
    coil += 1.5 * ornstein(rng, t.size, step, 40_000.0, 1.0)
    torquers = _torquers(track, rng)
    wheels = _wheels(track, rng)
    made = [
        Channel("solar_current", solar, "A", "solar_current", "power", 0.002),
        Channel("battery_current", battery, "A", "battery_current", "power", 0.002),
        Channel("camera_current", 1e3 * camera, "mA", "camera_current", "power", 0.2),
        Channel("heater_current", 600.0 * heater, "mA", "heater", "power", 1.0),
        Channel("transmitter_current", transmitter, "A", "current", "power", 0.001),
        Channel("payload_current", 500.0 * payload + ornstein(rng, t.size, step, 900.0, 6.0), "mA", "current",
                "power", 0.5),
        Channel("bus_voltage", 28.0 + 0.4 * track.sunlit - 0.12 * low_pass(load, 400.0, step)
                + ornstein(rng, t.size, step, 5000.0, 0.05), "V", "voltage", "power", 0.005),
        Channel("boom_temperature", boom, "degC", "temperature", "thermal", 0.005),
        Channel("coil_temperature", coil, "degC", "temperature", "thermal", 0.005),
        Channel("electronics_temperature", electronics, "degC", "temperature", "thermal", 0.005),
        Channel("torquer_current", torquers, "mA", "torquer_current", "aocs", 0.1),
        Channel("wheel_current", wheels, "A", "current", "aocs", 0.001),
    ]  # fmt: skip
    return {channel.name: channel for channel in made}


def _passes(track: Track) -> np.ndarray:
    """Return 1 where a ground station sees the spacecraft above 5 degrees; (time,)."""
    on = np.zeros(track.seconds.size)
    for latitude, longitude in np.deg2rad(STATIONS):
        up = np.array(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
        )
        sight = track.position - 6371.0 * up
        height = sight @ up / np.sqrt(np.einsum("ta,ta->t", sight, sight))
        on = np.maximum(on, height > np.sin(np.deg2rad(5.0)))
    return on


def _camera(track: Track, rng: np.random.Generator) -> np.ndarray:
    """Return the current of a star camera that works harder when the Sun nears its axis; A."""
    axis = rng.normal(size=3)
    towards = track.sun @ (axis / np.linalg.norm(axis))
    blinded = 1.0 / (1.0 + np.exp(-(towards - rng.uniform(0.2, 0.6)) / 0.05)) * track.sunlit
    busy = telegraph(rng, track.seconds.size, track.step, 1500.0, 9000.0)
    return 0.15 + 0.22 * blinded + 0.06 * busy + ornstein(rng, track.seconds.size, track.step, 200.0, 0.004)


def _panel_light(track: Track, rng: np.random.Generator) -> np.ndarray:
    """Return how much Sun two body-fixed panels and a roof gather, 0 to about 1; (time,)."""
    first, second = np.deg2rad(rng.uniform(25.0, 65.0, 2))
    normals = np.array(
        [[0.0, np.cos(first), -np.sin(first)], [0.0, -np.cos(second), -np.sin(second)], [0.2, 0.0, -1.0]]
    )
    seen = np.maximum(track.sun @ normals.T, 0.0) @ rng.uniform(0.4, 0.8, 3)
    return track.sunlit * seen


def _boom(track: Track, light: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the temperature of a boom whose thermostat heats below a line, degC, and the heater's 0 or 1."""
    stride = max(1, round(SLOW_STEP / track.step))
    cold, warm = rng.uniform(-14.0, -8.0), rng.uniform(16.0, 26.0)
    gain, tau, span = rng.uniform(9.0, 13.0), rng.uniform(1200.0, 2400.0), stride * track.step
    line, width = cold + rng.uniform(7.0, 11.0), rng.uniform(2.0, 4.0)
    drive = (cold + warm * (0.5 * light + 0.25 * track.sunlit))[::stride].tolist()
    at, on, temperature, heater = drive[0], 0.0, [], []
    for ambient in drive:
        on = 1.0 if at < line - width / 2 else 0.0 if at > line + width / 2 else on
        at += span / tau * (ambient + gain * on - at)
        temperature.append(at)
        heater.append(on)
    t = track.seconds
    smooth = np.interp(t, t[::stride] + span, temperature) + ornstein(rng, t.size, track.step, 8000.0, 0.25)
    return smooth, np.repeat(heater, stride)[: t.size]


def _power(
    track: Track, light: np.ndarray, load: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return array and battery currents, A: the battery carries the eclipses and is charged afterwards."""
    stride = max(1, round(SLOW_STEP / track.step))
    most, tau, span = rng.uniform(2.0, 4.0), rng.uniform(900.0, 2500.0), stride * track.step
    lit, used = track.sunlit[::stride].tolist(), load[::stride].tolist()
    missing, charge = 3000.0, []
    for sun, amps in zip(lit, used, strict=True):
        flow = sun * min(most, missing / tau)
        missing = max(missing + span * (amps * (1.0 - sun) - flow), 0.0)
        charge.append(flow)
    filled = np.interp(track.seconds, track.seconds[::stride], charge) * track.sunlit
    array = load * track.sunlit + filled + 1.6 * light
    return array, filled - load * (1.0 - track.sunlit)


def _torquers(track: Track, rng: np.random.Generator) -> np.ndarray:
    """Return three coil currents, mA: held for 20 s, driven by slow and fast errors of the attitude."""
    count, held = track.seconds.size, max(1, round(20.0 / track.step))
    slow = np.stack([ornstein(rng, count, track.step, 1500.0, 30.0) for _ in range(3)], axis=1)
    fast = np.stack([ornstein(rng, count, track.step, 120.0, 25.0) for _ in range(3)], axis=1)
    tone = 20.0 * np.cos(track.argument[:, None] + rng.uniform(0, 2 * np.pi, 3))
    wanted = np.clip(slow + fast + tone, -110.0, 110.0)
    return np.repeat(wanted[::held], held, axis=0)[:count]


def _wheels(track: Track, rng: np.random.Generator) -> np.ndarray:
    """Return the current of a reaction wheel, A: it winds up within half a day and is unloaded."""
    ramp = (track.seconds / rng.uniform(30_000.0, 50_000.0)) % 1.0
    tone = 0.08 * np.cos(track.argument + rng.uniform(0, 2 * np.pi))
    return 0.2 + 0.3 * ramp + tone + ornstein(rng, track.seconds.size, track.step, 600.0, 0.03)
