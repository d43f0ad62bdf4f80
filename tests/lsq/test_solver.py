"""Solving symmetric systems: what numpy's eigenvalue routine cannot do is done another way."""

import numpy as np
import pytest

from inflight.lsq.solver import (
    eigen_of_symmetric,
    gram_inverse,
    inverse_square_root,
    solve,
    solve_each,
    solve_scaled,
)


def refuse(matrix):
    raise np.linalg.LinAlgError("Eigenvalues did not converge")


@pytest.fixture
def gram():
    rows = np.random.default_rng(3).normal(size=(2, 40, 6)) * [1.0, 1e3, 1e-3, 1.0, 5.0, 0.2]
    return np.swapaxes(rows, 1, 2) @ rows


def test_eigenvalues_are_found_where_divide_and_conquer_does_not_converge(gram, monkeypatch):
    usual = np.linalg.eigh(gram)
    monkeypatch.setattr(np.linalg, "eigh", refuse)
    values, vectors = eigen_of_symmetric(gram)
    np.testing.assert_allclose(values, usual[0], rtol=1e-9, atol=1e-9 * values.max())
    np.testing.assert_allclose(
        (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2), gram, atol=1e-8 * values.max()
    )


def test_a_system_is_solved_all_the_same(gram, monkeypatch):
    right = np.eye(6)
    usual = solve_scaled(gram[0], right)
    monkeypatch.setattr(np.linalg, "eigh", refuse)
    np.testing.assert_allclose(solve_scaled(gram[0], right), usual, rtol=1e-8)


def test_what_is_not_a_number_is_still_refused(gram):
    gram[0, 0, 0] = np.nan
    with pytest.raises(np.linalg.LinAlgError):
        eigen_of_symmetric(gram)


@pytest.mark.parametrize("size", range(9))
def test_the_inverse_is_that_of_a_matrix_of_any_size_and_none_at_all_of_an_empty_one(size):
    rows = np.random.default_rng(size).normal(size=(3, 40, size)) * np.logspace(-2, 3, size)
    grams = np.swapaxes(rows, 1, 2) @ rows
    root = inverse_square_root(grams)
    expected = np.linalg.inv(grams)
    unit = np.sqrt(np.einsum("...ii->...i", expected))
    np.testing.assert_allclose(
        root @ np.swapaxes(root, 1, 2) / unit[..., None] / unit[..., None, :],
        expected / unit[..., None] / unit[..., None, :],
        atol=1e-9,
    )


@pytest.mark.parametrize("size", [2, 6, 8])
def test_the_inverse_leaves_out_what_a_matrix_does_not_determine(size):
    rows = np.random.default_rng(size).normal(size=(40, size))
    rows[:, -1] = rows[:, 0]
    gram = rows.T @ rows
    np.testing.assert_allclose(gram @ gram_inverse(gram) @ gram, gram, atol=1e-8 * gram.max())


def test_equations_that_are_solved_together_have_the_solutions_that_each_has_alone():
    random = np.random.default_rng(5)
    rows = random.normal(size=(40, 300, 4))
    rows[::3, :, 1] = rows[::3, :, 0]  # some determine only a combination
    read = rows.sum(axis=-1, keepdims=True) * 0.01 + random.normal(size=(40, 300, 1))
    rows = np.concatenate([rows, read], axis=-1)
    grams = rows.swapaxes(-1, -2) @ rows
    scores = rows[..., :-1] * rows[..., -1:]
    scatters = scores.swapaxes(-1, -2) @ scores * random.uniform(0.5, 3.0, (40, 1, 1))
    priors, sigmas = random.normal(size=(40, 4)), 10.0 ** random.uniform(-3, 1, (40, 4))
    sigmas[1::4, 2] = 0.0  # and some hold one
    counts = np.full(40, 300.0)
    together = solve_each(grams, scatters, counts, priors, sigmas)
    assert len({len(one.directions) for one in together}) > 1
    for place, one in enumerate(together):
        alone = solve(grams[place], scatters[place], 300.0, priors[place], sigmas[place])
        for name, value in vars(alone).items():
            np.testing.assert_array_equal(getattr(one, name), value, err_msg=name)


def test_a_matrix_for_which_divide_and_conquer_fails_changes_nothing_of_the_others(monkeypatch):
    random, eigh = np.random.default_rng(8), np.linalg.eigh
    rows = random.normal(size=(5, 30, 4))
    matrices = rows.swapaxes(1, 2) @ rows

    def failing(matrix):
        if any(np.array_equal(one, matrices[2]) for one in matrix.reshape(-1, 4, 4)):
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return eigh(matrix)

    sound = eigen_of_symmetric(matrices)
    monkeypatch.setattr(np.linalg, "eigh", failing)
    values, vectors = eigen_of_symmetric(matrices)
    others = [0, 1, 3, 4]
    np.testing.assert_array_equal(values[others], sound[0][others])
    np.testing.assert_array_equal(vectors[others], sound[1][others])
    np.testing.assert_allclose(values[2], sound[0][2], rtol=1e-10)
    np.testing.assert_allclose(vectors[2] * values[2] @ vectors[2].T, matrices[2], rtol=1e-9)


def test_systems_that_fix_different_unknowns_are_refused():
    precision = np.array([[1.0, np.inf], [np.inf, 1.0]])
    with pytest.raises(ValueError, match="fix different unknowns"):
        solve_scaled(np.array([np.eye(2)] * 2), np.ones((2, 2)), 0.0, precision)
    found = solve_scaled(
        np.array([np.eye(2)] * 2), np.ones((2, 2)), 0.0, np.array([[1.0, np.inf], [3.0, np.inf]])
    )
    np.testing.assert_allclose(found, [[0.5, 0.0], [0.25, 0.0]])
    for systems, unknowns in ((0, 2), (1, 0)):
        shape = (systems, unknowns)
        none = solve_scaled(np.zeros((*shape, unknowns)), np.zeros(shape), 0.0, np.zeros(shape))
        assert none.shape == shape
    assert solve_scaled(np.zeros((1, 0, 0)), np.zeros((1, 0, 1)), 0.0, np.zeros(0)).shape == (1, 0, 1)


def test_no_equations_have_no_solutions():
    none = np.zeros((0, 4))
    assert solve_each(np.zeros((0, 5, 5)), np.zeros((0, 4, 4)), np.zeros(0), none, none) == []
