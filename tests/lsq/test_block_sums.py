"""Sums of functions of time over blocks are those of the expanded matrices."""

import numpy as np

from inflight.lsq import BlockSums


def made(seed: int = 1) -> tuple[BlockSums, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    rows = random.standard_normal((9, 30, 5))
    values = np.column_stack([np.full(9, 2.0), random.standard_normal((9, 3)), np.ones(9)])
    owners = np.array([0, 1, 1, 2, 3])
    turn = np.zeros((9, 6, 5))
    turn[:, np.arange(5), owners] = values
    turn[:, -1, -1] = 1.0
    return BlockSums(np.swapaxes(rows, 1, 2) @ rows, random.uniform(0.2, 1.0, 9)), values, owners, turn


def test_sums_are_those_of_every_block_expanded():
    sums, values, owners, turn = made()
    expected = np.einsum("b,bik,bkl,bjl->ij", sums.weight, turn, sums.gram, turn)
    np.testing.assert_allclose(sums.expanded(values, owners), expected, rtol=1e-12)


def test_scores_are_those_of_every_block_expanded():
    sums, values, owners, turn = made()
    parameters = np.random.default_rng(5).standard_normal((9, 4))
    slopes = np.einsum("bij,bj->bi", sums.gram, np.column_stack([parameters, np.ones(9)]))
    expected = sums.weight[:, None] * np.einsum("bij,bj->bi", turn, slopes)[:, :-1]
    np.testing.assert_allclose(sums.scores(values, owners, parameters), expected, rtol=1e-12)
