"""Slope/Intercept and Beta/Phi: signs and numbers of Farrell et al. (1995), corrected, and recovery."""

import numpy as np
import pytest
from farrell_cases import READINGS, TURN, natural, phase_of, record, sensors, stamps_of, truth_of

from inflight.errors import CalibrationError, SamplesError
from inflight.spin import (
    CalibrationParameters,
    SensorAngles,
    azimuth_between,
    calibrate_farrell,
    despin,
    fit_spins,
    respin,
)
from inflight.spin.farrell import instrument_noise
from inflight.time import DAY

WEAK, STRONG = [3.0, -2.5, 3.0], [8000.0, -6000.0, 5000.0]


def stepped(angles, strength, spins=200, seed=0):
    """A field that is steady within every spin, and so has no error of its own."""
    rng = np.random.default_rng(seed)
    each = strength * (np.array([0.8, -0.5, 0.4]) + 0.3 * rng.standard_normal((spins, 3)))
    field = np.repeat(each, READINGS, axis=0)
    phase = phase_of(len(field))
    return stamps_of(len(field)), angles.disturb(respin(field, phase)), phase, field


def test_a_steady_field_in_spinning_axes_is_that_of_equation_8():
    phase, strength, psi, axial = phase_of(100), 5.0, 0.7, 3.0
    payload = np.tile([strength * np.cos(psi), strength * np.sin(psi), axial], (100, 1))
    seen = respin(payload, phase)
    np.testing.assert_allclose(seen[:, 0], strength * np.cos(phase - psi), atol=1e-12)
    np.testing.assert_allclose(seen[:, 1], -strength * np.sin(phase - psi), atol=1e-12)
    np.testing.assert_allclose(despin(seen, phase), payload, atol=1e-12)
    with pytest.raises(SamplesError, match="shape"):
        despin(seen, phase[:-1])


def test_directions_are_the_first_order_ones_with_minus_dph2():
    small = sensors(degrees=0.01)
    one, two, three = small.matrix()
    np.testing.assert_allclose(one, [1, small.azimuth[0], small.elevation[0]], atol=1e-7)
    np.testing.assert_allclose(two, [-small.azimuth[1], 1, small.elevation[1]], atol=1e-7)
    towards = small.tilt * np.array([np.cos(small.tilt_azimuth), np.sin(small.tilt_azimuth)])
    np.testing.assert_allclose(three, [*towards, 1], atol=1e-7)
    e1 = 0.5 * (small.elevation[0] ** 2 + small.azimuth[0] ** 2)
    assert 1 - one[0] == pytest.approx(e1, rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_phases_have_the_sign_opposite_to_equations_24_and_31_as_printed(sign):
    angles = sensors(sign, degrees=2.0)
    fits = fit_spins(*stepped(angles, 100.0)[:3])
    azimuth = np.arctan2(fits.value[..., 1], fits.value[..., 2])
    tilted = azimuth[:, 0] - azimuth[:, 2]
    np.testing.assert_allclose(np.exp(1j * azimuth_between(fits, 0, 2)), np.exp(1j * tilted), atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * azimuth_between(fits, 0, 2)), np.exp(1j * angles.tilt_azimuth))
    total = TURN / 4 + angles.azimuth[1] - angles.azimuth[0]
    np.testing.assert_allclose(azimuth_between(fits, 0, 1), total, atol=1e-9)
    psi = np.angle(np.exp(1j * (angles.azimuth[0] - np.angle(fits.phasor[:, 0]))))
    field = despin(angles.remove(stepped(angles, 100.0)[1]), stepped(angles, 100.0)[2])[6::12]
    np.testing.assert_allclose(psi, np.arctan2(field[:, 1], field[:, 0]), atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("strength", [5.0, 1e4])
def test_angles_come_back_to_a_hundred_thousandth_where_nothing_fluctuates(sign, strength):
    angles = sensors(sign)
    stamps, readings, phase, field = stepped(angles, strength)
    found = calibrate_farrell(fit_spins(stamps, readings, phase), spin_axis_zero=(0.0, 0.0))
    np.testing.assert_allclose(found.value, truth_of(angles), atol=1e-5)
    np.testing.assert_allclose(found.intercepts.zero[0], angles.zero[:2], atol=1e-5 * strength)
    back = found.angles()
    np.testing.assert_allclose(back.matrix(), angles.matrix(), atol=1e-5)
    assert np.abs(despin(back.remove(readings), phase) - field).max() < 1e-6 * strength


def test_the_exact_inverse_leaves_nothing_and_first_order_steps_leave_a_nanotesla():
    """In a spin plane of 10^4 nT, with tenths of a degree: up to 1.7 nT, 83-116 with printed signs."""
    angles = SensorAngles(
        np.deg2rad([0.3, -0.4]), np.deg2rad([0.25, -0.32]), np.deg2rad(0.5), np.deg2rad(130.0)
    )
    phase = phase_of(240)
    field = respin(np.tile([6000.0, 8000.0, 2000.0], (240, 1)), phase)
    readings = angles.disturb(field)

    def left(restored):
        return np.abs(restored - field).max(axis=0)

    assert left(angles.remove(readings)).max() < 1e-9
    steps = left(angles.remove_first_order(readings, azimuth=True))
    assert 0.1 < steps.max() < 1.7
    # The signs as printed: dph B2 is added to B1 (32), and sensor 2 is taken to see +dph2 Bsp cos wt (13).
    printed = angles.remove_first_order(readings)
    printed[:, 0] += angles.azimuth[0] * printed[:, 1]
    printed[:, 1] -= angles.azimuth[1] * printed[:, 0]
    wrong = left(printed)[:2]
    assert (wrong > 83.0).all()
    assert (wrong < 116.0).all()
    np.testing.assert_allclose(wrong, 2 * np.abs(angles.azimuth) * 1e4, rtol=0.05)
    # IMP-8 left the azimuths in.
    assert left(angles.remove_first_order(readings))[0] == pytest.approx(
        abs(angles.azimuth[0]) * 1e4, rel=0.05
    )


def test_second_order_terms_after_the_azimuths_do_not_count_them_twice():
    angles = SensorAngles(azimuth=np.deg2rad([1.0, 1.0]))
    phase = phase_of(240)
    field = respin(np.tile([6000.0, 8000.0, 0.0], (240, 1)), phase)
    steps = angles.remove_first_order(angles.disturb(field), azimuth=True, second=True)
    twice = steps[:, :2] * (1.0 + 0.5 * angles.azimuth**2)
    assert np.abs(steps - field).max() < 1.1 * np.abs(twice - field[:, :2]).max()
    bare = SensorAngles(elevation=np.deg2rad([1.0, -1.0]))
    readings = bare.disturb(field)
    first = np.abs(bare.remove_first_order(readings) - field).max()
    assert np.abs(bare.remove_first_order(readings, second=True) - field).max() < 1e-2 * first


@pytest.mark.parametrize("mean", [WEAK, STRONG])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_stated_sigmas_cover_in_fields_that_fluctuate(mean, sign):
    angles = sensors(sign)
    truth, inside, zeros = truth_of(angles), [], []
    for seed in range(30):
        found = calibrate_farrell(fit_spins(*record(seed, angles, mean)[:3]), spin_axis_zero=(0.0, 0.0))
        inside.append(np.abs(found.value - truth) < found.sigma)
        pulls = (found.intercepts.zero[0] - angles.zero[:2]) / found.intercepts.sigma[0]
        zeros.append(np.abs(pulls) < 1)
    assert 0.60 < np.mean(inside) < 0.78
    assert 0.50 < np.mean(zeros) < 0.84


def test_gaps_wild_readings_and_a_missing_one_cost_little():
    angles = sensors()
    stamps, readings, phase, _ = record(3, angles, WEAK)
    clean = calibrate_farrell(fit_spins(stamps, readings, phase))
    rng = np.random.default_rng(1)
    kept = rng.random(stamps.size) > 0.15
    kept[4000:5000] = False
    spoilt = readings.copy()
    spoilt[rng.random(readings.shape) < 0.005] += 200.0
    spoilt[77, 2] = np.nan
    found = calibrate_farrell(fit_spins(stamps[kept], spoilt[kept], phase[kept]))
    off = (found.value - truth_of(angles)) / found.sigma
    assert np.abs(off).max() < 4.0
    assert (found.sigma < 3.0 * clean.sigma).all()


def test_saturated_readings_are_for_the_caller_to_mark_and_then_do_no_harm():
    angles = sensors()
    stamps, readings, phase, _ = record(4, angles, STRONG)
    limit = 0.98 * np.abs(readings[:, :2]).max()
    clipped = np.clip(readings, -limit, limit)
    good = (np.abs(readings) < limit).all(axis=1)
    found = calibrate_farrell(fit_spins(stamps, clipped, phase, good=good))
    assert np.abs((found.value - truth_of(angles)) / found.sigma).max() < 4.0


def test_noise_of_the_spin_axis_sensor_draws_plain_slopes_to_zero_and_not_these():
    angles = SensorAngles(elevation=np.array([0.1, -0.1]))
    plain, fair, sigma = [], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        phase = phase_of(400 * READINGS)
        axial = np.repeat(1.0 + 0.3 * rng.standard_normal(400), READINGS)
        field = respin(np.stack([np.full(phase.size, 5.0), np.zeros(phase.size), axial], axis=1), phase)
        noise = rng.standard_normal(field.shape) * [0.01, 0.01, 0.6]
        fits = fit_spins(stamps_of(phase.size), angles.disturb(field) + noise, phase)
        found = calibrate_farrell(fits, spins=1)
        plain.append(found.plain_slope)
        fair.append(found.value[:2])
        sigma.append(found.sigma[:2])
    signs = np.array([1.0, -1.0])
    error = np.std(fair) / np.sqrt(60)
    # Noise makes 0.6^2 / 12 of the variance of 0.3^2 + 0.6^2 / 12.
    assert np.mean(plain @ signs / 2) == pytest.approx(0.1 / (1 + 0.03 / 0.09), rel=0.03)
    assert np.mean(fair @ signs / 2) == pytest.approx(np.arcsin(0.1), abs=4 * error)
    assert 0.60 < np.mean(np.abs(np.array(fair) - np.arcsin(0.1) * signs) < sigma) < 0.78


def test_the_noise_of_the_instrument_is_told_from_the_field_by_the_quietest_fits():
    rng = np.random.default_rng(0)
    phase = phase_of(3000 * READINGS)
    field = natural(rng, phase.size, WEAK)
    field[: phase.size // 3] = WEAK
    readings = respin(field, phase) + 0.02 * rng.standard_normal(field.shape)
    noise = instrument_noise(fit_spins(stamps_of(phase.size), readings, phase))
    # An upper bound: the quietest tenth of all is not the lowest tenth of the quiet third.
    assert (noise > 0.019).all()
    assert (noise < 0.026).all()


def test_a_tilt_of_nothing_is_nothing_where_equation_25_gives_noise():
    angles = SensorAngles()
    found, printed = [], []
    for seed in range(20):
        fits = fit_spins(*record(seed, angles, WEAK, spins=300, noise=0.1)[:3])
        found.append(calibrate_farrell(fits).value[2:4])
        printed.append(np.mean(np.abs(fits.phasor[:, 2]) / np.abs(fits.phasor[:, 0])))
    assert np.mean(printed) > 0.01
    assert np.abs(np.mean(found, axis=0)).max() < 4 * np.std(found) / np.sqrt(20)
    assert np.abs(np.mean(found)) < 0.1 * np.mean(printed)
    nothing = calibrate_farrell(fit_spins(*record(0, angles, WEAK, spins=300, noise=0.1)[:3]))
    assert np.isnan(nothing.tilt_azimuth[0])


def test_counts_need_the_ratio_of_the_sensitivities():
    angles, unit = sensors(zero=(0.0, 0.0, 0.0)), np.array([0.01, 0.01, 0.02])
    stamps, readings, phase, _ = stepped(angles, 50.0)
    counts = fit_spins(stamps, readings / unit, phase, unit="counts")
    found = calibrate_farrell(counts, sensitivity=unit)
    np.testing.assert_allclose(found.value, truth_of(angles), atol=1e-9)
    slope = np.polyfit(counts.constant[:, 2], counts.constant[:, 0], 1)[0]
    assert slope * unit[0] / unit[2] == pytest.approx(angles.elevation[0], rel=1e-3)


def test_an_intercept_is_the_zero_level_only_when_that_of_sensor_3_is_known():
    angles = sensors(zero=(1.5, -2.0, 40.0))
    fits = fit_spins(*stepped(angles, 50.0)[:3])
    blind, knowing = calibrate_farrell(fits), calibrate_farrell(fits, spin_axis_zero=(40.0, 1.0))
    expected = angles.zero[:2] - np.sin(angles.elevation) / np.cos(angles.tilt) * 40.0
    np.testing.assert_allclose(blind.intercepts.intercept[0], expected, atol=1e-6)
    assert "O3 not known" in blind.summary()
    np.testing.assert_allclose(knowing.intercepts.zero[0], angles.zero[:2], atol=1e-6)
    np.testing.assert_allclose(knowing.intercepts.sigma[0], np.abs(angles.elevation), rtol=1e-3)


def test_a_zero_level_that_drifts_is_followed_window_by_window_against_preflight():
    angles, inside, rates = sensors(), [], []
    for seed in range(50):
        stamps, readings, phase, _ = record(seed, angles, WEAK, spins=1000)
        days = (stamps - stamps[0]) / DAY
        drift = np.array([20.0, -10.0])
        readings[:, :2] += days[:, None] * drift
        found = calibrate_farrell(fit_spins(stamps, readings, phase), window=0.005, spin_axis_zero=(0.0, 0.0))
        levels = found.intercepts
        true = angles.zero[:2] + (levels.time - stamps[0])[:, None] / DAY * drift
        inside.append(np.abs(levels.zero - true) < levels.sigma)
        change = levels.against(np.array([1.0, -2.2]), 0.1)
        rates.append((change.rate - drift) / change.rate_sigma)
        np.testing.assert_allclose(change.change, levels.zero - [1.0, -2.2])
        assert (change.change_sigma > 0.1).all()
    assert len(levels.zero) == 7
    assert 0.60 < np.mean(inside) < 0.78
    assert np.abs(rates).max() < 5.0
    assert 0.50 < np.mean(np.abs(rates) < 1) < 0.85
    assert "from before the flight" in change.summary()


def mean_phasors(stamps, field, phase):
    """Sizes of the mean phasors at the spin and at twice it, and the scatter's error of either part."""
    whole = fit_spins(stamps, field, phase, harmonics=2).whole
    sigma = [
        np.sqrt(0.5 * np.mean(np.abs(one - one.mean(axis=0)) ** 2, axis=0) / len(whole))
        for one in (whole.phasor, whole.double)
    ]
    return np.abs(whole.phasor.mean(axis=0)), np.abs(whole.double.mean(axis=0)), *sigma


def test_the_spin_tone_leaves_with_the_right_angles_only():
    angles = sensors()
    stamps, readings, phase, _ = record(0, angles, STRONG)
    found = calibrate_farrell(fit_spins(stamps, readings, phase), spin_axis_zero=(0.0, 0.0))
    raw, raw_twice, _, _ = mean_phasors(stamps, despin(readings, phase), phase)
    once, twice, sigma, _ = mean_phasors(stamps, despin(found.angles().remove(readings), phase), phase)
    assert (raw > 10.0).all()
    assert (once < np.maximum(5 * sigma, 0.01 * raw)).all()
    # Half of Bsp times what the total phase and the ratio of the gains are known to.
    most = 0.5 * 1e4 * np.hypot(found.sigma[4], found.sigma[5])
    assert (twice[:2] < 3 * most).all()
    assert (twice[:2] < 0.2 * raw_twice[:2]).all()


def test_a_wrong_spin_period_shows_in_the_fits():
    stamps, readings, phase, _ = record(0, sensors(), WEAK)
    right, wrong = (fit_spins(stamps, readings, factor * phase) for factor in (1.0, 1.05))
    assert np.median(wrong.rms[:, 0]) > 2 * np.median(right.rms[:, 0])
    assert wrong.changing[:, 0].mean() < 0.05


def test_the_azimuth_of_sensor_1_and_its_sigma_are_carried():
    angles = sensors()
    fits = fit_spins(*stepped(angles, 50.0)[:3])
    found = calibrate_farrell(fits, azimuth_1=(0.01, 0.002))
    assert found.tilt_azimuth[0] == pytest.approx(angles.tilt_azimuth + 0.01, abs=1e-6)
    assert found.tilt_azimuth[1] == pytest.approx(0.002, rel=1e-3)
    assert found.angles().azimuth == pytest.approx([0.01, 0.01 + angles.azimuth[1]], abs=1e-6)
    assert found.tilt[0] == pytest.approx(angles.tilt, abs=1e-6)


def test_too_little_is_refused_with_what_to_do():
    stamps, readings, phase, _ = record(0, sensors(), WEAK, spins=8)
    with pytest.raises(CalibrationError, match="at least 10 needed; take a longer span"):
        calibrate_farrell(fit_spins(stamps, readings, phase))
    flat = respin(np.tile(WEAK, (100 * READINGS, 1)), phase_of(100 * READINGS))
    flat = flat + 0.1 * np.random.default_rng(0).standard_normal(flat.shape)
    with pytest.raises(CalibrationError, match="is noise"):
        calibrate_farrell(fit_spins(stamps_of(len(flat)), flat, phase_of(len(flat))))
    with pytest.raises(SamplesError, match="3 needed"):
        calibrate_farrell(fit_spins(stamps_of(len(flat)), flat[:, :2], phase_of(len(flat))))
    with pytest.raises(CalibrationError, match="in one plane"):
        SensorAngles(azimuth=np.array([0.0, -TURN / 4])).remove(flat)


def test_the_eight_that_go_with_the_directions_found_are_those_of_the_sensor():
    truth = CalibrationParameters(1.001, 1.0, 1.0, (2e-3, -3e-3), 1e-3, (3e-3, -1e-3), 0.0, (0.4, -0.3, 0.2))
    stamps, plain, phase, _ = stepped(SensorAngles(), 30.0)
    fits = fit_spins(stamps, truth.disturb(plain), phase)
    unit = np.array([1.001, 1.0 / 1.001, 1.0])
    value, covariance = calibrate_farrell(
        fits, sensitivity=unit, spins=1, spin_axis_zero=(0.2, 0.0)
    ).spin_related(unit)
    np.testing.assert_allclose(value, truth.spin_related(), atol=2e-8)
    assert np.linalg.eigvalsh(covariance).min() > -1e-20
