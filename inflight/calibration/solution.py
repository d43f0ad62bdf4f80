"""Solving normal equations with what is known beforehand; saying what the data can determine.

Columns are scaled. In coordinates z = (parameter - prior) / prior sigma the data's information has
the eigenvalues mu: a direction with mu < 1 is known better beforehand than from the data, and stays
at its prior exactly; the others take the maximum of the posterior. A single parameter counts as
determined when its own uncertainty, everything else being free, falls to half its prior's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.effects.base import Floats

#: Information of the data relative to the prior below which a direction stays at its prior.
MIN_INFORMATION = 1.0
#: A parameter is determined when its sigma is at most this part of its prior's.
DETERMINED = 0.5
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
    """Return the weighted sum of squared residuals after a scaled change of the parameters; nT^2."""
    matrix, cross, own = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
    return float(max(own + 2.0 * cross @ change + change @ matrix @ change, 0.0))


def solve(gram: Floats, scatter: Floats, count: float, prior: Floats, prior_sigma: Floats) -> Solution:
    """Solve ``min |y + X d|^2`` with a Gaussian prior on d.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Weighted Gram matrix of [X | y], scaled columns, nT^2.
    scatter : ndarray, shape (parameter, parameter)
        Sum over independent sub-blocks of the outer products of their scores ``X^T y``.
    count : float
        Sum of the weights.
    prior, prior_sigma : ndarray, shape (parameter,)
        Scaled mean and standard deviation; sigma 0 fixes a parameter.

    Returns
    -------
    Solution
    """
    matrix, cross = gram[:-1, :-1], gram[:-1, -1]
    inverse_prior = np.divide(1.0, prior_sigma**2, out=np.zeros_like(prior_sigma), where=prior_sigma > 0)
    first = _map(matrix, cross, prior, prior_sigma, _variance(gram, prior, count))
    variance = _variance(gram, first, count)
    steadied = np.linalg.pinv(matrix / variance + np.diag(inverse_prior), hermitian=True)
    white = float(np.trace(steadied @ matrix)) / variance
    inflation = max(1.0, float(np.trace(steadied @ scatter)) / variance**2 / white) if white > 0 else 1.0
    effective = variance * inflation

    information = prior_sigma[:, None] * matrix * prior_sigma[None, :] / effective
    mu, vectors = np.linalg.eigh(information)
    known = mu >= MIN_INFORMATION
    pull = -(prior_sigma * (matrix @ prior + cross)) / effective
    step = np.where(known, (vectors.T @ pull) / (1.0 + mu), 0.0)
    value = prior + prior_sigma * (vectors @ step)

    noise = vectors.T @ (prior_sigma[:, None] * scatter * prior_sigma[None, :]) @ vectors / effective**2
    shrink = 1.0 / (1.0 + np.maximum(mu, 0.0))
    of_prior, of_noise = np.where(known, shrink, 1.0), np.where(known, shrink, 0.0)
    spread = np.diag(of_prior**2) + of_noise[:, None] * noise * of_noise[None, :]
    covariance = prior_sigma[:, None] * (vectors @ spread @ vectors.T) * prior_sigma[None, :]
    sigma = np.sqrt(np.diag(covariance))
    return Solution(
        value,
        covariance,
        determined=(sigma <= DETERMINED * prior_sigma) & (prior_sigma > 0),
        retained=retained_fraction(matrix),
        moved=np.abs(value - prior) > 1e-9 * np.maximum(prior_sigma, 1e-300),
        directions=vectors[:, known].T[::-1],
        variance=variance,
        inflation=inflation,
    )


def _variance(gram: Floats, change: Floats, count: float) -> float:
    return max(residual_sum(gram, change) / max(count - change.size, 1.0), _SMALLEST_VARIANCE)


def _map(matrix: Floats, cross: Floats, prior: Floats, prior_sigma: Floats, variance: float) -> Floats:
    """Maximum of the posterior for white noise; the eigenvalues below rounding stay at the prior."""
    information = prior_sigma[:, None] * matrix * prior_sigma[None, :] / variance
    pull = -(prior_sigma * (matrix @ prior + cross)) / variance
    eye = np.eye(prior.size)
    return np.asarray(prior + prior_sigma * np.linalg.solve(information + eye, pull))


def retained_fraction(matrix: Floats) -> Floats:
    """Return, a column, the part of its square that the other columns cannot explain; in [0, 1]."""
    diagonal = np.sqrt(np.clip(np.diag(matrix), 0.0, None))
    safe = np.where(diagonal > 0, diagonal, 1.0)
    mu, vectors = np.linalg.eigh(matrix / safe[:, None] / safe[None, :])
    inflation = (vectors**2 / np.maximum(mu, 1e-14)).sum(axis=1)
    return np.where(diagonal > 0, np.minimum(1.0 / inflation, 1.0), 0.0)
