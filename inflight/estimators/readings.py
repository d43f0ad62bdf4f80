"""Readings of a housekeeping channel: their noise, their smallest step, and the spikes among them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.errors import SamplesError
from inflight.time import Int64

#: Changes between neighbours, and sizes, count from this many sigma on: with 86 400 readings a day
#: and Gaussian noise one false alarm in 10^10 days.
SIGNIFICANCE = 8.0
#: The fewest readings of a level.
FEWEST = 3


def noise_of(values: Floats, resolution: float | None = None) -> tuple[float, float]:
    """Return white noise and smallest step of readings, in their unit.

    The noise is that of second differences, which a drift does not reach, by the median of their
    sizes; rounding to a step q leaves at least ``q / sqrt(12)``.

    Parameters
    ----------
    values : ndarray, shape (reading,)
        Finite.
    resolution : float, optional
        The smallest step where it is known. Else it is the smallest change seen, unless that is more
        than a third of the range: two or three levels are those of a switch, not of a converter.
    """
    span = float(np.ptp(values)) if values.size else 0.0
    if resolution is None:
        sizes = np.abs(np.diff(values))
        # Decimal readings differ by rounding errors of their binary form too: those are no steps.
        least = float(
            sizes[sizes > 1e-9 * max(float(np.abs(values).max(initial=0.0)), 1e-30)].min(initial=span)
        )
        resolution = least if least < span / 3.0 else 0.0
    spread = (
        TO_SIGMA * float(np.median(np.abs(np.diff(values, 2)))) / np.sqrt(6.0) if values.size > 2 else 0.0
    )
    # A switch without noise still has the rounding of its binary form.
    return max(spread, resolution / np.sqrt(12.0), 1e-9 * span), resolution


def readings_of(stamps: Int64, current: Floats, resolution: float | None = None) -> tuple[Int64, Floats]:
    """Return times and values of the finite readings that are no spikes.

    Parameters
    ----------
    stamps : ndarray of int64, shape (reading,)
        TT2000, rising.
    current : ndarray, shape (reading,)
    resolution : float, optional
        As for `noise_of`.

    Raises
    ------
    SamplesError
        Shapes that differ, times that do not rise, or too few readings.
    """
    times, values = np.asarray(stamps, dtype=np.int64), np.asarray(current, dtype=np.float64)
    if times.shape != values.shape or times.ndim != 1:
        raise SamplesError(
            f"times have shape {times.shape}, the current {values.shape}", remedy="give one current a call"
        )
    good = np.isfinite(values)
    times, values = times[good], values[good]
    if times.size < 2 * FEWEST + 2:
        raise SamplesError(
            f"{times.size} readings of the current found, at least {2 * FEWEST + 2} needed",
            remedy="take a longer span",
        )
    if np.any(np.diff(times) <= 0):
        raise SamplesError("times of the current do not rise", remedy="sort them and drop duplicates")
    kept = ~_spikes(values, SIGNIFICANCE * np.sqrt(2.0) * noise_of(values, resolution)[0])
    return times[kept], values[kept]


def _spikes(values: Floats, limit: float) -> npt.NDArray[np.bool_]:
    """Return single readings that leave their neighbours' level and come back to it."""
    ahead, behind = np.diff(values)[:-1], np.diff(values)[1:]
    out_and_back = np.minimum(np.abs(ahead), np.abs(behind))
    alone = (out_and_back > limit) & (np.abs(ahead + behind) < 0.5 * out_and_back)
    return np.concatenate([[False], alone, [False]])
