"""The noise floor of a day, kept as sums in its report, and that of several days together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.noise import NoiseFloor, joined_floor, level_of_rows


def floor_of_samples(residual: Floats, good: np.ndarray, stamps: np.ndarray) -> dict[str, float]:
    """Return the white level of a day's residual, all rows together, as sums of squares over its samples."""
    level = level_of_rows(residual, good, stamps)
    if not np.isfinite(level.level_nT):
        return {"floor_samples": 0.0, "floor": 0.0, "floor_low": 0.0, "floor_high": 0.0}
    return {
        "floor_samples": float(level.samples),
        "floor": level.samples * level.level_nT**2,
        "floor_low": level.samples * level.low_nT**2,
        "floor_high": level.samples * level.high_nT**2,
    }


def floor_of_turns(samples: xr.Dataset, good: np.ndarray, sectors: int) -> dict[str, float]:
    """Return what nature leaves in a day's synthetic turns, by the scatter of the turns they are made of."""
    noise = np.asarray(samples["noise"].values)
    used = good & np.isfinite(noise) & (samples["weight"].values > 0)
    total = float(samples["weight"].values[used].sum())
    if not total > 0:
        return {"floor_samples": 0.0, "floor": 0.0, "floor_low": 0.0, "floor_high": 0.0}
    square = float(np.sum((samples["weight"].values * noise**2)[used])) / total
    # Two rows an interval with a sine and a cosine at two harmonics each.
    unsure = 2.0 * np.sqrt(2.0 / (8.0 * max(used.sum() / sectors, 1.0)))
    count = float(used.sum())
    return {
        "floor_samples": count,
        "floor": count * square,
        "floor_low": count * square * max(1.0 - unsure, 0.0),
        "floor_high": count * square * (1.0 + unsure),
    }


def joined_floors(reports: Sequence[Mapping[str, Any]]) -> NoiseFloor:
    """Return the white level of several blocks together."""
    known = [report for report in reports if report.get("floor_samples")]
    return joined_floor(
        [
            NoiseFloor(
                float(np.sqrt(report["floor"] / report["floor_samples"])),
                float(np.sqrt(report["floor_low"] / report["floor_samples"])),
                float(np.sqrt(report["floor_high"] / report["floor_samples"])),
                int(report["floor_samples"]),
            )
            for report in known
        ]
    )
