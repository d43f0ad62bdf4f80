"""Randomness that depends on seed, day and purpose alone, so any day can be made without its neighbours."""

from __future__ import annotations

import zlib

import numpy as np

from inflight.simulate.grid import Float

#: Times of a block, and of a series that is made in blocks: one of a sensor, always from midnight on.
_BLOCK, _LONG = 512, 4096
#: By how much even steps may differ, s: TT2000 in seconds is known to 0.1 us.
_EVEN_S = 1e-6


def generator(seed: int, stream: str, day: int = 0) -> np.random.Generator:
    """Return the generator of one purpose; `day` counts from 1970, 0 is for the whole mission."""
    return np.random.Generator(np.random.PCG64([seed, day + 1_000_000, zlib.crc32(stream.encode())]))


def drift(
    seconds: Float,
    seed: int,
    stream: str,
    rms: tuple[float, ...],
    *,
    periods: tuple[float, float],
    waves: int = 12,
) -> Float:
    """Return coloured noise that is one smooth function of absolute time.

    A sum of waves of random phase with periods spread evenly in their logarithm and amplitudes
    that grow with the square root of the period.

    Parameters
    ----------
    seconds : ndarray, shape (time,)
        TT2000, s.
    seed, stream : int, str
        The same pair gives the same function.
    rms : tuple of float
        Root mean square of each component, any unit.
    periods : (float, float)
        Shortest and longest period, s.
    waves : int
        Waves a component.

    Returns
    -------
    ndarray, shape (time, len(rms))
    """
    random = generator(seed, stream)
    edges = np.geomspace(*periods, waves + 1)
    series = np.empty((seconds.size, len(rms)))
    for column, size in enumerate(rms):
        period = edges[:-1] * (edges[1:] / edges[:-1]) ** random.random(waves)
        phase = random.uniform(0.0, 2.0 * np.pi, waves)
        amplitude = np.sqrt(period)
        amplitude *= size * np.sqrt(2.0 / np.sum(amplitude**2))
        series[:, column] = _sum_of_waves(seconds, 2.0 * np.pi / period, phase, amplitude)
    return series


def _sum_of_waves(seconds: Float, rate: Float, phase: Float, amplitude: Float) -> Float:
    """Return ``sum(amplitude * cos(rate * seconds + phase))``; (time,).

    At even steps the cosine of a sum of two angles is made of those of either: a few hundred starts of blocks
    and a few hundred steps within a block are enough for a whole day. The rounding, 1e-9, then depends on
    where the series begins; short ones, which are made for any span, are the same to the last digit.

    Parameters
    ----------
    seconds : ndarray, shape (time,)
    rate, phase, amplitude : ndarray, shape (wave,)
        rad/s, rad, any unit.
    """
    starts, inside = seconds[::_BLOCK], seconds[:_BLOCK] - seconds[:1]
    even = (starts[:, None] + inside).ravel()[: seconds.size]
    if seconds.size < _LONG or np.abs(even - seconds).max() > _EVEN_S:
        return np.asarray(np.cos(seconds[:, None] * rate + phase) @ amplitude)
    start, within = starts[:, None] * rate + phase, inside[:, None] * rate
    made = (amplitude * np.cos(start)) @ np.cos(within).T - (amplitude * np.sin(start)) @ np.sin(within).T
    return np.asarray(made.ravel()[: seconds.size])
