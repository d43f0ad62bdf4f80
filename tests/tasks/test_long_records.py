"""A search over hundreds of days: blocks of several days take the same steps as those of hours."""

import numpy as np
import pytest
from long_mission import DRIFT, HEATER, HEATER_LAG_S, STEP_S, add_later_days, make_long_workspace

from inflight.catalog import Workspace
from inflight.errors import CalibrationError
from inflight.tasks.analysis import DiagnoseSettings, block_grams, diagnose, gram_pass
from inflight.tasks.analysis.diagnosis import make_pass, plan_pass
from inflight.tasks.archive import ChannelReader, DerivedChannels


@pytest.fixture(scope="module", params=[261, pytest.param(1000, marks=pytest.mark.slow)])
def found(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("long") / "mission"
    return diagnose(make_long_workspace(root, request.param), Workspace.open(root).mission())


def test_a_slow_field_and_an_ageing_sensor_are_told_and_nothing_else(found):
    names = [one["name"].split("@")[0] for one in found.as_json()["effects"]]
    assert names == ["channel_field(heater_current)", "scale_drift"]
    # Nor is a block lost to the leap second in the record.
    assert found.blocks["lost"] == {}


def test_the_lag_and_the_sizes_come_back(found):
    heater, drift = found.as_json()["effects"]
    # The channel is known at the end of each step only: on average it is half a step late.
    assert heater["lag_s"] == pytest.approx(HEATER_LAG_S - STEP_S / 2, rel=0.05)
    told = np.array([one["value"] for one in heater["coefficients"]])
    assert told == pytest.approx(HEATER, abs=2e-5)
    told = np.array([one["value"] for one in drift["coefficients"]])
    # A reading that grows is calibrated by a factor that falls.
    assert told == pytest.approx(-DRIFT, rel=0.15)


def test_values_are_those_of_the_datas_own_cadence_though_a_block_is_lost(tmp_path, monkeypatch):
    cat = make_long_workspace(tmp_path / "mission", 202)
    made = gram_pass.block_grams

    def without_the_third(cat, mission, plan, index, derived, days):
        if not plan.estimates and days[0] == plan.blocks[2][0]:
            raise CalibrationError("nothing is left of it", remedy="none")
        return made(cat, mission, plan, index, derived, days)

    monkeypatch.setattr(gram_pass, "block_grams", without_the_third)
    mission = Workspace.open(tmp_path / "mission").mission()
    found = diagnose(cat, mission, settings=DiagnoseSettings(cadence_s=2 * STEP_S))
    assert len(found.blocks["lost"]) == 2
    assert set(found.blocks["lost"].values()) == {"nothing is left of it"}
    effects = found.as_json()["effects"]
    assert effects
    for one in effects:
        assert one["cadence_s"] == STEP_S
        assert one["cadence_shift"] is not None


def test_further_days_make_their_own_blocks_only(tmp_path):
    cat = make_long_workspace(tmp_path / "mission", 202, later=3)
    mission = Workspace.open(tmp_path / "mission").mission()

    def blocks():
        """Return every published block's run, by its first day."""
        made = make_pass(cat, mission, None, None, DiagnoseSettings())
        days = cat.days("equations/main/library", states=("published",))
        return made, {str(day.day): day.run for day in days}

    before, runs = blocks()
    add_later_days(cat, 202, 3)
    after, later = blocks()
    # The last block was not full; two more days fill the next one.
    assert len(set(runs.values())) == 1
    fresh = {day for day, run in later.items() if runs.get(day) != run}
    assert fresh == set(sorted(later)[-2:])
    assert after.plan.span[1] > before.plan.span[1]
    # The same as if all days had been there: what the first survey found holds for the later ones.
    count = len(before.loaded.raw) - 1
    np.testing.assert_array_equal(after.loaded.raw.squares[:count], before.loaded.raw.squares[:count])


def test_a_worker_is_sent_all_days_its_blocks_are_made_from_and_few_more(tmp_path):
    cat = make_long_workspace(tmp_path / "mission", 202)
    mission = Workspace.open(tmp_path / "mission").mission()
    planned = plan_pass(cat, mission, DiagnoseSettings())
    plan = planned.plan

    def made(block, index):
        reader = ChannelReader(cat, mission, plan.channel_needs, index, plan.cadence_ns, plan.span)
        derived = DerivedChannels(
            reader, plan.days, plan.channel_summaries, plan.library.placebos, plan.origin.days
        )
        return block_grams(cat, mission, plan, index, derived, block)[0]

    for block in (plan.blocks[0], plan.blocks[1], plan.blocks[50], plan.blocks[-1]):
        sent = planned.index.around(plan.read_for([block[0]]))
        assert len(sent.days) < 0.1 * len(planned.index.days)
        few, all_days = made(block, sent), made(block, planned.index)
        for name in few.data_vars:
            np.testing.assert_array_equal(few[name].values, all_days[name].values)


@pytest.mark.slow
def test_a_record_that_grew_between_diagnoses_gets_the_verdict_of_one_that_came_at_once(tmp_path):
    settings, said = DiagnoseSettings(draws=100, rounds=2), []
    for name, later in (("grown", 3), ("at-once", 0)):
        cat = make_long_workspace(tmp_path / name, 205 - later, later)
        mission = Workspace.open(tmp_path / name).mission()
        if later:
            make_pass(cat, mission, None, None, settings)
            add_later_days(cat, 205 - later, later)
        said.append(diagnose(cat, mission, settings=settings).as_json())
    grown, at_once = said
    assert grown["verdict"] == at_once["verdict"] == "FOUND"
    assert [one["name"] for one in grown["effects"]] == [one["name"] for one in at_once["effects"]]
    # The first survey holds, as of an earlier part of the record: nowhere does that move a value noticeably.
    for one, other in zip(grown["effects"], at_once["effects"], strict=True):
        for mine, same in zip(one["coefficients"], other["coefficients"], strict=True):
            assert mine["value"] == pytest.approx(same["value"], abs=0.2 * same["sigma"])
