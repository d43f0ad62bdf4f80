"""A mission small enough to go through the whole chain within a test, one sample a minute."""

from pathlib import Path

import numpy as np

TINY_YAML = """\
mission: tiny
description: A rotating vector magnetometer beside an absolute one, one sample a minute
instruments:
  turning:
    role: vector
    cadence: 60 s
    files: {pattern: "turning_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variables: [x, y, z], unit: nT}}
  absolute:
    role: scalar
    cadence: 60 s
    files: {pattern: "absolute_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels: {field: {variable: f, unit: nT}}
comparisons: {main: {kind: scalar, vector: turning, scalar: absolute}}
"""
TINY_START = "2024-03-01"
#: What the vector instrument adds to every axis, nT, and by what it multiplies.
TINY_OFFSET = np.array([20.0, -10.0, 5.0])
TINY_GAIN = np.array([1.0002, 0.9999, 1.0001])


def tiny_readings(
    day: str, seed: int = 0, offset: np.ndarray = TINY_OFFSET, gain: np.ndarray = TINY_GAIN
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return UTC stamps (time,), vector readings (time, axis) and scalar readings (time,) of one day, nT."""
    generator = np.random.default_rng([seed, int(np.datetime64(day, "D").astype(int))])
    times = np.datetime64(day, "s") + 60 * np.arange(1440)
    field = tiny_field()
    reading = field * gain + offset + generator.normal(0, 0.05, (1440, 3))
    return times, reading, np.linalg.norm(field, axis=1) + generator.normal(0, 0.05, 1440)


def tiny_field() -> np.ndarray:
    """Return the true field of every day; (time, axis), nT."""
    turn, tilt = np.linspace(0, 20 * np.pi, 1440), np.linspace(-1.5, 1.5, 1440)
    strength = 45_000 + 2_000 * np.sin(turn / 3)
    direction = np.stack([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)], axis=1)
    return direction * strength[:, None]


def deliver_tiny_day(
    folder: Path, day: str, seed: int = 0, offset: np.ndarray = TINY_OFFSET, gain: np.ndarray = TINY_GAIN
) -> None:
    """Write one day of both instruments as two files."""
    times, reading, scalar = tiny_readings(day, seed, offset, gain)
    stamp = day.replace("-", "")
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{t}," + ",".join(f"{v:.3f}" for v in row) for t, row in zip(times, reading, strict=True)]
    (folder / f"turning_{stamp}.csv").write_text("time,x,y,z\n" + "\n".join(rows) + "\n", encoding="utf-8")
    rows = [f"{t},{value:.3f}" for t, value in zip(times, scalar, strict=True)]
    (folder / f"absolute_{stamp}.csv").write_text("time,f\n" + "\n".join(rows) + "\n", encoding="utf-8")


def make_tiny_workspace(root: Path, days: int = 2) -> Path:
    """Make a workspace of the tiny mission with so many delivered days."""
    from inflight.catalog import Workspace

    yaml = root.parent / f"{root.name}.yaml"
    yaml.parent.mkdir(parents=True, exist_ok=True)
    yaml.write_text(TINY_YAML, encoding="utf-8")
    workspace = Workspace.create(root, yaml)
    for day in np.datetime64(TINY_START, "D") + np.arange(days):
        deliver_tiny_day(workspace.data, str(day))
    return root
