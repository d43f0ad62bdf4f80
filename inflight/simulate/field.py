"""The ambient field along the orbit: the IGRF, and what ionosphere and crust add."""

from __future__ import annotations

import numpy as np

from inflight.main_field import IGRF, MainField
from inflight.simulate.grid import Float, Grid
from inflight.simulate.randomness import drift
from inflight.time import day_bounds


def main_field(position: Float, seconds: Float, day: np.datetime64) -> Float:
    """Return the IGRF at positions.

    Parameters
    ----------
    position : ndarray, shape (time, 3)
        km, itrf.
    seconds : ndarray, shape (time,)
        TT2000, s, near `day`.
    day : datetime64[D]

    Returns
    -------
    ndarray, shape (time, 3)
        nT, itrf. Schmidt semi-normalised spherical harmonics to degree 13.
    """
    start, end = (bound / 1e9 for bound in day_bounds(day))
    return MainField.of(IGRF).on_day(position, day, (seconds - start) / (end - start))


def dipole_pole(days: float) -> tuple[float, float]:
    """Return colatitude and east longitude, rad, of the dipole's boreal pole; days since 1858-11-17."""
    turned, side, axial = MainField.of(IGRF).dipole_coefficients(np.array([days - 40_587.0]))[0]
    return float(np.arctan2(np.hypot(turned, side), -axial)), float(np.arctan2(-side, -turned))


def external_field(grid: Grid, seed: int, rms: float) -> Float:
    """Return a field both sensors see, nT in itrf on the nodes, with waves of 250 s to 3000 s."""
    return drift(grid.seconds, seed, "external field", (rms, rms, rms), periods=(250.0, 3000.0), waves=16)
