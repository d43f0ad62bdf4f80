"""The ambient field along the orbit: the IGRF of ppigrf, and what ionosphere and crust add.

Coefficients and Legendre functions are ppigrf's; only the sums are written here, because its own
evaluation raises to a power and calls pandas for every point and costs five times as much.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from ppigrf.ppigrf import RE, get_legendre, read_shc

from inflight.simulate.grid import Float, Grid, Int64
from inflight.simulate.randomness import drift
from inflight.time import day_bounds


@lru_cache(maxsize=1)
def _coefficients() -> tuple[Float, Float, Float, Int64, Int64]:
    """Epochs (days since 1970), g and h (epoch, term) in nT, degree and order of the terms."""
    g, h = read_shc()
    degree, order = np.array(list(g.columns), dtype=np.int64).T
    epochs = g.index.to_numpy().astype("datetime64[ns]").astype(np.float64) / 86400e9
    return epochs, g.to_numpy(np.float64), h.to_numpy(np.float64), degree, order


def _at(epochs: Float, values: Float, days: Float) -> Float:
    """Interpolate coefficients linearly to days since 1970; (term, day)."""
    return np.array([np.interp(days, epochs, column) for column in values.T])


def main_field(position: Float, seconds: Float, day: np.datetime64) -> Float:
    """Return the IGRF at positions.

    Parameters
    ----------
    position : ndarray, shape (time, 3)
        km, itrf.
    seconds : ndarray, shape (time,)
        TT2000, s, near `day`.
    day : datetime64[D]
        The model is taken at both ends of this day and blended, as it is linear in time itself.

    Returns
    -------
    ndarray, shape (time, 3)
        nT, itrf. Schmidt semi-normalised spherical harmonics to degree 13.
    """
    x, y, z = position.T
    across = np.hypot(x, y)
    radius = np.hypot(across, z)
    sin_t, cos_t, sin_p, cos_p = across / radius, z / radius, y / across, x / across
    start, end = (bound / 1e9 for bound in day_bounds(day))
    later = (seconds - start) / (end - start)
    theta, phi = np.arctan2(across, z), np.arctan2(y, x)
    ends = _synthesis(radius, theta, phi, day.astype(np.float64) + np.array([0.0, 1.0]))
    up, south, east = (part[:, 0] + later * (part[:, 1] - part[:, 0]) for part in ends)
    level = up * sin_t + south * cos_t
    return np.column_stack(
        [level * cos_p - east * sin_p, level * sin_p + east * cos_p, up * cos_t - south * sin_t]
    )


def _synthesis(radius: Float, theta: Float, phi: Float, days: Float) -> tuple[Float, Float, Float]:
    """Up, south and east components, nT, each (time, day); angles in rad, radius in km."""
    epochs, g, h, degree, order = _coefficients()
    g, h = _at(epochs, g, days), _at(epochs, h, days)
    legendre, slope = get_legendre(np.degrees(theta), list(zip(degree, order, strict=True)))
    orders = np.arange(order.max() + 1) * phi[:, None]
    cosine, sine = np.cos(orders)[:, order], np.sin(orders)[:, order]
    powers = (RE / radius[:, None]) ** (np.arange(degree.max() + 1) + 2)
    legendre, slope = legendre * powers[:, degree], slope * powers[:, degree]
    rising, falling = legendre * cosine, legendre * sine
    weight, turns = (degree + 1)[:, None], order[:, None]
    return (
        rising @ (weight * g) + falling @ (weight * h),
        -(slope * cosine) @ g - (slope * sine) @ h,
        (falling @ (turns * g) - rising @ (turns * h)) / np.sin(theta)[:, None],
    )


def dipole_pole(days: float) -> tuple[float, float]:
    """Return colatitude and east longitude, rad, of the dipole's boreal pole; days since 1858-11-17."""
    epochs, g, h, degree, order = _coefficients()
    since = np.array([days - 40_587.0])
    first = degree == 1
    axial, turned = (_at(epochs, g[:, first & (order == at)], since)[0, 0] for at in (0, 1))
    side = _at(epochs, h[:, first & (order == 1)], since)[0, 0]
    return float(np.arctan2(np.hypot(turned, side), -axial)), float(np.arctan2(-side, -turned))


def external_field(grid: Grid, seed: int, rms: float) -> Float:
    """Return a field both sensors see, nT in itrf on the nodes, with waves of 250 s to 3000 s."""
    return drift(grid.seconds, seed, "external field", (rms, rms, rms), periods=(250.0, 3000.0), waves=16)
