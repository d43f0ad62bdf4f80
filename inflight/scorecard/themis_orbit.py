"""Pieces of an orbit like THEMIS-C's in July 2007: solar wind, magnetosheath, and the way past perigee.

Fluctuations have a power of -5/3 and by region the strength at the spin that the paper's uncertainties
imply: some pT in the wind and in the magnetosphere, tenths of a nT in the sheath (Plaschke et al. 2019,
Figs. 2 and 3). They show estimators at work in such fields; THEMIS-C's own readings they are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.spin import respin
from inflight.time import SECOND, Int64

#: Spin period and cadence, s; hours of each piece.
SPIN, CADENCE, HOURS = 3.0, 0.25, 3.0
#: Mean field, nT, and root of the power density at 1 Hz, nT/sqrt(Hz), of wind and sheath.
WIND, SHEATH = ((3.5, -3.0, 1.0), 0.02), ((17.5, -15.0, 17.0), 0.8)
_QUIET = 0.012
#: Part of the fluctuations that changes the size.
_COMPRESSED = 0.4
#: Dipole at the equator, Earth's radius (km), the dipole's tilt from the spin axis (rad).
_DIPOLE, _RADIUS, _TILT = 30_000.0, 6371.2, 0.5
#: Earth radii, and the Earth's gravitational parameter, km^3/s^2.
_PERIGEE, _APOGEE = 1.4, 14.4
_MU = 398_600.4
#: Below this frequency, Hz, the spectrum is flat.
_SLOWEST = 2e-4


@dataclass(frozen=True)
class Piece:
    """Samples of one region.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    phase : ndarray, shape (time,)
        Spin phase, rad.
    field : ndarray, shape (time, 3)
        nT, spinning axes.
    distance : ndarray, shape (time,)
        Earth radii; NaN where it does not matter.
    """

    stamps: Int64
    phase: Floats
    field: Floats
    distance: Floats


def piece(region: str, seed: int) -> Piece:
    """Return three hours of ``wind``, ``sheath`` or ``perigee``."""
    seconds: Floats = (np.arange(round(HOURS * 3600.0 / CADENCE), dtype=np.float64) + 0.5) * CADENCE
    distance: Floats = np.full(seconds.size, np.nan)
    if region == "perigee":
        mean, distance = _past_perigee(seconds - 1800.0 * HOURS)
        density = _QUIET
    else:
        level, density = WIND if region == "wind" else SHEATH
        mean = np.tile(level, (seconds.size, 1))
    phase: Floats = 2.0 * np.pi * seconds / SPIN
    field = _fluctuating(mean, density, np.random.default_rng([seed, len(region)]))
    return Piece((seconds * SECOND).astype(np.int64), phase, respin(field, phase), distance)


def _fluctuating(mean: Floats, density: float, generator: np.random.Generator) -> Floats:
    """Return the mean field (time, 3) with turbulence that turns it and changes its size."""
    size = 1 << (len(mean) - 1).bit_length()
    frequency = np.maximum(np.fft.rfftfreq(size, CADENCE), _SLOWEST)
    amplitude = density * np.sqrt(frequency ** (-5.0 / 3.0) * size / CADENCE / 4.0)
    parts = generator.normal(size=(4, frequency.size)) + 1j * generator.normal(size=(4, frequency.size))
    waves = np.fft.irfft(amplitude * parts, size, axis=1).T[: len(mean)]
    bent = mean + waves[:, :3]
    strength = np.linalg.norm(mean, axis=1) + _COMPRESSED * waves[:, 3]
    return np.asarray(bent * (strength / np.linalg.norm(bent, axis=1))[:, None])


def _past_perigee(seconds: Floats) -> tuple[Floats, Floats]:
    """Return a dipole's field (time, 3), nT, and the distance, seconds from perigee."""
    axis = 0.5 * (_PERIGEE + _APOGEE)
    eccentricity = (_APOGEE - _PERIGEE) / (_APOGEE + _PERIGEE)
    mean = seconds * np.sqrt(_MU / (axis * _RADIUS) ** 3)
    anomaly = np.cbrt(6.0 * mean)
    for _ in range(20):
        fall = anomaly - eccentricity * np.sin(anomaly) - mean
        anomaly = anomaly - fall / (1.0 - eccentricity * np.cos(anomaly))
    across = axis * np.sqrt(1.0 - eccentricity**2) * np.sin(anomaly)
    place = np.column_stack(
        [-axis * (np.cos(anomaly) - eccentricity), across * np.cos(0.3), across * np.sin(0.3)]
    )
    distance = np.linalg.norm(place, axis=1)
    up, moment = place / distance[:, None], np.array([np.sin(_TILT), 0.0, np.cos(_TILT)])
    field = -_DIPOLE / distance[:, None] ** 3 * (3.0 * (up @ moment)[:, None] * up - moment)
    return field, distance
