"""Noise of both sensors: white noise of the difference, and what the sensors do slowly by themselves.

`noise_floor` takes cells and the difference; makes the covariance of its white noise, even where the
spacecraft hardly rests. Second differences hold the tone of a wheel as well as noise, and each scale holds
the tones of an octave. White noise is the same everywhere: no scale and no band of frequency has less.
Digital filters, means of samples, and readings interpolated between two stamps remove it near half the
sampling frequency, though: the quiet bands must agree with each other, lest all the noise that a filter
passes be taken for stray field.

`draw_slow_noise` draws flicker noise, a random walk and a line. What sensors do as slowly as units change
cannot be separated from them by the difference alone; so much is allowed for (`held_out`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.dual.readings import Cells, robust_covariance


@dataclass(frozen=True, kw_only=True)
class NoiseFloorSettings:
    """Numbers of the white noise in quiet scales and quiet bands of frequency.

    Attributes
    ----------
    fewest_cells : int
        Cells of a scale that estimate the noise at least. Assumed.
    shortest_scale : int
        The shortest scale at which a filter leaves noise, samples. Derived: the scale of one sample ends at
        half the sampling frequency.
    segment : int
        Samples of a segment of the spectrum. Assumed.
    fewest_segments, most_segments : int
        Segments without overlap at least, and segments used at most. Assumed; the latter for speed.
    bands : int
        Bands of frequency of equal width. Assumed.
    quiet_bands, first_band : int
        The noise is the mean of so many of the quietest bands, from this place on. Assumed: the quietest may
        be quiet by chance (tests/dual/test_noise_floor.py holds the mean of 20 records to 4 %).
    agreement : float
        The variances of these bands differ by no more than this factor. Assumed: in the edge of a filter
        neighbours differ by more.
    trend_frequencies : int
        Lowest frequencies of a segment, left out because they show its trend. Assumed.
    """

    fewest_cells: int = 12
    shortest_scale: int = 2
    segment: int = 256
    fewest_segments: int = 8
    most_segments: int = 400
    bands: int = 16
    quiet_bands: int = 4
    first_band: int = 1
    agreement: float = 2.0
    trend_frequencies: int = 3


@dataclass(frozen=True, kw_only=True)
class SlowNoiseSettings:
    """Numbers of what two sensors do slowly by themselves.

    `python -m tests.dual.hard_table --first-seed 400 --seeds 6` shows what corrections do to sensors that
    drift otherwise (docs/science/two-sensors.md).

    Attributes
    ----------
    drift_at_once, drift_in_hour : float
        How far two sensors drift apart within minutes, by their temperatures, and in an hour, growing with
        the root of time; nT, rms about the mean of the time. Assumed, from offsets of space fluxgates, which
        move by some 0.1 nT in a day and by about 1 nT in a month (here 0.15 and 0.8).
    student_freedom : float
        Sensors are not alike: the drift of a pair has Student's distribution with so many degrees of
        freedom. Assumed: more than three times the usual one in one pair of seventeen.
    flicker : float
        Flicker noise of the difference in a record over the white noise of one sample, standard
        deviations. Assumed.
    draws : int
        Series that are drawn of each. Assumed.
    """

    drift_at_once: float = 0.03
    drift_in_hour: float = 0.03
    student_freedom: float = 3.0
    flicker: float = 0.5
    draws: int = 3


NOISE_FLOOR_SETTINGS = NoiseFloorSettings()
SLOW_NOISE_SETTINGS = SlowNoiseSettings()


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
    if filtered:
        found = _of_scales(cells.select(cells.scale >= NOISE_FLOOR_SETTINGS.shortest_scale))
    else:
        found = [noise, *_of_scales(cells)]
    if spectrum is not None:
        found.append(spectrum)
    return min(found, key=np.trace, default=noise)


def _of_scales(cells: Cells) -> list[Floats]:
    """Return the covariance of the difference in the usual cells of each scale, nT^2."""
    found = []
    for scale in np.unique(cells.scale):
        own = cells.covariance[cells.scale == scale, 3:, 3:]
        size = np.einsum("cii->c", own)
        if size.size >= NOISE_FLOOR_SETTINGS.fewest_cells:
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
        nT, finite.

    Returns
    -------
    ndarray, shape (axis, axis), or None
        nT^2; None for fewer than some thousand samples, and where no bands agree: that is no white noise.
    bool
        The highest frequencies are a filter's: so are the shortest times.
    """
    length = NOISE_FLOOR_SETTINGS.segment
    starts = np.arange(0, len(series) - length + 1, length // 2)
    if starts.size < 2 * NOISE_FLOOR_SETTINGS.fewest_segments:
        return None, False
    most = NOISE_FLOOR_SETTINGS.most_segments
    if starts.size > most:
        starts = starts[np.linspace(0, starts.size - 1, most).astype(np.int64)]
    window = scipy.signal.windows.hann(length, sym=False)
    segments = scipy.signal.detrend(series[starts[:, None] + np.arange(length)], axis=1)
    # White noise of variance v: real and imaginary part of each coefficient have the variance v.
    unit = np.sqrt(2.0 / np.sum(window**2))
    spectrum = (
        unit * np.fft.rfft(segments * window[:, None], axis=1)[:, NOISE_FLOOR_SETTINGS.trend_frequencies : -1]
    )
    bands = [
        robust_covariance(np.concatenate([band.real, band.imag], axis=1).reshape(-1, series.shape[1]))
        for band in np.array_split(spectrum, NOISE_FLOOR_SETTINGS.bands, axis=1)
    ]
    bands.sort(key=_size)
    quiet = NOISE_FLOOR_SETTINGS.quiet_bands
    first: int | None = None
    for place in range(NOISE_FLOOR_SETTINGS.first_band, len(bands) - quiet + 1):
        if _size(bands[place + quiet - 1]) <= NOISE_FLOOR_SETTINGS.agreement * _size(bands[place]):
            first = place
            break
    found = None if first is None else np.asarray(np.mean(bands[first : first + quiet], axis=0))
    return found, first != NOISE_FLOOR_SETTINGS.first_band


def _size(covariance: Floats) -> float:
    """Return the geometric mean of the axes' variances, nT^2."""
    return float(np.exp(np.mean(np.log(np.maximum(np.diag(covariance), 1e-300)))))


def expected_drift(seconds: float, hourly: float = SLOW_NOISE_SETTINGS.drift_in_hour) -> float:
    """Return how far two sensors drift apart in a time, nT, rms about its mean."""
    return float(np.hypot(SLOW_NOISE_SETTINGS.drift_at_once, hourly * np.sqrt(max(seconds, 0.0) / 3600.0)))


@dataclass(frozen=True)
class SlowNoise:
    """Slow noise of sensors in a record: draws of flicker noise and of a walk, and a line; (time, draw) each.

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


def draw_slow_noise(count: int, draws: int = SLOW_NOISE_SETTINGS.draws) -> SlowNoise:
    """Return slow noise of sensors in a record of `count` samples, the same each time."""
    random = np.random.default_rng(5)
    frequency = np.fft.rfftfreq(count)
    spectrum = random.normal(size=(draws, frequency.size)) + 1j * random.normal(size=(draws, frequency.size))
    spectrum[:, 1:] /= np.sqrt(frequency[1:])
    spectrum[:, 0] = 0.0
    flicker = np.fft.irfft(spectrum, count, axis=1).T
    walk = np.cumsum(random.normal(0.0, 1.0 / np.sqrt(count), (count, draws)), axis=0)
    line = np.sqrt(12.0) * (np.arange(count) / count - 0.5)
    return SlowNoise(
        np.asarray(SLOW_NOISE_SETTINGS.flicker * flicker / flicker.std(axis=0)), walk, line[:, None]
    )
