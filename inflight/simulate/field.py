"""The ambient field along the orbit: the IGRF of ppigrf, and what ionosphere and crust add."""

from __future__ import annotations

import datetime as dt

import numpy as np
import ppigrf

from inflight.simulate.grid import Float, Grid
from inflight.simulate.randomness import wander
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
        The model is taken at both ends of this day and blended, as it is linear in time itself.

    Returns
    -------
    ndarray, shape (time, 3)
        nT, itrf.
    """
    x, y, z = position.T
    across = np.hypot(x, y)
    radius = np.hypot(across, z)
    date = dt.datetime.combine(day.astype(dt.date), dt.time())
    up, south, east = ppigrf.igrf_gc(
        radius,
        np.degrees(np.arctan2(across, z)),
        np.degrees(np.arctan2(y, x)),
        [date, date + dt.timedelta(days=1)],
    )
    start, end = (bound / 1e9 for bound in day_bounds(day))
    later = (seconds - start) / (end - start)
    up, south, east = (part[0] + later * (part[1] - part[0]) for part in (up, south, east))
    cos_t, sin_t, cos_p, sin_p = z / radius, across / radius, x / across, y / across
    level = up * sin_t + south * cos_t
    return np.column_stack(
        [level * cos_p - east * sin_p, level * sin_p + east * cos_p, up * cos_t - south * sin_t]
    )


def external_field(grid: Grid, seed: int, rms: float) -> Float:
    """Return a field both sensors see, nT in itrf on the nodes, with waves of 250 s to 3000 s."""
    return wander(grid.seconds, seed, "external field", (rms, rms, rms), periods=(250.0, 3000.0), waves=16)
