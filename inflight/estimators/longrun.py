"""Uncertainty of sums of scores that are correlated in time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: Correlations below this many times sqrt(log10(n)/n) are chance (Politis and White 2004), and how many of
#: them in a row end the memory.
_CHANCE, _IN_A_ROW = 2.0, 5
#: Lags at most, as a part of the record.
_LONGEST = 0.15
#: The variance of a sum is never taken as smaller than this part of that of uncorrelated scores.
_LEAST = 0.5
#: The correction for what a fit takes out of its own scores is at most this.
_MOST_LOST = 0.5


def autocorrelation(series: Floats, lags: int) -> Floats:
    """Return the correlations of each column at lags 0 to `lags`; (lag, column)."""
    centred = series - series.mean(axis=0)
    size = 1 << (2 * len(series) - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: lags + 1]
    return np.asarray(np.divide(products, products[0], out=np.zeros_like(products), where=products[0] > 0))


def memory_of(series: Floats) -> npt.NDArray[np.int64]:
    """Return after how many steps each column of (block, column) has forgotten itself; (column,)."""
    blocks = len(series)
    most = max(int(_LONGEST * blocks), 1)
    correlation = np.abs(autocorrelation(series, min(most + _IN_A_ROW, blocks - 1)))
    small = correlation < _CHANCE * np.sqrt(np.log10(max(blocks, 10)) / blocks)
    # Beyond the last lag nothing is known, and nothing speaks against a run.
    ahead = np.ones((most + _IN_A_ROW, small.shape[1]), dtype=np.bool_)
    ahead[: len(small) - 1] = small[1 : most + _IN_A_ROW + 1]
    quiet = np.lib.stride_tricks.sliding_window_view(ahead, _IN_A_ROW, axis=0)[:most].all(axis=-1)
    return np.asarray(np.where(quiet.any(axis=0), quiet.argmax(axis=0), most), dtype=np.int64)


def long_run_covariance(scores: Floats, functions: float = 1.0) -> Floats:
    """Return the covariance of a sum of scores, with their correlation in time.

    A flat-topped kernel (Politis and Romano 1995) over twice the memory that the scores themselves show
    (Politis and White 2004): days that remember for a month beneath their own white noise count as that,
    which a first-order memory does not see.

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        In order of time.
    functions : float
        How many functions of time were fitted to each kind of score: a fit hides some of its own noise.

    Returns
    -------
    ndarray, shape (column, column)
        Grows with the number of blocks; zero for fewer than two.
    """
    blocks = len(scores)
    if blocks < 2:
        return np.zeros((scores.shape[1],) * 2)
    centred = scores - scores.mean(axis=0)
    white = centred.T @ centred
    size = np.sqrt(np.diag(white))
    size = np.where(size > 0, size, 1.0)
    unit, plain = centred / size, white / np.outer(size, size)
    total = plain
    width = 2 * int(memory_of(centred).max())
    kernel = np.clip(2.0 * (1.0 - np.arange(1, width + 1) / (width + 1)), 0.0, 1.0)
    if width:
        # What the kernel makes of all earlier blocks, at once: a product a lag would take a second.
        size_of = 1 << (blocks + width).bit_length()
        spectrum = np.fft.rfft(np.append(0.0, kernel), size_of)[:, None] * np.fft.rfft(unit, size_of, axis=0)
        shared = unit.T @ np.fft.irfft(spectrum, size_of, axis=0)[:blocks]
        total = total + shared + shared.T
    lost = min(functions * (1.0 + 2.0 * kernel.sum()) / blocks, _MOST_LOST)
    return np.asarray(_no_smaller(total, plain) * np.outer(size, size) / (1.0 - lost))


def _no_smaller(total: Floats, white: Floats) -> Floats:
    """Return a covariance without directions far below what uncorrelated scores have: these are chance."""
    own, vectors = np.linalg.eigh(white)
    kept = own > 1e-10 * own.max()
    root = vectors[:, kept] * np.sqrt(own[kept])
    inverse = vectors[:, kept] / np.sqrt(own[kept])
    ratio, turn = np.linalg.eigh(inverse.T @ total @ inverse)
    spread = root @ turn
    return np.asarray((spread * np.maximum(ratio, _LEAST)) @ spread.T)


def sigma_of_mean(series: Floats) -> float:
    """Return the standard deviation of the mean of a correlated series (block,); NaN are left out."""
    known = series[np.isfinite(series)]
    if known.size < 2:
        return float("nan")
    return float(np.sqrt(long_run_covariance(known[:, None])[0, 0]) / known.size)
