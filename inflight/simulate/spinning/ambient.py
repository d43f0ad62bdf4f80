"""The field around a spinning spacecraft: solar wind turbulence, and along an orbit dipole and sheath.

Axes are the payload's: z along the spin axis, x towards the Sun's projection (Farrell et al. 1995).
"""

from __future__ import annotations

import numpy as np

from inflight.frames import gse_to_itrf, to_gse
from inflight.main_field import IGRF, MainField
from inflight.simulate.grid import Float
from inflight.simulate.randomness import drift, generator
from inflight.simulate.spinning.attitude import payload_axes, to_payload
from inflight.simulate.spinning.settings import SpinningParameters
from inflight.time import SECOND

EARTH_RADIUS_KM = 6371.2
#: Gravitational parameter of the Earth, km^3/s^2, and its dipole's field at the equator, nT.
_MU, _DIPOLE_NT = 398_600.4, 30_000.0
#: Spectral index of the power of fluctuations, and the longest period made day by day, s.
_INDEX, _LONGEST = -5.0 / 3.0, 7200.0
#: The dipole ends and the wind begins at these distances, Earth radii; between them is the sheath.
MAGNETOPAUSE, BOW_SHOCK = 9.0, 12.0
#: Tilt of dipole and orbit from the pole of the ecliptic, rad: every direction of field is met.
_DIPOLE_TILT, _ORBIT_TILT = 0.35, 0.15
#: Fluctuations over the mean field: in the sheath by angle and strength, in the dipole by component.
_SHEATH_TURNING, _SHEATH_COMPRESSION, _SHEATH_FIELD, _QUIET = 0.9, 0.25, 22.0, 2e-4


def solar_wind(seconds: Float, seed: int, day: int, parameters: SpinningParameters) -> Float:
    """Return the solar wind's field, nT, payload axes; (time, 3).

    Its direction turns (Alfvenic), its strength changes by a small part (compression), both with a
    Kolmogorov spectrum.
    """
    turning, compression = parameters.turning, parameters.compression
    return _turbulent(seconds, seed, day, "wind", parameters.field, turning, compression)


def _turbulent(
    seconds: Float, seed: int, day: int, stream: str, field: float, turning: float, compression: float
) -> Float:
    slow = drift(seconds, seed, f"{stream} slow", (1.0,) * 4, periods=(_LONGEST, 4e5), waves=24)
    fast = _kolmogorov(seconds.size, float(seconds[1] - seconds[0]), 4, seed, day, stream)
    # Power of the slow part over that of the fast one: both are one spectrum.
    shape = 0.8 * slow + 0.6 * fast
    mean = np.array([0.62, -0.62, 0.48])
    along = mean + turning * shape[:, :3]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    strength = field * np.exp(compression * shape[:, 3])
    return np.asarray(along * strength[:, None])


def _kolmogorov(count: int, step: float, columns: int, seed: int, day: int, stream: str) -> Float:
    """Return noise of unit variance whose power falls with frequency to the -5/3; (time, column)."""
    random = generator(seed, f"{stream} fast", day)
    frequency = np.fft.rfftfreq(count, step)
    size = np.zeros(frequency.size)
    band = frequency > 1.0 / _LONGEST
    size[band] = frequency[band] ** (_INDEX / 2.0)
    phases = np.exp(2j * np.pi * random.random((columns, frequency.size)))
    made = np.fft.irfft(size * phases, count, axis=1).T
    return np.asarray(made / made.std(axis=0))


def position(seconds: Float, parameters: SpinningParameters) -> Float:
    """Return the position along the orbit, km, gse; (time, 3); zeros where there is none."""
    if parameters.apogee <= 0.0:
        return np.zeros((seconds.size, 3))
    low, high = parameters.perigee * EARTH_RADIUS_KM, parameters.apogee * EARTH_RADIUS_KM
    axis, eccentricity = (low + high) / 2.0, (high - low) / (high + low)
    mean = np.mod(2.0 * np.pi * orbits(seconds, parameters), 2.0 * np.pi)
    anomaly = mean
    for _ in range(40):
        error = anomaly - eccentricity * np.sin(anomaly) - mean
        anomaly = anomaly - 0.9 * error / (1.0 - eccentricity * np.cos(anomaly))
        if np.abs(error).max(initial=0.0) < 1e-13:
            break
    # Apogee towards the Sun.
    x = -axis * (np.cos(anomaly) - eccentricity)
    y = -axis * np.sqrt(1.0 - eccentricity**2) * np.sin(anomaly)
    return np.column_stack([x, y * np.cos(_ORBIT_TILT), y * np.sin(_ORBIT_TILT)])


def orbits(seconds: Float, parameters: SpinningParameters) -> Float:
    """Return how many orbits have passed, whole numbers at perigee; (time,). There has to be an orbit."""
    axis = 0.5 * (parameters.perigee + parameters.apogee) * EARTH_RADIUS_KM
    return np.asarray(np.sqrt(_MU / axis**3) * seconds / (2.0 * np.pi))


def in_shadow(place: Float) -> np.ndarray:
    """Return where the Earth hides the Sun; (time,)."""
    across = np.hypot(place[:, 1], place[:, 2])
    return np.asarray((place[:, 0] < 0.0) & (across < EARTH_RADIUS_KM) & (np.linalg.norm(place, axis=1) > 0))


def field(seconds: Float, place: Float, seed: int, day: int, parameters: SpinningParameters) -> Float:
    """Return the ambient field, nT, payload axes; (time, 3)."""
    outside = solar_wind(seconds, seed, day, parameters)
    if parameters.apogee <= 0.0:
        return outside
    radius = np.linalg.norm(place, axis=1) / EARTH_RADIUS_KM
    sheath = _turbulent(seconds, seed, day, "sheath", _SHEATH_FIELD, _SHEATH_TURNING, _SHEATH_COMPRESSION)
    earth = main_field(seconds, parameters) if parameters.main_field else _dipole(place)
    inside = to_payload(earth, payload_axes(place, parameters))
    # Currents of the magnetosphere: fluctuations that grow with the field.
    strength = np.linalg.norm(inside, axis=1, keepdims=True)
    fluctuation = _kolmogorov(seconds.size, float(seconds[1] - seconds[0]), 3, seed, day, "magnetosphere")
    inside = inside + fluctuation * (0.5 + _QUIET * strength)
    out = np.where((radius < MAGNETOPAUSE)[:, None], inside, outside)
    between = (radius >= MAGNETOPAUSE) & (radius < BOW_SHOCK)
    out[between] = sheath[between]
    return out


def _dipole(place: Float) -> Float:
    """Return the field of a dipole that stands still, nT, gse; (time, 3)."""
    radius = np.linalg.norm(place, axis=1, keepdims=True)
    moment = np.array([np.sin(_DIPOLE_TILT), 0.0, np.cos(_DIPOLE_TILT)])
    along = place / radius
    strength = -_DIPOLE_NT / (radius / EARTH_RADIUS_KM) ** 3
    return np.asarray(strength * (3.0 * along * (along @ moment)[:, None] - moment))


def main_field(seconds: Float, parameters: SpinningParameters) -> Float:
    """Return the IGRF's field along the orbit, nT, gse; (time, 3)."""
    stamps = np.rint(seconds * SECOND).astype(np.int64)
    # The orbit is followed between places half a minute apart, a little beyond the record.
    places = np.arange(seconds[0] - 60.0, seconds[-1] + 90.0, 30.0)
    there = np.rint(places * SECOND).astype(np.int64)
    orbit = gse_to_itrf(position(places, parameters), there)
    return to_gse(MainField.of(IGRF).along_orbit(orbit, there, stamps), stamps, "itrf")
