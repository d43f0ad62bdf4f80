"""A model is a value: its text says all of it, its errors name effect and remedy, its tables bind."""

import numpy as np
import pytest
import xarray as xr
from effect_cases import MISSION, PLACES, PREFLIGHT, entry_of, model_of, true_samples
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.errors import InflightError, ModelError
from inflight.model import Model
from inflight.time import DAY, to_tt2000

seeds = st.integers(0, 2**32 - 1)
BLOCK = """\
model: m
mission: champ
comparison: main
effects:
  - effect: vector_sensor
    sensor: fgm
    scale_factor: {time: block}
    misalignment: {time: block}
    offset: {time: block}
"""


def values_at(model: Model, when: str = "2004-05-01") -> np.ndarray:
    stamp = to_tt2000(np.datetime64(when))
    return np.concatenate([value for entry in model.effects for value in entry.values(stamp).values()])


@given(seed=seeds, time=st.sampled_from(["constant", "linear", "log", "event", "spline"]))
@settings(max_examples=15, deadline=None)
def test_parsing_a_models_own_text_gives_the_same_model(seed, time):
    generator = np.random.default_rng(seed)
    model = model_of(*(entry_of(name, generator, time) for name in generator.permutation(sorted(PLACES))))
    again = Model.parse(model.text, MISSION)
    assert again.text == model.text
    assert again.sha == model.sha
    assert np.array_equal(values_at(again), values_at(model)), "not a bit of a value is lost"
    for one, other in zip(model.effects, again.effects, strict=True):
        for key, timed in one.parameters.items():
            assert np.array_equal(timed.sigma, other.parameters[key].sigma), key
            assert (timed.time, timed.free, timed.t0, timed.per) == (
                other.parameters[key].time,
                other.parameters[key].free,
                other.parameters[key].t0,
                other.parameters[key].per,
            )


@pytest.mark.parametrize("sigma", ["[1, .inf, 2]", ".inf", "[0, 0, 0]", "0"])
def test_a_stated_sigma_survives_the_text_whatever_it_is(sigma):
    model = Model.parse(
        BLOCK.replace("offset: {time: block}", f"offset: {{time: block, sigma: {sigma}}}"), MISSION
    )
    again = Model.parse(model.text, MISSION)
    told = [one.effects[0].parameters["offset"].sigma for one in (model, again)]
    assert np.array_equal(*told)


def test_the_preflight_model_of_champ_is_stable():
    model = Model.parse(PREFLIGHT, MISSION)
    assert Model.parse(model.text, MISSION).text == model.text


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_adding_and_dropping_an_effect_returns_the_model(seed):
    generator = np.random.default_rng(seed)
    names = generator.permutation(sorted(PLACES)).tolist()
    entries = [entry_of(name, generator) for name in names]
    model = model_of(*entries[1:])
    extra = model_of(entries[0]).effects[0]
    before = names[1 + int(generator.integers(len(names) - 1))]
    more = model.add(extra, before)
    assert [e.name for e in more.effects].index(names[0]) == [e.name for e in more.effects].index(before) - 1
    assert more.drop(names[0]) == model
    assert model.diff(more) == [f"added {names[0]}"]
    assert more.diff(model) == [f"dropped {names[0]}"]


def test_a_linear_parameter_grows_with_time_and_a_log_one_with_its_logarithm():
    text = BLOCK.replace(
        "scale_factor: {time: block}",
        "scale_factor: {time: log, t0: 2000-05-30, per: d, "
        "value: {x: [1.00025304, 2.8960e-4], y: [1.0, 0.0], z: [1.0, -1.0e-4]}}",
    ).replace(
        "offset: {time: block}",
        "offset: {time: linear, t0: 2004-01-01, per: 100 d, value: [[10, 1], [20, -2], [0, 0.5]]}",
    )
    model = Model.parse(text, MISSION)
    stamp = to_tt2000(np.datetime64("2004-05-01T12:00:00"))
    values = model.effects[0].values(stamp)
    days = (stamp - to_tt2000(np.datetime64("2000-05-30"))) / DAY
    expected = [1.00025304 + 2.8960e-4 * np.log(days), 1.0, 1.0 - 1e-4 * np.log(days)]
    assert np.allclose(values["scale_factor"], expected, rtol=0, atol=1e-15)
    assert np.allclose(
        values["offset"], np.array([10, 20, 0]) + 1.215 * np.array([1, -2, 0.5]), rtol=0, atol=1e-12
    )
    many = model.effects[0].values(stamp + np.arange(3) * DAY)["offset"]
    assert many.shape == (3, 3)
    assert np.allclose(np.diff(many, axis=0), np.array([1, -2, 0.5]) / 100, rtol=0, atol=1e-12)


def test_a_log_trend_is_not_continued_before_its_origin():
    text = BLOCK.replace(
        "offset: {time: block}", "offset: {time: log, t0: 2010-01-01, value: [[1, 1], [1, 1], [1, 1]]}"
    )
    with pytest.raises(ModelError, match=r"vector_sensor\.offset.*before it"):
        Model.parse(text, MISSION).correct(true_samples(0))


def table(start: list[int], offsets: list[float]) -> xr.Dataset:
    names = [f"vector_sensor.offset[{axis}]" for axis in "xyz"]
    value = np.array(offsets)[:, None] * np.array([1.0, 2.0, 3.0])
    ends = [at + DAY for at in start]
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), value),
            "start": ("interval", np.array(start)),
            "end": ("interval", np.array(ends)),
        },
        coords={"parameter": names},
    )


def test_a_bound_table_gives_each_sample_the_value_of_its_interval():
    samples = true_samples(0)
    stamps = samples["tt2000"].values
    middle = int(stamps[200])
    bound = Model.parse(BLOCK, MISSION).bind(table([middle - DAY, middle], [5.0, -7.0]))
    offset = bound.effects[0].values(stamps)["offset"]
    assert (offset[:200] == [5.0, 10.0, 15.0]).all()
    assert (offset[200:] == [-7.0, -14.0, -21.0]).all(), "the end of an interval belongs to the next one"
    raw = bound.disturb(samples)
    assert np.allclose(raw["vector"].values - samples["vector"].values, offset, rtol=0, atol=1e-10)


def test_stamps_in_any_order_have_the_values_that_each_has_alone():
    first = int(true_samples(0)["tt2000"].values[0])
    effect = (
        Model.parse(BLOCK, MISSION)
        .bind(table([first, first + DAY, first + 3 * DAY], [5.0, -7.0, 2.0]))
        .effects[0]
    )
    random = np.random.default_rng(5)
    stamps = np.sort(first + random.integers(0, 2 * DAY, 50))
    stamps[7] = stamps[8]
    alone = np.array([effect.values(one)["offset"] for one in stamps])
    order = random.permutation(50)
    for some in (slice(None), order, slice(0, 0), slice(3, 4), np.flatnonzero(stamps < first + DAY)):
        found = np.broadcast_to(effect.values(stamps[some])["offset"], alone[some].shape)
        np.testing.assert_array_equal(found, alone[some])
    with pytest.raises(ModelError, match="not valid at"):
        effect.values(np.append(stamps, first + np.array([2, 3]) * DAY))


@pytest.mark.parametrize("shift", [-2 * DAY, DAY, 3600 * 10**9])
def test_a_table_is_not_used_outside_its_validity(shift):
    samples = true_samples(0)
    bound = Model.parse(BLOCK, MISSION).bind(table([int(samples["tt2000"].values[0]) + shift], [5.0]))
    with pytest.raises(ModelError, match=r"vector_sensor\.offset.*not valid.*reprocess"):
        bound.correct(samples)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("{effect: no_such}", "no_such.*known are"),
        ("{effect: heading, sensor: nowhere}", "nowhere.*fgm, ovm"),
        ("{effect: heading, sensor: ovm, colour: red}", "colour"),
        ("{effect: heading, sensor: ovm, vector: [1, 2]}", r"heading\.vector.*3 components"),
        (
            "{effect: heading, sensor: ovm, vector: {value: {x: 1, y: 2}}}",
            r"heading\.vector.*expected x, y, z",
        ),
        ("{effect: heading, sensor: ovm, vector: {unit: mT, value: [1, 2, 3]}}", r"heading\.vector.*mT.*nT"),
        ("{effect: heading, sensor: ovm, vector: {time: weekly, value: [1, 2, 3]}}", "weekly.*constant"),
        ("{effect: heading, sensor: ovm, vector: {tome: block}}", "tome"),
        ("{effect: heading, sensor: ovm, vector: {time: linear, value: [[1, 1], [1, 1], [1, 1]]}}", "t0"),
        ("{effect: heading, sensor: ovm, vector: [1, .nan, 3]}", r"heading\.vector.*no number"),
        ("{effect: heading, sensor: ovm, vector: {value: [1, 2, 3], sigma: -1}}", "sigma below 0"),
    ],
)
def test_a_wrong_model_is_refused_with_file_effect_and_remedy(wrong, told):
    text = f"model: m\nmission: champ\neffects:\n  - {{effect: scalar_bias, sensor: ovm}}\n  - {wrong}\n"
    with pytest.raises(InflightError, match=told) as caught:
        Model.parse(text, MISSION, "my.yaml")
    assert "my.yaml: effect 2" in str(caught.value)
    assert caught.value.remedy


def test_a_comparison_the_mission_has_not_is_refused():
    with pytest.raises(ModelError, match=r"other.*main"):
        Model.parse(BLOCK.replace("comparison: main", "comparison: other"), MISSION)


def test_two_effects_of_one_name_are_refused():
    twice = "model: m\nmission: champ\neffects:\n" + "  - {effect: heading, sensor: ovm}\n" * 2
    with pytest.raises(ModelError, match=r"same name.*give 'name'"):
        Model.parse(twice, MISSION)
