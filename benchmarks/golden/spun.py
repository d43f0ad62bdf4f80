"""Deliveries of spinning sensors made by hand: a field, turned, read with known errors, with its Sun pulses.

Written here and not taken from the simulator, so that a record needs nothing but the command line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_MISSION = """mission: {name}
periods: {{spin: {period} s}}
instruments:
{sensors}  sun:
    role: housekeeping
    cadence: {period} s
    files: {{pattern: pulses.npz, reader: npz, time: seconds, time_unit: seconds since 1970-01-01}}
    channels: {{sun_pulse: {{variable: period, unit: s, kind: sun_pulse}}}}
comparisons:
{comparisons}"""
_SENSOR = """  {name}:
    role: vector
    cadence: {cadence}
    files: {{pattern: {name}.npz, reader: npz, time: seconds, time_unit: seconds since 1970-01-01}}
    channels: {{field: {{variable: readings, unit: nT, axes: [x, y, z]}}}}
"""
_SPIN = (
    "  {comparison}: {{kind: spin, vector: {name}, phase: sun_pulse, preflight: models/{name}.yaml{more}}}\n"
)
_DUAL = "  boom: {kind: dual, inboard: inboard, outboard: outboard, preflight: models/boom.yaml}\n"
_PREFLIGHT = """model: {name}
version: 1
mission: {mission}
comparison: {comparison}
effects:
  - effect: spinning_sensor
    sensor: {name}
    gain_ratio: {{time: block, unit: "1", value: 1.0, sigma: 3.0e-3}}
    spin_plane_gain: {{time: constant, unit: "1", value: 1.0, sigma: 1.0e-3, free: false}}
    axial_gain: {{time: constant, unit: "1", value: 1.0, sigma: 1.0e-3, free: false}}
    elevation: {{time: block, unit: rad, value: [0.0, 0.0], sigma: [4.0e-3, 4.0e-3]}}
    azimuth: {{time: block, unit: rad, value: 0.0, sigma: 4.0e-3}}
    spin_axis: {{time: block, unit: rad, value: [0.0, 0.0], sigma: [0.01, 0.01]}}
    rotation: {{time: constant, unit: rad, value: 0.0, sigma: 4.0e-3, free: false}}
    offset: {{time: block, unit: nT, value: [0.0, 0.0, 0.0], sigma: [10.0, 10.0, 10.0]}}
"""


@dataclass(frozen=True)
class Sensor:
    """What a sensor reads of a field B in turning axes: ``matrix @ B + offset``."""

    matrix: np.ndarray
    offset: np.ndarray

    def read(self, field: np.ndarray) -> np.ndarray:
        """Return readings (time, 3) of a field (time, 3), nT."""
        return field @ self.matrix.T + self.offset


MMS = Sensor(
    np.array([[1.0008, 0.0021, 0.0013], [-0.0011, 0.9993, -0.0024], [0.0017, 0.0008, 1.0]]),
    np.array([2.1, -3.4, 0.8]),
)
BOOM = {
    "inboard": Sensor(
        np.array([[1.0005, 0.0, 0.0004], [0.0006, 0.9995, 0.0], [0.0, -0.0003, 1.0]]),
        np.array([2.0, -1.0, 0.3]),
    ),
    "outboard": Sensor(
        np.array([[0.9994, 0.0003, 0.001], [0.0, 1.0006, -0.001], [0.0002, 0.0, 1.0]]),
        np.array([-0.5, 0.7, -0.2]),
    ),
}
#: By what the outboard sensor is turned against the inboard one on each day, rad.
_BENDS = (0.004, -0.003, 0.0015)


def write_mms(published: Path, work: Path) -> None:
    """Spin the published field of MMS 1 about an axis, read it with errors, and write a mission of it.

    Parameters
    ----------
    published : Path
        Folder of the delivered file.
    work : Path
        Folder of the case; gets ``mission/`` and ``delivered/``.
    """
    period, axis = 3.217, np.array([0.12, -0.31, 0.94])
    with np.load(next(published.glob("*.npz"))) as held:
        seconds, field = held["unix_time_s"], held["B_GSM_nT"]
    up = axis / np.linalg.norm(axis)
    # The Sun is along x of GSM.
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    payload = field @ np.stack([ahead, np.cross(up, ahead), up], axis=1)
    first = seconds[0] - 10.37 * period
    delivered = work / "delivered"
    delivered.mkdir()
    readings = MMS.read(_turned(payload, 2.0 * np.pi * (seconds - first) / period))
    np.savez(delivered / "fgm.npz", seconds=seconds, readings=readings)
    _write_pulses(delivered, np.arange(first, seconds[-1] + 5 * period, period), period)
    direction = ", ".join(f"{one:.9f}" for one in axis)
    spin_axis = f", spin_axis: {{frame: gsm, direction: [{direction}]}}"
    _write_mission(work, "mms1-spun", period, "62.5 ms", {"main": "fgm"}, spin_axis)


def write_boom(work: Path) -> None:
    """Write three quarter days of two spinning sensors on a boom that bends from day to day."""
    period, step, rng = 2.5871, 0.32, np.random.default_rng(12)
    began = 1_330_560_000.0  # 1 March 2012
    seconds, readings = [], {name: [] for name in BOOM}
    for number, bend in enumerate(_BENDS):
        stamps = began + 86_400.0 * number + step * np.arange(round(21_600 / step))
        phase = 2.0 * np.pi * (stamps - began) / period
        field = _wind(stamps, rng)
        for name, sensor in BOOM.items():
            turned = _turned(field, phase + (bend if name == "outboard" else 0.0))
            readings[name].append(sensor.read(turned) + 0.03 * rng.standard_normal(turned.shape))
        seconds.append(stamps)
    delivered = work / "delivered"
    delivered.mkdir()
    for name, parts in readings.items():
        path = delivered / f"{name}.npz"
        np.savez(path, seconds=np.concatenate(seconds), readings=np.concatenate(parts))
    # The Sun sensor runs on while the magnetometers are off.
    _write_pulses(delivered, np.arange(began, seconds[-1][-1] + period, period), period)
    _write_mission(work, "boom", period, "320 ms", {"main": "outboard", "inboard": "inboard"})


def _turned(field: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return a field in payload axes (time, 3) as axes see it that are ahead by a phase (time,)."""
    cosine, sine = np.cos(phase), np.sin(phase)
    along = cosine * field[:, 0] + sine * field[:, 1]
    across = cosine * field[:, 1] - sine * field[:, 0]
    return np.stack([along, across, field[:, 2]], axis=1)


def _wind(seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a field like the solar wind's: 5 nT that wander in direction more than in size; (time, 3)."""
    knots = np.arange(seconds[0], seconds[-1] + 60.0, 60.0)
    steps = rng.normal(size=(knots.size, 3)) * (0.02, 0.15, 0.15)
    # Each knot forgets the one before within ten minutes.
    state, path = np.zeros(3), np.empty_like(steps)
    for place, stride in enumerate(steps):
        state = 0.9 * state + stride
        path[place] = state
    size, tilt, turn = (np.interp(seconds, knots, path[:, one]) for one in range(3))
    length = 5.0 * np.exp(size)
    return np.stack(
        [length * np.cos(tilt) * np.cos(turn), length * np.cos(tilt) * np.sin(turn), length * np.sin(tilt)],
        axis=1,
    )


def _write_pulses(folder: Path, seconds: np.ndarray, period: float) -> None:
    np.savez(folder / "pulses.npz", seconds=seconds, period=np.full(seconds.size, period))


def _write_mission(
    work: Path, name: str, period: float, cadence: str, sensors: Mapping[str, str], more: str = ""
) -> None:
    """Write the YAML of a mission and its models; `sensors` gives each comparison its sensor."""
    models = work / "mission" / "models"
    models.mkdir(parents=True)
    comparisons = [_SPIN.format(comparison=one, name=sensor, more=more) for one, sensor in sensors.items()]
    if len(sensors) > 1:
        comparisons.append(_DUAL)
        text = f"model: boom\nversion: 1\nmission: {name}\ncomparison: boom\neffects: []\n"
        (models / "boom.yaml").write_text(text, encoding="utf-8")
    for comparison, sensor in sensors.items():
        text = _PREFLIGHT.format(name=sensor, mission=name, comparison=comparison)
        (models / f"{sensor}.yaml").write_text(text, encoding="utf-8")
    described = "".join(_SENSOR.format(name=one, cadence=cadence) for one in sensors.values())
    text = _MISSION.format(name=name, period=period, sensors=described, comparisons="".join(comparisons))
    (work / "mission" / f"{name}.yaml").write_text(text, encoding="utf-8")
