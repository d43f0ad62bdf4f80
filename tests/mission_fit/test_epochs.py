"""Superposed epochs: recovered coefficients of both signs, honest sigmas, confounding said."""

import numpy as np
import pytest
import xarray as xr
from epoch_cases import TRUTH, epochs_of_days, make_day, steps_of, stored_epochs

from benchmarks.excursions import find_excursions
from inflight.dipole import dipole_split
from inflight.errors import CalibrationError, SamplesError, SettingsError
from inflight.mission_fit import concat_epochs, extract_epochs, fit_step, stack_epochs
from inflight.mission_fit.superposed_epochs import Windows
from inflight.simulate.dipole import extrapolate_dipole


@pytest.fixture(scope="module")
def stored():
    return epochs_of_days(10, others=("battery_current", "sunlit"))


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_difference_of_the_sensors_is_recovered_with_its_sign(sign):
    fit = fit_step(epochs_of_days(8, value=sign * TRUTH))
    assert np.abs((fit.value[0] - sign * TRUTH) / fit.sigma[0]).max() < 3.5
    # Along x and z, where the field is strong, better than the thesis' one digit.
    assert (fit.sigma[0, [0, 2]] < 0.002).all()


def test_without_noise_the_coefficient_is_exact_though_the_current_drifts_and_settles():
    fit = fit_step(epochs_of_days(6, noise=1e-6, slow=0.0))
    assert fit.value[0] == pytest.approx(TRUTH, abs=2e-5)


def test_what_follows_the_orbit_leaves_no_more_than_the_cubic_drift_that_is_stated():
    """2 c length^3 with 25 s left out on either side; an order more removes it and costs noise."""
    third = sum(size * (k * 2 * np.pi / 5560.0) ** 3 / 6 for size, k in ((0.3, 1), (0.1, 3)))
    largest, noise = [], []
    for order in (2, 3):
        windows = Windows(order=order)
        quiet = epochs_of_days(3, noise=1e-6, value=(0.0, 0.0, 0.0), windows=windows)
        largest.append(float(np.abs(quiet["contrast"]).max()))
        noise.append(float(np.median(epochs_of_days(1, windows=windows)["sigma"])))
    assert 0.3 < largest[0] / (2.0 * third * 80.0**3) < 1.0
    assert largest[1] < 0.1 * largest[0]
    assert 1.5 < noise[1] / noise[0] < 3.0


@pytest.mark.parametrize("shared", [0.0, 0.03])
def test_one_sigma_covers_two_thirds_also_when_epochs_of_a_day_share_noise(shared):
    pulls = []
    for seed in range(200):
        fit = fit_step(stored_epochs(seed, shared=shared))
        pulls.append((fit.value[0] - TRUTH) / fit.sigma[0])
    inside = np.mean(np.abs(pulls) < 1)
    assert 0.60 < inside < 0.76
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.25


def test_contrasts_know_their_white_noise(stored):
    pull = (stored["contrast"].values - stored["column"].values[:, 0] @ TRUTH) / stored["sigma"].values
    assert np.std(pull) == pytest.approx(1.0, abs=0.15)
    assert fit_step(stored).placebo == pytest.approx(1.0, abs=0.15)


def test_what_steps_together_is_reported_with_its_share(stored):
    fit = fit_step(stored)
    (battery,) = fit.confounding
    assert (battery.channel, battery.unit) == ("battery_current", "A")
    assert battery.correlation == pytest.approx(1.0)
    assert battery.slope == pytest.approx(0.5)
    # The light does not change in these days: of a field of day and night little is known.
    assert not fit.light.determined.any()
    assert fit.light.sigma.min() > 0.5
    together = fit_step(stored, ["solar_current", "battery_current"])
    assert together.fit.retained.max() < 1e-6
    assert not together.fit.determined.any()
    assert together.value[0] + 0.5 * together.value[1] == pytest.approx(fit.value[0], abs=1e-3)


def with_light(epochs, field, in_light=0.5, seed=0):
    """Epochs whose current steps with the light but for a part of them, with a field of day and night."""
    random = np.random.default_rng([seed, 7])
    direction = epochs["column"].values[:, 0] / epochs["step"].values
    step = np.where(random.uniform(size=epochs.sizes["epoch"]) < in_light, 0.0, -1.0)
    columns = np.stack([epochs["column"].values[:, 0], step[:, None] * direction], axis=1)
    both = epochs.drop_dims("current")
    return both.assign(
        contrast=both["contrast"] + columns[:, 1] @ np.asarray(field),
        column=(("epoch", "current", "axis"), columns),
        placebo_column=(("epoch", "current", "axis"), np.zeros(columns.shape)),
        step=(("epoch", "current"), np.column_stack([epochs["step"].values[:, 0], step])),
        unit=("current", ["A", "1"]),
    ).assign_coords(current=["solar_current", "sunlit"])


def test_a_field_of_day_and_night_is_told_from_the_current_that_steps_with_the_light():
    field = np.array([0.8, 0.0, -0.5])
    pulls, lights, alone = [], [], []
    for seed in range(100):
        epochs = with_light(stored_epochs(seed), field, seed=seed)
        fit = fit_step(epochs)
        pulls.append((fit.value[0] - TRUTH) / fit.sigma[0])
        lights.append((fit.light.value - field) / fit.light.sigma)
        current = fit_step(epochs.sel(current=["solar_current"]))
        alone.append((current.value[0] - TRUTH) / current.sigma[0])
    for each in (pulls, lights):
        assert 0.58 < np.mean(np.abs(each) < 1) < 0.78
        assert np.abs(np.mean(each, axis=0)).max() < 0.4
    # Without it the current would have taken what belongs to the light.
    assert np.median(np.abs(np.array(alone)[:, 0])) > 4.0
    table = fit.table()
    assert table["day_night"].values == pytest.approx(fit.light.value)


def test_steps_of_one_size_that_all_come_with_the_light_are_told_from_nothing():
    epochs = stored_epochs(1)
    one_size = epochs["column"] / -epochs["step"].values[:, :, None] * 5.0
    epochs = epochs.assign(column=one_size, step=xr.full_like(epochs["step"], -5.0))
    fit = fit_step(with_light(epochs, np.zeros(3), in_light=0.0))
    assert not fit.light.determined.any()
    assert fit.sigma[0].min() > 0.1


def test_the_stack_shows_a_step_of_the_size_of_the_drop(stored):
    drops = stored.isel(epoch=stored["step"].values[:, 0] < 0)
    curve = stack_epochs(drops)
    late, early = curve.lag > 30, curve.lag < -30
    wanted = float(np.mean(drops["column"].values[:, 0] @ TRUTH))
    step = curve.residual[late].mean() - curve.residual[early].mean()
    width = np.hypot(*(np.mean(curve.high[part] - curve.low[part]) for part in (late, early))) / 2
    assert abs(step - wanted) < 3 * width
    assert curve.current[late].mean() - curve.current[early].mean() == pytest.approx(-5.1, abs=0.3)
    assert curve.days == 10
    turned = stack_epochs(drops, TRUTH)
    size = turned.residual[late].mean() - turned.residual[early].mean()
    assert size > 1.2 * abs(step)
    wrong = stack_epochs(drops, -TRUTH)
    assert wrong.residual == pytest.approx(-turned.residual)
    with pytest.raises(SamplesError, match="1 days"):
        stack_epochs(drops.isel(epoch=drops["day"].values == drops["day"].values[0]))


def test_gaps_missing_values_and_outliers_leave_the_rest():
    samples, residual = make_day(0)
    steps = steps_of(samples)
    whole = extract_epochs(samples, residual, steps, channel="solar_current")
    broken = residual.copy()
    broken[::97] += 30.0
    broken[1000:1400] = np.nan
    kept = np.r_[0:40000, 41000:86400]
    part = extract_epochs(samples.isel(time=kept), broken[kept], steps, channel="solar_current")
    assert whole.sizes["epoch"] - 4 <= part.sizes["epoch"] <= whole.sizes["epoch"]
    same = np.isin(whole["time"].values, part["time"].values)
    change = part["contrast"].values - whole["contrast"].values[same]
    assert np.abs(change / part["sigma"].values).max() < 1.5


def test_a_channel_that_is_missing_costs_no_epoch_of_another():
    parts = []
    for number in range(6):
        samples, residual = make_day(number)
        if number == 2:
            samples["battery_current"] = samples["battery_current"] * np.nan
        parts.append(
            extract_epochs(
                samples, residual, steps_of(samples), channel="solar_current", others=["battery_current"]
            )
        )
    stored = concat_epochs(parts)
    fit = fit_step(stored)
    assert fit.days == 6
    assert fit.confounding[0].slope == pytest.approx(0.5)
    assert fit_step(stored, ["battery_current"]).fit.clusters == 5


def test_an_excursion_is_fitted_by_its_own_course():
    parts, truth = [], np.array([0.3, -0.3, 1.0])
    for number in range(8):
        samples, residual = make_day(number, value=(0.0, 0.0, 0.0))
        seconds = np.arange(samples.sizes["time"])
        camera = 0.23 + sum(
            0.4 * np.exp(-0.5 * ((seconds - t) / 120.0) ** 2) for t in range(4000, 82000, 5500)
        )
        direction = samples["field"].values / 40000.0
        samples["camera_current"] = "time", 1e3 * camera, {"units": "mA"}
        found = find_excursions(samples["tt2000"].values[::10], np.round(camera[::10], 3), longest=1500)
        parts.append(
            extract_epochs(
                samples,
                residual + direction @ truth * camera,
                found,
                channel="camera_current",
                windows=Windows(shape="current", order=3),
            )
        )
    fit = fit_step(concat_epochs(parts), prior_sigma=10.0)
    assert np.abs((fit.value[0] - truth) / fit.sigma[0]).max() < 3.5
    assert fit.sigma[0, 2] < 0.05


def test_a_table_names_dims_units_and_the_difference(stored):
    table = fit_step(stored).table()
    assert table["value"].dims == ("current", "axis")
    assert table["value"].attrs == {"units": "nT/A", "at": "difference"}
    assert table["covariance"].shape == (1, 3, 1, 3)
    assert set(stack_epochs(stored).table()) == {"value", "low", "high", "sigma", "current"}


def test_too_little_is_refused_with_a_reason():
    few = epochs_of_days(3)
    with pytest.raises(CalibrationError, match="3 clusters"):
        fit_step(few)
    with pytest.raises(SamplesError, match="heater"):
        fit_step(few, ["heater"])
    samples, residual = make_day(0, hours=2, drops=0)
    none = extract_epochs(samples, residual, steps_of(samples), channel="solar_current")
    assert none.sizes["epoch"] == 0
    with pytest.raises(SamplesError, match="no epoch"):
        concat_epochs([none])
    with pytest.raises(SamplesError, match="heater"):
        extract_epochs(samples, residual, steps_of(samples), channel="heater")


def test_a_dipole_on_the_boom_splits_as_published():
    split = dipole_split([1.0, 2.0, -3.0], 4.75, 6.5, covariance=np.eye(3) * 0.01)
    assert split.factor == pytest.approx((1.64001, 0.64001), abs=1e-4)
    assert split.vector - split.scalar == pytest.approx([1.0, 2.0, -3.0])
    assert split.sigma_scalar == pytest.approx(0.1 * 0.64001, abs=1e-5)


def test_a_dipole_off_the_boom_needs_the_direction_of_its_moment():
    vector, scalar = np.array([4.75, 0.4, 0.0]), np.array([6.5, 0.4, 0.0])
    at_vector = np.array([0.02, 0.01, -0.01])
    at_scalar = extrapolate_dipole(at_vector, (0.0, 0.0, 0.0), vector, scalar)
    with pytest.raises(SettingsError, match="direction"):
        dipole_split(at_vector - at_scalar, vector, scalar)
    near = np.linalg.norm(vector)
    unit = vector / near
    moment = np.linalg.solve(3 * np.outer(unit, unit) - np.eye(3), at_vector)
    split = dipole_split(at_vector - at_scalar, vector, scalar, direction=moment)
    assert split.vector == pytest.approx(at_vector)
    assert split.scalar == pytest.approx(at_scalar)
    with pytest.raises(SettingsError, match="both sensors"):
        dipole_split(at_vector, 4.75, 4.75)
