"""The whole chain as one reprocess, on simulated days at two seconds: everything put in comes back."""

import datetime as dt
import shutil

import numpy as np
import pytest
import xarray as xr

from benchmarks.archive import simulated_workspace
from inflight.catalog import Catalog, Day, Workspace
from inflight.flags import Flag
from inflight.model import Model
from inflight.simulate import Parameters, SimulationSettings, mean_current, simulate_day
from inflight.simulate.stray import coefficients
from inflight.tasks.pipelines import ReprocessSettings, reprocess
from inflight.tasks.pipelines.mission_fit.day import StoredDays, unpack_part
from inflight.time import SECOND, day_bounds

DAYS = 24
CONTINUOUS = ReprocessSettings(table="continuous", trend="linear", batch_days=12)
SETTINGS = SimulationSettings(seed=3, cadence=2)


@pytest.fixture(scope="module")
def chain(tmp_path_factory) -> tuple[Catalog, dict]:
    """A mission that went through the chain once; the catalog and the report."""
    folder = tmp_path_factory.mktemp("chain") / "champ"
    cat = simulated_workspace(folder, DAYS, settings=SETTINGS, model="champ-chain.yaml", workers=1)
    # A sample every two seconds knows nothing of a response of half a second.
    model = folder / "models" / "champ-chain.yaml"
    given = model.read_text(encoding="utf-8")
    model.write_text(given.replace("value: 0.11, sigma: 0.02", "value: 0.0, sigma: 0.02"), encoding="utf-8")
    steps: list[tuple[str, int, int]] = []
    mission = Workspace.open(folder).mission()
    report = reprocess(cat, mission, settings=CONTINUOUS, progress=lambda *step: steps.append(step))
    return cat, report.as_json() | {"progress": steps}


def newest(cat: Catalog, kind: str) -> xr.Dataset:
    return cat.table_by_id(cat.tables(f"main-{kind}")[-1].id)


def told(truth: Parameters) -> dict[str, float]:
    """Return what the residual can tell of the truth, by the names of the model's values."""
    out = {"time_shift.seconds": truth.time_shift, "scalar_bias.bias": 0.0}
    for place, axis in enumerate("xyz"):
        out[f"temperature.linear[{axis}]"] = truth.temperature_linear[place]
        out[f"temperature.quadratic[{axis}]"] = truth.temperature_quadratic
        out[f"nonlinearity.quadratic[{axis}]"] = truth.quadratic[place]
        out[f"nonlinearity.cubic[{axis}]"] = truth.cubic[place]
    return out


#: Names of a source's coefficients, their axes behind: those that the simulator has by another name first.
SOURCES = {
    "camera": "camera.coefficient[{}]",
    "battery": "battery.coefficient[{}]",
    "heater": "heater.coefficient[{}]",
    "panel_left": "solar_array.panels[{}0]",
    "panel_right": "solar_array.panels[{}1]",
    "panel_top": "solar_array.panels[{}2]",
}


def fitted_model(cat: Catalog) -> Model:
    mission = Workspace.open(cat.workspace).mission()
    return Model.parse(cat.model_text("champ-chain-continuous")[2], mission)


def test_the_residual_falls_to_the_noise_that_was_put_in(chain):
    _, report = chain
    assert report["days"]["done"] == DAYS
    # Noise of both instruments and the rounding of their readings to 0.01 nT.
    floor = np.sqrt(SETTINGS.vector_noise**2 + SETTINGS.scalar_noise**2 + 2 * 0.01**2 / 12)
    assert report["residual"]["before_nT"] > 30
    assert report["residual"]["after_nT"] == pytest.approx(floor, rel=0.05)


def test_injected_coefficients_come_back_within_their_stated_errors(chain):
    cat, _ = chain
    table = newest(cat, "trend")
    value = dict(zip(table["parameter"].values.tolist(), table["value"].values, strict=True))
    sigma = dict(zip(table["parameter"].values.tolist(), table["sigma"].values, strict=True))
    pulls = [(value[name] - truth) / sigma[name] for name, truth in told(SETTINGS.parameters).items()]
    covariance, model = table["covariance"].to_pandas(), fitted_model(cat)
    for source, form in SOURCES.items():
        # Numbers of a dipole are those at the vector sensor: data tell what the difference makes of them.
        entry = model.effect(form.partition(".")[0])
        difference = np.eye(3) - entry.transfers()["ovm"]
        names = [form.format(axis) for axis in "xyz"]
        vector, scalar = coefficients(SETTINGS.parameters)[source]
        off = difference @ [value[name] for name in names] - (vector - scalar)
        spread = difference @ covariance.loc[names, names].values @ difference.T
        pulls += list(off / np.sqrt(np.diag(spread)))
    pulls = np.array(pulls)
    # Days at one local time tell panels, battery and temperature apart by picotesla: the noise of the
    # thermistor shows. Of 41 numbers one may be beyond three sigma by chance and another by that.
    assert np.sum(np.abs(pulls) > 3) <= 2
    assert np.abs(pulls).max() < 5
    # Neither too sure nor too modest, all together.
    assert 0.6 < np.sqrt(np.mean(pulls**2)) < 1.5


def test_currents_are_taken_off_the_vector_as_far_as_their_places_are_known(chain):
    cat, _ = chain
    model, day = fitted_model(cat), SETTINGS.start + dt.timedelta(days=11)
    truth, product = simulate_day(SETTINGS, day).truth, cat.read(_day(cat, day))
    # Readings in gaps are no part of the product.
    kept = (product["tt2000"].values - day_bounds(np.datetime64(day))[0]) // (SETTINGS.cadence * SECOND)
    off = product["field_sensor"].values - truth["FIELD"].values[kept]
    # Means of half an hour; what is constant stays with the offsets (of the body, the heading, the scalar).
    off = off[: len(off) // 900 * 900].reshape(-1, 900, 3).mean(axis=1)
    varying = off.std(axis=0)
    # Of the difference alone, what the scalar sensor sees of the currents would be left.
    left = sum(
        product[f"correction_{name}"].values @ model.effect(name).transfers()["ovm"].T
        for name in ("solar_array", "battery", "camera", "heater")
    )
    left = (off + left[: len(left) // 900 * 900].reshape(-1, 900, 3).mean(axis=1)).std(axis=0)
    assert np.hypot.reduce(varying) < 0.6 * np.hypot.reduce(left)
    assert (varying < product["uncertainty"].values.mean(axis=0)).all()


def test_products_do_not_jump_from_day_to_day(chain):
    cat, _ = chain
    table = newest(cat, "continuous")
    steps = np.abs(np.diff(table["value"].values, axis=0))
    assert table.sizes["interval"] == DAYS
    # A straight line in time: every day's step is the same.
    assert np.ptp(steps[:, :3], axis=0).max() < 1e-12
    assert steps[:, 3:].max() == 0.0
    model = cat.model_text("champ-chain-continuous")[2]
    assert "time: linear" in model


def test_every_table_is_certified_and_has_an_uncertainty(chain):
    cat, report = chain
    for kind in (
        "continuous",
        "trend",
        "own-fit",
        "current-steps",
        "panels",
        "torquer-band",
        "torquer-band-mean",
        "coil-temperature",
        "temperature-rivals",
        "day-night",
        "day-night-series",
        "day-night-daily",
        "cross-talk",
    ):
        record = cat.tables(f"main-{kind}")[-1]
        table = cat.table_by_id(record.id)
        assert record.certified, kind
        assert np.isfinite(table["sigma"].values).all(), kind
        assert np.all(table["sigma"].values >= 0), kind
    # What could not be made says why.
    assert "window" in report["left_out"]["torquer-mean"]


def test_the_lag_of_the_coil_comes_back_and_its_rival_loses(chain):
    cat, _ = chain
    table, truth = newest(cat, "coil-temperature"), SETTINGS.parameters
    found = dict(zip(table["parameter"].values.tolist(), table["value"].values, strict=True))
    sigma = dict(zip(table["parameter"].values.tolist(), table["sigma"].values, strict=True))
    assert abs(found["lag"] - truth.temperature_lag) < max(4 * sigma["lag"], 1.0)
    assert sigma["lag"] < 2.0
    rivals = newest(cat, "temperature-rivals")
    assert str(rivals["channel"].values[0]) == "coil_temperature"
    assert not rivals["tied"].sel(channel="electronics_temperature")


def test_no_field_by_day_is_told_where_none_was_put_in(chain):
    cat, _ = chain
    table = newest(cat, "day-night")
    assert np.abs(table["value"].values / table["sigma"].values).max() < 5
    assert table["sigma"].values.max() < 0.1


def test_ten_milliseconds_ignored_turn_an_angle_by_three_arcseconds(chain):
    cat, _ = chain
    table = newest(cat, "cross-talk").sel(ignored="time_shift.seconds")
    # A reading taken early, the opposite of the thesis' F(t + 10 ms).
    assert float(table["value"].sel(parameter="vector_sensor.misalignment[xz]")) == pytest.approx(
        3.2, abs=0.15
    )
    assert float(table["size"]) == 0.01


def test_products_tell_the_slow_part_of_the_residual_and_leave_it_in(chain):
    cat, _ = chain
    day = cat.days("l2/field", states=("published",))[3]
    product = cat.read(day)
    term = product["correction_distribution"]
    assert term.attrs["applied"] == "no"
    assert term.attrs["period_s"] == 80.0
    # White noise alone puts a little into the filter's band, and nothing else is left.
    assert 0 < term.attrs["rms_nT"] < 0.5 * day.report["after_nT"]
    along = np.einsum("ta,ta->t", term.values, product["field_sensor"].values)
    strength = np.linalg.norm(product["field_sensor"].values, axis=1)
    size = np.linalg.norm(term.values, axis=1)
    np.testing.assert_allclose(np.abs(along), size * strength, rtol=1e-3, atol=20.0)


def test_offsets_from_the_spread_are_nothing_but_noise(chain):
    cat, _ = chain
    table = newest(cat, "z-offset")
    assert table.sizes["interval"] == DAYS
    assert np.abs(table["slope"].values / table["sigma_slope"].values).max() < 5


def test_the_same_call_has_nothing_to_do(chain):
    cat, _ = chain
    again = reprocess(cat, Workspace.open(cat.workspace).mission(), settings=CONTINUOUS).as_json()
    assert again["days"]["unchanged"] == DAYS
    assert again["days"]["done"] == 0
    assert len(cat.tables("main-continuous")) == 1


def test_the_fit_of_all_days_tells_how_far_it_is(chain):
    cat, report = chain
    stages = list(dict.fromkeys(stage for stage, _, _ in report["progress"]))
    assert stages == ["calibrate", "tables", "statistics", "fit", "produce"]
    read = [(done, total) for stage, done, total in report["progress"] if stage == "statistics"]
    assert read[: DAYS + 1] == [(done, DAYS) for done in range(DAYS + 1)]
    fitted = [(done, total) for stage, done, total in report["progress"] if stage == "fit"]
    count = len(fitted) - 1
    assert fitted == [(done, count) for done in range(count + 1)]
    # Three tables are the fit's own, and three come of what the products tell.
    assert count >= len(cat.tables()) - 6


def test_days_are_read_part_by_part_as_they_are_whole(chain):
    cat, _ = chain
    days = cat.days("equations/main/chain", states=("published",))
    stored, whole = StoredDays(cat, days), [cat.read(day) for day in days]
    for name in ("spectrum", "band", "epoch"):
        for part, expected in zip(stored.rows_of(name), unpack_part(whole, name), strict=True):
            xr.testing.assert_identical(part, expected)
        assert stored.rows_of(name) is stored.rows_of(name)
    some = stored.of([3, 5]).read("start", "gram", "of no day")
    assert [sorted(day.data_vars) for day in some] == [["gram", "start"]] * 2
    np.testing.assert_array_equal(some[1]["gram"].values, whole[5]["gram"].values)


def test_a_day_of_the_chain_keeps_its_currents_in_amperes(chain):
    cat, _ = chain
    day = cat.read(cat.days("equations/main/chain", states=("published",))[7])
    part = unpack_part([day], "channel")[0]
    told = dict(zip(part["channel"].values.tolist(), part["mean"].values, strict=True))
    truth = mean_current(day["start"].values / SECOND, SETTINGS.parameters)
    found = [told[f"torquer_current[{axis}]"] for axis in "xyz"]
    np.testing.assert_allclose(found, truth[0], atol=2e-3)


def test_daily_fits_wander_by_what_they_do_not_know(chain):
    cat, _ = chain
    own, common = newest(cat, "own-fit"), newest(cat, "continuous")
    apart = (own["value"].values - common["value"].values)[:, 6:]
    assert np.abs(apart).max() < 2.0
    # That of what the model holds is in their errors, and the days' own is far smaller.
    assert np.mean(np.abs(apart) < 2.0 * own["sigma"].values[:, 6:]) > 0.9
    assert np.mean(np.abs(apart) < 2.0 * own["own_sigma"].values[:, 6:]) < 0.5


def test_mean_temperatures_of_whole_days_are_known_by_their_readings(chain):
    cat, _ = chain
    table = newest(cat, "daily-temperature").sel(channel="coil_temperature")
    truth = [simulate_day(SETTINGS, SETTINGS.start + dt.timedelta(days=day)).truth for day in range(3)]
    off = table["value"].values[:3] - [float(day["T_EFF"].mean()) for day in truth]
    assert (np.abs(off) < 3.0 * table["sigma"].values[:3]).all()
    assert (table["sigma"].values[:3] < 0.1 * table["spread"].values[:3]).all()


def test_a_day_without_housekeeping_gets_a_product_with_a_wider_uncertainty(chain, tmp_path):
    cat, _ = chain
    folder = tmp_path / "champ"
    shutil.copytree(cat.workspace, folder, symlinks=True)
    lost, mine = SETTINGS.start + dt.timedelta(days=5), Catalog(folder)
    with mine.run("test", {}) as run:
        empty = _without_values(mine, lost)
        told = {str(name): {"coverage": 0.0} for name in empty.data_vars if empty[name].dtype.kind == "f"}
        run.stage("l1/power", empty, day=str(lost), key="lost", report={"channels": told})
        run.publish()
    report = reprocess(mine, Workspace.open(folder).mission(), settings=CONTINUOUS).as_json()
    assert report["days"]["failed"] == 0
    told = [one for one in report["problems"] if one["day"] == str(lost)]
    assert [one["cause"] for one in told] == ["partial"]
    before, after = (one.read(_day(one, lost)) for one in (cat, mine))
    assert np.isfinite(after["field_sensor"].values).mean() > 0.99
    assert (after["flag"].values & np.uint32(Flag.CHANNEL_MISSING) != 0).mean() > 0.99
    # What the uncertainty grew by is about as much as the field is off.
    # A day that is not fitted is taken to be as noisy as the others: some may come out a picotesla surer.
    grown = after["uncertainty"].values ** 2 - before["uncertainty"].values ** 2
    assert np.nanmin(after["uncertainty"].values - before["uncertainty"].values) > -1e-3
    widened = np.sqrt(np.maximum(grown, 0.0))
    off = np.abs(after["field_sensor"].values - before["field_sensor"].values)
    assert np.nanmedian(widened[:, 2]) > 0.05
    # Currents of one bus deviate together: as independent ones they would state too little along z.
    assert 0.6 < np.sqrt(np.nanmean(off[:, 2] ** 2) / np.nanmean(widened[:, 2] ** 2)) < 1.4


def _day(cat: Catalog, day: dt.date) -> Day:
    return next(one for one in cat.days("l2/field", states=("published",)) if str(one.day) == str(day))


def _without_values(cat: Catalog, day: dt.date) -> xr.Dataset:
    """Return a day of housekeeping with stamps and no readings."""
    held = next(one for one in cat.days("l1/power", states=("published",)) if str(one.day) == str(day))
    data = cat.read(held)
    return data.map(lambda one: one * np.nan if one.dtype.kind == "f" else one, keep_attrs=True)
