"""Spectra of a residual along each axis: of days, and of a whole record of means.

A field along axis k that repeats with a period shows in the residual only through the direction u_k,
which turns along the orbit: the spectrum of the residual has it at sidebands. The spectrum of
``residual * u_k`` (demodulated) has it at its own period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy import ndimage, signal

from inflight.arrays import Floats

#: Names of the four series: the residual, and the residual times the direction's components.
SERIES = ("residual", "x", "y", "z")

#: Least part of a stretch that must be measured, and its fewest samples.
_LEAST_PART, LEAST_SAMPLES = 0.5, 64

#: Frequencies the local background is the median of, fewer at the slow end, and samples a gap is bridged by.
_AROUND, _NEAR, _BRIDGE = 301, 41, 31

_DAY_S = 86_400.0


@dataclass
class Power:
    """Sums of the spectra of stretches on one grid of frequencies.

    Attributes
    ----------
    frequency : ndarray, shape (frequency,)
        Hz, without zero.
    total : ndarray, shape (series, frequency)
        Sum of one-sided densities, nT^2/Hz.
    stretches : int
        How many were added.
    square : ndarray, shape (series,)
        Sum of the mean squares of what the residual was multiplied by: 1 and u_k^2.
    """

    frequency: Floats
    total: Floats
    stretches: int = 0
    square: Floats = field(default_factory=lambda: np.zeros(len(SERIES)))

    def add(self, other: Power) -> None:
        """Add the stretches of another one on the same grid."""
        self.total = self.total + other.total
        self.stretches += other.stretches
        self.square = self.square + other.square

    @property
    def density(self) -> Floats:
        """Mean density; (series, frequency), nT^2/Hz."""
        return np.asarray(self.total / max(self.stretches, 1))

    @property
    def direction_square(self) -> Floats:
        """Mean square of what each series was multiplied by; (series,)."""
        return np.asarray(self.square / max(self.stretches, 1))


def stretch_power(residual: Floats, direction: Floats, cadence: float) -> Power | None:
    """Return the spectra of one stretch at equal steps, such as a day.

    Parameters
    ----------
    residual : ndarray, shape (time,)
        nT; gaps (NaN) are bridged by what is around them.
    direction : ndarray, shape (time, 3)
        Unit vector of the field, axes of the vector sensor.
    cadence : float
        Seconds between samples.

    Returns
    -------
    Power or None
        Hann-windowed periodograms of the residual less its mean, and of that times each component
        of the direction; None when less than half of the stretch is measured.
    """
    known = np.isfinite(residual) & np.isfinite(direction).all(axis=1)
    if known.sum() < max(LEAST_SAMPLES, _LEAST_PART * residual.size):
        return None
    measured = residual[known] - residual[known].mean()
    factors = np.concatenate([np.ones((1, measured.size)), direction[known].T])
    series = np.array([_bridged(measured * factor, known) for factor in factors])
    levelled = signal.detrend(series, axis=1)
    frequency, power = signal.periodogram(levelled, fs=1.0 / cadence, window="hann", detrend=False)
    # Bridged gaps hold no noise: the rest stands for the whole.
    power /= known.mean()
    return Power(frequency[1:], np.asarray(power[:, 1:]), 1, np.mean(factors**2, axis=1))


def add_power(sums: dict[tuple[int, float], Power], power: Power | None) -> None:
    """Add a stretch to the sums of its grid of frequencies; a mission's spectra are never held one by one."""
    if power is None:
        return
    grid = (power.frequency.size, round(float(power.frequency[-1]), 9))
    if grid in sums:
        sums[grid].add(power)
    else:
        sums[grid] = power


def finest(sums: Mapping[tuple[int, float], Power]) -> Power | None:
    """Return the sums on the finest grid; None without any."""
    return max(sums.values(), key=lambda one: (one.frequency.size, one.stretches), default=None)


def _bridged(values: Floats, known: npt.NDArray[np.bool_]) -> Floats:
    """Return a whole series (time,) from its known values: means of what is around stand for the rest.

    Straight lines between neighbours would repeat their noise, which is then no longer white.
    """
    whole = np.zeros(known.size)
    whole[known] = values
    if known.all():
        return whole
    share = ndimage.uniform_filter1d(known.astype(np.float64), _BRIDGE, mode="constant")
    around = ndimage.uniform_filter1d(whole, _BRIDGE, mode="constant")
    told = share > 0.5 / _BRIDGE
    index = np.arange(known.size)
    smooth = np.interp(index, index[told], around[told] / share[told])
    return np.where(known, whole, smooth)


def slow_power(
    seconds: Floats, residual: Floats, direction: Floats, step: float, most: float = 32 * _DAY_S
) -> Power | None:
    """Return the spectra of a long record of means, for periods of hours to weeks.

    Parameters
    ----------
    seconds : ndarray, shape (row,)
        Time of the means, increasing, on a grid of `step` seconds with gaps.
    residual, direction : ndarray, shape (row,), (row, 3)
        Means.
    most : float
        Longest stretch, s: the longer, the better are lines of the orbit and others told apart;
        stretches overlap by half.

    Returns
    -------
    Power or None
        None when the record is shorter than three days.
    """
    slot = np.round((seconds - seconds[0]) / step).astype(np.int64) if seconds.size else np.zeros(0, np.int64)
    count = int(slot[-1]) + 1 if slot.size else 0
    if count * step < 3 * _DAY_S:
        return None
    grid = np.full((count, 4), np.nan)
    grid[slot] = np.column_stack([residual, direction])
    length = min(int(most / step), count)
    sums: dict[tuple[int, float], Power] = {}
    for start in range(0, count - length + 1, max(length // 2, 1)):
        part = grid[start : start + length]
        add_power(sums, stretch_power(part[:, 0], part[:, 1:], step))
    return finest(sums)


def background_of(density: Floats) -> Floats:
    """Return the running median around each frequency; narrower towards the slow end."""
    filled = np.maximum(density, 1e-300)
    wide = ndimage.median_filter(filled, _AROUND, mode="reflect")
    near = ndimage.median_filter(filled, _NEAR, mode="reflect")
    weight = np.clip(np.arange(density.size) / _AROUND, 0.0, 1.0)
    return np.asarray(near ** (1 - weight) * wide**weight)


def thinned(frequency: Floats, density: Floats, points: int = 1200) -> tuple[Floats, Floats]:
    """Return about so many points of a spectrum: means in steps of equal ratio, single ones at the slow end.

    `density` has shape (..., frequency).
    """
    if frequency.size <= points:
        return frequency, density
    edges = np.geomspace(1.0, frequency.size, points).astype(np.int64) - 1
    first = np.unique(edges)
    count = np.diff(np.append(first, frequency.size))
    return (
        np.add.reduceat(frequency, first) / count,
        np.add.reduceat(density, first, axis=-1) / count,
    )
