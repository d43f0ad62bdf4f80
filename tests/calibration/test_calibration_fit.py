"""Nine parameters are recovered with honest uncertainties, and nothing is invented."""

import numpy as np
import pytest
from calibration_cases import IDEAL, PRIOR, PRIOR_SIGMA, TRUTH, ar1, matrix_of, measure, polar_orbit
from scipy.optimize import least_squares

from inflight.calibration import ParameterPrior, sub_block_count
from inflight.errors import CalibrationError

ORBIT = polar_orbit()
#: One realistic error of each parameter.
SIZES = np.array([1.3e-3] * 3 + [0.06] * 3 + [25.0] * 3)
NAMES = ["sx", "sy", "sz", "xy", "xz", "yz", "ox", "oy", "oz"]


def pulls(seeds: int, make_noise, **options) -> np.ndarray:
    rows = []
    for seed in range(seeds):
        noise = make_noise(np.random.default_rng(seed))
        fit = measure(ORBIT, TRUTH, noise).fit(**options)
        rows.append((fit.value - TRUTH) / fit.sigma)
    return np.array(rows)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("index", range(9), ids=NAMES)
def test_each_parameter_is_recovered_with_its_sign(index, sign):
    truth = IDEAL.copy()
    truth[index] += sign * SIZES[index]
    noise = np.random.default_rng(index).normal(0, 0.1, len(ORBIT))
    fit = measure(ORBIT, truth, noise).fit()
    assert np.all(np.abs(fit.value - truth) < 4.5 * fit.sigma)
    assert abs(truth[index] - IDEAL[index]) > 50 * fit.sigma[index], "the injected error is clearly seen"
    assert fit.solution.determined.all()


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_all_parameters_together_are_recovered_without_noise(sign):
    truth = IDEAL + sign * (TRUTH - IDEAL)
    fit = measure(ORBIT, truth).fit()
    assert np.allclose(fit.value[:3], truth[:3], rtol=0, atol=1e-8)
    assert np.allclose(fit.value[3:6], truth[3:6], rtol=0, atol=1e-6)
    assert np.allclose(fit.value[6:], truth[6:], rtol=0, atol=1e-4)


def test_the_fit_is_the_exact_least_squares_of_an_independent_solver():
    noise = np.random.default_rng(3).normal(0, 0.1, len(ORBIT))
    m = measure(ORBIT, TRUTH, noise)
    scale = np.array([1e-5] * 3 + [1e-3] * 3 + [1.0] * 3)

    def residual(x):
        value = IDEAL + x * scale
        return np.linalg.norm((m.reading - value[6:]) @ matrix_of(value).T, axis=1) - m.scalar

    found = least_squares(residual, np.zeros(9), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    exact = IDEAL + found.x * scale
    fit = m.fit()
    # The robust weights keep 98.8 % of the information: the two differ by a tenth of a sigma.
    assert np.all(np.abs(fit.value - exact) < 0.35 * fit.sigma)


def test_stated_sigmas_cover_the_truth_for_white_noise():
    """Pull standard deviations 0.92 to 1.07 over 200 seeds; each is known to 5 %."""
    found = pulls(200, lambda g: g.normal(0, 0.2, len(ORBIT)))
    assert np.all(found.std(axis=0) < 1.2), found.std(axis=0)
    assert np.all(found.std(axis=0) > 0.8), found.std(axis=0)
    assert np.all(np.abs(found.mean(axis=0)) < 0.3), "no bias that the sigma hides"


@pytest.mark.parametrize(("memory_s", "worst"), [(120.0, 1.3), (300.0, 1.35), (900.0, 1.45)])
def test_stated_sigmas_cover_the_truth_for_noise_correlated_over_minutes(memory_s, worst):
    """Pull standard deviations up to 1.14 (2 min), 1.17 (5 min), 1.26 (15 min): slightly short, not wrong.

    Sigmas for white noise would be short by 2.8, 4.2 and 6.5 times.
    """

    def noise(g):
        return ar1(g, len(ORBIT), 0.2, memory_s / 20.0) + g.normal(0, 0.05, len(ORBIT))

    found = pulls(200, noise)
    assert np.all(found.std(axis=0) < worst), found.std(axis=0)
    assert np.all(found.std(axis=0) > 0.75), found.std(axis=0)


@pytest.mark.parametrize("parts", [1, 2, 5, 12])
def test_few_sub_blocks_make_no_overconfident_sigma(parts):
    found = pulls(60, lambda g: g.normal(0, 0.2, len(ORBIT)), sub_blocks=parts)
    assert np.all(found.std(axis=0) < 1.4), found.std(axis=0)


def test_the_residual_is_told_as_large_as_it_is_however_far_the_prior_is():
    noise = np.random.default_rng(0).normal(0, 0.2, len(ORBIT))
    near = ParameterPrior(TRUTH, PRIOR_SIGMA)
    m = measure(ORBIT, TRUTH, noise)
    far, close = m.fit(), m.fit(near)
    assert far.after == pytest.approx(close.after, rel=1e-4)
    assert far.after == pytest.approx(noise.std(), rel=0.08), "the weights take a few percent off"


@pytest.mark.parametrize("seed", range(4))
def test_gross_outliers_do_not_move_the_offsets(seed):
    """A sample in a thousand is 50 nT off, always to the same side."""
    g = np.random.default_rng(seed)
    noise = g.normal(0, 0.1, 43_200)
    field = polar_orbit(43_200, 2.0)
    clean = measure(field, TRUTH, noise).fit()
    spoiled = noise.copy()
    spoiled[g.choice(noise.size, 43, replace=False)] += 50.0
    fit = measure(field, TRUTH, spoiled).fit()
    assert np.abs(fit.value[6:] - clean.value[6:]).max() < 0.005
    assert np.abs(fit.value[:3] - clean.value[:3]).max() < 0.05e-6 * 10


def test_samples_that_are_not_good_have_no_say():
    g = np.random.default_rng(1)
    m = measure(ORBIT, TRUTH, g.normal(0, 0.1, len(ORBIT)))
    good = g.random(len(ORBIT)) > 0.3
    spoiled = m.__class__(np.where(good[:, None], m.reading, np.nan), np.where(good, m.scalar, np.nan))
    clean = m.__class__(m.reading[good], m.scalar[good])
    one, other = spoiled.fit(good=good), clean.fit()
    assert np.allclose(one.value, other.value, rtol=0, atol=1e-3 * one.sigma.min() + 1e-12 + 0.02 * one.sigma)
    assert one.used == other.used == good.sum()


def test_too_few_samples_are_an_error_not_a_number():
    m = measure(ORBIT[:200], TRUTH)
    good = np.zeros(200, dtype=bool)
    good[:8] = True
    with pytest.raises(CalibrationError, match="8 usable samples"):
        m.fit(good=good)


@pytest.mark.parametrize("minutes", [15, 30, 60, 120])
@pytest.mark.parametrize("memory_s", [0.0, 60.0, 300.0])
def test_a_short_day_settles_and_claims_no_more_than_it_knows(minutes, memory_s):
    """Part of an orbit determines some combinations; a parameter called determined must be right."""
    field = polar_orbit(minutes * 60, 1.0)
    for seed in range(12):
        g = np.random.default_rng(seed)
        noise = ar1(g, len(field), 0.2, memory_s) if memory_s else g.normal(0, 0.2, len(field))
        fit = measure(field, TRUTH, noise).fit(sub_blocks=sub_block_count(minutes * 60))
        claimed = fit.solution.determined
        assert np.all(np.abs(fit.value - TRUTH)[claimed] < 6 * fit.sigma[claimed])
        assert np.all(np.abs(fit.value - TRUTH) < 4 * np.hypot(fit.sigma, PRIOR_SIGMA))


def degenerate(kind: str, count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Fields that tell less than nine parameters, and which parameters they can never tell."""
    turn = np.linspace(0, 40, count)
    strength = 40_000 + 3_000 * np.sin(turn)
    one = np.array([0.48, 0.36, 0.8])
    if kind == "one direction":
        return strength[:, None] * one, np.ones(9, dtype=bool)
    if kind == "one attitude":
        return np.full((count, 3), 40_000.0 * one), np.ones(9, dtype=bool)
    if kind == "two opposite directions":
        return strength[:, None] * one * np.where(np.arange(count) % 2, 1, -1)[:, None], np.ones(
            9, dtype=bool
        )
    if kind == "only in the x, y plane":
        plane = np.stack([np.cos(3 * turn), np.sin(3 * turn), 0 * turn], axis=1)
        return strength[:, None] * plane, np.array([0, 0, 1, 0, 1, 1, 0, 0, 1], dtype=bool)
    directions = np.stack([np.cos(3 * turn), 0 * turn, np.sin(3 * turn)], axis=1)
    return strength[:, None] * directions, np.array([0, 1, 0, 1, 0, 1, 0, 1, 0], dtype=bool)


DEGENERATE = [
    "one direction",
    "one attitude",
    "two opposite directions",
    "only in the x, y plane",
    "x, z plane",
]


@pytest.mark.parametrize("noise_nT", [0.0, 1e-6, 0.01, 0.3])
@pytest.mark.parametrize("kind", DEGENERATE)
def test_what_the_field_cannot_tell_is_never_called_determined(kind, noise_nT):
    field, blind = degenerate(kind)
    truth = IDEAL if noise_nT < 0.01 else IDEAL + 0.02 * (TRUTH - IDEAL)
    noise = np.random.default_rng(5).normal(0, 1, len(field)) * noise_nT
    fit = measure(field, truth, noise).fit()
    assert not fit.solution.determined[blind].any()
    assert len(fit.solution.directions) <= 9 - (3 if not blind.all() else 6)


@pytest.mark.parametrize("kind", DEGENERATE[3:])
def test_what_a_field_in_a_plane_cannot_tell_stays_at_its_prior(kind):
    """The normal component is zero but for the offset, which shows in no first order."""
    field, blind = degenerate(kind)
    noise = np.random.default_rng(5).normal(0, 0.1, len(field))
    fit = measure(field, IDEAL, noise).fit()
    assert np.all(np.abs(fit.value - IDEAL)[blind] <= 1e-3 * PRIOR_SIGMA[blind])
    assert np.all(fit.sigma[blind] > 0.9 * PRIOR_SIGMA[blind]), "and is as uncertain as before"
    assert np.all(np.abs(fit.value - IDEAL)[~blind] < 5 * fit.sigma[~blind])


@pytest.mark.parametrize("kind", DEGENERATE[:3])
def test_the_sum_of_undetermined_parameters_still_lowers_the_residual(kind):
    field, _ = degenerate(kind)
    noise = np.random.default_rng(5).normal(0, 0.1, len(field))
    fit = measure(field, IDEAL + 0.02 * (TRUTH - IDEAL), noise).fit()
    assert fit.before > 3 * fit.after
    assert fit.after < 0.12
    assert np.all(np.abs(fit.value - IDEAL) < PRIOR_SIGMA)


@pytest.mark.parametrize("fixed", [[6], [3, 4, 5], [0, 1, 2, 6, 7, 8]])
def test_a_prior_sigma_of_zero_fixes_a_parameter_exactly(fixed):
    sigma = PRIOR_SIGMA.copy()
    sigma[fixed] = 0.0
    start = TRUTH.copy()
    free = np.setdiff1d(np.arange(9), fixed)
    start[free] = IDEAL[free]
    noise = np.random.default_rng(2).normal(0, 0.1, len(ORBIT))
    fit = measure(ORBIT, TRUTH, noise).fit(ParameterPrior(start, sigma))
    assert np.array_equal(fit.value[fixed], TRUTH[fixed])
    assert np.all(fit.sigma[fixed] == 0.0)
    assert not fit.solution.determined[fixed].any()
    assert np.all(np.abs(fit.value - TRUTH)[free] < 4.5 * fit.sigma[free])


def test_all_parameters_fixed_is_no_fit_and_no_error():
    fit = measure(ORBIT, TRUTH, 0.1).fit(ParameterPrior(TRUTH, np.zeros(9)))
    assert np.array_equal(fit.value, TRUTH)
    assert fit.before == pytest.approx(0.1, rel=1e-6)


def test_a_tight_prior_holds_a_parameter_that_the_data_tell_worse():
    sigma = PRIOR_SIGMA.copy()
    sigma[8] = 1e-4
    near = TRUTH.copy()
    near[8] += 1e-4
    noise = np.random.default_rng(2).normal(0, 0.2, len(ORBIT))
    fit = measure(ORBIT, TRUTH, noise).fit(ParameterPrior(near, sigma))
    assert abs(fit.value[8] - near[8]) < 1e-4
    assert not fit.solution.determined[8]


def test_additive_fields_are_taken_out_behind_the_sensor():
    """B = K (E - E0) - S: a stray field of the spacecraft, known from a current."""
    from inflight.calibration import fit_block

    g = np.random.default_rng(9)
    stray = g.normal(0, 3.0, (len(ORBIT), 1)) * np.array([1.0, -2.0, 0.5])
    m = measure(ORBIT + stray, TRUTH)
    scalar = np.linalg.norm(ORBIT, axis=1) + g.normal(0, 0.1, len(ORBIT))
    good = np.ones(len(ORBIT), dtype=bool)
    fit = fit_block(m.reading, stray, scalar, good, PRIOR)
    assert np.all(np.abs(fit.value - TRUTH) < 4.5 * fit.sigma)
    wrong = fit_block(m.reading, -stray, scalar, good, PRIOR)
    assert wrong.after > 5 * fit.after, "the other sign is not as good"
