"""Frames: the Sun, the Earth's turn and shadow, orbit geometry, and turning vectors between axes.

Frames: *sensor* (orthogonal axes of the vector sensor), *spacecraft*, *itrf* (turns with the Earth), *nec*
(north, east, centre: z towards the Earth's centre, geocentric), *gcrf* (equator and equinox of J2000), *gei*
(mean equator and equinox of date), *gse* (x to the Sun as the Earth sees it, z to the pole of the ecliptic
of date), *gsm* (gse turned about x until the Earth's dipole lies in its xz plane, z northward: Russell 1971;
Hapgood 1992). *Payload* axes have z along the spin and x to the Sun's projection into the spin plane
(Farrell et al. 1995, eq. 1). *Of date* is the true direction at the time, less nutation (below 0.005
degrees). UTC stands for UT1, which differs by at most 0.9 s (0.004 degrees). Directions are true to some
hundredths of a degree (low-precision formulas of the Astronomical Almanac); the dipole is that of the IGRF.

These formulas are kept here because a library for them takes seconds to import; the tests hold them against
one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.errors import MissionError, SamplesError
from inflight.main_field import IGRF, MainField
from inflight.time import SECOND, Int64, to_utc, usual_step
from inflight.units import factor_and_offset

if TYPE_CHECKING:
    import xarray as xr

_J2000_TIME = np.datetime64("2000-01-01T12:00:00", "ns")

_DAY = np.timedelta64(1, "D")

#: Mean radius of the Earth, km, and the Sun's as seen from it, rad (0.2666 degrees).
EARTH_RADIUS = 6371.0

SUN_RADIUS = 0.2666 * np.pi / 180.0

#: Where the Earth's shadow may end, km beyond that radius, and layers between: the equator is 7 km farther
#: out and the poles 14 km closer, and some 10 to 20 km of air dim the Sun.
SHADOW_LAYERS = (-15.0, 0.0, 15.0, 30.0)


@dataclass(frozen=True, kw_only=True)
class GeometrySettings:
    """Where directions stop being known.

    Attributes
    ----------
    shortest_quaternion : float
        A quaternion shorter than this is none (assumed: a fill value or nothing).
    plane_step : float
        s; two positions this far apart give the orbit's plane: further than their rounding matters (derived).
    least_inclination : float
        Sine of an angle; an orbit inclined by less has no node, and its phase counts from the vernal equinox
        (assumed).
    least_projection : float
        Sine of 5 degrees; with the Sun nearer to the spin axis its projection gives no direction (assumed).
    """

    shortest_quaternion: float = 0.5
    plane_step: float = 60.0
    least_inclination: float = 0.01
    least_projection: float = 0.087


GEOMETRY_SETTINGS = GeometrySettings()


def days_since_j2000(tt2000: Int64) -> Floats:
    """Return UTC days since 2000-01-01T12:00:00; (time,)."""
    return np.asarray((to_utc(tt2000) - _J2000_TIME) / _DAY, dtype=np.float64)


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
    return np.stack([np.cos(longitude), np.cos(tilt) * east, np.sin(tilt) * east]).T


def to_date(vectors: Floats, days: Floats) -> Floats:
    """Turn gcrf vectors (time, 3) to the equator and equinox of date: precession to first order.

    The angles grow by 0.640616, 0.556753 and 0.640616 degrees a century (Lieske et al. 1977, linear
    terms); taken at the mean of the days, which may be a year.
    """
    return np.asarray(_precession(days).apply(vectors))


def from_date(vectors: Floats, days: Floats) -> Floats:
    """Turn vectors (time, 3) of date to gcrf; the inverse of `to_date`."""
    return np.asarray(_precession(days).inv().apply(vectors))


def _precession(days: Floats) -> scipy.spatial.transform.Rotation:
    century = float(np.mean(days)) / 36525.0 if days.size else 0.0
    # scipy turns vectors, not axes: the signs are the opposite of the almanac's R3, R2, R3.
    return scipy.spatial.transform.Rotation.from_euler(
        "zyz", [0.640616 * century, -0.556753 * century, 0.640616 * century], True
    )


def rotate_with_earth(vectors: Floats, days: Floats, sign: int) -> Floats:
    """Turn vectors (time, 3) about the pole: from itrf to of date with sign +1, back with -1."""
    angle = sign * sidereal_angle(days)
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z]).T


def sunlit_fraction(position: Floats, sun: Floats, height: float = 0.0) -> Floats:
    """Return how much of the Sun's disc the Earth leaves free: 0 in umbra, 1 in full light; (time,).

    Parameters
    ----------
    position : ndarray, shape (time, 3)
        km from the centre of the Earth, taken as a sphere without air.
    sun : ndarray, shape (time, 3)
        Unit vector to the Sun, same frame.
    height : float
        km that the shadow reaches beyond that sphere.
    """
    radius = np.linalg.norm(position, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = -np.einsum("ta,ta->t", position, sun) / radius
        earth = np.arcsin(np.minimum((EARTH_RADIUS + height) / radius, 1.0))
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
        return np.asarray(field @ scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix().T)
    x, y, z, w = np.ascontiguousarray(quaternion.T)
    vx, vy, vz = np.ascontiguousarray(field.T)
    size = x * x + y * y + z * z + w * w
    with np.errstate(invalid="ignore", divide="ignore"):
        twice = np.where(size > GEOMETRY_SETTINGS.shortest_quaternion**2, 2.0 / size, np.nan)
    # v + 2 w (q x v) + 2 q x (q x v), of a quaternion of any length.
    tx, ty, tz = twice * (y * vz - z * vy), twice * (z * vx - x * vz), twice * (x * vy - y * vx)
    out = np.empty_like(field)
    out[:, 0] = vx + w * tx + y * tz - z * ty
    out[:, 1] = vy + w * ty + z * tx - x * tz
    out[:, 2] = vz + w * tz + x * ty - y * tx
    return out


def cross(one: Floats, other: Floats) -> Floats:
    """Return the cross products of vectors (time, 3)."""
    (x, y, z), (u, v, w) = one.T, other.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u]).T


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
    x, y, z = position.T
    from_axis = np.hypot(x, y)
    distance = np.hypot(from_axis, z)
    # At a pole any longitude does.
    on_axis = from_axis == 0.0
    with np.errstate(invalid="ignore", divide="ignore"):
        sin_lat, cos_lat = z / distance, from_axis / distance
        sin_lon, cos_lon = np.where(on_axis, 0.0, y / from_axis), np.where(on_axis, 1.0, x / from_axis)
    fx, fy, fz = field.T
    along = fx * cos_lon + fy * sin_lon
    north = -sin_lat * along + cos_lat * fz
    east = -sin_lon * fx + cos_lon * fy
    centre = -cos_lat * along - sin_lat * fz
    return np.stack([north, east, centre]).T


def position_in_itrf(position: Floats, frame: str, tt2000: Int64) -> Floats:
    """Return positions (time, 3) of a frame, ``itrf`` or ``gcrf``, Earth-fixed; any unit of length."""
    if frame == "itrf":
        return position
    days = days_since_j2000(tt2000)
    return rotate_with_earth(to_date(position, days), days, -1)


def itrf_to_spacecraft(
    field: Floats, attitude: Floats, frame: str, position: Floats, tt2000: Int64
) -> Floats:
    """Turn Earth-fixed vectors into the spacecraft's axes.

    Parameters
    ----------
    field : ndarray, shape (time, 3)
        Vectors, itrf.
    attitude : ndarray, shape (time, 4)
        Quaternion x, y, z, w from spacecraft axes to `frame`.
    frame : str
        ``itrf``, ``nec`` or ``gcrf``.
    position : ndarray, shape (time, 3)
        itrf, any length unit; only needed for ``nec``.
    tt2000 : ndarray of int64, shape (time,)
    """
    if frame == "nec":
        field = itrf_to_nec(field, position)
    elif frame == "gcrf":
        days = days_since_j2000(tt2000)
        field = from_date(rotate_with_earth(field, days, 1), days)
    return rotate(field, attitude * np.array([-1.0, -1.0, -1.0, 1.0]))


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
    rotated = rotate(field, attitude)
    if frame == "nec":
        return rotated
    if frame != "itrf":
        raise SamplesError(
            f"attitude is given towards {frame!r}", channel="attitude", remedy="give it towards itrf or nec"
        )
    if position is None:
        raise SamplesError("no position", channel="position", remedy="add an orbit instrument to the mission")
    return itrf_to_nec(rotated, position)


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
    "shadow_entry": "1",
    "shadow_exit": "1",
}

#: Variables of samples that they are made from.
_GEOMETRY_INPUTS = ("tt2000", "position", "attitude", "vector", "inboard")

#: Those made from the orbit's plane.
_PHASES = ("orbit_phase", "sun_phase")

#: What the Earth's shadow makes, and where it is not known well; see `_shadow_edges`.
SHADOW, SHADOW_EDGES = "sunlit", ("shadow_entry", "shadow_exit")

#: Those that a slow response or a play may be made of: positions are enough for them.
SLOW_GEOMETRY = ("sunlit", "latitude")


def add_geometry(samples: xr.Dataset, names: Collection[str] = tuple(GEOMETRY)) -> xr.Dataset:
    """Add geometry from position and attitude; at any cadence, with gaps.

    Parameters
    ----------
    samples : xarray.Dataset
        `tt2000` (time); `position` (time, axis) with attributes `units` and `frame` (itrf or gcrf);
        `attitude` (time, quaternion) from spacecraft axes to its attribute `frame` (itrf, gcrf or
        nec); a vector reading with attribute `orientation`, the quaternion from sensor to
        spacecraft axes (the same axes when absent).
    names : collection of str
        Of `GEOMETRY`, what to add.

    Returns
    -------
    xarray.Dataset
        With `latitude`, `longitude` (deg, geocentric), `orbit_phase` (deg, 0 at the ascending node),
        `sun_phase` (deg along the orbit from the point nearest the Sun; NaN where there is none),
        `local_time` (h, mean solar), `sunlit` (1 in light, 0 in shadow), `sun_direction` (time,
        axis), unit vector in the vector sensor's axes; `shadow_entry` and `shadow_exit` (time, axis), where
        light fades and where it returns: by how much less light there is when the shadow ends at the upper
        instead of the lower edge of each of `SHADOW_LAYERS`. Nothing is added without a position in a
        known frame, no Sun direction without an attitude, and nothing that is there is replaced.
    """
    place = _place(samples)
    if place is None:
        return samples
    missing = [name for name in names if name not in samples]
    normal = _orbit_normal(place) if set(missing) & {*_PHASES, *SHADOW_EDGES} else None
    return samples.assign(_as_variables(_geometry(samples, place, normal, missing)))


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
    samples = samples[[name for name in _GEOMETRY_INPUTS if name in samples]]
    before, after, longest = _neighbours(stamps, rows)
    around = np.unique(np.concatenate([before, rows, after]))
    place = _place(samples.isel(time=around))
    if place is None:
        return {}
    normal, known = _normals(place, np.searchsorted(around, before), np.searchsorted(around, after), longest)
    if not known.all():
        # Next to a gap the orbit's plane comes from farther away.
        whole = add_geometry(samples)
        return {name: whole[name].variable.isel(time=rows) for name in GEOMETRY if name in whole}
    here = np.searchsorted(around, rows)
    return _as_variables(_geometry(samples.isel(time=rows), place.rows(here), normal, list(GEOMETRY)))


def _as_variables(found: Mapping[str, Floats]) -> dict[str, xr.Variable]:
    import xarray as xr

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


def _geometry(
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
        if set(SHADOW_EDGES) & set(names):
            found |= dict(zip(SHADOW_EDGES, _shadow_edges(place, found["sun_phase"]), strict=True))
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
            fixed = rotate_with_earth(inertial, days, -1)
        else:
            fixed, inertial = given, rotate_with_earth(given, days, 1)
        return cls(stamps, days, fixed, inertial, sun_direction(days))

    def rows(self, index: Int64) -> _Place:
        """Return some of the places."""
        return _Place(*(getattr(self, field.name)[index] for field in fields(self)))


def _phases(place: _Place, normal: Floats) -> tuple[Floats, Floats]:
    """Return the angles along the orbit from the ascending node, and from the point nearest the Sun; deg."""
    node = np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))]).T
    node[np.hypot(node[:, 0], node[:, 1]) < GEOMETRY_SETTINGS.least_inclination] = (1.0, 0.0, 0.0)
    ahead = cross(normal, node)

    def angle(vectors: Floats) -> Floats:
        sine, cosine = np.einsum("ta,ta->t", vectors, ahead), np.einsum("ta,ta->t", vectors, node)
        with np.errstate(invalid="ignore"):
            return np.where(np.hypot(sine, cosine) > 1e-9, np.arctan2(sine, cosine), np.nan)

    phase = angle(place.inertial)
    return np.rad2deg(phase) % 360.0, np.rad2deg(phase - angle(place.sun)) % 360.0


def _shadow_edges(place: _Place, sun_phase: Floats) -> tuple[Floats, Floats]:
    """Return the light of each of `SHADOW_LAYERS`, where it fades and where it returns; (time, layer)."""
    light = np.stack([sunlit_fraction(place.inertial, place.sun, height) for height in SHADOW_LAYERS])
    changed = -np.diff(light, axis=0).T
    away = np.where(np.isnan(sun_phase), 0.5, sun_phase < 180.0)[:, None]
    return changed * away, changed * (1.0 - away)


def _neighbours(stamps: Int64, rows: Int64) -> tuple[Int64, Int64, float]:
    """Return the samples on both sides that the orbit's plane comes from, and their longest distance, ns."""
    usual = usual_step(stamps[:2000], SECOND)
    reach = max(1, round(0.5 * GEOMETRY_SETTINGS.plane_step * SECOND / usual))
    return np.maximum(rows - reach, 0), np.minimum(rows + reach, stamps.size - 1), 1.5 * 2 * reach * usual


def _normals(
    place: _Place, before: Int64, after: Int64, longest: float
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return unit vectors along the orbital angular momentum (row, 3), of date, and which are known."""
    along = place.inertial.T
    # One axis after the other: rows of three are gathered many times as slowly.
    normal = cross(*(np.stack([axis[index] for axis in along]).T for index in (before, after)))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Across a gap the two may be half an orbit apart and give the opposite plane.
    close = place.tt2000[after] - place.tt2000[before] <= longest
    return normal, np.asarray(np.isfinite(normal).all(axis=1) & close)


def _orbit_normal(place: _Place) -> Floats:
    """Return the unit vector along the orbital angular momentum; (time, 3), of date.

    From two positions around each sample, a minute apart or one sample either way; where one is
    missing, from the nearest places that have both.
    """
    normal, known = _normals(place, *_neighbours(place.tt2000, np.arange(len(place.inertial))))
    if not known.any():
        return np.full_like(normal, np.nan)
    stamps = place.tt2000 - place.tt2000[0]
    parts = [np.interp(stamps, stamps[known], normal[known, axis]) for axis in range(3)]
    whole = np.stack(parts).T
    return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))


def _sun_in_sensor(samples: xr.Dataset, place: _Place) -> Floats | None:
    """Return the unit vector to the Sun in the vector sensor's axes, or None without a usable attitude."""
    if "attitude" not in samples:
        return None
    fixed = rotate_with_earth(place.sun, place.days, -1)
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


#: Axes in which a spin axis or a position may be given.
FRAMES = ("gse", "gsm", "gei", "gcrf", "itrf")

#: km.
ASTRONOMICAL_UNIT = 149_597_870.7

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
    axis = -MainField.of(IGRF).dipole_coefficients(days + _J2000)
    return np.asarray(axis / np.linalg.norm(axis, axis=1, keepdims=True))


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
        vectors = rotate_with_earth(vectors, days, 1)
    return _equator_to_gse(vectors, days)


def gse_to_gsm(vectors: Floats, tt2000: Int64) -> Floats:
    """Turn vectors (time, 3) from gse to gsm."""
    return _about_x(vectors, dipole_angle(tt2000))


def dipole_angle(tt2000: Int64) -> Floats:
    """Return by how much gsm is turned about x from gse, from y towards z; (time,) rad."""
    days = days_since_j2000(tt2000)
    dipole = _equator_to_gse(rotate_with_earth(dipole_axis(days), days, 1), days)
    # z of gsm lies along the dipole's part across x.
    return np.asarray(np.arctan2(-dipole[:, 1], dipole[:, 2]))


def sun_direction_gse(tt2000: Int64, position: Floats | None = None) -> Floats:
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
    ahead, side, up = _payload_axes(axis, towards)
    return np.asarray(field[:, :1] * ahead + field[:, 1:2] * side + field[:, 2:] * up)


def gse_to_payload(field: Floats, axis: Floats, towards: Floats) -> Floats:
    """Turn vectors from gse to payload axes: the inverse of `payload_to_gse`; NaN where that is."""
    axes = _payload_axes(axis, towards)
    return np.stack([np.einsum("ta,ta->t", field, one) for one in axes], axis=1)


def _payload_axes(axis: Floats, towards: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the unit vectors x, y and z of the payload; each (time, 3)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        up = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        across = towards - np.einsum("ta,ta->t", towards, up)[:, None] * up
        size = np.linalg.norm(across, axis=1, keepdims=True)
        ahead = across / np.where(size > GEOMETRY_SETTINGS.least_projection, size, np.nan)
    return ahead, cross(up, ahead), up


def _equator_to_gse(vectors: Floats, days: Floats) -> Floats:
    """Turn vectors (time, 3) from the equator and equinox of date to gse."""
    return np.stack([np.einsum("ta,ta->t", vectors, one) for one in _gse_axes(days)], axis=1)


def gse_to_itrf(vectors: Floats, tt2000: Int64) -> Floats:
    """Turn vectors (time, 3) from gse to Earth-fixed axes."""
    days = days_since_j2000(tt2000)
    each = (vectors[:, at : at + 1] * one for at, one in enumerate(_gse_axes(days)))
    return rotate_with_earth(np.asarray(sum(each)), days, -1)


def _gse_axes(days: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the unit vectors of gse in those of equator and equinox of date; each (time, 3)."""
    sun = sun_direction(days)
    # The Sun's path lies in the ecliptic: the angle to the equator is that of `sun_direction`.
    tilt = np.deg2rad(23.439 - 4.0e-7 * days)
    pole = np.stack([np.zeros_like(tilt), -np.sin(tilt), np.cos(tilt)]).T
    return sun, cross(pole, sun), pole


def _about_x(vectors: Floats, angle: Floats) -> Floats:
    """Return components in axes turned about x by an angle (time,) from y towards z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([x, cosine * y + sine * z, cosine * z - sine * y]).T
