"""Solving normal equations with what is known beforehand; saying what the data can determine.

Columns are scaled. In coordinates z = (parameter - prior) / prior sigma the data's information has
the eigenvalues mu: a direction with mu < 1 is known better beforehand than from the data, and stays
at its prior exactly; the others take the maximum of the posterior. A single parameter counts as
determined when the data alone, everything else being free, know it to half its prior's sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

#: Information of the data relative to the prior below which a direction stays at its prior.
MIN_INFORMATION = 1.0
#: A parameter is determined when its sigma is at most this part of its prior's.
DETERMINED = 0.5
#: Priors are widened by this when the question is what the data alone determine.
_WIDE = 1e3
#: Systems with a smaller ratio of singular values do not determine their unknowns.
SINGULAR = 1e-9
#: Information smaller than this many times the rounding error of its own sum is no information.
_ROUNDING = 64 * float(np.finfo(np.float64).eps)
#: Turns of residual variance and known directions at most.
_VARIANCE_PASSES = 10
#: The variance of rounding: readings are never better than this; nT^2.
_SMALLEST_VARIANCE = 1e-12


@dataclass(frozen=True)
class Solution:
    """Values of the parameters, relative to the reference of the normal equations.

    Attributes
    ----------
    value : ndarray, shape (parameter,)
        Scaled change from the reference.
    covariance : ndarray, shape (parameter, parameter)
        Scaled; robust against autocorrelation within the sub-blocks it was made from.
    determined : ndarray of bool
        The data alone tell this parameter from all others.
    retained : ndarray
        Part of a column no combination of the others explains, 1 / variance inflation factor.
    moved : ndarray of bool
        The value left its prior, alone or as part of a combination.
    directions : ndarray, shape (determined direction, parameter)
        Combinations that the data determine, unit vectors in units of prior sigma.
    variance : float
        Residual variance per sample, nT^2.
    inflation : float
        How many times larger the covariance is than for uncorrelated residuals.
    """

    value: Floats
    covariance: Floats
    determined: npt.NDArray[np.bool_]
    retained: Floats
    moved: npt.NDArray[np.bool_]
    directions: Floats
    variance: float
    inflation: float

    @property
    def sigma(self) -> Floats:
        """Standard deviations, scaled."""
        return np.sqrt(np.diag(self.covariance))


def residual_sum(gram: Floats, change: Floats) -> float:
    """Return the weighted sum of squared residuals, nT^2, after a scaled change (parameter,)."""
    matrix, cross, own = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
    return float(max(own + 2.0 * cross @ change + change @ matrix @ change, 0.0))


def posterior(gram: Floats, count: float, prior: Floats, prior_sigma: Floats) -> tuple[Floats, Floats, float]:
    """Return the posterior's maximum, its covariance and the least information, for white residuals.

    Parameters
    ----------
    gram, count, prior, prior_sigma
        As in `solve`.
    """
    matrix, cross = gram[:-1, :-1], gram[:-1, -1]
    pull = prior_sigma * (matrix @ prior + cross)
    value, variance = prior, 1.0
    own, vectors = _information(matrix, prior_sigma)
    seen = np.where(own > 0, vectors.T @ pull, 0.0)
    for _ in range(2):
        variance = _variance(gram, value, count)
        shrink = 1.0 / (1.0 + own / variance)
        value = prior - prior_sigma * (vectors @ (shrink * seen)) / variance
    inverse = (vectors * shrink) @ vectors.T
    free = prior_sigma > 0
    least = float(own[-int(free.sum())]) / variance if free.any() else np.inf
    return value, inverse * np.outer(prior_sigma, prior_sigma), least


def _information(matrix: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Return information (nT^2, ascending) and its directions in units of prior sigma.

    What sums of squares leave behind where nothing is to be seen must not pass for information.
    """
    own, vectors = np.linalg.eigh(matrix * np.outer(prior_sigma, prior_sigma))
    parts = np.abs(vectors).T @ (prior_sigma * np.sqrt(np.clip(np.diag(matrix), 0.0, None)))
    rounding = _ROUNDING * np.maximum(parts**2, 0.125 * max(own[-1], 0.0))
    return np.where(own > rounding, own, 0.0), vectors


def solve(
    gram: Floats,
    scatter: Floats,
    count: float,
    prior: Floats,
    prior_sigma: Floats,
    least: float = MIN_INFORMATION,
) -> Solution:
    """Solve ``min |y + X d|^2`` with a Gaussian prior on d.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Weighted Gram matrix of [X | y], scaled columns, nT^2.
    scatter : ndarray, shape (parameter, parameter)
        Long-run scatter of the scores ``X^T y``, which knows how far residuals are correlated.
    count : float
        Sum of the weights.
    prior, prior_sigma : ndarray, shape (parameter,)
        Scaled mean and standard deviation; sigma 0 fixes a parameter.
    least : float
        Information relative to the prior below which a direction stays at its prior.

    Returns
    -------
    Solution
    """
    matrix, cross = gram[:-1, :-1], gram[:-1, -1]
    value, variance = prior, _variance(gram, prior, count)
    for _ in range(_VARIANCE_PASSES):
        found = _directions(matrix, scatter, variance, prior_sigma, least)
        value = _posterior(found, prior, matrix @ prior + cross, prior_sigma)
        before, variance = variance, _variance(gram, value, count)
        # A prior that is far off makes the residual look noisy and hides directions; it shrinks at each turn.
        if abs(before - variance) <= 1e-6 * variance:
            break
    alone = _directions(matrix, scatter, variance, prior_sigma * _WIDE, least)
    return Solution(
        value,
        found.covariance(prior_sigma),
        determined=(
            np.sqrt(np.clip(np.diag(alone.covariance(prior_sigma * _WIDE)), 0, None))
            <= DETERMINED * prior_sigma
        )
        & (prior_sigma > 0),
        retained=retained_fraction(matrix),
        moved=np.abs(value - prior) > 1e-9 * np.maximum(prior_sigma, 1e-300),
        directions=found.vectors[:, found.known].T[::-1],
        variance=variance,
        inflation=float(np.median(found.inflation[found.known])) if found.known.any() else 1.0,
    )


@dataclass(frozen=True)
class _Directions:
    """Independent directions of the data's information, in units of prior sigma.

    `white` is the information for uncorrelated residuals, `inflation` how many times less there
    really is along each direction: a drift spoils the mean of a day more than its slopes.
    """

    vectors: Floats
    white: Floats
    inflation: Floats
    noise: Floats
    variance: float
    least: float

    @property
    def information(self) -> Floats:
        return self.white / self.inflation

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        return self.information >= self.least

    def covariance(self, prior_sigma: Floats) -> Floats:
        """Covariance of the posterior's maximum, sandwiched; scaled."""
        shrink = 1.0 / (1.0 + self.information)
        of_prior, of_noise = np.where(self.known, shrink, 1.0), np.where(self.known, shrink, 0.0)
        gain = of_noise / self.inflation
        spread = np.diag(of_prior**2) + gain[:, None] * self.noise * gain[None, :]
        return np.asarray(
            prior_sigma[:, None] * (self.vectors @ spread @ self.vectors.T) * prior_sigma[None, :]
        )


def _directions(
    matrix: Floats, scatter: Floats, variance: float, prior_sigma: Floats, least: float
) -> _Directions:
    unit = np.outer(prior_sigma, prior_sigma)
    white, vectors = _information(matrix, prior_sigma)
    white = white / variance
    noise = vectors.T @ (scatter * unit) @ vectors / variance**2
    # Few sub-blocks can show less scatter than uncorrelated residuals have; that is chance, not knowledge.
    own = np.clip(np.diag(noise), 0.0, None)
    short = own < white
    noise[short, :] = 0.0
    noise[:, short] = 0.0
    noise[short, short] = white[short]
    inflation = np.divide(own, white, out=np.ones_like(white), where=white > 0)
    return _Directions(vectors, white, np.maximum(inflation, 1.0), noise, variance, least)


def _posterior(found: _Directions, prior: Floats, slope: Floats, prior_sigma: Floats) -> Floats:
    """Return the maximum of the posterior; directions the prior knows better stay."""
    pull = -(found.vectors.T @ (prior_sigma * slope))
    step = np.where(found.known, pull / found.variance / found.inflation / (1.0 + found.information), 0.0)
    return np.asarray(prior + prior_sigma * (found.vectors @ step))


def _variance(gram: Floats, change: Floats, count: float) -> float:
    return max(residual_sum(gram, change) / max(count - change.size, 1.0), _SMALLEST_VARIANCE)


def retained_fraction(matrix: Floats) -> Floats:
    """Return, a column, the part of its square that the others cannot explain; (column,) in [0, 1]."""
    diagonal = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    safe = np.where(diagonal > 0, diagonal, 1.0)
    mu, vectors = np.linalg.eigh(matrix / safe[:, None] / safe[None, :])
    inflation = (vectors**2 / np.maximum(mu, 1e-14)).sum(axis=1)
    return np.where(diagonal > 0, np.minimum(1.0 / inflation, 1.0), 0.0)
