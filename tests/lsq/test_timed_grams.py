"""Columns times functions of the block, and forms that take over what an earlier one holds."""

import numpy as np
import pytest

from inflight.lsq import CalibratedBlocks, FactoredGrams, GramArrays, TimedGrams

BASE, MODEL, OTHERS = ("a", "b"), ("m", "n"), ("s", "t", "u")
NAMES = (*BASE, *MODEL, *OTHERS, "residual")
BLOCKS, ROWS = 12, 40
GROUPS = [list(range(5)), list(range(5, 12))]
PRECISION = np.array([0.5, 2.0])
FREE = np.zeros(2)


def rows_of_blocks() -> np.ndarray:
    """Rows of [calibration | model | others | residual]; (block, row, column)."""
    rows = np.random.default_rng(3).normal(size=(BLOCKS, ROWS, len(NAMES)))
    # The calibration explains most of a column, and all but rounding of another one.
    rows[:, :, 4] += 30.0 * rows[:, :, 0]
    rows[:, :, 6] = rows[:, :, 0] - 3.0 * rows[:, :, 1]
    return rows


def grams_of(rows: np.ndarray, names: tuple[str, ...] = NAMES) -> GramArrays:
    edges = np.arange(len(rows) + 1, dtype=np.int64) * 100
    gram = np.swapaxes(rows, 1, 2) @ rows
    scale = np.arange(1.0, len(names) + 1.0)
    return GramArrays(names, gram, edges[:-1], edges[1:], np.full(len(rows), float(ROWS)), scale)


def functions() -> dict[str, tuple[str, np.ndarray]]:
    after = (np.arange(BLOCKS) >= 7).astype(np.float64)
    return {
        "s@7": ("s", after),
        "t@7": ("t", after),
        "s drifts": ("s", np.arange(BLOCKS) - 5.5),
        "t drifts": ("t", np.arange(BLOCKS) - 5.5),
        "u@all": ("u", np.ones(BLOCKS)),
        "m stays": ("m", np.ones(BLOCKS)),
    }


@pytest.mark.parametrize("precision", [PRECISION, np.zeros(2), np.array([0.0, np.inf])])
def test_functions_of_the_block_have_the_products_that_all_columns_together_have(precision):
    grams = grams_of(rows_of_blocks())
    made = TimedGrams.of(CalibratedBlocks(grams, BASE, GROUPS, precision), MODEL, functions())
    whole = grams.select([*BASE, *MODEL, *OTHERS]).expand(functions())
    whole = whole.marginalise(BASE, GROUPS, precision).select([*MODEL, *functions()])
    assert made.names == whole.names
    np.testing.assert_array_equal(made.scale, whole.scale)
    columns = np.array([made.residuals[0], *made.index(MODEL)])
    np.testing.assert_allclose(made.rows(columns), whole.rows(columns), rtol=1e-9, atol=1e-8)
    others = made.index(["t@7", "m"])
    np.testing.assert_allclose(made.rows(columns, others), whole.rows(columns, others), rtol=1e-9, atol=1e-8)
    groups = np.array([made.index(pair) for pair in (["s@7", "t@7"], ["s drifts", "t drifts"])])
    np.testing.assert_allclose(
        made.products_within(groups), whole.products_within(groups), rtol=1e-9, atol=1e-8
    )
    live = made.is_live(made.index(list(functions())))
    assert live.tolist() == (whole.squares.sum(axis=0)[whole.index(list(functions()))] > 0).tolist()


def test_what_the_calibration_takes_whole_is_no_column():
    made = TimedGrams.of(
        CalibratedBlocks(grams_of(rows_of_blocks()), BASE, GROUPS, np.zeros(2)), MODEL, functions()
    )
    place = made.index(["u@all"])
    assert not made.is_live(place).any()
    assert not made.rows(made.index(MODEL), place).any()


def test_functions_have_no_products_with_each_other_outside_a_group():
    made = TimedGrams.of(
        CalibratedBlocks(grams_of(rows_of_blocks()), BASE, GROUPS, PRECISION), MODEL, functions()
    )
    with pytest.raises(ValueError, match="within a group"):
        made.rows(made.index(["s@7"]))


def joined(asked: bool) -> tuple[FactoredGrams, FactoredGrams]:
    """A form with a column that joined, and the same made at once; `asked`: after rows were asked for."""
    rows = rows_of_blocks()
    early = [NAMES.index(name) for name in NAMES if name not in ("t", "u")]
    blocks = FactoredGrams.of(grams_of(rows[:, :, early], tuple(NAMES[at] for at in early)), BASE)
    earlier = blocks.marginalise(BASE, GROUPS, FREE)
    if asked:
        earlier.rows(earlier.index(["residual", "n"]))
        earlier.rows(earlier.index(["m"]))
        earlier.products_within(np.array([earlier.index(["s", "m"])]))
    late = [NAMES.index(name) for name in ("t", "u")]
    order = [NAMES.index(name) for name in blocks.names]
    new = rows[:, :, late]
    across, inner = np.swapaxes(rows[:, :, order], 1, 2) @ new, np.swapaxes(new, 1, 2) @ new
    wider = blocks.bordered(("t", "u"), np.ones(2), across, inner)
    return wider.marginalise(BASE, GROUPS, FREE, earlier=earlier), wider.marginalise(BASE, GROUPS, FREE)


@pytest.mark.parametrize("asked", [False, True])
def test_a_form_that_takes_over_an_earlier_one_is_the_form_made_anew(asked):
    found, anew = joined(asked)
    assert found.names == anew.names
    np.testing.assert_allclose(found.squares, anew.squares, rtol=1e-12, atol=1e-9)
    columns = found.index(["residual", "n", "m", "t", "u"])
    np.testing.assert_allclose(found.rows(columns), anew.rows(columns), rtol=1e-12, atol=1e-9)
    groups = np.array([found.index(pair) for pair in (["s", "m"], ["s", "t"])])
    np.testing.assert_allclose(
        found.products_within(groups), anew.products_within(groups), rtol=1e-12, atol=1e-9
    )
    # A column that the calibration takes whole is 0 for those that were kept, too.
    assert not found.rows(columns, found.index(["u"])).any()


def test_a_column_that_was_replaced_is_not_taken_over():
    rows = rows_of_blocks()
    blocks = FactoredGrams.of(grams_of(rows), BASE)
    first = blocks.expand({"s@": ("s", (np.arange(BLOCKS) >= 3.0) * 1.0)})
    earlier = first.marginalise(BASE, GROUPS, PRECISION)
    earlier.rows(earlier.index(["residual", "s@"]))
    again = first.without({"s@"}).expand({"s@": ("s", (np.arange(BLOCKS) >= 8.0) * 1.0)})
    found = again.marginalise(BASE, GROUPS, PRECISION, earlier=earlier)
    anew = again.marginalise(BASE, GROUPS, PRECISION)
    columns = found.index(["residual", "s@"])
    np.testing.assert_allclose(found.rows(columns), anew.rows(columns), rtol=1e-12, atol=1e-9)


def test_a_form_of_the_same_columns_takes_over_all_and_one_that_was_never_asked_nothing():
    blocks = FactoredGrams.of(grams_of(rows_of_blocks()), BASE)
    earlier = blocks.marginalise(BASE, GROUPS, PRECISION)
    # Products with what is kept ask whether anything is: nothing is yet.
    earlier.rows(earlier.index(["m"]), earlier.index(["n"]))
    found = blocks.marginalise(BASE, GROUPS, PRECISION, earlier=earlier)
    columns = found.index(["residual", "m"])
    np.testing.assert_array_equal(found.rows(columns), earlier.rows(columns))


def test_products_that_were_let_go_of_are_made_again():
    found, _ = joined(asked=True)
    columns = found.index(["residual", "n", "m", "t", "u"])
    rows = found.rows(columns)
    found.forget_products()
    np.testing.assert_allclose(found.rows(columns), rows, rtol=1e-12, atol=1e-9)
