"""The field that day and night switch: recovered with honest errors, and what it does when ignored."""

import json

import numpy as np
import pytest
import xarray as xr
from day_night_cases import (
    MIDNIGHT,
    NOON,
    PRIOR_SIGMA,
    mission,
    noise,
    orbit_day,
    residual_of,
    series_day,
    sun_phase,
    switched_day,
)

from inflight.calibration import block_equations, concat_equations
from inflight.errors import CalibrationError, SamplesError
from inflight.mission import Mission
from inflight.mission_fit import (
    SERIES,
    SWITCHED,
    block_parameters,
    fit_day_night,
    orbit_period,
    orbit_plane_sun,
    sunlit_duty,
)
from inflight.mission_fit.day_night import series_columns
from inflight.model import Model

MISSION = Mission.parse(
    """
mission: champ
instruments:
  fgm:
    role: vector
    cadence: 1 s
    files: {pattern: "a_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels: {field: {variable: B, unit: nT, axes: [x, y, z]}}
  ovm:
    role: scalar
    cadence: 1 s
    files: {pattern: "b_{day:%Y%m%d}.cdf", reader: cdf, time: Epoch}
    channels: {field: {variable: F, unit: nT}}
comparisons: {main: {kind: scalar, vector: fgm, scalar: ovm}}
"""
)

#: 66 days over one turn of local time.
CYCLE = tuple(range(2000, 2264, 4))
TEN = (2004, 2030, 2100, 2110, 2120, 2150, 2160, 2230, 2240, 2250)


# Geometry.


@pytest.mark.parametrize("mjd", [NOON, MIDNIGHT, 1833, 1898, 1963, 2028])
def test_the_duty_by_geometry_is_that_of_the_samples(mjd):
    day = orbit_day(mjd)
    # The Sun's declination and the equation of time (h), from the calendar; local time falls by 0.09 h a day.
    turn = 2 * np.pi * (mjd % 365.25 - 80.0) / 365.25
    declination = 23.44 * np.sin(turn)
    early = (9.87 * np.sin(2 * turn) - 7.53 * np.cos(turn) - 1.5 * np.sin(turn)) / 60.0
    beta = orbit_plane_sun(np.array(day.local_time + early - 0.046), np.array(declination), 87.3)
    assert float(sunlit_duty(day.altitude, beta)) == pytest.approx(day.sunlit_part, abs=0.004)


def test_the_shortest_day_is_three_fifths_of_the_orbit_and_never_the_printed_two_fifths():
    declination = np.linspace(-23.44, 23.44, 101)
    for hour in (0.0, 12.0):
        duty = sunlit_duty(400.0, orbit_plane_sun(np.array(hour), declination, 87.3))
        assert np.all((duty > 0.60) & (duty < 0.63))
        assert np.all((duty * orbit_period(400.0) / 60 > 55) & (duty * orbit_period(400.0) / 60 < 58))


def test_the_sun_stands_off_the_plane_by_local_time():
    beta = orbit_plane_sun(np.array([0.0, 6.0, 12.0, 18.0]), np.zeros(4), 90.0)
    np.testing.assert_allclose(beta, [0.0, -90.0, 0.0, 90.0], atol=1e-6)
    assert sunlit_duty(400.0, np.array(90.0)) == 1.0


# The fit.


@pytest.mark.parametrize("field", [(0.3, 0.0, 0.65), (-0.3, 0.2, -0.65)])
def test_a_switched_field_is_recovered_with_its_sign(field):
    found = fit_day_night(mission(TEN, field, seed=1))
    assert found.columns == tuple(f"{SWITCHED}[{axis}]" for axis in "xyz")
    assert found.determined.all()
    assert np.all(np.abs(found.value - field) < 3 * found.sigma)
    assert np.all(found.sigma[[0, 2]] < 0.02)
    assert found.after < found.before


def test_the_stated_error_covers_the_truth_as_often_as_it_says():
    """200 seeds of 10 days, noise correlated over hours."""
    field = np.array([0.2, 0.0, 0.5])
    pulls = []
    for seed in range(200):
        found = fit_day_night(mission(TEN, field, seed, robust=False))
        pulls.append((found.value - field) / found.sigma)
    inside = np.mean(np.abs(pulls) < 1.0, axis=0)
    assert np.all((inside > 0.60) & (inside < 0.76)), inside
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 0.3)


def test_gaps_missing_values_and_outliers_are_borne():
    field, generator, blocks = np.array([0.0, 0.0, 0.65]), np.random.default_rng(5), []
    for mjd in TEN:
        columns, day = dict(switched_day(mjd)), orbit_day(mjd)
        y = residual_of(mjd, field) + noise(generator, day.strength.size)
        y[generator.random(y.size) < 0.005] += 50.0
        y[400:900] = np.nan
        columns[f"{SWITCHED}[z]"] = np.where(np.arange(y.size) // 50 == 30, np.nan, columns[f"{SWITCHED}[z]"])
        blocks.append(block_equations(columns, y, day.span))
    found = fit_day_night(concat_equations(blocks))
    assert np.all(np.abs(found.value - field) < 3 * found.sigma)
    assert found.sigma[2] < 0.02
    assert blocks[0].dataset["count"].item() < 2400


def test_the_constant_part_is_not_told_from_an_offset():
    found = fit_day_night(mission(TEN, (0, 0, 0.65), columns=lambda mjd: series_day(mjd, 3, constant=True)))
    constant = np.array([name.endswith("0]") for name in found.columns])
    assert constant.sum() == 2
    assert not found.determined[constant].any()
    assert np.all(found.retained[constant] < 1e-6)
    assert np.all(np.isinf(found.sigma[constant]))
    assert found.determined[~constant].any()


def test_a_series_is_recovered_from_one_day_with_its_orbits_as_blocks():
    truth = {f"{SERIES}[cx1]": 0.2, f"{SERIES}[cz1]": 0.4, f"{SERIES}[cz2]": -0.15}
    columns, day = series_day(NOON, 2), orbit_day(NOON)
    y = noise(np.random.default_rng(2), day.strength.size) - sum(
        columns[name] * a for name, a in truth.items()
    )
    blocks, start = [], day.span[0]
    for part in np.array_split(np.arange(y.size), 15):
        span = (start + int(part[0]) * 30_000_000_000, start + int(part[-1] + 1) * 30_000_000_000)
        blocks.append(block_equations({name: c[part] for name, c in columns.items()}, y[part], span))
    found = fit_day_night(concat_equations(blocks), each_block=False)
    wanted = np.array([truth.get(name, 0.0) for name in found.columns])
    assert np.all(np.abs(found.value - wanted) < 3.5 * found.sigma)
    curve, sigma = found.series(sun_phase(NOON))
    expected = wanted[found.columns.index(f"{SERIES}[cz1]")] * np.cos(np.deg2rad(sun_phase(NOON)))
    expected = expected - 0.15 * np.cos(2 * np.deg2rad(sun_phase(NOON)))
    assert np.all(np.abs(curve[:, 2] - expected) < 4 * sigma[:, 2] + 1e-9)


def test_the_result_is_a_table():
    found = fit_day_night(mission(TEN, (0, 0, 0.65)))
    table = found.table()
    assert set(table["units"].values) == {"nT"}
    assert table.attrs["at"] == "difference"
    np.testing.assert_allclose(np.sqrt(np.diag(table["covariance"].values)), table["sigma"].values)


@pytest.mark.parametrize("columns", [switched_day, lambda mjd: series_day(mjd, 3)])
def test_the_result_is_an_effect_of_a_model_that_takes_the_field_away(columns):
    """The model's own correction of a reading is that of the fit."""
    found = fit_day_night(mission(TEN, (0.3, 0, 0.65), columns=columns))
    entry = found.entry("fgm")
    text = f"model: m\nversion: 1\nmission: champ\ncomparison: main\neffects: {json.dumps([entry])}\n"
    model = Model.parse(text, MISSION)
    day = orbit_day(NOON)
    samples = xr.Dataset(
        {
            "sunlit": ("time", day.sunlit, {"units": "1"}),
            "sun_phase": ("time", sun_phase(NOON), {"units": "deg"}),
        }
    )
    effect = model.effects[0]
    field = effect.effect.field(samples, effect.values(0), effect.sensor)
    made = sum(-columns(NOON)[name] * value for name, value in found.values.items())
    np.testing.assert_allclose(np.einsum("ta,ta->t", day.direction, field), made, atol=1e-12)


def test_too_few_blocks_no_columns_and_no_night_are_refused():
    with pytest.raises(CalibrationError, match="3 clusters"):
        fit_day_night(mission(TEN[:3], (0, 0, 0.65)))
    with pytest.raises(CalibrationError, match="no day/night column"):
        fit_day_night(mission(TEN, (0, 0, 0.65)).select([f"vector_sensor.offset[{axis}]" for axis in "xyz"]))
    full = [mjd for mjd in range(1855, 1875) if orbit_day(mjd).sunlit.min() == 1.0]
    assert len(full) > 5
    with pytest.raises(CalibrationError, match="any night"):
        fit_day_night(mission(full, (0, 0, 0.65)))
    day = orbit_day(NOON)
    with pytest.raises(CalibrationError, match="usable rows"):
        block_equations(switched_day(NOON), np.full(day.strength.size, np.nan), day.span)
    with pytest.raises(SamplesError, match="order 0"):
        series_columns(orbit_day(NOON).direction, sun_phase(NOON), 0)


# The wander of the angles.


def cycle_amplitude(days, values) -> tuple[float, float]:
    """Amplitude at 260.5 d, and which part of the variance it explains."""
    turn = 2 * np.pi * np.asarray(days) / 260.5
    rows = np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)], axis=1)
    found = np.linalg.lstsq(rows, values)[0]
    return float(np.hypot(*found[1:])), float(1 - np.var(values - rows @ found) / np.var(values))


def test_a_day_night_field_makes_the_angles_wander_with_local_time_and_adding_it_ends_that():
    equations = mission(CYCLE, (0.0, 0.0, 0.65), seed=4)
    ignored = block_parameters(equations, PRIOR_SIGMA)
    xz = "vector_sensor.misalignment[xz]"
    assert ignored["units"].sel(parameter=xz).item() == "arcsec"
    amplitude, part = cycle_amplitude(CYCLE, ignored["value"].sel(parameter=xz).values)
    assert amplitude > 3.0
    assert part > 0.8
    # One period, not half of it as with temperature: noon and midnight go opposite ways.
    half, _ = cycle_amplitude(2 * np.array(CYCLE), ignored["value"].sel(parameter=xz).values)
    assert half < 0.35 * amplitude

    found = fit_day_night(equations)
    assert np.all(np.abs(found.value - [0, 0, 0.65]) < 3 * found.sigma)
    added = block_parameters(equations, PRIOR_SIGMA, found.values)["value"].sel(parameter=xz).values
    amplitude_after, part_after = cycle_amplitude(CYCLE, added)
    assert amplitude_after < 0.05 * amplitude
    assert part_after < 0.3


def test_a_day_night_field_on_x_makes_the_x_scale_factor_wander_instead():
    equations = mission(CYCLE[::2], (0.65, 0.0, 0.0), seed=6)
    ignored = block_parameters(equations, PRIOR_SIGMA)
    of_x = ignored["value"].sel(parameter="vector_sensor.scale_factor[x]").values
    of_xz = ignored["value"].sel(parameter="vector_sensor.misalignment[xz]").values
    amplitude, _ = cycle_amplitude(CYCLE[::2], of_x)
    assert 10 < amplitude < 16
    assert cycle_amplitude(CYCLE[::2], of_xz)[0] < 0.8, "a quarter of what the same field does on z"
    given = block_parameters(equations, PRIOR_SIGMA, fit_day_night(equations).values)
    after = given["value"].sel(parameter="vector_sensor.scale_factor[x]").values
    assert cycle_amplitude(CYCLE[::2], after)[0] < 0.1 * amplitude
