"""The month of the page on missing effects: what is hidden is named, and what is not there is not."""

import pytest

from inflight.catalog import Catalog, Workspace
from inflight.simulate import SimulationSettings
from inflight.tasks.analysis import diagnose
from inflight.tasks.archive import ingest, simulate

#: What the pre-flight model does not know of this satellite beside the hidden field, by what it follows.
UNKNOWN = {"camera_current", "battery_current", "solar_current", "heater_current", "scale_drift"}


@pytest.mark.slow
def test_the_field_in_sunlight_is_named_and_five_small_causes_take_nothing_from_it(tmp_path):
    workspace = Workspace.create(tmp_path / "month", "champ")
    text = workspace.mission_file.read_text("utf-8").replace("cadence: 1 s", "cadence: 5 s")
    workspace.mission_file.write_text(text, "utf-8")
    simulate(SimulationSettings(days=30, cadence=5, hide=("day_night",)), workspace.data, workers=1)
    catalog = Catalog(workspace.root)
    ingest(catalog, workspace.mission(), workspace.data)
    found = diagnose(catalog, workspace.mission())
    first = found.entries[0]
    assert (first.name, first.status) == ("day_night", "sure")
    value = next(one for one in found.effects[0].coefficients if one.name.endswith("[z]"))
    assert abs(value.value - 0.65) < 4 * value.sigma < 0.1
    for one in found.entries[1:]:
        assert one.status != "sure" or any(name in one.name for name in UNKNOWN), one
        assert "*" not in one.name
