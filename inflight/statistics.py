"""What a residual looks like: its size and its noise floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.noise import NO_FLOOR, NoiseFloor, joined_floor, noise_floor

__all__ = ["NO_FLOOR", "NoiseFloor", "Size", "joined", "joined_floor", "noise_floor", "size_of"]


@dataclass(frozen=True)
class Size:
    """Size of a residual, nT, over its finite samples."""

    count: int
    mean: float
    std: float
    rms: float
    robust: float
    least: float
    largest: float

    def as_json(self) -> dict[str, float | int]:
        """Return the fields by name."""
        return asdict(self)


def size_of(residual: Floats) -> Size:
    """Return the size of a residual (time,) in nT; NaN are left out."""
    finite = residual[np.isfinite(residual)]
    if finite.size == 0:
        nan = float("nan")
        return Size(0, nan, nan, nan, nan, nan, nan)
    middle = np.median(finite)
    return Size(
        int(finite.size),
        float(finite.mean()),
        float(finite.std()),
        float(np.sqrt(np.mean(finite**2))),
        float(TO_SIGMA * np.median(np.abs(finite - middle))),
        float(finite.min()),
        float(finite.max()),
    )


def joined(sizes: Sequence[Size]) -> Size:
    """Return the size of several residuals together; the robust sigma is the median of theirs."""
    filled = [one for one in sizes if one.count]
    if not filled:
        return size_of(np.empty(0))
    count = np.array([one.count for one in filled], dtype=np.float64)
    mean = float(np.sum(count * [one.mean for one in filled]) / count.sum())
    square = float(np.sum(count * [one.rms**2 for one in filled]) / count.sum())
    # From the parts' own spreads: the square less the squared mean cancels where the mean is large.
    spread = float(np.sum(count * [one.std**2 + (one.mean - mean) ** 2 for one in filled]) / count.sum())
    return Size(
        int(count.sum()),
        mean,
        float(np.sqrt(spread)),
        float(np.sqrt(square)),
        float(np.median([one.robust for one in filled])),
        min(one.least for one in filled),
        max(one.largest for one in filled),
    )
