"""Significance by flipped signs: honest where neighbouring rows of a block depend on each other."""

import numpy as np
import pytest
from row_cases import DAY_NS
from scipy import stats
from scipy.signal import lfilter

from inflight.diagnosis import ModelColumns, draw_signs, family_wise_p, sign_flip_ratios
from inflight.lsq import GramArrays

BLOCKS, ROWS, DRAWS, NULLS = 40, 50, 400, 400
CANDIDATES = ("z0", "z1", "z2"), ("z3",), ("z4",), ("z5", "z6"), ("z7",), ("z8",), ("z9", "z10", "z11")


def smooth(g, *shape):
    """Return first-order processes along the rows (second axis) that remember twenty rows."""
    return lfilter([np.sqrt(1 - 0.95**2)], [1.0, -0.95], g.normal(size=shape), axis=1)


def null_evidence(effect=0.0, seed=0):
    """Slow columns, and residuals that are slow noise in each block: nothing follows from anything."""
    g = np.random.default_rng(seed)
    columns = smooth(g, BLOCKS, ROWS, 14)
    y = smooth(g, BLOCKS, ROWS, NULLS) + 0.3 * g.normal(size=(BLOCKS, ROWS, NULLS))
    y = y + columns[:, :, 12:] @ [[1.0], [-0.5]] + effect * columns[:, :, 3:4]
    values = np.concatenate([columns, y], axis=2)
    names = (*(f"z{k}" for k in range(12)), "p0", "p1", *(f"residual~{k}" for k in range(NULLS)))
    start = DAY_NS * np.arange(BLOCKS, dtype=np.int64)
    gram = np.einsum("bri,brj->bij", values, values, optimize=True)
    return GramArrays(names, gram, start, start + DAY_NS, np.full(BLOCKS, float(ROWS)), np.ones(len(names)))


def p_values(evidence, candidates, most=NULLS):
    """Return p-values, family-wise over the candidates; (residual, candidate)."""
    present = ModelColumns(evidence.index(("p0", "p1")), np.zeros(2))
    columns = [evidence.index(one) for one in candidates]
    signs, units = draw_signs(BLOCKS, DRAWS, 0)
    found = [sign_flip_ratios(evidence, present, columns, y, signs, units) for y in evidence.residuals[:most]]
    return np.array([family_wise_p(*one) for one in found])


@pytest.fixture(scope="module")
def nulls():
    return null_evidence()


@pytest.mark.parametrize("candidate", [CANDIDATES[0], CANDIDATES[1]])
def test_p_values_of_noise_are_uniform(nulls, candidate):
    p = p_values(nulls, [candidate])[:, 0]
    assert stats.kstest(p, "uniform").statistic < 0.1
    assert abs(np.mean(p < 0.05) - 0.05) < 3 * np.sqrt(0.05 * 0.95 / NULLS)


def test_a_test_that_takes_rows_as_independent_would_be_wrong_here(nulls):
    """The reason for flips: the plain F-test finds something in most of the noise."""
    z = nulls.index(["z3"])[0]
    total = nulls.total
    f = [total[z, y] ** 2 / total[z, z] / (total[y, y] / (BLOCKS * ROWS)) for y in nulls.residuals]
    assert np.mean(stats.chi2.sf(f, 1) < 0.05) > 0.4


def test_of_many_candidates_hardly_ever_one_stands_out_of_noise(nulls):
    wrong = (p_values(nulls, CANDIDATES) < 0.05).any(axis=1)
    assert wrong.mean() <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / NULLS)
    # Nor is the test asleep.
    assert wrong.mean() > 0.01


def test_a_real_effect_is_found_and_named():
    p = p_values(null_evidence(effect=0.8), CANDIDATES, 100)
    assert np.mean(p[:, 1] < 0.05) > 0.9
    assert np.mean(np.delete(p, 1, axis=1) < 0.05) < 0.1


def test_a_p_value_counts_the_flips_whose_largest_ratio_is_as_large():
    flipped = np.array([[1.0, 0.5], [0.2, 3.0], [0.1, 0.4], [2.0, 1.9]])
    np.testing.assert_allclose(family_wise_p(np.array([2.5, 0.0, 9.0]), flipped), [2 / 5, 1.0, 1 / 5])


def test_no_more_units_are_flipped_than_blocks_and_neighbours_flip_together():
    signs, units = draw_signs(500, 7, 3)
    assert signs.shape == (7, len(units))
    assert set(np.unique(signs)) == {-1.0, 1.0}
    assert np.concatenate(units).tolist() == list(range(500))
    assert len(draw_signs(9, 7, 3)[1]) == 9
