"""A parameter that the pre-flight model of a spinning sensor holds at a wrong value."""

import json

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.simulate.spinning import SpinningSettings
from inflight.spin import spinning_sensor_of
from inflight.tasks.analysis import Workbench
from inflight.tasks.archive import ingest, simulate

SETTINGS = SpinningSettings(craft="imp8", days=2, seed=41, without=("zero_drift",))
HELD = SETTINGS.parameters.gain_ratio + 0.0011
BEFORE = 'gain_ratio: {time: block, unit: "1", value: 1.0, sigma: 3.0e-3}'
AFTER = f'gain_ratio: {{time: block, unit: "1", value: {HELD:.7f}, sigma: 3.0e-3, free: false}}'


@pytest.mark.slow
def test_a_gain_ratio_held_at_a_wrong_value_is_found_and_freed_in_place(tmp_path):
    made = Workspace.create(tmp_path / "held", "imp8")
    file = made.models / "imp8-preflight.yaml"
    text = file.read_text()
    assert BEFORE in text
    file.write_text(text.replace(BEFORE, AFTER))
    simulate(SETTINGS, made.data, workers=1)
    cat, mission = Catalog(made.root), made.mission()
    ingest(cat, mission, made.data)
    found, steps = Workbench(cat, mission).auto()
    told = found.as_json()
    assert [one["name"] for one in told["effects"]] == ["spinning_sensor.gain_ratio"], json.dumps(told)
    (step,) = steps
    assert len(step.model.model.effects) == len(mission_model(made)["effects"])
    entry = spinning_sensor_of(step.model.model)
    freed = entry.parameters["gain_ratio"]
    off = float(np.ravel(freed.value)[0]) - SETTINGS.parameters.gain_ratio
    assert freed.free
    assert abs(off) < 4.0 * float(np.ravel(freed.sigma)[0])
    assert abs(off) < 2e-4
    assert told["residual"]["held_out_after_nT"] < told["residual"]["held_out_before_nT"]


def mission_model(made: Workspace) -> dict:
    from ruamel.yaml import YAML

    return YAML(typ="safe").load((made.models / "imp8-preflight.yaml").read_text())
