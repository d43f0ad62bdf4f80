"""The one solver and the one of each covariance, held against statsmodels and closed forms."""

import numpy as np
import pytest
import statsmodels.api as sm

from inflight.lsq import (
    GramArrays,
    GramBlocks,
    bartlett_covariance,
    bartlett_variance,
    correlated_covariance,
    gram_inverse,
    grams_by_cluster,
    inverse_square_root,
    jackknife,
    jackknife_covariance,
    long_run_covariance,
    marginalise,
    posterior,
    posterior_covariance,
    regression_coefficients,
    residual_sum,
    sandwich,
    solve,
    solve_clusters,
    solve_scaled,
    with_variance_floor,
)

ROWS, LAGS = 400, 5

#: Columns differ by as much as scale factors, angles and offsets do.
SIZE = np.array([1e-5, 1.0, 3e4])


def autoregressive(random, rows, phi):
    """Noise whose neighbours are correlated by `phi`, of unit variance."""
    noise = random.standard_normal(rows)
    for row in range(1, rows):
        noise[row] = phi * noise[row - 1] + np.sqrt(1 - phi**2) * noise[row]
    return noise


@pytest.fixture(name="fitted", params=range(3))
def fitted_by_statsmodels(request):
    """Correlated columns and noise, and their ordinary least squares."""
    random = np.random.default_rng(request.param)
    x = np.stack([autoregressive(random, ROWS, 0.9) for _ in SIZE], axis=1) * SIZE
    y = x @ (np.array([2.0, -1.0, 0.5]) / SIZE) + autoregressive(random, ROWS, 0.7)
    return x, y, sm.OLS(y, x)


def bread_and_scores(x, y):
    gram = x.T @ x
    value = solve_scaled(gram, x.T @ y)
    return value, gram_inverse(gram), x * (y - x @ value)[:, None]


def test_values_are_those_of_ordinary_least_squares(fitted):
    x, y, model = fitted
    value, _, _ = bread_and_scores(x, y)
    np.testing.assert_allclose(value, model.fit().params, rtol=1e-10)


def test_the_hac_covariance_is_newey_and_wests(fitted):
    x, y, model = fitted
    _, bread, scores = bread_and_scores(x, y)
    options = {"maxlags": LAGS, "use_correction": False}
    expected = model.fit(cov_type="HAC", cov_kwds=options).cov_params()
    found = sandwich(bread, bartlett_covariance(scores, LAGS))
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    alone = bartlett_variance(scores, LAGS)
    np.testing.assert_allclose(alone, np.diag(bartlett_covariance(scores, LAGS)), rtol=1e-12)


def test_the_sandwich_of_blocks_is_the_clustered_one(fitted):
    x, y, model = fitted
    value, bread, _ = bread_and_scores(x, y)
    day = np.repeat(np.arange(40), ROWS // 40)
    grams, _ = grams_by_cluster(x, -y, np.ones(ROWS), day)
    blocks = GramArrays(
        ("a", "b", "c", "residual"), grams, day[::10], day[::10] + 1, np.full(40, 10.0), np.ones(4)
    )
    scores = blocks.scores(value)
    expected = model.fit(cov_type="cluster", cov_kwds={"groups": day, "use_correction": False}).cov_params()
    np.testing.assert_allclose(sandwich(bread, scores.T @ scores), expected, rtol=1e-7)


def test_the_jackknife_over_rows_is_hc3(fitted):
    x, y, model = fitted
    value, _, _ = bread_and_scores(x, y)
    without = np.array(
        [solve_scaled(x[kept].T @ x[kept], x[kept].T @ y[kept]) for kept in ~np.eye(ROWS, dtype=bool)]
    )
    expected = (ROWS - 1) / ROWS * model.fit(cov_type="HC3").cov_params()
    found = jackknife_covariance(without, about=value)
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_allclose(jackknife(without) ** 2, np.diag(jackknife_covariance(without)), rtol=1e-9)


def test_a_fit_of_clusters_of_one_row_is_hc3_widened_as_student_says(fitted):
    x, y, model = fitted
    fit = solve_clusters(*grams_by_cluster(x, y, np.ones(ROWS), np.arange(ROWS)))
    student = (fit.sigma[0] / np.sqrt((ROWS - 1) / ROWS * model.fit(cov_type="HC3").cov_params()[0, 0])) ** 2
    np.testing.assert_allclose(fit.value, model.fit().params, rtol=1e-9)
    assert 1.0 < student < 1.01
    assert fit.variance == pytest.approx(model.fit().scale, rel=1e-9)


def test_the_long_run_variance_is_that_of_the_process():
    """Of a first-order autoregression it is (1 + phi) / (1 - phi) times the variance, a row."""
    for phi in (0.0, 0.5, 0.8):
        found = [
            long_run_covariance(autoregressive(np.random.default_rng(seed), 2000, phi)[:, None])[0, 0] / 2000
            for seed in range(40)
        ]
        assert np.mean(found) == pytest.approx((1 + phi) / (1 - phi), rel=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_a_prior_is_more_rows(seed):
    random = np.random.default_rng(seed)
    x, y = random.standard_normal((60, 3)) * SIZE, random.standard_normal(60)
    sigma, variance = np.array([0.1, 1.0, 0.3]) / SIZE, 0.7
    rows = np.concatenate([x, np.diag(np.sqrt(variance) / sigma)])
    expected = np.linalg.lstsq(rows / np.tile(SIZE, (63, 1)), np.append(y, np.zeros(3)))[0] / SIZE
    found = solve_scaled(x.T @ x, x.T @ y, precision=variance / sigma**2)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    quick = solve_scaled(x.T @ x, x.T @ y, cut=0.0, precision=variance / sigma**2)
    np.testing.assert_allclose(quick, expected, rtol=1e-9)
    scaled = np.linalg.inv((rows / SIZE).T @ (rows / SIZE)) / np.outer(SIZE, SIZE)
    covariance = posterior_covariance(x.T @ x, sigma, variance)
    np.testing.assert_allclose(covariance, variance * scaled, rtol=1e-9)


def test_an_infinite_precision_fixes_and_a_matrix_of_right_sides_is_solved_at_once():
    random = np.random.default_rng(4)
    x, right = random.standard_normal((5, 40, 3)), random.standard_normal((5, 40, 2))
    gram, cross = x.swapaxes(1, 2) @ x, x.swapaxes(1, 2) @ right
    found = solve_scaled(gram, cross, precision=np.array([0.0, np.inf, 0.0]))
    for block in range(5):
        expected = np.linalg.lstsq(x[block][:, [0, 2]], right[block])[0]
        np.testing.assert_allclose(found[block][[0, 2]], expected, rtol=1e-9)
    np.testing.assert_array_equal(found[:, 1], 0.0)
    covariance = posterior_covariance(gram[0], np.array([1.0, 0.0, np.inf]))
    np.testing.assert_array_equal(covariance[1], 0.0)


def test_what_columns_that_repeat_each_other_determine_is_solved_and_nothing_else():
    random = np.random.default_rng(5)
    one, other, y = random.standard_normal((3, 50))
    x = np.stack([one, 2.0 * one, other], axis=1)
    value = solve_scaled(x.T @ x, x.T @ y)
    np.testing.assert_allclose(x @ value, x @ np.linalg.lstsq(x, y)[0], atol=1e-9)
    # In units of their size both carry the same.
    assert value[0] == pytest.approx(2.0 * value[1], rel=1e-6)


def test_marginalising_is_the_gram_matrix_of_what_a_fit_leaves():
    random = np.random.default_rng(6)
    x, z = random.standard_normal((4, 80, 2)), random.standard_normal((4, 80, 3))
    z[:, :, 0] += x[:, :, 1]
    rows = np.concatenate([x, z], axis=2)
    gram = rows.swapaxes(1, 2) @ rows
    first, last = np.arange(2), np.arange(2, 5)
    for block in range(4):
        rest = np.stack([sm.OLS(one, x[block]).fit().resid for one in z[block].T], axis=1)
        params = np.stack([sm.OLS(one, x[block]).fit().params for one in z[block].T], axis=1)
        np.testing.assert_allclose(marginalise(gram, first, last)[block], rest.T @ rest, atol=1e-9)
        np.testing.assert_allclose(regression_coefficients(gram, first, last)[block], params, atol=1e-9)
    day = np.arange(4)
    blocks: GramBlocks = GramArrays(
        ("a", "b", "c", "d", "residual"), gram, day, day + 1, np.full(4, 80.0), np.ones(5)
    )
    left = blocks.marginalise(["a", "b"])
    np.testing.assert_allclose(left.rows(left.names), marginalise(gram, first, last), atol=1e-9)


def test_the_root_of_an_inverse_is_one():
    random = np.random.default_rng(7)
    x = random.standard_normal((6, 30, 3)) * SIZE
    gram = x.swapaxes(1, 2) @ x
    root = inverse_square_root(gram)
    unit = (root @ root.swapaxes(1, 2)) @ gram
    np.testing.assert_allclose(
        unit * (1 / SIZE)[None] * SIZE[:, None], np.tile(np.eye(3), (6, 1, 1)), atol=1e-9
    )


def test_a_posterior_is_the_prior_and_the_data_by_their_weight():
    random = np.random.default_rng(8)
    x = random.standard_normal((500, 3))
    y = x @ np.array([0.3, -0.2, 0.1]) + 0.5 * random.standard_normal(500)
    rows, sigma = np.column_stack([x, y]), np.array([0.05, 0.02, 10.0])
    gram, mean = rows.T @ rows, np.array([-0.27, 0.19, 0.0])
    value, covariance, _ = posterior(gram, 500.0, mean, sigma)
    whole = solve(gram, gram[:3, :3] * residual_sum(gram, value) / 497.0, 500.0, mean, sigma, least=0.0)
    for found in (value, whole.value):
        variance = residual_sum(gram, found) / 497.0
        information = x.T @ x / variance + np.diag(sigma**-2)
        expected = np.linalg.solve(information, -x.T @ y / variance + mean / sigma**2)
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.sqrt(np.diag(covariance)).min())
        np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=0.01, atol=1e-7)
    np.testing.assert_allclose(whole.covariance, covariance, rtol=0.01, atol=1e-7)


def test_a_covariance_of_correlated_blocks_with_a_prior_covers_both():
    random = np.random.default_rng(9)
    x = random.standard_normal((3000, 2))
    y = random.standard_normal(3000)
    value = solve_scaled(x.T @ x, x.T @ y)
    scores = x * (y - x @ value)[:, None]
    found = correlated_covariance(scores, x.T @ x, np.array([np.inf, 0.01]))
    white = posterior_covariance(x.T @ x, np.array([np.inf, 0.01]))
    np.testing.assert_allclose(np.diag(found), np.diag(white), rtol=0.2)
    assert np.all(np.diag(found) >= np.diag(white) * (1 - 1e-12))


def test_a_covariance_is_raised_to_another_one_and_keeps_its_correlations():
    raised = with_variance_floor(np.array([[1.0, 0.5], [0.5, 4.0]]), np.diag([4.0, 1.0]))
    np.testing.assert_allclose(raised, [[4.0, 1.0], [1.0, 4.0]])
