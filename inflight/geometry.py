"""Where the spacecraft is and how it points: latitude, orbit phase, and the axes fields are given in.

Frames: *sensor* (orthogonal axes of the vector sensor), *spacecraft*, *itrf* (Earth-fixed), *nec*
(north, east, centre: z towards the Earth's centre, geocentric).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.errors import SamplesError


def rotate(field: Floats, quaternion: Floats) -> Floats:
    """Turn vectors by quaternions x, y, z, w.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Vectors in the source frame.
    quaternion : ndarray, shape (4,) or (time, 4)
        Rotation from source to target frame; NaN gives NaN.

    Returns
    -------
    ndarray, shape (time, 3)
    """
    if quaternion.ndim == 1:
        return np.asarray(Rotation.from_quat(quaternion).apply(field))
    out = np.full_like(field, np.nan)
    norm = np.linalg.norm(quaternion, axis=1)
    good = np.isfinite(norm) & (norm > 0.5)
    if good.any():
        out[good] = Rotation.from_quat(quaternion[good]).apply(field[good])
    return out


def latitude_longitude(position: Floats) -> tuple[Floats, Floats]:
    """Return geocentric latitude and longitude (deg) of Earth-fixed positions (time, 3), any unit."""
    x, y, z = position.T
    return np.rad2deg(np.arctan2(z, np.hypot(x, y))), np.rad2deg(np.arctan2(y, x))


def itrf_to_nec(field: Floats, position: Floats) -> Floats:
    """Turn Earth-fixed vectors into north, east, centre.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Vectors, itrf.
    position : ndarray, shape (time, 3)
        Where they were measured, itrf, any length unit.
    """
    latitude, longitude = (np.deg2rad(angle) for angle in latitude_longitude(position))
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    fx, fy, fz = field.T
    along = fx * cos_lon + fy * sin_lon
    north = -sin_lat * along + cos_lat * fz
    east = -sin_lon * fx + cos_lon * fy
    centre = -cos_lat * along - sin_lat * fz
    return np.stack([north, east, centre], axis=1)


def to_nec(field: Floats, attitude: Floats, position: Floats | None, frame: str) -> Floats:
    """Turn spacecraft vectors into north, east, centre.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Vectors in spacecraft axes.
    attitude : ndarray, shape (time, 4)
        Quaternion x, y, z, w from spacecraft axes to `frame`.
    position : ndarray, shape (time, 3), optional
        Earth-fixed position; not needed for frame "nec".
    frame : str
        ``itrf`` or ``nec``.

    Raises
    ------
    SamplesError
        When the frame is another one, or the position is missing.
    """
    turned = rotate(field, attitude)
    if frame == "nec":
        return turned
    if frame != "itrf":
        raise SamplesError(
            f"attitude is given towards {frame!r}", channel="attitude", remedy="give it towards itrf or nec"
        )
    if position is None:
        raise SamplesError("no position", channel="position", remedy="add an orbit instrument to the mission")
    return itrf_to_nec(turned, position)


def orbit_phase(latitude: Floats, latitude_rate: Floats) -> Floats:
    """Return the argument of latitude of a near-polar orbit, 0 at the ascending node; (time,) deg.

    Latitude (time,) in deg; of its rate (time,) only the sign matters.
    """
    rising = latitude_rate >= 0
    return np.where(rising, latitude, 180.0 - latitude) % 360.0
