"""Geocentric solar axes, and the payload axes of a spinning spacecraft in them.

*gse* has x to the Sun as the Earth sees it and z to the pole of the ecliptic of date; *gsm* is turned about
x until the Earth's dipole lies in its xz plane, z northward (Russell 1971; Hapgood 1992). *gei* is the mean
equator and equinox of date, *gcrf* those of J2000, *itrf* turns with the Earth. *Payload* axes have z along
the spin and x to the Sun's projection into the spin plane (Farrell et al. 1995, eq. 1). Directions are true
to some hundredths of a degree: see `inflight.sun`. The dipole is that of the IGRF.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from ppigrf.ppigrf import read_shc

from inflight.arrays import Floats
from inflight.errors import MissionError
from inflight.sun import days_since_j2000, sun_direction, to_date, turn_with_earth
from inflight.time import Int64

#: Axes in which a spin axis or a position may be given.
FRAMES = ("gse", "gsm", "gei", "gcrf", "itrf")
#: km.
ASTRONOMICAL_UNIT = 149_597_870.7
#: With the Sun nearer to the spin axis than this its projection tells no direction; sine of 5 degrees.
_LEAST_PROJECTION = 0.087
#: Days from 1970 to J2000.
_J2000 = 10_957.5


def dipole_axis(days: Floats) -> Floats:
    """Return the unit vector to the boreal pole of the Earth's dipole, itrf; (time, 3).

    IGRF coefficients of degree one, linear between its epochs; the last epoch's hold beyond it.

    Parameters
    ----------
    days : ndarray, shape (time,)
        UTC days since J2000.
    """
    epochs, coefficients = _first_degree()
    at = [np.interp(days + _J2000, epochs, one) for one in coefficients.T]
    axis = -np.stack(at, axis=1)
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


@lru_cache(maxsize=1)
def _first_degree() -> tuple[Floats, Floats]:
    """Return epochs (days since 1970) and g11, h11, g10 (epoch, 3), nT."""
    g, h = read_shc()
    epochs = g.index.to_numpy().astype("datetime64[ns]").astype(np.float64) / 86_400e9
    terms = [g[(1, 1)], h[(1, 1)], g[(1, 0)]]
    return epochs, np.stack([one.to_numpy(np.float64) for one in terms], axis=1)


def to_gse(vectors: Floats, tt2000: Int64, frame: str) -> Floats:
    """Turn vectors (time, 3) of a frame of `FRAMES` to gse.

    Raises
    ------
    MissionError
        When the frame is another one.
    """
    if frame not in FRAMES:
        raise MissionError(
            f"directions are given in the frame {frame!r}", remedy=f"give them in {', '.join(FRAMES)}"
        )
    if frame == "gse":
        return vectors
    if frame == "gsm":
        return _about_x(vectors, -dipole_angle(tt2000))
    days = days_since_j2000(tt2000)
    if frame == "gcrf":
        vectors = to_date(vectors, days)
    elif frame == "itrf":
        vectors = turn_with_earth(vectors, days, 1)
    return _equator_to_gse(vectors, days)


def gse_to_gsm(vectors: Floats, tt2000: Int64) -> Floats:
    """Turn vectors (time, 3) from gse to gsm."""
    return _about_x(vectors, dipole_angle(tt2000))


def dipole_angle(tt2000: Int64) -> Floats:
    """Return by how much gsm is turned about x from gse, from y towards z; (time,) rad."""
    days = days_since_j2000(tt2000)
    dipole = _equator_to_gse(turn_with_earth(dipole_axis(days), days, 1), days)
    # z of gsm lies along the dipole's part across x.
    return np.asarray(np.arctan2(-dipole[:, 1], dipole[:, 2]))


def sunward(tt2000: Int64, position: Floats | None = None) -> Floats:
    """Return the unit vector to the Sun, gse; (time, 3).

    Parameters
    ----------
    position : ndarray, shape (time, 3), optional
        Of the spacecraft, km, gse; NaN and absent stand for the centre of the Earth, which is 0.002
        degrees wrong for every Earth radius of distance.
    """
    towards = np.zeros((tt2000.size, 3))
    towards[:, 0] = 1.0
    if position is None:
        return towards
    # Earth's distance from the Sun, Astronomical Almanac (C5).
    anomaly = np.deg2rad(357.528 + 0.9856003 * days_since_j2000(tt2000))
    distance = 1.00014 - 0.01671 * np.cos(anomaly) - 0.00014 * np.cos(2.0 * anomaly)
    towards -= np.nan_to_num(position) / (ASTRONOMICAL_UNIT * distance)[:, None]
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def payload_to_gse(field: Floats, axis: Floats, towards: Floats) -> Floats:
    """Turn vectors from payload axes to the axes in which spin axis and Sun are given.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Payload axes.
    axis : ndarray, shape (time, 3)
        Direction of the spacecraft's rotation, right-handed, of any length; NaN where it is not known.
    towards : ndarray, shape (time, 3)
        Unit vector to the Sun.

    Returns
    -------
    ndarray, shape (time, 3)
        NaN without an axis, and where the Sun is within five degrees of it.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        up = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        across = towards - np.einsum("ta,ta->t", towards, up)[:, None] * up
        size = np.linalg.norm(across, axis=1, keepdims=True)
        ahead = across / np.where(size > _LEAST_PROJECTION, size, np.nan)
    side = np.cross(up, ahead)
    return np.asarray(field[:, :1] * ahead + field[:, 1:2] * side + field[:, 2:] * up)


def _equator_to_gse(vectors: Floats, days: Floats) -> Floats:
    """Turn vectors (time, 3) from the equator and equinox of date to gse."""
    sun = sun_direction(days)
    # The Sun's path lies in the ecliptic: the angle to the equator is that of `sun_direction`.
    tilt = np.deg2rad(23.439 - 4.0e-7 * days)
    pole = np.stack([np.zeros_like(tilt), -np.sin(tilt), np.cos(tilt)], axis=1)
    axes = (sun, np.cross(pole, sun), pole)
    return np.stack([np.einsum("ta,ta->t", vectors, one) for one in axes], axis=1)


def _about_x(vectors: Floats, angle: Floats) -> Floats:
    """Return components in axes turned about x by an angle (time,) from y towards z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([x, cosine * y + sine * z, cosine * z - sine * y], axis=1)
