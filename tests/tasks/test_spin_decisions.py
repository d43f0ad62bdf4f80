"""The tables of a turning sensor: values are replaced where a day warrants it, and the reason is kept."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from inflight.mission import Mission
from inflight.model import Model
from inflight.spin import PARAMETER_NAMES, SPIN_RELATED
from inflight.tasks.pipelines.spin.tables import spin_table
from inflight.time import day_bounds

ROOT = Path(__file__).parents[2] / "missions"
FIRST = np.datetime64("2012-03-01", "D")
SIGMA = np.array([0.01 if name.startswith("offset") else 2e-5 for name in SPIN_RELATED])
TRUTH = np.array([1.001, 1e-3, -1e-3, 2e-3, 1e-3, 1e-3, 3.0, -4.0])
AT = {name: index for index, name in enumerate(SPIN_RELATED)}
ONE = PARAMETER_NAMES.index("spin_axis[x]")


@pytest.fixture(scope="module")
def model():
    mission = Mission.parse((ROOT / "imp8.yaml").read_text(encoding="utf-8"))
    return Model.parse((ROOT / "models/imp8-preflight.yaml").read_text(encoding="utf-8"), mission)


def day_of(number, value):
    start, end = day_bounds(FIRST + number)
    return xr.Dataset(
        {
            "value": (("block", "parameter"), value[None]),
            "covariance": (("block", "parameter", "other"), np.diag(SIGMA**2)[None]),
            "sigma": (("block", "parameter"), SIGMA[None]),
            "estimate": (("block", "sub", "parameter"), np.zeros((1, 20, 8))),
            "start": ("block", np.array([start])),
            "end": ("block", np.array([end])),
        }
    )


def table_of(model, truths, seed, zero=None, days_each=1):
    generator = np.random.default_rng(seed)
    days = [day_of(number, generator.normal(truth, SIGMA)) for number, truth in enumerate(truths)]
    edges = [FIRST + number for number in range(0, len(days) + 1, days_each)]
    return spin_table(days, model, edges, "daily", zero)


def test_noise_alone_replaces_hardly_anything(model):
    places = [PARAMETER_NAMES.index(name) for name in SPIN_RELATED]
    replaced = []
    for seed in range(20, 28):
        table = table_of(model, np.tile(TRUTH, (10, 1)), seed)
        assert (table["decision"].values[0, places] == "update").all()
        update = table["decision"].values[1:] == "update"
        replaced.append(update[:, places].mean())
        # Values change where it was decided, and nowhere else.
        assert np.array_equal(np.diff(table["value"].values, axis=0) != 0.0, update)
        assert np.ptp(table["own"].values[:, places], axis=0).min() > 0.0
        kept = table["reason"].values[1:][(table["decision"].values[1:] != "update")]
        assert any("jitter" in str(one) for one in kept)
    # Beyond three sigma of both errors lie 0.3 %.
    assert np.mean(replaced) < 0.015


def test_a_step_replaces_what_stepped(model):
    truths = np.tile(TRUTH, (8, 1))
    truths[5:, AT["spin_axis[x]"]] += 20.0 * SIGMA[AT["spin_axis[x]"]]
    table = table_of(model, truths, seed=4)
    assert table["decision"].values[5, ONE] == "update"
    assert "more than both uncertainties" in str(table["reason"].values[5, ONE])
    assert np.array_equal(table["value"].values[5], np.where(np.arange(12) == ONE, table["value"].values[5],
                                                             table["value"].values[4]))  # fmt: skip
    assert table["value"].values[7, ONE] == pytest.approx(truths[5, AT["spin_axis[x]"]], abs=4e-5 * 2)


def test_a_drift_is_followed_within_the_stated_errors(model):
    truths = np.tile(TRUTH, (20, 1))
    at = AT["offset[1]"]
    truths[:, at] += 0.008 * np.arange(20)
    table = table_of(model, truths, seed=5)
    place = PARAMETER_NAMES.index("offset[1]")
    assert (table["decision"].values[1:, place] == "update").sum() >= 2
    pulls = (table["value"].values[:, place] - truths[:, at]) / table["sigma"].values[:, place]
    assert np.abs(pulls).max() < 4.0


def test_what_nothing_in_flight_tells_stays_as_on_the_ground(model):
    table = table_of(model, np.tile(TRUTH, (2, 1)), seed=6)
    for name in ("spin_plane_gain", "axial_gain", "rotation"):
        place = PARAMETER_NAMES.index(name)
        assert (table["decision"].values[:, place] == "").all()
        assert "ground" in str(table["reason"].values[0, place])
        assert (table["origin"].values[:, place] == "ground").all()
        assert np.isinf(table["own_sigma"].values[:, place]).all()


def test_windows_decide_as_days_do(model):
    truths = np.tile(TRUTH, (12, 1))
    truths[9:, AT["azimuth"]] += 30.0 * SIGMA[AT["azimuth"]]
    table = table_of(model, truths, seed=7, days_each=3)
    assert table["decision"].values[:, PARAMETER_NAMES.index("azimuth")].tolist() == [
        "update", *("keep" if one == "keep" else "confirm" for one in
                    table["decision"].values[1:3, PARAMETER_NAMES.index("azimuth")]), "update",
    ]  # fmt: skip


def test_the_axial_offset_is_replaced_by_the_same_rules(model):
    days = [day_bounds(FIRST + number) for number in range(4)]
    zero = xr.Dataset(
        {
            "value": ("interval", np.array([1.5, 1.6, 3.0, np.nan])),
            "sigma": ("interval", np.array([0.2, 0.2, 0.2, np.inf])),
            "method": ("interval", np.array(["wang-pan"] * 4)),
            "start": ("interval", np.array([one[0] for one in days])),
            "end": ("interval", np.array([one[1] for one in days])),
        }
    )
    table = table_of(model, np.tile(TRUTH, (4, 1)), seed=8, zero=zero)
    place = PARAMETER_NAMES.index("offset[3]")
    assert table["decision"].values[:, place].tolist() == ["update", "keep", "update", "keep"]
    assert table["value"].values[:, place].tolist() == [1.5, 1.5, 3.0, 3.0]
    assert "does not tell" in str(table["reason"].values[3, place])
