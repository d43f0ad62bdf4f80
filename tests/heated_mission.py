"""The tiny mission with a heater and a boom temperature, and a field that no model of it knows."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tiny_mission import TINY_START, TINY_YAML, deliver_tiny_day

from inflight.catalog import Catalog, Workspace
from inflight.tasks.archive import ingest

#: What a sensor reads beside what the tiny mission knows: (day, reading (time, component) nT) -> nT.
Hidden = Callable[[str, np.ndarray], np.ndarray]
HOUSEKEEPING = """\
  power:
    role: housekeeping
    cadence: 60 s
    files: {pattern: "power_{day:%Y%m%d}.csv", reader: table, delimiter: ",", time: time}
    channels:
      heater_current: {variable: heater, unit: mA, kind: heater}
      boom_temperature: {variable: boom, unit: degC, kind: temperature}
comparisons:"""
#: What the heater adds at the vector sensor, nT/A.
HEATER_FIELD = np.array([2.0, 0.0, -1.5])
HEATED_DAYS = [str(day) for day in np.datetime64(TINY_START, "D") + np.arange(4)]


def housekeeping(day: str) -> tuple[np.ndarray, np.ndarray]:
    """Return heater current (mA) and boom temperature (degC) of a day, a sample a minute."""
    generator = np.random.default_rng([9, int(np.datetime64(day, "D").astype(int))])
    switched = np.repeat(generator.integers(0, 2, 48), 30)
    minutes = np.arange(1440)
    return 500.0 * switched, np.round(8 + 6 * np.sin(2 * np.pi * minutes / 700 + generator.uniform(0, 6)), 2)


def heater_field(day: str, reading: np.ndarray) -> np.ndarray:
    """Return the heater's field at the vector sensor; (time, axis) nT."""
    return housekeeping(day)[0][:, None] / 1000 * HEATER_FIELD


def nothing(day: str, reading: np.ndarray) -> np.ndarray:
    """Return no field."""
    return np.zeros_like(reading)


def deliver_heated_day(folder: Path, day: str, hidden: Hidden, scalar: Hidden = nothing) -> None:
    """Write a day whose sensors read something more: functions of the day and of the reading."""
    heater, boom = housekeeping(day)
    stamp = day.replace("-", "")
    deliver_tiny_day(folder, day)
    for name, more in ((f"turning_{stamp}.csv", hidden), (f"absolute_{stamp}.csv", scalar)):
        head, *rows = (folder / name).read_text(encoding="utf-8").splitlines()
        stamps = [row.split(",")[0] for row in rows]
        values = np.array([row.split(",")[1:] for row in rows], dtype=float)
        values = values + more(day, values)
        lines = [f"{t}," + ",".join(f"{v:.3f}" for v in row) for t, row in zip(stamps, values, strict=True)]
        (folder / name).write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    lines = [f"{t},{i},{c}" for t, i, c in zip(stamps, heater, boom, strict=True)]
    text = "time,heater,boom\n" + "\n".join(lines) + "\n"
    (folder / f"power_{stamp}.csv").write_text(text, encoding="utf-8")


def make_heated_workspace(
    root: Path, hidden: Hidden = heater_field, scalar: Hidden = nothing, days: Sequence[str] = HEATED_DAYS
) -> Workspace:
    """Make a workspace of heated days, ingested."""
    source = root.parent / f"{root.name}.yaml"
    source.parent.mkdir(parents=True, exist_ok=True)
    source.write_text(TINY_YAML.replace("comparisons:", HOUSEKEEPING), encoding="utf-8")
    made = Workspace.create(root, source)
    for day in days:
        deliver_heated_day(made.data, day, hidden, scalar)
    ingest(Catalog(made.root), made.mission(), made.data)
    return made
