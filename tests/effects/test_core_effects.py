"""Every effect and every model is undone exactly, and says what it means in the published equations."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from effect_cases import MISSION, PLACES, PREFLIGHT, ROOT, SENSORS, entry_of, model_of, true_samples
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from inflight.calibration import to_sensor_angles
from inflight.calibration.published import from_sensor_angles
from inflight.diagnosis.candidates import acting_sensors
from inflight.effects import Effect, Parameter, known_effects, with_field
from inflight.effects.base import best_field
from inflight.effects.sensors import field_strength_rate
from inflight.errors import ModelError, SamplesError
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, make_effect
from inflight.time import SECOND

#: Rounding of fields of 50 000 nT through a chain of a dozen effects: 8 units in the last place, nT.
ROUNDING = 6e-11
seeds = st.integers(0, 2**32 - 1)


def test_the_cases_cover_the_whole_library():
    library = {
        name for name, kind in known_effects().items() if kind.__module__.startswith("inflight.effects")
    }
    assert library == set(PLACES)


@pytest.mark.parametrize("time", ["constant", "linear", "log", "event", "spline"])
@pytest.mark.parametrize("name", sorted(PLACES))
@given(seed=seeds)
@settings(max_examples=5, deadline=None)
def test_correct_undoes_disturb_for_each_effect(name, time, seed):
    truth = true_samples(seed % 7)
    model = model_of(entry_of(name, np.random.default_rng(seed), time))
    raw = model.disturb(truth)
    back = model.correct(raw)
    assert_allclose(back["vector"].values, truth["vector"].values, rtol=0, atol=ROUNDING)
    assert_allclose(back["scalar"].values, truth["scalar"].values, rtol=0, atol=ROUNDING)
    moved = max(float(np.abs(raw[role].values - truth[role].values).max()) for role in ("vector", "scalar"))
    assert moved > 1e-4, "an effect that changes nothing proves nothing"


@given(seed=seeds)
@settings(max_examples=25, deadline=None)
def test_correct_undoes_disturb_for_all_effects_together_in_any_order(seed):
    generator = np.random.default_rng(seed)
    names = generator.permutation(sorted(PLACES)).tolist()
    times = generator.choice(["constant", "linear", "log", "event", "spline"], len(names))
    model = model_of(*(entry_of(name, generator, str(time)) for name, time in zip(names, times, strict=True)))
    truth = true_samples(seed % 7)
    back = model.correct(model.disturb(truth))
    assert_allclose(back["vector"].values, truth["vector"].values, rtol=0, atol=10 * ROUNDING)
    assert_allclose(back["scalar"].values, truth["scalar"].values, rtol=0, atol=10 * ROUNDING)
    forth = model.disturb(model.correct(truth))
    assert_allclose(forth["vector"].values, truth["vector"].values, rtol=0, atol=10 * ROUNDING)


def sensor_equation(field: np.ndarray, s: np.ndarray, u: np.ndarray, e0: np.ndarray) -> np.ndarray:
    """Readings by eqs. 2.1 to 2.4 of Yin (2010), written out sample by sample."""
    u1, u2, u3 = np.deg2rad(u)
    w = np.sqrt(1 + np.tan(u2) ** 2 + np.tan(u3) ** 2)
    readings = []
    for bx, by, bz in field:
        along_x = bx / w + np.tan(u2) / w * by + np.tan(u3) / w * bz
        along_y = np.cos(u1) * by + np.sin(u1) * bz
        readings.append([s[0] * along_x + e0[0], s[1] * along_y + e0[1], s[2] * bz + e0[2]])
    return np.array(readings)


@given(seed=seeds)
@settings(max_examples=30, deadline=None)
def test_nine_parameters_are_the_thesis_sensor_equation(seed):
    generator = np.random.default_rng(seed)
    s, u = 1 + generator.uniform(-0.01, 0.01, 3), generator.uniform(-1, 1, 3)
    e0 = generator.uniform(-200, 200, 3)
    scale, angles = from_sensor_angles(s, u)
    entry = {
        "effect": "vector_sensor",
        "sensor": "fgm",
        "scale_factor": scale.tolist(),
        "misalignment": {"unit": "deg", "value": angles.tolist()},
        "offset": {"unit": "nT", "value": e0.tolist()},
    }
    truth = true_samples(1, 30)
    raw = model_of(entry).disturb(truth)["vector"].values
    assert_allclose(raw, sensor_equation(truth["vector"].values, s, u, e0), rtol=0, atol=ROUNDING)


@given(seed=seeds)
@settings(max_examples=50, deadline=None)
def test_both_forms_of_the_nine_parameters_convert_exactly(seed):
    generator = np.random.default_rng(seed)
    s, u = 1 + generator.uniform(-0.05, 0.05, 3), generator.uniform(-5, 5, 3)
    told = to_sensor_angles(*from_sensor_angles(s, u))
    assert_allclose(told.sensitivity, s, rtol=1e-14)
    assert_allclose(told.angles, u, rtol=0, atol=1e-12)


def test_the_published_angles_are_not_those_between_the_axes():
    """A misalignment of 90.02613 deg means axes at 89.97387 deg (to first order)."""
    told = to_sensor_angles(np.ones(3), np.array([90.02613, 90.0, 90.0]))
    assert_allclose(told.between_axes, [89.97387, 90, 90], rtol=0, atol=1e-5)
    assert_allclose(told.angles, [0.0, 0.02613, 0.0], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("s", "u"), [([1, -1, 1], [0, 0, 0]), ([1, 1, 1], [90, 0, 0]), ([1, 1, 1], [0, 89.9, 89.9])]
)
def test_no_sensor_is_made_of_impossible_numbers(s, u):
    with pytest.raises(ModelError):
        from_sensor_angles(np.array(s, dtype=float), np.array(u, dtype=float))


def one(name: str, **given: object) -> Model:
    return model_of({"effect": name, "sensor": PLACES[name][0], **PLACES[name][1], **given})


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_scalar_sensor_reads_the_projection_of_a_field_on_the_direction(sign):
    truth = true_samples(2)
    raw = one("heading", vector=[0.0, 0.0, 4.0 * sign]).disturb(truth)
    b = truth["vector"].values
    expected = truth["scalar"].values + 4.0 * sign * b[:, 2] / np.linalg.norm(b, axis=1)
    assert_allclose(raw["scalar"].values, expected, rtol=0, atol=ROUNDING)
    assert_allclose(raw["vector"].values, b, rtol=0, atol=0)


def test_a_second_order_heading_error_is_the_same_for_fields_that_oppose():
    truth = true_samples(2)
    xx, yy, xy, xz, yz = 0.4, -0.1, 0.2, -0.3, 0.05
    raw = one("heading_anisotropy", matrix=[xx, yy, xy, xz, yz]).disturb(truth)
    b = truth["vector"].values
    x, y, z = (b / np.linalg.norm(b, axis=1, keepdims=True)).T
    # Written out, so that neither sign nor factor of a product is taken from the code.
    expected = xx * (x * x - z * z) + yy * (y * y - z * z) + 2 * (xy * x * y + xz * x * z + yz * y * z)
    assert_allclose(raw["scalar"].values - truth["scalar"].values, expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_scalar_bias_adds_to_the_reading(sign):
    truth = true_samples(2)
    raw = one("scalar_bias", bias=0.4 * sign).disturb(truth)
    assert_allclose(raw["scalar"].values - truth["scalar"].values, 0.4 * sign, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("shift", [-0.015, 0.015])
def test_a_scalar_reading_taken_early_shows_the_field_of_an_earlier_time(shift):
    truth = true_samples(0)
    seconds = (truth["tt2000"].values - truth["tt2000"].values[0]) / SECOND

    def strength(t):
        return 40_000 + 8_000 * np.sin(2 * np.pi * t / 800)

    smooth = truth.assign(
        vector=(("time", "axis"), np.stack([strength(seconds), 0 * seconds, 0 * seconds], axis=1)),
        scalar=("time", strength(seconds)),
    )
    raw = one("time_shift", seconds=shift).disturb(smooth)["scalar"].values
    assert_allclose(raw[1:-1], strength(seconds - shift)[1:-1], rtol=0, atol=1e-4)


def test_a_late_vector_shows_an_earlier_field_and_a_turned_one_a_turned_field():
    truth = true_samples(0)
    seconds = (truth["tt2000"].values - truth["tt2000"].values[0]) / SECOND

    def field(t):
        return np.stack([3e4 * np.sin(t / 900), 2e4 * np.cos(t / 700), 1e4 + 0 * t], axis=1)

    smooth = truth.assign(vector=(("time", "axis"), field(seconds)))
    late = model_of({"effect": "vector_clock", "sensor": "fgm", "seconds": 0.4}).disturb(smooth)
    assert_allclose(late["vector"].values[2:-2], field(seconds - 0.4)[2:-2], rtol=0, atol=0.01)
    degrees = np.array([0.002, -0.001, 0.003])
    given = {"sensor": "fgm", "channel": "coil_temperature", "coefficient": degrees.tolist()}
    bent = model_of({"effect": "channel_turn", **given}).disturb(smooth)["vector"].values
    angle = truth["coil_temperature"].values[:, None] * np.deg2rad(degrees)
    whole = Rotation.from_rotvec(angle).apply(field(seconds))
    # Of second order in the angle.
    assert np.abs(bent - whole).max() < np.max(np.sum(angle**2, axis=1)) * 4e4
    assert np.abs(bent - field(seconds)).max() > 10


def test_a_turn_and_a_late_vector_are_tried_where_the_residual_shows_them():
    text = (ROOT / "missions" / "champ.yaml").read_text(encoding="utf-8")
    against_model = "comparisons: {main: {kind: field_model, vector: fgm}}"
    alone = Mission.parse(
        text.replace("comparisons: {main: {kind: scalar, vector: fgm, scalar: ovm}}", against_model)
    )
    model = SimpleNamespace(comparison="main")
    for name in ("channel_turn", "vector_clock"):
        kind = known_effects()[name]
        assert [sensor.name for sensor in acting_sensors(kind, alone, model)] == ["fgm"]
        assert acting_sensors(kind, MISSION, model) == [], "a field strength shows neither"


def test_a_rate_is_not_invented_where_a_sample_stands_alone():
    truth = true_samples(0, 60)
    lonely = truth["vector"].values.copy()
    lonely[[29, 31]] = np.nan
    samples = truth.assign(field=(("time", "axis"), lonely))
    found = field_strength_rate(samples)
    assert np.isnan(found[[29, 30, 31]]).all()
    assert np.isfinite(np.delete(found, [29, 30, 31])).all()
    shifted = one("time_shift", seconds=0.0).correct(truth.assign(vector=(("time", "axis"), lonely)))
    assert np.isfinite(shifted["scalar"].values).all(), "without a shift no rate is needed"


@pytest.mark.parametrize("name", ["torquer", "channel_field", "remanent"])
def test_what_an_additive_effect_takes_out_is_told_apart(name):
    truth = true_samples(3)
    model = model_of(entry_of(name, np.random.default_rng(4)))
    raw = model.disturb(truth)
    terms = model.correction_terms(model.correct(raw))
    assert_allclose(terms[name], raw["vector"].values - truth["vector"].values, rtol=0, atol=ROUNDING)


def test_a_torquer_matrix_has_coils_as_columns():
    truth = true_samples(1)
    current = np.zeros((truth.sizes["time"], 3))
    current[:, 1] = 1000.0
    truth["torquer_current"] = (("time", "axis"), current, {"units": "mA"})
    raw = one("torquer", matrix=[1, 2, 3, 4, 5, 6, 7, 8, 9]).disturb(truth)
    assert_allclose(
        (raw["vector"] - truth["vector"]).values, np.tile([2.0, 5, 8], (400, 1)), rtol=0, atol=1e-9
    )


def test_temperature_lowers_the_corrected_field_of_a_warm_sensor():
    truth = true_samples(1)
    truth["coil_temperature"] = ("time", np.full(400, 30.0), {"units": "degC"})
    corrected = one("temperature", linear=[3e-5] * 3, reference=20.0, quadratic=[4e-8] * 3).correct(truth)
    factor = 1 - 3e-5 * 10 - 4e-8 * 100
    assert_allclose(corrected["vector"].values, truth["vector"].values * factor, rtol=1e-15)


def test_a_missing_channel_is_told_with_effect_and_remedy():
    model = one("channel_field", coefficient=[1, 2, 3])
    with pytest.raises(SamplesError, match=r"solar_current.*channel_field.*drop the effect"):
        model.correct(true_samples(0).drop_vars("solar_current"))


def test_a_channel_of_another_dimension_is_refused():
    truth = true_samples(0)
    truth["coil_temperature"].attrs["units"] = "mA"
    with pytest.raises(SamplesError, match=r"coil_temperature.*cannot become.*correct the channel's unit"):
        one("temperature").correct(truth)


class Follower(Effect):
    """Follows the field without saying so."""

    def field(self, samples, values, sensor):
        return 1e-5 * best_field(samples)


def test_an_effect_that_follows_the_field_without_saying_so_is_refused_at_a_vector_sensor():
    entry = ModelEffect(Follower(), SENSORS["fgm"], {})
    with pytest.raises(SamplesError, match=r"field is not known.*follows_field"):
        Model("m", "champ", "main", (entry,)).correct(true_samples(0))


@pytest.mark.parametrize(("name", "key"), [("induced", "diagonal"), ("eddy", "diagonal")])
def test_an_effect_that_follows_the_field_is_solved_for_at_a_vector_sensor(name, key):
    truth = true_samples(0)
    model = model_of({"effect": name, "sensor": "fgm", key: [0.01, -0.02, 0.03]})
    raw = model.disturb(truth)
    effect, samples = model.effects[0], with_field(truth, raw["vector"].values)
    added = effect.effect.field(samples, effect.values(0), effect.sensor)
    assert_allclose(raw["vector"].values - truth["vector"].values, added, rtol=0, atol=1e-9)
    assert not effect.is_additive


def test_an_effect_that_repetition_does_not_find_is_solved_for():
    truth = true_samples(0)
    model = model_of({"effect": "eddy", "sensor": "fgm", "diagonal": [3.0, 1.0, 1.0]})
    back = model.correct(model.disturb(truth))
    assert_allclose(back["vector"].values, truth["vector"].values, rtol=0, atol=1e-6)


def test_an_effect_too_strong_to_be_told_from_the_field_is_refused():
    model = model_of({"effect": "eddy", "sensor": "fgm", "diagonal": [1e9, 1.0, 1.0]})
    with pytest.raises(ModelError, match="too strong"):
        model.disturb(true_samples(0))


@pytest.mark.parametrize("name", sorted(PLACES))
def test_parameters_said_to_be_linear_are(name):
    """Within a typical step the correction bends by less than a thousandth of what it moves."""
    entry = model_of(entry_of(name, np.random.default_rng(5))).effects[0]
    truth = with_field(true_samples(4), true_samples(4)["vector"].values)
    reading = truth[entry.sensor.role].values
    values = {key: np.array(value) for key, value in entry.values(0).items()}
    for key, parameter in entry.effect.parameters().items():
        if not parameter.linear or not np.isfinite(parameter.sigma):
            continue
        for index in range(parameter.size):
            corrected = []
            for sign in (-1, 0, 1):
                moved = values | {
                    key: values[key] + sign * parameter.step * (np.arange(parameter.size) == index)
                }
                corrected.append(entry.effect.correct(reading, truth, moved, entry.sensor))
            low, middle, high = corrected
            slope, bend = np.nanmax(np.abs(high - low)), np.nanmax(np.abs(high + low - 2 * middle))
            assert slope > 0, (key, index)
            assert bend < 1e-3 * slope + ROUNDING, (key, index)


def test_a_correction_forgets_the_field_of_an_earlier_one():
    """Samples that went through another model keep nothing of it."""
    truth = true_samples(0)
    model = Model.parse(PREFLIGHT, MISSION)
    raw = model.disturb(truth)
    spoiled = raw.assign(field=raw["vector"] * 0 + 1.0)
    assert_allclose(model.correct(spoiled)["scalar"].values, truth["scalar"].values, rtol=0, atol=1e-9)


def test_missing_samples_stay_missing_and_harm_no_neighbour():
    truth = true_samples(5)
    model = Model.parse(PREFLIGHT, MISSION)
    raw = model.disturb(truth)
    holes = raw["vector"].values.copy()
    holes[100:110] = np.nan
    back = model.correct(raw.assign(vector=(("time", "axis"), holes)))
    gone = np.zeros(400, dtype=bool)
    gone[100:110] = True
    assert np.isnan(back["field"].values[gone]).all()
    assert_allclose(back["field"].values[~gone], truth["vector"].values[~gone], rtol=0, atol=1e-9)
    assert np.isnan(back["scalar"].values[gone]).all(), "without a direction no projection is known"


class Doubling(Effect):
    """A user's own effect, in ten lines."""

    channels = ("solar_current",)
    gain = Parameter("nT/A", ("x", "y", "z"))

    def field(self, samples, values, sensor):
        return self.channel(samples, "A")[:, None] * values["gain"] * 2.0


def test_a_users_own_effect_is_exact_too():
    from inflight.effects import registry

    registry.register(Doubling)
    try:
        model = Model(
            "m", "champ", "main", (make_effect({"effect": "doubling", "gain": [1, -2, 3]}, SENSORS),)
        )
        truth = true_samples(0)
        raw = model.disturb(truth)
        added = 2e-3 * truth["solar_current"].values[:, None] * np.array([1, -2, 3])
        assert_allclose(raw["vector"].values - truth["vector"].values, added, rtol=0, atol=1e-9)
        assert xr.testing.assert_allclose(model.correct(raw)["vector"], truth["vector"], rtol=1e-12) is None
    finally:
        registry._registered.pop("doubling")


def test_a_slow_scalar_sensor_reads_the_mean_over_its_response():
    # A Gaussian response of 0.5 s, on a field that swings as it does along an orbit, sampled each second.
    count, spread = 4000, 0.5
    seconds = np.arange(count, dtype=np.float64)
    rate = 2 * np.pi * 2 / 5580
    strength = 45_000 + 15_000 * np.cos(rate * seconds)
    seen = 45_000 + 15_000 * np.cos(rate * seconds) * np.exp(-0.5 * (rate * spread) ** 2)
    truth = xr.Dataset(
        {
            "vector": (("time", "axis"), strength[:, None] * np.array([0.0, 0.6, 0.8])),
            "scalar": ("time", strength),
            "tt2000": ("time", (seconds * SECOND).astype(np.int64)),
        }
    )
    raw = one("scalar_response", half_variance=spread**2 / 2).disturb(truth)["scalar"].values
    inner = slice(40, -40)
    assert np.abs(seen - strength).max() > 5e-3
    np.testing.assert_allclose(raw[inner], seen[inner], rtol=0, atol=2e-6)


@pytest.mark.parametrize(("name", "shape"), [("channel_field", False), ("tone", True), ("wander", True)])
def test_what_is_there_for_its_shape_says_so_in_the_model_and_in_a_worker(name, shape):
    entry = entry_of(name, np.random.default_rng(1), "constant")
    plain, marked = model_of(entry), model_of(entry | {"empirical": True})
    assert plain.empirical == ([plain.effects[-1].name] if shape else [])
    assert marked.empirical == [marked.effects[-1].name]
    assert ("empirical: true" in marked.text) is not shape, "of a shape the class says it"
    again = Model.parse(marked.text, MISSION)
    assert again.text == marked.text
    assert pickle.loads(pickle.dumps(marked.effects[-1])).effect.empirical
