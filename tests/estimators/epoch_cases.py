"""Days of samples with currents that step, made for tests: known coefficients, any noise."""

import numpy as np
import xarray as xr

from inflight.time import SECOND, day_bounds

ORBIT = 5560.0
FIRST = np.datetime64("2007-01-01", "D")


def direction_at(seconds, tilt=0.2):
    """Field's direction of a dipole along a polar orbit, with a small and changing y."""
    angle = 2 * np.pi * seconds / ORBIT
    field = np.column_stack([np.cos(angle), tilt * np.sin(0.13 * angle), 2 * np.sin(angle)])
    return field / np.linalg.norm(field, axis=1, keepdims=True)


def make_day(
    number,
    value,
    *,
    seed=0,
    noise=0.09,
    shared=0.0,
    drops=14,
    other=None,
    cadence=1,
    rest=2.9,
    top=8.0,
    settle=5.0,
):
    """Return (samples, residual) of a day; `value` nT/A, `shared` nT rms of an error common to a day."""
    random = np.random.default_rng([seed, number])
    start, end = day_bounds(FIRST + number)
    stamps = np.arange(start, end, cadence * SECOND)
    seconds = (stamps - start) / SECOND
    clock = seconds + number * 86400.0
    direction = direction_at(clock)
    current = top - 0.8 * np.cos(2 * np.pi * clock / ORBIT)
    at = np.sort(random.uniform(300, 86000, drops))
    # A drop lasts until the current rises again half an orbit later, as in an eclipse.
    level = np.zeros(seconds.size)
    for moment in at:
        level = np.where((seconds >= moment) & (seconds < moment + 1500), 1.0, level)
    share = np.empty_like(level)
    keep = np.exp(-cadence / settle)
    state = level[0]
    for index, wanted in enumerate(level):
        state = wanted + (state - wanted) * keep
        share[index] = state
    current = current + (rest - current) * share
    slow = 0.3 * np.sin(2 * np.pi * clock / ORBIT + 1.0) + 0.1 * np.sin(6 * np.pi * clock / ORBIT)
    residual = direction @ np.asarray(value) * current + slow
    residual = residual + (direction @ random.normal(0, shared, 3)) * current
    residual = residual + noise * random.standard_normal(seconds.size)
    samples = xr.Dataset(
        {
            "tt2000": ("time", stamps),
            "field": (("time", "axis"), 40000.0 * direction),
            "solar_current": ("time", current, {"units": "A"}),
            "local_time": (
                "time",
                np.full(seconds.size, (24.0 - 24.0 * number / 260.5) % 24.0),
                {"units": "h"},
            ),
        }
    )
    if other is not None:
        samples["battery_current"] = ("time", 1e3 * other * current, {"units": "mA"})
    return samples, residual
