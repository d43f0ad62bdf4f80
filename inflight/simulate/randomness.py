"""Randomness that depends on seed, day and purpose alone, so any day can be made without its neighbours."""

from __future__ import annotations

import zlib

import numpy as np

from inflight.simulate.grid import Float


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
        series[:, column] = np.cos(2.0 * np.pi * seconds[:, None] / period + phase) @ amplitude
    return series
