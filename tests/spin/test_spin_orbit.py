"""A mission whose offsets follow eclipses, and one whose spin axis moves at perigee."""

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.simulate.spinning import SpinningSettings, ambient, simulate_spinning_day
from inflight.spin import respin
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.spin.orbit import _least, _runs
from inflight.time import SECOND

DAY = "2012-03-01"


def of_mission(folder, effect):
    """A day of two orbits in which one effect is not in the model."""
    settings = SpinningSettings(
        days=1, seed=3, without=("zero_drift",), include=(effect,), overrides={"cadence": 0.5, "apogee": 8.0}
    )
    made = Workspace.create(folder, "themis")
    simulate(settings, made.data, workers=1)
    path = folder / "mission.yaml"
    path.write_text(path.read_text(encoding="utf-8").replace("cadence: 250 ms", "cadence: 500 ms"))
    cat = Catalog(folder)
    assert not ingest(cat, made.mission(), made.data).days["failed"]
    day = simulate_spinning_day(settings, DAY)
    truth = respin(day.truth["FIELD"].values, day.truth["PHASE"].values)
    dark = np.repeat(day.instruments["slow"]["SHADOW"].values > 0, 20)
    return cat, path, settings, truth, dark


def reprocessed(cat, path, keys):
    """Reprocess with more keys of the comparison; the report, the product and the table."""
    text = path.read_text(encoding="utf-8")
    line = "    spin_axis: spin_axis\n"
    mission = Mission.parse(text.replace(line, line + "".join(f"    {key}\n" for key in keys)))
    report = reprocess(cat, mission, settings=ReprocessSettings(table="daily"))
    product = cat.read(cat.days("l2/field", states=("published",))[0])
    return report, product, cat.table("main-daily", DAY)


def mean_error(product, truth, used):
    """The error of each component that does not average out, nT: what turns with the sensor."""
    return np.abs(np.nanmean((product["field_sensor"].values - truth)[used], axis=0))


@pytest.mark.slow
def test_offsets_that_follow_an_eclipse_harm_no_other_hour_when_it_is_left_out(tmp_path):
    cat, path, _, truth, dark = of_mission(tmp_path / "eclipse", "eclipse_shift")
    # In light, and more than two hours after a shadow.
    light = np.convolve(dark, np.ones(14_401))[: dark.size] < 0.5
    _, before, _ = reprocessed(cat, path, [])
    for told in ("shadow", "computed"):
        _, after, _ = reprocessed(cat, path, [f"eclipse: {told}", "after_eclipse: 3 h"])
        for axis in (0, 1):
            assert mean_error(after, truth, light)[axis] < 0.65 * mean_error(before, truth, light)[axis]
        flagged = (after["flag"].values & np.uint32(Flag.EXTRAPOLATED)) > 0
        assert flagged[dark].all()
        assert not flagged.all()
    report, unchanged, _ = reprocessed(cat, path, ["eclipse: darkness"])
    assert any("no channel 'darkness'" in one["message"] for one in report.problems)
    np.testing.assert_array_equal(unchanged["field_sensor"].values, before["field_sensor"].values)


@pytest.mark.slow
def test_a_spin_axis_that_moves_at_perigee_has_values_of_its_own_each_orbit(tmp_path):
    cat, path, settings, truth, _ = of_mission(tmp_path / "perigee", "perigee_turn")
    _, before, _ = reprocessed(cat, path, [])
    _, after, table = reprocessed(cat, path, ["cut_at: perigee"])
    seconds = after["tt2000"].values / SECOND
    orbit = np.floor(ambient.orbits(seconds, settings.parameters))
    assert table.sizes["interval"] == np.unique(orbit).size
    for one, row in zip(np.unique(orbit), table["value"].values, strict=True):
        expected = np.add(
            settings.parameters.spin_axis, np.array(settings.parameters.perigee_turn) * (one % 2)
        )
        np.testing.assert_allclose(row[6:8], expected, atol=3e-5)
    error = [np.nanstd(one["field_sensor"].values[:, 2] - truth[:, 2]) for one in (before, after)]
    assert error[1] < 0.3 * error[0]


def test_a_perigee_lies_between_readings_and_an_eclipse_lasts_until_temperatures_have_relaxed():
    stamps = np.arange(0, 600, 60) * SECOND
    distance = 7000.0 + 1e-3 * (stamps / SECOND - 275.0) ** 2
    (found,) = _least(stamps, distance)
    assert found == pytest.approx(275 * SECOND, abs=SECOND)
    first, second = _runs(stamps[[0, 1, 7]], 180 * SECOND, 3600 * SECOND)
    assert (first.start, first.end) == (-60 * SECOND, (60 + 60 + 3600) * SECOND)
    assert second.start == 360 * SECOND
