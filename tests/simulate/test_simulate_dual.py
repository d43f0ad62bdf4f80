"""A simulated boom with two sensors: the same days always, the published states, the truth kept apart."""

import itertools

import numpy as np
import pytest
from pydantic import ValidationError

from inflight.simulate.dual import DualSettings, simulate_dual_day
from inflight.simulate.dual.switching import UNITS, six_states
from inflight.tasks.archive import simulate


def test_a_day_does_not_depend_on_the_days_asked_for():
    day = "2006-05-16"
    one = simulate_dual_day(DualSettings(days=1), day)
    other = simulate_dual_day(DualSettings(days=5), day)
    for name, data in one.instruments.items():
        assert data.equals(other.instruments[name])


def test_units_keep_their_state_over_midnight():
    settings = DualSettings(days=4)
    states = [simulate_dual_day(settings, day).truth["STATE"].values for day in settings.day_list]
    for before, after in itertools.pairwise(states):
        assert before[-1] == after[0]


def test_readings_are_field_stray_field_and_offset():
    settings = DualSettings(overrides={"turned": 0.0, "noise_inboard": 0.0, "noise_outboard": 0.0})
    made = simulate_dual_day(settings, settings.day_list[0])
    truth = made.truth
    for name, end in (("ib", "IN"), ("ob", "OUT")):
        expected = truth["FIELD"] + truth[f"STRAY_{end}"] + truth[f"OFFSET_{end}"]
        assert np.abs(made.instruments[name]["B_RAW"] - expected).max() <= 0.0041


def test_the_published_states_differ_as_printed():
    inner, outer = six_states()
    printed = np.array([-9.39, -6.71, -4.05, 0.5, 2.89, 2.72])
    assert np.allclose(-(inner - outer)[:, 0], printed, atol=0.001)
    assert np.allclose(-outer[:, 0], [-6.18, -6.12, -1.68, 0.5, 2.49, 3.63])
    settings = DualSettings(include=("six_states",))
    truth = simulate_dual_day(settings, settings.day_list[0]).truth
    assert set(np.unique(truth["STATE"])) == set(range(6))
    assert np.allclose(truth["STRAY_OUT"].values, outer[truth["STATE"].values])


def test_commissioning_switches_every_unit_by_itself():
    truth = simulate_dual_day(DualSettings(), "2006-05-14").truth
    states = truth["STATE"].values[: 12 * 3600]
    assert {1 << place for place in range(len(UNITS))} | {0} == set(np.unique(states))


def test_a_hidden_unit_has_no_housekeeping_but_its_field():
    settings = DualSettings(hide=("camera",), include=("new_unit",))
    made = simulate_dual_day(settings, settings.day_list[-1])
    assert "I_CAM" not in made.instruments["hk"]
    states = made.truth["STATE"].values
    assert (states & 4).any()
    assert (states & 1 << len(UNITS)).any()


def test_gaps_of_the_sensors_are_their_own():
    settings = DualSettings(defects=("gaps", "spikes"))
    made = simulate_dual_day(settings, settings.day_list[0])
    stamps = [set(made.instruments[name]["Epoch"].values.tolist()) for name in ("ib", "ob")]
    assert stamps[0] != stamps[1]
    assert all(len(one) < 86_400 for one in stamps)


def test_an_effect_nobody_knows_is_refused():
    with pytest.raises(ValidationError, match="no effect"):
        DualSettings(include=("wheel",))


def test_files_and_truth_are_written_apart(tmp_path):
    paths = simulate(DualSettings(days=1), tmp_path, workers=1)
    assert sorted(path.parent.name for path in paths) == ["hk", "ib", "ob", "slow"]
    assert [path.suffix for path in (tmp_path / "truth").glob("vex_truth_*")] == [".nc"]
