"""Values that change at events and along splines, values put in by name, and what two models differ in."""

import numpy as np
import pytest
from effect_cases import MISSION, SENSORS, model_of, true_samples
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.design import term_of
from inflight.errors import InflightError, ModelError
from inflight.mission import Mission
from inflight.model import Model, TimeDependence, changes, make_effect, parse_tree
from inflight.time import DAY, to_tt2000

START = int(to_tt2000(np.datetime64("2004-01-01")))
EVENTS = Mission.parse(
    MISSION.text
    + """
events:
  - {at: 2004-06-01, name: second, kind: reset}
  - {at: 2004-02-01, name: first, kind: reset}
  - {at: 2004-03-01, name: dark, kind: eclipse}
"""
)


def bias(**told):
    return make_effect({"effect": "scalar_bias", "sensor": "ovm", "bias": told}, SENSORS, mission=EVENTS)


def at(entry, *days):
    return entry.values(np.array([int(to_tt2000(np.datetime64(day))) for day in days]))["bias"][:, 0].tolist()


def test_a_value_holds_from_its_event_to_the_next():
    entry = bias(time="event", at=["2004-02-01", "2004-06-01T12:00"], value=[1.0, 2.0, 3.0])
    days = ["2000-01-01", "2004-01-31T23:59:59", "2004-02-01", "2004-06-01T11:59", "2004-06-01T12:00"]
    assert at(entry, *days) == [1.0, 1.0, 2.0, 2.0, 3.0]
    assert entry.parameters["bias"].columns == [f"scalar_bias.bias*e{i}" for i in range(3)]


def test_a_spline_goes_through_its_knots_and_is_held_beyond():
    days = ["2004-01-01", "2004-01-11", "2004-02-01"]
    for interpolation in ("linear", "cubic"):
        entry = bias(time="spline", at=days, value=[1.0, 3.0, -2.0], interpolation=interpolation)
        assert np.allclose(at(entry, *days), [1.0, 3.0, -2.0], rtol=0, atol=1e-12)
        assert np.allclose(at(entry, "1990-01-01", "2020-01-01"), [1.0, -2.0])
    line = bias(time="spline", at=days, value=[1.0, 3.0, -2.0], interpolation="linear")
    assert np.allclose(at(line, "2004-01-06"), [2.0])


@given(
    st.lists(st.integers(1, 400), min_size=1, max_size=6, unique=True),
    st.sampled_from(["event", "spline"]),
    st.sampled_from(["linear", "cubic"]),
    st.integers(-500, 900),
)
@settings(max_examples=60, deadline=None)
def test_functions_of_time_add_up_to_one(days, time, interpolation, when):
    """So that equal values at all knots and intervals are a constant."""
    moments = tuple(START + day * DAY for day in sorted({0, *days}))
    basis = TimeDependence(time, at=moments, interpolation=interpolation).basis(START + when * DAY)
    assert basis.shape == (len(moments) + (time == "event"),)
    assert np.isclose(basis.sum(), 1.0, rtol=0, atol=1e-9)


def test_one_value_a_component_holds_for_every_interval():
    text = {"effect": "heading", "sensor": "ovm"}
    told = {"time": "event", "at": ["2004-02-01"], "value": [1, 2, 3], "sigma": 0.5}
    timed = make_effect({**text, "vector": told}, SENSORS).parameters["vector"]
    assert timed.value.tolist() == [[1, 1], [2, 2], [3, 3]]
    assert (timed.sigma == 0.5).all()
    plain = make_effect({**text, "vector": {"time": "event", "at": ["2004-02-01"]}}, SENSORS)
    assert (plain.parameters["vector"].sigma == plain.parameters["vector"].parameter.sigma).all()


def test_a_stated_sigma_makes_a_parameter_free_unless_it_is_said_not_to_be():
    assert bias(value=1.0, sigma=0.1).parameters["bias"].free
    assert not bias(value=1.0, sigma=0.1, free=False).parameters["bias"].free
    assert not bias(value=1.0).parameters["bias"].free
    assert bias(time="block").parameters["bias"].free


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"time": "evnt"}, "did you mean 'event'"),
        ({"time": "event"}, "list 1 or more rising UTC times, or 'events: KIND'"),
        ({"time": "event", "at": ["2004-02-01", "2004-01-01"]}, "rising"),
        ({"time": "event", "at": ["soon"]}, "at: "),
        ({"time": "event", "events": "no_such"}, "no event of kind 'no_such'"),
        ({"time": "spline", "at": ["2004-02-01"]}, "2 or more rising"),
        ({"time": "spline", "at": ["2004-02-01", "2004-03-01"], "interpolation": "cubik"}, "linear"),
        ({"time": "spline", "at": ["2004-02-01", "2004-03-01"], "value": [1, 2, 3]}, "2 coefficients"),
        ({"time": "constant", "at": ["2004-02-01"]}, "has no 'at'"),
        ({"time": "linear", "t0": "then", "value": [1, 2]}, "t0: 2000-05-30"),
        ({"valu": 1.0}, "did you mean 'value'"),
    ],
)
def test_a_wrong_time_dependence_is_refused_with_a_remedy(told, match):
    with pytest.raises(ModelError, match=match) as caught:
        bias(**told)
    assert caught.value.remedy


def test_events_of_a_kind_come_from_the_mission_and_are_kept_as_times():
    told = bias(time="event", events="reset").as_yaml()["bias"]
    assert [moment[:10] for moment in told["at"]] == ["2004-02-01", "2004-06-01"]
    assert "events" not in told


MODEL = model_of(
    {"effect": "time_shift", "sensor": "ovm", "seconds": {"value": 0.01, "sigma": 0.001}},
    {
        "effect": "vector_sensor",
        "sensor": "fgm",
        "scale_factor": {"time": "block"},
        "offset": {"time": "linear", "t0": "2004-01-01", "value": [[1, 0.1], [2, 0.2], [3, 0.3]]},
    },
    {
        "effect": "scalar_bias",
        "sensor": "ovm",
        "bias": {"time": "event", "at": ["2004-02-01"], "value": [1, 2]},
    },
)


def test_values_and_sigmas_are_put_in_by_the_names_of_columns():
    assert MODEL.columns[:1] == ["time_shift.seconds"]
    assert "vector_sensor.offset[y]*b" in MODEL.columns
    assert not any("scale_factor" in name for name in MODEL.columns), "those lie in a table"
    new = MODEL.with_values(
        {"time_shift.seconds": 0.02, "vector_sensor.offset[y]*b": 0.5, "scalar_bias.bias*e1": -1.0},
        {"vector_sensor.offset[y]": 0.25},
    )
    offset = new.effect("vector_sensor").parameters["offset"]
    assert offset.value.tolist() == [[1, 0.1], [2, 0.5], [3, 0.3]]
    assert offset.sigma[1, 0] == 0.25
    assert new.effect("time_shift").parameters["seconds"].value[0, 0] == 0.02
    assert new.effect("time_shift").parameters["seconds"].sigma[0, 0] == 0.001
    assert new.effect("scalar_bias").parameters["bias"].value.tolist() == [[1, -1]]
    assert MODEL.effect("time_shift").parameters["seconds"].value[0, 0] == 0.01, "a model is a value"
    assert Model.parse(new.text, MISSION).text == new.text


@pytest.mark.parametrize("name", ["time_shift.second", "vector_sensor.scale_factor[x]"])
def test_a_value_the_model_does_not_hold_is_refused(name):
    with pytest.raises(ModelError, match="holds no value"):
        MODEL.with_values({name: 1.0})


def test_a_second_fit_begins_with_what_was_known_before_the_first():
    plain = {"effect": "channel_field", "sensor": "fgm", "channel": "solar_current"}
    stated = {"effect": "scalar_bias", "sensor": "ovm", "bias": {"value": 0.0, "sigma": 0.2}}
    model = model_of(
        stated, plain | {"coefficient": {"value": [0.0, 0.0, 0.0], "sigma": [0.0, 0.0, 0.0], "free": True}}
    )
    for sigma in (0.02, 0.01):
        columns = ("scalar_bias.bias", *(f"channel_field.coefficient[{axis}]" for axis in "xyz"))
        model = model.with_values(dict.fromkeys(columns, 0.1), dict.fromkeys(columns, sigma))
        model = Model.parse(model.text, MISSION)
        bias, field = (
            term_of(model.effect(name), name, free_only=True) for name in ("scalar_bias", "channel_field")
        )
        assert bias.sigma == (sigma,)
        bias, field = bias.before_any_fit(), field.before_any_fit()
        assert bias.sigma == (0.2,)
        # Of what was added nothing was known: as far as such an effect goes.
        assert field.sigma == (10.0, 10.0, 10.0)
        assert model.effect("scalar_bias").parameters["bias"].sigma_at(0) == [sigma]


def test_an_effect_is_put_in_the_place_of_its_namesake():
    other = make_effect({"effect": "time_shift", "sensor": "ovm", "seconds": 0.5}, SENSORS)
    new = MODEL.replace(other)
    assert [entry.name for entry in new.effects] == [entry.name for entry in MODEL.effects]
    assert new.effects[0] is other
    with pytest.raises(ModelError, match="no effect 'remanent'"):
        MODEL.replace(make_effect({"effect": "remanent", "sensor": "ovm"}, SENSORS))


def test_a_new_effect_stands_where_the_calibration_can_use_it():
    """What changes the reading goes before the nine parameters, what adds a field behind them."""
    scale = make_effect({"effect": "channel_scale", "channel": "coil_temperature", "sensor": "fgm"}, SENSORS)
    eddy = make_effect({"effect": "eddy", "sensor": "fgm"}, SENSORS)
    field = make_effect({"effect": "remanent", "sensor": "fgm"}, SENSORS)
    names = [entry.name for entry in MODEL.add(scale).add(eddy).add(field).effects]
    assert names == ["time_shift", "channel_scale", "eddy", "vector_sensor", "scalar_bias", "remanent"]
    induced = make_effect({"effect": "induced", "sensor": "ovm"}, SENSORS)
    assert MODEL.add(induced).effects[-1] is induced


def test_a_term_that_follows_the_field_at_the_scalar_sensor_is_told_apart():
    model = model_of({"effect": "induced", "sensor": "ovm", "diagonal": [1e-5, 2e-5, -1e-5]})
    truth = true_samples(0)
    raw = model.disturb(truth)
    terms = model.correction_terms(model.correct(raw))
    assert np.allclose(terms["induced"], raw["scalar"].values - truth["scalar"].values, rtol=0, atol=1e-9)


def test_the_field_before_its_corrections_is_that_of_a_model_without_them():
    sensor = {
        "effect": "vector_sensor",
        "sensor": "fgm",
        "offset": [10, -20, 30],
        "scale_factor": [1.01, 0.99, 1],
    }
    remanent = {"effect": "remanent", "sensor": "fgm", "vector": [5, -3, 1]}
    heater = {
        "effect": "channel_field",
        "channel": "solar_current",
        "sensor": "fgm",
        "coefficient": [3, 2, -1],
    }
    own = {"effect": "heading", "sensor": "ovm", "vector": [1, 2, 3]}
    model, raw = model_of(sensor, remanent, heater, own), true_samples(0)
    corrected = model.correct(raw)
    found = model.before_corrections(corrected, model.correction_terms(corrected))
    without = model_of(sensor, own).correct(raw)["field"].values
    assert found == pytest.approx(without, abs=1e-9)
    assert np.abs(without - corrected["field"].values).max() > 5.0
    # Scaled by the sensor's equation behind it a term is not what it adds to the field; and none is no sum.
    for other in (model_of(remanent, sensor), model_of(sensor, own)):
        corrected = other.correct(raw)
        assert other.before_corrections(corrected, other.correction_terms(corrected)) is None


def test_changes_tell_each_value_that_moved():
    new = MODEL.with_values({"vector_sensor.offset[y]*b": 0.5}).drop("time_shift")
    extra = make_effect({"effect": "heading", "sensor": "ovm", "vector": [1, 2, 3]}, SENSORS)
    found = MODEL.changes(new.add(extra))
    assert [(one["change"], one["effect"], one["key"]) for one in found] == [
        ("added", "heading", ""),
        ("dropped", "time_shift", ""),
        ("changed", "vector_sensor", "offset.value.y"),
    ]
    assert (found[2]["from"], found[2]["to"]) == ([2.0, 0.2], [2.0, 0.5])
    assert found[2]["sentence"] == "changed vector_sensor.offset.value.y: [2, 0.2] -> [2, 0.5]"
    assert found[0]["to"]["effect"] == "heading"


def test_changes_of_order_are_told():
    entries = parse_tree(MODEL.text)["effects"]
    found = changes(entries, entries[::-1])
    assert {one["change"] for one in found} == {"moved"}
    assert {one["effect"] for one in found} == {"time_shift", "scalar_bias"}
    assert not changes(entries, entries)


@pytest.mark.parametrize("text", ["effects: [", "model: m\n", "- 1\n", "effects: 3\n", "effects: [3]\n"])
def test_a_text_that_is_no_model_is_refused(text):
    with pytest.raises(InflightError, match=r"my\.yaml"):
        Model.parse(text, MISSION, "my.yaml")
