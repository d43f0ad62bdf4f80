"""A diagnosis of two sensors while something nobody recorded switches beside the currents."""

from pathlib import Path

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.simulate.dual import DualParameters, DualSettings
from inflight.simulate.dual.switching import UNITS
from inflight.tasks.analysis import DiagnoseSettings, Workbench, diagnose_span
from inflight.tasks.archive import ingest, simulate

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"


def diagnosed(folder, seed, **more):
    """Return a diagnosis of two days every four seconds, and its workspace."""
    source = folder.parent / f"{folder.name}.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 4 s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(folder, source)
    settings = DualSettings(days=2, seed=seed, overrides={"cadence": 4.0}, **more)
    simulate(settings, made.data, workers=1)
    assert ingest(Catalog(folder), made.mission(), made.data).days["failed"] == 0
    return diagnose_span(made), made


def truth():
    """Return what one milliampere changes in the difference, axes of the inner sensor, nT."""
    numbers = DualParameters()
    out = {}
    for unit in UNITS:
        if unit.current:
            x, y, z = (unit.field_at(numbers.inboard) - unit.field_at(numbers.outboard)) / unit.current
            out[f"{unit.name}_current"] = np.array([y, -x, z])
    return out


def pulls(fields):
    """Return how far the coefficients of the currents are from the truth, in their own errors."""
    out = {}
    for one in fields["effects"]:
        name = one["channels"][0] if len(one["channels"]) == 1 else ""
        if name in truth():
            value, sigma = (np.array([c[key] for c in one["coefficients"]]) for key in ("value", "sigma"))
            out[name] = (value - truth()[name]) / sigma
    return out


@pytest.fixture(scope="module")
def unrecorded(tmp_path_factory):
    """A fourth unit switches, and no channel follows it."""
    return diagnosed(tmp_path_factory.mktemp("diagnosed") / "w", 211)


def test_recorded_units_get_their_true_coefficients_beside_one_without_a_record(unrecorded):
    found = pulls(unrecorded[0])
    assert set(found) == set(truth())
    every = np.concatenate(list(found.values()))
    assert np.abs(every).max() < 4.0
    assert np.sqrt(np.mean(every**2)) < 2.0


def test_what_is_left_is_called_a_unit_without_housekeeping(unrecorded):
    left = unrecorded[0]["remaining"]
    assert left["verdict"] == "UNKNOWN_EFFECT"
    signature = left["signature"]
    assert signature["shape"] == "unit without housekeeping"
    heater = next(unit for unit in UNITS if not unit.current)
    numbers = DualParameters()
    step = heater.field_at(numbers.inboard) - heater.field_at(numbers.outboard)
    value, sigma = np.array([signature["steps"][axis] for axis in "xyz"]).T
    assert np.all(np.abs(value - step) < 5.0 * sigma)
    assert "without housekeeping" in unrecorded[0]["sentence"]


def test_adding_the_current_takes_its_field_out(unrecorded):
    _, made = unrecorded
    bench = Workbench(Catalog(made.root), made.mission(), settings=DiagnoseSettings())
    before, after = bench.add("channel_field(spectrometer_current)").as_json()["error"]["held_out_nT"]
    assert after < 0.9 * before


def test_when_every_unit_has_a_current_nothing_is_called_without_housekeeping(tmp_path):
    fields, _ = diagnosed(tmp_path / "w", 212, without=("survival_heater",))
    found = pulls(fields)
    assert set(found) == set(truth())
    assert np.abs(np.concatenate(list(found.values()))).max() < 4.0
    signature = fields["remaining"]["signature"]
    assert signature is None or signature["shape"] != "unit without housekeeping"
