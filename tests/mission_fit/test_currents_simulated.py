"""Currents' estimators on days of the simulated mission, against the dipoles behind them."""

import numpy as np
import pytest
import xarray as xr

from benchmarks.excursions import find_excursions
from inflight.dipole import dipole_split
from inflight.frames import add_geometry
from inflight.mission_fit import (
    band_equations,
    concat_epochs,
    extract_epochs,
    fit_band,
    fit_step,
    node_local_time,
    select_panel_model,
)
from inflight.mission_fit.superposed_epochs import Windows
from inflight.residual import find_steps
from inflight.simulate import Parameters, SimulationSettings, simulate_day
from inflight.simulate.stray import coefficients

#: The scalar sensor's matrix before the flight, nT/A (thesis p. 52).
BEFORE_FLIGHT = np.array([[7.40, -2.60, -2.40], [0.00, -10.70, 0.00], [-0.40, 0.30, -11.60]])
PARAMETERS = Parameters()
DIFFERENCE = {name: vector - scalar for name, (vector, scalar) in coefficients(PARAMETERS).items()}
CHANNELS = {
    "solar_current": "I_SOL",
    "battery_current": "I_BAT",
    "heater_current": "I_HTR",
    "camera_current": "I_CAM",
}


def residual_of(day, noise=0.09):
    """What two perfect sensors disagree by, with their noise; nT."""
    field, vector, scalar = (day.truth[name].values for name in ("FIELD", "STRAY_VECTOR", "STRAY_SCALAR"))
    seen = np.linalg.norm(field + vector, axis=1) - np.linalg.norm(field + scalar, axis=1)
    seed = int(day.day.astype(np.int64))
    return seen + noise * np.random.default_rng(seed).standard_normal(seen.size)


def samples_of(day):
    """Samples at 1 Hz: the field, housekeeping and geometry."""
    stamps, house = day.truth["Epoch"].values, day.instruments["hk"]

    def at(instrument, name):
        source = day.instruments[instrument]
        series = source[name].values
        return np.stack([np.interp(stamps, source["Epoch"].values, one) for one in series.T], axis=1)

    field = day.truth["FIELD"].values
    attitude = at("att", "Q")
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps),
            "field": (("time", "axis"), field),
            "vector": (("time", "axis"), field, {"orientation": (0.0, 0.0, 0.0, 1.0)}),
            "position": (("time", "axis"), at("orb", "POS_ITRF"), {"units": "km", "frame": "itrf"}),
            "attitude": (
                ("time", "quaternion"),
                attitude / np.linalg.norm(attitude, axis=1, keepdims=True),
                {"frame": "itrf"},
            ),
        }
    )
    for channel, name in CHANNELS.items():
        series = np.interp(stamps, house["Epoch"].values, house[name].values)
        samples[channel] = "time", series, {"units": "mA"}
    return add_geometry(samples)


@pytest.fixture(scope="module")
def solar():
    """Epochs of the solar current on every thirteenth day of a cycle of local time."""
    settings = SimulationSettings(without=("torquer", "star_camera"), defects=("gaps",))
    parts = []
    for number in range(20):
        day = simulate_day(settings, np.datetime64("2006-01-01") + 13 * number)
        house = day.instruments["hk"]
        steps = find_steps(house["Epoch"].values, house["I_SOL"].values / 1e3, smallest=1.0)
        others = ("battery_current", "heater_current", "sunlit")
        parts.append(
            extract_epochs(samples_of(day), residual_of(day), steps, channel="solar_current", others=others)
        )
    return concat_epochs(parts)


def test_the_panels_are_told_from_the_steps_with_the_battery_in_them(solar):
    """The array's current and the battery's step together: what is found is the sum of both."""
    battery = fit_step(solar).confounding[0]
    assert battery.correlation > 0.99
    assert battery.slope == pytest.approx(1.0, abs=0.02)
    places = (solar[name].values for name in ("local_time", "orbit_phase", "latitude"))
    hours = node_local_time(*places)
    choice = select_panel_model(solar, hours, areas=PARAMETERS.panel_peaks)
    constant = next(one for one in choice.models if one.name == "constant")
    assert not constant.ties
    sides = next(one for one in choice.models if one.name == "two_sides")
    truth = np.array([DIFFERENCE["panel_left"], DIFFERENCE["panel_right"]])
    truth = truth + battery.slope * DIFFERENCE["battery"]
    assert np.abs((sides.value - truth) / sides.sigma).max() < 3.5
    assert (sides.sigma[:, [0, 2]] < 0.003).all()


def test_a_step_s_difference_splits_into_both_sensors_for_a_source_on_the_boom():
    difference = DIFFERENCE["heater"]
    source = np.array(PARAMETERS.heater_position)
    split = dipole_split(difference, PARAMETERS.vector_position - source, PARAMETERS.scalar_position - source)
    vector, scalar = coefficients(PARAMETERS)["heater"]
    assert split.vector == pytest.approx(vector)
    assert split.scalar == pytest.approx(scalar)


def test_the_camera_s_nanotesla_per_ampere_is_found_by_the_same_code():
    # The currents that step in the same ten minutes have to be corrected for beforehand.
    known = SimulationSettings(without=("torquer", "solar_array", "battery", "heater"))
    parts = []
    for number in range(6):
        day = simulate_day(known, np.datetime64("2007-04-28") + number)
        house = day.instruments["hk"]
        found = find_excursions(house["Epoch"].values, house["I_CAM"].values / 1e3, longest=2400)
        shape = Windows(shape="current", order=3, field=True)
        parts.append(
            extract_epochs(samples_of(day), residual_of(day), found, channel="camera_current", windows=shape)
        )
    fit = fit_step(concat_epochs(parts), prior_sigma=3.0)
    best = int(np.argmin(fit.sigma[0]))
    # All excursions are at one place of the orbit: one direction of the field is told.
    assert fit.sigma[0, best] < 0.3
    assert np.abs((fit.value[0] - DIFFERENCE["camera"]) / fit.sigma[0]).max() < 3.5


def test_the_heater_s_steps_give_its_field_and_what_else_steps_is_said():
    known = SimulationSettings(without=("torquer", "solar_array", "battery", "star_camera"))
    parts = []
    for number in range(6):
        day = simulate_day(known, np.datetime64("2007-04-28") + number)
        house = day.instruments["hk"]
        found = find_steps(house["Epoch"].values, house["I_HTR"].values / 1e3)
        parts.append(
            extract_epochs(
                samples_of(day), residual_of(day), found, channel="heater_current", others=["battery_current"]
            )
        )
    fit = fit_step(concat_epochs(parts))
    assert np.abs((fit.value[0] - DIFFERENCE["heater"]) / fit.sigma[0]).max() < 3.5
    assert (fit.sigma[0, [0, 2]] < 0.01).all()
    # In the shadow the battery feeds the heater.
    assert fit.confounding[0].slope < -0.3


def test_the_torquer_matrix_is_found_in_a_day_with_everything_else_on():
    day = simulate_day(SimulationSettings(), "2007-08-09")
    field = day.truth["FIELD"].values
    direction = field / np.linalg.norm(field, axis=1, keepdims=True)
    torquer = day.instruments["tq"]
    _, here, there = np.intersect1d(day.truth["Epoch"].values, torquer["Epoch"].values, return_indices=True)
    current = np.full((field.shape[0], 3), np.nan)
    current[here] = torquer["I_TQ"].values[there] / 1e3
    wrong = np.array(PARAMETERS.torquer_vector) - BEFORE_FLIGHT
    residual = residual_of(day) - np.einsum("tj,jk,tk->t", direction, wrong, current)
    fit = fit_band(band_equations(day.truth["Epoch"].values, residual, direction, current))
    lacks = np.array(PARAMETERS.torquer_scalar) - BEFORE_FLIGHT
    assert np.abs((fit.for_scalar - lacks) / fit.sigma).max() < 3.5
