"""What figures share: days of a CHAMP-like orbit in the IGRF, each made once in a run."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.calibration import NormalEquations, block_equations, nine_columns
from inflight.frames import direction_of
from inflight.mission_fit import orbit_period, switched_columns
from inflight.simulate import (
    EARTH_RADIUS,
    STEP,
    Grid,
    Parameters,
    geometry,
    main_field,
    node_local_time,
    sunlight,
)
from inflight.time import SECOND, day_bounds

Result = TypeVar("Result")
#: Seconds between the samples of a day.
_STEP = STEP / SECOND
#: Day 0 of the thesis' day numbers (MJD).
MJD_ZERO = np.datetime64("2000-01-01", "D")
#: The two days whose angles the thesis compares, near local noon and midnight (Yin 2010, section 4.3).
NOON, MIDNIGHT = 2852, 2979
#: Days of the mission over which figures scatter: early and late, at all local times.
DAYS = (300, 1000, 1450, 2000, 2676, NOON, MIDNIGHT)


@dataclass(frozen=True)
class OrbitDay:
    """A UTC day on the orbit, every 30 s; axes x along the flight, y = z x x, z down; no attitude errors.

    Attributes
    ----------
    span : tuple of int
        TT2000.
    field, direction : ndarray, shape (time, 3)
        IGRF, nT, and its unit vectors.
    strength, rate : ndarray, shape (time,)
        nT and nT/s along the orbit.
    sunlit : ndarray, shape (time,)
        Visible part of the Sun's disc.
    altitude : float
        km above the mean radius.
    local_time : float
        Of the ascending node, h.
    """

    span: tuple[int, int]
    field: Floats
    direction: Floats
    strength: Floats
    rate: Floats
    sunlit: Floats
    altitude: float
    local_time: float

    @property
    def sunlit_part(self) -> float:
        """Part of the time in the Sun, counted over whole orbits."""
        orbit = orbit_period(self.altitude) / _STEP
        orbits = int(len(self.sunlit) / orbit)
        return float(self.sunlit[: round(orbits * orbit)].mean())


class SimulatedDays:
    """Simulated days that the figures of one run share, and a cache of what is costly."""

    def __init__(self) -> None:
        self._cache: dict[Hashable, Any] = {}

    def cached(self, work: Callable[..., Result], *arguments: Hashable) -> Result:
        """Return ``work(scene, *arguments)``, computed the first time only."""
        key = (work, arguments)
        if key not in self._cache:
            self._cache[key] = work(self, *arguments)
        found: Result = self._cache[key]
        return found

    def day(self, mjd: int) -> OrbitDay:
        """Return the day with this number of the thesis."""
        return self.cached(_orbit_day, mjd)

    def equations(self, mjd: int) -> NormalEquations:
        """Return the day's normal equations: the nine, ``time_shift``, ``bias``, the switched field."""
        return self.cached(_equations, mjd)


def _orbit_day(scene: SimulatedDays, mjd: int) -> OrbitDay:
    parameters = Parameters(attitude_rms=(0.0, 0.0, 0.0))
    day = MJD_ZERO + mjd
    start, end = day_bounds(day)
    grid = Grid.covering(start, end)
    place = geometry(grid, parameters, seed=0)
    field = np.einsum("nij,nj->ni", place.axes, main_field(place.position, grid.seconds, day))
    strength = np.linalg.norm(field, axis=1)
    radius = float(np.linalg.norm(place.position[-1]))
    return OrbitDay(
        (start, end),
        field,
        direction_of(field),
        strength,
        np.asarray(scipy.interpolate.CubicSpline(grid.seconds, strength)(grid.seconds, 1)),
        sunlight(place.zenith, radius),
        radius - EARTH_RADIUS,
        float(node_local_time(grid.seconds[:1], parameters)[0]),
    )


def _equations(scene: SimulatedDays, mjd: int) -> NormalEquations:
    """Normal equations of a day; their residual is 0, cross-talk needs none."""
    day = scene.day(mjd)
    columns = nine_columns(day.field) | {"time_shift": day.rate, "bias": np.ones_like(day.strength)}
    columns |= switched_columns(day.direction, day.sunlit)
    return block_equations(columns, np.zeros_like(day.strength), day.span, robust=False)
