"""Spin fits: the numbers of least squares, whatever the sampling, without the say of wild readings."""

import numpy as np
import pytest
from farrell_cases import READINGS, TURN, natural, phase_of, stamps_of
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.errors import CalibrationError, SamplesError
from inflight.spin import fit_spins, respin


def by_lstsq(field, phase, spins=1, harmonics=1):
    """The loop people write: one lstsq a fit and component, over its finite readings."""
    turn = np.floor(phase / (TURN * spins))
    out = []
    for number in np.unique(turn[np.isfinite(turn)]):
        row = []
        for reading in field.T:
            own = (turn == number) & np.isfinite(reading)
            shapes = [np.ones(own.sum())]
            shapes += [f(h * phase[own]) for h in range(1, harmonics + 1) for f in (np.sin, np.cos)]
            row.append(np.linalg.lstsq(np.stack(shapes, axis=1), reading[own], rcond=None)[0])
        out.append(row)
    return np.array(out)


def steady(spins=50, seed=0, noise=0.1):
    rng = np.random.default_rng(seed)
    phase = phase_of(spins * READINGS)
    field = respin(np.tile([30.0, -40.0, 12.0], (phase.size, 1)), phase)
    return stamps_of(phase.size), field + noise * rng.standard_normal(field.shape), phase, rng


@pytest.mark.parametrize("spins", [1, 3])
@pytest.mark.parametrize("harmonics", [1, 2])
def test_uneven_readings_with_gaps_give_the_numbers_of_lstsq(spins, harmonics):
    rng = np.random.default_rng(2)
    phase = np.sort(rng.uniform(0.0, 60 * TURN, 60 * 20))
    field = 1e4 + 50.0 * rng.standard_normal((phase.size, 3))
    field[rng.random(field.shape) < 0.1] = np.nan
    phase[100:110] = np.nan
    kept = np.isfinite(phase)
    fits = fit_spins(stamps_of(phase.size), field, phase, spins=spins, harmonics=harmonics, robust=False)
    expected = by_lstsq(field[kept], phase[kept], spins, harmonics)
    # Per fit: relative to the size of the field.
    assert np.abs(fits.value - expected)[fits.determined].max() < 1e-10 * 1e4
    assert fits.determined.mean() > 0.95


def test_covariance_and_residual_are_those_of_lstsq():
    stamps, field, phase, _ = steady()
    fits = fit_spins(stamps, field, phase, robust=False)
    own = slice(7 * READINGS, 8 * READINGS)
    shapes = np.stack([np.ones(READINGS), np.sin(phase[own]), np.cos(phase[own])], axis=1)
    left = field[own, 1] - shapes @ np.linalg.lstsq(shapes, field[own, 1], rcond=None)[0]
    variance = left @ left / (READINGS - 3)
    assert fits.rms[7, 1] == pytest.approx(np.sqrt(variance), rel=1e-9)
    np.testing.assert_allclose(
        fits.covariance[7, 1], variance * np.linalg.inv(shapes.T @ shapes), rtol=1e-9, atol=1e-15
    )


@settings(max_examples=30, deadline=None)
@given(
    values=st.lists(st.floats(-1e5, 1e5), min_size=3, max_size=3),
    start=st.floats(-50.0, 50.0),
    seed=st.integers(0, 99),
)
def test_a_field_of_three_coefficients_comes_back_exactly(values, start, seed):
    rng = np.random.default_rng(seed)
    phase = np.sort(start + rng.uniform(0.0, 6 * TURN, 120))
    field = values[0] + values[1] * np.sin(phase) + values[2] * np.cos(phase)
    fits = fit_spins(stamps_of(phase.size), field[:, None], phase)
    found = fits.value[fits.determined[:, 0], 0]
    assert np.abs(found - values).max() <= 1e-9 * max(np.abs(values).max(), 1e-3)


def test_stated_sigmas_cover_white_noise():
    stamps, field, phase, _ = steady(spins=2000)
    fits = fit_spins(stamps, field, phase)
    pull = (fits.value[:, 2] - [12.0, 0.0, 0.0]) / fits.sigma[:, 2]
    # Nine degrees of freedom: Student's distribution has 66 % within one sigma.
    assert 0.60 < np.mean(np.abs(pull) < 1) < 0.76


def test_wild_readings_are_left_out_and_counted():
    stamps, field, phase, rng = steady(spins=500)
    clean = fit_spins(stamps, field, phase)
    spoilt = field.copy()
    hit = rng.random(field.shape) < 0.03
    spoilt[hit] += rng.choice([-1.0, 1.0], hit.sum()) * rng.uniform(5.0, 500.0, hit.sum())
    plain = fit_spins(stamps, spoilt, phase, robust=False)
    robust = fit_spins(stamps, spoilt, phase)
    assert np.std(plain.value - clean.value) > 5.0
    assert np.median(np.abs(robust.value - clean.value)) < 0.5 * np.median(clean.sigma)
    assert np.abs(robust.value - clean.value)[~robust.changing].max() < 0.5
    assert robust.outliers.sum() == pytest.approx(hit.sum(), rel=0.05)
    pull = (robust.value[:, 2, 0] - 12.0) / robust.sigma[:, 2, 0]
    assert 0.60 < np.mean(np.abs(pull) < 1) < 0.76


def test_one_missing_reading_touches_one_fit_of_one_component():
    stamps, field, phase, _ = steady()
    whole = fit_spins(stamps, field, phase)
    field[125, 1] = np.nan
    one = fit_spins(stamps, field, phase)
    same = np.isclose(one.value, whole.value, rtol=0, atol=0).all(axis=2)
    assert np.argwhere(~same).tolist() == [[10, 1]]
    assert one.count[10].tolist() == [READINGS, READINGS - 1, READINGS]


def test_a_jump_of_the_field_is_no_outlier():
    stamps, field, phase, _ = steady()
    field[246:] += 20.0
    fits = fit_spins(stamps, field, phase)
    assert fits.changing[20].all()
    assert not fits.changing[np.arange(50) != 20].any()
    assert fits.outliers[20].sum() == 0
    assert (fits.rms[20] > 20 * np.median(fits.rms)).all()


def test_natural_fluctuations_are_not_called_outliers():
    rng = np.random.default_rng(5)
    phase = phase_of(800 * READINGS)
    field = respin(natural(rng, phase.size, [5.0, 2.0, 3.0]), phase)
    fits = fit_spins(stamps_of(phase.size), field, phase)
    assert fits.outliers.sum() < 0.003 * field.size


def test_too_few_readings_or_too_small_an_arc_give_no_fit():
    stamps, field, phase, _ = steady()
    few = np.ones(phase.size, dtype=bool)
    few[3 * READINGS + 3 : 4 * READINGS] = False
    few[6 * READINGS + 4 : 7 * READINGS] = False
    fits = fit_spins(stamps, field, phase, good=few)
    assert np.flatnonzero(~fits.determined[:, 0]).tolist() == [3, 6]
    assert np.isnan(fits.covariance[3]).all()
    with pytest.raises(CalibrationError, match="spread over the turn"):
        fit_spins(stamps[::12], field[::12], phase[::12])


def test_a_fourier_transform_gives_the_fit_for_whole_spins_only():
    stamps, field, phase, _ = steady(noise=0.0)
    field[:, 0] += 3.0
    whole = fit_spins(stamps, field, phase, spins=5)
    tone = 2.0 * np.mean(field[: 5 * READINGS, 0] * np.exp(-1j * phase[: 5 * READINGS]))
    assert whole.phasor[0, 0] == pytest.approx(tone, abs=1e-9)
    broken = field[: 5 * READINGS + 5, 0], phase[: 5 * READINGS + 5]
    assert abs(2.0 * np.mean(broken[0] * np.exp(-1j * broken[1])) - tone) > 0.1


def test_phases_that_fall_or_are_missing_are_refused():
    stamps, field, phase, _ = steady()
    with pytest.raises(SamplesError, match="falls"):
        fit_spins(stamps, field, -phase)
    with pytest.raises(CalibrationError, match="none of 600 samples has a phase"):
        fit_spins(stamps, field, np.full_like(phase, np.nan))
    with pytest.raises(SamplesError, match="shape"):
        fit_spins(stamps[:-1], field, phase)


def test_the_summary_counts_the_fits_and_the_second_tone_has_a_phasor():
    stamps, field, phase, _ = steady()
    fits = fit_spins(stamps, field, phase, harmonics=2)
    assert fits.covariance.shape == (50, 3, 5, 5)
    assert "50 fits of 1 spin, 50 of them whole" in fits.summary()
    assert fits.double.shape == (50, 3)
