"""Symmetric matrices of which each entry is kept once."""

import numpy as np
import pytest

from inflight.lsq.triangles import Triangles, entries_of, places_of_entries

RANDOM = np.random.default_rng(5)


def symmetric(blocks, width):
    values = RANDOM.normal(size=(blocks, width, width)).astype(np.float32)
    return values + values.swapaxes(1, 2)


def packed(matrices):
    out = Triangles.zeros(len(matrices), matrices.shape[1])
    for block, matrix in enumerate(matrices):
        out.put(block, matrix)
    return out


def whole(triangles):
    every = np.arange(triangles.width)
    return triangles.at(np.arange(len(triangles)), places_of_entries(every[:, None], every))


@pytest.mark.parametrize("blocks", [[0, 1, 2, 3], [1, 2], [3, 0, 2], [2], []])
def test_entries_are_those_of_the_matrices_whichever_blocks_are_asked_for(blocks):
    matrices = symmetric(4, 7)
    made, rows, columns = packed(matrices), np.array([[6], [0], [3]]), np.array([1, 6, 3, 2])
    at = np.array(blocks, dtype=np.int64)
    found = made.at(at, places_of_entries(rows, columns))
    np.testing.assert_array_equal(found, matrices[at[:, None, None], rows, columns])


def test_sums_and_diagonals_are_those_of_the_matrices():
    matrices, columns = symmetric(5, 6), np.array([4, 1, 5])
    made, entries = packed(matrices), places_of_entries(columns[:, None], columns)
    np.testing.assert_array_equal(made.diagonal(columns), np.einsum("bii->bi", matrices)[:, columns])
    expected = matrices[[3, 0]].astype(np.float64).sum(axis=0)[np.ix_(columns, columns)]
    np.testing.assert_allclose(made.sum_of(np.array([3, 0]), entries), expected, rtol=1e-15)


def test_products_of_the_last_columns_leave_the_first_ones_0():
    made, matrix = Triangles.zeros(1, 5), symmetric(1, 3)[0]
    made.put(0, matrix)
    np.testing.assert_array_equal(whole(made)[0], np.pad(matrix, ((2, 0), (2, 0))))


def test_columns_join_with_and_without_room():
    matrices = symmetric(3, 9)
    made = packed(matrices[:, :4, :4])
    # Without room, with room, and beyond it.
    for old, new, room in ((4, 5, 7), (5, 7, 7), (7, 9, 0)):
        made.append(matrices[:, :old, old:new], matrices[:, old:new, old:new], room)
        np.testing.assert_array_equal(whole(made), matrices[:, :new, :new])
        assert made.values.shape[1] >= entries_of(new)


def test_sums_and_selections_have_arrays_of_their_own():
    first, second = symmetric(2, 4), symmetric(2, 4)
    made = packed(first)
    made.append(np.zeros((2, 4, 1)), np.ones((2, 1, 1)), 8)
    same, both = Triangles.sum([packed(first)]), Triangles.sum([packed(first), packed(second)])
    np.testing.assert_array_equal(whole(both), first + second)
    alone = Triangles.sum([made])
    kept = made.select(np.array([0, 2]))
    made.append(np.ones((2, 5, 1)), np.ones((2, 1, 1)), 8)
    made.values[:] = 0.0
    assert (made.width, alone.width, same.width) == (6, 5, 4)
    np.testing.assert_array_equal(whole(alone)[:, :4, :4], first)
    np.testing.assert_array_equal(whole(kept), first[:, [0, 2]][:, :, [0, 2]])
