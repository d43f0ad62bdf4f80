"""What changes at a moment: the right parameter is named, with a time that says how sharp it is."""

from functools import lru_cache

import numpy as np
import pytest
from diagnosis_cases import DAY, NOISE_NT, POLAR, SECOND, STEP_S, case_of, flight_of, read

from inflight.diagnosis import TimeVariableColumns, batch_changes, drifts, episodes, steps
from inflight.diagnosis.refine import refine_change_time
from inflight.diagnosis.search import Option
from inflight.diagnosis.time_changes import Change, ChangeSettings, time_text
from inflight.residual import format_period
from inflight.time import parse_utc, to_tt2000

DAYS, BLOCK_DAYS = 14, 0.25
#: No edge of a block: the search can only come near.
AT_DAYS = 8.1
ANGLE_DEG, SCALE, SHIFT_S = 0.002, 2e-5, 0.02


def after(flight):
    """1 from the moment on; (time,)."""
    return (STEP_S * np.arange(flight.tt2000.size) >= AT_DAYS * 86_400) * 1.0


@lru_cache(maxsize=1)
def stepped():
    """Residuals of a step of one angle, of one scale factor, and of the clock."""
    flight = flight_of(POLAR, DAYS)
    step = after(flight)[:, None]
    field = flight["field"]
    angle = np.deg2rad(ANGLE_DEG) * field[:, [2]] * np.array([1.0, 0.0, 0.0])
    scale = SCALE * field * np.array([0.0, 0.0, 1.0])
    strength = np.linalg.norm(field, axis=1)
    clock = SHIFT_S * np.gradient(strength, STEP_S) * step[:, 0]
    hidden = [read(flight, 1, angle * step), read(flight, 2, scale * step), read(flight, 3, 0.0, -clock)]
    return case_of(flight, hidden, block_days=BLOCK_DAYS, channels=("heater_current", "boom_temperature"))


@lru_cache(maxsize=3)
def told_of(residual):
    return stepped().diagnose(residual, draws=500)


def only_effect(residual):
    told = told_of(residual)
    assert len(told.effects) == 1, told.sentence
    return told.effects[0]


def test_a_step_of_an_angle_is_found_as_such_and_not_as_a_clock():
    told, effect = told_of(0), only_effect(0)
    assert effect.name.startswith("angle_step@"), told.sentence
    assert effect.family == "sensor"
    assert effect.axes == ("xz",)
    for one in effect.coefficients:
        truth = ANGLE_DEG if one.name == "misalignment[xz]" else 0.0
        assert abs(one.value - truth) < 4 * one.sigma
        assert (one.unit, one.at) == ("deg", "fgm")


def test_a_step_of_a_scale_is_none_of_an_angle():
    effect = only_effect(1)
    assert effect.name.startswith("scale_step@")
    found = {one.name: one for one in effect.coefficients}
    assert -found["scale_factor[z]"].value == pytest.approx(SCALE, rel=0.1)
    assert found["scale_factor[z]"].unit == "1"


def test_a_step_of_the_clock_is_still_one():
    effect = only_effect(2)
    assert effect.name.startswith("clock_step@")
    assert abs(effect.coefficients[0].value) == pytest.approx(SHIFT_S, rel=0.1)


@pytest.mark.parametrize("residual", [0, 1, 2])
def test_the_moment_is_told_with_how_sharp_it_is(residual):
    case, effect = stepped(), only_effect(residual)
    truth = int(case.flight.tt2000[0]) + int(AT_DAYS * DAY)
    off = abs(int(to_tt2000(parse_utc(effect.at[0]))) - truth) / SECOND
    # Samples are two minutes apart, and a change shows in the first one behind it.
    assert off <= 3 * effect.at_sigma_s + 0.5 * STEP_S
    assert STEP_S / 12**0.5 < effect.at_sigma_s < 0.1 * BLOCK_DAYS * 86_400
    told = told_of(residual)
    when = effect.at[0].rstrip("Z").replace("T", " ")
    assert f"{when} UTC +- {format_period(effect.at_sigma_s)}" in told.sentence
    assert told.as_json()["effects"][0]["at_sigma_s"] == effect.at_sigma_s


@pytest.mark.parametrize("residual", [0, 1, 2])
def test_a_change_at_its_moment_leaves_the_noise(residual):
    told = told_of(residual)
    assert told.residual["held_out_after_nT"] < 1.02 * NOISE_NT
    assert told.remaining["verdict"] == "NOTHING_LEFT"


def test_a_drift_has_no_moment():
    search = stepped().search()
    made = {one.name: one for one in drifts(search.raw, search.time_variable)}
    assert {"scale_drift", "offset_drift", "angle_drift", "clock_drift"} <= set(made)
    assert all(one.at == () for one in made.values())
    assert {name: len(one.functions) for name, one in made.items() if name != "bias_drift"} == {
        "scale_drift": 3,
        "offset_drift": 3,
        "angle_drift": 3,
        "clock_drift": 1,
    }


def test_what_lasts_to_an_end_of_the_record_is_a_step():
    search = stepped().search(1)
    lone = TimeVariableColumns(clock=search.time_variable.clock)
    found = episodes(search.raw, search.forms["raw"], lone, search.y())
    record = int(search.raw.start[0]), int(search.raw.end[-1])
    assert all(not set(one.at) & set(record) for one in found)
    for one in found:
        if len(one.at) == 1:
            assert "_step@" in one.name
            inside = next(iter(one.functions.values()))[1]
            assert inside[0] == 0.0
            assert inside[-1] == 1.0
    assert any(len(one.at) == 1 for one in found)


def test_changes_looked_at_in_batches_are_all_changes_held_out_alike():
    search = stepped().search()
    found = drifts(search.raw, search.time_variable) + steps(search.raw, search.time_variable)
    lone = TimeVariableColumns(clock=search.time_variable.clock)
    found += episodes(search.raw, search.forms["raw"], lone, search.y())
    parts = list(batch_changes(found))
    assert sorted(one.name for part in parts for one in part) == sorted(one.name for one in found)
    assert all(len({one.interleaved for one in part}) == 1 for part in parts)
    assert len(parts) > 3


def test_a_batch_scores_what_all_changes_together_score(monkeypatch):
    apart = stepped().search(draws=50).table()
    monkeypatch.setattr(
        "inflight.diagnosis.time_changes.CHANGE_SETTINGS", ChangeSettings(batch_columns=10_000)
    )
    whole = stepped().search(draws=50).table()
    assert {one.name for one in apart.options} == {one.name for one in whole.options}
    place = {one.name: at for at, one in enumerate(whole.options)}
    order = [place[one.name] for one in apart.options]
    for form, scores in apart.scores.items():
        np.testing.assert_allclose(scores.gain, whole.scores[form].gain[order], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(apart.p[form], whole.p[form][order])


# Episodes, and what moves a moment.

FROM_DAYS, TO_DAYS = 5.13, 8.37


@lru_cache(maxsize=1)
def visited():
    """Residual of a clock that is wrong for three days, from and until moments within blocks."""
    flight = flight_of(POLAR, DAYS)
    days = STEP_S * np.arange(flight.tt2000.size) / 86_400
    strength = np.linalg.norm(flight["field"], axis=1)
    early = SHIFT_S * np.gradient(strength, STEP_S) * ((days >= FROM_DAYS) & (days < TO_DAYS))
    return case_of(
        flight, [read(flight, 4, 0.0, -early)], block_days=BLOCK_DAYS, channels=("heater_current",)
    )


def test_begin_and_end_of_an_episode_are_found_with_their_error():
    case = visited()
    told = case.diagnose(0, draws=500)
    (effect,) = told.effects
    assert effect.name.startswith("clock_episode@"), told.sentence
    first = int(case.flight.tt2000[0])
    for at, truth in zip(effect.at, (FROM_DAYS, TO_DAYS), strict=True):
        off = abs(int(to_tt2000(parse_utc(at))) - first - truth * DAY) / SECOND
        assert off <= 3 * effect.at_sigma_s + 0.5 * STEP_S
    assert effect.at_sigma_s < 1800
    assert told.residual["held_out_after_nT"] < 1.02 * NOISE_NT
    assert told.remaining["verdict"] == "NOTHING_LEFT"


def put_to_its_moment():
    """A search that took a clock step at an edge, and the same at its moment instead."""
    case = stepped()
    search, material = case.search(2), case.material(2)
    at_edge = next(one for one in search.table().options if one.name == "clock_step@2024-03-09T00:00:00")
    search, exact = refine_change_time(search.add(at_edge), material, at_edge)
    search = search.drop(at_edge).add(exact)
    return search, material, at_edge, exact


def test_whatever_may_change_is_held_against_a_step_at_the_same_moment():
    search, _, _, exact = put_to_its_moment()
    when = exact.name.partition("@")[2]
    offered = {one.name for one in search.table(without=exact).options}
    assert {f"{kind}_step@{when}" for kind in ("offset", "scale", "angle", "clock")} <= offered


def test_a_moment_that_is_found_already_stays():
    search, material, _, exact = put_to_its_moment()
    assert refine_change_time(search, material, exact)[1] is exact


def test_a_change_that_comes_back_knows_the_columns_that_joined_meanwhile():
    search, _, at_edge, exact = put_to_its_moment()
    search = search.drop(exact).add(at_edge)
    one, other = search.raw.index([*at_edge.columns, *exact.columns])
    total = search.raw.total
    assert total[one, other] ** 2 > 0.9 * total[one, one] * total[other, other]


def test_an_episode_that_turns_out_to_reach_the_end_of_the_record_comes_back_as_a_step():
    case = stepped()
    search, material = case.search(2), case.material(2)
    block, end = int(BLOCK_DAYS * DAY), int(search.raw.end[-1])
    begin = int(search.raw.start[np.searchsorted(search.raw.end, material.series.tt2000[0] + AT_DAYS * DAY)])
    inside = ((search.raw.start >= begin) & (search.raw.start < end - block)) * 1.0
    name = "clock_episode@tried"
    change = Change(
        name,
        "clock_episode",
        "clock",
        {f"{name}.seconds": (search.time_variable.clock[0], inside)},
        (begin, end - block),
        sharpness=block,
    )
    option = Option(
        name=name, mechanism=change.mechanism, family="clock", columns=tuple(change.functions), change=change
    )
    told = refine_change_time(search.add(option), material, option)[1]
    assert told.mechanism == "clock_step"
    (when,) = told.change.at
    assert abs(when - material.series.tt2000[0] - AT_DAYS * DAY) < 3 * told.change.sharpness
    assert told.name == f"clock_step@{time_text(when)}"
