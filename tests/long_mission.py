"""A mission of hundreds of days, written into its archive directly, a sample every eight minutes.

A rotating vector magnetometer beside an absolute one, a heater that switches and a panel whose current
follows the orbit. Not in the model are the heater's field, which follows its current slowly, and the drift of
the scale factors.
"""

from pathlib import Path

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, DayData, Workspace, write_segment
from inflight.time import to_tt2000

STEP_S = 480
#: The last day of 2008, which has a leap second, is in it.
LONG_START = "2008-10-01"
LONG_YAML = f"""\
mission: long
description: A rotating vector magnetometer beside an absolute one, with two currents
instruments:
  turning:
    role: vector
    cadence: {STEP_S} s
    files: {{pattern: "turning_{{day:%Y%m%d}}.csv", reader: table, delimiter: ",", time: time}}
    channels: {{field: {{variables: [x, y, z], unit: nT}}}}
  absolute:
    role: scalar
    cadence: {STEP_S} s
    files: {{pattern: "absolute_{{day:%Y%m%d}}.csv", reader: table, delimiter: ",", time: time}}
    channels: {{field: {{variable: f, unit: nT}}}}
  power:
    role: housekeeping
    cadence: {STEP_S} s
    files: {{pattern: "power_{{day:%Y%m%d}}.csv", reader: table, delimiter: ",", time: time}}
    channels:
      heater_current: {{variable: heater, unit: mA, kind: heater}}
      panel_current: {{variable: panel, unit: mA, kind: solar_current}}
comparisons: {{main: {{kind: scalar, vector: turning, scalar: absolute}}}}
"""
#: Drift of the scale factors, 1/d.
DRIFT = np.array([4e-7, -3e-7, 3e-7])
#: Field of the heater, nT/mA, and how slowly it follows the current, s.
HEATER, HEATER_LAG_S = np.array([0.4, 0.0, -0.3]) * 1e-3, 3000.0


def _readings(days: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return TT2000 (time,) and every channel (time, ...) of the whole record."""
    generator, per_day = np.random.default_rng(1), 86_400 // STEP_S
    start = np.datetime64(LONG_START, "s")
    stamps = np.asarray(to_tt2000(start + STEP_S * np.arange(days * per_day)), dtype=np.int64)
    seconds = STEP_S * np.arange(stamps.size, dtype=np.float64)
    turn, tilt = 2 * np.pi * seconds / 6100.0, 1.4 * np.sin(2 * np.pi * seconds / 41_000.0)
    direction = np.stack([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)], axis=1)
    strength = 45_000 + 2_000 * np.sin(2 * np.pi * seconds / 93_000.0)
    # On or off for some hours at a time.
    on = np.repeat(generator.random(stamps.size // 20 + 1) < 0.4, 20)[: stamps.size]
    heater = 800.0 * on
    warm, decay = np.empty(stamps.size), np.exp(-STEP_S / HEATER_LAG_S)
    level = heater[0]
    for place, value in enumerate(heater):
        level = value + (level - value) * decay
        warm[place] = level
    noise = generator.normal(0, 0.05, (stamps.size, 4))
    field = direction * strength[:, None] * [1.0002, 0.9999, 1.0001]
    field *= 1.0 + DRIFT * seconds[:, None] / 86_400.0
    return stamps, {
        "turning": field + [20.0, -10.0, 5.0] + warm[:, None] * HEATER + noise[:, :3],
        "absolute": strength + noise[:, 3],
        "heater_current": heater,
        "panel_current": 2000.0 * np.clip(np.sin(turn * 6100.0 / 5560.0), 0.0, None),
    }


def make_long_workspace(root: Path, days: int, later: int = 0) -> Catalog:
    """Make a workspace whose archive holds so many days; `later` more are left for `add_later_days`."""
    yaml = root.parent / f"{root.name}.yaml"
    yaml.parent.mkdir(parents=True, exist_ok=True)
    yaml.write_text(LONG_YAML, encoding="utf-8")
    Workspace.create(root, yaml)
    cat = Catalog(root)
    _write_days(cat, days + later, range(days))
    return cat


def add_later_days(cat: Catalog, days: int, later: int) -> None:
    """Write the days that `make_long_workspace` left."""
    _write_days(cat, days + later, range(days, days + later))


def _write_days(cat: Catalog, total: int, which: range) -> None:
    root, (stamps, series) = cat.workspace, _readings(total)
    contents = {
        "turning": {"field": (("time", "axis"), "turning", "nT", "vector")},
        "absolute": {"field": (("time",), "absolute", "nT", "scalar")},
        "power": {
            "heater_current": (("time",), "heater_current", "mA", "heater"),
            "panel_current": (("time",), "panel_current", "mA", "solar_current"),
        },
    }
    per_day = 86_400 // STEP_S
    first = np.datetime64(LONG_START, "D")
    with cat.run("simulate", {"days": len(which)}) as run:
        for instrument, channels in contents.items():
            found = []
            for day in which:
                part = slice(day * per_day, (day + 1) * per_day)
                data = {
                    name: (
                        dims,
                        series[source][part],
                        {"units": unit, "kind": kind, "cadence_ns": STEP_S * 10**9},
                    )
                    for name, (dims, source, unit, kind) in channels.items()
                }
                data["tt2000"] = (("time",), stamps[part], {})
                data["flag"] = (("time",), np.zeros(per_day, dtype=np.uint32), {})
                found.append(DayData(str(first + day), xr.Dataset(data), key=f"{instrument}-{day}"))
            run.attach(write_segment(root, run.id, f"l1/{instrument}", found))
        run.publish()
