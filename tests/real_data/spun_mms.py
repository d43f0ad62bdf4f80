"""MMS 1's field as a spinning sensor with known errors would have read it, delivered with sun pulses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from injections import REAL

from inflight.catalog import Catalog, Workspace
from inflight.spin import CalibrationParameters
from inflight.tasks.archive import ingest

FILE = REAL / "mms1-fgm-srvy-20190601" / "mms1_fgm_srvy_l2_gsm_20190601T2300_20190602T0100.npz"
#: Sizes of the errors put in: what ground tests leave.
SIZES = {
    "gain_ratio": 1e-3, "elevation[1]": 2e-3, "elevation[2]": 2e-3, "azimuth": 2e-3, "spin_axis[x]": 3e-3,
    "spin_axis[y]": 3e-3, "offset[1]": 3.0, "offset[2]": 3.0, "offset[3]": 1.0,
}  # fmt: skip
_MISSION = """
mission: mms1-spun
description: MMS1 FGM survey level 2, spun again with known errors
acknowledgement: NASA MMS FGM team
periods: {{spin: {period} s}}
instruments:
  fgm:
    role: vector
    cadence: 62.5 ms
    files: {{pattern: readings.npz, reader: npz, time: seconds, time_unit: seconds since 1970-01-01}}
    channels: {{field: {{variable: readings, unit: nT, axes: [x, y, z]}}}}
  sun:
    role: housekeeping
    cadence: {period} s
    files: {{pattern: pulses.npz, reader: npz, time: seconds, time_unit: seconds since 1970-01-01}}
    channels: {{sun_pulse: {{variable: period, unit: s, kind: sun_pulse}}}}
comparisons:
  main:
    kind: spin
    vector: fgm
    phase: sun_pulse
    spin_axis: {{frame: gsm, direction: [{axis}]}}
    preflight: models/mms1-spun-preflight.yaml
"""
_PREFLIGHT = """
model: mms1-spun-preflight
version: 1
mission: mms1-spun
comparison: main
effects:
  - effect: spinning_sensor
    sensor: fgm
    gain_ratio: {time: block, unit: "1", value: 1.0, sigma: 3.0e-3}
    spin_plane_gain: {time: constant, unit: "1", value: 1.0, sigma: 1.0e-3, free: false}
    axial_gain: {time: constant, unit: "1", value: 1.0, sigma: 1.0e-3, free: false}
    elevation: {time: block, unit: rad, value: [0.0, 0.0], sigma: [4.0e-3, 4.0e-3]}
    azimuth: {time: block, unit: rad, value: 0.0, sigma: 4.0e-3}
    spin_axis: {time: block, unit: rad, value: [0.0, 0.0], sigma: [0.01, 0.01]}
    rotation: {time: constant, unit: rad, value: 0.0, sigma: 4.0e-3, free: false}
    offset: {time: block, unit: nT, value: [0.0, 0.0, 0.0], sigma: [10.0, 10.0, 10.0]}
"""


@dataclass(frozen=True)
class Spun:
    """A workspace with the archive, and the truth behind it."""

    workspace: Workspace
    truth: CalibrationParameters
    published: np.ndarray


def errors(seed: int) -> CalibrationParameters:
    """Draw errors of either sign."""
    drawn = np.random.default_rng(seed).normal(size=len(SIZES))
    present = CalibrationParameters()
    return present.changed(
        {
            name: (1.0 if name == "gain_ratio" else 0.0) + size * draw
            for (name, size), draw in zip(SIZES.items(), drawn, strict=True)
        }
    )


def spun(root: Path, seed: int) -> Spun:
    """Spin the published field about a random axis, read it with random errors, and take it in.

    Periods and phases differ too: else every seed would meet the same fluctuation at its spin.
    """
    rng = np.random.default_rng([seed, 1])
    period = round(rng.uniform(2.5, 5.0), 3)
    axis = rng.standard_normal(3)
    while abs(axis[0]) > 0.9 * np.linalg.norm(axis):  # the Sun has to be seen
        axis = rng.standard_normal(3)
    with np.load(FILE) as held:
        seconds, published = held["unix_time_s"], held["B_GSM_nT"]
    up = axis / np.linalg.norm(axis)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    payload = published @ np.stack([ahead, np.cross(up, ahead), up], axis=1)
    first = seconds[0] - (10.0 + rng.random()) * period
    phase = 2.0 * np.pi * (seconds - first) / period
    turning = np.stack(
        [
            np.cos(phase) * payload[:, 0] + np.sin(phase) * payload[:, 1],
            np.cos(phase) * payload[:, 1] - np.sin(phase) * payload[:, 0],
            payload[:, 2],
        ],
        axis=1,
    )
    truth = errors(seed)
    data = root / "delivered"
    data.mkdir(parents=True)
    np.savez(data / "readings.npz", seconds=seconds, readings=truth.disturb(turning))
    pulses = first + period * np.arange(0, int((seconds[-1] - first) / period) + 10)
    np.savez(data / "pulses.npz", seconds=pulses, period=np.full(pulses.size, period))
    source = root / "yaml" / "mms1-spun.yaml"
    (source.parent / "models").mkdir(parents=True)
    told = _MISSION.format(period=period, axis=", ".join(f"{one:.9f}" for one in axis))
    source.write_text(told, encoding="utf-8")
    (source.parent / "models" / "mms1-spun-preflight.yaml").write_text(_PREFLIGHT, encoding="utf-8")
    workspace = Workspace.create(root / "workspace", source)
    assert ingest(Catalog(workspace.root), workspace.mission(), data).days["failed"] == 0
    return Spun(workspace, truth, published)
