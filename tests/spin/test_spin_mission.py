"""A spinning mission from its deliveries to tables, products and the effect that is missing."""

import json

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.errors import MissionError
from inflight.simulate.spinning import SpinningSettings
from inflight.spin import PARAMETER_NAMES, SPIN_RELATED
from inflight.tasks.analysis.diagnosis import diagnose
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess

SETTINGS = SpinningSettings(
    craft="imp8", days=3, seed=5, without=("zero_drift",), defects=("missing_pulses", "gaps", "spikes")
)


def workspace(folder, settings):
    made = Workspace.create(folder, settings.craft)
    simulate(settings, made.data, workers=1)
    cat, mission = Catalog(folder), made.mission()
    assert ingest(cat, mission, made.data).days["failed"] == 0
    return cat, mission


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A mission in which nothing is hidden, reprocessed."""
    cat, mission = workspace(tmp_path_factory.mktemp("spin") / "plain", SETTINGS)
    return cat, mission, reprocess(cat, mission)


def put_in(name: str) -> float:
    key, _, axis = name.partition("[")
    value = np.ravel(getattr(SETTINGS.parameters, key))
    return float(value[("1", "2", "3", "x", "y").index(axis.rstrip("]")) % 3 if axis else 0])


def test_a_spinning_mission_is_calibrated_to_what_nature_leaves(plain):
    cat, _, report = plain
    assert report.days["done"] == 3
    assert not report.days["failed"]
    days = cat.days("l2/field", states=("published",))
    assert all(day.report["after_nT"] < 1.2 * day.report["floor_nT"] for day in days)
    assert report.extra["residual"]["before_nT"] > 100 * report.extra["residual"]["after_nT"]


def test_the_eight_parameters_come_back_within_their_errors(plain):
    cat, mission, _ = plain
    table = cat.table("main-window", "2012-03-02")
    value = table["value"].values[0]
    sigma = table["sigma"].values[0]
    pulls = [
        (value[i] - put_in(name)) / sigma[i] for i, name in enumerate(PARAMETER_NAMES) if name in SPIN_RELATED
    ]
    assert np.abs(pulls).max() < 4.0
    assert mission.mission == "imp8"


def test_the_offset_along_the_axis_comes_from_natures_statistics(plain):
    cat, _, _ = plain
    table = cat.table("main-window", "2012-03-02")
    at = list(PARAMETER_NAMES).index("offset[3]")
    assert table["origin"].values[0][at] != "ground"
    assert (
        abs(table["value"].values[0][at] - SETTINGS.parameters.offset[2]) < 4 * table["sigma"].values[0][at]
    )
    unknown = [
        name
        for name, told in zip(PARAMETER_NAMES, table["origin"].values[0], strict=True)
        if told == "ground"
    ]
    assert unknown == ["spin_plane_gain", "axial_gain", "rotation"]


def test_a_product_is_the_field_outside(plain):
    cat, _, _ = plain
    data = cat.read(cat.days("l2/field", states=("published",))[1])
    assert {"field_sensor", "field_payload", "spin_phase", "uncertainty", "flag"} <= set(data.variables)
    # In payload axes the wind does not turn with the spin: what a wrong calibration would make of it.
    field, phase = data["field_payload"].values, data["spin_phase"].values
    good = (data["flag"].values == 0) & np.isfinite(field).all(axis=1)
    tone = np.abs(np.mean(field[good] * np.exp(1j * phase[good])[:, None], axis=0))
    assert tone.max() < 0.02
    assert np.nanmedian(data["uncertainty"].values) < 0.5


def test_nothing_is_missing_where_nothing_is_hidden(plain):
    cat, mission, _ = plain
    found = diagnose(cat, mission).as_json()
    assert found["effects"] == []
    assert found["verdict"] in ("NOTHING_LEFT", "NOT_IDENTIFIABLE")


def test_a_coil_that_is_driven_at_the_spin_is_found(tmp_path):
    settings = SpinningSettings(craft="imp8", days=3, seed=6, hide=("torquer",))
    cat, mission = workspace(tmp_path / "coil", settings)
    found = diagnose(cat, mission).as_json()
    assert found["verdict"] == "FOUND"
    (effect,) = found["effects"]
    assert effect["family"] == "torquer"
    assert effect["channels"] == ["coil_current"]
    parameters = settings.parameters
    for one, truth in zip(effect["coefficients"], parameters.torquer_field, strict=True):
        expected = truth / (1e3 * parameters.torquer_current)
        assert abs(one["value"] - expected) < 4 * one["sigma"] + 0.02 * abs(expected), json.dumps(effect)
    assert found["residual"]["held_out_after_nT"] < 1.2 * found["residual"]["noise_floor_nT"]


def test_a_second_run_changes_nothing(plain):
    cat, mission, _ = plain
    again = reprocess(cat, mission)
    assert again.days["unchanged"] == 3
    assert again.days["done"] == 0


def test_what_a_spin_comparison_has_not_is_refused(plain):
    cat, mission, _ = plain
    with pytest.raises(MissionError, match="continuous"):
        reprocess(cat, mission, settings=ReprocessSettings(table="continuous"))
