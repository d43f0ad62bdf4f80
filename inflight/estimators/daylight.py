"""How long day and night last on a circular orbit, and the series of a wave that follows them."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.sun import EARTH_RADIUS

#: km^3/s^2.
_GM = 398600.4418


def orbit_period(altitude: float) -> float:
    """Return the period of a circular orbit, s; `altitude` in km above the mean radius 6371 km."""
    return float(2.0 * np.pi * np.sqrt((EARTH_RADIUS + altitude) ** 3 / _GM))


def orbit_plane_sun(local_time: Floats, declination: Floats, inclination: float) -> Floats:
    """Return the angle between the Sun and the orbit's plane (beta), deg.

    ``sin beta = sin i cos d sin(15 (LT - 12)) + cos i sin d``: the product of orbit normal and Sun.

    Parameters
    ----------
    local_time : ndarray
        Of the ascending node, h, apparent solar.
    declination : ndarray
        Of the Sun, deg.
    inclination : float
        deg.
    """
    hour, sun, tilt = np.deg2rad(15.0 * (local_time - 12.0)), np.deg2rad(declination), np.deg2rad(inclination)
    sine = np.sin(tilt) * np.cos(sun) * np.sin(hour) + np.cos(tilt) * np.sin(sun)
    return np.asarray(np.rad2deg(np.arcsin(np.clip(sine, -1.0, 1.0))))


def sunlit_duty(altitude: float, beta: Floats) -> Floats:
    """Return which part of a circular orbit lies in the Sun; (...) in (0.5, 1].

    A spherical Earth throws a cylinder of shadow; half the night's arc has the cosine
    ``sqrt(r^2 - R^2) / (r cos beta)``, and there is no night when that exceeds 1.

    Parameters
    ----------
    altitude : float
        km above the mean radius.
    beta : ndarray
        Angle between Sun and orbit plane, deg.
    """
    radius = EARTH_RADIUS + altitude
    cosine = np.sqrt(radius**2 - EARTH_RADIUS**2) / (radius * np.cos(np.deg2rad(beta)))
    return np.asarray(1.0 - np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi)


def square_wave_series(duty: float, order: int) -> Floats:
    """Return a_0 ... a_order of a square wave that is 1 for `duty` of the orbit around t0, 0 elsewhere."""
    k = np.arange(1, order + 1)
    return np.concatenate([[duty], 2.0 * np.sin(np.pi * k * duty) / (np.pi * k)])
