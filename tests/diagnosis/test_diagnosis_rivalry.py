"""How sure gains are: textbook sums, blocks left out one by one, and gains of known truth."""

import numpy as np
import pytest
from scipy.stats import norm as normal
from scipy.stats import t as student

from inflight.lsq import expected_gain_t, hac_t


def bartlett_t(series):
    """Mean over its error by the textbook: sums of autocovariances with falling weights."""
    n, mean = len(series), np.mean(series)
    reach = max(1, int(4 * (n / 100) ** (2 / 9)))
    covariance = [np.sum((series[k:] - mean) * (series[: n - k] - mean)) / n for k in range(reach + 1)]
    long_run = covariance[0] + 2 * sum((1 - k / (reach + 1)) * covariance[k] for k in range(1, reach + 1))
    return mean / np.sqrt(max(long_run, covariance[0]) / (n - 1))


@pytest.mark.parametrize("memory", [0.0, 0.7, -0.4])
def test_the_t_of_a_series_knows_of_its_correlation(memory):
    g = np.random.default_rng(3)
    series = np.zeros((200, 4))
    for k in range(1, 200):
        series[k] = memory * series[k - 1] + g.normal(0.1, 1.0, 4)
    np.testing.assert_allclose(hac_t(series), [bartlett_t(one) for one in series.T], rtol=1e-10)


def test_blocks_that_tell_nothing_do_not_dilute_a_t():
    g = np.random.default_rng(4)
    series, used = np.zeros((60, 1)), np.zeros((60, 1), dtype=bool)
    used[20:35] = True
    series[used] = g.normal(1.0, 1.0, 15)
    inside = bartlett_of_part(series[20:35, 0], 60)
    assert hac_t(series, used)[0] == pytest.approx(inside, rel=1e-9)
    assert hac_t(series, used)[0] != pytest.approx(hac_t(series)[0], rel=1e-3)


def bartlett_of_part(series, blocks):
    n, mean = len(series), np.mean(series)
    reach = max(1, int(4 * (blocks / 100) ** (2 / 9)))
    sums = [np.sum((series[k:] - mean) * (series[: n - k] - mean)) for k in range(reach + 1)]
    whole = sums[0] + 2 * sum((1 - k / (reach + 1)) * sums[k] for k in range(1, reach + 1))
    return n * mean / np.sqrt(max(whole, sums[0]) * n / (n - 1))


def test_two_blocks_have_no_t():
    assert hac_t(np.array([[1.0], [2.0]]))[0] == 0.0


def promises(blocks, uneven):
    """Return what each block can tell: the same, or most of it in a few blocks."""
    return np.ones(blocks) if not uneven else 0.02 + 10.0 * (np.arange(blocks) % 17 == 3)


def gains(promised, amplitude, seeds, generator):
    """Gains held out, of an effect fitted elsewhere at about its size, in unit noise; (block, seed)."""
    fitted = amplitude + generator.normal(size=seeds) / np.sqrt(promised.sum())
    scores = promised[:, None] * amplitude + np.sqrt(promised)[:, None] * generator.normal(
        size=(len(promised), seeds)
    )
    expected = fitted**2 * promised[:, None]
    return 2.0 * fitted * scores - expected, expected


def test_each_block_is_held_against_what_the_others_make_of_its_promise():
    g = np.random.default_rng(5)
    promised = g.exponential(1.0, 30)
    gained = promised + g.normal(size=30)
    missed = []
    for b in range(30):
        others = np.arange(30) != b
        missed.append(gained[b] - promised[b] * gained[others].sum() / promised[others].sum())
    reach = max(1, int(4 * (30 / 100) ** (2 / 9)))
    products = [np.dot(missed[k:], missed[: 30 - k]) for k in range(reach + 1)]
    whole = products[0] + 2 * sum((1 - k / (reach + 1)) * products[k] for k in range(1, reach + 1))
    freedom = promised.sum() ** 2 / np.sum(promised**2) - 1
    few = 3.0 / student.isf(normal.sf(3.0), freedom)
    expected = few * gained.sum() / np.sqrt(max(whole, products[0]))
    used = np.ones((30, 1), dtype=bool)
    assert expected_gain_t(gained[:, None], promised[:, None], used)[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("blocks", [20, 60, 200])
def test_an_effect_that_is_not_there_hardly_ever_has_a_t_of_three(blocks, uneven):
    promised = promises(blocks, uneven)
    gained, expected = gains(promised, 0.0, 4000, np.random.default_rng(6))
    t = expected_gain_t(gained, expected, np.ones(gained.shape, dtype=bool))
    assert np.mean(t > 3.0) < 0.004


def test_a_gain_that_lies_where_it_is_foretold_is_no_scatter():
    promised = promises(100, uneven=True)
    gained, expected = gains(promised, 4.0, 200, np.random.default_rng(7))
    used = np.ones(gained.shape, dtype=bool)
    assert np.median(expected_gain_t(gained, expected, used)) > 3.0 * np.median(hac_t(gained, used))


def test_the_same_gain_where_it_is_not_foretold_is():
    promised = promises(100, uneven=True)
    gained, expected = gains(promised, 4.0, 200, np.random.default_rng(7))
    used = np.ones(gained.shape, dtype=bool)
    elsewhere = expected_gain_t(gained, np.roll(expected, 5, axis=0), used)
    assert np.median(elsewhere) < 3.0


def test_a_gain_of_one_block_has_no_others_that_bear_it_out():
    promised = np.where(np.arange(50) == 7, 1.0, 1e-9)[:, None]
    gained = np.where(np.arange(50) == 7, 5.0, 0.0)[:, None]
    assert expected_gain_t(gained, promised, np.ones(gained.shape, dtype=bool))[0] < 3.0
