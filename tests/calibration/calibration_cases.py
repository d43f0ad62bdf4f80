"""A day of a polar orbit in a tilted dipole field, written apart from the project's own simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.calibration import BlockFit, ParameterPrior, fit_block

#: Parameters of a sensor that errs by as much as CHAMP's did (Yin 2010, section 3.2), of either sign.
TRUTH = np.array([1.00132, 0.99885, 1.00207, 90.026, 89.941, 90.038, 26.97, -19.84, 21.63])
IDEAL = np.array([1.0] * 3 + [90.0] * 3 + [0.0] * 3)
PRIOR_SIGMA = np.array([0.005] * 3 + [0.5] * 3 + [100.0] * 3)
PRIOR = ParameterPrior(IDEAL, PRIOR_SIGMA)


def polar_orbit(count: int = 4320, cadence_s: float = 20.0, day: int = 0) -> np.ndarray:
    """Field in axes along the flight, across and down; (time, 3) nT.

    A circular orbit of 87.3 degrees at 430 km, a dipole tilted by 10 degrees that turns with the Earth.
    """
    t = day * 86_400.0 + cadence_s * np.arange(count)
    u, incline, spin = 2 * np.pi * t / 5580.0, np.deg2rad(87.3), 2 * np.pi * t / 86_164.0
    up = np.stack([np.cos(u), np.sin(u) * np.cos(incline), np.sin(u) * np.sin(incline)], axis=1)
    along = np.stack([-np.sin(u), np.cos(u) * np.cos(incline), np.cos(u) * np.sin(incline)], axis=1)
    tilt = np.deg2rad(10.0)
    pole = np.stack([np.sin(tilt) * np.cos(spin), np.sin(tilt) * np.sin(spin), np.cos(tilt) + 0 * t], axis=1)
    strength = -30_000.0 * (6371.2 / 6801.2) ** 3
    field = strength * (3 * np.sum(pole * up, axis=1, keepdims=True) * up - pole)
    across = np.cross(-up, along)
    return np.stack([np.sum(field * axis, axis=1) for axis in (along, across, -up)], axis=1)


def matrix_of(value: np.ndarray) -> np.ndarray:
    """K of eq. 2.5 from scale factors and angles, written out."""
    c = np.cos(np.deg2rad(value[3:6]))
    return np.array([[value[0], c[0], c[1]], [0.0, value[1], c[2]], [0.0, 0.0, value[2]]])


def reading_of(field: np.ndarray, value: np.ndarray) -> np.ndarray:
    """What a sensor of these nine parameters reads; (time, 3) nT."""
    return np.linalg.solve(matrix_of(value), field.T).T + value[6:]


def ar1(generator: np.random.Generator, count: int, sigma: float, memory: float) -> np.ndarray:
    """Stationary noise with correlation exp(-k / memory) over k samples."""
    keep = np.exp(-1.0 / memory)
    drive = generator.normal(0.0, sigma * np.sqrt(1 - keep**2), count)
    out = np.empty(count)
    last = generator.normal(0.0, sigma)
    for index in range(count):
        last = keep * last + drive[index]
        out[index] = last
    return out


@dataclass(frozen=True)
class Measured:
    """Readings of a vector sensor and the scalar field beside it; nT."""

    reading: np.ndarray
    scalar: np.ndarray

    def fit(self, prior: ParameterPrior = PRIOR, good: np.ndarray | None = None, **options: int) -> BlockFit:
        use = np.ones(self.scalar.size, dtype=bool) if good is None else good
        return fit_block(self.reading, np.zeros((1, 3)), self.scalar, use, prior, **options)


def measure(field: np.ndarray, value: np.ndarray, noise: np.ndarray | float = 0.0) -> Measured:
    return Measured(reading_of(field, value), np.linalg.norm(field, axis=1) + noise)
