"""Parts of a correction: a share of it, and what of it is quick."""

import numpy as np
import pytest
from plain_correction import plain

from inflight.dual import (
    WHOLE,
    AppliedPart,
    Readings,
    applied_part_to_dataset,
    omits_slow_part,
    partial_correction,
    slow_part_of_day,
)
from inflight.dual.correction import slow_in_window, slow_part, slow_part_of
from inflight.time import SECOND


def readings_of(count, first=0):
    random = np.random.default_rng(1)
    fields = random.normal(size=(2, count, 3))
    return Readings((np.arange(count) + first) * 2 * SECOND, *fields)


def test_a_share_has_an_error_that_holds_the_rest():
    field = np.zeros((3, 3))
    field[1, 0] = 2.0
    part = partial_correction(plain(field), AppliedPart(0.7), slope_error=0.3)
    assert part.field[1, 0] == pytest.approx(1.4)
    assert part.sigma[1, 0] == pytest.approx(np.hypot(0.6, 0.007))
    assert part.sigma[0, 0] == pytest.approx(0.007)


def test_the_whole_is_returned_as_it_is():
    whole = plain(np.ones((3, 3)))
    assert partial_correction(whole, WHOLE, slope_error=0.3) is whole


def test_what_is_left_alone_is_an_error_and_the_constant_is_no_longer_known():
    count = 400
    slow = np.linspace(-1.0, 1.0, count)[:, None] * np.ones(3)
    quick = np.where(np.arange(count) % 20 < 10, 0.5, -0.5)[:, None] * np.ones(3)
    whole, readings = plain(5.0 + slow + quick, constant_known=True), readings_of(count)
    part = AppliedPart(1.0, 80.0)
    found = partial_correction(whole, part, 0.0, slow_part_of(whole, readings, part.seconds))
    inside = slice(60, -60)
    assert found.field[inside] == pytest.approx(quick[inside], abs=0.05)
    assert found.sigma[inside] == pytest.approx(np.hypot(0.01, np.abs(slow[inside])), abs=0.03)
    assert not found.constant_known


def test_no_frequency_is_left_with_more_than_it_had():
    impulse = np.zeros((4097, 1))
    impulse[2048] = 1.0
    response = np.abs(np.fft.rfft((impulse - slow_part(impulse, 64))[:, 0]))
    assert response.max() < 1.0 + 1e-9


def test_samples_that_are_not_known_stay_so():
    field = np.ones((50, 3))
    field[10:20] = np.nan
    whole, readings = plain(field), readings_of(50)
    found = partial_correction(whole, AppliedPart(0.5, 20.0), 0.0, slow_part_of(whole, readings, 20.0))
    assert np.array_equal(found.known, whole.known)
    assert np.isnan(found.sigma[10:20]).all()


def test_days_find_the_slow_part_of_their_window_and_do_not_step_between_them():
    count = 8000
    random = np.random.default_rng(2)
    field = np.cumsum(random.normal(0.0, 0.02, (count, 3)), axis=0)
    whole, readings = plain(field), readings_of(count)
    table = applied_part_to_dataset(whole, readings, AppliedPart(1.0, 2000.0), np.zeros(3))
    assert omits_slow_part(table)
    parts = []
    for rows in (slice(0, 4000), slice(4000, count)):
        parts.append(slow_in_window(table, plain(field[rows]), readings.select(rows), 2000.0, np.zeros(3)))
    expected = slow_part_of(whole, readings, 2000.0)
    assert np.concatenate(parts) == pytest.approx(expected, abs=0.02 * expected.std())
    # By itself each day would step at midnight.
    alone = slow_part_of(plain(field[:4000]), readings.select(slice(0, 4000)), 2000.0)
    assert np.abs(alone[-1] - expected[3999]).max() > 0.05


@pytest.mark.parametrize("part", [AppliedPart(0.7), AppliedPart(1.0, 400.0)])
def test_a_day_has_the_error_that_it_has_in_its_window(part):
    # A unit that is on for the whole second day is no constant.
    field = np.repeat([0.0, 1.0, 0.0, 0.0], 1000)[:, None] * np.ones(3)
    whole, readings, nothing = plain(field), readings_of(4000), np.zeros(3)
    table = applied_part_to_dataset(whole, readings, part, nothing)
    of_window = partial_correction(whole, part, 0.3, slow_part_of(whole, readings, part.seconds))
    rows = slice(1000, 2000)
    day, of_day = plain(field[rows]), readings.select(rows)
    found = partial_correction(day, part, 0.3, *slow_part_of_day(table, day, of_day, part, nothing))
    assert found.field == pytest.approx(of_window.field[rows], abs=0.01)
    assert found.sigma == pytest.approx(of_window.sigma[rows], abs=0.01)
    assert np.median(found.sigma) > 0.25


def test_a_constant_that_a_window_took_over_is_no_matter_of_the_share():
    field = np.repeat([5.0, 7.0, 5.0], 100)[:, None] * np.ones(3)
    found = partial_correction(plain(field, constant_known=True), AppliedPart(0.5), slope_error=0.5)
    assert found.field[0] == pytest.approx(5.0 * np.ones(3))
    assert found.field[150] == pytest.approx(6.0 * np.ones(3))
    assert found.sigma[150] == pytest.approx(np.ones(3), rel=0.01)
    assert found.constant_known


def test_a_day_outside_of_the_window_goes_by_itself():
    whole, readings = plain(np.random.default_rng(3).normal(size=(500, 3))), readings_of(500)
    table = applied_part_to_dataset(whole, readings, AppliedPart(1.0, 100.0), np.zeros(3))
    later = readings_of(500, first=100_000)
    assert slow_in_window(table, whole, later, 100.0, np.zeros(3)) == pytest.approx(
        slow_part_of(whole, later, 100.0)
    )


def test_parts_are_told_in_words():
    assert str(AppliedPart(0.7)) == "0.70 of it"
    assert str(AppliedPart(1.0, 7200.0)) == "all of what changes within 2.0 h"
    assert str(AppliedPart(0.5, 90.0)) == "0.50 of what changes within 90 s"
