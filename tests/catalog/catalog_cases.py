"""Small datasets and pieces of work shared by the catalog's tests."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, DayData, write_segment
from inflight.time import SECOND, day_bounds


def samples(
    day: str | np.datetime64, *, step_s: float = 600, seed: int = 0, jitter: bool = False
) -> xr.Dataset:
    """A day of a vector instrument: a packed vector, a float, a flag and a matrix without rows."""
    start, end = day_bounds(np.datetime64(day, "D"))
    times = np.arange(start, end, int(step_s * SECOND), dtype=np.int64)
    rng = np.random.default_rng([seed, abs(int(np.datetime64(day, "D").astype(int)))])
    if jitter:
        times = times + rng.integers(0, int(step_s * SECOND) // 2, times.size)
        times = times[times < end]
    field = np.round(rng.normal(0, 30000, (times.size, 3)), 2)
    field[::17, 1] = np.nan
    return xr.Dataset(
        {
            "tt2000": ("time", times),
            "field": (("time", "axis"), field, {"units": "nT", "resolution": 0.01, "frame": "sensor"}),
            "temperature": ("time", rng.normal(20, 1, times.size), {"units": "degC"}),
            "flag": ("time", rng.integers(0, 5, times.size).astype("uint32"), {"flag_masks": [1, 2, 4]}),
            "rotation": (("axis", "other"), np.eye(3)),
        },
        coords={"axis": ["x", "y", "z"]},
        attrs={"mission": "test"},
    )


def days_from(first: str, count: int) -> list[np.datetime64]:
    return [np.datetime64(first, "D") + offset for offset in range(count)]


def publish(
    catalog: Catalog,
    name: str,
    days: Sequence[np.datetime64],
    *,
    seed: int = 0,
    key: str = "",
    context: str | None = None,
) -> str:
    """Publish days as one segment; return the run's id. The key of each day ends with the day."""
    with catalog.run("test", {}, context) as run:
        data = [
            DayData(day, samples(day, seed=seed), f"{key}-{day}" if key else "", ("file:abc",))
            for day in days
        ]
        run.attach(write_segment(catalog.workspace, run.id, name, data))
        run.publish()
    return run.id


def table(value: float = 1.0) -> xr.Dataset:
    """A calibration table of two intervals and two parameters."""
    return xr.Dataset(
        {
            "value": (("interval", "parameter"), np.full((2, 2), value), {"units": "nT"}),
            "determined": (("interval", "parameter"), np.ones((2, 2), bool)),
            "source": (("interval",), np.array(["fit", "prior"])),
        },
        coords={"parameter": ["offset[x]", "offset[y]"]},
    )


def python(code: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
    """Start a Python of its own that runs `code`."""
    import os

    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
