"""The scorer itself, on truths and diagnoses written by hand."""

import io
import math

import pytest
from rich.console import Console

from .run import Outcome
from .score import base_channels, in_set, score, unit_factor
from .verdicts import side_by_side, verdict_of

BATTERY = {
    "name": "battery_current field",
    "families": ["battery"],
    "channels": ["battery_current"],
    "coefficients": [
        {"quantity": "coefficient", "axis": a, "value": v, "unit": "nT/A", "at": "difference"}
        for a, v in zip("xyz", (0.1, -0.2, 0.05), strict=True)
    ],
    "identifiable": True,
    "equivalents": [],
}
BLIND_BIAS = {
    "name": "scalar bias",
    "families": ["bias"],
    "channels": [],
    "coefficients": [],
    "identifiable": False,
    "equivalents": [],
}
SWITCH = {
    "name": "unrecorded switch",
    "families": ["unknown"],
    "channels": [],
    "coefficients": [],
    "identifiable": True,
    "equivalents": [],
    "period_s": 2460.0,
    "axis": "z",
    "unrecorded": True,
}


def truth(*effects, verdicts=("FOUND", "CONFOUNDED")):
    return {
        "scenario": "by_hand",
        "seed": 0,
        "verdicts": list(verdicts),
        "floor_nT": 0.1,
        "effects": list(effects),
    }


def effect(family="battery", channels=("battery_current",), values=(0.1, -0.2, 0.05), unit="nT/A", **more):
    told = [
        {"name": f"own.coefficient[{a}]", "value": v, "sigma": 0.01, "unit": unit, "at": "difference"}
        for a, v in zip("xyz", values, strict=True)
    ]
    return {"name": "own", "family": family, "channels": list(channels), "coefficients": told} | more


def diagnosis(verdict="FOUND", *effects, held_out=0.101, **more):
    return {
        "verdict": verdict,
        "effects": list(effects),
        "confusion_set": [],
        "unscorable": [],
        "signature": None,
        "residual": {"held_out_after_nT": held_out},
    } | more


def test_the_right_answer_passes():
    told = score(truth(BATTERY), diagnosis("FOUND", effect(values=(0.11, -0.19, 0.05))))
    assert told.passed
    assert told.pull == pytest.approx(1.0)
    assert told.floor_ratio == pytest.approx(1.01)


@pytest.mark.parametrize(
    "wrong",
    [
        effect("solar", ("solar_current",)),
        effect("solar"),
        effect(channels=("other_battery",)),
    ],
)
def test_a_wrong_name_found_is_confidently_wrong(wrong):
    told = score(truth(BATTERY), diagnosis("FOUND", wrong))
    assert told.confident_wrong
    assert told.family is False
    assert not told.honest


def test_a_wrong_companion_of_the_right_one_is_confidently_wrong_too():
    told = score(truth(BATTERY), diagnosis("FOUND", effect(), effect("camera", ("camera_current",))))
    assert told.family
    assert told.confident_wrong
    assert told.false_additions == ("camera:camera_current",)


@pytest.mark.parametrize(
    "entry",
    [
        {"family": "battery", "channels": ["battery_current@lag=100s"]},
        "channel_field battery_current",
    ],
)
def test_a_confusion_set_with_the_truth_in_it_is_honest(entry):
    wrong = effect("solar", ("solar_current",))
    told = score(truth(BATTERY), diagnosis("CONFOUNDED", wrong, confusion_set=[entry, "solar_current"]))
    assert told.passed
    assert told.false_additions == ()


def test_a_confusion_set_without_the_truth_is_not():
    wrong = effect("solar", ("solar_current",))
    told = score(truth(BATTERY), diagnosis("CONFOUNDED", wrong, confusion_set=["camera_current"]))
    assert told.family is False
    assert told.false_additions == ("solar:solar_current",)
    assert not told.confident_wrong


def test_silence_about_what_can_be_told_fails():
    told = score(truth(BATTERY), diagnosis("NOTHING_LEFT"))
    assert not told.verdict_allowed
    assert told.family is False
    assert not told.confident_wrong


def test_a_coefficient_is_judged_in_its_own_sigmas_and_units():
    milli = effect(values=(1e-4, -2e-4, 5e-5), unit="nT/mA")
    for one in milli["coefficients"]:
        one["sigma"] = 1e-5
    assert score(truth(BATTERY), diagnosis("FOUND", milli)).coefficients
    off = score(truth(BATTERY), diagnosis("FOUND", effect(values=(0.1, -0.2, 0.09))))
    assert off.pull == pytest.approx(4.0)
    assert off.coefficients is False
    assert not off.passed


def test_a_coefficient_of_another_sign_is_far_off():
    told = score(truth(BATTERY), diagnosis("FOUND", effect(values=(-0.1, 0.2, -0.05))))
    assert told.coefficients is False


@pytest.mark.parametrize(("found", "right"), [(600.0, True), (710.0, True), (730.0, False), (None, False)])
def test_a_lag_is_allowed_a_fifth(found, right):
    slow = BATTERY | {"lag_s": 600.0}
    assert score(truth(slow), diagnosis("FOUND", effect(lag_s=found))).lag is right


def test_a_lag_may_stand_in_the_name_or_have_a_sigma():
    slow = BATTERY | {"lag_s": 600.0}
    assert score(truth(slow), diagnosis("FOUND", effect(channels=("battery_current@lag=640s",)))).lag
    assert score(truth(slow), diagnosis("FOUND", effect(lag_s=800.0, lag_sigma_s=70.0))).lag


@pytest.mark.parametrize(("period", "right"), [(2462.0, True), (2500.0, False)])
def test_an_unrecorded_period_is_told_by_the_signature(period, right):
    told = diagnosis("UNKNOWN_EFFECT", signature={"period_s": period, "axis": "z"})
    made = score(truth(SWITCH, verdicts=("UNKNOWN_EFFECT",)), told)
    assert made.period is right
    assert made.family is right
    assert made.passed is right


def test_an_unknown_effect_named_after_a_channel_is_confidently_wrong():
    told = diagnosis("FOUND", effect(), signature={"period_s": 2460.0})
    assert score(truth(SWITCH, verdicts=("UNKNOWN_EFFECT",)), told).confident_wrong


def test_half_a_product_is_right_only_where_the_rest_is_said_to_be_unknown():
    true = BATTERY | {"product": True, "channels": ["a", "b"], "coefficients": [], "families": ["unknown"]}
    whole = score(truth(true), diagnosis("FOUND", effect("unknown", ("a*b",))))
    half = diagnosis("FOUND", effect("current", ("a",)))
    assert whole.passed
    assert score(truth(true), half).confident_wrong
    assert not score(truth(true), half | {"remaining": {"verdict": "UNKNOWN_EFFECT"}}).confident_wrong


def test_what_cannot_be_seen_has_to_be_named_among_the_unscorable():
    silent = truth(BLIND_BIAS, verdicts=("NOTHING_LEFT", "NOT_IDENTIFIABLE"))
    assert score(silent, diagnosis("NOTHING_LEFT", unscorable=[{"family": "bias"}])).passed
    assert score(silent, diagnosis("NOTHING_LEFT")).family is False
    assert score(silent, diagnosis("FOUND", effect())).confident_wrong


def test_a_null_is_passed_by_saying_nothing():
    nothing = truth(verdicts=("NOTHING_LEFT",))
    assert score(nothing, diagnosis("NOTHING_LEFT")).passed
    added = score(nothing, diagnosis("FOUND", effect()))
    assert added.confident_wrong
    assert added.false_additions


def test_an_error_above_the_floor_fails():
    told = score(truth(BATTERY), diagnosis("FOUND", effect(), held_out=0.106))
    assert told.floor is False
    assert not told.passed


def test_derived_names_lead_to_their_channels():
    assert base_channels(["a@lag=600s*b", "power.c~3"]) == {"a", "b", "c"}
    assert base_channels("d@width=2") == {"d"}
    assert base_channels(None) == set()


def test_units_convert_or_do_not():
    assert unit_factor("nT/mA", "nT/A") == pytest.approx(1000.0)
    assert unit_factor("nT/degC", "nT/K") == pytest.approx(1.0)
    assert unit_factor("ppm/K", "1/K") == pytest.approx(1e-6)
    assert unit_factor("nT", "nT/A") is None


def test_an_entry_of_another_channel_is_not_the_truth():
    assert not in_set(BATTERY, [{"family": "battery", "channels": ["second_battery"]}])
    assert not in_set(BATTERY, ["second_battery_current"])


def test_cosine_and_sine_are_compared_by_their_amplitude():
    tone = BATTERY | {"name": "tone", "families": ["tone"], "channels": []}
    tone["coefficients"] = [
        {"quantity": "amplitude", "axis": "x", "value": 0.5, "unit": "nT", "at": "difference"}
    ]
    parts = [
        {"name": f"tone.amplitude[{part}x1]", "value": value, "sigma": 0.01, "unit": "nT"}
        for part, value in (("c", 0.3), ("s", -0.41))
    ]
    told = effect("tone", ()) | {"coefficients": parts}
    made = score(truth(tone), diagnosis("FOUND", told))
    assert made.pull == pytest.approx((math.hypot(0.3, 0.41) - 0.5) / 0.01, rel=1e-6)
    assert made.coefficients


def test_the_field_of_the_sun_may_be_told_by_any_of_its_coordinates():
    lit = BATTERY | {"families": ["day_night"], "channels": ["sunlit"], "coefficients": []}
    for channels in (("sunlit",), ("sun_phase",), ()):
        assert score(truth(lit), diagnosis("FOUND", effect("day_night", channels))).passed
    assert score(truth(lit), diagnosis("FOUND", effect("day_night", ("solar_current",)))).confident_wrong


def test_a_run_stands_beside_an_earlier_one_and_what_differs_is_counted():
    hidden = truth(BATTERY)

    def verdict(name, told):
        return verdict_of(Outcome(name, 1, 30, 0.0, 0.0, 7.0, hidden, told, score(hidden, told)))

    found, unnamed = diagnosis("FOUND", effect()), diagnosis("UNKNOWN_EFFECT")
    broken = verdict_of(Outcome("broken", 1, 30, 0.0, 0.0, 1.0, hidden, error="no such channel"))
    assert (broken["verdict"], broken["passed"], broken["taken"]) == ("error", None, [])
    before = [verdict("same", found), verdict("other", unnamed)]
    console = Console(width=200, file=io.StringIO())
    console.print(side_by_side(before, [verdict("same", found), verdict("other", found), broken]))
    text = console.file.getvalue()
    assert "1 of 3 cases with the verdict and effects of the earlier run" in text
    rows = {name: line for line in text.splitlines() for name in ("same", "other", "broken") if name in line}
    assert "UNKNOWN_EFFECT" in rows["other"]
    assert "FOUND" in rows["other"].replace("UNKNOWN_EFFECT", "")
    assert "not run" in rows["broken"]
