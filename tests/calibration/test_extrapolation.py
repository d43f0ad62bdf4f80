"""How uncertain a table is outside the span it was learnt from: its own changes, over as long."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from inflight.calibration.extrapolation import (
    change_outside,
    expected_change,
    held_table,
    outside_learnt,
    with_changes,
    with_learnt_spans,
)
from inflight.errors import CalibrationError
from inflight.time import DAY

NAMES = ["scale", "offset"]


def table_of(values: np.ndarray, *, learnt: np.ndarray | None = None) -> xr.Dataset:
    """Return a table of rows of one day each, values (interval, parameter)."""
    start = DAY * np.arange(len(values))
    has = np.ones(len(values), dtype=bool) if learnt is None else learnt
    table = xr.Dataset(
        {
            "value": (("interval", "parameter"), values),
            "covariance": (("interval", "parameter", "other"), np.zeros((len(values), 2, 2))),
            "prior_sigma": ("parameter", [0.3, 7.0]),
            "start": ("interval", start),
            "end": ("interval", start + DAY),
        },
        coords={"parameter": NAMES, "other": NAMES},
    )
    return with_learnt_spans(table, start, np.where(has, start + DAY, start))


def test_a_steady_drift_is_what_the_uncertainty_grows_by():
    table = with_changes(table_of(np.arange(20.0)[:, None] * [1.0, -0.5]))
    for days in (0.5, 1.0, 8.0, 40.0):
        expected = np.array([1.0, 0.5]) * days
        found = expected_change(table, days * DAY, NAMES)
        # Between 0 and the first distance it is what a random walk would do.
        assert_allclose(found, expected if days >= 1 else expected * np.sqrt(2), rtol=1e-9)
        assert_allclose(expected_change(table, -days * DAY, NAMES[::-1]), found[::-1])


@pytest.mark.parametrize("reach", [3, 15, 60])
def test_a_random_walk_stays_within_what_is_stated(reach):
    generator, taught, runs = np.random.default_rng(7), 16, 600
    walks = np.cumsum(generator.normal(0, 1, (runs, taught + reach, 2)), axis=1)
    inside = 0
    for walk in walks:
        table = with_changes(table_of(walk[:taught]))
        sigma = expected_change(table, reach * DAY, NAMES)
        inside += np.count_nonzero(np.abs(walk[taught + reach - 1] - walk[taught - 1]) < sigma)
    # One sigma of a normal error holds 68 %; sixteen rows do not tell it exactly.
    assert inside / (2 * runs) > 0.6


def test_a_table_of_few_rows_takes_the_changes_of_a_finer_one_or_the_prior():
    span, daily = table_of(np.ones((1, 2))), table_of(np.arange(5.0)[:, None] * [1.0, 2.0])
    assert_allclose(expected_change(with_changes(span, [span, daily]), 2 * DAY, NAMES), [2.0, 4.0])
    assert_allclose(expected_change(with_changes(span), 2 * DAY, NAMES), [0.3, 7.0])


def test_only_what_is_outside_the_span_that_taught_it_is_extrapolated():
    table = with_changes(table_of(np.arange(4.0)[:, None] * [1.0, 1.0]))
    row = table.isel(interval=1)
    assert change_outside(row, table, (DAY, 2 * DAY), NAMES) is None
    # Its middle is a day and a half from the farthest sample; squares go from 1 to 4 in two days.
    assert_allclose(change_outside(row, table, (DAY, 3 * DAY), NAMES), np.sqrt([2.5, 2.5]))
    assert outside_learnt(row, np.array([DAY - 1, DAY, 2 * DAY - 1, 2 * DAY])).tolist() == [1, 0, 0, 1]


def test_a_row_that_nothing_taught_holds_the_prior_and_is_not_extrapolated():
    table = table_of(np.arange(4.0)[:, None] * [1.0, 1.0], learnt=np.array([True, True, True, False]))
    row = table.isel(interval=3)
    assert change_outside(row, table, (3 * DAY, 4 * DAY), NAMES) is None
    assert not outside_learnt(row, np.array([3 * DAY])).any()


def test_a_held_table_goes_on_with_the_nearest_row_before_that_was_taught():
    table = table_of(np.arange(4.0)[:, None] * [1.0, 1.0], learnt=np.array([True, True, True, False]))
    gappy = table.isel(interval=[0, 2, 3])
    held = held_table(gappy, -DAY, 6 * DAY)
    assert held["value"].values[:, 0].tolist() == [0, 0, 0, 2, 3, 2]
    assert (held["start"].values / DAY).tolist() == [-1, 0, 1, 2, 3, 4]
    assert (held["end"].values / DAY).tolist() == [0, 1, 2, 3, 4, 6]
    assert (held["learnt_start"].values / DAY).tolist() == [0, 0, 0, 2, 3, 2]
    xr.testing.assert_identical(held_table(table, 0, 4 * DAY), table)
    with pytest.raises(CalibrationError, match="learnt from"):
        held_table(table.drop_vars("learnt_start"), 0, 9 * DAY)
