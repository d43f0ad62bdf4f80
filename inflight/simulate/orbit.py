"""A circular polar orbit that sinks, the Sun, and the axes of the spacecraft.

Frames: *inertial* is the mean equator and equinox of date; *itrf* turns with the Earth about z;
*orbital* is x along the inertial velocity, z down, y = z x x; *spacecraft* is orbital turned by the
small attitude angles. UT1 is taken as TT - 64.2 s: the error is common to everything simulated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from inflight.simulate.grid import Float, Grid
from inflight.simulate.parameters import Parameters
from inflight.simulate.randomness import drift

EARTH_RADIUS = 6371.2
_GM = 398600.4418
_LAUNCH_MJD = 196.0
_UT1_LAG = 64.2
_SUN_RADIUS = np.radians(0.2666)


@dataclass(frozen=True)
class Geometry:
    """Position and attitude of the spacecraft, on the nodes of `grid`.

    Attributes
    ----------
    position : ndarray, shape (node, 3)
        km, itrf.
    axes : ndarray, shape (node, 3, 3)
        Rows are the spacecraft's x, y, z in itrf: ``spacecraft vector = axes @ itrf vector``.
    sun : ndarray, shape (node, 3)
        Unit vector to the Sun, spacecraft axes.
    zenith : ndarray, shape (node,)
        Cosine of the angle between Sun and zenith.
    """

    grid: Grid
    position: Float
    axes: Float
    sun: Float
    zenith: Float


def mjd(seconds: Float) -> Float:
    """Return the thesis' day number, days since 2000-01-01T00:00 UTC, of TT2000 seconds."""
    return 0.5 + (seconds - _UT1_LAG) / 86400.0


def argument_of_latitude(seconds: Float, parameters: Parameters) -> Float:
    """Return the angle from the ascending node, rad, for a radius that falls linearly.

    The integral of ``sqrt(GM / a(t)^3)`` is closed; `expm1` keeps it exact over the mission.
    """
    radius = EARTH_RADIUS + parameters.altitude
    decay = parameters.altitude_decay / 86400.0
    elapsed = (mjd(seconds) - _LAUNCH_MJD) * 86400.0
    growth = np.expm1(-0.5 * np.log1p(-decay * elapsed / radius))
    return np.asarray(2.0 * np.sqrt(_GM) / (decay * np.sqrt(radius)) * growth)


def node_local_time(seconds: Float, parameters: Parameters) -> Float:
    """Return the local time of the ascending node, h in [0, 24); it falls by 24 h in 260.5 d."""
    elapsed = mjd(seconds) - parameters.local_time_mjd
    return np.asarray((parameters.local_time - 24.0 * elapsed / parameters.local_time_period) % 24.0)


def geometry(grid: Grid, parameters: Parameters, seed: int) -> Geometry:
    """Return position, axes and Sun on the nodes."""
    seconds = grid.seconds
    days = (seconds - _UT1_LAG) / 86400.0
    mean_sun = 280.460 + 0.98564736 * days
    sidereal = 280.46061837 + 360.98564736629 * days
    node = np.radians(mean_sun + 15.0 * (node_local_time(seconds, parameters) - 12.0) - sidereal)
    ahead, up, left = _orbit_axes(node, argument_of_latitude(seconds, parameters), parameters)
    radius = EARTH_RADIUS + parameters.altitude - parameters.altitude_decay * (mjd(seconds) - _LAUNCH_MJD)
    angles = np.radians(drift(seconds, seed, "attitude", parameters.attitude_rms, periods=(600.0, 20000.0)))
    small = scipy.spatial.transform.Rotation.from_euler("xyz", angles).as_matrix()
    axes = small @ np.stack([ahead, -left, -up], axis=1)
    sun = sun_direction(days, sidereal)
    return Geometry(
        grid,
        radius[:, None] * up,
        axes,
        np.einsum("nij,nj->ni", axes, sun),
        np.einsum("ni,ni->n", up, sun),
    )


def _orbit_axes(node: Float, argument: Float, parameters: Parameters) -> tuple[Float, Float, Float]:
    """Unit vectors along velocity, up and orbit normal in itrf; `node` is the node's longitude, rad."""
    cos_i, sin_i = np.cos(np.radians(parameters.inclination)), np.sin(np.radians(parameters.inclination))
    cos_n, sin_n, cos_u, sin_u = np.cos(node), np.sin(node), np.cos(argument), np.sin(argument)
    along = np.stack([-cos_n * sin_u - sin_n * cos_i * cos_u, -sin_n * sin_u + cos_n * cos_i * cos_u])
    outward = np.stack([cos_n * cos_u - sin_n * cos_i * sin_u, sin_n * cos_u + cos_n * cos_i * sin_u])
    normal = np.stack([sin_n * sin_i, -cos_n * sin_i, np.full_like(node, cos_i)], axis=1)
    return (
        np.column_stack([*along, sin_i * cos_u]),
        np.column_stack([*outward, sin_i * sin_u]),
        normal,
    )


def sun_direction(days: Float, sidereal: Float) -> Float:
    """Return the unit vector to the Sun in itrf, shape (time, 3).

    Low-precision formula of the Astronomical Almanac, good to 0.01 degrees; `days` since
    J2000 and `sidereal` time in degrees, shape (time,).
    """
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(
        280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly)
    )
    tilt = np.radians(23.439 - 4e-7 * days)
    x, y, z = np.cos(longitude), np.cos(tilt) * np.sin(longitude), np.sin(tilt) * np.sin(longitude)
    cos_s, sin_s = np.cos(np.radians(sidereal)), np.sin(np.radians(sidereal))
    return np.column_stack([cos_s * x + sin_s * y, -sin_s * x + cos_s * y, z])


def sunlight(zenith: Float, radius: float) -> Float:
    """Return the visible fraction of the Sun's disc, 0 in umbra, 1 in full light.

    Parameters
    ----------
    zenith : ndarray, shape (time,)
        Cosine of the angle between Sun and zenith.
    radius : float
        Distance from the Earth's centre, km.

    Returns
    -------
    ndarray, shape (time,)
        The Earth's limb is taken as a straight edge across the disc.
    """
    limb = np.pi - np.arcsin(EARTH_RADIUS / radius)
    depth = np.clip((np.arccos(np.clip(zenith, -1.0, 1.0)) - limb) / _SUN_RADIUS, -1.0, 1.0)
    return np.asarray((np.arccos(depth) - depth * np.sqrt(1.0 - depth**2)) / np.pi)
