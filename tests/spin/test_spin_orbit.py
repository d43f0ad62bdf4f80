"""A mission whose offsets follow eclipses, and one whose spin axis moves at perigee."""

import numpy as np
import pytest

from inflight.catalog import Catalog, Workspace
from inflight.flags import Flag
from inflight.frames import gse_to_itrf, to_gse
from inflight.main_field import MainField
from inflight.mission import Mission
from inflight.simulate.spinning import SpinningSettings, ambient, simulate_spinning_day
from inflight.simulate.spinning.attitude import payload_axes, to_payload
from inflight.spin import PARAMETER_NAMES, CalibrationParameters, fit_held, respin, sums_near_earth
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.spin.orbit import _least, _runs
from inflight.time import SECOND

DAY = "2012-03-01"


def of_mission(folder, *effects, days=1, **overrides):
    """A mission of two orbits a day in which these effects are not in the model."""
    settings = SpinningSettings(
        days=days,
        seed=3,
        without=("zero_drift",),
        include=effects,
        overrides={"cadence": 0.5, "apogee": 8.0, **overrides},
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


def with_keys(path, keys):
    """The mission with more keys of its comparison."""
    text = path.read_text(encoding="utf-8")
    line = "    spin_axis: spin_axis\n"
    return Mission.parse(text.replace(line, line + "".join(f"    {key}\n" for key in keys)))


def reprocessed(cat, path, keys):
    """Reprocess with more keys of the comparison; the report, the product and the table."""
    report = reprocess(cat, with_keys(path, keys), settings=ReprocessSettings(table="daily"))
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


@pytest.mark.slow
def test_a_field_model_near_perigee_tells_gains_and_rotation_and_is_applied_once(tmp_path):
    off = {"spin_plane_gain": 1.0008, "axial_gain": 0.9994, "rotation": 0.003}
    cat, path, settings, _, _ = of_mission(tmp_path / "earth", days=3, main_field=True, **off)
    preflight = path.parent / "models/themis-preflight.yaml"
    text = preflight.read_text(encoding="utf-8").replace("time: constant", "time: block")
    lines = [
        line.replace(", free: false", "") if any(f"{name}:" in line for name in off) else line
        for line in text.splitlines()
    ]
    preflight.write_text("\n".join(lines), encoding="utf-8")

    def products(keys):
        report = reprocess(cat, with_keys(path, keys), settings=ReprocessSettings(table="window"))
        return report, [cat.read(one) for one in cat.days("l2/field", states=("published",))]

    _, first = products([])
    place = [ambient.position(one["tt2000"].values / SECOND, settings.parameters) for one in first]
    near = [np.linalg.norm(one, axis=1) < 3.0 * 6371.0 for one in place]
    true = [simulate_spinning_day(settings, str(one.attrs["day"])).truth for one in first]

    def errors(made):
        each = [
            (one["field_sensor"].values - respin(known["FIELD"].values, known["PHASE"].values))[inside]
            for one, known, inside in zip(made, true, near, strict=True)
        ]
        stated = [one["uncertainty"].values[inside] for one, inside in zip(made, near, strict=True)]
        return tuple(np.sqrt(np.nanmean(np.concatenate(one) ** 2, axis=0)) for one in (each, stated))

    keys = ["field_model: {external: 20}"]
    before, _ = errors(first)
    _, made = products(keys)
    after, stated = errors(made)
    assert np.all(after[:2] < 0.1 * before[:2])
    assert np.all(after < 2.0 * stated)
    table = cat.table("main-window", DAY)
    value, sigma, origin = (
        dict(zip(PARAMETER_NAMES, table[name].values[0], strict=True))
        for name in ("value", "sigma", "origin")
    )
    for name, put_in in off.items():
        assert origin[name] == "field model"
        assert abs(value[name] - put_in) < 3.0 * sigma[name]
    # The model finds nothing more in what was corrected, and a second run has nothing to make.
    in_use, sums = CalibrationParameters.from_values(table["value"].values[0]), []
    for one, where, inside in zip(made, place, near, strict=True):
        some = np.flatnonzero(inside)[::60]
        stamps, here = one["tt2000"].values[some], where[some]
        model = to_gse(MainField.of("igrf").at(gse_to_itrf(here, stamps), stamps), stamps, "itrf")
        model = to_payload(model, payload_axes(here, settings.parameters))
        sums.append(sums_near_earth(one["field_payload"].values[some], model, stamps, in_use))
    again = fit_held(np.concatenate(sums), np.zeros(4), np.array([1e-3, 1e-3, 4e-3, 10.0]), 20.0)
    assert np.all(np.abs(again.value) < 0.5 * np.sqrt(np.diag(again.covariance)))
    assert products(keys)[0].days["done"] == 0


def test_a_perigee_lies_between_readings_and_an_eclipse_lasts_until_temperatures_have_relaxed():
    stamps = np.arange(0, 600, 60) * SECOND
    distance = 7000.0 + 1e-3 * (stamps / SECOND - 275.0) ** 2
    (found,) = _least(stamps, distance)
    assert found == pytest.approx(275 * SECOND, abs=SECOND)
    first, second = _runs(stamps[[0, 1, 7]], 180 * SECOND, 3600 * SECOND)
    assert (first.start, first.end) == (-60 * SECOND, (60 + 60 + 3600) * SECOND)
    assert second.start == 360 * SECOND
