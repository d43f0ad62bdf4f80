"""Lines in the spectrum of a residual, along each axis too: which are known, and which are not.

A field along axis k that repeats with a period shows in the residual only through the direction u_k,
which turns along the orbit: the spectrum of the residual has it at sidebands. The spectrum of
``residual * u_k`` (demodulated) has it at its own period.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, signal, stats

from inflight.arrays import Floats

#: Names of the four series: the residual, and the residual times the direction's components.
SERIES = ("residual", "x", "y", "z")
#: Least part of a stretch that must be measured, and its fewest samples.
_LEAST_PART, _LEAST_SAMPLES = 0.5, 64
#: Frequencies the local background is the median of, and the chance of one false line in a spectrum.
_AROUND, _CHANCE = 101, 0.01
#: A line must also stand this far above its background: real backgrounds are not smooth.
_LEAST_RATIO = 3.0
#: Harmonics of the orbit that are drawn, and those that are recognised.
DRAWN_HARMONICS, _KNOWN_HARMONICS = 6, 12
#: A Hann window spreads a line over this many frequencies on either side.
_SPREAD = 2
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


@dataclass(frozen=True)
class Line:
    """One line: its period, what it is, and its amplitude in each series.

    `amplitude` and `sigma` have shape (series,): nT in the residual, then of a field along x, y and
    z that would make the line (NaN where it is not seen). `label` names a known period; `follows` says
    of which stronger unknown line it is a multiple or a sideband. Both are empty for a line of its own.
    """

    period_s: float
    label: str
    follows: str
    ratio: float
    amplitude: Floats
    sigma: Floats

    @property
    def is_known(self) -> bool:
        """True when the period is one the mission states, or of the orbit or the day."""
        return bool(self.label)

    @property
    def is_new(self) -> bool:
        """True when nothing explains the period: neither what is known nor a stronger line."""
        return not (self.label or self.follows)

    @property
    def axis(self) -> str:
        """Series other than the residual in which the line is largest; empty when it is in none."""
        along = np.where(np.isfinite(self.amplitude[1:]), self.amplitude[1:], 0.0)
        return SERIES[1 + int(np.argmax(along))] if along.any() else ""

    def as_json(self) -> dict[str, object]:
        """Return the fields of the command line's JSON."""
        seen = zip(SERIES, self.amplitude, self.sigma, strict=True)
        return {
            "period_s": self.period_s,
            "label": self.label,
            "follows": self.follows,
            "known": self.is_known,
            "times_background": self.ratio,
            "amplitude_nT": {name: a for name, a, _ in seen if np.isfinite(a)},
            "sigma_nT": {
                name: s
                for name, a, s in zip(SERIES, self.amplitude, self.sigma, strict=True)
                if np.isfinite(a)
            },
            "axis": self.axis,
        }


def stretch_power(residual: Floats, direction: Floats, cadence: float) -> Power | None:
    """Return the spectra of one stretch at equal steps, such as a day.

    Parameters
    ----------
    residual : ndarray, shape (time,)
        nT; gaps (NaN) are bridged by straight lines.
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
    if known.sum() < max(_LEAST_SAMPLES, _LEAST_PART * residual.size):
        return None
    measured = residual[known] - residual[known].mean()
    factors = np.concatenate([np.ones((1, measured.size)), direction[known].T])
    index = np.arange(residual.size)
    series = np.array([np.interp(index, index[known], measured * factor) for factor in factors])
    levelled = signal.detrend(series, axis=1)
    frequency, power = signal.periodogram(levelled, fs=1.0 / cadence, window="hann", detrend=False)
    # Bridged gaps hold no noise: the rest stands for the whole.
    power /= known.mean()
    return Power(frequency[1:], np.asarray(power[:, 1:]), 1, np.mean(factors**2, axis=1))


def known_periods(periods: Mapping[str, float], orbit: float | None) -> dict[str, float]:
    """Return the periods that need no explanation, s: the mission's, harmonics of the orbit, the day.

    Parameters
    ----------
    periods : mapping of str to float
        The mission's own, s.
    orbit : float, optional
        The orbit's as the positions tell it, which counts more than a stated ``orbit``.
    """
    found = {name: seconds for name, seconds in periods.items() if name != "orbit"}
    whole = orbit or periods.get("orbit")
    if whole:
        found["orbit"] = whole
        found |= {f"orbit/{k}": whole / k for k in range(2, _KNOWN_HARMONICS + 1)}
    return found | {"day": _DAY_S, "day/2": _DAY_S / 2, "day/3": _DAY_S / 3}


def drawn_periods(known: Mapping[str, float]) -> dict[str, float]:
    """Return the known periods that a figure marks: of the orbit's harmonics, the first six."""
    late = {f"orbit/{k}" for k in range(DRAWN_HARMONICS + 1, _KNOWN_HARMONICS + 1)} | {"day/2", "day/3"}
    return {name: seconds for name, seconds in known.items() if name not in late}


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
        Longest stretch, s: a third of the record if that is shorter; stretches overlap by half.

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
    length = int(min(most, max(count * step / 3, 3 * _DAY_S)) / step)
    sums: dict[tuple[int, float], Power] = {}
    for start in range(0, count - length + 1, max(length // 2, 1)):
        part = grid[start : start + length]
        add_power(sums, stretch_power(part[:, 0], part[:, 1:], step))
    return finest(sums)


def find_lines(
    power: Power,
    known: Mapping[str, float],
    shortest: float = 0.0,
    longest: float = np.inf,
    most: int = 12,
) -> list[Line]:
    """Return the lines of a mean spectrum: new ones, those that follow from them, known ones.

    Parameters
    ----------
    power : Power
        Sums of stretches.
    known : mapping of str to float
        Periods by name, s.
    shortest, longest : float
        Periods looked at, s.
    most : int
        Lines returned at most of each sort, largest first.

    Returns
    -------
    list of Line
        Lines that stand above the median of the frequencies around them by more than chance allows.
        Sidebands and multiples of a stronger unknown line are labelled as such.
    """
    density = power.density
    step = float(power.frequency[0])
    background = np.array([_background(row) for row in density])
    ratio = density / background
    inside = (power.frequency * longest >= 1.0) & (power.frequency * shortest <= 1.0)
    ratio = np.where(inside, ratio, 0.0)
    peaks = sorted(_peaks(ratio, power.stretches), key=lambda peak: -float(ratio[:, peak].max()))
    orbit = 1.0 / known["orbit"] if "orbit" in known else 0.0
    lines: list[Line] = []
    for peak in peaks:
        frequency = _centre(power.frequency, density[int(np.argmax(ratio[:, peak])), :], peak)
        label = _label(frequency, step, known)
        follows = "" if label else _relation(frequency, step, orbit, lines)
        if any(abs(1.0 / line.period_s - frequency) <= 2 * step for line in lines):
            continue
        amplitude, sigma = _amplitudes(power, density, background, peak)
        lines.append(Line(1.0 / frequency, label, follows, float(ratio[:, peak].max()), amplitude, sigma))
    new = [line for line in lines if line.is_new][:most]
    following = [line for line in lines if line.follows][:most]
    return new + following + [line for line in lines if line.is_known][:most]


def _background(density: Floats) -> Floats:
    """Return the running median around each frequency; narrower towards the slow end."""
    filled = np.maximum(density, 1e-300)
    wide = ndimage.median_filter(filled, _AROUND, mode="nearest")
    near = ndimage.median_filter(filled, 15, mode="nearest")
    weight = np.clip(np.arange(density.size) / _AROUND, 0.0, 1.0)
    return np.asarray(near ** (1 - weight) * wide**weight)


def _peaks(ratio: Floats, stretches: int) -> list[int]:
    """Return local maxima that noise would reach in one spectrum of a hundred."""
    chance = _CHANCE / ratio.shape[1]
    # A median lies below the mean of such a spectrum by its own ratio.
    shape = max(stretches, 1)
    limit = stats.gamma.isf(chance, shape) / stats.gamma.ppf(0.5, shape)
    found: set[int] = set()
    for row in ratio:
        found |= set(signal.find_peaks(row, height=max(limit, _LEAST_RATIO), distance=_SPREAD)[0].tolist())
    return sorted(found)


def _centre(frequency: Floats, density: Floats, peak: int) -> float:
    """Return the frequency of a line between the grid's: the top of a parabola through three logarithms."""
    if not 0 < peak < density.size - 1:
        return float(frequency[peak])
    low, mid, high = np.log(np.maximum(density[peak - 1 : peak + 2], 1e-300))
    bend = low - 2 * mid + high
    shift = 0.5 * (low - high) / bend if bend < 0 else 0.0
    return float(frequency[peak] + np.clip(shift, -0.5, 0.5) * frequency[0])


def _label(frequency: float, step: float, known: Mapping[str, float]) -> str:
    """Return the known period a frequency belongs to; the day splits lines of the orbit by 1/day."""
    best, name = np.inf, ""
    for label, seconds in known.items():
        away = abs(frequency - 1.0 / seconds)
        width = max(1.5 * step, 1.5 / _DAY_S if label.startswith("orbit") else 0.0)
        if away <= width and away < best:
            best, name = away, label
    return name


def _relation(frequency: float, step: float, orbit: float, lines: Sequence[Line]) -> str:
    """Say how a line follows from a stronger unknown one: a multiple of it, or a sideband at the orbit."""
    for line in lines:
        if not line.is_new:
            continue
        base = 1.0 / line.period_s
        for times in range(1, 6):
            for side in range(-2, 3) if orbit else (0,):
                # An error of the base counts as often as it is multiplied.
                if abs(abs(times * base + side * orbit) - frequency) <= (1.0 + 0.5 * times) * step:
                    return _told_relation(line.period_s, times, side)
    return ""


def _told_relation(period: float, times: int, side: int) -> str:
    base = f"{period / 60:.1f} min" if period >= 60 else f"{period:.3g} s"
    whole = base if times == 1 else f"({base})/{times}"
    if side == 0:
        return f"multiple: {whole}"
    return f"sideband: {whole} {'+' if side > 0 else '-'} {abs(side) if abs(side) > 1 else ''}orbit".strip()


def _amplitudes(power: Power, density: Floats, background: Floats, peak: int) -> tuple[Floats, Floats]:
    """Return a line's amplitude in each series and its standard deviation; NaN below three sigma."""
    step = float(power.frequency[0])
    around = slice(max(peak - _SPREAD, 0), peak + _SPREAD + 1)
    width = around.stop - around.start
    excess = (density[:, around] - background[:, around]).sum(axis=1) * step
    noise = background[:, peak] * step * np.sqrt(width / max(power.stretches, 1))
    amplitude = np.sqrt(2.0 * np.maximum(excess, 0.0))
    seen = excess > 3.0 * noise
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = noise / amplitude
        # The direction multiplies a field once in the residual and once more in the demodulation.
        scale = np.append(1.0, 1.0 / power.direction_square[1:])
        return np.where(seen, amplitude * scale, np.nan), np.where(seen, sigma * scale, np.nan)


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
