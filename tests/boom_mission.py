"""Quarter days of a spinning mission with two magnetometers on a boom that bends."""

from pathlib import Path

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.simulate.spinning import SpinningSettings, simulate_spinning_day
from inflight.spin import CalibrationParameters, respin
from inflight.tasks.archive import ingest
from inflight.time import to_utc

SETTINGS = SpinningSettings(craft="imp8", days=3, seed=12)
#: The bend on each day, rad; the boom lies straight on none.
BENDS = (0.004, -0.003, 0.0015)
SENSORS = {
    "inboard": CalibrationParameters(gain_ratio=1.001, offset=(2.0, -1.0, 0.3)),
    "outboard": CalibrationParameters(gain_ratio=0.9988, elevation=(0.001, -0.001), offset=(-0.5, 0.7, -0.2)),
}
_SENSOR = """  {name}:
    role: vector
    cadence: 320 ms
    files: {{pattern: "{name}_{{day:%Y%m%d}}.npz", reader: npz, time: utc}}
    channels: {{field: {{variable: readings, unit: nT, axes: [x, y, z]}}}}
"""
_MISSION = (
    "mission: boom\nperiods: {spin: 2.5871 s}\ninstruments:\n"
    + "".join(_SENSOR.format(name=name) for name in SENSORS)
    + """  sun:
    role: housekeeping
    cadence: 2.5871 s
    files: {pattern: "sun_{day:%Y%m%d}.npz", reader: npz, time: utc}
    channels: {sun_pulse: {variable: period, unit: s, kind: sun_pulse}}
comparisons:
  main: {kind: spin, vector: outboard, phase: sun_pulse, preflight: models/outboard.yaml}
  inboard: {kind: spin, vector: inboard, phase: sun_pulse, preflight: models/inboard.yaml}
  boom: {kind: dual, inboard: inboard, outboard: outboard, preflight: models/boom.yaml}
"""
)
_PREFLIGHT = """model: {name}
version: 1
mission: boom
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


def deliver(folder, number, day):
    """Write the first quarter of a day as both sensors and the Sun sensor have it."""
    made = simulate_spinning_day(SETTINGS, day)
    count = made.truth.sizes["record"] // 4
    field, phase = made.truth["FIELD"].values[:count], made.truth["PHASE"].values[:count]
    stamps = made.truth["Epoch"].values[:count]
    rng = np.random.default_rng([5, number])
    tag = str(day).replace("-", "")
    for name, sensor in SENSORS.items():
        bend = BENDS[number] if name == "outboard" else 0.0
        readings = sensor.disturb(respin(field, phase + bend)) + 0.03 * rng.standard_normal(field.shape)
        np.savez(folder / f"{name}_{tag}.npz", utc=to_utc(stamps), readings=readings)
    pulses = made.instruments["sun"]
    # The Sun sensor runs on while the magnetometers are off.
    np.savez(
        folder / f"sun_{tag}.npz", utc=to_utc(pulses["Epoch"].values), period=pulses["SPIN_PERIOD"].values
    )


def make_boom_workspace(root: Path, days: int = 3) -> Workspace:
    """Make a workspace with so many quarter days in its archive."""
    for name in ("delivered", "yaml/models"):
        (root / name).mkdir(parents=True)
    (root / "yaml" / "boom.yaml").write_text(_MISSION, encoding="utf-8")
    for name, comparison in (("outboard", "main"), ("inboard", "inboard")):
        text = _PREFLIGHT.format(name=name, comparison=comparison)
        (root / "yaml" / "models" / f"{name}.yaml").write_text(text, encoding="utf-8")
    empty = "model: boom\nversion: 1\nmission: boom\ncomparison: boom\neffects: []\n"
    (root / "yaml" / "models" / "boom.yaml").write_text(empty, encoding="utf-8")
    for number, day in enumerate(SETTINGS.day_list[:days]):
        deliver(root / "delivered", number, day)
    workspace = Workspace.create(root / "workspace", root / "yaml" / "boom.yaml")
    found = ingest(Catalog(workspace.root), workspace.mission(), root / "delivered")
    assert found.days["failed"] == 0
    return workspace
