"""Running means of torquer currents and the remanent field they tell."""

import numpy as np
import pytest

from inflight.errors import CalibrationError, SamplesError, SettingsError
from inflight.mission_fit import MEAN_STATES, filled_running_mean, fit_remanence_factor, remanent_field
from inflight.simulate import Parameters, mean_current, mjd
from inflight.simulate.stray import remanent_fields

#: 2001-01-01.
FIRST = 11323
PARAMETERS = Parameters()


def seconds_of(day):
    """TT2000 seconds of the middle of days since 1970."""
    offset = 10957 + mjd(np.zeros(1))[0]
    return (np.asarray(day) + 0.5 - offset) * 86400.0


def truth_of(day):
    return mean_current(seconds_of(day), PARAMETERS)


def daily_means(days=1200, *, seed=0, noise=0.002, cycle=0.010):
    """Days, daily means and counts: the trend, a part that follows the local time, noise."""
    day = FIRST + np.arange(days)
    random = np.random.default_rng(seed)
    turn = 2 * np.pi * np.arange(days) / 260.5
    seasonal = cycle * np.column_stack([np.sin(turn), np.cos(turn), np.sin(2 * turn)])
    value = truth_of(day) + seasonal + noise * random.standard_normal((days, 3))
    return day, value, np.full(days, 86400.0)


def test_the_mean_is_the_slow_part_and_the_cycle_is_gone():
    mean = filled_running_mean(*daily_means())
    whole = mean.state == 0
    assert np.abs(mean.value - truth_of(mean.day))[whole].max() < 0.0007
    assert whole.sum() == 1200 - 260
    assert (mean.coverage[whole] >= 0.999).all()


def test_ends_are_held_with_a_growing_sigma_and_said():
    mean = filled_running_mean(*daily_means())
    held = MEAN_STATES.index("held")
    assert mean.state[0] == mean.state[-1] == held
    assert mean.coverage[0] == pytest.approx(0.5, abs=0.01)
    first = int(np.argmax(mean.state != held))
    assert mean.value[0] == pytest.approx(mean.value[first])
    assert (np.diff(mean.sigma[:first, 1]) < 1e-12).all()
    assert mean.sigma[0, 1] > 3 * mean.sigma[600, 1]
    assert "held" in mean.sentence
    error = np.abs(mean.value - truth_of(mean.day)) / mean.sigma
    assert (error[mean.state == held] < 3).all()


def test_a_gap_too_long_is_interpolated_and_a_short_one_widens_sigma():
    day, value, count = daily_means()
    kept = np.ones(day.size, dtype=bool)
    kept[400:412] = False
    kept[700:860] = False
    mean = filled_running_mean(day[kept], value[kept], count[kept])
    assert mean.day.size == day.size
    assert np.isfinite(mean.value).all()
    assert MEAN_STATES[mean.state[406]] == "partial"
    assert mean.sigma[406, 1] > 2 * filled_running_mean(day, value, count).sigma[406, 1]
    assert MEAN_STATES[mean.state[780]] == "interpolated"
    carried = mean.state > 0
    assert (np.abs(mean.value - truth_of(mean.day))[carried] < 3 * mean.sigma[carried]).mean() > 0.98


def test_half_a_window_is_never_averaged_silently():
    """What a truncated window would give at the ends is wrong by the cycle, and is not given."""
    day, value, count = daily_means(cycle=0.020)
    mean = filled_running_mean(day, value, count)
    naive = value[:131].mean(axis=0)
    assert np.abs(naive - truth_of(day[:1])[0]).max() > 0.008
    assert np.abs(mean.value[0] - truth_of(day[:1])[0]).max() < 0.004


def test_one_sigma_of_whole_windows_covers_two_thirds():
    """Errors of one record are correlated over the window: one number a record."""
    pulls = []
    for seed in range(60):
        mean = filled_running_mean(*daily_means(520, seed=seed, cycle=0.0))
        pulls.append((mean.value[260] - truth_of(mean.day[260:261])[0]) / mean.sigma[260])
    assert 0.60 < np.mean(np.abs(pulls) < 1) < 0.76


def test_days_weigh_by_their_samples_at_most_as_a_usual_day():
    day, value, count = daily_means(600)
    value[300] += 10.0
    count[300] = 40.0
    mean = filled_running_mean(day, value, count)
    assert np.abs(mean.value[300] - truth_of(day[300:301])[0]).max() < 0.001


def test_the_window_is_a_parameter_and_a_short_record_is_refused():
    day, value, count = daily_means(100)
    with pytest.raises(SamplesError, match="260 d"):
        filled_running_mean(day, value, count)
    assert (filled_running_mean(day, value, count, window=27).state == 0).sum() == 100 - 27 + 1
    with pytest.raises(SamplesError, match="twice"):
        filled_running_mean(np.r_[day, day[:1]], np.r_[value, value[:1]], np.r_[count, 1.0])
    with pytest.raises(SamplesError, match="no day"):
        filled_running_mean(day, np.full_like(value, np.nan), count)
    with pytest.raises(SettingsError, match="window"):
        filled_running_mean(day, value, count, window=0.0)


def test_the_field_at_the_scalar_sensor_is_the_simulated_one():
    mean = filled_running_mean(*daily_means())
    table = remanent_field(mean, eta=PARAMETERS.remanent_per_current, eta_sigma=0.1)
    _, at_scalar = remanent_fields(seconds_of(mean.day), PARAMETERS)
    error = table["value"].values - at_scalar
    assert np.abs(error[mean.state == 0]).max() < 0.005
    assert (table["value"].sel(axis="x") == 0).all()
    assert table["value"].attrs["units"] == "nT"
    assert (np.diff(table["start"].values) > 0).all()
    # What is common to y and z is in the covariance: eta itself.
    both = table["covariance"].values[600, 1, 2]
    assert both == pytest.approx(0.01 * np.prod(mean.value[600, 1:]))


def grams_of(day, difference, *, seed=0, noise=0.05, offset=(0.3, -0.2, 0.1), shared=0.02):
    """Gram matrices of [e | dB] a day: a field that follows the mean current, an offset, slow errors."""
    random = np.random.default_rng(seed)
    field = np.asarray(offset) + difference * truth_of(day) * [0.0, 1.0, 1.0]
    wander = shared * random.standard_normal((day.size // 20 + 1, 3))[np.arange(day.size) // 20]
    count = 100
    angle = random.uniform(0, 2 * np.pi, (day.size, count))
    e = np.stack([np.cos(angle), random.uniform(-0.4, 0.4, angle.shape), 2 * np.sin(angle)], axis=2)
    e /= np.linalg.norm(e, axis=2, keepdims=True)
    residual = np.einsum("dti,di->dt", e, field + wander) + noise * random.standard_normal(angle.shape)
    rows = np.concatenate([e, residual[..., None]], axis=2)
    return rows.transpose(0, 2, 1) @ rows, np.full(day.size, float(count))


def test_eta_is_recovered_from_the_residual_when_the_fall_off_is_known():
    day, value, count = daily_means(2500)
    vector, scalar = remanent_fields(seconds_of(day[:1]), PARAMETERS)
    ratio = float(np.linalg.norm(vector) / np.linalg.norm(scalar))
    mean = filled_running_mean(day, value, count)
    gram, rows = grams_of(day, 7.1 * (ratio - 1.0))
    found, sigma = fit_remanence_factor(day, gram, rows, mean).at_scalar(ratio)
    assert abs(found - 7.1) < 3 * sigma
    assert sigma < 1.5


def test_eta_s_sigma_covers_two_thirds_though_errors_last_for_weeks():
    found = []
    for seed in range(100):
        day, value, count = daily_means(1300, seed=seed)
        found.append(
            fit_remanence_factor(day, *grams_of(day, 8.0, seed=seed), filled_running_mean(day, value, count))
        )
    pulls = [(one.difference - 8.0) / one.difference_sigma for one in found]
    assert 0.60 < np.mean(np.abs(pulls) < 1) < 0.76
    assert abs(np.mean(pulls)) < 0.5


def test_eta_is_refused_where_nothing_tells_it():
    day, value, count = daily_means(600)
    steady = filled_running_mean(day, np.full_like(value, 0.04), count)
    gram, rows = grams_of(day, 8.0)
    with pytest.raises(CalibrationError, match="does not change"):
        fit_remanence_factor(day, gram, rows, steady)
    mean = filled_running_mean(day, value, count)
    with pytest.raises(CalibrationError, match="no day"):
        fit_remanence_factor(day[:50], gram[:50], rows[:50], mean)
    with pytest.raises(SettingsError, match="same field"):
        fit_remanence_factor(day, gram, rows, mean).at_scalar(1.0)
