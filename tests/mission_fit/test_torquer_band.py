"""Torquer coefficients from the band of their modulation."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import detrend

from inflight.errors import CalibrationError, SamplesError
from inflight.mission_fit import (
    band_equations,
    concat_band_equations,
    daily_fits,
    fit_band,
    instrument_spectra,
    robust_mean,
    torquer_lines,
)
from inflight.mission_fit.torquers import band_spectra
from inflight.simulate import Parameters, Sampling, torquer_currents
from inflight.time import SECOND, day_bounds

#: What the thesis finds to lack in the scalar sensor's matrix, nT/A (p. 52).
LACKS = np.array([[0.385, 0.134, 0.162], [-0.402, 1.452, -0.199], [0.237, -0.247, 0.232]])
FIRST = np.datetime64("2007-08-09", "D")


def make_day(number=0, seed=1, *, hours=24.0, noise=0.09, slow=0.3, lacks=LACKS):
    """Times, residual, direction and currents; the scalar sensor's matrix lacks `lacks`."""
    start, _ = day_bounds(FIRST + number)
    times = Sampling.of_span(start, start + round(hours * 3600) * SECOND, SECOND)
    current = torquer_currents(times, Parameters(), seed, number)
    angle = 2 * np.pi * times.seconds / 5560.0
    field = np.column_stack([np.cos(angle), 0.25 * np.sin(0.97 * angle + number), 2 * np.sin(angle)])
    direction = field / np.linalg.norm(field, axis=1, keepdims=True)
    random = np.random.default_rng([seed, number])
    # F is corrected by too little: e.(lacks I) is left in it, and with a minus in dB = |B_v| - F.
    residual = slow * np.sin(angle + 1.0) - np.einsum("tj,jk,tk->t", direction, lacks, current)
    return times.tt2000, residual + noise * random.standard_normal(angle.size), direction, current


def band_power(residual, count=3600):
    """Power between 0.045 and 0.055 Hz, hour by hour, nT^2."""
    pieces = detrend(residual[: residual.size // count * count].reshape(-1, count), axis=1)
    frequency = np.fft.rfftfreq(count, 1.0)
    inside = (frequency > 0.0449) & (frequency < 0.0551)
    return float(np.sum(np.abs(np.fft.rfft(pieces, axis=1)[:, inside]) ** 2) * 2 / count)


@pytest.mark.parametrize("sign", [-1, 1])
def test_the_matrix_is_recovered_with_its_sign(sign):
    fit = fit_band(band_equations(*make_day(lacks=sign * LACKS)))
    assert np.abs((fit.for_scalar - sign * LACKS) / fit.sigma).max() < 3.5
    assert fit.value == pytest.approx(-fit.for_scalar)
    assert fit.level == pytest.approx(0.09, rel=0.1)


def test_without_noise_the_closed_form_is_exact():
    fit = fit_band(band_equations(*make_day(hours=8, noise=0.0, slow=0.0)))
    assert fit.for_scalar == pytest.approx(LACKS, abs=1e-9)


def test_adding_the_correction_removes_the_line_and_the_thesis_minus_doubles_it():
    stamps, residual, direction, current = make_day(noise=0.02, slow=0.0)
    found = fit_band(band_equations(stamps, residual, direction, current)).for_scalar
    seen = np.einsum("tj,jk,tk->t", direction, found, current)
    before, right, printed = (band_power(residual + sign * seen) for sign in (0, 1, -1))
    noise = 0.02**2 * 2 * 37 * 24
    assert right == pytest.approx(noise, rel=0.15)
    assert before > 5 * noise
    assert printed - noise == pytest.approx(4 * (before - noise), rel=0.1)


def test_row_y_is_weak_and_says_so():
    """The field has a small y: the published errors of row 2 are the largest of each column but one."""
    fit = fit_band(band_equations(*make_day()))
    assert (fit.sigma[1] > 3 * fit.sigma[[0, 2]]).all()
    assert (fit.retained > 0.01).all()
    assert 0.3 < fit.sigma[1, 1] / 1.192 < 3.0


def test_slsqp_on_the_integral_of_the_thesis_finds_the_same():
    """Minimising the band's power, eq. 3.5, numerically: equal to 1e-5 nT/A."""
    stamps, residual, direction, current = make_day(hours=6)
    closed = fit_band(band_equations(stamps, residual, direction, current)).for_scalar
    columns = np.einsum("tj,tk->tjk", direction, current).reshape(-1, 6, 3600, 9).swapaxes(0, 1)[:, 0]
    frequency = np.fft.rfftfreq(3600, 1.0)
    inside = (frequency > 0.0449) & (frequency < 0.0551)
    seen = np.fft.rfft(detrend(columns, axis=1), axis=1)[:, inside].reshape(-1, 9)
    wanted = np.fft.rfft(detrend(residual.reshape(6, 3600), axis=1), axis=1)[:, inside].ravel()
    # The currents are small: an optimiser needs coordinates of like size and power near one.
    scale = 1.0 / np.linalg.norm(seen, axis=0)
    unit = float(np.linalg.norm(wanted))

    def power(x):
        left = (wanted + seen @ (scale * x) * unit) / unit
        slope = 2 * np.real(np.conj(left) @ (seen * scale))
        return float(np.vdot(left, left).real), slope

    result = minimize(power, np.zeros(9), jac=True, method="SLSQP", options={"ftol": 1e-16, "maxiter": 500})
    assert (result.x * scale * unit).reshape(3, 3) == pytest.approx(closed, abs=1e-5)


def test_one_sigma_covers_two_thirds():
    pulls = []
    for seed in range(40):
        fit = fit_band(band_equations(*make_day(seed, seed, hours=8), longest=1200))
        pulls.append(((fit.for_scalar - LACKS) / fit.sigma).ravel())
    assert 0.60 < np.mean(np.abs(pulls) < 1) < 0.76
    assert 0.7 < np.std(pulls) < 1.2


def test_a_residual_that_follows_the_orbit_leaks_less_after_a_higher_order():
    levels = [fit_band(band_equations(*make_day(slow=3.0), order=order)).level for order in (1, 5)]
    assert levels[0] > 1.2 * 0.09
    assert levels[1] == pytest.approx(0.09, rel=0.05)


def test_gaps_and_missing_samples_cut_the_stretches():
    stamps, residual, direction, current = make_day(hours=8)
    residual[5000] = np.nan
    current[9000:9100] = np.nan
    kept = np.r_[0:15000, 15500 : stamps.size]
    part = band_equations(stamps[kept], residual[kept], direction[kept], current[kept])
    assert (part["end"] - part["start"]).max() < 3600 * SECOND
    assert not any(
        start < stamps[5000] < end
        for start, end in zip(part["start"].values, part["end"].values, strict=True)
    )
    fit = fit_band(part)
    assert np.abs((fit.for_scalar - LACKS) / fit.sigma).max() < 4.0


def test_days_are_kept_joined_and_averaged_robustly():
    parts = [band_equations(*make_day(day, hours=8)) for day in range(12)]
    spoiled = make_day(12, hours=8, noise=0.09, lacks=20 * LACKS)
    stored = concat_band_equations([*parts, band_equations(*spoiled)])
    daily = daily_fits(stored)
    assert daily.sizes["day"] == 13
    mean = robust_mean(daily)
    assert np.abs((mean["value"].values + LACKS) / mean["sigma"].values).max() < 4.0
    clean = fit_band(concat_band_equations(parts), by="day")
    assert clean.fit.clusters == 12
    assert np.abs((clean.for_scalar - LACKS) / clean.sigma).max() < 4.0
    assert stored["gram"].dtype == np.float64
    assert stored.nbytes < 13 * 10_000


def test_the_robust_mean_s_error_covers_two_thirds():
    pulls = []
    for seed in range(12):
        parts = [band_equations(*make_day(day, seed, hours=3), longest=1500) for day in range(10)]
        mean = robust_mean(daily_fits(concat_band_equations(parts)))
        pulls.append(((mean["value"] + LACKS) / mean["sigma"]).values)
    assert 0.58 < np.mean(np.abs(pulls) < 1) < 0.78


def test_the_errors_of_few_days_cover_the_truth():
    pulls = []
    for seed in range(12):
        parts = [band_equations(*make_day(day, seed, hours=3), longest=1500) for day in range(6)]
        joined = concat_band_equations(parts)
        mean, fit = robust_mean(daily_fits(joined)), fit_band(joined, by="day")
        pulls.append([((mean["value"] + LACKS) / mean["sigma"]).values, (fit.for_scalar - LACKS) / fit.sigma])
    assert (np.sqrt(np.mean(np.square(pulls), axis=(0, 2, 3))) < 1.2).all()


def test_spectra_show_the_line_before_and_not_after():
    day = make_day(noise=0.05)
    fit = fit_band(band_equations(*day))
    spectra = band_spectra(*day, fit.value)
    line = np.abs(spectra["frequency"] - 0.05) < 0.0007
    beside = (np.abs(spectra["frequency"] - 0.05) > 0.003) & (np.abs(spectra["frequency"] - 0.05) < 0.01)
    before, after = (spectra[name].where(line, drop=True).max() for name in ("before", "after"))
    floor = spectra["after"].where(beside, drop=True).median()
    assert before > 10 * floor
    assert after < 2 * floor


def test_what_cannot_be_done_is_refused():
    stamps, residual, direction, current = make_day(hours=2)
    with pytest.raises(SamplesError, match="every 10 s"):
        band_equations(stamps[::10], residual[::10], direction[::10], current[::10])
    with pytest.raises(SamplesError, match="no stretch"):
        band_equations(stamps[:300], residual[:300], direction[:300], current[:300])
    with pytest.raises(CalibrationError, match="2 clusters"):
        fit_band(band_equations(stamps, residual, direction, current))
    without = current * [1.0, 0.0, 1.0]
    with pytest.raises(CalibrationError, match="zero"):
        fit_band(band_equations(stamps, residual, direction, without, longest=900))


@pytest.mark.parametrize(
    ("wrong", "told"), [("scalar", "scalar sensor"), ("vector", "vector sensor"), ("", "neither")]
)
def test_the_line_is_seen_in_the_instrument_whose_matrix_is_wrong(wrong, told):
    stamps, _, direction, current = make_day(hours=12)
    angle, random = 2 * np.pi * np.arange(stamps.size) / 5560.0, np.random.default_rng(3)
    truth = 4e4 + 1.5e4 * np.cos(2 * angle) + 300 * np.sin(5 * angle)
    line = np.einsum("tj,jk,tk->t", direction, 3 * LACKS, current)
    vector, scalar = (
        truth + size * random.standard_normal(truth.size) + line * (name == wrong)
        for name, size in (("vector", 0.08), ("scalar", 0.04))
    )
    found = torquer_lines([instrument_spectra(stamps, vector, scalar)])
    assert told in found.attrs["told"]
    if wrong:
        # The band holds the line of 20 s and the commands' own noise.
        alone = np.sqrt(band_power(line) / line.size)
        assert float(found["value"].sel(sensor=wrong)) == pytest.approx(alone, rel=0.15)
    right = [name for name in ("vector", "scalar") if name != wrong]
    assert (np.abs(found["excess"].sel(sensor=right)) < 4 * found["excess_sigma"].sel(sensor=right)).all()


def test_without_a_line_its_size_lies_within_its_errors():
    """Noise that falls with frequency and white noise: the spectrum beside the band is bent."""
    random, far = np.random.default_rng(7), []
    for _ in range(12):
        slow, white = 0.02 * random.normal(size=(2, 40_000)).cumsum(axis=1), random.normal(size=(2, 40_000))
        stamps = np.arange(40_000, dtype=np.int64) * 5 * SECOND
        found = torquer_lines([instrument_spectra(stamps, *(slow + [[0.02], [0.05]] * white))])
        far += (found["excess"] / found["excess_sigma"]).values.tolist()
    # A mean of so many, and their rms, by three of their sigmas.
    assert abs(np.mean(far)) < 3.0 / np.sqrt(len(far))
    assert np.sqrt(np.mean(np.square(far))) < 1.0 + 3.0 / np.sqrt(2.0 * len(far))


def test_readings_too_slow_for_the_band_are_refused():
    stamps, residual, *_ = make_day(hours=2)
    with pytest.raises(SamplesError, match="do not hold"):
        instrument_spectra(stamps[::10], residual[::10], residual[::10])
