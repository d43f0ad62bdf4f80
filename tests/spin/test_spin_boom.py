"""A mission with two magnetometers on a boom: each calibrated by the spin, and the bend between them."""

import numpy as np
import pytest
from boom_mission import BENDS, make_boom_workspace

from inflight.catalog import Catalog
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.intercalibration.tables import unwrap_phase


@pytest.fixture(scope="module")
def boom(tmp_path_factory):
    """Three quarter days, both sensors calibrated, and the report of the boom."""
    workspace = make_boom_workspace(tmp_path_factory.mktemp("boom"))
    cat, mission = Catalog(workspace.root), workspace.mission()
    for comparison in ("main", "inboard"):
        settings = ReprocessSettings(comparison=comparison, table="span")
        assert reprocess(cat, mission, settings=settings).days["done"] == 3
    return cat, mission, reprocess(cat, mission, settings=ReprocessSettings(comparison="boom"))


def test_the_bend_of_each_day_is_in_a_certified_table(boom):
    cat, _, report = boom
    assert report.days["done"] == 3
    assert report.outputs == ["tables/boom-bending"]
    table = cat.table("boom-bending", "2012-03-02")
    value, sigma = table["value"].values[:, 0], table["sigma"].values[:, 0]
    assert np.abs((value - BENDS) / sigma).max() < 4.0
    assert sigma.max() < 3e-4
    assert table["units"].values[0] == "rad"


def test_the_same_days_again_change_nothing(boom):
    cat, mission, _ = boom
    again = reprocess(cat, mission, settings=ReprocessSettings(comparison="boom"))
    assert again.days["unchanged"] == 3
    assert again.days["done"] == 0
    assert len(cat.tables("boom-bending")) == 1


def test_a_phase_runs_on_across_a_gap():
    seconds = np.concatenate([np.arange(0.0, 60.0, 0.25), np.arange(97.3, 140.0, 0.25)])
    phase = 2.0 * np.pi * seconds / 3.1
    found = unwrap_phase(np.mod(phase, 2.0 * np.pi), (seconds * 1e9).astype(np.int64))
    np.testing.assert_allclose(found - found[0], phase - phase[0], atol=1e-6)
