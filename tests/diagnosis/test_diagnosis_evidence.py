"""Algebra on Gram matrices against the same done on rows."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from row_cases import row_case

from inflight.errors import CalibrationError
from inflight.lsq import FactoredGrams, GramArrays, gram_of, parts_of, prewhiten, solve_scaled
from inflight.lsq.gram_blocks import pack, unpack
from inflight.time import SECOND


def grams_of(rows):
    return np.einsum("bri,brj->bij", rows, rows)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1000),
    cut=st.integers(2, 8),
    precision=st.lists(st.sampled_from([0.0, 1.0, 50.0, 1e4]), min_size=3, max_size=3),
)
def test_absorbing_is_a_fit_of_the_rows_in_each_interval(seed, cut, precision):
    case = row_case(seed, blocks=10, rows=12)
    groups = [range(cut), range(cut, 10)]
    left = case.grams.marginalise(["n0", "n1", "n2"], groups, np.array(precision))
    expected = case.values[:, :, 3:].copy()
    for group in groups:
        n = case.of("n0", "n1", "n2")[list(group)]
        # What is known beforehand acts like three more rows that read nought.
        more = np.concatenate([n.reshape(-1, 3), np.diag(np.sqrt(precision))])
        right = np.concatenate([expected[list(group)].reshape(-1, 8), np.zeros((3, 8))])
        expected[list(group)] -= n @ np.linalg.lstsq(more, right, rcond=None)[0]
    assert left.names == case.names[3:]
    np.testing.assert_allclose(left.gram, grams_of(expected), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(left.scale, case.grams.scale[3:])


def test_a_column_that_the_calibration_explains_wholly_is_dead_but_a_residual_never():
    case = row_case(1)
    case.values[:, :, 5] = case.of("n0", "n1") @ [2.0, -1.0]
    case.values[:, :, 10] = case.of("n2")[:, :, 0]
    left = case.grams.marginalise(["n0", "n1", "n2"], [range(20)], np.zeros(3))
    dead, alive = left.names.index("z0"), left.names.index("z1")
    assert not left.gram[:, dead].any()
    assert not left.gram[:, :, dead].any()
    assert left.total[alive, alive] > 1.0
    y = left.residuals[0]
    assert np.abs(left.total[y, y]) < 1e-6


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), factors=st.lists(st.floats(-3, 3), min_size=20, max_size=20))
def test_expanding_is_multiplying_rows_by_a_function_of_the_block(seed, factors):
    case = row_case(seed, rows=6)
    factor = np.array(factors)
    wide = case.grams.expand({"step": ("z0", factor), "late": ("n1", 1.0 - factor)})
    rows = np.concatenate(
        [
            case.values[:, :, :-1],
            case.of("z0") * factor[:, None, None],
            case.of("n1") * (1.0 - factor)[:, None, None],
            case.of("residual"),
        ],
        axis=2,
    )
    assert wide.names == (*case.names[:-1], "step", "late", "residual")
    np.testing.assert_allclose(wide.gram, grams_of(rows), atol=1e-9)
    np.testing.assert_array_equal(
        wide.scale[-3:-1], [case.grams.scale[case.names.index(name)] for name in ("z0", "n1")]
    )


@settings(max_examples=20, deadline=None)
@given(cuts=st.sets(st.integers(1, 19), max_size=6), order=st.randoms(use_true_random=False))
def test_blocks_add_up_whatever_way_they_are_merged_and_joined(cuts, order):
    whole = row_case(3, rows=8).grams
    edges = [0, *sorted(cuts), 20]
    groups = [list(range(a, b)) for a, b in pairwise(edges)]
    merged = whole.merge_groups(groups)
    np.testing.assert_allclose(merged.total, whole.total, rtol=1e-12)
    np.testing.assert_allclose(merged.gram[0], whole.gram[groups[0]].sum(axis=0), rtol=1e-12)
    assert merged.count.sum() == whole.count.sum()
    assert (merged.start[0], merged.end[-1]) == (whole.start[0], whole.end[-1])
    pieces = [
        GramArrays(
            whole.names,
            *(part[group] for part in (whole.gram, whole.start, whole.end, whole.count)),
            whole.scale,
        )
        for group in groups
    ]
    order.shuffle(pieces)
    joined = pieces[0].join(pieces[1:])
    for name in ("gram", "start", "end", "count"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))


def test_joining_refuses_what_overlaps_and_what_has_other_columns():
    one = row_case().grams
    with pytest.raises(CalibrationError, match="overlap"):
        one.join([one])
    with pytest.raises(CalibrationError, match="different libraries"):
        one.join([one.select(["z0", "n1"])])


def test_selecting_keeps_the_residual_last():
    case = row_case(4)
    some = case.grams.select(["z3", "n1"])
    assert some.names == ("z3", "n1", "residual")
    np.testing.assert_allclose(some.gram, grams_of(case.of("z3", "n1", "residual")), rtol=1e-12)
    with pytest.raises(CalibrationError, match="no column z9"):
        case.grams.select(["z9"])


def test_sums_over_folds_are_sums_of_blocks():
    evidence = row_case(5).grams
    folds = [np.arange(0, 7), np.arange(7, 20)]
    for found, fold in zip(evidence.sums(folds), folds, strict=True):
        np.testing.assert_allclose(found, evidence.gram[fold].sum(axis=0))


@settings(max_examples=20, deadline=None)
@given(width=st.integers(1, 9), blocks=st.integers(1, 4), seed=st.integers(0, 99))
def test_packing_keeps_symmetric_matrices(width, blocks, seed):
    rows = np.random.default_rng(seed).normal(size=(blocks, 5, width))
    gram = grams_of(rows)
    np.testing.assert_array_equal(unpack(pack(gram)), gram)
    assert pack(gram).shape == (blocks, width * (width + 1) // 2)


def test_a_store_gives_back_the_evidence():
    evidence = row_case(6).grams
    stored = evidence.as_dataset()
    np.testing.assert_array_equal(unpack(stored["gram"].values), evidence.gram)
    for name in ("start", "end", "count"):
        np.testing.assert_array_equal(stored[name].values, getattr(evidence, name))


def test_the_gram_matrix_of_a_part_counts_good_rows_by_their_weight():
    g = np.random.default_rng(7)
    columns, residual, weight = g.normal(size=(30, 2, 4)), g.normal(size=(30, 2, 1)), g.uniform(0, 1, 30)
    weight[5:9] = 0.0
    stamps = SECOND * np.arange(30, dtype=np.int64)
    parts = parts_of(stamps, [0, 10 * SECOND, 30 * SECOND])
    assert parts == [slice(0, 10), slice(10, 30)]
    both = np.concatenate([columns, residual], axis=2)
    expected = [np.einsum("t,tri,trj->ij", weight[part], both[part], both[part]) for part in parts]
    np.testing.assert_allclose(gram_of(columns, residual, weight, parts), expected, rtol=1e-12)


def test_prewhitening_takes_off_what_the_row_before_foretells_and_breaks_at_gaps():
    g = np.random.default_rng(8)
    stamps = (SECOND * np.array([0, 10, 20, 30, 90, 100, 110])).astype(np.int64)
    values, weight = g.normal(size=(7, 2)), np.array([1, 1, 0, 1, 1, 1, 1.0])
    white = prewhiten(values, weight, stamps, 50.0)
    phi = np.exp(-10 / 50)
    np.testing.assert_allclose(white[1], values[1] - phi * values[0])
    np.testing.assert_allclose(white[5:], values[5:] - phi * values[4:6])
    # The first row, a row without weight, the one behind it, and the first after a gap.
    assert not white[[0, 2, 3, 4]].any()


def test_prewhitening_makes_a_first_order_process_white():
    g = np.random.default_rng(9)
    phi, noise = np.exp(-10 / 600), g.normal(size=20_000)
    series = np.zeros(noise.size)
    for k in range(1, noise.size):
        series[k] = phi * series[k - 1] + noise[k]
    stamps = 10 * SECOND * np.arange(noise.size, dtype=np.int64)
    white = prewhiten(series, np.ones(noise.size), stamps, 600.0)
    np.testing.assert_allclose(white[1:], noise[1:], atol=1e-12)


def test_a_system_is_solved_in_units_of_its_diagonal_and_left_alone_where_it_is_singular():
    g = np.random.default_rng(10)
    rows = g.normal(size=(40, 4)) * [1e-6, 1.0, 1e5, 1.0]
    rows[:, 3] = 0.0
    truth = np.array([1e6, 2.0, 3e-5, 0.0])
    found = solve_scaled(rows.T @ rows, rows.T @ (rows @ truth))
    np.testing.assert_allclose(found, truth, rtol=1e-9)
    many = solve_scaled(rows.T @ rows, rows.T @ np.stack([rows @ truth, -rows @ truth], axis=1))
    np.testing.assert_allclose(many, np.stack([truth, -truth], axis=1), rtol=1e-9)


def test_columns_that_join_later_are_as_if_they_had_been_there():
    evidence, fresh = row_case(1).grams, ["z3", "z4"]
    small = evidence.select([name for name in evidence.names if name not in (*fresh, "residual")])
    places = evidence.index(fresh)
    across = evidence.gram[:, evidence.index(small.names)][:, :, places]
    inner = evidence.gram[:, places][:, :, places]
    joined = small.bordered(fresh, evidence.scale[places], across, inner)
    assert joined.names == evidence.names
    np.testing.assert_array_equal(joined.gram, evidence.gram)
    np.testing.assert_array_equal(joined.scale, evidence.scale)


@pytest.mark.parametrize("precision", [None, np.array([0.0, 3.0, 0.0])])
@pytest.mark.parametrize("groups", [None, [list(range(7)), list(range(7, 20))]])
def test_factored_blocks_are_the_blocks_as_they_were_and_marginalised(precision, groups):
    grams, base = row_case(1).grams, ["n0", "n1", "n2"]
    factored = FactoredGrams.of(grams, base)
    size = np.sqrt(grams.squares.max(axis=0))
    size = size[:, None] * size
    every = np.arange(len(grams.names))
    np.testing.assert_allclose(factored.rows(every) / size, grams.gram / size, atol=2e-7)
    np.testing.assert_allclose(factored.rows(base), grams.rows(base), rtol=1e-12)
    np.testing.assert_allclose(factored.squares, grams.squares, rtol=1e-6)
    told = [groups or [[block] for block in range(len(grams))], precision]
    left, whole = (one.marginalise(base, *told) for one in (factored, grams))
    assert left.names == whole.names
    size = np.sqrt(whole.squares.max(axis=0))
    size = size[:, None] * size
    folds = [np.arange(0, 6), np.arange(6, 20)]
    np.testing.assert_allclose(left.rows(np.arange(8)) / size, whole.gram / size, atol=3e-7)
    np.testing.assert_allclose(left.total / size, whole.total / size, atol=3e-6)
    for one, other in zip(left.sums(folds), whole.sums(folds), strict=True):
        np.testing.assert_allclose(one / size, other / size, atol=3e-6)
    of_each = np.array([[0, 1], [2, 4], [5, 6]])
    within = [one.products_within(of_each, folds[0]) for one in (left, whole)]
    np.testing.assert_allclose(*within, rtol=3e-6, atol=1e-5)


def test_a_calibration_that_blocks_hardly_determine_costs_no_digits():
    """As in an observatory, where one direction is seen: a block's own fit is huge, what it leaves is not."""
    case, base = row_case(5), ["n0", "n1", "n2"]
    values = case.values.copy()
    values[:, :, 1] = values[:, :, 0] * (1.0 + 1e-5 * np.arange(20)[:, None]) + 1e-5 * values[:, :, 1]
    grams = replace(case, values=values).grams
    left, whole = (one.marginalise(base, [list(range(20))]) for one in (FactoredGrams.of(grams, base), grams))
    size = np.sqrt(np.diag(whole.total))
    np.testing.assert_allclose(
        left.total / size / size[:, None], whole.total / size / size[:, None], atol=1e-6
    )


def test_restricted_blocks_are_those_of_fewer_columns_and_columns_join_them_alone():
    grams, base = row_case(2).grams, ["n0", "n1", "n2"]
    whole = FactoredGrams.of(grams, base)
    small = whole.restricted({"z1", "z3"})
    assert small.names == tuple(
        name for name in grams.names if name in (*base, "z1", "z3") or name.startswith("residual")
    )
    told = [list(range(7)), list(range(7, 20))]
    np.testing.assert_array_equal(
        small.rows(["z1", "z3"]), whole.rows(["z1", "z3"])[:, :, whole.index(small.names)]
    )
    left, same = small.marginalise(base, told), whole.marginalise(base, told)
    at = same.index(left.names)
    np.testing.assert_allclose(left.total, same.total[np.ix_(at, at)], rtol=1e-12)
    width = whole.shared.width
    small.expand({"later": ("z1", np.arange(20.0))})
    assert whole.shared.width == width


def test_columns_that_join_merged_blocks_do_not_join_those_they_were_made_of():
    grams, base = row_case(2).grams, ["n0", "n1", "n2"]
    first = FactoredGrams.of(grams, base)
    padded, before = first.merged([], fits=3), first.total.copy()
    told = [list(range(7)), list(range(7, 20))]
    left, same = (one.marginalise(base, told) for one in (padded, first))
    np.testing.assert_allclose(left.total, same.total, rtol=1e-9, atol=1e-9)
    padded.expand({"later": ("z1", np.arange(20.0))})
    np.testing.assert_array_equal(FactoredGrams.total.func(first), before)
    first.expand({"other": ("z2", np.arange(20.0))})


def test_columns_join_factored_blocks_as_if_they_had_been_there():
    grams, base, fresh = row_case(1).grams, ["n0", "n1", "n2"], ["z3", "z4"]
    small = FactoredGrams.of(grams.select([name for name in grams.columns if name not in fresh]), base)
    places = grams.index(fresh)
    across = grams.gram[:, grams.index(small.names)][:, :, places]
    before = small.total.copy()
    assert small.squares.shape == (20, 9)
    late = small.bordered(fresh, grams.scale[places], across, grams.gram[:, places][:, :, places])
    assert late.names == grams.names
    told = [list(range(7)), list(range(7, 20))]
    left, whole = (one.marginalise(base, told) for one in (late, grams))
    np.testing.assert_allclose(left.total, whole.total, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(late.rows(fresh), grams.rows(fresh), rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(late.squares, grams.squares, rtol=1e-6)
    # What was there before does not see them.
    np.testing.assert_array_equal(small.total, before)


@pytest.mark.parametrize("base", [("z0", "z1"), ("z2", "z0"), ()])
def test_factored_blocks_of_rows_are_those_of_their_gram_matrices(base):
    g = np.random.default_rng(12)
    names, parts = ("z0", "z1", "z2", "z3", "residual"), [slice(0, 7_000), slice(7_000, 16_000)]
    columns, residual = g.normal(size=(16_000, 2, 4)), g.normal(size=(16_000, 2, 1))
    # Of one column little is left, and one is of another size.
    columns[:, :, 3] = columns[:, :, 0] - 2.0 * columns[:, :, 2] + 1e-4 * columns[:, :, 3]
    columns[:, :, 1] *= 1e4
    weight = g.uniform(0.0, 1.0, 16_000)
    weight[200:300] = 0.0
    span, scale = (np.array([0, 7]), np.array([7, 16])), np.arange(1.0, 6.0)
    made = FactoredGrams.of_rows(names, columns, residual, weight, parts, span, scale, base)
    count = np.array([2.0 * weight[part].sum() for part in parts])
    grams = GramArrays(names, gram_of(columns, residual, weight, parts), *span, count, scale)
    expected = FactoredGrams.of(grams, base)
    assert made.names == expected.names
    for name in ("places", "start", "end", "count", "scale", "begins"):
        np.testing.assert_array_equal(getattr(made, name), getattr(expected, name))
    every, size = np.arange(5), np.sqrt(grams.squares)
    np.testing.assert_allclose(
        made.rows(every) / size[:, None] / size[:, :, None], every_of(grams), atol=3e-7
    )
    left, whole = (one.marginalise(list(base), [[0, 1]]) for one in (made, grams))
    size = np.sqrt(np.diag(whole.total))
    np.testing.assert_allclose(
        left.total / size / size[:, None], whole.total / size / size[:, None], atol=1e-6
    )


def every_of(grams: GramArrays) -> np.ndarray:
    """Gram matrices of columns of size one."""
    size = np.sqrt(grams.squares)
    return grams.gram / size[:, None] / size[:, :, None]


def test_blocks_of_several_fits_are_put_into_one():
    days, base = row_case(2).grams, ["n0", "n1", "n2"]
    pairs = [FactoredGrams.of(days.of_blocks(np.arange(first, 20, 2)), base) for first in (0, 1)]
    one = pairs[0].merged(pairs[1:]).in_one_fit()
    wide = days.merge_groups([[block, block + 1] for block in range(0, 20, 2)])
    assert one.fits == 1
    np.testing.assert_allclose(one.rows(np.arange(11)), wide.gram, rtol=1e-5, atol=1e-3)
    left, whole = (two.marginalise(base) for two in (one, wide))
    np.testing.assert_allclose(left.total, whole.total, rtol=1e-5, atol=1e-3)


def test_blocks_of_several_days_are_those_of_their_days():
    days, base = row_case(2).grams, ["n0", "n1", "n2"]
    pairs = [days.of_blocks(np.arange(first, 20, 2)) for first in (0, 1)]
    first, *later = (FactoredGrams.of(one, base) for one in pairs)
    factored = first.merged(later, fits=3)
    wide = days.merge_groups([[block, block + 1] for block in range(0, 20, 2)])
    np.testing.assert_allclose(factored.rows(np.arange(11)), wide.gram, rtol=1e-5, atol=1e-3)
    daily = days.marginalise(base).merge_groups([[block, block + 1] for block in range(0, 20, 2)])
    np.testing.assert_allclose(factored.marginalise(base).total, daily.total, rtol=1e-5, atol=1e-3)
    groups = [list(range(4)), list(range(4, 10))]
    left, whole = (one.marginalise(base, groups) for one in (factored, wide))
    np.testing.assert_allclose(left.total, whole.total, rtol=1e-5, atol=1e-3)
    # The same after a visit to the disk, in parts.
    stored = factored.as_dataset()
    parts = [stored.isel(block=slice(0, 3)), stored.isel(block=slice(3, 10))]
    read = FactoredGrams.read(iter(parts), 10, days.names, days.scale, base)
    np.testing.assert_array_equal(read.rows(np.arange(11)), factored.rows(np.arange(11)))
    # Of some columns only: beside them the calibration's and the residual.
    some = FactoredGrams.read(iter(parts), 10, days.names, days.scale, base, {"z1", "n1"})
    assert some.names == tuple(name for name in days.names if name in {*base, "z1", "residual"})
    places = factored.index(some.names)
    np.testing.assert_array_equal(some.scale, days.scale[places])
    every = np.arange(len(some.names))
    np.testing.assert_allclose(some.rows(every), factored.rows(places, places), rtol=1e-12)


def test_a_sum_of_columns_and_a_function_of_the_block_join_factored_blocks():
    case, base = row_case(3), ["n0", "n1", "n2"]
    factor = np.linspace(-1.0, 2.0, 20)
    found = FactoredGrams.of(case.grams, base).with_combinations(["w"], [(0.5, ["z0"]), (-2.0, ["z1"])])
    found = found.expand({"d": ("z2", factor), "e": ("n1", factor)})
    scale = dict(zip(case.grams.names, case.grams.scale, strict=True))
    z0, z1, z2, n1 = (case.of(name)[:, :, 0] for name in ("z0", "z1", "z2", "n1"))
    own = np.stack([0.5 * z0 - 2.0 * z1, z2 * factor[:, None], n1 * factor[:, None]], axis=2)
    np.testing.assert_allclose(
        found.rows(["w", "d", "e"], ["w", "d", "e"]),
        np.einsum("bri,brj->bij", own, own),
        rtol=1e-5,
        atol=1e-4,
    )
    assert found.scale[found.index(["w", "d", "e"])].tolist() == [scale["z0"], scale["z2"], scale["n1"]]
