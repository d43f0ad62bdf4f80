"""Steps near the edge of a calibration interval, whose own parameters take up most of them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import DAY, NOISE_NT, POLAR, SECOND, STEP_S, case_of, flight_of, read
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.diagnosis.search import intervals_around
from inflight.lsq import GramArrays
from inflight.time import parse_utc, to_tt2000

DAYS, INTERVAL_DAYS, BLOCK_DAYS = 14, 7, 0.25
#: An hour and a half, or four, before the edge between the two intervals; and the edge itself.
NEAR_DAYS, NEARER_DAYS = INTERVAL_DAYS - 4 / 24, INTERVAL_DAYS - 1.5 / 24
ANGLE_DEG = 0.004


@lru_cache(maxsize=1)
def stepped():
    """Residuals of a step of one angle near the edge, nearer, on the edge; and of nothing."""
    flight = flight_of(POLAR, DAYS)
    days = STEP_S * np.arange(flight.tt2000.size) / 86_400
    turned = np.deg2rad(ANGLE_DEG) * flight["field"][:, [2]] * np.array([1.0, 0.0, 0.0])
    moments = (NEAR_DAYS, NEARER_DAYS, INTERVAL_DAYS, DAYS)
    hidden = [read(flight, 20 + seed, turned * (days >= at)[:, None]) for seed, at in enumerate(moments)]
    return case_of(flight, hidden, block_days=BLOCK_DAYS, channels=("heater_current", "boom_temperature"))


@lru_cache(maxsize=4)
def told_of(residual):
    return stepped().diagnose(residual, interval_days=INTERVAL_DAYS, draws=500)


@pytest.mark.parametrize(("residual", "days"), [(0, NEAR_DAYS), (1, NEARER_DAYS)])
def test_a_step_near_the_edge_of_an_interval_is_found(residual, days):
    told = told_of(residual)
    (effect,) = told.effects
    assert told.verdict == "FOUND", told.sentence
    assert effect.name.startswith("angle_step@")
    first = int(stepped().flight.tt2000[0])
    off = abs(int(to_tt2000(parse_utc(effect.at[0]))) - first - days * DAY) / SECOND
    assert off <= 4 * effect.at_sigma_s + STEP_S
    for one in effect.coefficients:
        truth = ANGLE_DEG if one.name == "misalignment[xz]" else 0.0
        assert abs(one.value - truth) < 4 * one.sigma


def test_the_sizes_before_are_those_of_the_intervals_asked_for():
    told, case = told_of(0), stepped()
    search = case.search(0, interval_days=INTERVAL_DAYS)
    form, y = search.forms["raw"], search.y()
    before = np.sqrt(form.total[y, y] / form.count.sum())
    assert told.residual["before_nT"] == pytest.approx(before, rel=0.01)
    assert told.residual["held_out_after_nT"] < 1.02 * NOISE_NT
    assert told.remaining["verdict"] == "NOTHING_LEFT"


def test_a_step_on_the_edge_of_an_interval_is_said_to_be_hidden():
    told = told_of(2)
    assert not told.effects, told.sentence
    assert told.verdict == "NOTHING_LEFT"
    hidden = [one for one in told.unscorable if "edge of a calibration interval" in one["reason"]]
    assert [one["family"] for one in hidden] == ["sensor"]


def test_of_noise_nothing_is_said_to_step():
    told = told_of(3)
    assert not told.effects
    assert not [one for one in told.unscorable if "edge of a calibration interval" in one["reason"]]


def test_intervals_are_those_asked_for_once_a_step_is_dropped():
    search = stepped().search(0, interval_days=INTERVAL_DAYS, draws=100)
    asked = search.intervals
    step = next(
        one
        for one in search.table().options
        if one.change
        and one.change.at
        and one.family == "sensor"
        and abs(one.change.at[0] - int(search.raw.start[asked[1][0]])) <= BLOCK_DAYS * DAY
    )
    search = search.add(step)
    assert search.intervals != asked
    assert search.as_found().intervals == asked
    assert search.drop(step).intervals == asked


# The cuts themselves.


def blocks(count):
    edges = np.arange(count + 1, dtype=np.int64) * DAY
    empty = GramArrays(
        ("residual",), np.zeros((count, 1, 1)), edges[:-1], edges[1:], np.ones(count), np.ones(1)
    )
    return replace(empty)


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 6), st.integers(1, 12), st.lists(st.floats(0.0, 60.0), max_size=3))
def test_intervals_hold_every_block_once_and_keep_their_edges_away(count, width, moments):
    evidence = blocks(count * width)
    cut = [list(range(at, at + width)) for at in range(0, count * width, width)]
    at = [int(moment * DAY) for moment in moments]
    found = intervals_around(evidence, cut, at)
    assert [block for group in found for block in group] == list(range(count * width))
    for group in found[1:]:
        edge = int(evidence.start[group[0]])
        assert all(abs(edge - moment) >= 0.25 * width * DAY for moment in at)


def test_an_edge_near_a_moment_goes_half_an_interval_to_both_sides():
    cut = [list(range(at, at + 8)) for at in (0, 8, 16)]
    found = intervals_around(blocks(24), cut, [int(8.5 * DAY)])
    assert [group[0] for group in found] == [0, 4, 12, 16]


def test_intervals_of_one_block_stay_together_around_a_moment():
    cut = [[at] for at in range(6)]
    assert intervals_around(blocks(6), cut, [3 * DAY]) == [[0], [1], [2, 3], [4], [5]]
