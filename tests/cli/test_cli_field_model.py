"""A sensor without an absolute instrument beside it, calibrated against a model of the Earth's field."""

import datetime as dt
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.archive import simulated_workspace
from inflight.catalog import Workspace
from inflight.simulate import SimulationSettings, simulate_day
from inflight.tasks.analysis import DiagnoseSettings, Workbench
from inflight.tasks.analysis.diagnosis import diagnose
from inflight.tasks.pipelines import reprocess

DAYS = 2
#: Only the sensor's own numbers are wrong, and the model lacks 5 nT of ionosphere and crust.
SETTINGS = SimulationSettings(
    seed=5,
    start=dt.date(2005, 1, 1),
    days=DAYS,
    cadence=10,
    defects=(),
    without=tuple(
        sorted(set(SimulationSettings.standard_effects) - {"offset", "misalignment", "external_field"})
    ),
)
COMPARISONS = "comparisons: {main: {kind: field_model, vector: fgm, external: 5}}\n"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    cat = simulated_workspace(tmp_path_factory.mktemp("platform") / "w", DAYS, settings=SETTINGS, workers=1)
    assert reprocess(cat, with_field_model(cat)).exit_code == 0
    return cat


def with_field_model(cat):
    """The workspace's mission with one comparison: its fluxgate against the IGRF."""
    path = cat.workspace / "mission.yaml"
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith(("comparisons:", "preflight:"))]
    path.write_text("".join([*kept, COMPARISONS]), encoding="utf-8")
    return Workspace.open(cat.workspace).mission()


def test_the_product_is_nearer_to_the_truth_than_the_model_it_was_held_against(workspace):
    off, model, sigma, before = [], [], [], []
    for day in SETTINGS.day_list:
        product, truth = (
            workspace.read_day("l2/field", day),
            simulate_day(SETTINGS, day).truth["FIELD"].values,
        )
        off.append(product["field_spacecraft"].values - truth)
        model.append(product["field_model"].values - truth)
        sigma.append(product["uncertainty"].values)
        before.append(product["residual_preflight"].values)
    off, model, sigma, before = (np.concatenate(one) for one in (off, model, sigma, before))
    # (docs/how-to/platform-magnetometer.md has the numbers.)
    rms = [np.sqrt(np.nanmean(one**2, axis=0)) for one in (before, model, off, sigma)]
    assert rms[0].max() > 50  # before calibration
    assert (rms[1] > 4).all()  # what the model lacks
    assert (rms[2] < 1).all()
    assert (rms[2] < 1.5 * rms[3]).all()  # the stated error covers


def test_compare_and_chain_say_what_the_sensor_is(workspace, inflight):
    compared = inflight("compare", "-w", workspace.workspace, "--json").json
    assert [one["axis"] for one in compared["components"]] == ["x", "y", "z"]
    assert compared["residual"]["after_nT"] == pytest.approx(5.0, rel=0.1)
    last = inflight("chain", "-w", workspace.workspace, "--json").json["intervals"][-1]
    assert (last["first"], last["last"]) == ("2005-01-01", "2005-01-02")
    found = {one["name"]: one for one in last["parameters"]}
    truth = json.loads(simulate_day(SETTINGS, SETTINGS.day_list[0]).truth.attrs["nine_parameters"])
    for name, expected in zip(
        ("offset x", "offset y", "offset z", "angle between x and z"),
        [*truth["offset"], truth["misalignment"][1]],
        strict=True,
    ):
        assert abs(found[name]["value"] - expected) < 3 * found[name]["sigma"], name
    assert found["offset z"]["sigma"] < 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("vector: fgm,", "vector: fgm, model: chaos.shc,", "no file 'chaos.shc'"),
        ("kind: attitude,", "kind: other,", "a field model needs an attitude (kind: attitude)"),
    ],
)
def test_what_a_field_model_needs_is_asked_for_by_name(workspace, inflight, old, new, message):
    path = Path(workspace.workspace) / "mission.yaml"
    text = path.read_text(encoding="utf-8")
    try:
        path.write_text(text.replace(old, new), encoding="utf-8")
        found = inflight("reprocess", "--no-prefect", "-w", workspace.workspace)
    finally:
        path.write_text(text, encoding="utf-8")
    assert found.code != 0
    assert message in found.out + found.err


@pytest.mark.slow
def test_a_current_beside_the_sensor_is_named(tmp_path):
    settings = SETTINGS.model_copy(
        update={
            "without": tuple(sorted(set(SETTINGS.without) - {"battery"})),
            "overrides": {"battery_field": (2.0, -2.0, 4.0)},
        }
    )
    cat = simulated_workspace(tmp_path / "w", DAYS, settings=settings, workers=1)
    mission = with_field_model(cat)
    assert reprocess(cat, mission).exit_code == 0
    found = diagnose(cat, mission, settings=DiagnoseSettings())
    names = [one.name for one in found.entries]
    assert any("battery_current" in name for name in names), names
    # Taken out of the product, it stands apart, and beside the field that still has it.
    Workbench(cat, mission).add("channel_field(battery_current)")
    assert reprocess(cat, mission).exit_code == 0
    product = cat.read_day("l2/field", SETTINGS.day_list[0])
    turn = Rotation.from_quat(mission.instruments["fgm"].orientation)
    (term,) = (name for name in product if name.startswith("correction_"))
    still_in = turn.apply(product["field_sensor"].values + product[term].values)
    np.testing.assert_allclose(product["before_stray_field"].values, still_in, atol=2e-4)
    assert np.abs(product["before_stray_field"].values - product["field_spacecraft"].values).max() > 1
