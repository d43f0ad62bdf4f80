"""Uncertainty of sums of scores that are correlated in time."""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats

#: The scores' own memory from one block to the next is taken out up to this correlation.
_MOST_MEMORY = 0.97


def memory_of(series: Floats) -> Floats:
    """Return the correlation of neighbours in each column of (block, column), between 0 and 0.97.

    Fitted series are pushed below zero by their fit: a negative memory is never believed, since it would
    make uncertainties smaller.
    """
    own = np.sum(series**2, axis=0)
    next_to = np.sum(series[1:] * series[:-1], axis=0)
    # Kendall's bias of a short record's correlation.
    short = 1.0 / max(len(series) - 3, 1)
    memory = np.divide(next_to, own, out=np.zeros_like(own), where=own > 0)
    return np.clip(np.where(memory > 0, memory * (1 + 3 * short) + short, 0.0), 0.0, _MOST_MEMORY)


def long_run_covariance(scores: Floats, fitted: int = 0) -> Floats:
    """Return the covariance of a sum of scores, with their correlation in time.

    Prewhitened by each column's own memory, then Bartlett's kernel with a lag from the data (Newey and
    West 1987; Andrews 1991; Andrews and Monahan 1992).

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        In order of time.
    fitted : int
        How many parameters were fitted to them.

    Returns
    -------
    ndarray, shape (column, column)
        Grows with the number of blocks; zero for fewer than two.
    """
    blocks = len(scores)
    if blocks < 2:
        return np.zeros((scores.shape[1],) * 2)
    centred = scores - scores.mean(axis=0)
    memory = memory_of(centred)
    white = centred.copy()
    white[1:] -= memory * centred[:-1]
    white[0] *= np.sqrt(1.0 - memory**2)
    total = white.T @ white
    lag = _bandwidth(white)
    for step in range(1, min(int(lag), blocks - 1) + 1):
        shared = white[step:].T @ white[:-step]
        total += (1.0 - step / (lag + 1.0)) * (shared + shared.T)
    again = 1.0 / (1.0 - memory)
    return np.asarray(again[:, None] * total * again[None, :] * blocks / max(blocks - max(fitted, 1), 1))


def sigma_of_mean(series: Floats) -> float:
    """Return the standard deviation of the mean of a correlated series (block,); NaN are left out."""
    known = series[np.isfinite(series)]
    if known.size < 2:
        return float("nan")
    return float(np.sqrt(long_run_covariance(known[:, None])[0, 0]) / known.size)


def _bandwidth(white: Floats) -> float:
    """Return Andrews' lag for Bartlett's kernel from what correlation is left (his eq. 6.2 and 6.4)."""
    left = np.sum(white[1:] * white[:-1], axis=0)
    own = np.sum(white[:-1] ** 2, axis=0)
    rho = np.clip(np.divide(left, own, out=np.zeros_like(own), where=own > 0), -0.9, 0.9)
    used = own > 0
    if not used.any():
        return 0.0
    rho = rho[used]
    alpha = np.mean(4 * rho**2 / ((1 - rho) ** 6 * (1 + rho) ** 2)) / np.mean(1 / (1 - rho) ** 4)
    return float(min(1.1447 * (alpha * len(white)) ** (1 / 3), len(white) / 4))
