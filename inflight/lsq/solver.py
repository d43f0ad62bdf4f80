"""Solving normal equations in scaled columns, with what is known beforehand.

Takes Gram matrices of [columns | residual]; makes values, covariances and what the data determine.

- `solve_scaled` solves a symmetric system in units of its own diagonal, with a prior's precision and
  a cut of its eigenvalues; `inverse_square_root`, `gram_inverse`, `regression` and `marginalise` (the
  Schur complement; Frisch, Waugh and Lovell) are the same solver asked for other things.
- `posterior_covariance` is the covariance of a Gaussian prior updated by a Gram matrix.
- `posterior`, `solve` and, for many at once, `solve_each` fit a calibration. In coordinates
  z = (parameter - prior) / prior sigma the data's information has the eigenvalues mu: a direction with
  mu < 1 is known better beforehand than from the data, and stays at its prior exactly; the others take
  the maximum of the posterior. A single parameter counts as determined when the data alone, everything
  else being free, know it to half its prior's sigma.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.lsq.robust import median_of_finite

#: Places of columns in a Gram matrix.
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """What counts as information, and what as rounding.

    Attributes
    ----------
    eigen_cut : float
        Eigenvalues of a matrix of unit diagonal below this determine nothing: rounding of sums of
        squares of some thousand rows; assumed.
    weak_cut : float
        The same where columns that nearly repeat each other are to count as one; assumed.
    singular : float
        Smallest eigenvalue of a matrix of unit diagonal that is refused instead of cut; assumed.
    rounding : float
        Information smaller than this part of its own sum of squares is none: 64 rounding errors of
        double precision.
    min_information : float
        Information of the data, relative to the prior's, below which a direction stays at its prior:
        where data and prior know equally much.
    determined : float
        A parameter is determined when its sigma is at most this part of its prior's; stated.
    wide : float
        Factor by which priors are widened when the question is what the data alone determine; assumed.
    variance_passes : int
        Passes of residual variance and known directions at most; they settle in three or four.
    cluster_variance_passes : int
        Passes of the residual variance of a fit of clusters; assumed.
    smallest_variance : float
        nT^2. Readings are never better than their rounding; assumed.
    fewest_clusters : int
        The fewest clusters whose scatter gives an uncertainty: four degrees of freedom.
    """

    eigen_cut: float = 1e-12
    weak_cut: float = 1e-6
    singular: float = 1e-9
    rounding: float = 64 * float(np.finfo(np.float64).eps)
    min_information: float = 1.0
    determined: float = 0.5
    wide: float = 1e3
    variance_passes: int = 10
    cluster_variance_passes: int = 3
    smallest_variance: float = 1e-12
    fewest_clusters: int = 5


SOLVER_SETTINGS = SolverSettings()


def unit_scaled(matrices: Floats) -> tuple[Floats, Floats]:
    """Return the units that make each diagonal 1 (..., k), and the matrices in these units."""
    size = np.sqrt(np.clip(np.einsum("...ii->...i", matrices), 0.0, None))
    unit = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    return unit, matrices * unit[..., :, None] * unit[..., None, :]


def eigen_of_symmetric(matrix: Floats) -> tuple[Floats, Floats]:
    """Return eigenvalues (..., n), ascending, and eigenvectors (..., n, n) of symmetric matrices.

    LAPACK's divide and conquer, which numpy calls, now and then does not converge for a sound matrix; the
    slower QR iteration is asked then.

    Raises
    ------
    numpy.linalg.LinAlgError
        When neither converges: the matrix holds something that is not a number.
    """
    try:
        values, vectors = np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        if matrix.ndim > 2:
            # Each by itself: what is found of one must not depend on its neighbours.
            each = [eigen_of_symmetric(one) for one in matrix.reshape(-1, *matrix.shape[-2:])]
            values = np.stack([one[0] for one in each]).reshape(matrix.shape[:-1])
            vectors = np.stack([one[1] for one in each]).reshape(matrix.shape)
        else:
            import scipy.linalg  # rarely needed, and slow to load

            values, vectors = scipy.linalg.eigh(matrix, driver="ev")
    return np.asarray(values), np.asarray(vectors)


def solve_scaled(
    matrix: Floats, right: Floats, cut: float = SOLVER_SETTINGS.eigen_cut, precision: Floats | None = None
) -> Floats:
    """Solve symmetric systems in units of their own diagonals; what they do not determine stays 0.

    Parameters
    ----------
    matrix : ndarray, shape (..., n, n)
    right : ndarray, shape (..., n) or (..., n, m)
    cut : float
        Eigenvalues of the unit-diagonal matrix below it are no information. With 0 the matrix must be
        positive definite, as a prior makes it; it is then solved without eigenvalues, in a tenth of the
        time.
    precision : ndarray, shape (n,) or (..., n), optional
        What is known of the unknowns beforehand: 1 / sigma^2 times the residual's variance, which joins
        the diagonal. An infinite one fixes its unknown at 0; the same ones in all systems.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the matrix is singular and `cut` is 0.
    ValueError
        When the systems do not fix the same unknowns.
    """
    vector = right.ndim < matrix.ndim
    columns = right[..., None] if vector else right
    if precision is None:
        found = _solve_free(matrix, columns, cut)
    else:
        finite = np.isfinite(precision)
        somewhere = finite.any(axis=tuple(range(finite.ndim - 1)))
        if (finite != somewhere).any():
            raise ValueError("systems that fix different unknowns are solved apart")
        free = np.flatnonzero(somewhere)
        found = np.zeros(np.broadcast_shapes(columns.shape, matrix.shape[:-1] + columns.shape[-1:]))
        own = matrix[..., free[:, None], free] + precision[..., free, None] * np.eye(free.size)
        found[..., free, :] = _solve_free(own, columns[..., free, :], cut)
    return np.asarray(found[..., 0] if vector else found)


def _solve_free(matrix: Floats, columns: Floats, cut: float) -> Floats:
    if cut <= 0:
        unit, scaled = unit_scaled(matrix)
        return np.asarray(unit[..., None] * np.linalg.solve(scaled, unit[..., None] * columns))
    return ScaledSystems(matrix, cut).solve(columns)


class ScaledSystems:
    """Symmetric systems made ready once, to be solved for one right side after another; see `solve_scaled`.

    Parameters
    ----------
    matrix : ndarray, shape (..., n, n)
    cut : float
        Above 0.
    """

    def __init__(self, matrix: Floats, cut: float = SOLVER_SETTINGS.eigen_cut) -> None:
        self._unit, scaled = unit_scaled(matrix)
        # An unknown without information stays 0, as its unit is; the others need no eigenvalues for it.
        scaled = scaled + (self._unit == 0.0)[..., None] * np.eye(scaled.shape[-1])
        self._vectors: Floats | None = None
        try:
            # No eigenvalue is below 1 over the norm of the inverse.
            self._inverse = np.linalg.inv(scaled)
            if np.sum(self._inverse**2, axis=(-2, -1)).max(initial=0.0) < min(_SOUND, 1.0 / cut) ** 2:
                return
        except np.linalg.LinAlgError:
            pass
        own, self._vectors = eigen_of_symmetric(scaled)
        self._along = np.where(own > cut, 1.0 / np.where(own > cut, own, 1.0), 0.0)[..., None]

    def solve(self, right: Floats, which: Indices | slice = slice(None)) -> Floats:
        """Return the solutions of some of the systems, of which the first axis counts; (..., n, m)."""
        unit = self._unit[which][..., None]
        if self._vectors is None:
            return np.asarray(unit * (self._inverse[which] @ (unit * right)))
        vectors = self._vectors[which]
        return np.asarray(
            unit * (vectors @ (self._along[which] * (vectors.swapaxes(-1, -2) @ (unit * right))))
        )


#: Norm of the inverse of a matrix of unit diagonal up to which it is taken as it is: eight digits are right.
_SOUND = 1e8


def inverse_square_root(matrices: Floats, cut: float = SOLVER_SETTINGS.weak_cut) -> Floats:
    """Return L with ``L L^T`` the inverse of each matrix where it is one; (..., k, k).

    Directions of eigenvalues below `cut`, in units of each matrix's diagonal, are left out. Where the
    determinant says that there is none, L is the transposed inverse of Cholesky's factor, made for all
    matrices at once: eigenvalues of thousands of small ones take twenty times as long.
    """
    unit, scaled = unit_scaled(matrices)
    k = scaled.shape[-1]
    if k > _SMALL:
        return _by_eigenvalues(unit, scaled, cut)
    factor, pivots = _cholesky(scaled)
    # The product of all eigenvalues, of which none exceeds the trace, bounds the least one from below.
    sound = pivots.prod(axis=-1) > cut * float(k) ** max(k - 1, 0)
    out = np.zeros_like(scaled)
    # Of F with F F' the matrix, the inverse by forward substitution, transposed.
    for row in range(k):
        out[..., row, row] = 1.0 / factor[..., row, row]
        for column in range(row):
            known = np.einsum("...m,...m->...", factor[..., row, column:row], out[..., column, column:row])
            out[..., column, row] = -known / factor[..., row, row]
    out *= unit[..., :, None]
    if not sound.all():
        out[~sound] = _by_eigenvalues(unit[~sound], scaled[~sound], cut)
    return out


#: Matrices of so many columns at most are eliminated all at once.
_SMALL = 6


def _cholesky(scaled: Floats) -> tuple[Floats, Floats]:
    """Return Cholesky's factors of matrices of unit diagonal (..., k, k), and squared pivots (..., k).

    A pivot that rounding has made negative, or a row without anything, is told as 0 and taken as 1.
    """
    k = scaled.shape[-1]
    factor, pivots = np.zeros_like(scaled), np.zeros(scaled.shape[:-1])
    for column in range(k):
        own = factor[..., column, :column]
        pivot = scaled[..., column, column] - np.einsum("...m,...m->...", own, own)
        pivots[..., column] = np.where(pivot > 0, pivot, 0.0)
        factor[..., column, column] = np.sqrt(np.where(pivot > 0, pivot, 1.0))
        for row in range(column + 1, k):
            known = np.einsum("...m,...m->...", factor[..., row, :column], own)
            factor[..., row, column] = (scaled[..., row, column] - known) / factor[..., column, column]
    return factor, pivots


def _by_eigenvalues(unit: Floats, scaled: Floats, cut: float) -> Floats:
    own, vectors = eigen_of_symmetric(scaled)
    root = np.where(own > cut, 1.0 / np.sqrt(np.where(own > cut, own, 1.0)), 0.0)
    return np.asarray(unit[..., :, None] * vectors * root[..., None, :])


def gram_inverse(matrix: Floats, cut: float = SOLVER_SETTINGS.weak_cut) -> Floats:
    """Return the inverse of a Gram matrix (k, k) along what it determines, 0 along what it does not."""
    root = inverse_square_root(matrix, cut)
    return np.asarray(root @ root.T)


def regression_coefficients(
    gram: Floats, fitted: Indices, ignored: Indices, cut: float = SOLVER_SETTINGS.weak_cut
) -> Floats:
    """Return how much of each fitted column stands for one unit of each ignored one; (..., fitted, ignored).

    With X the fitted columns and z an ignored one it is ``(X^T X)^-1 X^T z``: least squares of z on X.

    Parameters
    ----------
    gram : ndarray, shape (..., column, column)
        Gram matrix of all columns; one, or one a block.
    fitted, ignored : ndarray of int
        Their places.
    cut : float
        As of `solve_scaled`.
    """
    own = gram[..., fitted[:, None], fitted[None, :]]
    return solve_scaled(own, gram[..., fitted[:, None], ignored[None, :]], cut)


def marginalise(
    gram: Floats, marginalised: Indices, kept: Indices, cut: float = SOLVER_SETTINGS.weak_cut
) -> Floats:
    """Return the Gram matrix of the kept columns less what the marginalised ones explain; (..., kept, kept).

    The Schur complement ``G_kk - G_km G_mm^-1 G_mk``.

    Parameters
    ----------
    gram : ndarray, shape (..., column, column)
        Gram matrix of all columns; one, or one a block.
    marginalised, kept : ndarray of int
        Their places.
    cut : float
        As of `solve_scaled`.
    """
    explained = regression_coefficients(gram, marginalised, kept, cut)
    cross = gram[..., kept[:, None], marginalised[None, :]]
    return np.asarray(gram[..., kept[:, None], kept[None, :]] - cross @ explained)


def posterior_covariance(matrix: Floats, prior_sigma: Floats, variance: float = 1.0) -> Floats:
    """Return the covariance ``(A / v + P)^-1`` of a Gaussian prior updated by data; (column, column).

    Parameters
    ----------
    matrix : ndarray, shape (column, column)
        Gram matrix of the columns: A.
    prior_sigma : ndarray, shape (column,)
        Of a mean 0; P is the diagonal of 1 / sigma^2. 0 fixes a column, whose covariance is 0; of an
        infinite one nothing is known beforehand.
    variance : float
        Of a row about the fit: v.

    Raises
    ------
    numpy.linalg.LinAlgError
        When a column is known neither from the data nor beforehand.
    """
    free = np.flatnonzero(prior_sigma > 0)
    grid = np.ix_(free, free)
    unit, scaled = unit_scaled(matrix[grid] + np.diag(variance / prior_sigma[free] ** 2))
    out = np.zeros_like(matrix)
    out[grid] = variance * np.linalg.inv(scaled) * np.outer(unit, unit)
    return out


def retained_fraction(matrix: Floats) -> Floats:
    """Return, a column, the part of its square that the others cannot explain; (..., column) in [0, 1]."""
    diagonal = np.sqrt(np.clip(_diagonal(matrix), 0.0, None))
    safe = np.where(diagonal > 0, diagonal, 1.0)
    mu, vectors = eigen_of_symmetric(matrix / safe[..., :, None] / safe[..., None, :])
    inflation = (vectors**2 / np.maximum(mu, 1e-14)[..., None, :]).sum(axis=-1)
    return np.where(diagonal > 0, np.minimum(1.0 / inflation, 1.0), 0.0)


def _diagonal(matrices: Floats) -> Floats:
    """Return the diagonals (..., k) of matrices (..., k, k)."""
    return np.diagonal(matrices, axis1=-2, axis2=-1)


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Return the products (..., m) of matrices (..., m, k) with vectors (..., k)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def _outer(vectors: Floats) -> Floats:
    """Return the products of vectors (..., k) with themselves; (..., k, k)."""
    return np.asarray(vectors[..., :, None] * vectors[..., None, :])


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
        The data alone separate this parameter from all others.
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
    return float(_residual_sums(gram, change))


def _residual_sums(gram: Floats, change: Floats) -> Floats:
    """Return `residual_sum` of matrices (..., parameter + 1, parameter + 1); (...)."""
    slope = 2.0 * gram[..., :-1, -1] + _times(gram[..., :-1, :-1], change)
    return np.asarray(np.maximum(gram[..., -1, -1] + (slope * change).sum(axis=-1), 0.0))


def posterior(gram: Floats, count: float, prior: Floats, prior_sigma: Floats) -> tuple[Floats, Floats, float]:
    """Return the posterior's maximum, its covariance and the least information, for white residuals.

    Parameters
    ----------
    gram, count, prior, prior_sigma
        As in `solve`.
    """
    matrix, cross = gram[:-1, :-1], gram[:-1, -1]
    score = prior_sigma * (matrix @ prior + cross)
    value, variance = prior, 1.0
    own, vectors = _information(matrix, prior_sigma)
    seen = np.where(own > 0, vectors.T @ score, 0.0)
    for _ in range(2):
        variance = float(_variance(gram, value, count))
        shrink = 1.0 / (1.0 + own / variance)
        value = prior - prior_sigma * (vectors @ (shrink * seen)) / variance
    inverse = (vectors * shrink) @ vectors.T
    free = prior_sigma > 0
    least = float(own[-int(free.sum())]) / variance if free.any() else np.inf
    return value, inverse * np.outer(prior_sigma, prior_sigma), least


def fit_white(gram: Floats, count: float, prior_sigma: Floats) -> tuple[Floats, float]:
    """Return values with the prior 0 +- `prior_sigma` and the residual variance, for white residuals.

    Exact for columns and priors of any size, where `posterior` works in units of the prior.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Of [X | y], scaled columns, nT^2.
    count : float
        Sum of the weights.
    prior_sigma : ndarray, shape (parameter,)
        Scaled; 0 fixes a parameter.

    Returns
    -------
    value : ndarray, shape (parameter,)
    variance : float
        That weighed the prior in the last of two passes, nT^2.
    """
    value, variance = np.zeros_like(prior_sigma), 0.0
    with np.errstate(divide="ignore"):
        known = 1.0 / prior_sigma**2
    for _ in range(2):
        variance = max(residual_sum(gram, value), 1e-30) / max(count, 1.0)
        value = -solve_scaled(gram[:-1, :-1], gram[:-1, -1], 0.0, variance * known)
    return value, variance


def _information(matrix: Floats, prior_sigma: Floats) -> tuple[Floats, Floats]:
    """Return information (..., k) (nT^2, ascending) and its directions in units of prior sigma (..., k, k).

    The rounding of sums of squares must not pass for information.
    """
    own, vectors = eigen_of_symmetric(matrix * _outer(prior_sigma))
    sizes = prior_sigma * np.sqrt(np.clip(_diagonal(matrix), 0.0, None))
    parts = _times(np.abs(vectors).swapaxes(-1, -2), sizes)
    largest = 0.125 * np.maximum(own[..., -1:], 0.0)
    rounding = SOLVER_SETTINGS.rounding * np.maximum(parts**2, largest)
    return np.where(own > rounding, own, 0.0), vectors


def solve(
    gram: Floats,
    scatter: Floats,
    count: float,
    prior: Floats,
    prior_sigma: Floats,
    least: float = SOLVER_SETTINGS.min_information,
) -> Solution:
    """Solve ``min |y + X d|^2`` with a Gaussian prior on d.

    Parameters
    ----------
    gram : ndarray, shape (parameter + 1, parameter + 1)
        Weighted Gram matrix of [X | y], scaled columns, nT^2.
    scatter : ndarray, shape (parameter, parameter)
        Long-run scatter of the scores ``X^T y``, which contains the correlation of the residuals.
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
    counts = np.array([count], dtype=np.float64)
    return solve_each(gram[None], scatter[None], counts, prior[None], prior_sigma[None], least)[0]


def solve_each(
    grams: Floats,
    scatters: Floats,
    counts: Floats,
    priors: Floats,
    prior_sigmas: Floats,
    least: float = SOLVER_SETTINGS.min_information,
) -> list[Solution]:
    """Solve many equations, each for itself, together: a quarter of the time of one by one.

    Parameters
    ----------
    grams, scatters, counts, priors, prior_sigmas : ndarray, shape (equations, ...)
        As in `solve`.

    Returns
    -------
    list of Solution
        None depends on the others.
    """
    matrices, crosses = grams[:, :-1, :-1], grams[:, :-1, -1]
    values, variances = priors.copy(), _variance(grams, priors, counts)
    information = _information(matrices, prior_sigmas)
    slopes = _times(matrices, priors) + crosses
    found: dict[int, _Directions] = {}
    left = np.arange(len(grams))
    for _ in range(SOLVER_SETTINGS.variance_passes):
        known = (information[0][left], information[1][left])
        now = _directions(known, scatters[left], variances[left], prior_sigmas[left], least)
        values[left] = _posterior(now, priors[left], slopes[left], prior_sigmas[left])
        found |= zip(left.tolist(), now.each(), strict=True)
        before, after = variances[left], _variance(grams[left], values[left], counts[left])
        variances[left] = after
        # A prior that is far off makes the residual look noisy and hides directions; less at each pass.
        left = left[np.abs(before - after) > 1e-6 * after]
        if not left.size:
            break
    wide = prior_sigmas * SOLVER_SETTINGS.wide
    alone = _directions(_information(matrices, wide), scatters, variances, wide, least).covariance(wide)
    sigmas = np.sqrt(np.clip(_diagonal(alone), 0.0, None))
    determined = (sigmas <= SOLVER_SETTINGS.determined * prior_sigmas) & (prior_sigmas > 0)
    retained = retained_fraction(matrices)
    moved = np.abs(values - priors) > 1e-9 * np.maximum(prior_sigmas, 1e-300)
    return [
        Solution(
            values[place],
            one.covariance(prior_sigmas[place]),
            determined=determined[place],
            retained=retained[place],
            moved=moved[place],
            directions=one.vectors[:, one.known].T[::-1],
            variance=float(variances[place]),
            inflation=median_of_finite(one.inflation[one.known]) if one.known.any() else 1.0,
        )
        for place, one in sorted(found.items())
    ]


@dataclass(frozen=True)
class _Directions:
    """Independent directions of the data's information, in units of prior sigma; of one or many equations.

    `white` (..., k) is the information for uncorrelated residuals, `inflation` (..., k) how many times less
    there is along each direction: a drift spoils the mean of a day more than its slopes.
    """

    vectors: Floats
    white: Floats
    inflation: Floats
    noise: Floats
    variance: Floats
    least: float

    @property
    def information(self) -> Floats:
        return self.white / self.inflation

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        return self.information >= self.least

    def each(self) -> Iterator[_Directions]:
        """Yield the directions of each of many equations."""
        arrays = (self.vectors, self.white, self.inflation, self.noise, self.variance)
        for one in zip(*arrays, strict=True):
            yield _Directions(*one, least=self.least)

    def covariance(self, prior_sigma: Floats) -> Floats:
        """Covariance of the posterior's maximum, sandwiched; scaled."""
        shrink = 1.0 / (1.0 + self.information)
        of_prior, of_noise = np.where(self.known, shrink, 1.0), np.where(self.known, shrink, 0.0)
        gain = of_noise / self.inflation
        spread = gain[..., :, None] * self.noise * gain[..., None, :]
        places = np.arange(shrink.shape[-1])
        spread[..., places, places] += of_prior**2
        turned = self.vectors @ spread @ self.vectors.swapaxes(-1, -2)
        return np.asarray(prior_sigma[..., :, None] * turned * prior_sigma[..., None, :])


def _directions(
    information: tuple[Floats, Floats], scatter: Floats, variance: Floats, prior_sigma: Floats, least: float
) -> _Directions:
    """Return the directions of `_information`, with the noise of the scores' scatter along them."""
    white, vectors = information
    white = white / variance[..., None]
    noise = vectors.swapaxes(-1, -2) @ (scatter * _outer(prior_sigma)) @ vectors
    noise /= variance[..., None, None] ** 2
    # Few sub-blocks can show less scatter than uncorrelated residuals have; that is chance.
    own = np.clip(_diagonal(noise), 0.0, None)
    short = own < white
    noise[short[..., :, None] | short[..., None, :]] = 0.0
    places = np.arange(white.shape[-1])
    noise[..., places, places] += np.where(short, white, 0.0)
    inflation = np.divide(own, white, out=np.ones_like(white), where=white > 0)
    return _Directions(vectors, white, np.maximum(inflation, 1.0), noise, variance, least)


def _posterior(found: _Directions, prior: Floats, slope: Floats, prior_sigma: Floats) -> Floats:
    """Return the maximum of the posterior; directions that the prior determines better stay."""
    score = -_times(found.vectors.swapaxes(-1, -2), prior_sigma * slope)
    part = score / found.variance[..., None] / found.inflation / (1.0 + found.information)
    step = np.where(found.known, part, 0.0)
    return np.asarray(prior + prior_sigma * _times(found.vectors, step))


def _variance(gram: Floats, change: Floats, count: Floats | float) -> Floats:
    """Return the variance of the residual after a scaled change, nT^2."""
    free = np.maximum(count - change.shape[-1], 1.0)
    return np.asarray(np.maximum(_residual_sums(gram, change) / free, SOLVER_SETTINGS.smallest_variance))
