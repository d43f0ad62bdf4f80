"""Uncertainty of estimates from blocks that are correlated in time.

One of each:

- `bartlett_covariance`: heteroskedasticity- and autocorrelation-consistent (HAC) covariance of a sum
  of scores with Bartlett's kernel and a stated number of lags (Newey and West 1987).
- `long_run_covariance`: the same with a flat-topped kernel whose width follows from the scores themselves
  (Politis and Romano 1995; Politis and White 2004).
- `sandwich`: covariance of estimates from that of the scores, clustered by block.
- `jackknife` and `jackknife_covariance`: from the values without one block each (Efron and Stein 1981).
- `with_variance_floor` and `larger_scatter`: never surer than what is known otherwise.
- `hac_t`, `expected_gain_t`, `expected_gain_p`: whether a gain that is spread over blocks is more
  than chance.

Blocks differ in what they determine: a storm's hours a clock's offset, an eclipse season the arrays. A
gain that lies in few blocks looks like scatter to a plain mean over its error. A true effect predicts
where its gain must lie, so `expected_gain_t` holds each block's gain against what the others' make of
the gain expected of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.lsq.solver import eigen_of_symmetric, posterior_covariance


@dataclass(frozen=True, kw_only=True)
class LongRunSettings:
    """How the width of the flat-topped kernel is chosen, and how small a covariance may become.

    Attributes
    ----------
    chance : float
        Correlations below this many times ``sqrt(log10(n) / n)`` are chance: Politis and White (2004),
        section 3.2.
    in_a_row : int
        So many small correlations in a row end the correlation time: ibid.
    longest : float
        Lags at most, as a part of the record; assumed.
    least : float
        The variance of a sum is never smaller than this part of that of uncorrelated scores; assumed.
    most_lost : float
        The correction for the part of its own scores that a fit removes is at most this; assumed.
    """

    chance: float = 2.0
    in_a_row: int = 5
    longest: float = 0.15
    least: float = 0.5
    most_lost: float = 0.5


LONG_RUN_SETTINGS = LongRunSettings()


def bartlett_weights(lags: int) -> Floats:
    """Return Bartlett's weights ``1 - l / (lags + 1)`` of the lags 1 to `lags`; (lag,)."""
    return np.asarray(1.0 - np.arange(1, lags + 1) / (lags + 1.0))


def bartlett_kernel(blocks: int, lags: int) -> Floats:
    """Return Bartlett's weights of every pair of blocks; (block, block)."""
    apart = np.abs(np.subtract.outer(np.arange(blocks), np.arange(blocks)))
    return np.asarray(np.maximum(0.0, 1.0 - apart / (lags + 1.0)))


def newey_west_lags(blocks: int) -> int:
    """Return the lags ``4 (n / 100)^(2/9)`` that Newey and West (1994) take for n blocks, at least 1."""
    return max(1, int(4.0 * (blocks / 100.0) ** (2.0 / 9.0)))


def bartlett_covariance(scores: Floats, lags: int) -> Floats:
    """Return the covariance of a sum of scores with Bartlett's kernel; (column, column).

    Variances are never smaller than those of uncorrelated scores: by chance few blocks look
    anticorrelated, and that is no knowledge.

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        In order of time; of mean zero, as they are at a fit.
    lags : int
        Neighbours that may be correlated.
    """
    white = np.asarray(scores.T @ scores)
    total = white.copy()
    for lag, weight in enumerate(bartlett_weights(lags)[: len(scores) - 1], start=1):
        cross = scores[lag:].T @ scores[:-lag]
        total += weight * (cross + cross.T)
    return with_variance_floor(total, white)


def bartlett_variance(series: Floats, lags: int) -> Floats:
    """Return the variances that `bartlett_covariance` has for each series alone; (series,).

    Parameters
    ----------
    series : ndarray, shape (block, series)
    lags : int
    """
    white = np.sum(series**2, axis=0)
    total = white.copy()
    for lag, weight in enumerate(bartlett_weights(lags)[: len(series) - 1], start=1):
        total += 2.0 * weight * np.sum(series[lag:] * series[:-lag], axis=0)
    return np.asarray(np.maximum(total, white))


def with_variance_floor(covariance: Floats, least: Floats) -> Floats:
    """Return a covariance with variances no smaller than those of another one, and its own correlations.

    Parameters
    ----------
    covariance, least : ndarray, shape (column, column)
    """
    own = np.diag(covariance)
    raised = np.maximum(own, np.diag(least))
    with np.errstate(invalid="ignore", divide="ignore"):
        lift = np.sqrt(np.where(own > 0, raised / own, 1.0))
    out = covariance * lift[:, None] * lift[None, :]
    out[np.diag_indices_from(out)] = raised
    return np.asarray(out)


def sandwich(bread: Floats, meat: Floats, least: Floats | None = None) -> Floats:
    """Return the covariance ``B M B^T`` of estimates from that of the scores they are made of.

    Parameters
    ----------
    bread : ndarray, shape (column, column)
        How far the estimates move for one unit of the summed scores.
    meat : ndarray, shape (column, column)
        Covariance of the summed scores; of blocks that are correlated in time
        `bartlett_covariance` or `long_run_covariance`.
    least : ndarray, shape (column, column), optional
        A covariance whose variances are the least possible, as that of white noise.
    """
    found = np.asarray(bread @ meat @ bread.T)
    return found if least is None else with_variance_floor(found, least)


def jackknife_covariance(without: Floats, about: Floats | None = None) -> Floats:
    """Return the covariance of a statistic from its values without one cluster each; (column, column).

    Parameters
    ----------
    without : ndarray, shape (cluster, column)
    about : ndarray, shape (column,), optional
        The value with all clusters, where the clusters are few and their bias is to count as error
        (Efron's form); the mean of `without` when absent.
    """
    clusters = len(without)
    change = without - (without.mean(axis=0) if about is None else about)
    return np.asarray((clusters - 1) / clusters * change.T @ change)


def jackknife(without: Floats) -> Floats:
    """Return the standard deviation of a statistic from its values without one block; (block, ...)."""
    blocks = without.shape[0]
    spread = without - without.mean(axis=0)
    return np.asarray(np.sqrt((blocks - 1) / blocks * np.sum(spread**2, axis=0)))


def larger_scatter(matrix: Floats, within: Floats, between: Floats, prior_sigma: Floats) -> Floats:
    """Return the scatter of scores that is larger, direction by direction; (column, column), scaled.

    Both estimate the same when blocks differ by chance alone, so they must not be added; what
    changes slowly from block to block shows between them only, and what few blocks show may be too little.

    Parameters
    ----------
    matrix : ndarray, shape (column, column)
        Information of all blocks; its eigenvectors in units of the prior's sigma are the directions.
    within, between : ndarray, shape (column, column)
        Scatter of the scores inside blocks and from block to block.
    prior_sigma : ndarray, shape (column,)
        Scaled; 0 for what is fixed.
    """
    free = np.flatnonzero(prior_sigma > 0)
    grid, sigma = np.ix_(free, free), prior_sigma[free]
    unit = np.outer(sigma, sigma)
    _, vectors = eigen_of_symmetric(matrix[grid] * unit)
    inside = vectors.T @ (within[grid] * unit) @ vectors
    outside = np.diag(vectors.T @ (between[grid] * unit) @ vectors)
    inside += np.diag(np.where(np.diag(inside) <= 0, outside, 0.0))
    own = np.diag(inside)
    lift = np.sqrt(np.maximum(np.divide(outside, own, out=np.ones_like(own), where=own > 0), 1.0))
    out = np.zeros_like(matrix)
    out[grid] = vectors @ (lift[:, None] * inside * lift[None, :]) @ vectors.T / unit
    return out


def autocorrelation(series: Floats, lags: int) -> Floats:
    """Return the correlations of each column at lags 0 to `lags`; (lag, column)."""
    centred = series - series.mean(axis=0)
    size = 1 << (2 * len(series) - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    products = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[: lags + 1]
    return np.asarray(np.divide(products, products[0], out=np.zeros_like(products), where=products[0] > 0))


def correlation_steps(series: Floats) -> npt.NDArray[np.int64]:
    """Return the correlation time of each column of (block, column), in blocks; (column,)."""
    blocks = len(series)
    most = max(int(LONG_RUN_SETTINGS.longest * blocks), 1)
    correlation = np.abs(autocorrelation(series, min(most + LONG_RUN_SETTINGS.in_a_row, blocks - 1)))
    small = correlation < LONG_RUN_SETTINGS.chance * np.sqrt(np.log10(max(blocks, 10)) / blocks)
    # Beyond the last lag nothing is known, and nothing speaks against a run.
    ahead = np.ones((most + LONG_RUN_SETTINGS.in_a_row, small.shape[1]), dtype=np.bool_)
    ahead[: len(small) - 1] = small[1 : most + LONG_RUN_SETTINGS.in_a_row + 1]
    quiet = np.logical_and.reduce([ahead[lag : lag + most] for lag in range(LONG_RUN_SETTINGS.in_a_row)])
    return np.asarray(np.where(quiet.any(axis=0), quiet.argmax(axis=0), most), dtype=np.int64)


def long_run_covariance(scores: Floats, functions: float = 1.0) -> Floats:
    """Return the covariance of a sum of scores, with their correlation in time.

    A flat-topped kernel (Politis and Romano 1995) over twice the correlation time that the scores
    themselves show (Politis and White 2004): days that are correlated over a month beneath their own white
    noise count as that, which a first-order autoregression does not see.

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
    width = 2 * int(correlation_steps(centred).max())
    kernel = np.clip(2.0 * (1.0 - np.arange(1, width + 1) / (width + 1)), 0.0, 1.0)
    if width:
        # What the kernel makes of all earlier blocks, at once: a product a lag would take a second.
        size_of = 1 << (blocks + width).bit_length()
        spectrum = np.fft.rfft(np.append(0.0, kernel), size_of)[:, None] * np.fft.rfft(unit, size_of, axis=0)
        shared = unit.T @ np.fft.irfft(spectrum, size_of, axis=0)[:blocks]
        total = total + shared + shared.T
    lost = min(functions * (1.0 + 2.0 * kernel.sum()) / blocks, LONG_RUN_SETTINGS.most_lost)
    return np.asarray(_no_smaller(total, plain) * np.outer(size, size) / (1.0 - lost))


def long_run_variance(series: Floats) -> Floats:
    """Return the `long_run_covariance` of each column by itself, each with its own correlation time.

    Parameters
    ----------
    series : ndarray, shape (block, column)
        In order of time.

    Returns
    -------
    ndarray, shape (column,)
    """
    blocks = len(series)
    if blocks < 2:
        return np.zeros(series.shape[1])
    centred = series - series.mean(axis=0)
    width = 2 * correlation_steps(centred)
    lag = np.arange(1, int(width.max(initial=0)) + 1)[:, None]
    kernel = np.clip(2.0 * (1.0 - lag / (width + 1)), 0.0, 1.0)
    ratio = 1.0 + 2.0 * np.sum(kernel * autocorrelation(centred, len(lag))[1:], axis=0)
    lost = np.minimum((1.0 + 2.0 * kernel.sum(axis=0)) / blocks, LONG_RUN_SETTINGS.most_lost)
    return np.asarray(np.sum(centred**2, axis=0) * np.maximum(ratio, LONG_RUN_SETTINGS.least) / (1.0 - lost))


def _no_smaller(total: Floats, white: Floats) -> Floats:
    """Return a covariance without directions far below what uncorrelated scores have: these are chance."""
    own, vectors = eigen_of_symmetric(white)
    kept = own > 1e-10 * own.max()
    root = vectors[:, kept] * np.sqrt(own[kept])
    inverse = vectors[:, kept] / np.sqrt(own[kept])
    ratio, directions = eigen_of_symmetric(inverse.T @ total @ inverse)
    spread = root @ directions
    return np.asarray((spread * np.maximum(ratio, LONG_RUN_SETTINGS.least)) @ spread.T)


def correlated_covariance(
    scores: Floats, information: Floats, prior_sigma: Floats, functions: float = 1.0
) -> Floats:
    """Return the covariance of a fit with a prior from the scatter of its blocks' scores, correlated in time.

    With B the covariance for white residuals, ``(A + P)^-1``, it is that of the blocks' influences ``B s``
    (`long_run_covariance`) plus ``B P B``, what the prior leaves open; variances are at least those of B:
    fewer blocks than parameters leave scores that are too small.

    Parameters
    ----------
    scores : ndarray, shape (block, column)
        At the fit, over the residual's variance.
    information : ndarray, shape (column, column)
        Gram matrix of all blocks together over the residual's variance: A.
    prior_sigma : ndarray, shape (column,)
        P is the diagonal of 1 / sigma^2; 0 for what is fixed.
    functions : float
        Functions of time of each parameter, on average; as of `long_run_covariance`.
    """
    free = np.flatnonzero(prior_sigma > 0)
    grid = np.ix_(free, free)
    white = posterior_covariance(information[grid], prior_sigma[free])
    precision = 1.0 / prior_sigma[free] ** 2
    spread = long_run_covariance(scores[:, free] @ white, functions) + (white * precision) @ white
    out = np.zeros_like(information)
    out[grid] = with_variance_floor(spread, white)
    return out


def sigma_of_mean(series: Floats) -> float:
    """Return the standard deviation of the mean of a correlated series (block,); NaN are left out."""
    known = series[np.isfinite(series)]
    if known.size < 2:
        return float("nan")
    return float(np.sqrt(long_run_covariance(known[:, None])[0, 0]) / known.size)


def hac_t(difference: Floats, active: npt.NDArray[np.bool_] | None = None) -> Floats:
    """Return mean over standard error of series; (series,), errors with Bartlett's kernel over blocks.

    Parameters
    ----------
    difference : ndarray, shape (block, series)
    active : ndarray of bool, shape (block, series), optional
        Blocks with information: an effect that lasts a week is judged by that week.
    """
    used = np.ones(difference.shape, dtype=bool) if active is None else active
    count = np.maximum(used.sum(axis=0), 1)
    summed = np.where(used, difference, 0.0).sum(axis=0)
    centred = np.where(used, difference - summed / count, 0.0)
    variance = bartlett_variance(centred, newey_west_lags(len(centred)))
    error = np.sqrt(variance * count / np.maximum(count - 1, 1))
    return np.where((error > 0) & (count > 2), summed / np.where(error > 0, error, 1.0), 0.0)


def expected_gain_t(gained: Floats, expected: Floats, active: npt.NDArray[np.bool_]) -> Floats:
    """Return total gain over its error, by how each block's gain misses its expected part; (series,).

    With expected gains e_b and gains d_b, block b alone misses by d_b - e_b sum'(d) / sum'(e), the sums over
    all other blocks; the error is the root of the sum of their squares, with Bartlett's kernel over
    neighbours.
    As many blocks as (sum e)^2 / sum e^2 bear the gain out: with few, t is lowered so that three lies at the
    same probability of Student's distribution.

    Parameters
    ----------
    gained, expected : ndarray, shape (block, series)
        Held-out gain, and the square of what the effect fitted elsewhere contributes.
    active : ndarray of bool, shape (block, series)
        Blocks with information.
    """
    t, freedom = _expected_gain(gained, expected, active)
    # A t of three as probable as with many blocks.
    limit = scipy.special.stdtrit(np.maximum(freedom, 0.1), scipy.special.ndtr(-3.0))
    few = np.where(freedom > 0.1, -3.0 / limit, 0.0)
    return np.asarray(few * t)


def expected_gain_p(gained: Floats, expected: Floats, active: npt.NDArray[np.bool_]) -> Floats:
    """Return the probability that chance gains so much where it is expected (Student); (series,).

    Parameters
    ----------
    gained, expected, active : ndarray, shape (block, series)
        As in `expected_gain_t`.
    """
    t, freedom = _expected_gain(gained, expected, active)
    return np.where(freedom > 0.1, scipy.special.stdtr(np.maximum(freedom, 0.1), -t), 1.0)


def _expected_gain(gained: Floats, expected: Floats, active: npt.NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Return total gain over its error and the degrees of freedom of that error; (series,) each."""
    count = active.sum(axis=0)
    gains = np.where(active, gained, 0.0)
    whole = np.sum(gains, axis=0)
    part = np.where(active, expected, 0.0)
    # Nothing expected, nothing gained: the same is then expected of each block.
    part = np.where(np.sum(part, axis=0) > 0, part, active)
    share = part / np.maximum(np.sum(part, axis=0), 1e-300)
    missed = (gains - whole * share) / np.maximum(1.0 - share, 1e-12)
    error = np.sqrt(bartlett_variance(missed, newey_west_lags(len(missed))))
    freedom = 1.0 / np.maximum(np.sum(share**2, axis=0), 1e-300) - 1.0
    return np.where((error > 0) & (count > 2), whole / np.where(error > 0, error, 1.0), 0.0), freedom
