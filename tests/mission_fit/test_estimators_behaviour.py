"""How daily parameters behave: periods in red noise, means with gaps, slopes, loops, steps, clock faults."""

import numpy as np
import pytest
from estimator_cases import wandering

from inflight.errors import CalibrationError
from inflight.lsq import long_run_covariance, sigma_of_mean
from inflight.mission_fit import (
    find_clock_faults,
    find_week_pattern,
    fit_slope,
    hysteresis_loop,
    measure_event_steps,
    parameter_spectrum,
    running_mean,
)
from inflight.mission_fit.parameter_series import holm
from inflight.simulate import SimulationSettings, effect_names, simulate_day

#: Middles of the days of eight years, and of two.
DAYS = np.arange(200.0, 3200.0) + 0.5
SHORT = DAYS[:800]
WEDNESDAYS = np.arange(200.0, 3200.0)[np.arange(200, 3200) % 7 == 4] + 10 / 24


def daily(days, seed, *, red=0.05, memory=30.0, white=0.05, gaps=0.1):
    """Wandering values with noise and gaps; unit-free."""
    generator = np.random.default_rng(seed)
    value = red * wandering(days.size, memory, generator) + white * generator.normal(size=days.size)
    value[generator.random(days.size) < gaps] = np.nan
    value[days.size // 3 : days.size // 3 + days.size // 30] = np.nan
    return value


def sigmas(days, size=0.05):
    return np.full(days.size, size)


def test_red_noise_alone_has_no_lines():
    peaks = sum(
        len(parameter_spectrum(SHORT, daily(SHORT, seed), sigmas(SHORT), trials=40).peaks)
        for seed in range(20)
    )
    assert peaks <= 2, "one spectrum in a hundred may have one"


def test_white_thresholds_would_have_found_lines_in_it():
    """What makes the red background necessary: by the white level alone every spectrum has lines."""
    found = parameter_spectrum(SHORT, daily(SHORT, 3), sigmas(SHORT), trials=20)
    white = np.median(found.amplitude**2) / np.log(2)
    assert np.max(found.amplitude**2) / white > 15


def test_lines_in_red_noise_are_told_with_amplitude_phase_and_name():
    value = daily(DAYS, 1) + 0.2 * np.cos(2 * np.pi * (DAYS - 1000) / 260.5)
    value -= 0.08 * np.cos(2 * np.pi * (DAYS - 1000) / 130.0)
    found = parameter_spectrum(DAYS, value, sigmas(DAYS), trials=60, unit="nT")
    named = {one.name: one for one in found.named}
    assert {one.label for one in found.peaks} == {"260.5 d", "130 d"}
    assert abs(named["260.5 d"].amplitude - 0.2) < 4 * named["260.5 d"].sigma
    assert abs(named["130 d"].amplitude - 0.08) < 4 * named["130 d"].sigma
    away = (named["260.5 d"].maximum - 1000 + 130.25) % 260.5 - 130.25
    assert abs(away) < 8
    assert named["365 d"].false_alarm > 1e-3
    assert 10 < found.correlation_days < 90


def test_one_sigma_of_an_amplitude_covers_two_thirds_of_seeds():
    inside = []
    for seed in range(60):
        value = daily(DAYS[:1600], seed)
        for period, size in ((260.5, 0.2), (130.0, 0.15)):
            value = value + size * np.cos(2 * np.pi * DAYS[:1600] / period + seed)
        found = parameter_spectrum(DAYS[:1600], value, sigmas(DAYS[:1600]), trials=5, shortest=20)
        for one, size in zip(found.named[:2], (0.15, 0.2), strict=True):
            inside.append(abs(one.amplitude - size) < one.sigma)
    assert 0.57 <= np.mean(inside) <= 0.79


def test_periods_that_a_span_does_not_resolve_are_said_so():
    found = parameter_spectrum(SHORT, daily(SHORT, 1), sigmas(SHORT), trials=10)
    named = {one.name: one for one in found.named}
    assert named["130 d"].resolved
    assert not named["260.5 d"].resolved
    assert "do not tell it from 365 d, 908 are needed" in named["260.5 d"].why
    assert np.isnan(named["365 d"].amplitude)
    assert not found.table()["determined"].sel(parameter="365 d")
    early = parameter_spectrum(DAYS[:150], daily(DAYS[:150], 1), sigmas(DAYS[:150]), trials=10)
    assert all("less than 1.5 periods" in one.why for one in early.named)


def test_a_slope_among_waves_is_recovered_with_honest_sigma():
    """The published drift of the Z offset, -0.00024 nT a day."""
    pulls = []
    for seed in range(80):
        value = daily(DAYS, seed) - 0.00024 * DAYS + 0.15 * np.cos(2 * np.pi * DAYS / 260.5)
        value[700] = 20.0
        found = fit_slope(DAYS, value, sigmas(DAYS), periods=(260.5,))
        pulls.append((found.slope + 0.00024) / found.sigma)
    assert found.sigma < 3e-5
    assert found.outlying >= 1
    assert 0.58 <= np.mean(np.abs(pulls) < 1) <= 0.78


def test_a_turn_of_local_time_averages_out_what_repeats_with_it():
    value = 1.0 + 0.3 * np.cos(2 * np.pi * DAYS / 260.5)
    found = running_mean(DAYS, value, 260.5)
    inner = np.isfinite(found.value)
    assert np.abs(found.value[inner] - 1).max() < 0.004
    assert running_mean(DAYS, value, 60).value[1000] == pytest.approx(value[1000], abs=0.03)


def test_ends_and_gaps_of_a_running_mean_are_defined():
    value = np.ones(DAYS.size)
    value[1000:1200] = np.nan
    found = running_mean(DAYS, value, 60)
    assert np.isnan(found.value[:10]).all()
    assert np.isfinite(found.value[40])
    assert np.isnan(found.value[1050:1150]).all()
    assert found.coverage[1100] == 0
    with pytest.raises(CalibrationError, match="no window of 260 days"):
        running_mean(DAYS[:100], value[:100], 260)


def test_one_sigma_of_a_running_mean_covers_the_truth():
    inside = []
    for seed in range(40):
        found = running_mean(DAYS, daily(DAYS, seed, memory=6.0), 260.0)
        some = np.flatnonzero(np.isfinite(found.value))[::300]
        inside += list(np.abs(found.value[some]) < found.sigma[some])
    assert 0.58 <= np.mean(inside) <= 0.78


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_area_of_a_loop_is_recovered_with_its_sign_and_an_honest_error(sign):
    temperature = 10 + 6 * np.sin(2 * np.pi * DAYS / 130)
    areas, errors = [], []
    for seed in range(60):
        lag = sign * 0.05 * np.cos(2 * np.pi * DAYS / 130)
        value = 0.01 * temperature + lag + daily(DAYS, seed, memory=5.0, white=0.03)
        noisy = temperature + 0.2 * np.random.default_rng(seed).normal(size=DAYS.size)
        loop = hysteresis_loop(DAYS, noisy, value, unit="nT")
        areas.append(loop.area)
        errors.append(loop.sigma)
    # An ellipse of half-axes 6 K and 0.05 nT, pi a b, less the tips that no bin reaches.
    assert np.mean(areas) == pytest.approx(sign * np.pi * 6 * 0.05, rel=0.05)
    assert np.std(areas) == pytest.approx(np.mean(errors), rel=0.35)
    assert loop.is_open
    assert sign * (loop.rising - loop.falling)[3] > 0


def test_a_function_of_temperature_alone_has_no_loop():
    opened = 0
    for seed in range(30):
        temperature = 10 + 6 * np.sin(2 * np.pi * DAYS / 130) + 2 * np.sin(2 * np.pi * DAYS / 365)
        value = 0.02 * temperature + 0.003 * temperature**2 + daily(DAYS, seed)
        opened += hysteresis_loop(DAYS, temperature, value).is_open
    assert opened <= 2


def test_steps_on_event_days_are_found_with_their_sizes_and_others_are_not():
    false, found, pulls = 0, 0, []
    steps = {20: 0.4, 100: -0.4, 300: 0.4}
    for seed in range(20):
        value = daily(DAYS, seed, memory=10.0, white=0.03)
        for index, size in steps.items():
            value = value + size * (WEDNESDAYS[index] < DAYS)
        result = measure_event_steps(DAYS, value, sigmas(DAYS, 0.03), WEDNESDAYS)
        found += sum(bool(result.found[index]) for index in steps)
        false += int(result.found.sum()) - sum(bool(result.found[index]) for index in steps)
        others = np.setdiff1d(np.arange(WEDNESDAYS.size), list(steps))
        pulls += list((result.size / result.sigma)[others])
    assert false <= 2
    assert found >= 0.7 * 20 * 3
    assert 0.64 <= np.nanmean(np.abs(pulls) < 1) / np.mean(np.isfinite(pulls)) <= 0.76


def test_the_reset_day_is_found_among_the_days_of_the_week():
    generator = np.random.default_rng(2)
    level = 0.1 * generator.normal(size=500)
    week = np.floor((DAYS - 4.0) / 7).astype(int)
    # A reset at 10:00: the day's own mean holds 10 hours of the old level and 14 of the new one.
    wednesday = np.floor(DAYS).astype(int) % 7 == 4
    held = np.where(wednesday, (10 * level[week - 1] + 14 * level[week]) / 24, level[week])
    found = find_week_pattern(DAYS, daily(DAYS, 3, red=0.02, white=0.03) + held, unit="nT")
    assert found.found
    assert found.day == 4
    assert abs(found.step - 0.1 * np.sqrt(2)) < 4 * found.sigma_step
    assert "Wednesdays (MJD mod 7 = 4)" in found.summary()
    quiet = [find_week_pattern(DAYS, daily(DAYS, seed)).found for seed in range(20)]
    assert sum(quiet) <= 1


def test_holm_counts_the_tests_that_were_made():
    np.testing.assert_allclose(holm(np.array([0.01, np.nan, 0.04, 0.03])), [0.03, np.nan, 0.06, 0.06])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_clock_fault_of_four_days_is_found_without_being_told_the_days(sign):
    """MJD 3164 to 3167, 12 ms (Yin 2010, ch. 4)."""
    pulls = []
    for seed in range(10):
        shift = 0.015 + daily(DAYS, seed, red=2e-4, white=5e-4)
        shift[2964:2968] = 0.015 + sign * 0.012 + 5e-4 * np.random.default_rng(seed).normal(size=4)
        found = find_clock_faults(DAYS, shift, sigmas(DAYS, 4e-4))
        assert [(one.first, one.last) for one in found.faults] == [(3164, 3167)]
        pulls.append((found.faults[0].shift - sign * 0.012) / found.faults[0].sigma)
    assert np.std(pulls) < 2.0
    assert "MJD 3164 to 3167" in found.summary()[0]


def test_a_weak_fault_of_many_days_is_found_and_wander_is_none():
    shift = 0.015 + daily(DAYS, 4, red=0.0, white=5e-4)
    shift[1500:1512] += 0.0016
    fault = find_clock_faults(DAYS, shift, sigmas(DAYS, 5e-4)).faults[0]
    assert abs(fault.first - 1700) <= 2
    assert abs(fault.last - 1711) <= 2
    wander = [
        bool(find_clock_faults(DAYS, daily(DAYS, seed, red=3e-4, white=5e-4), sigmas(DAYS, 4e-4)).faults)
        for seed in range(20)
    ]
    assert sum(wander) <= 2


def test_the_simulated_missions_clock_fault_is_found_from_its_own_days():
    """Daily shifts by least squares of dB on dF/dt and the nine parameters' columns, days not told."""
    kept = ("misalignment", "offset", "ageing", "time_shift", "external_field", "clock_fault")
    others = tuple(name for name in effect_names() if name not in kept)
    settings = SimulationSettings(cadence=10, without=others, include=("clock_fault",), defects=())
    first = np.datetime64("2000-01-01", "D") + 3155
    days, shifts, errors = [], [], []
    for index in range(22):
        simulated = simulate_day(settings, first + index).instruments
        reading, scalar = simulated["fgm"]["FGM_RAW"].values, simulated["ovm"]["F"].values
        rate = np.gradient(scalar, 10.0)
        strength = np.linalg.norm(reading, axis=1)
        x, y, z = reading.T / strength
        tensor = np.stack([x * x, y * y, z * z, x * y, x * z, y * z], axis=1) * strength[:, None] / 5e4
        rows = np.column_stack([tensor, x, y, z, rate])[5:-5]
        value, rest, _, _ = np.linalg.lstsq(rows, (strength - scalar)[5:-5])
        days.append(3155.5 + index)
        shifts.append(value[-1])
        errors.append(np.sqrt(np.linalg.inv(rows.T @ rows)[-1, -1] * rest[0] / len(rows)))
    found = find_clock_faults(np.array(days), np.array(shifts), np.array(errors))
    assert [(one.first, one.last) for one in found.faults] == [(3164, 3167)]
    assert abs(found.faults[0].shift) == pytest.approx(0.012, abs=0.0015)


@pytest.mark.parametrize(("memory", "white"), [(0.01, 0.0), (5.0, 0.0), (40.0, 1.0)])
def test_the_sigma_of_a_mean_is_honest_for_days_that_remember(memory, white):
    inside = []
    for seed in range(150):
        generator = np.random.default_rng(seed)
        series = wandering(2000, memory, generator) + white * generator.normal(size=2000)
        inside.append(abs(series.mean()) < sigma_of_mean(series))
    assert 0.58 <= np.mean(inside) <= 0.78
    assert long_run_covariance(np.ones((1, 2))).tolist() == [[0, 0], [0, 0]]


def test_too_little_data_is_refused_in_words():
    few, nan = DAYS[:8], np.full(8, np.nan)
    with pytest.raises(CalibrationError, match="0 days with a value make no spectrum"):
        parameter_spectrum(few, nan, np.ones(8))
    with pytest.raises(CalibrationError, match="2 unknowns"):
        fit_slope(few, nan, np.ones(8))
    with pytest.raises(CalibrationError, match="0 days have a time shift"):
        find_clock_faults(few, nan, np.ones(8))
    with pytest.raises(CalibrationError, match="contrasts away from events"):
        measure_event_steps(few, np.ones(8), np.ones(8), np.array([203.4]))
    with pytest.raises(CalibrationError, match="whole weeks"):
        find_week_pattern(few, np.ones(8))
    with pytest.raises(CalibrationError, match="make no loop"):
        hysteresis_loop(few, np.ones(8), np.ones(8))
