"""White noise, sensor drift.

The white noise of the difference where a spacecraft hardly rests: in the quiet scales and frequencies.

Second differences hold the tone of a wheel as well as noise, and each scale holds the tones of an octave.
White noise is the same everywhere: no scale and no band of frequency has less. Digital filters, means of
samples, and readings between two stamps take it away near half the sampling frequency, though: the quiet
bands must agree with each other, lest all the noise that a filter passes be taken for stray field.

What two sensors at rest do by themselves, slowly: flicker noise and drifting offsets.

White noise is seen where a spacecraft rests; what changes as slowly as units do cannot be told from them by
the difference alone. So much is therefore allowed for, and no correction is made of less.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from inflight.arrays import Floats
from inflight.dual.readings import Cells, robust_covariance

#: Cells of a scale that tell the noise.
_FEWEST_CELLS = 12

#: Samples of a spectrum's segment, segments that there are at least and at most, and bands of frequency.
_SEGMENT, _FEWEST, _MOST, _BANDS = 256, 8, 400, 16

#: The noise is the mean of so many bands, from this one on: the quietest of all may be quiet by chance.
_QUIET, _FIRST = 4, 1

#: Their variances differ by no more than this factor: in the edge of a filter neighbours differ by more.
_ALIKE = 2.0

#: Frequencies below which a segment shows its trend.
_TREND = 3

#: The shortest scale that a filter leaves its noise.
_SHORTEST = 2

#: nT^2
_LEAST = 1e-300


def noise_floor(cells: Cells, difference: Floats, noise: Floats) -> Floats:
    """Return the covariance of white noise of the difference; (axis, axis), nT^2.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d].
    difference : ndarray, shape (time, axis)
        nT, finite.
    noise : ndarray, shape (axis, axis)
        From the shortest times, nT^2. A tone at a high frequency raises it, a filter lowers it.
    """
    spectrum, filtered = noise_of_bands(difference)
    found = _of_scales(cells.part(cells.scale >= _SHORTEST)) if filtered else [noise, *_of_scales(cells)]
    if spectrum is not None:
        found.append(spectrum)
    return min(found, key=np.trace, default=noise)


def _of_scales(cells: Cells) -> list[Floats]:
    found = []
    for scale in np.unique(cells.scale):
        own = cells.covariance[cells.scale == scale, 3:, 3:]
        size = np.einsum("cii->c", own)
        if size.size >= _FEWEST_CELLS:
            # The cells around the median, in all elements at once.
            usual = np.abs(np.argsort(np.argsort(size)) - size.size // 2) <= size.size // 8
            found.append(own[usual].mean(axis=0))
    return found


def noise_of_bands(series: Floats) -> tuple[Floats | None, bool]:
    """Return the covariance of white noise in quiet bands of frequency, and whether a filter emptied others.

    Tones stand in a few bands, and jumps in a few segments, which robust covariances over segments leave out.

    Parameters
    ----------
    series : ndarray, shape (time, axis)
        Finite.

    Returns
    -------
    ndarray, shape (axis, axis), or None
        nT^2; None for fewer than some thousand samples, and where no bands agree: that is no white noise.
    bool
        The highest frequencies are a filter's: so are the shortest times.
    """
    bands = _bands(series)
    first = _agreeing(bands)
    found = None if first is None else np.asarray(np.mean(bands[first : first + _QUIET], axis=0))
    return found, bool(bands) and first != _FIRST


def _agreeing(bands: list[Floats]) -> int | None:
    """Return the place of the first of the quietest bands that agree with each other; None for none."""
    for first in range(_FIRST, len(bands) - _QUIET + 1):
        if _size(bands[first + _QUIET - 1]) <= _ALIKE * _size(bands[first]):
            return first
    return None


def _size(covariance: Floats) -> float:
    """Return the geometric mean of the axes' variances, nT^2."""
    return float(np.exp(np.mean(np.log(np.maximum(np.diag(covariance), _LEAST)))))


def _bands(series: Floats) -> list[Floats]:
    """Return the covariance of white noise as each band of frequency has it, the quietest first; or nothing.

    Parameters
    ----------
    series : ndarray, shape (time, axis)
        nT, finite. Too short for bands where it has fewer than some thousand samples.
    """
    starts = np.arange(0, len(series) - _SEGMENT + 1, _SEGMENT // 2)
    if starts.size < 2 * _FEWEST:
        return []
    if starts.size > _MOST:
        starts = starts[np.linspace(0, starts.size - 1, _MOST).astype(np.int64)]
    window = signal.windows.hann(_SEGMENT, sym=False)
    segments = signal.detrend(series[starts[:, None] + np.arange(_SEGMENT)], axis=1)
    # White noise of variance v: real and imaginary part of each coefficient have the variance v.
    unit = np.sqrt(2.0 / np.sum(window**2))
    spectrum = unit * np.fft.rfft(segments * window[:, None], axis=1)[:, _TREND:-1]
    found = [
        robust_covariance(np.concatenate([band.real, band.imag], axis=1).reshape(-1, series.shape[1]))
        for band in np.array_split(spectrum, _BANDS, axis=1)
    ]
    return sorted(found, key=_size)


#: How far two sensors drift apart within minutes, by their temperatures, and in an hour, which grows with the
#: root of time; nT, rms about the mean of the time. Offsets of space fluxgates move by some 0.1 nT in a day,
#: and by about 1 nT in a month.
AT_ONCE, DRIFT = 0.03, 0.03

#: Sensors are not alike: how much a pair wanders has Student's distribution with so many degrees of freedom.
TAIL = 3.0

#: Flicker noise of the difference in a record beside the white noise of one sample, one standard deviation.
FLICKER = 0.5

#: Series that are drawn of each.
DRAWS = 3


def expected_drift(seconds: float, hourly: float = DRIFT) -> float:
    """Return how far two sensors drift apart in a time, nT, rms about its mean."""
    return float(np.hypot(AT_ONCE, hourly * np.sqrt(max(seconds, 0.0) / 3600.0)))


@dataclass(frozen=True)
class SlowNoise:
    """How sensors wander in a record: draws of flicker noise and of a walk, and a line; each (time, draw).

    Attributes
    ----------
    flicker : ndarray
        Beside white noise of size one.
    walk : ndarray
        A random walk whose ends are as far apart as the rms of the line.
    line : ndarray, shape (time, 1)
        A straight line of rms one. A pair that drifts steadily does not walk, and the other way round.
    """

    flicker: Floats
    walk: Floats
    line: Floats


def draw_slow_noise(count: int, draws: int = DRAWS) -> SlowNoise:
    """Return how sensors wander in a record of `count` samples."""
    random = np.random.default_rng(5)
    frequency = np.fft.rfftfreq(count)
    spectrum = random.normal(size=(draws, frequency.size)) + 1j * random.normal(size=(draws, frequency.size))
    spectrum[:, 1:] /= np.sqrt(frequency[1:])
    spectrum[:, 0] = 0.0
    flicker = np.fft.irfft(spectrum, count, axis=1).T
    walk = np.cumsum(random.normal(0.0, 1.0 / np.sqrt(count), (count, draws)), axis=0)
    line = np.sqrt(12.0) * (np.arange(count) / count - 0.5)
    return SlowNoise(np.asarray(FLICKER * flicker / flicker.std(axis=0)), walk, line[:, None])
