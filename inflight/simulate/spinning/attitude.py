"""Where a simulated spinning spacecraft points: its payload axes in gse, and its field in gsm.

Written by angles of the ecliptic, the sidereal time and the dipole (Hapgood 1992), apart from the products'
own way (`inflight.frames`).
"""

from __future__ import annotations

import numpy as np

from inflight.simulate.field import dipole_pole
from inflight.simulate.grid import Float, Int64
from inflight.simulate.spinning.settings import SpinningParameters
from inflight.time import to_utc

_AU_KM = 149_597_870.7


def payload_axes(place: Float, parameters: SpinningParameters) -> Float:
    """Return the payload axes in gse; (time, 3, 3), a row an axis. Without an attitude they are gse's own.

    Parameters
    ----------
    place : ndarray, shape (time, 3)
        Position, km, gse.
    """
    if parameters.attitude is None:
        return np.broadcast_to(np.eye(3), (len(place), 3, 3))
    up = np.asarray(parameters.attitude) / np.linalg.norm(parameters.attitude)
    sun = np.array([_AU_KM, 0.0, 0.0]) - place
    side = np.cross(up, sun)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([np.cross(side, up), side, np.broadcast_to(up, side.shape)], axis=1)


def to_gse(field: Float, axes: Float) -> Float:
    """Return a field (time, 3) of payload axes in gse."""
    return np.asarray(np.einsum("ta,tab->tb", field, axes))


def to_payload(field: Float, axes: Float) -> Float:
    """Return a field (time, 3) of gse in payload axes."""
    return np.asarray(np.einsum("tb,tab->ta", field, axes))


def spin_direction(tt2000: Int64, parameters: SpinningParameters) -> Float:
    """Return right ascension and declination of the spin axis, deg, equator of date; (time, 2)."""
    assert parameters.attitude is not None
    up = np.asarray(parameters.attitude) / np.linalg.norm(parameters.attitude)
    longitude, tilt, _ = _angles(tt2000)
    # gse's x lies at the Sun's longitude in the ecliptic.
    cosine, sine = np.cos(longitude), np.sin(longitude)
    x, y, z = up[0] * cosine - up[1] * sine, up[0] * sine + up[1] * cosine, np.full(cosine.shape, up[2])
    north, east = np.sin(tilt) * y + np.cos(tilt) * z, np.cos(tilt) * y - np.sin(tilt) * z
    angles = np.stack([np.mod(np.arctan2(east, x), 2.0 * np.pi), np.arcsin(north)], axis=1)
    return np.asarray(np.rad2deg(angles))


def to_gsm(field: Float, tt2000: Int64) -> Float:
    """Return a field (time, 3) of gse in gsm."""
    longitude, tilt, sidereal = _angles(tt2000)
    colatitude, east = dipole_pole(float(_days(tt2000).mean()))
    angle = sidereal + east
    dipole = (np.sin(colatitude) * np.cos(angle), np.sin(colatitude) * np.sin(angle), np.cos(colatitude))
    along = np.cos(tilt) * dipole[1] + np.sin(tilt) * dipole[2]
    pole = np.cos(tilt) * dipole[2] - np.sin(tilt) * dipole[1]
    across = np.cos(longitude) * along - np.sin(longitude) * dipole[0]
    turned = np.arctan2(across, pole)
    cosine, sine = np.cos(turned), np.sin(turned)
    return np.column_stack(
        [field[:, 0], cosine * field[:, 1] - sine * field[:, 2], sine * field[:, 1] + cosine * field[:, 2]]
    )


def _days(tt2000: Int64) -> Float:
    """Return days since 1858-11-17, UTC."""
    since = to_utc(tt2000) - np.datetime64("1858-11-17", "ns")
    return np.asarray(since / np.timedelta64(1, "D"), dtype=np.float64)


def _angles(tt2000: Int64) -> tuple[Float, Float, Float]:
    """Return the Sun's longitude, tilt of the ecliptic and sidereal time, rad (Hapgood 1992, eqs. 3, 5)."""
    days = _days(tt2000)
    century = (np.floor(days) - 51_544.5) / 36_525.0
    hours = 24.0 * np.mod(days, 1.0)
    tilt = 23.439 - 0.013 * century
    anomaly = np.deg2rad(357.528 + 35_999.050 * century + 0.04107 * hours)
    mean = 280.460 + 36_000.772 * century + 0.04107 * hours
    longitude = mean + (1.915 - 0.0048 * century) * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly)
    sidereal = 100.461 + 36_000.770 * century + 15.04107 * hours
    return np.deg2rad(longitude), np.deg2rad(tilt), np.deg2rad(sidereal)
