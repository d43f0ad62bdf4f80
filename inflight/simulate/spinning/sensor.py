"""What a sensor on a spinning spacecraft reads: from the field in the turning body to the raw output.

Plaschke et al. (2019), eq. 4 to 9, read backwards: the field in axes along the spin axis is turned into the
sensor package, projected on three sensors that are not quite at right angles, divided by the gains, and the
offsets are added before the temperature's part of the gains.
"""

from __future__ import annotations

import numpy as np

from inflight.simulate.grid import Float
from inflight.simulate.spinning.settings import SpinningParameters


def apparent(payload: Float, phase: Float) -> Float:
    """Return a field in the turning body's axes; (time, 3) (Farrell et al. 1995, eq. 1 and 8)."""
    c, s = np.cos(phase), np.sin(phase)
    x, y, z = payload.T
    return np.column_stack([c * x + s * y, -s * x + c * y, z])


def projection(parameters: SpinningParameters, effects: frozenset[str], turned: Float) -> Float:
    """Return the rows that make readings less offset of a field along the spin axis; (3, 3).

    Parameters
    ----------
    turned : ndarray, shape (2,)
        What is added to the two angles of the spin axis, rad.
    """
    p = parameters
    x, y = (np.asarray(p.spin_axis) if "spin_axis" in effects else np.zeros(2)) + turned
    cx, sx, cy, sy = np.cos(x), np.sin(x), np.cos(y), np.sin(y)
    sigma = np.array([[cx, 0, -sx], [0, 1, 0], [sx, 0, cx]]) @ np.array(
        [[1, 0, 0], [0, cy, -sy], [0, sy, cy]]
    )
    c, s = np.cos(p.rotation), np.sin(p.rotation)
    phi = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    first, second = np.pi / 2 + (np.asarray(p.elevation) if "elevation" in effects else np.zeros(2))
    between = np.pi / 2 + (p.azimuth if "azimuth" in effects else 0.0)
    sensors = np.array(
        [
            [np.sin(first), 0.0, np.cos(first)],
            [np.cos(between) * np.sin(second), np.sin(between) * np.sin(second), np.cos(second)],
            [0.0, 0.0, 1.0],
        ]
    )
    ratio = p.gain_ratio if "gain_ratio" in effects else 1.0
    gains = np.array([ratio * p.spin_plane_gain, p.spin_plane_gain / ratio, p.axial_gain])
    return np.asarray((sensors @ sigma.T @ phi.T) / gains[:, None])


def zero(
    seconds: Float, warm: Float, start: float, parameters: SpinningParameters, effects: frozenset[str]
) -> Float:
    """Return the offsets, nT; (time, 3).

    Parameters
    ----------
    warm : ndarray, shape (time,)
        Temperature of the sensor less the reference, K.
    start : float
        Time the drift counts from, s.
    """
    p = parameters
    out = np.zeros((seconds.size, 3)) + (np.asarray(p.offset) if "offset" in effects else 0.0)
    if "zero_drift" in effects:
        out[:, 2] += p.zero_drift * (seconds - start) / 86_400.0
    if "eclipse_shift" in effects:
        out += warm[:, None] * p.eclipse_shift
    if "flipper" in effects:
        turned = np.searchsorted(p.flips, (seconds - start) / 86_400.0, side="right") % 2 == 1
        # Flipped, sensor 3 lies along x and sensor 1 against z.
        out = np.where(turned[:, None], out[:, [2, 1, 0]] * [1.0, 1.0, -1.0], out) + p.spacecraft_field
    return out


def reading(
    field: Float,
    rows: Float,
    offsets: Float,
    warm: Float,
    parameters: SpinningParameters,
    effects: frozenset[str],
) -> Float:
    """Return the raw output without noise, nT; (time, 3)."""
    less = field @ rows.T
    if "nonlinearity" in effects:
        straight = less
        for _ in range(3):
            less = (
                straight - np.asarray(parameters.quadratic) * less**2 - np.asarray(parameters.cubic) * less**3
            )
    out = less + offsets
    if "thermal_gain" in effects:
        out = out / (1.0 + warm[:, None] * np.asarray(parameters.thermal_gain))
    return np.asarray(out)
