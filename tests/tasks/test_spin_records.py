"""Records of a turning sensor that are older, longer-winded or less complete than usual."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import inflight.tasks.pipelines.spin.tables as spin_tables
from inflight.errors import CalibrationError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.model import Model
from inflight.spin import PARAMETER_NAMES, SPIN_RELATED
from inflight.tasks.pipelines.spin import SpinResults
from inflight.tasks.pipelines.spin.compare import _tone_coordinates, _ToneRecord
from inflight.tasks.pipelines.spin.day import pad_days
from inflight.tasks.pipelines.spin.report import _phase
from inflight.tasks.pipelines.spin.tables import zero_level_table
from inflight.time import SECOND, day_bounds

ROOT = Path(__file__).parents[2] / "missions"
OLD, NEW = np.datetime64("1974-12-15", "D"), np.datetime64("2012-03-01", "D")
OFFSET = 1.5


@pytest.fixture(scope="module")
def mission():
    return Mission.parse((ROOT / "imp8.yaml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def model(mission):
    return Model.parse((ROOT / "models/imp8-preflight.yaml").read_text(encoding="utf-8"), mission)


def day_of(day, subs=3):
    """A field of constant size whose direction wanders; an offset along the spin axis; and sub-intervals."""
    generator = np.random.default_rng(3)
    start, end = day_bounds(day)
    walk = np.cumsum(generator.normal(size=(2880, 3)), axis=0) * 0.1
    direction = np.array([2.0, -1.0, 1.0]) + walk - walk.mean(axis=0)
    mean = 6.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True) + [0.0, 0.0, OFFSET]
    at = start + (np.arange(2880) * 30 + 15) * SECOND
    cut = start + np.arange(subs + 1) * 300 * SECOND
    sizes = np.full((1, subs, len(SPIN_RELATED)), 1e-5)
    return xr.Dataset(
        {
            "start": ("block", np.array([start])),
            "end": ("block", np.array([end])),
            "mean": (("block", "mean_of", "axis"), mean[None]),
            "mean_time": (("block", "mean_of"), at[None]),
            "near_earth": (("block", "sum", "column", "column_of"), np.zeros((1, 1, 11, 11))),
            "estimate": (("block", "sub", "parameter"), sizes * generator.normal(size=sizes.shape)),
            "uncertainty": (("block", "sub", "parameter"), sizes),
            "sub_start": (("block", "sub"), cut[None, :-1]),
            "sub_end": (("block", "sub"), cut[None, 1:]),
        }
    )


def test_the_offset_along_the_axis_is_the_same_whatever_the_year(model):
    old, new = (zero_level_table([day_of(day)], model, [day, day + 1]) for day in (OLD, NEW))
    assert int(old["intervals"].values[0]) == int(new["intervals"].values[0]) >= 90
    assert np.isfinite(old["sigma"].values).all()
    for name in ("value", "sigma"):
        np.testing.assert_allclose(old[name].values, new[name].values, rtol=1e-9)


def test_means_that_fill_up_a_store_are_left_out(model):
    whole, short = day_of(OLD), day_of(OLD + 1).isel(mean_of=slice(0, 2000))
    filled = pad_days([whole, short])
    plain, padded = (zero_level_table(days, model, [OLD, OLD + 2]) for days in ([whole, short], filled))
    xr.testing.assert_identical(plain, padded)


@pytest.mark.parametrize("day", [OLD, NEW])
def test_sub_intervals_are_told_from_what_fills_up_a_store_in_any_year(day):
    days = pad_days([day_of(day, subs=30), day_of(day + 1, subs=20)])
    found = SpinResults(None, None, "main", {}, days, [], [])
    assert found.cloud.start.size == 50
    assert found.cloud.chosen.any()


def test_a_long_reason_is_kept_whole(model, monkeypatch):
    message = "it is so because " + "one thing follows from another, " * 40 + "and here it ends"

    def refused(*_):
        raise CalibrationError(message, remedy="none")

    monkeypatch.setattr(spin_tables, "combine_methods", refused)
    table = zero_level_table([day_of(NEW)], model, [NEW, NEW + 1])
    assert str(table["reason"].values[0]) == message
    source = "as told by " + "this and " * 20 + "that"
    zero = table.assign(value=("interval", [1.0]), sigma=("interval", [0.1]), method=("interval", [source]))
    told = day_of(NEW).assign(
        value=(("block", "parameter"), np.zeros((1, 8))),
        sigma=(("block", "parameter"), np.full((1, 8), np.inf)),
        covariance=(("block", "parameter", "other"), np.eye(8)[None]),
    )
    twelve = spin_tables.spin_table([told], model, [NEW, NEW + 1], "daily", zero)
    assert str(twelve["origin"].values[0, PARAMETER_NAMES.index("offset[3]")]) == source


def test_a_day_without_a_product_does_not_lend_its_flags_to_the_next():
    days = [NEW + number for number in range(3)]
    records = [SimpleNamespace(day=day, report={"phase": str(day), "told": ""}) for day in days]
    products = [SimpleNamespace(day=day) for day in (days[0], days[2])]
    flags = {days[0]: np.zeros(4, np.uint32), days[2]: np.full(4, Flag.PHASE_BRIDGED, np.uint32)}
    cat = SimpleNamespace(read=lambda product, _: xr.Dataset({"flag": ("time", flags[product.day])}))
    part = _phase(SpinResults(cat, None, "main", {}, [], records, products))
    np.testing.assert_equal([one["bridged"] for one in part.fields["items"]], [0.0, np.nan, 1.0])
    assert "no product" in "".join(str(one) for one in part.text)


def test_a_day_without_housekeeping_keeps_its_place_in_what_tones_may_follow():
    mission = Mission.parse((ROOT / "themis.yaml").read_text(encoding="utf-8"))
    found = _ToneRecord()
    for number in range(3):
        start, _ = day_bounds(NEW + number)
        found.time.append(start + np.arange(4) * 300 * SECOND)
        tone = {"coil_current at the spin": np.full(4, 1.0 + number + 0j)}
        found.coordinates.append({"time of day": np.arange(4.0)})
        found.channel_tones.append({} if number == 1 else tone)
    by_name = {one.name: one for one in _tone_coordinates(found, mission)}
    assert {one.values.size for one in by_name.values()} == {12}
    np.testing.assert_array_equal(np.isfinite(by_name["coil_current at the spin"].values[4:8]), False)
    np.testing.assert_allclose(np.abs(by_name["coil_current at the spin"].channel_tone[8:]), 3.0)


def test_selected_means_stand_beside_their_own_day_when_one_is_gone():
    days = [
        day_of(NEW + number, subs=30).assign(value=(("block", "parameter"), np.full((1, 8), float(number))))
        for number in range(3)
    ]
    own = np.tile(np.arange(3.0)[:, None], (1, len(PARAMETER_NAMES)))
    starts = np.array([int(day["start"].values[0]) for day in days])
    daily = xr.Dataset({"own": (("interval", "parameter"), own), "start": ("interval", starts)})
    whole = SpinResults(None, None, "main", {"daily": daily}, days, [], []).selected
    value, sigma = SpinResults(None, None, "main", {"daily": daily}, [days[0], days[2]], [], []).selected
    np.testing.assert_array_equal(np.isnan(value).all(axis=1), [False, True, False])
    np.testing.assert_array_equal(np.isinf(sigma).all(axis=1), [False, True, False])
    np.testing.assert_allclose(value[[0, 2]], whole[0][[0, 2]])
