"""What has no name is added for what it looks like, marked everywhere; the search goes on beside it."""

import json

import numpy as np
import pytest
from heated_mission import HEATED_DAYS, make_heated_workspace
from tiny_mission import TINY_START

from inflight.catalog import Catalog, Workspace
from inflight.tasks.pipelines import reprocess

NOISE = 0.05 * np.sqrt(2)
PERIOD_S = 2460.0


def tone(day, reading):
    """A field on z without a channel, 0.4 nT."""
    start = (np.datetime64(day) - np.datetime64(TINY_START)) / np.timedelta64(1, "s")
    phase = 2 * np.pi * (start + 60.0 * np.arange(1440)) / PERIOD_S
    return 0.4 * np.sin(phase)[:, None] * np.array([0.0, 0.0, 1.0])


def residual_of_products(root):
    return reprocess(Catalog(root), Workspace.open(root).mission()).extra["residual"]["after_nT"]


def test_a_line_without_a_channel_is_added_as_told_and_marked_empirical_everywhere(inflight, tmp_path):
    root = make_heated_workspace(tmp_path / "made", tone).root
    told = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    left = next(one for one in told["entries"] if one["name"] == "what is left")
    assert left["status"] == "unknown"
    assert left["command"].startswith('inflight add "tone(')
    name = left["command"].split('"')[1]
    assert float(name.split("(")[1].split(" s")[0]) == pytest.approx(PERIOD_S, rel=1e-3)

    before = residual_of_products(root)
    added = inflight("add", name, "--json", "-w", root).json
    assert added["error"]["held_out_nT"][1] == pytest.approx(NOISE, rel=0.03)
    after = residual_of_products(root)
    assert after == pytest.approx(NOISE, rel=0.03)
    assert after < 0.5 * before

    shown = inflight("model", "show", "--json", "-w", root).json
    (entry,) = (one for one in shown["model"]["effects"] if one["effect"] == "tone")
    assert entry["empirical"] is True
    assert "cause not known: tone" in inflight("model", "show", "-w", root).out
    cat = Catalog(root)
    assert cat.table("main-window", TINY_START).attrs["empirical_effects"] == "tone"
    assert cat.read(cat.current("l2/field", TINY_START)).attrs["empirical_effects"] == "tone"

    again = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    assert again["verdict"] == "NOTHING_LEFT"
    assert again["model"]["empirical"] == ["tone"]
    assert "In the model without a known cause: tone." in again["sentence"]


def test_whatever_is_added_may_be_marked_empirical_and_stays_so(inflight, tmp_path):
    root = make_heated_workspace(tmp_path / "made").root
    added = inflight("add", "channel_field(heater_current)@lag=90s", "--empirical", "--json", "-w", root)
    assert added.json["empirical"] == ["channel_field_heater_current"]
    inflight("add", "boom_temperature", "-w", root)
    effects = inflight("model", "show", "--json", "-w", root).json["model"]["effects"]
    marks = {one.get("name", one["effect"]): one.get("empirical") for one in effects}
    assert marks["channel_field_heater_current"] is True
    assert marks["channel_field_boom_temperature"] is None
    assert json.dumps(effects).count("empirical") == 1
    # A wave with harmonics, as a diagnosis names what switches: two orders, sine and cosine, three axes.
    waves = inflight("add", "tone(2460 s, order=2)", "--json", "-w", root).json
    assert len(waves["coefficients"]) == 12


@pytest.mark.parametrize("end", ["2024-03-05", "2024-03-09"])
def test_an_episode_that_reaches_the_end_of_the_record_is_added_as_a_step(inflight, tmp_path, end):
    root = make_heated_workspace(tmp_path / "made").root
    added = inflight("add", f"offset_episode@2024-03-03/{end}", "--json", "-w", root).json
    assert added["effect"] == "add offset_step@2024-03-03T00:00:00"
    whole = inflight("add", f"offset_episode@2024-02-03/{end}", "-w", root)
    assert whole.code == 1
    assert "nothing changes in it" in whole.err


#: What the scale factor of z changes by in a day (rms).
RATE = 5e-6


def wandering(seed):
    """Return a scale factor of z that walks at random, as a reading has it."""
    steps = np.random.default_rng([3, seed]).normal(0, RATE / np.sqrt(1440), 1440 * len(HEATED_DAYS))
    walk = np.cumsum(steps).reshape(len(HEATED_DAYS), 1440, 1)
    return lambda day, reading: reading * walk[HEATED_DAYS.index(day)] * np.array([0.0, 0.0, 1.0])


def test_a_parameter_that_wanders_is_added_by_one_command_and_the_residual_comes_near_the_noise(
    inflight, tmp_path
):
    root = make_heated_workspace(tmp_path / "made", wandering(1)).root
    said = inflight("diagnose", "--no-prefect", "-w", root).out
    assert "in time: scale_factor[z]: irregular, windows of " in said
    told = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    entry = told["entries"][0]
    assert (told["verdict"], entry["status"]) == ("UNKNOWN_EFFECT", "unknown")
    assert entry["command"].startswith('inflight add "wander(scale_factor[z], ')
    one = next(one for one in told["in_time"] if one["form"] != "constant")
    assert abs(one["size"] - RATE) < 3 * one["sigma"] < RATE

    added = inflight("add", entry["command"].split('"')[1], "--json", "-w", root).json
    assert added["error"]["held_out_nT"][0] > 1.3 * NOISE
    assert added["error"]["held_out_nT"][1] < 1.05 * NOISE
    assert residual_of_products(root) < 1.03 * NOISE

    shown = inflight("model", "show", "--json", "-w", root).json["model"]["effects"]
    # It changes the reading before the nine parameters.
    assert [effect["effect"] for effect in shown] == ["wander", "vector_sensor"]
    assert shown[0]["of"] == "scale_factor[z]"
    assert shown[0]["empirical"] is True
    # What is added later starts from the same values.
    later = inflight("add", "boom_temperature", "--json", "-w", root).json
    assert later["error"]["held_out_nT"][0] == pytest.approx(added["error"]["held_out_nT"][1], rel=1e-6)
    inflight("undo", "-w", root)
    again = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    assert not again["effects"]
    assert "In the model without a known cause: wander_scale_factor_z." in again["sentence"]


def test_a_bias_that_wanders_is_a_bias_with_values_in_time(inflight, tmp_path):
    root = make_heated_workspace(tmp_path / "made").root
    assert inflight("add", "wander(bias, 6 h)", "-w", root).code == 0
    (entry,) = (
        one
        for one in inflight("model", "show", "--json", "-w", root).json["model"]["effects"]
        if one["effect"] == "scalar_bias"
    )
    assert entry["empirical"] is True
    assert (entry["bias"]["time"], len(entry["bias"]["value"])) == ("spline", 16)
    assert inflight("add", "boom_temperature", "-w", root).code == 0
    wrong = inflight("add", "wander(scale, 6 h)", "-w", root)
    assert wrong.code == 1
    assert "no 'scale' that could wander" in wrong.err
    assert "it has offset[x], " in wrong.err
