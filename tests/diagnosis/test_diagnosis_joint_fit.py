"""Errors of values of which the data tell little and a number's own sigma the rest."""

import numpy as np
import pytest

from inflight.diagnosis.scoring import ModelColumns
from inflight.diagnosis.stepwise import joint_fit
from inflight.lsq import GramArrays, gram_of

BLOCKS, ROWS, DRAWS, SIGMA = 60, 80, 300, 0.05


@pytest.fixture(scope="module")
def fits():
    """Return errors of two values and their sigmas, (draw, column), of columns that do nearly the same.

    The first is free, the second a number that is known to a sigma, as a field's delay along each axis and a
    clock are.
    """
    generator = np.random.default_rng(0)
    quick = generator.normal(size=(BLOCKS, ROWS))
    both = np.stack([quick, quick + 1e-3 * generator.normal(size=(BLOCKS, ROWS))], axis=2)
    columns = both.reshape(-1, 1, 2)
    parts = [slice(at * ROWS, (at + 1) * ROWS) for at in range(BLOCKS)]
    truth = np.stack([generator.normal(size=DRAWS), SIGMA * generator.normal(size=DRAWS)])
    noise = generator.normal(size=(BLOCKS * ROWS, 1, DRAWS))
    gram = gram_of(columns, noise - columns @ truth, np.ones(len(columns)), parts)
    names = ("free", "known", *(f"residual~{k}" if k else "residual" for k in range(DRAWS)))
    edges = np.arange(BLOCKS + 1, dtype=np.int64)
    grams = GramArrays(names, gram, edges[:-1], edges[1:], np.full(BLOCKS, float(ROWS)), np.ones(len(names)))
    present = ModelColumns(np.array([0, 1]), np.array([0.0, 1.0 / SIGMA**2]), 1.0)
    found = [joint_fit(grams, present, y) for y in grams.residuals]
    values = np.array([value for value, _ in found])
    sigma = np.sqrt(np.array([np.diag(covariance) for _, covariance in found]))
    return values - truth.T, sigma


def test_errors_are_as_large_as_stated(fits):
    errors, sigma = fits
    pulls = np.sqrt(np.mean((errors / sigma) ** 2, axis=0))
    assert np.all((pulls > 0.9) & (pulls < 1.1))


def test_stated_errors_do_not_depend_on_how_far_the_number_was_pulled(fits):
    _, sigma = fits
    assert np.all(sigma.std(axis=0) < 0.1 * sigma.mean(axis=0))


def test_a_column_that_data_do_not_see_keeps_what_is_known_of_it():
    gram = np.zeros((4, 2, 2))
    gram[:, 1, 1] = 50.0
    edges = np.arange(5, dtype=np.int64)
    grams = GramArrays(("known", "residual"), gram, edges[:-1], edges[1:], np.full(4, 50.0), np.ones(2))
    value, covariance = joint_fit(grams, ModelColumns(np.array([0]), np.array([2.0 / SIGMA**2]), 2.0), 1)
    assert value[0] == 0.0
    assert np.sqrt(covariance[0, 0]) == pytest.approx(SIGMA)
