"""Where the spacecraft is, where the Sun is, and how the spacecraft points.

Kepler ellipse with the secular drift of J2 (Vallado, Fundamentals of Astrodynamics, 9.6), Sun of the
low-precision almanac formulas, Earth turned by mean sidereal time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

MU = 398_600.4418
EARTH_RADIUS = 6378.137
J2 = 1.08262668e-3
#: Half the Sun's apparent diameter, rad: the width of the penumbra.
SUN_RADIUS = np.deg2rad(0.2666)
ATTITUDES = ("nadir", "yaw", "inertial", "tumble")
EPOCH = np.datetime64("2000-01-01T12:00:00", "ns")


@dataclass(frozen=True)
class Orbit:
    """A Kepler orbit; altitude of the perigee in km, angles in degrees, local time of the node in hours."""

    altitude: float
    eccentricity: float
    inclination: float
    local_time: float
    perigee: float
    phase: float

    @property
    def axis(self) -> float:
        """Semi-major axis, km."""
        return (EARTH_RADIUS + self.altitude) / (1.0 - self.eccentricity)

    @property
    def motion(self) -> float:
        """Mean motion, rad/s."""
        return float(np.sqrt(MU / self.axis**3))

    @property
    def period(self) -> float:
        """Nodal period, s: from one ascending node to the next."""
        return float(2 * np.pi / (self.motion + sum(self._drift()[1:])))

    @property
    def node_rate(self) -> float:
        """Drift of the node, rad/s."""
        return self._drift()[0]

    def _drift(self) -> tuple[float, float, float]:
        """Rates of node, perigee and mean anomaly by the Earth's flattening, rad/s."""
        c = np.cos(np.deg2rad(self.inclination))
        k = 1.5 * J2 * (EARTH_RADIUS / (self.axis * (1 - self.eccentricity**2))) ** 2 * self.motion
        return -k * c, k * (2.5 * c * c - 0.5), k * np.sqrt(1 - self.eccentricity**2) * (1.5 * c * c - 0.5)


@dataclass(frozen=True)
class Track:
    """The flight on the base grid; all vectors (time, 3).

    `position` km and `turn` (time, 3, 3) from body to Earth-fixed axes, both itrf; `sun` unit vector
    in body axes; `sunlit` 0 to 1; `argument` of latitude, rad; `seconds` since the start.
    """

    seconds: np.ndarray
    position: np.ndarray
    turn: np.ndarray
    sun: np.ndarray
    sunlit: np.ndarray
    argument: np.ndarray
    sun_height: np.ndarray

    @property
    def step(self) -> float:
        """Spacing of the grid, s."""
        return float(self.seconds[1] - self.seconds[0])


def sun_direction(days: np.ndarray) -> np.ndarray:
    """Return the unit vector to the Sun, equator of date; days since J2000, (time, 3)."""
    anomaly = np.deg2rad(357.528 + 0.9856003 * days)
    longitude = np.deg2rad(280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    tilt = np.deg2rad(23.439 - 4e-7 * days)
    return np.stack(
        [np.cos(longitude), np.sin(longitude) * np.cos(tilt), np.sin(longitude) * np.sin(tilt)], axis=1
    )


def sidereal_angle(days: np.ndarray) -> np.ndarray:
    """Return Greenwich mean sidereal time, rad; days of UT since J2000."""
    return np.deg2rad((280.46061837 + 360.98564736629 * days) % 360.0)


def fly(
    orbit: Orbit, attitude: str, start: np.datetime64, seconds: np.ndarray, rng: np.random.Generator
) -> Track:
    """Return the flight from a UTC start over so many seconds (time,)."""
    days = (start.astype("datetime64[ns]") - EPOCH) / np.timedelta64(1, "D") + seconds / 86_400.0
    sun = sun_direction(days)
    radial, along, radius, argument = _ellipse(orbit, sun[0], seconds)
    body = _point(attitude, radial, along, sun, seconds, rng)
    position = radial * radius[:, None]
    sunlit = _sunlit(position, sun)
    theta = sidereal_angle(days)
    return Track(
        seconds,
        _spin(position, theta),
        np.stack([_spin(body[:, :, k], theta) for k in range(3)], axis=2),
        np.einsum("tak,ta->tk", body, sun),
        sunlit,
        argument,
        np.einsum("ta,ta->t", radial, sun),
    )


def _ellipse(orbit: Orbit, first_sun: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return radial and along-track unit vectors (inertial), radius in km, argument of latitude in rad."""
    node_rate, perigee_rate, anomaly_rate = orbit._drift()
    node = np.arctan2(first_sun[1], first_sun[0]) + np.deg2rad(15.0 * (orbit.local_time - 12.0))
    node = node + node_rate * t
    e = orbit.eccentricity
    mean = np.deg2rad(orbit.phase - orbit.perigee) + (orbit.motion + anomaly_rate) * t
    excentric = mean + e * np.sin(mean)
    for _ in range(5):
        excentric -= (excentric - e * np.sin(excentric) - mean) / (1 - e * np.cos(excentric))
    true = 2 * np.arctan2(np.sqrt(1 + e) * np.sin(excentric / 2), np.sqrt(1 - e) * np.cos(excentric / 2))
    argument = np.deg2rad(orbit.perigee) + perigee_rate * t + true
    ci, si = np.cos(np.deg2rad(orbit.inclination)), np.sin(np.deg2rad(orbit.inclination))
    p = np.stack([np.cos(node), np.sin(node), 0 * node], axis=1)
    q = np.stack([-np.sin(node) * ci, np.cos(node) * ci, si + 0 * node], axis=1)
    cu, su = np.cos(argument)[:, None], np.sin(argument)[:, None]
    return p * cu + q * su, q * cu - p * su, orbit.axis * (1 - e * np.cos(excentric)), argument


def _point(
    attitude: str,
    radial: np.ndarray,
    along: np.ndarray,
    sun: np.ndarray,
    t: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the body's axes as columns (time, axis, column), inertial; a wobble of some degrees on top."""
    if attitude in ("inertial", "tumble"):
        axes = np.broadcast_to(Rotation.random(random_state=rng).as_matrix(), (t.size, 3, 3))
    else:
        z = -radial
        side = np.cross(z, along)
        side /= np.linalg.norm(side, axis=1)[:, None]
        axes = np.stack([np.cross(side, z), side, z], axis=2)
    turned = Rotation.from_rotvec(_wobble(t, rng))
    if attitude == "tumble":
        axis = rng.normal(size=3)
        rate = 2 * np.pi / rng.uniform(1500.0, 2600.0)
        turned = Rotation.from_rotvec(np.outer(rate * t, axis / np.linalg.norm(axis))) * turned
    if attitude == "yaw":
        seen = np.einsum("tak,ta->tk", axes, sun)
        steer = np.unwrap(np.arctan2(seen[:, 1], seen[:, 0]))
        turned = Rotation.from_rotvec(np.outer(steer, [0.0, 0.0, 1.0])) * turned
    return np.einsum("tij,tjk->tik", axes, turned.as_matrix())


def _wobble(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return small rotations, rad (time, 3): six slow waves an axis, 2 degrees rms in all."""
    periods = np.exp(rng.uniform(np.log(400.0), np.log(90_000.0), (6, 3)))
    size = rng.normal(0.0, np.deg2rad(2.0) / np.sqrt(3.0), (6, 3))
    phase = rng.uniform(0, 2 * np.pi, (6, 3))
    out = np.zeros((t.size, 3))
    for one, amount, begin in zip(periods, size, phase, strict=True):
        out += amount * np.sin(2 * np.pi * t[:, None] / one + begin)
    return out


def _sunlit(position: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Return the lit part of the Sun's disc, taken as growing linearly across the penumbra; (time,)."""
    away = np.einsum("ta,ta->t", position, sun)
    across = np.sqrt(np.maximum(np.einsum("ta,ta->t", position, position) - away**2, 0.0))
    half = np.maximum(np.abs(away) * SUN_RADIUS, 1e-6)
    lit = np.clip((across - EARTH_RADIUS) / (2 * half) + 0.5, 0.0, 1.0)
    return np.where(away > 0, 1.0, lit)


def _spin(vectors: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Turn inertial vectors (time, 3) into Earth-fixed axes."""
    c, s = np.cos(theta), np.sin(theta)
    x, y, z = vectors.T
    return np.stack([c * x + s * y, c * y - s * x, z], axis=1)
