"""What a diagnosis says: why nothing can be told, what switches where, what was left out."""

from dataclasses import replace

import numpy as np
import pytest

from inflight.diagnosis import Signature
from inflight.diagnosis.residual import dominant_blocks
from inflight.diagnosis.result import (
    LEFT,
    Coefficient,
    Entry,
    FoundEffect,
    ranked_entries,
    sentence,
    stop_reason,
)
from inflight.diagnosis.search import Rules
from inflight.diagnosis.verdict import of_one_direction, of_one_response
from inflight.lsq import GramArrays
from inflight.time import SECOND

SIZES = {"held_out_before_nT": 0.2, "held_out_after_nT": 0.2, "noise_floor_nT": 0.198, "structure_nT": 0.01}
SWITCH = Signature(
    period_s=2231.0,
    axis="z",
    shape="square",
    amplitude_nT=0.201,
    duty=0.3,
    amplitudes={"x": (0.055, 0.007), "y": (0.024, 0.026), "z": (0.201, 0.005)},
    steps={"x": (0.099, 0.004), "y": (0.01, 0.015), "z": (0.399, 0.003)},
)

LINE = Signature(period_s=5640.0, axis="z", shape="sine", amplitude_nT=0.1, amplitudes={"z": (0.1, 0.01)})


def effect(rms, name="solar", **more):
    plain = {
        "name": name,
        "family": "solar",
        "channels": ("solar_current",),
        "axes": ("x",),
        "coefficients": (),
        "gain": 0.5,
        "t": 9.0,
        "flip_p": 0.01,
        "retained": 0.9,
        "lag_s": 0.0,
        "lag_sigma_s": None,
        "placebo_t": 9.0,
        "consistency": None,
        "rms_nT": rms,
    }
    return FoundEffect(**(plain | more))


def hour(place):
    return f"2010-03-01T{place:02d}:00:00Z"


def block(place, part=0.4):
    return {"start": hour(place), "end": hour(place + 1), "part": part}


def told(remaining, **more):
    plain = {
        "effects": (),
        "signature": None,
        "residual": SIZES,
        "remaining": remaining,
        "blocks": {"count": 90, "by_length": 90.0, "telling": 90.0, "independent": 90.0, "holding": []},
        "outliers": {},
        "unscorable": (),
        "fewest": 20,
    }
    return plain | more


def blocks(by_length, telling, holding=()):
    return {
        "count": 90,
        "by_length": by_length,
        "telling": telling,
        "independent": min(by_length, telling),
        "holding": list(holding),
    }


def test_a_short_span_is_said_to_be_short():
    said = sentence(told("NOT_IDENTIFIABLE", blocks=blocks(8.0, 8.0)))
    assert "too short to say what: 8 independent blocks" in said


def test_a_long_span_of_which_few_blocks_tell_is_not_said_to_be_short_but_when_they_were():
    holding = [block(4), block(5), block(9, 0.2)]
    given = told("NOT_IDENTIFIABLE", blocks=blocks(90.0, 2.9, holding))
    for said in (sentence(given), stop_reason(given, 8, False)):
        assert "short" not in said
        assert "3 of 90 blocks hold nearly all of the residual's square" in said
        assert "2010-03-01 04:00 to 2010-03-01 06:00; 2010-03-01 09:00 to 2010-03-01 10:00" in said


def test_the_blocks_that_hold_nearly_all_are_the_fewest_in_order_of_time():
    hours = 700_000_000 * SECOND + 3600 * SECOND * np.arange(91)
    evidence = GramArrays(("residual",), np.ones((90, 1, 1)), hours[:-1], hours[1:], np.ones(90), np.ones(1))
    square = np.full(90, 0.1)
    assert dominant_blocks(evidence, square) == []
    square[[40, 12]] = 300.0, 400.0
    found = dominant_blocks(evidence, square)
    assert [one["part"] for one in found] == pytest.approx([400 / square.sum(), 300 / square.sum()])
    assert found[0]["start"] < found[0]["end"] < found[1]["start"]


def test_a_long_span_that_tells_evenly_is_told_of_doubt():
    said = sentence(told("NOT_IDENTIFIABLE"))
    assert "short" not in said
    assert "not beyond doubt" in said


def test_a_switch_is_said_with_every_axis_that_stands_out_its_steps_and_what_the_amplitude_is():
    said = sentence(told("UNKNOWN_EFFECT", signature=SWITCH))
    assert "axes z (0.201 nT) and x (0.055 nT), half of peak to peak" in said
    assert "on 30% of the time: +0.399 nT on z and +0.099 nT on x" in said
    assert " y" not in said


def test_an_axis_below_three_sigma_is_not_named():
    one = Signature(**(vars(SWITCH) | {"amplitudes": {"x": (0.055, 0.02), "z": (0.201, 0.005)}, "steps": {}}))
    assert "on axis z (0.201 nT), half" in sentence(told("UNKNOWN_EFFECT", signature=one))


def test_what_is_fast_is_not_called_slow():
    one = Signature(shape="fast", amplitude_nT=0.173, faster_than_s=48.0)
    said = sentence(told("UNKNOWN_EFFECT", signature=one))
    assert "something faster than 48 s, about 0.173 nT rms" in said
    assert "slow" not in said
    banded = Signature(**(vars(one) | {"periods_s": (43.9, 47.6)}))
    assert "periods of 43.9 to 47.6 s" in sentence(told("UNKNOWN_EFFECT", signature=banded))


@pytest.mark.parametrize(("structure", "rms", "doubted"), [(0.04, 0.05, True), (0.01, 0.05, False)])
def test_effects_beside_as_much_structure_may_stand_in_for_another(structure, rms, doubted):
    given = told(
        "UNKNOWN_EFFECT",
        effects=(effect(0.3), effect(rms)),
        signature=Signature(shape="wander", amplitude_nT=structure),
        residual=SIZES | {"structure_nT": structure},
    )
    said = sentence(given)
    assert ("may stand in" in said) is doubted
    assert ("Slow structure of 0.04 nT is left, and solar takes off 0.05 nT" in said) is doubted


def test_the_largest_comes_first_whatever_took_it():
    found = effect(0.05, "small"), effect(0.3, "large")
    said = ranked_entries(told("NOTHING_LEFT", effects=found))
    assert [one.name for one in said] == ["large", "small"]
    assert said[0].command == 'inflight add "large"'


def test_what_is_left_stands_in_its_place_by_size_and_leads_when_it_is_the_largest():
    left = Signature(shape="wander", amplitude_nT=0.1)
    found = effect(0.05, "small"), effect(0.3, "large")
    given = told("UNKNOWN_EFFECT", effects=found, signature=left, residual=SIZES | {"structure_nT": 0.1})
    assert [one.name for one in ranked_entries(given)] == ["large", LEFT, "small"]
    assert sentence(given).startswith("A solar effect")
    given["residual"] = SIZES | {"structure_nT": 0.5}
    said = ranked_entries(given)
    assert [one.name for one in said] == [LEFT, "large", "small"]
    assert (said[0].verdict, said[0].takes_off_nT) == ("UNKNOWN_EFFECT", 0.5)
    assert sentence(given).startswith("Most of what is there no effect of the library explains")


def test_a_number_of_the_model_that_data_contradict_is_told_with_how_far_it_is_off():
    wrong = {"name": "torquer.matrix[yy]", "moved": -3.0, "sigma": 0.01, "known": 0.3, "rms_nT": 0.12}
    right = wrong | {"name": "torquer.matrix[xx]", "moved": 0.1, "wrong": False}
    given = told("NOTHING_LEFT", refined=[wrong | {"wrong": True}, right])
    (entry,) = ranked_entries(given)
    assert (entry.name, entry.status, entry.takes_off_nT) == ("torquer.matrix", "sure", 0.12)
    assert "torquer.matrix[yy], off by -3 +- 0.01, 10.0 times the sigma it states" in sentence(given)
    assert not ranked_entries(told("NOTHING_LEFT", refined=[right]))


def test_an_effect_beside_one_of_the_model_names_it():
    said = sentence(told("NOTHING_LEFT", effects=(effect(0.1, model_effects=("panels",)),)))
    assert "beside panels of the model, whose numbers or response may be what is wrong" in said


def test_what_is_left_is_not_told_larger_than_all_that_is_left():
    switches = Signature(**(vars(SWITCH) | {"switchings": 3, "period_s": None}))
    (left,) = ranked_entries(told("UNKNOWN_EFFECT", signature=switches, residual=SIZES))
    assert left.takes_off_nT == pytest.approx(np.hypot(0.2, 0.0) * np.sqrt(1 - (0.198 / 0.2) ** 2))


def test_what_is_left_beside_effects_and_is_not_sure_comes_last():
    given = told("NOT_IDENTIFIABLE", effects=(effect(0.6),), residual=SIZES | {"structure_nT": 0.5})
    assert [one.status for one in ranked_entries(given)] == ["sure", "weak"]


@pytest.mark.parametrize("remaining", ["NOT_IDENTIFIABLE", "UNKNOWN_EFFECT"])
def test_what_explains_no_more_than_what_has_no_cause_may_be_a_part_of_it(remaining):
    given = told(remaining, effects=(effect(0.01), effect(0.6)), residual=SIZES | {"structure_nT": 0.5})
    status = {one.takes_off_nT: one.status for one in ranked_entries(given)}
    assert (status[0.01], status[0.6]) == ("stand-in", "sure")


def test_beside_a_line_or_how_the_calibration_changes_in_time_a_small_effect_is_sure():
    line = told("UNKNOWN_EFFECT", effects=(effect(0.01),), signature=SWITCH, residual=SIZES)
    assert {one.status for one in ranked_entries(line)} == {"sure", "unknown"}
    drift = effect(0.6, name="wander(offset[x], 1 d)", status="unknown")
    assert {one.status for one in ranked_entries(told("NOTHING_LEFT", effects=(effect(0.01), drift)))} == {
        "sure",
        "unknown",
    }


@pytest.mark.parametrize(("rms", "status"), [(0.01, "stand-in"), (0.05, "stand-in"), (0.2, "sure")])
def test_an_effect_of_the_period_of_what_is_left_may_be_a_part_of_it(rms, status):
    """Unless it explains so much more that its channel would be nearly that of the cause."""
    line = told("UNKNOWN_EFFECT", effects=(effect(rms, shares_line=True),), signature=LINE, residual=SIZES)
    assert {one.status for one in ranked_entries(line)} == {status, "unknown"}


def test_an_effect_says_what_is_left_follows():
    one = effect(0.1, left_follows="channel_scale(heater)", status="stand-in")
    said = sentence(told("UNKNOWN_EFFECT", effects=(one,), residual=SIZES))
    assert "what is left follows channel_scale(heater), so that it may stand in for another form" in said
    said = sentence(told("UNKNOWN_EFFECT", effects=(replace(one, status="sure"),), residual=SIZES))
    assert "what is left follows channel_scale(heater), so that its form is nearly right" in said
    one = effect(0.1, instead="channel_field(heater@width=2)")
    said = sentence(told("NOTHING_LEFT", effects=(one,), residual=SIZES))
    assert "may be parts of one cause: channel_field(heater@width=2) does as well alone" in said


def test_the_verdict_of_an_entry_is_that_of_how_sure_it_is():
    verdicts = {
        "sure": "FOUND",
        "rivals": "CONFOUNDED",
        "stand-in": "CONFOUNDED",
        "weak": "NOT_IDENTIFIABLE",
        "unknown": "UNKNOWN_EFFECT",
    }
    for status, verdict in verdicts.items():
        one = Entry(name="solar", words="", status=status, takes_off_nT=0.1)
        assert one.verdict == verdict
        assert one.as_json()["how_sure"]


@pytest.mark.parametrize(
    ("gain", "t", "firm"), [(0.2, 20.0, True), (0.2, 3.9, False), (0.2, 4.1, True), (0.006, 5.0, False)]
)
def test_what_one_sigma_less_would_have_lost_is_weak(gain, t, firm):
    assert Rules().firm((gain, t)) is firm


def test_what_the_search_alone_would_have_told_does_not_make_a_sure_value_doubtful():
    moved = told("NOTHING_LEFT", effects=(effect(0.1, cadence_s=1.0, cadence_shift=7.3),))
    assert "sigma from those" not in sentence(moved)


def test_effects_that_leave_noise_are_not_doubted():
    given = told("NOTHING_LEFT", effects=(effect(0.01),), residual=SIZES | {"structure_nT": 0.1})
    assert "stand in" not in sentence(given)


def test_nothing_left_says_what_could_not_have_been_seen():
    unscorable = [{"name": name} for name in ("induced", "bias", "temperature(coil)", "channel_rate")]
    said = sentence(told("NOTHING_LEFT", unscorable=unscorable))
    assert "could not have shown: induced, bias." in said
    assert "could not" not in sentence(told("NOTHING_LEFT"))


@pytest.mark.parametrize(("floor", "noise"), [(0.198, True), (0.1, False), (float("nan"), True)])
def test_a_residual_far_above_its_floor_is_not_called_noise(floor, noise):
    said = sentence(told("NOTHING_LEFT", residual=SIZES | {"noise_floor_nT": floor}))
    assert ("the residual is noise" in said) is noise
    assert ("0.173 nT rms beyond" in said) is not noise


OUT = {"burst_count": 12, "share": 0.0061, "kept": False, "bursts": [block(3)]}


@pytest.mark.parametrize("remaining", ["NOTHING_LEFT", "NOT_IDENTIFIABLE", "UNKNOWN_EFFECT"])
def test_bursts_are_said_whatever_the_verdict(remaining):
    said = sentence(told(remaining, outliers=OUT))
    assert "12 bursts of wild readings, 0.61% of the samples" in said
    assert "(the first 2010-03-01 03:00 to 2010-03-01 04:00), were left out." in said
    assert "bursts" in sentence(told(remaining, outliers=OUT, effects=(effect(0.1),)))
    assert "burst" not in sentence(told(remaining, outliers=OUT | {"burst_count": 0, "bursts": []}))


def test_bursts_that_were_kept_are_said_to_be_there():
    said = sentence(told("NOTHING_LEFT", outliers=OUT | {"kept": True, "share": 0.04}))
    assert "hold 4% of the samples" in said
    assert "too many to be left out" in said


def test_days_that_could_not_be_taken_in_are_told_with_the_reason():
    lost = {"2010-03-02": "no sample is left", "2010-03-03": "no sample is left"}
    text = sentence(told("NOTHING_LEFT", blocks=blocks(90.0, 90.0) | {"lost": lost}))
    assert "2 days could not be taken in: 2010-03-02, no sample is left." in text
    assert "taken in" not in sentence(told("NOTHING_LEFT"))


def field(channel, value, sigma, unit="nT/A"):
    numbers = zip("xyz", value, sigma, strict=True)
    return effect(
        0.1,
        name=f"channel_field({channel})",
        channels=(channel,),
        coefficients=tuple(Coefficient(f"coefficient[{axis}]", *two, unit, "") for axis, *two in numbers),
    )


def test_currents_that_make_one_field_may_be_one_that_nobody_records():
    """What a load draws, which no channel tells, is what others give or take."""
    parts = [
        field("battery", (0.434, -0.340, -0.672), (0.002, 0.005, 0.001)),
        field("heater", (0.446, -0.330, -0.676), (0.005, 0.019, 0.003)),
        field("panels", (-0.434, 0.337, 0.669), (0.007, 0.021, 0.004)),
    ]
    warm = field("warmth", (0.434, -0.340, -0.672), (0.002, 0.005, 0.001), "nT/K")
    found = of_one_direction([*parts, warm])
    assert set(found) == {one.name for one in parts}
    assert set(found.values()) == {"a field that follows battery + 1.01 * heater - 0.996 * panels"}
    # Two fields of one direction, unlike in size, are no sum of currents.
    assert not of_one_direction([parts[0], field("radio", (1.1, -0.86, -1.7), (0.005, 0.019, 0.003))])


def test_directions_that_are_known_badly_are_not_called_one():
    known, vague = (0.01, 0.01, 0.01), (0.2, 0.3, 0.2)
    assert not of_one_direction([field("a", (1, 0.1, 0), known), field("b", (1, -0.1, 0.1), vague)])


def test_two_lags_of_one_channel_with_one_direction_may_be_one_response():
    error = (0.03, 0.03, 0.03)
    slow = field("rod", (-3.0, -2.8, -2.3), error)
    slow = replace(slow, name=f"{slow.name}@lag=35s", lag_s=35.0)
    quick = field("rod", (1.5, 1.4, 1.15), error)
    assert set(of_one_response([slow, quick])) == {slow.name, quick.name}
    # Of two directions they are two sources, a wire and what it heats; and two channels are no one response.
    assert not of_one_response([slow, field("rod", (1.5, -1.4, 1.15), error)])
    assert not of_one_response([slow, field("heater", (1.5, 1.4, 1.15), error)])
