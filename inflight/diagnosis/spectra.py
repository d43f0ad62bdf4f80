"""Periodogram (to become residual/spectrum).

The signature of an effect that is in no library: period, axis, shape; channel and lag as a hint.

The residual is demodulated along each axis, ``p_k = y u_k``, so that a field of one axis shows its own
period and not the sidebands the turning direction makes of it.

What is faster than the search can see: how much of it there is, and between which periods.

A rotating wheel whose speed drifts leaves no sharp line and no slow structure. Its power stands in a band
of the spectrum all the same, and in no form of the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.ndimage import label

from inflight.arrays import Floats
from inflight.diagnosis.residual import LAGS, Structure
from inflight.diagnosis.result import Signature
from inflight.diagnosis.series import Series
from inflight.time import SECOND, Int64

AXES = ("x", "y", "z")

#: A line stands out when its power is this many times the running median of the averaged periodogram,
#: and more for few segments: the largest of many frequencies of one periodogram is large by chance.
_RATIO = 4.0

#: Segments the periodogram is averaged over, wanted; and frequencies of the running median.
_SEGMENTS, _MEDIAN = 12, 41

#: Harmonics of the orbit and the day that are masked, and by how many resolutions either side.
_HARMONICS, _MASK = 30, 2.0

#: Directions of the field that hold less than this part of the strongest one's are not seen.
_SEEN = 3e-3

#: Phases a period is folded into.
PHASES = 24


@dataclass(frozen=True)
class Periodogram:
    """Power of the demodulated residual.

    Attributes
    ----------
    frequency : ndarray, shape (frequency,)
        Hz.
    power : ndarray, shape (axis, frequency)
        nT^2/Hz, averaged over segments.
    ratio : ndarray, shape (axis, frequency)
        Power over its running median.
    known : ndarray of bool, shape (frequency,)
        At or beside a harmonic of a known period.
    threshold : float
        Ratio beyond chance.
    """

    frequency: Floats
    power: Floats
    ratio: Floats
    known: np.ndarray
    threshold: float


def periodogram(
    tt2000: Int64, residual: Floats, direction: Floats, weight: Floats, periods_s: Sequence[float]
) -> Periodogram | None:
    """Return the averaged periodogram of the residual along each axis; None for a record too short.

    Parameters
    ----------
    residual : ndarray, shape (sample, row)
        nT.
    direction : ndarray, shape (sample, row, axis)
    weight : ndarray, shape (sample,)
    periods_s : sequence of float
        Known periods: their harmonics are labelled and masked.
    """
    step = float(np.median(np.diff(tt2000))) / SECOND if tt2000.size > 1 else 0.0
    if tt2000.size < 128 or step <= 0:
        return None
    place = np.rint((tt2000 - tt2000[0]) / (step * SECOND)).astype(np.int64)
    count = int(place[-1]) + 1
    series = np.zeros((count, 3))
    good = weight > 0
    series[place[good]] = np.einsum("tr,tra->ta", residual, direction)[good]
    there = np.zeros(count)
    there[place[good]] = 1.0
    length = int(np.clip(count // _SEGMENTS * 2, 64, 4 * 86_400 / step))
    starts = range(0, count - length + 1, max(length // 2, 1))
    window = signal.windows.hann(length)
    powers, used = np.zeros((3, length // 2 + 1)), 0
    for start in starts:
        inside = there[start : start + length]
        if inside.mean() < 0.7:
            continue
        part = series[start : start + length]
        part = (part - part.sum(axis=0) / inside.sum()) * inside[:, None]
        powers += np.abs(np.fft.rfft(part * window[:, None], axis=0)).T ** 2 * (length / inside.sum())
        used += 1
    if not used:
        return None
    frequency: Floats = np.fft.rfftfreq(length, step).astype(np.float64)
    power = powers / used * 2.0 * step / np.sum(window**2)
    resolution = 1.0 / (length * step)
    ratio = np.stack([one / _running_median(one) for one in power])
    ratio[:, frequency < 3.0 * resolution] = 0.0
    known = _known(frequency, periods_s, resolution)
    # The mean of m independent exponentials, the largest of n: about 1 + sqrt(2 ln n / m) + ln n / m.
    independent = max(used * 0.6, 1.0)
    chance = np.log(max(frequency.size * 3, 2) / 0.01)
    threshold = max(_RATIO, 1.0 + np.sqrt(2.0 * chance / independent) + chance / independent)
    return Periodogram(frequency, power, ratio, known, float(threshold))


def _running_median(power: Floats) -> Floats:
    width = min(_MEDIAN, power.size // 2 * 2 - 1)
    padded = np.pad(power, width // 2, mode="reflect")
    middle = np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=1)
    return np.asarray(np.maximum(middle, 1e-300))


def _known(frequency: Floats, periods_s: Sequence[float], resolution: float) -> np.ndarray:
    known = np.zeros(frequency.size, dtype=bool)
    for period in periods_s:
        for harmonic in range(1, _HARMONICS + 1):
            known |= np.abs(frequency - harmonic / period) < _MASK * resolution
    return known


def strongest_line(found: Periodogram) -> tuple[float, float] | None:
    """Return frequency (Hz) and ratio of the strongest line no known period explains, or None."""
    ratio = np.where(found.known[None, :], 0.0, found.ratio).max(axis=0)
    at = int(np.argmax(ratio))
    if ratio[at] < found.threshold:
        return None
    # Harmonics of a switch can be stronger along one axis: the lowest of comparable lines is the period.
    for lower in range(4, 1, -1):
        near = np.abs(found.frequency - found.frequency[at] / lower) < 1.5 * found.frequency[1]
        near &= ~found.known
        if near.any() and ratio[near].max() >= max(found.threshold, 0.3 * ratio[at]):
            return float(found.frequency[near][np.argmax(ratio[near])]), float(ratio[near].max())
    return float(found.frequency[at]), float(ratio[at])


def describe(
    tt2000: Int64, residual: Floats, direction: Floats, weight: Floats, frequency: float, spread: float
) -> tuple[Signature, float]:
    """Return period, amplitudes along the axes and shape of a line, and the part of the residual it explains.

    Where the field hardly turns, only the field's own direction is seen, and no axis is named.

    Parameters
    ----------
    frequency, spread : float
        Where the line was seen, and the resolution it was seen with; Hz.
    """
    good = weight > 0
    seconds = (tt2000[good] - tt2000[0]) / SECOND
    y, u = residual[good].reshape(-1), direction[good].reshape(-1, 3)
    seconds = np.repeat(seconds, residual.shape[1])
    own, vectors = np.linalg.eigh(u.T @ u)
    seen = vectors[:, own > _SEEN * own[-1]]
    best = _refined(seconds, y, u @ seen, frequency, spread)
    period = 1.0 / best
    curve, sigma = fold(seconds, y, u @ seen, period)
    whole = curve @ seen.T
    errors = np.sqrt(sigma**2 @ (seen.T**2))
    amplitude = np.ptp(curve, axis=0) / 2.0
    clear = amplitude / np.maximum(np.sqrt(np.mean(sigma**2, axis=0)), 1e-12)
    main = int(np.argmax(clear))
    if seen.shape[1] == 3:
        of_axes = np.ptp(whole, axis=0) / 2.0
        place = int(np.argmax(of_axes / np.maximum(np.sqrt(np.mean(errors**2, axis=0)), 1e-12)))
        named, size = AXES[place], float(of_axes[place])
        shape, duty = shape_of(whole[:, place], errors[:, place])
        steps = steps_of(whole, errors, place) if shape in ("square", "pulse") else {}
    else:
        named, size, steps = None, float(amplitude[main]), {}
        shape, duty = shape_of(curve[:, main], sigma[:, main])
    span = seconds[-1] - seconds[0]
    strength = float(clear[main]) * np.sqrt(PHASES / 2.0)
    amplitudes = {
        name: (float(np.ptp(whole[:, at]) / 2.0), float(np.sqrt(np.mean(errors[:, at] ** 2))))
        for at, name in enumerate(AXES)
    }
    told = Signature(
        period_s=period,
        axis=named,
        shape=shape,
        amplitude_nT=size,
        period_sigma_s=float(period**2 / (np.pi * max(span, period)) * np.sqrt(6.0) / max(strength, 1.0)),
        duty=duty,
        amplitudes=amplitudes if named else {},
        steps=steps,
    )
    return told, _explained(seconds, y, u @ seen, best) / max(float(y @ y), 1e-300)


def _explained(seconds: Floats, y: Floats, u: Floats, frequency: float, harmonics: int = 2) -> float:
    angle = 2.0 * np.pi * frequency * seconds
    waves = [f(k * angle) for k in range(1, harmonics + 1) for f in (np.cos, np.sin)]
    columns = np.concatenate([u * wave[:, None] for wave in waves], axis=1)
    gram = columns.T @ columns
    right = columns.T @ y
    return float(right @ np.linalg.lstsq(gram, right, rcond=1e-10)[0])


def _refined(seconds: Floats, y: Floats, u: Floats, frequency: float, spread: float) -> float:
    """Return the frequency that explains most over the whole record, in steps that keep the phase."""
    span = max(seconds[-1] - seconds[0], 1.0 / frequency)
    if seconds.size > 60_000:
        step = seconds.size // 60_000 + 1
        seconds, y, u = seconds[::step], y[::step], u[::step]
    low, high = max(frequency - 1.2 * spread, 0.2 * frequency), frequency + 1.2 * spread
    best = frequency
    for _ in range(2):
        grid = np.linspace(low, high, int(np.clip((high - low) * span * 4.0, 21, 161)))
        values = np.array([_explained(seconds, y, u, float(one)) for one in grid])
        at = int(np.argmax(values))
        best = float(grid[at])
        width = grid[1] - grid[0]
        low, high = best - width, best + width
    return best


def fold(seconds: Floats, y: Floats, u: Floats, period: float) -> tuple[Floats, Floats]:
    """Return the field along each axis by phase, its mean taken off, and its error; (phase, axis), nT."""
    phase = ((seconds % period) / period * PHASES).astype(np.int64) % PHASES
    shape = (PHASES, u.shape[1])
    curve, sigma = np.zeros(shape), np.full(shape, np.inf)
    noise = float(np.var(y))
    for place in range(PHASES):
        inside = phase == place
        gram = u[inside].T @ u[inside]
        if inside.sum() > 6:
            curve[place] = np.linalg.lstsq(gram, u[inside].T @ y[inside], rcond=1e-10)[0]
            sigma[place] = np.sqrt(noise * np.diag(np.linalg.pinv(gram)))
    return curve - np.median(curve, axis=0), sigma


def shape_of(curve: Floats, sigma: Floats) -> tuple[str, float | None]:
    """Return whether a folded curve is a sine, a square wave with its duty, or another shape."""
    waves = np.abs(np.fft.rfft(curve))[1:6]
    noise = (
        float(np.sqrt(np.mean(sigma[np.isfinite(sigma)] ** 2) * curve.size))
        if np.isfinite(sigma).any()
        else 0.0
    )
    if waves[1:].max() < max(0.15 * waves[0], 2.5 * noise):
        return "sine", None
    low, high = np.quantile(curve, [0.1, 0.9])
    middle = 0.5 * (low + high)
    on = curve > middle
    levels = np.where(on, curve[on].mean() if on.any() else 0.0, curve[~on].mean() if (~on).any() else 0.0)
    left = float(np.mean((curve - levels) ** 2))
    whole = float(np.var(curve))
    # By levels, not by phases: a phase in which it switches belongs to both.
    height = np.median(curve[on]) - np.median(curve[~on]) if on.any() and not on.all() else 0.0
    duty = float(np.clip(np.mean(curve - np.median(curve[~on])) / height, 0.0, 1.0)) if height > 0 else 0.0
    if left < 0.15 * whole + noise**2 / curve.size:
        return ("square" if 0.25 <= duty <= 0.75 else "pulse"), duty
    return "other", duty


def steps_of(curve: Floats, sigma: Floats, main: int) -> dict[str, tuple[float, float]]:
    """Return what a switch adds along each axis while it is on, and its sigma; nT.

    Parameters
    ----------
    curve, sigma : ndarray, shape (phase, axis)
    main : int
        The axis that tells when it is on: where the curve is above its middle.
    """
    low, high = np.quantile(curve[:, main], [0.1, 0.9])
    on = curve[:, main] > 0.5 * (low + high)
    if on.all() or not on.any():
        return {}
    # A phase in which it switches belongs to neither level: medians leave it out.
    height = np.median(curve[on], axis=0) - np.median(curve[~on], axis=0)
    error = np.sqrt(np.mean(sigma**2, axis=0) * (0.5 * np.pi) * (1.0 / on.sum() + 1.0 / (~on).sum()))
    return {name: (float(height[at]), float(error[at])) for at, name in enumerate(AXES)}


#: Rows of a segment; segments needed; and frequencies the spectrum is smoothed over.
_LENGTH, _FEWEST, _SMOOTH = 256, 12, 5

#: A band stands this many times above the usual power, and holds this part of what is missing.
_STANDS, _HOLDS = 3.0, 0.5

#: Missing power counts when its size is this many times the structure's, and this part of the floor.
_MORE, _PART = 2.0, 0.5


@dataclass(frozen=True)
class Fast:
    """What is missing and has no slow structure.

    Attributes
    ----------
    rms_nT : float
        Root of the residual's square less that of noise and structure.
    faster_than_s : float
        Structure is looked for in means over so long.
    periods_s : tuple of float or None
        The range that holds most of it, when one stands out.
    """

    rms_nT: float  # noqa: N815 (a unit)
    faster_than_s: float
    periods_s: tuple[float, float] | None = None


def fast_part(
    series: Series, left: Floats, residual_nT: float, floor_nT: float, structure: Structure
) -> Fast | None:
    """Return what is left beside noise and slow structure; None when that is little.

    Parameters
    ----------
    left : ndarray, shape (sample, row)
        What is left of the series, nT.
    residual_nT, floor_nT : float
        Sizes of the residual and of its white level at the cadence of the comparison.
    """
    if series.turn_rows > 1:
        # A synthetic turn has no time between its rows.
        return None
    square = residual_nT**2 - floor_nT**2 - structure.rms_nT**2
    if not square > max(_MORE * structure.rms_nT, _PART * floor_nT) ** 2:
        return None
    missing = float(np.sqrt(square))
    return Fast(missing, LAGS * series.step_s, _band(series, left, missing))


def _band(series: Series, left: Floats, missing: float) -> tuple[float, float] | None:
    """Return the shortest and longest period of the one band that holds most of what is missing, s."""
    found = _spectrum(series, left)
    if found is None:
        return None
    frequency, power = found
    usual = float(np.median(power))
    bands, count = label(power > _STANDS * usual)
    excess = (power - usual) * frequency[1]
    held = np.array([excess[bands == one].sum() for one in range(1, count + 1)])
    # The slow end is structure, and has its own words.
    if not count or held.max() < _HOLDS * missing**2:
        return None
    inside = np.flatnonzero(bands == int(np.argmax(held)) + 1)
    if inside[0] < 3 * _SMOOTH // 2 or frequency[inside[-1]] > 4.0 * frequency[inside[0]]:
        return None
    low, high = np.interp([0.05, 0.95], np.cumsum(excess[inside]) / excess[inside].sum(), frequency[inside])
    return 1.0 / float(high), 1.0 / float(low)


def _spectrum(series: Series, left: Floats) -> tuple[Floats, Floats] | None:
    """Return frequencies and the power of all rows, mean of many short windows, nT^2/Hz; None if too few."""
    step = series.step_s
    place = np.rint((series.tt2000 - series.tt2000[0]) / (step * SECOND)).astype(np.int64)
    good = series["weight"] > 0
    values = np.zeros((int(place[-1]) + 1, left.shape[1]))
    there = np.zeros(len(values))
    values[place[good]], there[place[good]] = left[good], 1.0
    window = np.hanning(_LENGTH + 1)[:-1]
    total, used = np.zeros(_LENGTH // 2 + 1), 0
    for start in range(0, len(values) - _LENGTH + 1, _LENGTH // 2):
        inside = there[start : start + _LENGTH]
        if inside.mean() < 0.7:
            continue
        part = values[start : start + _LENGTH]
        part = (part - part.sum(axis=0) / inside.sum()) * inside[:, None] * window[:, None]
        total += np.mean(np.abs(np.fft.rfft(part, axis=0)) ** 2, axis=1) / np.mean(inside)
        used += 1
    if used < _FEWEST:
        return None
    power = total / used * 2.0 * step / np.sum(window**2)
    smooth = np.convolve(np.pad(power, _SMOOTH // 2, mode="edge"), np.ones(_SMOOTH) / _SMOOTH, mode="valid")
    return np.asarray(np.fft.rfftfreq(_LENGTH, step), dtype=np.float64), smooth
