"""The spectrum of a residual with gaps, and of the fields along the sensor's axes that it holds.

Takes a residual at equal steps with gaps, and the direction of the field; makes power densities, summed over
stretches of a record (Welch, 1967: modified periodograms, averaged). Everything that shows a spectrum of a
residual takes it from here: `compare`, the signature and the page of `diagnose`, the explorer.

A field along axis k that repeats with a period shows in the residual ``y = u . b`` only through the direction
u_k, which turns along the orbit: the spectrum of the residual has it at sidebands. The spectrum of ``y u_k``
(*demodulated*) has it at its own period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats

#: Names of the four series: the residual, and the residual times the direction's components.
SERIES = ("residual", "x", "y", "z")

_DAY_S = 86_400.0


@dataclass(frozen=True, kw_only=True)
class SpectrumSettings:
    """How spectra are made.

    Attributes
    ----------
    least_part : float
        Least part of a stretch that must be measured. Assumed.
    least_samples : int
        Fewest measured samples of a stretch. Assumed.
    bridge : int
        Samples whose mean fills a gap, centred on it. Assumed: short beside the periods looked for.
    longest_s : float
        Longest stretch of a record, s: the longer, the better lines of the orbit and others are resolved.
        32 days, about a calibration interval; assumed.
    shortest_s : float
        Shortest record of means whose slow spectrum is made, s: three days, so that the harmonics of the
        orbit and the day are apart. Assumed.
    wide, near : int
        Frequencies the local background is the median of, far from the slow end and at it. Assumed.
    points : int
        Frequencies of a spectrum that is drawn: more than a screen has columns.
    """

    least_part: float = 0.5
    least_samples: int = 64
    bridge: int = 31
    longest_s: float = 32 * _DAY_S
    shortest_s: float = 3 * _DAY_S
    wide: int = 301
    near: int = 41
    points: int = 1200


SPECTRUM_SETTINGS = SpectrumSettings()


@dataclass
class SpectrumSum:
    """Sums of the spectra of stretches on one grid of frequencies.

    Attributes
    ----------
    frequency : ndarray, shape (frequency,)
        Hz, without zero.
    total : ndarray, shape (series, frequency)
        Sum of one-sided densities, nT^2/Hz; series as in `SERIES`.
    stretches : int
        How many were added.
    square : ndarray, shape (series,)
        Sum of the mean squares of what the residual was multiplied by: 1 and u_k^2.
    """

    frequency: Floats
    total: Floats
    stretches: int = 0
    square: Floats = field(default_factory=lambda: np.zeros(len(SERIES)))

    def add(self, other: SpectrumSum) -> None:
        """Add the stretches of another one on the same grid."""
        self.total = self.total + other.total
        self.stretches += other.stretches
        self.square = self.square + other.square

    @property
    def step(self) -> float:
        """Distance of the frequencies, Hz: the resolution."""
        return float(self.frequency[0])

    @property
    def density(self) -> Floats:
        """Mean density; (series, frequency), nT^2/Hz."""
        return np.asarray(self.total / max(self.stretches, 1))

    @property
    def direction_square(self) -> Floats:
        """Mean square of what each series was multiplied by; (series,)."""
        return np.asarray(self.square / max(self.stretches, 1))


def hann_power(series: Floats, cadence: float) -> Floats:
    """Return the two-sided power densities of whole series; (..., frequency), from zero to Nyquist.

    A straight line is taken off each, and a Hann window is laid over it.

    Parameters
    ----------
    series : ndarray, shape (..., time)
    cadence : float
        Seconds between samples.
    """
    count = series.shape[-1]
    place, window = _line_and_window(count)
    slope = (series @ place) / max(float(place @ place), 1.0)
    levelled = series - (series.mean(axis=-1)[..., None] + slope[..., None] * place)
    levelled *= window
    transform = np.fft.rfft(levelled, axis=-1)
    scale = cadence / float(window @ window)
    return np.asarray((transform.real**2 + transform.imag**2) * scale, dtype=np.float64)


@lru_cache(maxsize=4)
def _line_and_window(count: int) -> tuple[Floats, Floats]:
    """Return a straight line about the middle, where level and slope are independent, and a Hann window."""
    number = np.arange(count, dtype=np.float64)
    return number - 0.5 * (count - 1), 0.5 - 0.5 * np.cos(2.0 * np.pi * number / count)


def density_with_gaps(
    values: Floats,
    known: npt.NDArray[np.bool_],
    cadence: float,
    settings: SpectrumSettings = SPECTRUM_SETTINGS,
) -> Floats | None:
    """Return the one-sided power densities of series with common gaps; (series, frequency) with zero.

    The series are bridged, a straight line is taken off, and a Hann window is laid over them. Bridged gaps
    hold no noise: the density is that of the measured part, divided by this part.

    Parameters
    ----------
    values : ndarray, shape (series, measured)
        Any unit; the measured samples only.
    known : ndarray of bool, shape (time,)
        Which samples were measured.
    cadence : float
        Seconds between samples.

    Returns
    -------
    ndarray or None
        In the square of the unit for each Hz. None when too little of the stretch is measured
        (`SpectrumSettings.least_part`, `least_samples`).
    """
    whole = np.zeros((len(values), known.size))
    whole[:, known] = values
    return _density_of_whole(whole, known, cadence, settings)


def _density_of_whole(
    whole: Floats, known: npt.NDArray[np.bool_], cadence: float, settings: SpectrumSettings
) -> Floats | None:
    """Return `density_with_gaps` of whole series (series, time) with zeros in the gaps, which are bridged."""
    if known.sum() < max(settings.least_samples, settings.least_part * known.size):
        return None
    _bridge_gaps(whole, known, settings.bridge)
    power = hann_power(whole, cadence)
    # Of a real series both signs of a frequency hold as much; zero and Nyquist have one sign.
    power[:, 1 : (known.size + 1) // 2] *= 2.0
    return np.asarray(power / known.mean(), dtype=np.float64)


def stretch_power(
    residual: Floats, direction: Floats, cadence: float, settings: SpectrumSettings = SPECTRUM_SETTINGS
) -> SpectrumSum | None:
    """Return the spectra of one stretch at equal steps, such as a day.

    Parameters
    ----------
    residual : ndarray, shape (time,) or (time, row)
        nT; gaps (NaN) are bridged by what is around them.
    direction : ndarray, shape (time, 3) or (time, row, 3)
        What a field (x, y, z) makes of each row: of a scalar comparison the unit vector of the field, axes of
        the vector sensor.
    cadence : float
        Seconds between samples.

    Returns
    -------
    Power or None
        Of the residual less its mean (the sum over rows), and of that times each component of the direction
        (summed over rows before the transform); None when less than half of the stretch is measured.
    """
    rows = residual.reshape(len(residual), -1)
    factors = direction.reshape(*rows.shape, 3)
    known = np.ones(len(rows), dtype=np.bool_)
    for column in (*rows.T, *factors.reshape(len(rows), -1).T):
        known &= np.isfinite(column)
    if not known.any():
        return None
    count = rows.shape[1]
    whole, part = np.zeros((count + 3, known.size)), np.zeros(known.size)
    square = np.ones(len(SERIES))
    for index, row in enumerate(rows.T):
        np.subtract(row, row[known].mean(), out=whole[index], where=known)
    for axis in range(3):
        for index in range(count):
            np.multiply(whole[index], factors[:, index, axis], out=part, where=known)
            whole[count + axis] += part
        square[axis + 1] = np.mean(np.sum(factors[known, :, axis] ** 2, axis=1))
    density = _density_of_whole(whole, known, cadence, settings)
    if density is None:
        return None
    total = np.concatenate([density[:count].sum(axis=0)[None], density[count:]])
    return SpectrumSum(np.fft.rfftfreq(known.size, cadence)[1:].astype(np.float64), total[:, 1:], 1, square)


def add_power(sums: dict[tuple[int, float], SpectrumSum], power: SpectrumSum | None) -> None:
    """Add a stretch to the sums of its grid of frequencies; a mission's spectra are never held one by one."""
    if power is None:
        return
    grid = (power.frequency.size, round(float(power.frequency[-1]), 9))
    if grid in sums:
        sums[grid].add(power)
    else:
        sums[grid] = power


def finest_power(sums: Mapping[tuple[int, float], SpectrumSum]) -> SpectrumSum | None:
    """Return the sums on the finest grid; None without any."""
    return max(sums.values(), key=lambda one: (one.frequency.size, one.stretches), default=None)


def _bridge_gaps(whole: Floats, known: npt.NDArray[np.bool_], bridge: int) -> None:
    """Fill the gaps of series (series, time), which hold zeros there, with means of what is around.

    Straight lines between neighbours would repeat their noise, which is then no longer white.
    """
    gaps = np.flatnonzero(~known)
    if not gaps.size:
        return
    sides, windows = (bridge // 2, bridge - 1 - bridge // 2), np.lib.stride_tricks.sliding_window_view
    near = windows(np.pad(known, sides), bridge)[gaps].sum(axis=1)
    # A long gap is bridged from what its ends reach.
    reached, near = gaps[near > 0], near[near > 0]
    for row in whole:
        total = windows(np.pad(row, sides), bridge)[reached].sum(axis=1)
        row[gaps] = np.interp(gaps, reached, total / near)


def on_grid(seconds: Floats, values: Floats, step: float) -> Floats:
    """Return rows (row, column) at increasing times on a grid of `step` seconds; NaN in gaps."""
    slot = np.round((seconds - seconds[0]) / step).astype(np.int64)
    grid = np.full((int(slot[-1]) + 1, values.shape[1]), np.nan)
    grid[slot] = values
    return grid


def record_power(
    seconds: Floats,
    residual: Floats,
    direction: Floats,
    step: float,
    settings: SpectrumSettings = SPECTRUM_SETTINGS,
) -> SpectrumSum | None:
    """Return the spectra of a long record of means, for periods of hours to weeks.

    Parameters
    ----------
    seconds : ndarray, shape (sample,)
        Time of the means, increasing, on a grid of `step` seconds with gaps.
    residual, direction : ndarray, shape (sample,) or (sample, row), (sample, 3) or (sample, row, 3)
        Means, as in `stretch_power`.
    step : float
        Seconds.

    Returns
    -------
    Power or None
        Of stretches of at most `SpectrumSettings.longest_s` that overlap by half. None when the record is
        shorter than `SpectrumSettings.shortest_s`.
    """
    if not seconds.size:
        return None
    columns = [one.reshape(seconds.size, -1) for one in (residual, direction)]
    rows, grid = columns[0].shape[1], on_grid(seconds, np.concatenate(columns, axis=1), step)
    count = len(grid)
    if count * step < settings.shortest_s:
        return None
    length = min(int(settings.longest_s / step), count)
    sums: dict[tuple[int, float], SpectrumSum] = {}
    for start in range(0, count - length + 1, max(length // 2, 1)):
        part = grid[start : start + length]
        add_power(sums, stretch_power(part[:, :rows], part[:, rows:], step, settings))
    return finest_power(sums)


def mean_density(
    grid: Floats, step: float, length: int, settings: SpectrumSettings = SPECTRUM_SETTINGS
) -> tuple[Floats, Floats, int]:
    """Return the mean power of all rows of a record over many short stretches that overlap by half.

    Parameters
    ----------
    grid : ndarray, shape (time, row)
        nT at equal steps, NaN in gaps.
    step : float
        Seconds.
    length : int
        Samples of a stretch.

    Returns
    -------
    frequency : ndarray, shape (frequency,)
        Hz, with zero.
    density : ndarray, shape (frequency,)
        nT^2/Hz, mean over rows and stretches.
    stretches : int
        How many were measured for at least half.
    """
    known = np.asarray(np.isfinite(grid).all(axis=1))
    total, used = np.zeros(length // 2 + 1), 0
    for start in range(0, len(grid) - length + 1, length // 2):
        inside = known[start : start + length]
        part = grid[start : start + length][inside]
        one = density_with_gaps((part - part.mean(axis=0)).T, inside, step, settings) if len(part) else None
        if one is not None:
            total += one.mean(axis=0)
            used += 1
    frequency = np.asarray(np.fft.rfftfreq(length, step), dtype=np.float64)
    return frequency, total / max(used, 1), used


def background_of(density: Floats, settings: SpectrumSettings = SPECTRUM_SETTINGS) -> Floats:
    """Return the running median around each frequency; narrower towards the slow end."""
    filled = np.maximum(density, 1e-300)
    wide = scipy.ndimage.median_filter(filled, settings.wide, mode="reflect")
    near = scipy.ndimage.median_filter(filled, settings.near, mode="reflect")
    weight = np.clip(np.arange(density.size) / settings.wide, 0.0, 1.0)
    return np.asarray(near ** (1 - weight) * wide**weight)


def thin_spectrum(
    frequency: Floats, density: Floats, points: int = SPECTRUM_SETTINGS.points
) -> tuple[Floats, Floats]:
    """Return about so many points of a spectrum: means in steps of equal ratio, single ones at the slow end.

    `density` has shape (..., frequency).
    """
    first, count = _groups(frequency.size, points)
    return (
        np.add.reduceat(frequency, first) / count,
        np.add.reduceat(density, first, axis=-1) / count,
    )


def as_drawn(density: Floats, points: int = SPECTRUM_SETTINGS.points) -> Floats:
    """Return a spectrum (..., frequency) with the means that are drawn in place of all it is drawn of.

    What is only drawn is kept so: it takes hardly any space.
    """
    first, count = _groups(density.shape[-1], points)
    return np.repeat(np.add.reduceat(density, first, axis=-1) / count, count, axis=-1)


def _groups(size: int, points: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return the first of each group of frequencies that makes one point of a drawing, and its size."""
    edges = np.geomspace(1.0, size, points).astype(np.int64) - 1 if size > points else np.arange(size)
    first = np.unique(edges)
    return first, np.diff(np.append(first, size))
