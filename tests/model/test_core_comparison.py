"""Rows of a residual: what a field at each sensor does to them, and the band they are seen in."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from inflight.dual import readings_of
from inflight.errors import MissionError, SamplesError
from inflight.flags import Flag
from inflight.mission import Mission, sensors_of
from inflight.model import Band, Model, ResidualDefinition, filter_rows, make_effect, rows_of
from inflight.time import day_bounds

ROOT = Path(__file__).parents[2]
COUNT = 300


def mission_of(name):
    return Mission.parse((ROOT / "missions" / f"{name}.yaml").read_text(encoding="utf-8"), name)


def model_of(mission, *entries):
    sensors = sensors_of(mission)
    effects = tuple(make_effect(entry, sensors) for entry in entries)
    return Model("case", mission.mission, "main", effects, layout=ResidualDefinition.of(mission))


def samples_of(layout, step_ns=1_000_000_000, seed=0):
    """True readings of every sensor of a layout, in its own axes."""
    g = np.random.default_rng(seed)
    body = np.array([20_000.0, -5_000.0, 40_000.0]) + np.cumsum(g.normal(0, 30, (COUNT, 3)), axis=0)
    held = {}
    for role, sensor in layout.sensors.items():
        own = sensor.rotation.inv().apply(body)
        held[role] = ("time", np.linalg.norm(own, axis=1)) if sensor.is_scalar else (("time", "axis"), own)
    held["tt2000"] = ("time", day_bounds("2017-02-12")[0] + step_ns * np.arange(COUNT))
    held["flag"] = ("time", np.zeros(COUNT, dtype=np.uint32))
    return xr.Dataset(held)


@pytest.mark.parametrize(("name", "sensor", "role"), [("goes16", "inboard", "inboard"),
                                                      ("goes16", "outboard", "outboard"),
                                                      ("conrad", "lemi", "vector")])  # fmt: skip
def test_a_small_field_changes_the_rows_as_the_directions_say(name, sensor, role):
    model = model_of(mission_of(name))
    samples = samples_of(model.layout)
    field = np.random.default_rng(1).normal(0, 0.01, (COUNT, 3))
    before = rows_of(model, samples)
    after = rows_of(model, samples.assign({role: samples[role] + field}))
    expected = np.einsum("tra,ta->tr", before.directions[sensor], field)
    np.testing.assert_allclose(after.residual - before.residual, expected, atol=1e-7)


@pytest.mark.parametrize(("name", "sensor"), [("conrad", "gp20s3"), ("magnav-tl", "mag_1")])
def test_a_field_at_the_scalar_sensor_is_seen_along_the_field(name, sensor):
    mission = mission_of(name)
    model = model_of(mission)
    samples = samples_of(model.layout, 100_000_000)
    vector = np.array([0.03, -0.02, 0.05])
    disturbed = model_of(
        mission, {"effect": "remanent", "sensor": sensor, "vector": vector.tolist()}
    ).disturb(samples)
    before, after = rows_of(model, samples), rows_of(model, disturbed)
    column = filter_rows(before.directions[sensor][:, 0] @ vector, before.step_s, before.kept)
    np.testing.assert_allclose((after.residual - before.residual)[:, 0], column, atol=1e-7)


def test_a_run_too_short_for_the_band_is_not_good():
    model = model_of(mission_of("magnav-tl"))
    samples = samples_of(model.layout, 100_000_000)
    samples["scalar"][[120, 180]] = np.nan
    rows = rows_of(model, samples)
    assert np.flatnonzero(~rows.good).tolist() == list(range(120, 181))
    assert np.isfinite(rows.residual[rows.good]).all()


def test_two_vector_sensors_in_one_field_leave_nothing_in_spacecraft_axes():
    model = model_of(mission_of("goes16"))
    rows = rows_of(model, samples_of(model.layout))
    assert rows.residual.shape == (COUNT, 3)
    assert np.abs(rows.residual).max() < 1e-6
    assert rows.kept is None
    assert rows.good.all()


def test_effects_on_either_of_two_sensors_are_taken_out_exactly():
    mission = mission_of("goes16")
    model = model_of(
        mission,
        {"effect": "vector_sensor", "sensor": "inboard", "offset": [1.0, -2.0, 3.0]},
        {"effect": "remanent", "sensor": "inboard", "vector": [0.5, 0.25, -0.5]},
        {
            "effect": "vector_sensor",
            "name": "other",
            "sensor": "outboard",
            "scale_factor": [1.001, 0.999, 1.0],
        },
    )
    samples = samples_of(model.layout)
    disturbed = model.disturb(samples)
    assert np.abs(model_of(mission).residual(disturbed)).max() > 1.0
    assert np.abs(model.residual(disturbed)).max() < 1e-6
    corrected = model.correct(disturbed)
    np.testing.assert_allclose(corrected["field"], samples["outboard"], atol=1e-7)
    np.testing.assert_allclose(corrected["inboard"], samples["inboard"], atol=1e-7)
    terms = model.correction_terms(corrected)
    np.testing.assert_allclose(terms["remanent"][0], [0.5, 0.25, -0.5])


def test_each_sensor_knows_its_own_field_in_its_own_axes():
    model = model_of(mission_of("goes16"))
    samples = samples_of(model.layout)
    rows = rows_of(model, samples)
    np.testing.assert_allclose(rows.fields["inboard"], samples["inboard"])
    np.testing.assert_allclose(rows.fields["outboard"], samples["outboard"])
    np.testing.assert_allclose(rows.field, samples["outboard"])


@pytest.mark.parametrize("bad", [Flag.VECTOR_MISSING, Flag.OUT_OF_RANGE, Flag.INSTRUMENT_FLAG])
def test_flagged_and_missing_samples_are_not_good(bad):
    model = model_of(mission_of("conrad"))
    samples = samples_of(model.layout)
    samples["flag"][3] = bad
    samples["flag"][4] = Flag.OUTLIER
    samples["scalar"][7] = np.nan
    rows = rows_of(model, samples)
    assert np.flatnonzero(~rows.good).tolist() == [3, 7]
    assert np.isnan(rows.residual[7, 0])


def test_what_has_no_rows_says_so():
    with pytest.raises(SamplesError, match="'vector'"):
        rows_of(model_of(mission_of("mms1")), xr.Dataset())
    model = model_of(mission_of("goes16"))
    with pytest.raises(SamplesError, match="'inboard'"):
        rows_of(model, samples_of(model.layout).drop_vars("inboard"))


def test_the_band_of_a_platform_comes_from_the_mission():
    text = (ROOT / "missions" / "magnav-tl.yaml").read_text(encoding="utf-8")
    assert ResidualDefinition.of(Mission.parse(text)).band == Band(0.1, 0.9)
    with pytest.raises(MissionError, match="rising"):
        Mission.parse(text.replace("[0.1, 0.9]", "[0.9, 0.1]"))


@settings(max_examples=25, deadline=None)
@given(st.floats(-5, 5), st.floats(-5, 5), st.integers(0, 2**31), st.booleans())
def test_the_band_is_linear_and_the_same_alone_or_together(a, b, seed, gap):
    g = np.random.default_rng(seed)
    x = np.cumsum(g.normal(size=(600, 2)), axis=0)
    if gap:
        x[300:310] = np.nan
    band = Band(0.1, 0.9)
    both = filter_rows(x, 0.1, band)
    mixed = filter_rows(x @ np.array([a, b]), 0.1, band)
    np.testing.assert_allclose(mixed, both @ np.array([a, b]), atol=1e-8)
    np.testing.assert_array_equal(np.isnan(both[:, 0]), np.isnan(x[:, 0]))


def test_the_band_keeps_what_is_inside_without_delay_and_drops_what_is_outside():
    seconds = 0.1 * np.arange(4000)
    inside, slow, fast = (np.sin(2 * np.pi * f * seconds) for f in (0.3, 0.01, 3.0))
    seen = filter_rows(np.column_stack([inside, slow, fast]), 0.1, Band(0.1, 0.9))[500:-500]
    np.testing.assert_allclose(seen[:, 0], inside[500:-500], atol=0.02)
    assert np.abs(seen[:, 1:]).max() < 1e-3


def test_runs_shorter_than_a_period_and_samples_not_good_are_left_out():
    values = np.random.default_rng(0).normal(size=500)
    good = np.ones(500, dtype=bool)
    good[[200, 250]] = False
    seen = filter_rows(values, 0.1, Band(0.1, 0.9), good)
    assert np.isnan(seen[200:251]).all()
    assert np.isfinite(seen[:200]).all()
    assert np.isfinite(seen[251:]).all()
    assert filter_rows(values, 0.1, None) is values


def test_a_band_above_the_nyquist_frequency_is_open_above():
    values = np.random.default_rng(0).normal(size=2000)
    seen = filter_rows(values, 1.0, Band(0.05, 0.9))
    assert 0.8 < seen.std() / values.std() < 1.0


def test_a_source_fitted_to_the_difference_stays_in_the_readings_that_states_are_learnt_from():
    mission = mission_of("goes16")
    sensor = {"effect": "vector_sensor", "sensor": "inboard", "offset": [1.0, -2.0, 3.0]}
    source = {"effect": "remanent", "sensor": "inboard", "vector": [0.5, 0.25, -0.5]}
    samples = samples_of(model_of(mission).layout)
    with_source, without = (
        readings_of(model_of(mission, *entries), samples)[0] for entries in ((sensor, source), (sensor,))
    )
    np.testing.assert_array_equal(with_source.inboard, without.inboard)
    raw = readings_of(model_of(mission), samples)[0]
    assert np.abs(without.inboard - raw.inboard).max() > 1.0
    np.testing.assert_array_equal(with_source.outboard, raw.outboard)
