"""The white noise of the difference where a spacecraft hardly rests: in the quiet scales and frequencies.

Second differences hold the tone of a wheel as well as noise, and each scale holds the tones of an octave.
White noise is the same everywhere: no scale and no band of frequency has less. Digital filters, means of
samples, and readings between two stamps have less near half the sampling frequency, though: the upper half
of the frequencies is left out, lest all the noise below be taken for stray field.
"""

from __future__ import annotations

import numpy as np
from scipy import signal

from inflight.arrays import Floats
from inflight.dual.readings import robust_covariance
from inflight.dual.scales import Cells

#: Cells of a scale that tell the noise.
_FEWEST_CELLS = 12
#: Samples of a spectrum's segment, segments that there are at least and at most, and bands of frequency.
_SEGMENT, _FEWEST, _MOST, _BANDS = 256, 8, 400, 16
#: The noise is the mean of these bands, the quietest first: not of it alone, which is quiet by chance.
_QUIET = slice(1, 5)
#: Frequencies of a segment: its trend is below, what filters take away above.
_USED = slice(3, _SEGMENT // 4 + 1)
#: The shortest scale whose contrasts are of those frequencies.
_SHORTEST = 2


def noise_floor(cells: Cells, difference: Floats, noise: Floats) -> Floats:
    """Return the covariance of white noise of the difference; (axis, axis), nT^2.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d].
    difference : ndarray, shape (time, axis)
        nT, finite.
    noise : ndarray, shape (axis, axis)
        From the shortest times, nT^2, for records that are too short for more. A tone at a high frequency
        raises it, a filter lowers it.
    """
    found = _of_scales(cells)
    spectrum = noise_of_bands(difference)
    if spectrum is not None:
        found.append(spectrum)
    return min(found, key=np.trace, default=noise)


def _of_scales(cells: Cells) -> list[Floats]:
    found = []
    for scale in np.unique(cells.scale[cells.scale >= _SHORTEST]):
        own = cells.covariance[cells.scale == scale, 3:, 3:]
        size = np.einsum("cii->c", own)
        if size.size >= _FEWEST_CELLS:
            # The cells around the median, in all elements at once.
            usual = np.abs(np.argsort(np.argsort(size)) - size.size // 2) <= size.size // 8
            found.append(own[usual].mean(axis=0))
    return found


def noise_of_bands(series: Floats) -> Floats | None:
    """Return the covariance of white noise in the quiet bands of low frequency, (axis, axis), nT^2.

    Tones stand in a few bands, and jumps in a few segments, which robust covariances over segments leave out.

    Parameters
    ----------
    series : ndarray, shape (time, axis)
        Finite. None for fewer than some thousand samples.
    """
    starts = np.arange(0, len(series) - _SEGMENT + 1, _SEGMENT // 2)
    if starts.size < 2 * _FEWEST:
        return None
    if starts.size > _MOST:
        starts = starts[np.linspace(0, starts.size - 1, _MOST).astype(np.int64)]
    window = signal.windows.hann(_SEGMENT, sym=False)
    segments = signal.detrend(series[starts[:, None] + np.arange(_SEGMENT)], axis=1)
    # White noise of variance v: real and imaginary part of each coefficient have the variance v.
    size = np.sqrt(2.0 / np.sum(window**2))
    spectrum = size * np.fft.rfft(segments * window[:, None], axis=1)[:, _USED]
    found = [
        robust_covariance(np.concatenate([band.real, band.imag], axis=1).reshape(-1, series.shape[1]))
        for band in np.array_split(spectrum, _BANDS, axis=1)
    ]
    found.sort(key=lambda one: float(np.sum(np.log(np.maximum(np.diag(one), 1e-300)))))
    return np.asarray(np.mean(found[_QUIET], axis=0))
