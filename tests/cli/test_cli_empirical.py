"""What has no name is added for what it looks like, marked everywhere; the search goes on beside it."""

import json

import numpy as np
import pytest
from heated_mission import make_heated_workspace
from tiny_mission import TINY_START

from inflight.catalog import Catalog

NOISE = 0.05 * np.sqrt(2)
PERIOD_S = 2460.0


def tone(day, reading):
    """A field on z without a channel, 0.4 nT."""
    start = (np.datetime64(day) - np.datetime64(TINY_START)) / np.timedelta64(1, "s")
    phase = 2 * np.pi * (start + 60.0 * np.arange(1440)) / PERIOD_S
    return 0.4 * np.sin(phase)[:, None] * np.array([0.0, 0.0, 1.0])


def test_a_line_without_a_channel_is_added_as_told_and_marked_empirical_everywhere(inflight, tmp_path):
    root = make_heated_workspace(tmp_path / "made", tone).root
    told = inflight("diagnose", "--no-prefect", "--json", "-w", root).json
    left = next(one for one in told["entries"] if one["name"] == "what is left")
    assert left["status"] == "unknown"
    assert left["command"].startswith('inflight add "tone(')
    name = left["command"].split('"')[1]
    assert float(name.split("(")[1].split(" s")[0]) == pytest.approx(PERIOD_S, rel=1e-3)

    assert inflight("reprocess", "--no-prefect", "-w", root).code == 0
    before = inflight("compare", "--json", "-w", root).json["residual"]["after_nT"]
    added = inflight("add", name, "--json", "-w", root).json
    assert added["error"]["held_out_nT"][1] == pytest.approx(NOISE, rel=0.03)
    assert inflight("reprocess", "--no-prefect", "-w", root).code == 0
    after = inflight("compare", "--json", "-w", root).json["residual"]["after_nT"]
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
    assert added.code == 0
    inflight("add", "boom_temperature", "-w", root)
    effects = inflight("model", "show", "--json", "-w", root).json["model"]["effects"]
    marks = {one.get("name", one["effect"]): one.get("empirical") for one in effects}
    assert marks["channel_field_heater_current"] is True
    assert marks["channel_field_boom_temperature"] is None
    assert json.dumps(effects).count("empirical") == 1


@pytest.mark.parametrize("end", ["2024-03-05", "2024-03-09"])
def test_an_episode_that_reaches_the_end_of_the_record_is_added_as_a_step(inflight, tmp_path, end):
    root = make_heated_workspace(tmp_path / "made").root
    added = inflight("add", f"offset_episode@2024-03-03/{end}", "--json", "-w", root).json
    assert added["effect"] == "add offset_step@2024-03-03T00:00:00"
    whole = inflight("add", f"offset_episode@2024-02-03/{end}", "-w", root)
    assert whole.code == 1
    assert "nothing changes in it" in whole.err
