"""A gradiometer's correction of readings, without the noise of the difference.

A matrix takes the difference's noise to the outboard sensor with the stray field. The difference is
therefore cut into bands of time scale, and in each of them, stretch by stretch, as much is kept as stands
above the noise (James and Stein's shrinkage by ``1 - c N / P``): a step keeps its edge, a quiet hour adds no
noise.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from inflight.arrays import Floats
from inflight.dual.correction import UNKNOWN, Correction
from inflight.dual.gradiometer import Gradiometer
from inflight.dual.readings import Readings

#: Power over that of the noise below which nothing is kept of a band.
_ABOVE = 2.0
#: A stretch of a band is so many of its own lengths.
_AROUND = 4
#: The slowest band is of this part of the record; what is slower is kept.
_SLOWEST = 8


def gradiometer_correction(gradiometer: Gradiometer, readings: Readings) -> Correction:
    """Return what a gradiometer takes off the outboard sensor, with its error.

    The median of the correction is zero: what is constant in the difference may be offsets of the sensors.

    Parameters
    ----------
    gradiometer : Gradiometer
    readings : Readings
        Other ones than it was fitted to, or the same.
    """
    good = readings.good
    count = len(readings)
    field = np.full((count, 3), np.nan)
    covariance = np.full((count, 3, 3), np.nan)
    if good.any():
        stray = gradiometer.stray(readings)[good]
        kept, variance = without_noise(stray, gradiometer.noise)
        kept -= np.median(kept, axis=0)
        field[good] = kept @ gradiometer.matrix.T
        covariance[good] = _error(gradiometer, kept, variance, readings.outboard[good])
    return Correction(
        field,
        covariance,
        np.full(count, UNKNOWN, dtype=np.int64),
        np.full(count, np.nan),
        np.zeros(count, dtype=np.uint32),
        "gradiometer",
        reason=f"gradiometer of form '{gradiometer.form}'",
    )


def without_noise(series: Floats, noise: Floats) -> tuple[Floats, Floats]:
    """Return a series less what is no more than white noise in each band, and the rest's error.

    Parameters
    ----------
    series : ndarray, shape (time, axis)
        nT, finite.
    noise : ndarray, shape (axis, axis)
        Covariance of its white noise, nT^2.

    Returns
    -------
    kept : ndarray, shape (time, axis)
    variance : ndarray, shape (time,)
        Of the error of `kept`, in units of `noise`.
    """
    # Rows of white noise of size one.
    whiten = np.linalg.pinv(np.linalg.cholesky(noise + 1e-9 * max(float(np.trace(noise)), 1e-18) * np.eye(3)))
    smooth, width = series, 1
    kept, variance = np.zeros_like(series), np.zeros(len(series))
    while 2 * width + 1 <= max(len(series) // _SLOWEST, 1):
        wider = 2 * width + 1
        slower = ndimage.uniform_filter1d(series, wider, axis=0, mode="nearest")
        band = smooth - slower
        level = 1.0 / width - 1.0 / wider
        power = np.mean((band @ whiten.T) ** 2, axis=1)
        around = ndimage.uniform_filter1d(power, min(_AROUND * wider, len(series)), mode="nearest") / level
        share = np.clip(1.0 - _ABOVE / np.maximum(around, 1e-12), 0.0, 1.0)
        kept += share[:, None] * band
        variance += level * (share + (1.0 - share) ** 2 * np.clip(around - 1.0, 0.0, None))
        smooth, width = slower, wider
    return kept + smooth, variance + 1.0 / width


def _error(gradiometer: Gradiometer, kept: Floats, variance: Floats, outboard: Floats) -> Floats:
    """Return the covariance of a correction's error; (time, axis, axis), nT^2.

    Noise that was kept, the matrix's error on the difference, and the leak's on the ambient field.
    """
    matrix = gradiometer.matrix
    noise = matrix @ gradiometer.noise @ matrix.T
    total = variance[:, None, None] * noise + quadratic(gradiometer.covariance, kept)
    return np.asarray(total + quadratic(gradiometer.leak_effect, outboard - np.median(outboard, axis=0)))


def quadratic(covariance: Floats, vectors: Floats) -> Floats:
    """Return the covariance of a matrix times vectors, from that of its elements.

    Parameters
    ----------
    covariance : ndarray, shape (9, 9)
        Of the elements, row by row.
    vectors : ndarray, shape (time, 3)

    Returns
    -------
    ndarray, shape (time, 3, 3)
    """
    by_element = covariance.reshape(3, 3, 3, 3).transpose(0, 2, 1, 3).reshape(9, 9)
    products = (vectors[:, :, None] * vectors[:, None, :]).reshape(-1, 9)
    return np.asarray(products @ by_element.T).reshape(-1, 3, 3)
