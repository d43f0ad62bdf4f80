"""An Earth-like main field of the simulator's own: real low degrees, invented higher ones."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

REFERENCE_RADIUS = 6371.2
#: Schmidt semi-normalised (g, h) in nT by (degree, order): IGRF of 2020, rounded (Alken et al. 2021).
LOW_DEGREES = {
    (1, 0): (-29405, 0),
    (1, 1): (-1451, 4653),
    (2, 0): (-2500, 0),
    (2, 1): (2982, -2992),
    (2, 2): (1677, -735),
    (3, 0): (1363, 0),
    (3, 1): (-2381, -82),
    (3, 2): (1236, 242),
    (3, 3): (526, -543),
}
#: Spread of an invented coefficient of degrees 4 to 6, nT.
HIGH_DEGREES = {4: 250.0, 5: 120.0, 6: 50.0}
#: Spacing of the nodes the series is summed at, s; between them the spline *is* the field.
NODE_STEP = 60.0


def draw_field(rng: np.random.Generator, uniform: bool = False) -> dict[tuple[int, int], tuple[float, float]]:
    """Return the coefficients of one Earth; with `uniform` an upright dipole and nothing else."""
    if uniform:
        return {(1, 0): (-29_405.0, 0.0), (1, 1): (-150.0, 200.0)}
    found = {key: (float(g), float(h)) for key, (g, h) in LOW_DEGREES.items()}
    for degree, spread in HIGH_DEGREES.items():
        for order in range(degree + 1):
            g, h = rng.normal(0.0, spread, 2)
            found[(degree, order)] = (g, h if order else 0.0)
    return found


def main_field(
    coefficients: dict[tuple[int, int], tuple[float, float]], seconds: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return the field along a track; position (time, 3) km itrf, result (time, 3) nT itrf."""
    stride = max(1, round(NODE_STEP / (seconds[1] - seconds[0])))
    nodes = np.unique(np.append(np.arange(0, seconds.size, stride), seconds.size - 1))
    values = _sum(coefficients, position[nodes])
    return np.asarray(CubicSpline(seconds[nodes], values)(seconds))


def _sum(coefficients: dict[tuple[int, int], tuple[float, float]], position: np.ndarray) -> np.ndarray:
    x, y, z = position.T
    across = np.hypot(x, y)
    radius = np.hypot(across, z)
    c, s, phi = z / radius, across / radius, np.arctan2(y, x)
    legendre, slope = _legendre(c, s, max(n for n, _ in coefficients))
    up, south, east = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for (n, m), (g, h) in coefficients.items():
        power = (REFERENCE_RADIUS / radius) ** (n + 2)
        wave = g * np.cos(m * phi) + h * np.sin(m * phi)
        up += (n + 1) * power * wave * legendre[n, m]
        south -= power * wave * slope[n, m]
        east += m * power * (g * np.sin(m * phi) - h * np.cos(m * phi)) * legendre[n, m] / s
    level = up * s + south * c
    cp, sp = x / across, y / across
    return np.stack([level * cp - east * sp, level * sp + east * cp, up * c - south * s], axis=1)


def _legendre(c: np.ndarray, s: np.ndarray, degree: int) -> tuple[dict, dict]:
    """Return Schmidt functions and their slopes by (n, m), by the usual recursion in n."""
    p, d = {(0, 0): np.ones_like(c)}, {(0, 0): np.zeros_like(c)}
    for n in range(1, degree + 1):
        k = np.sqrt((2 * n - 1) / (2 * n)) if n > 1 else 1.0
        p[n, n] = k * s * p[n - 1, n - 1]
        d[n, n] = k * (s * d[n - 1, n - 1] + c * p[n - 1, n - 1])
        for m in range(n):
            below = np.sqrt((n - 1) ** 2 - m**2)
            older, older_slope = p.get((n - 2, m), 0.0), d.get((n - 2, m), 0.0)
            root = np.sqrt(n**2 - m**2)
            p[n, m] = ((2 * n - 1) * c * p[n - 1, m] - below * older) / root
            d[n, m] = ((2 * n - 1) * (c * d[n - 1, m] - s * p[n - 1, m]) - below * older_slope) / root
    return p, d
