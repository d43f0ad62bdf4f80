"""Dipoles, currents and temperatures of the simulated spacecraft."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inflight.simulate import (
    Parameters,
    Sampling,
    SimulationSettings,
    mean_current,
    simulate_day,
    torquer_currents,
)
from inflight.simulate.dipole import dipole_matrix, extrapolate_dipole
from inflight.simulate.fluxgate import play
from inflight.simulate.power import currents, relax
from inflight.simulate.stray import coefficients, remanent_fields
from inflight.time import SECOND, day_bounds

VECTOR, SCALAR = (4.75, 0.0, 0.0), (6.5, 0.0, 0.0)
components = st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(field=components)
def test_dipole_on_the_boom_axis_splits_as_the_thesis_says(field):
    """Difference of the sensors times 1.64001 is the vector sensor's field, times 0.64001 the scalar's."""
    at_vector = np.array(field)
    at_scalar = extrapolate_dipole(field, (0.0, 0.0, 0.0), VECTOR, SCALAR)
    difference = at_vector - at_scalar
    assert at_vector == pytest.approx(1.64001 * difference, rel=1e-5, abs=1e-9)
    assert at_scalar == pytest.approx(0.64001 * difference, rel=2e-5, abs=1e-9)


@given(arm=components, factor=st.floats(1.1, 5.0), moment=components)
def test_dipole_falls_with_the_cube_and_has_no_divergence(arm, factor, moment):
    near = dipole_matrix(arm) @ moment
    far = dipole_matrix(np.array(arm) * factor) @ moment
    assert far * factor**3 == pytest.approx(near, rel=1e-9, abs=1e-9 * np.abs(near).max())
    assert np.trace(dipole_matrix(arm)) == pytest.approx(0.0, abs=1e-9 * np.abs(dipole_matrix(arm)).max())


def test_axial_moment_makes_the_thesis_coefficients():
    """0.0014850 mu0 m on the axis at 4.75 m, half of it with reversed sign across (after eq. 3.1)."""
    mu0 = 4e-7 * np.pi * 1e9
    matrix = dipole_matrix(VECTOR)
    assert matrix[0, 0] == pytest.approx(0.0014850 * mu0, rel=1e-4)
    assert matrix[1, 1] == pytest.approx(-0.0007425 * mu0, rel=1e-4)
    # The fourth digit printed, 6, is 5: 1 / (2 pi 6.5^3) = 0.00057954.
    assert dipole_matrix(SCALAR)[0, 0] == pytest.approx(0.00057954 * mu0, rel=1e-5)


def test_star_camera_makes_a_nanotesla_per_ampere_between_the_sensors():
    vector, scalar = coefficients(Parameters())["camera"]
    assert np.linalg.norm(vector - scalar) == pytest.approx(1.0, abs=0.15)


def test_remanent_field_follows_the_mean_torquer_current():
    parameters = Parameters()
    seconds = np.array([1.6e8, 2.4e8])
    vector, scalar = remanent_fields(seconds, parameters)
    mean = mean_current(seconds, parameters)
    assert scalar[:, 1:] == pytest.approx(7.1 * mean[:, 1:])
    assert np.abs(scalar[:, 1]).max() == pytest.approx(0.3, abs=0.1), "the pre-flight value is -0.3 nT"
    assert np.linalg.norm(vector, axis=1) == pytest.approx(
        np.linalg.norm(scalar, axis=1) * (7.62 / 5.87) ** 3, rel=1e-6
    )


def test_relaxation_is_the_exact_exponential():
    drive = np.ones(500)
    assert relax(drive, 40.0, 2.0, 0.0) == pytest.approx(1.0 - np.exp(-2.0 * np.arange(1, 501) / 40.0))
    assert relax(drive, 40.0, 2.0, 1.0) == pytest.approx(1.0)


def test_battery_forgets_how_the_simulation_began():
    """A later start gives the same currents once the battery was full."""
    seconds = np.arange(1_000_000_000.0, 1_000_030_000.0)
    angle = seconds * 2.0 * np.pi / 5580.0
    sun = np.column_stack([np.sin(angle), np.full_like(angle, 0.3), -np.cos(angle)])
    light = (sun[:, 2] < 0.3).astype(float)

    def solar(first):
        part = slice(first, None)
        flow = currents(seconds[part], sun[part], light[part], parameters=Parameters(), seed=1, cadence=1.0)
        return flow.solar[-8000:]

    assert solar(0) == pytest.approx(solar(6000), abs=1e-6)


def test_array_drops_from_full_current_to_the_load_within_fifteen_seconds():
    """Yin (2010) Fig. 3.5: about 7 A lost in 15 s, at the end of charging, once an orbit."""
    day = simulate_day(SimulationSettings(cadence=10, defects=()), "2008-07-01")
    solar = day.instruments["hk"]["I_SOL"].values / 1e3
    fall = solar[:-2] - solar[2:]
    steps = np.flatnonzero((fall[1:-1] > 3.0) & (fall[1:-1] >= fall[:-2]) & (fall[1:-1] > fall[2:]))
    assert 13 <= steps.size <= 17
    assert solar.max() == pytest.approx(10.5, abs=1.0)
    assert np.median(solar[steps + 5]) == pytest.approx(2.9, abs=0.4)
    assert (solar == 0.0).mean() == pytest.approx(0.5, abs=0.02), "no panel sees a Sun below the horizontal"


def test_torquer_currents_have_their_twenty_second_line_in_x_and_z():
    start, end = day_bounds("2005-03-03")
    current = torquer_currents(Sampling.of_span(start, end, SECOND), Parameters(), 1, 99)
    spectrum = np.abs(np.fft.rfft(current - current.mean(axis=0), axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(current), 1.0)
    line = spectrum[(frequency > 0.0495) & (frequency < 0.0505)].max(axis=0)
    beside = np.median(spectrum[(frequency > 0.03) & (frequency < 0.045)], axis=0)
    assert (line[[0, 2]] > 300.0 * beside[[0, 2]]).all()
    assert np.abs(current).max() < 0.2
    assert current.mean(axis=0) == pytest.approx([0.0, -0.034, 0.020], abs=0.003)


def test_temperatures_swing_with_the_orbit_and_the_coil_that_acts_is_late():
    day = simulate_day(SimulationSettings(defects=()), "2005-01-01")
    recorded, acting = day.instruments["fgm"]["T_CSC"].values, day.truth["T_EFF"].values
    assert 2.0 < np.ptp(recorded) < 12.0
    assert acting[100:] == pytest.approx(recorded[:-100], abs=0.03)
    assert np.abs(acting - recorded).max() > 0.2


def test_play_follows_only_after_its_slack():
    drive = np.concatenate([np.linspace(0, 5, 51), np.linspace(5, 0, 51)])
    loop = play(drive, 2.0)
    assert loop[50] == pytest.approx(4.0)
    assert loop[60] == pytest.approx(4.0), "still inside the slack on the way down"
    assert loop[-1] == pytest.approx(1.0)
