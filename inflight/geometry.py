"""Where the spacecraft is and how it points: latitude, orbit phase, and the axes fields are given in.

Frames: *sensor* (orthogonal axes of the vector sensor), *spacecraft*, *itrf* (Earth-fixed), *nec*
(north, east, centre: z towards the Earth's centre, geocentric).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.sun import (
    days_since_j2000,
    from_date,
    sun_direction,
    sunlit_fraction,
    to_date,
    turn_with_earth,
)
from inflight.time import SECOND, Int64, usual_step
from inflight.units import factor_and_offset

#: A quaternion shorter than this is none.
_SHORTEST = 0.5


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
        return np.asarray(field @ Rotation.from_quat(quaternion).as_matrix().T)
    x, y, z, w = np.ascontiguousarray(quaternion.T)
    vx, vy, vz = np.ascontiguousarray(field.T)
    size = x * x + y * y + z * z + w * w
    with np.errstate(invalid="ignore", divide="ignore"):
        twice = np.where(size > _SHORTEST**2, 2.0 / size, np.nan)
    # v + 2 w (q x v) + 2 q x (q x v), of a quaternion whose length is its own affair.
    tx, ty, tz = twice * (y * vz - z * vy), twice * (z * vx - x * vz), twice * (x * vy - y * vx)
    out = np.empty_like(field)
    out[:, 0] = vx + w * tx + y * tz - z * ty
    out[:, 1] = vy + w * ty + z * tx - x * tz
    out[:, 2] = vz + w * tz + x * ty - y * tx
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


def direction_of(field: Floats) -> Floats:
    """Return unit vectors along a field (time, 3); NaN where it is nothing or missing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(field / np.linalg.norm(field, axis=1, keepdims=True))


def orbit_phase(latitude: Floats, latitude_rate: Floats) -> Floats:
    """Return the argument of latitude of a near-polar orbit, 0 at the ascending node; (time,) deg.

    Latitude (time,) in deg; of its rate (time,) only the sign matters.
    """
    rising = latitude_rate >= 0
    return np.where(rising, latitude, 180.0 - latitude) % 360.0


#: What `add_geometry` can add: name -> unit.
GEOMETRY = {
    "latitude": "deg",
    "longitude": "deg",
    "orbit_phase": "deg",
    "sun_phase": "deg",
    "local_time": "h",
    "sunlit": "1",
    "sun_direction": "1",
}
#: Variables of samples that tell them.
_TELLING = ("tt2000", "position", "attitude", "vector", "inboard")
#: Those that the orbit's plane tells.
_PHASES = ("orbit_phase", "sun_phase")
#: Those that a slow response or a play may be made of: positions alone tell them.
SLOW_GEOMETRY = ("sunlit", "latitude")
#: Two positions this far apart in time tell the orbit's plane, seconds: further than their rounding matters.
_PLANE_STEP = 60.0
#: An orbit inclined by less has no node: its phase counts from the vernal equinox. Sine of the angle.
_LEAST_INCLINATION = 0.01


def add_geometry(samples: xr.Dataset, names: Collection[str] = tuple(GEOMETRY)) -> xr.Dataset:
    """Add what position and attitude say of a sample; at any cadence, with gaps.

    Parameters
    ----------
    samples : xarray.Dataset
        `tt2000` (time); `position` (time, axis) with attributes `units` and `frame` (itrf or gcrf);
        `attitude` (time, quaternion) from spacecraft axes to its attribute `frame` (itrf, gcrf or
        nec); a vector reading with attribute `orientation`, the quaternion from sensor to
        spacecraft axes (the same axes when absent).
    names : collection of str
        Of `GEOMETRY`, what is wanted.

    Returns
    -------
    xarray.Dataset
        With `latitude`, `longitude` (deg, geocentric), `orbit_phase` (deg, 0 at the ascending node),
        `sun_phase` (deg along the orbit from the point nearest the Sun; NaN where there is none),
        `local_time` (h, mean solar), `sunlit` (1 in light, 0 in shadow), `sun_direction` (time,
        axis), unit vector in the vector sensor's axes. Nothing is added without a position in a
        known frame, no Sun direction without an attitude, and nothing that is there is replaced.
    """
    place = _place(samples)
    if place is None:
        return samples
    missing = [name for name in names if name not in samples]
    normal = _orbit_normal(place) if set(missing) & set(_PHASES) else None
    return samples.assign(_variables(_told(samples, place, normal, missing)))


def geometry_at(samples: xr.Dataset, rows: npt.NDArray[np.int64]) -> dict[str, xr.Variable]:
    """Return what `add_geometry` adds, at some samples only.

    Parameters
    ----------
    samples : xarray.Dataset
        As `add_geometry` takes them.
    rows : ndarray of int, shape (row,)
        Which samples.

    Returns
    -------
    dict of Variable
        dims (time,) or (time, axis), as long as `rows`.
    """
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    samples = samples[[name for name in _TELLING if name in samples]]
    before, after, longest = _beside(stamps, rows)
    around = np.unique(np.concatenate([before, rows, after]))
    place = _place(samples.isel(time=around))
    if place is None:
        return {}
    normal, known = _normals(place, np.searchsorted(around, before), np.searchsorted(around, after), longest)
    if not known.all():
        # Beside a gap the orbit's plane comes from farther away.
        whole = add_geometry(samples)
        return {name: whole[name].variable.isel(time=rows) for name in GEOMETRY if name in whole}
    here = np.searchsorted(around, rows)
    return _variables(_told(samples.isel(time=rows), place.rows(here), normal, list(GEOMETRY)))


def _variables(found: Mapping[str, Floats]) -> dict[str, xr.Variable]:
    return {
        name: xr.Variable(("time", "axis")[: values.ndim], values, {"units": GEOMETRY[name]})
        for name, values in found.items()
    }


def _place(samples: xr.Dataset) -> _Place | None:
    """Return where the samples were taken; None without a position in a known frame."""
    position = samples.get("position")
    if position is None or position.attrs.get("frame") not in ("itrf", "gcrf") or not samples.sizes["time"]:
        return None
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    return _Place.of(np.asarray(position.values, dtype=np.float64), position.attrs, stamps)


def _told(
    samples: xr.Dataset, place: _Place, normal: Floats | None, names: Collection[str]
) -> dict[str, Floats]:
    """Return what is wanted of places; the orbit's normal is needed for its phases only."""
    found: dict[str, Floats] = {}
    if {"latitude", "longitude", "local_time"} & set(names):
        latitude, longitude = latitude_longitude(place.fixed)
        hours = (24.0 * ((place.days + 0.5) % 1.0) + longitude / 15.0) % 24.0
        found |= {"latitude": latitude, "longitude": longitude, "local_time": hours}
    if normal is not None:
        found |= dict(zip(_PHASES, _phases(place, normal), strict=True))
    if "sunlit" in names:
        found["sunlit"] = sunlit_fraction(place.inertial, place.sun)
    towards = _sun_in_sensor(samples, place) if "sun_direction" in names else None
    if towards is not None:
        found["sun_direction"] = towards
    return {name: found[name] for name in GEOMETRY if name in found and name in names}


@dataclass(frozen=True)
class _Place:
    """Positions (time, 3) in km, itrf and of date, and the unit vector to the Sun, of date."""

    tt2000: Int64
    days: Floats
    fixed: Floats
    inertial: Floats
    sun: Floats

    @classmethod
    def of(cls, position: Floats, attrs: Mapping[Any, Any], stamps: Int64) -> _Place:
        days = days_since_j2000(stamps)
        factor, _ = factor_and_offset(str(attrs.get("units", "km")), "km")
        given = position * factor
        if attrs["frame"] == "gcrf":
            inertial = to_date(given, days)
            fixed = turn_with_earth(inertial, days, -1)
        else:
            fixed, inertial = given, turn_with_earth(given, days, 1)
        return cls(stamps, days, fixed, inertial, sun_direction(days))

    def rows(self, index: Int64) -> _Place:
        """Return some of the places."""
        return _Place(*(getattr(self, field.name)[index] for field in fields(self)))


def _phases(place: _Place, normal: Floats) -> tuple[Floats, Floats]:
    """Return the angles along the orbit from the ascending node, and from the point nearest the Sun; deg."""
    node = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)
    node[np.hypot(node[:, 0], node[:, 1]) < _LEAST_INCLINATION] = (1.0, 0.0, 0.0)
    ahead = np.cross(normal, node)

    def angle(vectors: Floats) -> Floats:
        sine, cosine = np.einsum("ta,ta->t", vectors, ahead), np.einsum("ta,ta->t", vectors, node)
        with np.errstate(invalid="ignore"):
            return np.where(np.hypot(sine, cosine) > 1e-9, np.arctan2(sine, cosine), np.nan)

    phase = angle(place.inertial)
    return np.rad2deg(phase) % 360.0, np.rad2deg(phase - angle(place.sun)) % 360.0


def _beside(stamps: Int64, rows: Int64) -> tuple[Int64, Int64, float]:
    """Return the samples on both sides that tell the orbit's plane, and their longest distance, ns."""
    usual = usual_step(stamps[:2000], SECOND)
    reach = max(1, round(0.5 * _PLANE_STEP * SECOND / usual))
    return np.maximum(rows - reach, 0), np.minimum(rows + reach, stamps.size - 1), 1.5 * 2 * reach * usual


def _normals(
    place: _Place, before: Int64, after: Int64, longest: float
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return unit vectors along the orbital angular momentum (row, 3), of date, and which are known."""
    normal = np.cross(place.inertial[before], place.inertial[after])
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Across a gap the two may be half an orbit apart and tell the opposite plane.
    close = place.tt2000[after] - place.tt2000[before] <= longest
    return normal, np.asarray(np.isfinite(normal).all(axis=1) & close)


def _orbit_normal(place: _Place) -> Floats:
    """Return the unit vector along the orbital angular momentum; (time, 3), of date.

    From two positions around each sample, a minute apart or one sample either way; where one is
    missing, from the nearest places that have both.
    """
    normal, known = _normals(place, *_beside(place.tt2000, np.arange(len(place.inertial))))
    if not known.any():
        return np.full_like(normal, np.nan)
    stamps = place.tt2000 - place.tt2000[0]
    parts = [np.interp(stamps, stamps[known], normal[known, axis]) for axis in range(3)]
    whole = np.stack(parts, axis=1)
    return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))


def _sun_in_sensor(samples: xr.Dataset, place: _Place) -> Floats | None:
    """Return the unit vector to the Sun in the vector sensor's axes, or None without a usable attitude."""
    if "attitude" not in samples:
        return None
    fixed = turn_with_earth(place.sun, place.days, -1)
    frame = str(samples["attitude"].attrs.get("frame", ""))
    if frame == "itrf":
        seen = fixed
    elif frame == "gcrf":
        seen = from_date(place.sun, place.days)
    elif frame == "nec":
        seen = itrf_to_nec(fixed, place.fixed)
    else:
        return None
    body = rotate(seen, _reversed(np.asarray(samples["attitude"].values, dtype=np.float64)))
    for role in ("vector", "inboard"):
        if role in samples and "orientation" in samples[role].attrs:
            return rotate(body, _reversed(np.asarray(samples[role].attrs["orientation"], dtype=np.float64)))
    return body


def _reversed(quaternion: Floats) -> Floats:
    """Return the opposite rotation of quaternions x, y, z, w; any shape (..., 4)."""
    return np.asarray(quaternion * np.array([-1.0, -1.0, -1.0, 1.0]))
