"""Fields along a very elliptical orbit through solar wind, sheath and dipole, seen by a spinning sensor.

Written apart from the estimators. Fluctuations are turbulence of power -5/3 that turns the field (Alfvenic)
and a compressional part of it, scaled by region so that their amplitude at the spin has the size THEMIS-C
shows: about 5 pT in the solar wind and in the magnetosphere, some 0.3 nT in the magnetosheath.
"""

from dataclasses import dataclass

import numpy as np

EARTH_DIPOLE = 30_000.0
SUN_WIND, SHEATH, SPHERE = 0, 1, 2


@dataclass(frozen=True)
class Record:
    """Samples of a record: stamps (time,), phase, field (time, 3) in spinning axes, region and distance."""

    stamps: np.ndarray
    phase: np.ndarray
    field: np.ndarray
    region: np.ndarray
    distance: np.ndarray


def turbulence(count, cadence, generator, power=5 / 3, slowest=2e-4):
    """Unit-density noise: 1 nT^2/Hz at 1 Hz, falling with `power`, flat below `slowest` Hz; (count,)."""
    size = 1 << (count - 1).bit_length()
    frequency = np.maximum(np.fft.rfftfreq(size, cadence), slowest)
    amplitude = np.sqrt(frequency**-power * size / cadence / 2)
    spectrum = amplitude * (
        generator.normal(size=frequency.size) + 1j * generator.normal(size=frequency.size)
    )
    return np.fft.irfft(spectrum, size)[:count]


def spun(field, phase):
    """Turn a field (time, 3) from inertial axes into axes at `phase` from x towards y."""
    c, s = np.cos(phase), np.sin(phase)
    return np.stack(
        [c * field[:, 0] + s * field[:, 1], c * field[:, 1] - s * field[:, 0], field[:, 2]], axis=1
    )


def fluctuating(mean, density, compression, cadence, generator):
    """Add turbulence to a mean field (time, 3), `compression` of it to its length, the rest to its direction.

    `density` (time,) is the root of the spectral density at 1 Hz, nT/sqrt(Hz).
    """
    waves = np.stack([turbulence(len(mean), cadence, generator) for _ in range(4)], axis=1)
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    bent = mean + density[:, None] * waves[:, :3]
    length = size + compression * density[:, None] * waves[:, 3:]
    return bent / np.linalg.norm(bent, axis=1, keepdims=True) * length


def steady(seed, hours=2.0, mean=(30.0, 10.0, 20.0), density=0.005, compression=0.5, spin=3.0, cadence=0.25):
    """A record in one field with natural fluctuations."""
    generator = np.random.default_rng(seed)
    seconds = np.arange(round(hours * 3600 / cadence)) * cadence
    base = np.broadcast_to(np.asarray(mean, dtype=float), (seconds.size, 3))
    field = fluctuating(base, np.full(seconds.size, density), compression, cadence, generator)
    phase = 0.7 + 2 * np.pi * seconds / spin
    stamps = (seconds * 1e9).astype(np.int64)
    return Record(stamps, phase, spun(field, phase), np.zeros(seconds.size, int), np.zeros(seconds.size))


def orbit(seed, hours=48.0, spin=3.0, cadence=0.25, perigee=1.4, apogee=14.4, first=-9.5):
    """Two days of an orbit of 31.3 h; perigee `first` hours before the middle of the first pass."""
    generator = np.random.default_rng(seed)
    seconds = np.arange(round(hours * 3600 / cadence)) * cadence
    axis = 0.5 * (perigee + apogee)
    period = 2 * np.pi * np.sqrt((axis * 6.371e6) ** 3 / 3.986e14)
    eccentricity = (apogee - perigee) / (apogee + perigee)
    anomaly = 2 * np.pi * (seconds / 3600 + first) * 3600 / period
    eccentric = anomaly + 0.0
    for _ in range(30):
        eccentric = anomaly + eccentricity * np.sin(eccentric)
    for _ in range(4):
        slope = 1 - eccentricity * np.cos(eccentric)
        eccentric = eccentric - (eccentric - eccentricity * np.sin(eccentric) - anomaly) / slope
    place = np.stack(
        [
            -axis * (np.cos(eccentric) - eccentricity),
            axis * np.sqrt(1 - eccentricity**2) * np.sin(eccentric) * np.cos(0.3),
            axis * np.sqrt(1 - eccentricity**2) * np.sin(eccentric) * np.sin(0.3),
        ],
        axis=1,
    )
    distance = np.linalg.norm(place, axis=1)
    moment = np.array([np.sin(0.5), 0.0, np.cos(0.5)])
    up = place / distance[:, None]
    dipole = -EARTH_DIPOLE / distance[:, None] ** 3 * (3 * (up @ moment)[:, None] * up - moment)
    region = np.where(distance > 13.2, SUN_WIND, np.where(distance > 9.5, SHEATH, SPHERE))
    wind = np.array([3.5, -3.0, 1.0])
    outer = {SUN_WIND: wind, SHEATH: 5.0 * wind + [0, 0, 12.0], SPHERE: np.array([5.0, 5.0, 25.0])}
    density = np.choose(region, [0.02, 0.8, 0.012])
    mean = np.where(region[:, None] == SPHERE, dipole, 0.0)
    mean = mean + np.stack([outer[one] for one in (SUN_WIND, SHEATH, SPHERE)])[region]
    field = fluctuating(mean, density, 0.4, cadence, generator)
    phase = 1.1 + 2 * np.pi * seconds / spin
    stamps = (seconds * 1e9).astype(np.int64)
    return Record(stamps, phase, spun(field, phase), region, distance)
