"""Missions that are described rightly have no finding, whatever physics is hidden in them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boom_mission import make_boom_workspace
from heated_mission import make_heated_workspace
from plumbing_cases import survey_of

from inflight.catalog import Catalog
from inflight.plumbing import find_faults
from inflight.simulate import SimulationSettings
from inflight.simulate.dual import DualSettings
from inflight.simulate.spinning import SpinningSettings
from inflight.tasks import check_plumbing
from inflight.tasks.archive import simulate

MISSIONS = Path(__file__).parents[2] / "missions"
#: Mission, settings of a day of it, and what its YAML says otherwise.
SIMULATED = {
    "venus-express": (
        DualSettings(days=1, seed=31, overrides={"cadence": 10.0}),
        ("cadence: 1 s", "cadence: 10 s"),
    ),
    "champ": (
        SimulationSettings(days=1, seed=5, cadence=10, include=("day_night", "hysteresis", "eddy")),
        ("cadence: 1 s", "cadence: 10 s"),
    ),
    "themis": (SpinningSettings(craft="themis", days=1, seed=11), ("", "")),
}


@pytest.mark.parametrize("mission", SIMULATED)
def test_a_simulated_mission_is_clean(tmp_path, mission):
    settings, (old, new) = SIMULATED[mission]
    simulate(settings, tmp_path, workers=1)
    text = (MISSIONS / f"{mission}.yaml").read_text(encoding="utf-8").replace(old, new)
    assert find_faults(survey_of(text, tmp_path)) == ()


def test_a_hidden_field_is_no_fault(tmp_path):
    made = make_heated_workspace(tmp_path / "w")
    assert check_plumbing(Catalog(made.root), made.mission()) == ()


def test_two_sensors_on_a_boom_that_bends_are_clean(tmp_path):
    made = make_boom_workspace(tmp_path / "boom", days=2)
    for comparison in ("main", "inboard", "boom"):
        assert check_plumbing(Catalog(made.root), made.mission(), comparison=comparison) == ()


def test_in_noise_nothing_is_told(champ):
    """Fields that hardly change, with clocks and axes that nothing tells: no finding in six records."""
    text, folder = champ
    survey = survey_of(text, folder, "between", without=("orbit", "attitude"))
    generator = np.random.default_rng(7)
    for _ in range(6):
        fields = {
            role: replace(
                one, values=20.0 * generator.normal(size=3) + generator.normal(size=one.values.shape)
            )
            for role, one in survey.fields.items()
        }
        assert find_faults(replace(survey, fields=fields, channels={})) == ()


@pytest.mark.parametrize("lost", ["vector", "scalar", "position", "attitude", "all but one"])
def test_what_was_not_measured_is_no_fault(champ, lost):
    text, folder = champ
    survey = survey_of(text, folder)
    fields = {
        role: replace(one, values=np.full_like(one.values, np.nan)) if lost == role else one
        for role, one in survey.fields.items()
    }
    channels = {
        name: replace(one, values=np.full_like(one.values, np.nan)) if lost == name else one
        for name, one in survey.channels.items()
    }
    if lost == "all but one":
        fields.pop("scalar")
    assert find_faults(replace(survey, fields=fields, channels=channels)) == ()
