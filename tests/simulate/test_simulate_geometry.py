"""Orbit, Sun and main field, against direct evaluation and against what the thesis prints."""

import datetime as dt

import numpy as np
import ppigrf
import pytest

from inflight.errors import SamplesError
from inflight.simulate import (
    EARTH_RADIUS,
    STEP,
    Grid,
    Parameters,
    Sampling,
    geometry,
    main_field,
    mjd,
    node_local_time,
    sunlight,
)
from inflight.simulate.field import external_field
from inflight.simulate.grid import interpolate
from inflight.simulate.orbit import argument_of_latitude, sun_direction
from inflight.time import SECOND, as_day, day_bounds, to_tt2000

DAY = as_day("2005-06-10")
START, END = day_bounds(DAY)
GRID = Grid.covering(START, END)


def igrf_itrf(position, day, fraction):
    """The IGRF at one place and time, straight from ppigrf."""
    x, y, z = position
    radius, across = np.linalg.norm(position), np.hypot(x, y)
    theta, phi = np.arctan2(across, z), np.arctan2(y, x)
    date = dt.datetime.combine(day.astype(dt.date), dt.time()) + dt.timedelta(seconds=86400.0 * fraction)
    up, south, east = (
        float(part.ravel()[0]) for part in ppigrf.igrf_gc(radius, np.degrees(theta), np.degrees(phi), date)
    )
    axes = np.array(
        [
            [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)],
            [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)],
            [-np.sin(phi), np.cos(phi), 0.0],
        ]
    )
    return np.array([up, south, east]) @ axes


def test_interpolated_field_equals_the_igrf_to_a_picotesla_scale():
    """Position and field interpolated from nodes agree with a direct evaluation at the place reached."""
    scene = geometry(GRID, Parameters(), seed=1)
    nodes = main_field(scene.position, GRID.seconds, DAY)
    times = Sampling.of_span(START, END, SECOND).shifted(-0.015)
    field, position = interpolate(nodes, GRID, times), interpolate(scene.position, GRID, times)
    chosen = np.random.default_rng(3).integers(0, times.count, 150)
    direct = np.array([igrf_itrf(position[k], DAY, k / 86400.0) for k in chosen])
    assert np.abs(field[chosen] - direct).max() < 1e-3
    assert 1.5e4 < np.linalg.norm(field, axis=1).min() < np.linalg.norm(field, axis=1).max() < 6.5e4


def test_interpolation_is_exact_for_polynomials_of_degree_seven():
    """Any phase of the samples against the nodes, whatever the leap seconds did to it."""
    grid = Grid.covering(START, START + 3600 * SECOND)
    scaled = (grid.seconds - grid.seconds[0]) / 3600.0
    for cadence, offset in ((1, 0), (5, 184_000_000), (10, 29_999_999_999)):
        times = Sampling(START + offset, cadence * SECOND, 300)
        at = (times.seconds - grid.seconds[0]) / 3600.0
        assert interpolate(scaled**7, grid, times) == pytest.approx(at**7, abs=1e-10)


def test_nodes_that_do_not_reach_are_refused():
    grid = Grid.covering(START, START + 3600 * SECOND)
    with pytest.raises(SamplesError, match="widen the grid"):
        interpolate(grid.seconds, grid, Sampling(START, SECOND, 7200))
    with pytest.raises(SamplesError, match="does not divide"):
        interpolate(grid.seconds, grid, Sampling(START, 7 * SECOND, 10))


def test_nodes_are_the_same_function_of_time_whatever_the_span():
    early, late = Grid.covering(START - 9000 * SECOND, END), Grid.covering(START, END)
    part = early.part(late)
    assert np.array_equal(early.seconds[part], late.seconds)
    assert np.array_equal(
        geometry(early, Parameters(), 4).position[part], geometry(late, Parameters(), 4).position
    )
    assert np.array_equal(external_field(early, 4, 5.0)[part], external_field(late, 4, 5.0))


def test_axes_are_right_handed_with_x_along_flight_and_z_down():
    scene = geometry(GRID, Parameters(attitude_rms=(0.0, 0.0, 0.0)), seed=1)
    x, y, z = (scene.axes[:, row] for row in range(3))
    assert np.cross(z, x) == pytest.approx(y, abs=1e-12)
    down = -scene.position / np.linalg.norm(scene.position, axis=1)[:, None]
    assert z == pytest.approx(down, abs=1e-12)
    velocity = np.gradient(scene.position, STEP / SECOND, axis=0)[2:-2]
    rotation = np.cross([0.0, 0.0, 7.2921e-5], scene.position[2:-2])
    ahead = velocity + rotation
    assert np.einsum("ij,ij->i", ahead / np.linalg.norm(ahead, axis=1)[:, None], x[2:-2]).min() > 0.9999


def test_attitude_motion_is_a_fraction_of_a_degree():
    still = geometry(GRID, Parameters(attitude_rms=(0.0, 0.0, 0.0)), seed=1).axes
    moving = geometry(GRID, Parameters(), seed=1).axes
    angle = np.degrees(np.arccos((np.einsum("nij,nij->n", still, moving) - 1.0) / 2.0))
    assert 0.02 < np.median(angle) < 0.6


def test_orbit_sinks_within_the_altitudes_of_the_mission_and_keeps_kepler():
    parameters = Parameters()
    for day in ("2000-08-01", "2004-01-01", "2009-12-31"):
        grid = Grid.covering(*day_bounds(day))
        radius = np.linalg.norm(geometry(grid, parameters, 1).position, axis=1)
        assert 335.0 < radius.mean() - EARTH_RADIUS < 455.0
        rate = np.gradient(argument_of_latitude(grid.seconds, parameters), grid.seconds)
        assert rate * np.sqrt(radius**3 / 398600.4418) == pytest.approx(1.0, rel=1e-6)


def test_local_time_falls_by_a_day_in_260_and_a_half_days():
    """03:20 on 2007-04-30, Yin (2010) section 3.4.1."""
    parameters = Parameters()
    at = np.array([to_tt2000("2007-04-30"), to_tt2000("2008-01-15T12:00")]) / SECOND
    assert mjd(at)[0] == pytest.approx(2676.0, abs=1e-4)
    assert node_local_time(at, parameters) == pytest.approx(10.0 / 3.0, abs=1e-3)
    scene = geometry(GRID, parameters, 1)
    rising = np.flatnonzero((scene.position[:-1, 2] < 0) & (scene.position[1:, 2] >= 0))
    place, sun = scene.position[rising], np.einsum("nji,nj->ni", scene.axes[rising], scene.sun[rising])
    hours = np.degrees(np.arctan2(place[:, 1], place[:, 0]) - np.arctan2(sun[:, 1], sun[:, 0])) / 15.0
    expected = node_local_time(GRID.seconds[rising], parameters) - 12.0
    away = (hours - expected + 12.0) % 24.0 - 12.0
    assert np.abs(away).max() < 0.35, "true and mean Sun differ by up to 16 minutes"


@pytest.mark.parametrize(
    ("moment", "declination", "tolerance"),
    [("2005-06-21T06:46", 23.44, 0.02), ("2005-03-20T12:33", 0.0, 0.02), ("2005-12-21T18:35", -23.44, 0.02)],
)
def test_sun_stands_where_the_seasons_say(moment, declination, tolerance):
    days = np.array([(to_tt2000(moment) / SECOND) / 86400.0])
    sun = sun_direction(days, np.zeros(1))[0]
    assert np.degrees(np.arcsin(sun[2])) == pytest.approx(declination, abs=tolerance)


def test_eclipse_is_a_third_of_the_orbit_at_noon_and_nothing_at_dawn():
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    radius = EARTH_RADIUS + 400.0
    noon, dawn = sunlight(np.cos(angle), radius), sunlight(np.zeros_like(angle), radius)
    assert noon.mean() == pytest.approx(1.0 - np.arcsin(EARTH_RADIUS / radius) / np.pi, abs=1e-3)
    assert dawn.min() == 1.0
    assert ((noon > 0.0) & (noon < 1.0)).mean() * 5580.0 == pytest.approx(
        2 * 2 * 0.2666 / 360 * 5580, rel=0.05
    )
