"""Scores of candidates against refits and predictions of the rows themselves."""

import numpy as np
import pytest
from row_cases import row_case

from benchmarks.null_cases import score_many
from inflight.diagnosis import ModelColumns, active_blocks, make_folds, score
from inflight.diagnosis.scoring import block_scores, fit
from inflight.lsq import expected_gain_t, inverse_square_root

PRESENTS = {
    "nothing": ((), ()),
    "a model": (("p0", "p1"), (0.0, 0.0)),
    "a model known beforehand": (("p0", "p1"), (300.0, 4e4)),
}
CANDIDATES = (("z0", "z1", "z2"), ("z3",), ("z3", "z4"), ("z4",))


def solved(columns, y, precision):
    """Return the least-squares values of rows (row, column) with what is known beforehand."""
    matrix = columns.T @ columns + np.diag(precision)
    return np.linalg.solve(matrix, -columns.T @ y) if columns.shape[1] else np.zeros(0)


def refitted(case, present, precision, candidate, folds):
    """Return the sum of squares of each block, predicted from the other folds."""
    columns, y = case.of(*present, *candidate), case.of("residual")[:, :, 0]
    known = np.append(precision, np.zeros(len(candidate)))
    loss = np.zeros(len(y))
    for fold in folds:
        rest = np.setdiff1d(np.arange(len(y)), fold)
        flat = columns[rest].reshape(y[rest].size, columns.shape[2])
        values = solved(flat, y[rest].ravel(), known)
        loss[fold] = np.sum((y[fold] + columns[fold] @ values) ** 2, axis=1)
    return loss


def contributed(case, present, precision, candidate, folds, beside=None):
    """Sums of squares of what a candidate changes of the prediction of rows held out; (block,).

    Beside another candidate: of what sets the two predictions apart.
    """
    out = np.zeros(20)
    y = case.of("residual")
    for fold in folds:
        rest = np.setdiff1d(np.arange(20), fold)
        predicted = []
        for names in ((*present, *candidate), (*present, *(beside or ()))):
            columns = case.of(*names)
            known = np.append(precision, np.zeros(len(names) - len(present)))
            flat = columns[rest].reshape(y[rest].size, columns.shape[2])
            predicted.append(columns[fold] @ solved(flat, y[rest].ravel(), known))
        out[fold] = np.sum((predicted[0] - predicted[1]) ** 2, axis=1)
    return out


def scored(case, present, precision, folds):
    evidence = case.grams
    held = ModelColumns(evidence.index(present), np.array(precision, dtype=float))
    return score(evidence, held, [evidence.index(one) for one in CANDIDATES], evidence.residuals[0], folds)


@pytest.mark.parametrize("present", PRESENTS)
@pytest.mark.parametrize("interleaved", [False, True])
def test_held_out_losses_are_those_of_refits_of_the_rows(present, interleaved):
    names, precision = PRESENTS[present]
    case, folds = row_case(2), make_folds(20, interleaved)
    found = scored(case, names, precision, folds)
    without = refitted(case, names, precision, (), folds)
    np.testing.assert_allclose(found.loss0, without, rtol=1e-9)
    for place, candidate in enumerate(CANDIDATES):
        expected = refitted(case, names, precision, candidate, folds)
        np.testing.assert_allclose(found.loss[:, place], expected, rtol=1e-9)
        assert found.gain[place] == pytest.approx(1.0 - expected.sum() / without.sum(), abs=1e-9)
        change = contributed(case, names, precision, candidate, folds)
        np.testing.assert_allclose(found.expected[:, place], change, rtol=1e-8)
        used = np.ones((20, 1), dtype=bool)
        t = expected_gain_t((without - expected)[:, None], change[:, None], used)[0]
        assert found.t[place] == pytest.approx(t, rel=1e-6)


@pytest.mark.parametrize("present", PRESENTS)
def test_what_sets_two_candidates_apart_is_what_sets_their_predictions_of_rows_apart(present):
    names, precision = PRESENTS[present]
    case, folds = row_case(2), make_folds(20)
    found = scored(case, names, precision, folds)
    expected = contributed(case, names, precision, CANDIDATES[0], folds, beside=CANDIDATES[3])
    np.testing.assert_allclose(found.fits.squared_differences([0], 3)[:, 0], expected, rtol=1e-8)
    np.testing.assert_allclose(found.fits.squared_differences([1, 3], 0)[:, 1], expected, rtol=1e-8)
    assert found.t_worse_than(3, 0) == pytest.approx(-found.t_worse_than(0, 3), rel=1e-9)


@pytest.mark.parametrize("present", PRESENTS)
def test_values_and_what_they_explain_are_those_of_the_rows(present):
    names, precision = PRESENTS[present]
    case = row_case(3)
    found = scored(case, names, precision, make_folds(20))
    y = case.of("residual").ravel()
    p = case.of(*names).reshape(y.size, -1)
    alone = y + p @ solved(p, y, np.array(precision))
    penalty = np.array(precision) @ solved(p, y, np.array(precision)) ** 2 if names else 0.0
    for place, candidate in enumerate(CANDIDATES):
        z = case.of(*names, *candidate).reshape(y.size, -1)
        known = np.append(precision, np.zeros(len(candidate)))
        values = solved(z, y, known)
        np.testing.assert_allclose(found.gamma[place], values[len(names) :], rtol=1e-8)
        left = np.sum((y + z @ values) ** 2) + known @ values**2
        assert found.explained[place] == pytest.approx(alone @ alone + penalty - left, rel=1e-7)


@pytest.mark.parametrize("present", PRESENTS)
def test_many_residuals_at_once_score_as_one_after_the_other(present):
    names, precision = PRESENTS[present]
    case = row_case(4)
    g = np.random.default_rng(1)
    more = np.concatenate([case.values, g.normal(size=(20, 60, 2))], axis=2)
    case = type(case)((*case.names, "residual~1", "residual~2"), more)
    evidence = case.grams
    held = ModelColumns(evidence.index(names), np.array(precision, dtype=float))
    columns = [evidence.index(one) for one in CANDIDATES]
    folds, y = make_folds(20), np.array(evidence.residuals)
    gain, t = score_many(evidence, held, columns, y, folds)
    for place, one in enumerate(y):
        alone = score(evidence, held, columns, int(one), folds)
        np.testing.assert_allclose(gain[:, place], alone.gain, atol=1e-11)
        np.testing.assert_allclose(t[:, place], alone.t, rtol=1e-7)


def test_block_scores_are_sums_over_rows_at_the_models_own_fit():
    case = row_case(5)
    evidence = case.grams
    held = ModelColumns(evidence.index(("p0", "p1")), np.zeros(2))
    p, y = case.of("p0", "p1"), case.of("residual")
    every = case.values - p @ np.linalg.lstsq(p.reshape(-1, 2), case.values.reshape(-1, 11), rcond=None)[0]
    left = y - p @ np.linalg.lstsq(p.reshape(-1, 2), y.reshape(-1, 1), rcond=None)[0]
    expected = np.einsum("bri,br->bi", every, left[:, :, 0])
    np.testing.assert_allclose(block_scores(evidence, held, evidence.residuals[0]), expected, atol=1e-8)


def test_a_candidate_that_the_model_holds_already_explains_nothing_more():
    case = row_case(6)
    case.values[:, :, 5] = case.of("p0", "p1") @ [1.0, -2.0]
    evidence = case.grams
    held = ModelColumns(evidence.index(("p0", "p1")), np.zeros(2))
    gamma, explained = fit(evidence, held, [evidence.index(["z0"])], evidence.residuals[0])
    assert np.abs(explained[0]) < 1e-6 * evidence.total[-1, -1]
    found = score(evidence, held, [evidence.index(["z0"])], evidence.residuals[0], make_folds(20))
    assert np.abs(found.gain[0]) < 1e-6
    assert gamma[0].shape == (1,)


def test_the_half_inverse_is_one_where_the_matrix_has_an_inverse():
    g = np.random.default_rng(0)
    rows = g.normal(size=(5, 30, 3)) * [1e-4, 1.0, 1e4]
    matrices = np.einsum("cri,crj->cij", rows, rows)
    half = inverse_square_root(matrices)
    product = np.matmul(half.transpose(0, 2, 1), np.matmul(matrices, half))
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-9)
    rows[:, :, 2] = rows[:, :, 0]
    twins = np.einsum("cri,crj->cij", rows, rows)
    half = inverse_square_root(twins)
    back = np.matmul(twins, np.matmul(half, np.matmul(half.transpose(0, 2, 1), twins)))
    np.testing.assert_allclose(back, twins, rtol=1e-6)


def test_a_block_is_active_when_a_part_of_a_column_is_left_in_it():
    case = row_case(7)
    case.values[5:, :, 5] = 0.0
    case.values[5:, :, 6] *= 1e-6
    case.values[:3, :, 8] = 0.0
    evidence = case.grams
    found = active_blocks(
        evidence, [evidence.index(["z0"]), evidence.index(["z1"]), evidence.index(["z0", "z3"])]
    )
    np.testing.assert_array_equal(found[:, 0], np.arange(20) < 5)
    np.testing.assert_array_equal(found[:, 1], np.arange(20) < 5)
    np.testing.assert_array_equal(found[:, 2], np.ones(20, dtype=bool))


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("blocks", [2, 5, 13, 14, 60])
def test_folds_hold_every_block_once(blocks, interleaved):
    folds = make_folds(blocks, interleaved)
    assert sorted(np.concatenate(folds).tolist()) == list(range(blocks))
    assert 2 <= len(folds) <= 13
    if not interleaved:
        assert all(np.all(np.diff(fold) == 1) for fold in folds)
