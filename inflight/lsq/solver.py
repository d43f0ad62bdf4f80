"""Scaled solve with priors, identifiability, clustered fit.

Solving normal equations with what is known beforehand; saying what the data can determine.

Columns are scaled. In coordinates z = (parameter - prior) / prior sigma the data's information has
the eigenvalues mu: a direction with mu < 1 is known better beforehand than from the data, and stays
at its prior exactly; the others take the maximum of the posterior. A single parameter counts as
determined when the data alone, everything else being free, know it to half its prior's sigma.

Least squares from Gram matrices of clusters: rows of one cluster share noise, clusters do not.

A cluster is a day, or a segment of one. Its Gram matrix of [columns | observation] is all that is
kept of it, so a pass over the archive stores little and every fit is algebra afterwards. The
covariance is the jackknife over clusters: it assumes nothing about the noise inside one, and leaving
a cluster out accounts for its leverage, which the plain sandwich of scores does not. Series whose days
remember each other, such as daily parameters, have `longrun.long_run_covariance` instead: it needs
many more days than the five that are enough here.

What fitted columns take over from others: algebra of Gram matrices for cross-talk and evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student_t

from inflight.arrays import Floats
from inflight.errors import CalibrationError

#: Places of columns in a Gram matrix.
Places = npt.NDArray[np.int64]

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


#: Eigenvalues of a matrix of unit diagonal below this determine nothing: rounding of sums of squares.
EIGEN_CUT = 1e-12

#: Directions that keep less than this of their own variance beside the others are dropped.
WEAK_CUT = 1e-6


def _unit_eigen(matrices: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the units that make each diagonal 1 (..., k), and eigenvalues and vectors in these units."""
    size = np.sqrt(np.clip(np.einsum("...ii->...i", matrices), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    own, vectors = np.linalg.eigh(matrices * unit[..., :, None] * unit[..., None, :])
    return unit, own, vectors


def solve_scaled(matrix: Floats, right: Floats, cut: float = EIGEN_CUT) -> Floats:
    """Solve a symmetric system in units of its own diagonal; what it does not determine stays 0.

    A prior is part of the matrix: its precision times the residual's variance, on the diagonal.

    Parameters
    ----------
    matrix : ndarray, shape (n, n)
    right : ndarray, shape (n,) or (n, m)
    cut : float
        Eigenvalues of the unit-diagonal matrix below it are no information.
    """
    unit, own, vectors = _unit_eigen(matrix)
    inverse = np.where(own > cut, 1.0 / np.where(own > cut, own, 1.0), 0.0)
    scaled = right * (unit[:, None] if right.ndim == 2 else unit)
    found = vectors @ ((vectors.T @ scaled) * (inverse[:, None] if right.ndim == 2 else inverse))
    return np.asarray(found * (unit[:, None] if right.ndim == 2 else unit))


def inverse_square_root(matrices: Floats, cut: float = WEAK_CUT) -> Floats:
    """Return L with ``L L^T`` the inverse of each matrix where it is one; (candidate, k, k)."""
    unit, own, vectors = _unit_eigen(matrices)
    root = np.where(own > cut, 1.0 / np.sqrt(np.where(own > cut, own, 1.0)), 0.0)
    return np.asarray(unit[:, :, None] * vectors * root[:, None, :])


def gram_inverse(matrix: Floats, cut: float = WEAK_CUT) -> Floats:
    """Return the inverse of a Gram matrix (k, k) along what it determines, 0 along what it does not."""
    half = inverse_square_root(matrix[None], cut)[0]
    return np.asarray(half @ half.T)


def regression(gram: Floats, fitted: Places, ignored: Places) -> Floats:
    """Return how much of each fitted column stands for one unit of each ignored one; (..., fitted, ignored).

    With X the fitted columns and z an ignored one it is ``(X^T X)^-1 X^T z``: least squares of z on X.

    Parameters
    ----------
    gram : ndarray, shape (..., column, column)
        Gram matrix of all columns; one, or one a block.
    fitted, ignored : ndarray of int
        Their places.
    """
    stack = gram.reshape(-1, *gram.shape[-2:])
    half = inverse_square_root(stack[:, fitted[:, None], fitted[None, :]])
    found = half @ half.swapaxes(1, 2) @ stack[:, fitted[:, None], ignored[None, :]]
    return np.asarray(found.reshape(*gram.shape[:-2], fitted.size, ignored.size))


def marginalise(gram: Floats, marginalised: Places, kept: Places) -> Floats:
    """Return the Gram matrix of the kept columns less what the marginalised ones explain; (..., kept, kept).

    The Schur complement ``G_kk - G_km G_mm^-1 G_mk``.

    Parameters
    ----------
    gram : ndarray, shape (..., column, column)
        Gram matrix of all columns; one, or one a block.
    marginalised, kept : ndarray of int
        Their places.
    """
    over = regression(gram, marginalised, kept)
    cross = gram[..., kept[:, None], marginalised[None, :]]
    return np.asarray(gram[..., kept[:, None], kept[None, :]] - cross @ over)


def correlation_of(covariance: Floats) -> Floats:
    """Return the correlations of a covariance or Gram matrix (k, k), in [-1, 1]; 0 where a size is 0."""
    size = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    return np.clip(covariance * unit[:, None] * unit[None, :], -1.0, 1.0)


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


#: The fewest clusters whose scatter says anything of an uncertainty: four degrees of freedom.
FEWEST_CLUSTERS = 5

#: Part of a Gaussian below one sigma.
_ONE_SIGMA = 0.8413447460685429


@dataclass(frozen=True)
class ClusteredFit:
    """Values of a linear fit with the uncertainty that the scatter between clusters tells.

    Attributes
    ----------
    value : ndarray, shape (column,)
    covariance : ndarray, shape (column, column)
        Of noise, by the jackknife, and of what the prior leaves open.
    retained : ndarray, shape (column,)
        Part of a column's square that the others cannot explain, in [0, 1].
    determined : ndarray of bool, shape (column,)
        The data alone tell the value to half its prior's sigma.
    variance : float
        Residual variance of a row in units of its weight: 1 where rows were divided by their sigma.
    clusters : int
    rows : float
    """

    value: Floats
    covariance: Floats
    retained: Floats
    determined: npt.NDArray[np.bool_]
    variance: float
    clusters: int
    rows: float

    @property
    def sigma(self) -> Floats:
        """Standard deviations; (column,)."""
        return np.sqrt(np.clip(np.diag(self.covariance), 0.0, None))


def grams_by_cluster(
    columns: Floats, observed: Floats, weight: Floats, cluster: npt.NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return Gram matrix (cluster, column + 1, column + 1) and number of rows (cluster,) of each cluster."""
    _, which = np.unique(cluster, return_inverse=True)
    rows = np.column_stack([columns, observed])
    gram = np.zeros((int(which.max(initial=-1)) + 1, rows.shape[1], rows.shape[1]))
    np.add.at(gram, which, weight[:, None, None] * rows[:, :, None] * rows[:, None, :])
    return gram, np.bincount(which).astype(np.float64)


def solve_clusters(
    gram: Floats, rows: Floats, prior_sigma: Floats | None = None, *, fewest: int = FEWEST_CLUSTERS
) -> ClusteredFit:
    """Solve for the columns with the prior 0 +- `prior_sigma`.

    Parameters
    ----------
    gram : ndarray, shape (cluster, column + 1, column + 1)
        Of [columns | observation], rows weighted by one over their variance, up to a factor.
    rows : ndarray, shape (cluster,)
        Rows behind each.
    prior_sigma : ndarray, shape (column,), optional
        In units of the values; infinite when absent: nothing is known beforehand.
    fewest : int
        Clusters needed.

    Returns
    -------
    ClusteredFit
        With d_g the change of the values when cluster g is left out, the covariance is
        ``(G - 1)/G sum d_g d_g^T`` (Efron's jackknife) plus ``S^-1 P S^-1``, what a prior of precision
        P leaves open, with S the sum of both precisions. The first is widened so that one sigma of
        Student's distribution with G - 1 degrees of freedom holds 68 %: by 1.14 in sigma for 5 clusters.

    Raises
    ------
    CalibrationError
        Too few clusters, or columns that neither data nor prior determine.
    """
    filled = gram[rows > 0]
    if len(filled) < fewest:
        raise CalibrationError(
            f"{len(filled)} clusters with data found, at least {fewest} needed for an uncertainty",
            remedy="take a longer span or shorter clusters",
        )
    total, width = filled.sum(axis=0), gram.shape[1] - 1
    count = float(rows.sum())
    precision = np.zeros(width) if prior_sigma is None else 1.0 / np.asarray(prior_sigma) ** 2
    variance = _row_variance(total, precision, count)
    ridge = np.diag(variance * precision)
    value = _solve(total[None], ridge)[0]
    left = _solve(total - filled, ridge)
    change = left - value
    noise = _student(len(filled) - 1) ** 2 * (len(filled) - 1) / len(filled) * change.T @ change
    inverse = np.linalg.inv(total[:-1, :-1] + ridge)
    open_ = inverse @ (variance * ridge) @ inverse
    alone = variance * np.diag(np.linalg.inv(total[:-1, :-1] + ridge / _WIDE**2))
    with np.errstate(divide="ignore"):
        limit = np.where(precision > 0, DETERMINED / np.sqrt(precision), np.inf)
    return ClusteredFit(
        value,
        noise + open_,
        retained_fraction(total[:-1, :-1]),
        np.sqrt(alone) <= limit,
        variance,
        len(filled),
        count,
    )


def mean_of_clusters(value: Floats, weight: Floats, cluster: npt.NDArray[np.int64]) -> tuple[float, float]:
    """Return the weighted mean of values and its standard deviation by the scatter between clusters.

    Parameters
    ----------
    value, weight : ndarray, shape (row,)
        The weight is one over the row's variance, up to a factor.
    cluster : ndarray of int64, shape (row,)
        Two or more different ones.
    """
    fit = solve_clusters(*grams_by_cluster(np.ones((value.size, 1)), value, weight, cluster), fewest=2)
    return float(fit.value[0]), float(fit.sigma[0])


def _student(freedom: int) -> float:
    """Return how many estimated sigmas hold what one true sigma does."""
    return float(student_t.ppf(_ONE_SIGMA, freedom))


def _row_variance(total: Floats, precision: Floats, count: float) -> float:
    """Return the variance of a row about the fit; a prior's pull is small beside it."""
    variance = float(total[-1, -1]) / max(count, 1.0)
    for _ in range(3):
        value = _solve(total[None], np.diag(variance * precision))[0]
        extended = np.append(-value, 1.0)
        variance = float(extended @ total @ extended) / max(count - value.size, 1.0)
    # Rounding can make the square of a perfect fit negative.
    return max(variance, np.finfo(np.float64).tiny)


def _solve(gram: Floats, ridge: Floats) -> Floats:
    """Return the values of each Gram matrix; (cluster, column)."""
    matrix = gram[:, :-1, :-1] + ridge
    scale = np.sqrt(np.maximum(np.einsum("gii->gi", matrix), 0.0))
    if not np.all(scale > 0):
        index = int(np.argwhere(scale <= 0)[0, 1])
        raise CalibrationError(
            f"column {index} of the fit is zero in all clusters but at most one",
            remedy="leave the column out, or state what is known of it beforehand",
        )
    scaled = matrix / scale[:, :, None] / scale[:, None, :]
    if np.linalg.eigvalsh(scaled)[:, 0].min() < SINGULAR:
        raise CalibrationError(
            "the columns of the fit are not independent, or only in one cluster",
            remedy="take more data, leave a column out, or state what is known of it beforehand",
        )
    return np.asarray(np.linalg.solve(scaled, (gram[:, :-1, -1] / scale)[..., None])[..., 0] / scale)
