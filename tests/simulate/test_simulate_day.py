"""Whole simulated days: noise floor, reproducibility, leap seconds, switches, defects."""

import json

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from inflight.simulate import Parameters, SimulationSettings, effect_names, simulate_day
from inflight.simulate.fluxgate import reading, solve_reading
from inflight.simulate.overhauser import low_pass
from inflight.simulate.randomness import drift
from inflight.simulate.settings import EXTRA_EFFECTS, STANDARD_EFFECTS
from inflight.time import SECOND, day_bounds, in_leap_second

CLEAN = SimulationSettings(defects=())
COARSE = SimulationSettings(defects=(), cadence=10)


def perfect_vector(day, parameters=Parameters()):  # noqa: B008 - immutable
    """The fluxgate corrected with the truth, in the order of Yin (2010), 2.4, written out here."""
    fgm, truth = day.instruments["fgm"], day.truth
    mjd = 0.5 + (fgm["Epoch"].values / 1e9 - 64.2) / 86400.0
    scale = np.array(parameters.scale_constant) + np.log(mjd - 150.0)[:, None] * parameters.scale_log
    e = fgm["FGM_RAW"].values - np.array(parameters.offset)
    e = scale * e + np.array(parameters.quadratic) * e**2 + np.array(parameters.cubic) * e**3
    excess = (truth["T_EFF"].values - parameters.temperature_reference)[:, None]
    e = e * (1.0 - excess * parameters.temperature_linear - parameters.temperature_quadratic * excess**2)
    xy, xz, yz = np.cos(np.radians(parameters.angles))
    return e @ np.array([[1.0, xy, xz], [0.0, 1.0, yz], [0.0, 0.0, 1.0]]).T - truth["STRAY_VECTOR"].values


def perfect_scalar(day, parameters=Parameters()):  # noqa: B008 - immutable
    """The Overhauser magnetometer corrected with the truth, Yin (2010), 2.5."""
    ovm, field = day.instruments["ovm"], day.truth["FIELD"].values
    strength = ovm["F"].values * ovm["F_OSC_RATIO"].values
    strength = strength + parameters.time_shift * np.gradient(strength, ovm["Epoch"].values / 1e9)
    induced = np.array(parameters.induced_first) + np.array(parameters.induced_second)
    added = day.truth["STRAY_SCALAR"].values + np.array(parameters.heading) + induced * field
    return strength - np.einsum("ij,ij->i", field, added) / np.linalg.norm(field, axis=1)


def test_perfect_calibration_leaves_the_noise_and_nothing_else():
    """Quantisation of both sensors and the differentiated scalar noise add less than 2 %."""
    day = simulate_day(CLEAN, "2005-01-01")
    vector, scalar = perfect_vector(day), perfect_scalar(day)
    floor = np.hypot(CLEAN.vector_noise, CLEAN.scalar_noise)
    residual = np.linalg.norm(vector, axis=1) - scalar
    assert residual[2:-2].std() == pytest.approx(floor, rel=0.02)
    assert abs(residual.mean()) < 0.003
    error = vector - day.truth["FIELD"].values
    assert error.std(axis=0) == pytest.approx(CLEAN.vector_noise, rel=0.02)
    assert np.abs(error.mean(axis=0)).max() < 0.002
    assert np.abs((scalar - day.truth["STRENGTH"].values).mean()) < 0.002


def test_both_sensors_see_the_common_field():
    """With every effect removed the readings are the field, and the residual of noiseless sensors nil."""
    bare = SimulationSettings(
        defects=(), vector_noise=0, scalar_noise=0, resolution=0, without=tuple(STANDARD_EFFECTS)
    )
    with_ionosphere = bare.model_copy(update={"without": tuple(set(STANDARD_EFFECTS) - {"external_field"})})
    for wanted in (bare, with_ionosphere):
        day = simulate_day(wanted, "2005-01-01")
        scale = np.array(Parameters().scale_constant) + np.log(850.0) * np.array(Parameters().scale_log)
        vector = day.instruments["fgm"]["FGM_RAW"].values * scale
        assert vector == pytest.approx(day.truth["FIELD"].values, abs=1e-8)
        assert np.linalg.norm(vector, axis=1) == pytest.approx(day.instruments["ovm"]["F"].values, abs=1e-8)
    quiet = simulate_day(bare, "2005-01-01").truth["STRENGTH"].values
    difference = day.truth["STRENGTH"].values - quiet
    assert 2.0 < difference.std() < 8.0, "the external field is in both sensors"


def test_uncorrected_residual_is_tens_of_nanotesla():
    day = simulate_day(CLEAN, "2005-01-01")
    raw = (
        np.linalg.norm(day.instruments["fgm"]["FGM_RAW"].values, axis=1) - day.instruments["ovm"]["F"].values
    )
    assert 20.0 < np.abs(raw).mean() < 200.0


def test_a_day_is_the_same_alone_and_in_a_range():
    span = SimulationSettings(start="2005-02-01", days=4, seed=7)
    days = [simulate_day(span, day) for day in span.day_list]
    alone = simulate_day(SimulationSettings(start="2005-02-03", days=1, seed=7), "2005-02-03")
    for name, data in alone.instruments.items():
        assert data.identical(days[2].instruments[name])
    assert alone.truth.identical(days[2].truth)
    other = simulate_day(SimulationSettings(seed=8), "2005-02-03")
    assert not other.truth.equals(alone.truth)


def test_field_and_currents_go_on_over_midnight():
    first, second = (simulate_day(CLEAN, day) for day in ("2005-02-01", "2005-02-02"))
    for name, slack in (("FIELD", 0.01), ("STRENGTH", 0.01), ("T_EFF", 1e-4), ("I_PANEL", 1e-3)):
        joined = np.concatenate([first.truth[name].values[-4:], second.truth[name].values[:4]])
        bend = np.abs(np.diff(joined, n=2, axis=0))
        assert bend[2:4].max() < bend[[0, -1]].max() + slack, name


@pytest.mark.parametrize("day", ["2005-12-31", "2008-12-31"])
def test_a_day_with_a_leap_second_has_86401_samples(day):
    simulated = simulate_day(CLEAN, day)
    for name, step in (("fgm", 1), ("ovm", 1), ("tq", 1), ("hk", 10), ("att", 5), ("orb", 10)):
        epoch = simulated.instruments[name]["Epoch"].values
        assert epoch.size == -(-86401 // step)
        assert (np.diff(epoch) == step * SECOND).all()
        assert (epoch[0], epoch[-1] < day_bounds(day)[1]) == (day_bounds(day)[0], True)
    assert in_leap_second(simulated.instruments["fgm"]["Epoch"].values)[-1]
    bend = np.diff(simulated.truth["FIELD"].values[-10:], n=2, axis=0)
    assert np.abs(bend).max() < 0.5, "the spacecraft flies on through the inserted second"


@pytest.mark.parametrize("effect", effect_names())
def test_every_effect_can_be_switched_and_is_seen(effect):
    day = "2008-09-01" if effect == "clock_fault" else "2005-01-01"
    base = COARSE.model_copy(update={"cadence": 1}) if effect == "scalar_filter" else COARSE
    extra = effect in EXTRA_EFFECTS
    changed = base.model_copy(update={"include" if extra else "without": (effect,)})
    before, after = simulate_day(base, day), simulate_day(changed, day)
    moved = {
        name: float(np.abs(before.instruments[name][key].values - after.instruments[name][key].values).max())
        for name, key in (("fgm", "FGM_RAW"), ("ovm", "F"))
    }
    assert max(moved.values()) > 0.02
    vector_only = {"ageing", "misalignment", "offset", "nonlinearity", "temperature", "temperature_lag"}
    vector_only |= {"day_night", "unrecorded_heater", "hysteresis", "adc_temperature", "eddy"}
    vector_only |= {"offset_steps", "offset_drift"}
    scalar_only = {"time_shift", "oscillator", "heading", "induced", "scalar_filter", "scalar_bias"}
    scalar_only |= {"clock_fault"}
    assert (moved["ovm"] == 0.0) == (effect in vector_only)
    assert (moved["fgm"] == 0.0) == (effect in scalar_only)


def test_a_hidden_effect_is_in_the_data_and_only_the_truth_names_it():
    hidden = simulate_day(COARSE.model_copy(update={"hide": ("day_night",)}), "2005-01-01")
    included = simulate_day(COARSE.model_copy(update={"include": ("day_night",)}), "2005-01-01")
    for name, data in included.instruments.items():
        assert data.identical(hidden.instruments[name])
        assert "day_night" not in str(hidden.instruments[name].to_dict(data=False))
    assert json.loads(hidden.truth.attrs["hidden"]) == ["day_night"]
    assert "day_night" in json.loads(hidden.truth.attrs["effects"])


def test_day_night_field_adds_its_size_in_sunlight_only():
    on = simulate_day(COARSE.model_copy(update={"include": ("day_night",)}), "2005-01-01").truth
    off = simulate_day(COARSE, "2005-01-01").truth
    added = on["STRAY_VECTOR"].values - off["STRAY_VECTOR"].values
    assert added[:, 2] == pytest.approx(0.65 * on["SUNLIT"].values)
    assert not added[:, :2].any()


def test_unknown_names_and_contradictions_are_refused():
    with pytest.raises(ValidationError, match=r"no effect .*gremlins"):
        SimulationSettings(hide=("gremlins",))
    with pytest.raises(ValidationError, match="both in the data and without"):
        SimulationSettings(hide=("torquer",), without=("torquer",))
    with pytest.raises(ValidationError, match="no parameter 'scale'"):
        SimulationSettings(overrides={"scale": 1.0})
    with pytest.raises(ValidationError, match="3 values expected"):
        SimulationSettings(overrides={"offset": [1.0, 2.0]})


def test_an_override_moves_the_truth():
    moved = SimulationSettings(
        defects=(), cadence=10, vector_noise=0, resolution=0, overrides={"offset": [127.0, 19.843, 21.625]}
    )
    still = moved.model_copy(update={"overrides": {}})
    difference = (
        simulate_day(moved, "2005-01-01").instruments["fgm"]["FGM_RAW"]
        - simulate_day(still, "2005-01-01").instruments["fgm"]["FGM_RAW"]
    )
    assert difference.values == pytest.approx(np.broadcast_to([100.03, 0.0, 0.0], difference.shape), abs=1e-8)


def test_truth_gives_the_nine_parameters_of_the_triangular_matrix():
    """``B = K (E - E0)`` with K's entries from the truth reproduces the chain without its finer terms."""
    settings_ = SimulationSettings(
        defects=(),
        vector_noise=0,
        resolution=0,
        without=("ageing", "nonlinearity", "temperature"),
        cadence=10,
    )
    day = simulate_day(settings_, "2005-01-01")
    nine = json.loads(day.truth.attrs["nine_parameters"])
    k = np.diag(nine["scale_factor"])
    k[0, 1], k[0, 2], k[1, 2] = np.cos(np.radians(nine["misalignment"]))
    corrected = (day.instruments["fgm"]["FGM_RAW"].values - nine["offset"]) @ k.T
    expected = day.truth["FIELD"].values + day.truth["STRAY_VECTOR"].values
    assert corrected == pytest.approx(expected, abs=1e-8)


@settings(max_examples=50)
@given(
    field=st.lists(st.tuples(*[st.floats(-65000.0, 65000.0)] * 3), min_size=1, max_size=5),
    factor=st.floats(0.999, 1.001),
)
def test_fluxgate_is_the_exact_inverse_of_the_thesis_chain(field, factor):
    parameters = Parameters()
    sensed = np.array(field)
    scale = np.full_like(sensed, 1.002) + np.array([0.0, 1e-4, 3e-4])
    offset = np.array(parameters.offset)
    e = (
        reading(
            sensed,
            scale,
            np.full_like(sensed, factor),
            offset,
            parameters=parameters,
            effects={"misalignment", "nonlinearity"},
        )
        - offset
    )
    straight = scale * e + np.array(parameters.quadratic) * e**2 + np.array(parameters.cubic) * e**3
    xy, xz, yz = np.cos(np.radians(parameters.angles))
    x, y, z = (straight * factor).T
    assert np.column_stack([x + xy * y + xz * z, y + yz * z, z]) == pytest.approx(sensed, abs=1e-9)


def test_cubic_is_solved_to_rounding():
    wanted = np.linspace(-65000.0, 65000.0, 1001)
    found = solve_reading(wanted, np.array(1.002), np.array(2e-11), np.array(2.5e-16))
    assert 1.002 * found + 2e-11 * found**2 + 2.5e-16 * found**3 == pytest.approx(wanted, abs=3e-11)


def test_scalar_filter_keeps_slopes_to_the_ends_and_has_its_bandwidth():
    ramp = 40000.0 + 33.0 * np.arange(400)
    assert low_pass(ramp, 0.28, 1.0) == pytest.approx(ramp, abs=1e-9)
    wave = np.sin(2.0 * np.pi * 0.28 / 16.0 * np.arange(4000))
    passed = low_pass(wave, 0.28, 1.0 / 16.0)[500:-500]
    assert np.ptp(passed) / 2.0 == pytest.approx(np.sqrt(0.5), rel=0.01)


def test_defects_fall_where_seed_and_day_say_and_leave_the_truth_alone():
    every = ("gaps", "duplicates", "fill_values", "clock_step", "unsorted", "flags", "spikes")
    broken = SimulationSettings(cadence=10, defects=every)
    clean, hurt = simulate_day(COARSE, "2005-01-05"), simulate_day(broken, "2005-01-05")
    assert hurt.truth["FIELD"].identical(clean.truth["FIELD"])
    again = simulate_day(broken, "2005-01-05")
    assert all(again.instruments[name].identical(data) for name, data in hurt.instruments.items())
    fgm = hurt.instruments["fgm"]
    assert fgm["FGM_FLAG"].values.any()
    assert (fgm["FGM_RAW"].values > 90000.0).any()
    assert (np.diff(fgm["Epoch"].values) <= 0).any()
    assert np.unique(fgm["Epoch"].values).size < fgm["Epoch"].size


def test_missing_days_drop_an_instrument_now_and_then():
    wanted = SimulationSettings(cadence=10, defects=("missing_days",), without=("external_field",))
    absent = {
        (str(day), name)
        for day in wanted.model_copy(update={"days": 25}).day_list
        for name in {"fgm", "ovm"} - set(simulate_day(wanted, day).instruments)
    }
    assert 1 <= len(absent) <= 8


def test_ordinary_gaps_are_short_and_few():
    lost = [
        86400 - simulate_day(SimulationSettings(), f"2005-01-0{day}").instruments[name].sizes["record"]
        for day in range(1, 5)
        for name in ("fgm", "ovm")
    ]
    assert 0 < sum(lost) < 8 * 400


def test_a_second_fluxgate_changes_nothing_of_the_others():
    settings = SimulationSettings(cadence=10, defects=("gaps", "flags", "spikes"))
    alone = simulate_day(settings, "2005-01-02")
    both = simulate_day(settings.model_copy(update={"second_fluxgate": True}), "2005-01-02")
    assert set(both.instruments) - set(alone.instruments) == {"fgm2"}
    for name, data in alone.instruments.items():
        xr.testing.assert_identical(both.instruments[name], data)
    xr.testing.assert_identical(both.truth.drop_vars("STRAY_SECOND").drop_attrs(), alone.truth.drop_attrs())


@pytest.mark.parametrize("effect", ["day_night", "eddy", "hysteresis", "offset_steps", "adc_temperature"])
def test_what_is_at_one_sensor_only_does_not_reach_the_second_fluxgate(effect):
    plain = SimulationSettings(cadence=10, second_fluxgate=True, defects=())
    moved, still = (
        simulate_day(settings, "2005-01-05").instruments
        for settings in (plain.model_copy(update={"include": (effect,)}), plain)
    )
    assert np.array_equal(moved["fgm2"]["FGM_RAW"].values, still["fgm2"]["FGM_RAW"].values)
    assert not np.array_equal(moved["fgm"]["FGM_RAW"].values, still["fgm"]["FGM_RAW"].values)


def test_the_second_fluxgate_is_in_the_field_of_the_same_dipoles_at_its_own_place():
    near = SimulationSettings(cadence=10, second_fluxgate=True, defects=(), without=("torquer",))
    there = near.model_copy(update={"overrides": {"second_position": [4.75, 0.0, 0.0]}})
    truth = simulate_day(there, "2005-01-02").truth
    assert np.allclose(truth["STRAY_SECOND"].values, truth["STRAY_VECTOR"].values, atol=1e-9)
    farther = simulate_day(near, "2005-01-02").truth
    camera_and_body = np.abs(farther["STRAY_SECOND"].values).mean(axis=0)
    assert (camera_and_body < np.abs(farther["STRAY_VECTOR"].values).mean(axis=0)).all()


def test_the_nine_parameters_of_the_second_fluxgate_are_in_the_truth():
    settings = SimulationSettings(
        cadence=10,
        second_fluxgate=True,
        defects=(),
        vector_noise=0.0,
        resolution=0.0,
        without=tuple(name for name in STANDARD_EFFECTS if name not in ("ageing", "misalignment", "offset")),
    )
    day = simulate_day(settings, "2005-01-02")
    nine = json.loads(day.truth.attrs["nine_parameters_second"])
    k = np.diag(nine["scale_factor"])
    k[0, 1], k[0, 2], k[1, 2] = np.cos(np.radians(nine["misalignment"]))
    corrected = (day.instruments["fgm2"]["FGM_RAW"].values - nine["offset"]) @ k.T
    turn = Rotation.from_rotvec(settings.parameters.second_rotation, degrees=True)
    assert np.abs(turn.apply(corrected) - day.truth["FIELD"].values).max() < 0.02


@pytest.mark.parametrize("count", [0, 1, 700, 5000, 86_400])
def test_coloured_noise_is_the_same_at_even_steps_and_at_any_times(count):
    """A long series at even steps is summed in blocks; with a time left out wave by wave at every time."""
    seconds = 3.9e8 + 0.123 + np.arange(count)
    kept = np.arange(count) != 300
    asked = {"seed": 3, "stream": "any", "rms": (1.0, 2.0), "periods": (250.0, 4e5)}
    whole = drift(seconds, **asked)
    assert whole.shape == (count, 2)
    assert np.allclose(whole[kept], drift(seconds[kept], **asked), rtol=0.0, atol=1e-7)
