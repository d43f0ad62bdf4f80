"""Where the Sun stands and how the Earth turns, to a hundredth of a degree, and the Earth's shadow.

Frames: *of date* is the true direction of equator and equinox at the time, less nutation (below
0.005 degrees); *gcrf* is the equator and equinox of J2000; *itrf* turns with the Earth. UTC stands
for UT1, which it never leaves by more than 0.9 s (0.004 degrees).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.time import Int64, to_utc

_J2000 = np.datetime64("2000-01-01T12:00:00", "ns")
_DAY = np.timedelta64(1, "D")
#: Mean radius of the Earth, km, and the Sun's as seen from it, rad (0.2666 degrees).
EARTH_RADIUS = 6371.0
SUN_RADIUS = 0.2666 * np.pi / 180.0


def days_since_j2000(tt2000: Int64) -> Floats:
    """Return UTC days since 2000-01-01T12:00:00; (time,)."""
    return np.asarray((to_utc(tt2000) - _J2000) / _DAY, dtype=np.float64)


def sidereal_angle(days: Floats) -> Floats:
    """Return Greenwich mean sidereal time, rad, of days (time,) since J2000 (Astronomical Almanac, B8)."""
    return np.deg2rad((280.46061837 + 360.98564736629 * days) % 360.0)


def sun_direction(days: Floats) -> Floats:
    """Return the unit vector to the Sun, equator and equinox of date; (time, 3).

    Low-precision formulas of the Astronomical Almanac (C5), 0.01 degrees between 1950 and 2050.
    """
    anomaly = np.deg2rad(357.528 + 0.9856003 * days)
    longitude = np.deg2rad(
        280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly)
    )
    tilt = np.deg2rad(23.439 - 4.0e-7 * days)
    east = np.sin(longitude)
    return np.stack([np.cos(longitude), np.cos(tilt) * east, np.sin(tilt) * east], axis=1)


def to_date(vectors: Floats, days: Floats) -> Floats:
    """Turn gcrf vectors (time, 3) to the equator and equinox of date: precession to first order.

    The angles grow by 0.640616, 0.556753 and 0.640616 degrees a century (Lieske et al. 1977, linear
    terms); taken at the mean of the days, which may be a year.
    """
    return np.asarray(_precession(days).apply(vectors))


def from_date(vectors: Floats, days: Floats) -> Floats:
    """Turn vectors (time, 3) of date to gcrf; the inverse of `to_date`."""
    return np.asarray(_precession(days).inv().apply(vectors))


def _precession(days: Floats) -> Rotation:
    century = float(np.mean(days)) / 36525.0 if days.size else 0.0
    # scipy turns vectors, not axes: the signs are the opposite of the almanac's R3, R2, R3.
    return Rotation.from_euler("zyz", [0.640616 * century, -0.556753 * century, 0.640616 * century], True)


def turn_with_earth(vectors: Floats, days: Floats, sign: int) -> Floats:
    """Turn vectors (time, 3) about the pole: from itrf to of date with sign +1, back with -1."""
    angle = sign * sidereal_angle(days)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def sunlit_fraction(position: Floats, sun: Floats) -> Floats:
    """Return how much of the Sun's disc the Earth leaves free: 0 in umbra, 1 in full light; (time,).

    Parameters
    ----------
    position : ndarray, shape (time, 3)
        km from the centre of the Earth, taken as a sphere without air.
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, same frame.
    """
    radius = np.linalg.norm(position, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = -np.einsum("ta,ta->t", position, sun) / radius
        earth = np.arcsin(np.minimum(EARTH_RADIUS / radius, 1.0))
    return 1.0 - _covered(np.arccos(np.clip(cosine, -1.0, 1.0)), earth, SUN_RADIUS)


def _covered(apart: Floats, cover: Floats, disc: float) -> Floats:
    """Return the part of a disc behind another one: radii and distance of centres, rad, plane geometry."""
    out = np.where(apart < cover + disc, 1.0, 0.0)
    # A cover smaller than the disc, far from the Earth, hides only its own area.
    out = np.where(cover < disc, out * (cover / disc) ** 2, out)
    partly = (apart > np.abs(cover - disc)) & (apart < cover + disc)
    d, r, s = apart[partly], cover[partly], disc
    first = np.arccos(np.clip((d**2 + r**2 - s**2) / (2 * d * r), -1.0, 1.0))
    second = np.arccos(np.clip((d**2 + s**2 - r**2) / (2 * d * s), -1.0, 1.0))
    lens = r**2 * (first - 0.5 * np.sin(2 * first)) + s**2 * (second - 0.5 * np.sin(2 * second))
    out[partly] = lens / (np.pi * s**2)
    return np.where(np.isfinite(apart), out, np.nan)
