"""The second simulator holds what it says: the true model leaves noise, a hidden cause leaves its field."""

import json
from dataclasses import replace

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.tasks.archive import ingest

from .closure import as_effect, residual_of
from .orbiter.case import make_case
from .orbiter.causes import CAUSES
from .orbiter.known import LEFT
from .orbiter.rivals import nine_columns
from .scenarios import Scenario, scenarios

CLEAN = Scenario("clean", days=3, known=4, decoys=0, gaps=0.0)


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


@pytest.mark.parametrize("hidden", sorted(set(CAUSES) - {"switch"}))
def test_a_hidden_cause_leaves_exactly_its_contribution(tmp_path, hidden):
    scenario = replace(CLEAN, hidden=(hidden,), orbit="eclipses", days=5 if hidden == "clock_episode" else 2)
    case, workspace, truth = written(replace(scenario, known=1), tmp_path)
    left = residual_of(case, workspace) - case.readings.noise
    seen = case.hidden[0].seen(case.world)
    assert np.nanstd(left - seen) < 0.01 * np.std(seen) + 0.004
    assert truth["effects"][0]["rms_nT"] == pytest.approx(np.sqrt(np.mean(seen**2)))


#: Causes whose stated numbers make an effect of the project's library, and nothing else.
SAYABLE = ("solar", "temperature_offset", "other_current", "slow", "hysteresis", "torquer", "day_night")
SAYABLE += (
    "temperature_scale",
    "nonlinearity",
    "clock",
    "clock_episode",
    "scalar_bias",
    "offset_step",
    "angle_step",
    "eddy",
)


@pytest.mark.parametrize("hidden", SAYABLE)
def test_the_truth_as_an_effect_of_the_library_takes_the_cause_out(tmp_path, hidden):
    scenario = replace(CLEAN, hidden=(hidden,), orbit="eclipses", days=5 if hidden == "clock_episode" else 2)
    case, workspace, truth = written(replace(scenario, known=1), tmp_path)
    told = truth["effects"][0]
    left = residual_of(case, workspace, as_effect(case, told)) - case.readings.noise
    # What came before the first sample is nobody's to know: responses and plays settle within hours.
    settled = left[int(0.4 * 8640) :]
    assert np.nanstd(settled) < 0.03 * told["rms_nT"] + 0.004


def test_what_the_nine_parameters_leave_is_what_was_asked_for():
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
