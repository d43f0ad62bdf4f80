"""Excursions of a housekeeping current: it leaves its usual level for some minutes and comes back."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.residual import STEP_SIGNIFICANCE, CurrentSteps, channel_noise, clean_readings
from inflight.time import SECOND, Int64

#: A reading is away from the level from this many sigma on.
_AWAY = 3.0


def find_excursions(
    stamps: Int64,
    current: Floats,
    *,
    unit: str = "A",
    longest: float = 1200.0,
    significance: float = STEP_SIGNIFICANCE,
    smallest: float = 0.0,
    resolution: float | None = None,
) -> CurrentSteps:
    """Find the times when a current leaves its usual level and comes back, such as a dazzled camera's.

    Parameters
    ----------
    stamps, current, unit, significance, smallest, resolution
        As for `find_steps`.
    longest : float
        Longer departures are a new level, s. The usual level is a running median over three times that.

    Returns
    -------
    CurrentSteps
        `time` is where it was farthest away, `after` that reading and `before` the level then;
        `start` and `end` are the readings around the part that was more than half as far.
    """
    times, values = clean_readings(stamps, current, resolution)
    noise, smallest_step = channel_noise(values, resolution)
    seconds = (times - times[0]) / SECOND
    cadence = float(np.median(np.diff(seconds)))
    size = min(2 * round(1.5 * longest / cadence) + 1, values.size)
    level = median_filter(values, size, mode="nearest")
    away = np.abs(values - level) > _AWAY * noise
    edges = np.flatnonzero(np.diff(np.concatenate([[False], away, [False]]).astype(np.int8)))
    rows = []
    for first, stop in edges.reshape(-1, 2):
        departure = np.abs(values[first:stop] - level[first:stop])
        far = int(first) + int(np.argmax(departure))
        inside = first > 0 and stop < values.size and seconds[stop] - seconds[first - 1] <= longest
        if inside and departure.max() >= max(significance * noise, smallest):
            half = int(first) + np.flatnonzero(departure > 0.5 * departure.max())[[0, -1]] + [-1, 1]
            rows.append((times[far], *times[half], level[far], values[far]))
    when = np.array([row[:3] for row in rows], dtype=np.int64).reshape(-1, 3)
    levels = np.array([(*row[3:], noise) for row in rows], dtype=np.float64).reshape(-1, 3)
    return CurrentSteps.of_rows(when, levels, (noise, smallest_step, cadence), unit)
