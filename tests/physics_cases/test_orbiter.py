"""The second simulator holds what it says: the true model leaves noise, a hidden cause leaves its field."""

import json
from dataclasses import replace

import numpy as np
import pytest

from inflight.catalog import Catalog
from inflight.catalog.workspace import Workspace
from inflight.model import Model
from inflight.tasks.ingest import ingest
from inflight.tasks.samples import ArchiveIndex, load_samples, needs_of

from .orbiter.case import make_case
from .orbiter.known import LEFT
from .orbiter.rivals import nine_columns
from .scenarios import Scenario, scenarios

CLEAN = Scenario("clean", days=3, known=4, decoys=0, gaps=0.0)


def true_model(case, mission):
    """The case's own model with the true values in the places of the pre-flight ones."""
    tree = json.loads(json.dumps(case.model))
    for entry in tree["effects"]:
        if entry["effect"] == "vector_sensor":
            for part in ("scale_factor", "misalignment", "offset"):
                entry[part]["value"] = getattr(case.nine, part).tolist()
        for cause in case.known.values():
            for quantity in {one["quantity"] for one in cause.coefficients} & set(entry):
                true = [one["value"] for one in cause.coefficients if one["quantity"] == quantity]
                if entry[quantity]["unit"] == "nT/A":
                    true = [1e3 * value for value in true]
                entry[quantity]["value"] = true if len(true) > 1 else true[0]
    return Model.parse(json.dumps(tree), mission)


def residual_of(case, root):
    """The residual of every day through the archive and the project's chain, under the true model."""
    cat, mission = Catalog(root), Workspace.open(root).mission()
    model = true_model(case, mission)
    needs = needs_of(mission, model)
    index = ArchiveIndex.of(cat, needs)
    days = [load_samples(cat, mission, model, day, needs, index) for day in case.days]
    return np.concatenate([model.residual(samples)[:, 0] for samples in days])


def written(scenario, tmp_path, seed=1):
    case = make_case(scenario, seed)
    workspace, truth = case.write(tmp_path)
    return case, workspace, json.loads(truth.read_text())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_true_model_leaves_noise_and_nothing_else(tmp_path, seed):
    case, workspace, _ = written(CLEAN, tmp_path, seed)
    left = residual_of(case, workspace) - case.readings.noise
    # Steps of the readings and of the channels; the clock's shift is not differentiated at the ends of days.
    assert np.nanstd(left) < 0.004
    assert np.nanmax(np.abs(left)) < 0.05


@pytest.mark.parametrize(
    "hidden",
    ["solar", "temperature_scale", "clock", "scalar_bias", "nonlinearity", "torquer", "eddy", "ageing"],
)
def test_a_hidden_cause_leaves_exactly_its_contribution(tmp_path, hidden):
    case, workspace, truth = written(replace(CLEAN, hidden=(hidden,), orbit="polar", known=1), tmp_path)
    left = residual_of(case, workspace) - case.readings.noise
    seen = case.hidden[0].seen(case.world)
    assert np.nanstd(left - seen) < 0.01 * np.std(seen) + 0.004
    assert truth["effects"][0]["rms_nT"] == pytest.approx(np.sqrt(np.mean(seen**2)))


def test_what_the_nine_parameters_leave_is_what_was_asked_for(tmp_path):
    case = make_case(replace(CLEAN, hidden=("camera",), size=(5.0, 5.0)), 4)
    seen, columns = case.hidden[0].seen(case.world), nine_columns(case.world, slice(None))
    fit, *_ = np.linalg.lstsq(columns / np.linalg.norm(columns, axis=0), seen, rcond=None)
    left = seen - columns / np.linalg.norm(columns, axis=0) @ fit
    assert np.std(left) == pytest.approx(0.5 * case.noise.size, rel=0.05)


def test_equal_seeds_give_equal_missions_and_other_seeds_others():
    first, again, other = (make_case(replace(CLEAN, days=1), seed) for seed in (5, 5, 6))
    assert np.array_equal(first.readings.vector, again.readings.vector)
    assert first.mission == again.mission
    assert not np.array_equal(first.readings.vector, other.readings.vector)


def test_the_truth_lies_outside_the_workspace(tmp_path):
    _, workspace, truth = written(replace(CLEAN, hidden=("battery",), days=1), tmp_path)
    assert truth["effects"][0]["families"] == ["battery"]
    told = "".join(path.read_text(errors="ignore") for path in workspace.rglob("*.yaml"))
    assert "retained" not in told
    assert tmp_path / "truth" not in workspace.parents


def test_a_known_cause_is_off_by_less_than_is_detectable():
    case = make_case(replace(CLEAN, days=2), 7)
    model = {entry["effect"]: entry for entry in case.model["effects"]}
    bias = np.array(model["time_shift"]["seconds"]["value"]) - case.known["clock"].coefficients[0]["value"]
    assert np.std(bias * case.world.rate) < 4 * LEFT * case.noise.size


def test_files_say_the_same_as_the_archive(tmp_path):
    scenario = replace(CLEAN, days=2, decoys=2, gaps=0.02)
    case, direct, _ = written(scenario, tmp_path / "direct")
    _, filed, _ = written(replace(scenario, files=True), tmp_path / "filed")
    report = ingest(Catalog(filed), Workspace.open(filed).mission(), filed / "data")
    assert not report.problems
    assert np.array_equal(residual_of(case, direct), residual_of(case, filed), equal_nan=True)


@pytest.mark.parametrize(
    "name", [name for name in scenarios() if name.startswith(("near", "bias", "steady"))]
)
def test_what_is_made_inseparable_is(name):
    truth = make_case(replace(scenarios()[name], days=10), 1).truth["effects"][0]
    assert truth["equivalents"] or not truth["identifiable"]


def test_dawn_and_dusk_are_never_in_shadow():
    made = [make_case(replace(scenarios()["null_dawn_dusk"], days=1, decoys=0), seed) for seed in range(5)]
    assert all(case.world.track.sunlit.min() == 1.0 for case in made)


def test_unequal_cadences_gaps_and_outliers_are_delivered():
    case = make_case(replace(scenarios()["unequal_cadences"], days=2, gaps=0.1, outliers=0.01), 1)
    steps = {name: np.median(np.diff(stamps)) / 1e9 for name, (stamps, _) in case.tables.items()}
    assert {steps["aocs"], steps["power"], steps["thermal"], steps["misc"]} == {1.0, 10.0, 32.0, 60.0}
    assert case.tables["power"][0].size == pytest.approx(0.9 * 2 * 8640, rel=0.02)
    assert case.readings.outlier.mean() == pytest.approx(0.01, rel=0.3)
