"""Spinning triads with known angles in fields that fluctuate as nature's do."""

import numpy as np

from inflight.spin import SensorAngles, respin
from inflight.time import SECOND

TURN = 2 * np.pi
#: Readings a spin, and their cadence: 3 s at 4 Hz, as THEMIS.
READINGS, CADENCE = 12, 0.25


def red(rng, samples, slope=5 / 3, rms=1.0):
    """Noise whose power falls with the frequency to `slope`, of a given rms."""
    frequency = np.fft.rfftfreq(samples)
    frequency[0] = frequency[1]
    parts = rng.standard_normal((2, frequency.size))
    series = np.fft.irfft((parts[0] + 1j * parts[1]) * frequency ** (-slope / 2), samples)
    return rms * series / series.std()


def natural(rng, samples, mean, turning=0.15, compressing=0.05):
    """A field (samples, 3) that turns about its mean (Alfvenic) and changes its strength (compressional)."""
    mean = np.asarray(mean, dtype=float)
    strength = np.linalg.norm(mean)
    turned = mean / strength + turning * np.stack([red(rng, samples) for _ in range(3)], axis=1)
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    return turned * (strength * np.exp(compressing * red(rng, samples)))[:, None]


def stamps_of(samples, start=0):
    return np.int64(start) + (np.arange(samples) * CADENCE * SECOND).astype(np.int64)


def phase_of(samples):
    return (np.arange(samples) + 0.5) * TURN / READINGS


def sensors(sign=1.0, degrees=0.4, zero=(1.5, -2.0, 0.0)):
    """Angles of some tenths of a degree, of one sign or the other."""
    unit = sign * np.deg2rad(degrees)
    return SensorAngles(
        np.array([0.75, -1.0]) * unit,
        np.array([0.0, 1.25]) * unit,
        abs(1.5 * unit),
        float(np.deg2rad(130.0 * sign)),
        sign * np.asarray(zero),
    )


def truth_of(angles):
    """The six parameters of `farrell` for equal gains."""
    ratio = np.cos(angles.elevation[1]) / np.cos(angles.elevation[0])
    return np.array(
        [
            *angles.elevation,
            angles.tilt * np.cos(angles.tilt_azimuth),
            angles.tilt * np.sin(angles.tilt_azimuth),
            angles.azimuth[1] - angles.azimuth[0],
            ratio,
        ]
    )


def record(seed, angles, mean, *, spins=1200, noise=0.01, turning=0.15, compressing=0.05):
    """Times, readings, phase and true payload field of a triad."""
    rng = np.random.default_rng(seed)
    samples = spins * READINGS
    field = natural(rng, samples, mean, turning, compressing)
    phase = phase_of(samples)
    readings = angles.disturb(respin(field, phase)) + noise * rng.standard_normal((samples, 3))
    return stamps_of(samples), readings, phase, field
