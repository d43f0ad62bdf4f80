"""Days of a CHAMP-like orbit with a field that day and night switch, and their normal equations."""

from __future__ import annotations

from functools import cache

import numpy as np

from inflight.calibration import NormalEquations, block_equations, concat_equations, nine_columns
from inflight.mission_fit import switched_columns
from inflight.mission_fit.day_night import series_columns
from inflight.scorecard import OrbitDay, SimulatedDays

SCENE = SimulatedDays()
#: Wide enough to leave the data alone.
PRIOR_SIGMA = np.array([0.01] * 3 + [1.0] * 3 + [100.0] * 3)
NOON, MIDNIGHT = 2852, 2979


def orbit_day(mjd: int) -> OrbitDay:
    return SCENE.day(mjd)


@cache
def sun_phase(mjd: int) -> np.ndarray:
    """Degrees along the orbit from the middle of the sunlit arc; (time,)."""
    day = orbit_day(mjd)
    t = 30.0 * np.arange(day.sunlit.size)
    period = 2 * np.pi * np.sqrt((6371.2 + day.altitude) ** 3 / 398600.4418)
    turn = np.exp(2j * np.pi * t / period)
    # Full sun has no middle, and any phase will do.
    return np.rad2deg(np.angle(turn / np.sum(day.sunlit * turn))) % 360.0


@cache
def switched_day(mjd: int) -> dict[str, np.ndarray]:
    day = orbit_day(mjd)
    return nine_columns(day.field) | switched_columns(day.direction, day.sunlit)


def series_day(mjd: int, order: int = 4, constant: bool = False) -> dict[str, np.ndarray]:
    day = orbit_day(mjd)
    columns = series_columns(day.direction, sun_phase(mjd), order, ("x", "z"), constant)
    return nine_columns(day.field) | columns


def residual_of(mjd: int, field: np.ndarray) -> np.ndarray:
    """dB that a field (3,) at the vector sensor makes by day; nT."""
    day = orbit_day(mjd)
    return (day.direction @ field) * day.sunlit


def noise(generator: np.random.Generator, count: int, sigma: float = 0.1, slow: float = 0.05) -> np.ndarray:
    """White noise and waves of minutes to hours; nT."""
    t = np.arange(count)
    waves = [
        generator.normal(0, slow / 2)
        * np.sin(2 * np.pi * t / generator.uniform(10, 200) + generator.uniform(0, 7))
        for _ in range(8)
    ]
    return generator.normal(0, sigma, count) + np.sum(waves, axis=0)


def mission(days, field, seed=0, columns=switched_day, **options) -> NormalEquations:
    """Equations of days with a day/night field (3,) and noise."""
    generator = np.random.default_rng(seed)
    field = np.asarray(field, dtype=float)
    blocks = []
    for mjd in days:
        y = residual_of(mjd, field)
        blocks.append(
            block_equations(columns(mjd), y + noise(generator, y.size), orbit_day(mjd).span, **options)
        )
    return concat_equations(blocks)
