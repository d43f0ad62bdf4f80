"""Least squares over clusters: recovered values, honest sigmas, clear refusals."""

import numpy as np
import pytest

from inflight.errors import CalibrationError
from inflight.lsq import grams_by_cluster, solve_clusters

TRUTH = np.array([1.5, -0.7])


def rows_of(seed, clusters=12, size=30, shared=0.5):
    """Rows whose noise has a part that a whole cluster shares."""
    random = np.random.default_rng(seed)
    cluster = np.repeat(np.arange(clusters), size)
    columns = random.standard_normal((cluster.size, 2)) + random.standard_normal((clusters, 2))[cluster]
    noise = random.standard_normal(cluster.size) + shared * random.standard_normal(clusters)[cluster]
    return columns, columns @ TRUTH + noise, cluster


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_one_sigma_covers_two_thirds_whether_or_not_a_cluster_shares_noise(shared):
    pulls = []
    for seed in range(300):
        columns, observed, cluster = rows_of(seed, shared=shared)
        fit = solve_clusters(*grams_by_cluster(columns, observed, np.ones_like(observed), cluster))
        pulls.append((fit.value - TRUTH) / fit.sigma)
    inside = np.mean(np.abs(pulls) < 1)
    assert 0.60 < inside < 0.76
    assert np.abs(np.mean(pulls, axis=0)).max() < 0.2


def test_rows_alone_would_promise_too_much_where_a_cluster_shares_noise():
    columns, observed, cluster = rows_of(0, shared=1.0)
    fit = solve_clusters(*grams_by_cluster(columns, observed, np.ones_like(observed), cluster))
    white = np.sqrt(fit.variance * np.diag(np.linalg.inv(columns.T @ columns)))
    assert (fit.sigma > 1.5 * white).all()


def test_a_column_without_data_stays_at_its_prior_and_says_so():
    columns, observed, cluster = rows_of(1)
    wide = np.column_stack([columns, np.zeros(len(columns))])
    gram, rows = grams_by_cluster(wide, observed, np.ones_like(observed), cluster)
    fit = solve_clusters(gram, rows, np.array([10.0, 10.0, 0.3]))
    assert fit.value[2] == 0.0
    assert fit.sigma[2] == pytest.approx(0.3)
    assert list(fit.determined) == [True, True, False]
    with pytest.raises(CalibrationError, match="column 2"):
        solve_clusters(gram, rows)


def test_too_few_clusters_and_dependent_columns_are_refused():
    columns, observed, cluster = rows_of(2, clusters=4)
    with pytest.raises(CalibrationError, match="4 clusters"):
        solve_clusters(*grams_by_cluster(columns, observed, np.ones_like(observed), cluster))
    columns, observed, cluster = rows_of(2)
    twice = np.column_stack([columns[:, 0], 2 * columns[:, 0]])
    with pytest.raises(CalibrationError, match="not independent"):
        solve_clusters(*grams_by_cluster(twice, observed, np.ones_like(observed), cluster))


def test_weights_count_as_inverse_variances():
    columns, observed, _ = rows_of(3)
    heavy = np.r_[np.full(100, 4.0), np.ones(len(observed) - 100)]
    one, first = np.zeros(len(observed), dtype=np.int64), slice(0, 100)
    weighted, _ = grams_by_cluster(columns, observed, heavy, one)
    plain, _ = grams_by_cluster(columns, observed, np.ones_like(observed), one)
    part, _ = grams_by_cluster(columns[first], observed[first], np.ones(100), one[first])
    assert weighted == pytest.approx(plain + 3 * part)
