"""Ambient and stray field in two sensors that both measure both: the matrix, the leak, and their moments.

``B_out = B + M e`` and ``d = B_in - B_out = L B + e``: the *matrix* M takes the stray part e of the
difference to the outboard sensor, the *leak* L is what badly aligned or scaled sensors let through of the
ambient field B. Takes cells of [B_out, d] (`readings.Cells`); makes both matrices with covariances.

The two fields are independent. In every cell of time and scale they are uncorrelated, while their sizes
differ from cell to cell: the spacecraft switches where the ambient field is quiet, the ambient field changes
where the spacecraft rests. That identifies both matrices, by Gaussian maximum likelihood with the variances
of each cell (Pham and Cardoso 2001, IEEE Trans. Signal Process. 49); where all cells have the same proportion
it does not, and the covariance is large.

Row k of the matrix is then regressed from the outboard reading's axis k on the stray part of the difference,
each cell weighted by the ambient field's variance there (`SecondMoments`). The noise of the difference is
subtracted from its squares, else the matrix comes out too small; the noise stays in the regression's error,
and so does ambient field that leaks into the difference. Where the ambient field hides everything the prior
remains.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.dual.readings import Cells


@dataclass(frozen=True, kw_only=True)
class MixingSettings:
    """Numbers of the fit of matrix and leak.

    Attributes
    ----------
    loud_difference, loud_outboard : float
        A cell is used when the power of its difference, or of its outboard reading, is at least so many times
        that of the difference's noise. Assumed.
    quiet_difference : float
        The sensors' shares of the noise are estimated where the difference has less than so many times its
        noise. Assumed.
    share_sigma : float
        Prior standard deviation of the outboard sensor's share of the noise about a half. Assumed.
    share_range : (float, float)
        That share is within these. Assumed: neither sensor is without noise.
    prior_sigmas : float
        Prior standard deviations that a fit of the leak may go: farther the leak could stand for the matrix.
        Level of significance.
    own_contrasts : float
        Contrasts, of the size of the noise, that are added to those of a cell's variance. Assumed:
        ambient and stray field cancel by chance in a few cells.
    leak_parts : int
        Parts of the record whose scatter widens the covariance of the leak. Assumed.
    rounds : int
        Rounds of weighting cells by the ambient field. Assumed.
    observed_square : float
        Weighted square of the difference along a direction that determines the matrix at all. Assumed.
    noise_uncertainty : float
        The noise is known to this part. Assumed.
    blocks : int
        Blocks of time whose scatter widens the covariance of the matrix. Assumed.
    neighbours : int
        Neighbouring cells of a scale whose ambient field is about as large. Assumed.
    """

    loud_difference: float = 6.0
    loud_outboard: float = 10.0
    quiet_difference: float = 1.5
    share_sigma: float = 0.3
    share_range: tuple[float, float] = (0.02, 0.98)
    prior_sigmas: float = 3.0
    own_contrasts: float = 1.0
    leak_parts: int = 6
    rounds: int = 6
    observed_square: float = 0.1
    noise_uncertainty: float = 0.1
    blocks: int = 24
    neighbours: int = 5


MIXING_SETTINGS = MixingSettings()

#: A basis of all matrices, row by row.
ELEMENTS = np.eye(9).reshape(9, 3, 3)


@dataclass(frozen=True)
class DifferenceNoise:
    """White noise of the difference and how much of it is the outboard sensor's.

    Attributes
    ----------
    covariance : ndarray, shape (3, 3)
        Of the difference, nT^2.
    share, share_sigma : float
        Part of it that is the outboard sensor's: it is in both series, with opposite sign.
    """

    covariance: Floats
    share: float
    share_sigma: float

    @property
    def floor(self) -> Floats:
        """Least variance of the outboard reading, nT^2; (axis,)."""
        return np.maximum(self.share * np.diag(self.covariance), 1e-12)


def difference_noise(cells: Cells, covariance: Floats, leak_sigma: float = 0.0) -> DifferenceNoise:
    """Return the noise of the difference with the share of it that is the outboard sensor's.

    Outboard reading and difference share it with opposite sign, which their covariance on the shortest scale
    shows; the median over cells, lest a few that switch decide. A half where the ambient field hides it: so
    does what may leak of it, in all cells with the same sign.

    Parameters
    ----------
    covariance : ndarray, shape (3, 3)
        Of the white noise of d, nT^2.
    leak_sigma : float
        Standard deviation of the elements of the leak.
    """
    total_noise = float(np.trace(covariance))
    quiet = np.einsum("cii->c", cells.covariance[:, 3:, 3:]) < MIXING_SETTINGS.quiet_difference * total_noise
    first = cells.select((cells.scale == 1) & quiet)
    variance = np.diag(covariance)
    if len(first) < 4 or not np.all(variance > 0):
        return DifferenceNoise(covariance, 0.5, MIXING_SETTINGS.share_sigma)
    found = -np.einsum("cii->ci", first.covariance[:, :3, 3:]) / variance
    median = np.median(found, axis=0)
    spread = 1.4826 * np.median(np.abs(found - median), axis=0) * 1.25 / np.sqrt(len(first)) + 1e-6
    spread += leak_sigma * np.median(np.einsum("cii->ci", first.covariance[:, :3, :3]), axis=0) / variance
    weight, prior = 1.0 / spread**2, 1.0 / MIXING_SETTINGS.share_sigma**2
    total = float(weight.sum()) + prior
    share = np.clip((float(weight @ median) + 0.5 * prior) / total, *MIXING_SETTINGS.share_range)
    return DifferenceNoise(covariance, float(share), 1.0 / np.sqrt(total))


def usable_cells(cells: Cells, noise: DifferenceNoise) -> Cells:
    """Return the cells with more than noise in them, their shared noise taken out."""
    size = np.einsum("cii->ci", cells.covariance)
    level = max(float(np.trace(noise.covariance)), 1e-300)
    use = size[:, 3:].sum(axis=1) > MIXING_SETTINGS.loud_difference * level
    use |= size[:, :3].sum(axis=1) > MIXING_SETTINGS.loud_outboard * level
    kept = cells.select(use)
    covariance = kept.covariance.copy()
    covariance[:, :3, 3:] += noise.share * noise.covariance
    covariance[:, 3:, :3] += noise.share * noise.covariance
    # The products of a cell may not allow for the whole of it: correlations stay below one.
    size = np.sqrt(np.einsum("cii->ci", covariance)) + 1e-300
    most = 0.999999 * size[:, :, None] * size[:, None, :]
    bounded = np.where(~np.eye(6, dtype=bool), np.clip(covariance, -most, most), covariance)
    return Cells(bounded, kept.count, kept.scale, kept.row)


@dataclass(frozen=True)
class Mixing:
    """Both matrices and how well they are known.

    Attributes
    ----------
    matrix, leak : ndarray, shape (3, 3)
        M and L.
    leak_covariance : ndarray, shape (9, 9)
        Of the elements of L, row by row.
    share : float
        Part of the white noise of d that is the outboard sensor's.
    """

    matrix: Floats
    leak: Floats
    leak_covariance: Floats
    share: float

    def ambient_rows(self) -> Floats:
        """Return the rows that make ``B`` of [B_out, d]; (3, 6)."""
        inverse = np.linalg.inv(np.eye(3) - self.matrix @ self.leak)
        return np.asarray(inverse @ np.concatenate([np.eye(3), -self.matrix], axis=1))

    def stray_rows(self) -> Floats:
        """Return the rows that make ``e`` of [B_out, d]; (3, 6)."""
        inverse = np.linalg.inv(np.eye(3) - self.leak @ self.matrix)
        return np.asarray(inverse @ np.concatenate([-self.leak, np.eye(3)], axis=1))


def fit_mixing(
    cells: Cells, noise: DifferenceNoise, prior: tuple[Floats, Floats], leak_sigma: float
) -> Mixing:
    """Fit both matrices: the leak where the spacecraft rests, then the matrix in all cells.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d], as `usable_cells` makes them.
    noise : DifferenceNoise
    prior : tuple of ndarray, shapes (9,), (9, 9)
        Prior mean and covariance of the elements of M.
    leak_sigma : float
        Prior standard deviation of the elements of L; 0 when there is none.
    """
    size = np.einsum("cii->ci", cells.covariance)
    # Where the difference holds more than a leak can make, the units' field would be taken for one: it is in
    # the outboard reading, too.
    most = 3.0 * (MIXING_SETTINGS.prior_sigmas * leak_sigma) ** 2
    restful = cells.select(size[:, 3:].sum(axis=1) < most * size[:, :3].sum(axis=1))
    floor = np.maximum(np.concatenate([noise.floor, np.diag(noise.covariance)]), 1e-12)
    leak, leak_covariance = np.zeros((3, 3)), np.zeros((9, 9))
    if leak_sigma > 0:
        leak = _most_likely_leak(restful, floor, prior, leak_sigma)
        leak_covariance = _leak_covariance(restful, prior, leak, leak_sigma)
    mixing = Mixing(prior[0].reshape(3, 3), leak, leak_covariance, noise.share)
    for _ in range(MIXING_SETTINGS.rounds):
        value, _ = second_moments(cells, mixing, noise).solve(ELEMENTS, prior)
        mixing = replace(mixing, matrix=value.reshape(3, 3))
    return mixing


def _most_likely_leak(cells: Cells, floor: Floats, prior: tuple[Floats, Floats], leak_sigma: float) -> Floats:
    """Return the leak of the most likely pair of matrices; (3, 3)."""
    precision = np.linalg.inv(prior[1])
    start = np.concatenate([prior[0], np.zeros(9)])
    spread = np.concatenate([np.sqrt(np.diag(prior[1])), np.full(9, leak_sigma)])
    known = np.diag(_information(cells, prior[0].reshape(3, 3), np.zeros((3, 3))))
    # Steps of the size of the errors: the likelihood is then about as wide in every direction.
    unit = 1.0 / np.sqrt(known + 1.0 / spread**2)

    def cost(scaled: Floats) -> tuple[float, Floats]:
        value = start + scaled * unit
        total, gradient = _likelihood(cells, floor, value[:9].reshape(3, 3), value[9:].reshape(3, 3))
        away = value[:9] - prior[0]
        gradient[:9] += 2.0 * precision @ away
        gradient[9:] += 2.0 * value[9:] / leak_sigma**2
        total += float(away @ precision @ away + np.sum((value[9:] / leak_sigma) ** 2))
        return total, gradient * unit

    limits = [(-most, most) for most in (MIXING_SETTINGS.prior_sigmas * spread / unit).tolist()]
    zero = np.zeros(start.size)
    best = scipy.optimize.minimize(
        cost, zero, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 300}
    ).x
    return np.asarray((start + best * unit)[9:].reshape(3, 3))


def _likelihood(cells: Cells, floor: Floats, matrix: Floats, leak: Floats) -> tuple[float, Floats]:
    """Return minus twice the logarithm of the likelihood, and its gradient by the elements of M and L.

    Sum over cells and axes of the logarithms of the variances of ``B_out - M d`` and ``d - L B_out``, less
    that of the determinant of both rows together.
    """
    unmix = _unmixing(matrix, leak)
    own = MIXING_SETTINGS.own_contrasts
    weight = cells.count + own
    count = float(weight.sum())
    product = cells.covariance @ unmix.T
    contrasts = cells.count[:, None]
    power = np.maximum(np.einsum("cik,ki->ck", product, unmix), 0.0)
    variance = np.asarray((contrasts * power + own * floor) / (contrasts + own))
    sign, logarithm = np.linalg.slogdet(unmix)
    if sign <= 0:
        return 1e30, np.zeros(18)
    total = float(weight @ np.log(variance).sum(axis=1)) - 2.0 * count * logarithm
    gradient = 2.0 * np.einsum("ck,cik->ki", cells.count[:, None] / variance, product)
    gradient -= 2.0 * count * np.linalg.inv(unmix).T
    return total, np.concatenate([-gradient[:3, 3:].ravel(), -gradient[3:, :3].ravel()])


def _unmixing(matrix: Floats, leak: Floats) -> Floats:
    """Return the rows that make ``B_out - M d`` and ``d - L B_out`` of [B_out, d]; (6, 6)."""
    return np.block([[np.eye(3), -matrix], [-leak, np.eye(3)]])


def _information(cells: Cells, matrix: Floats, leak: Floats) -> Floats:
    """Return Fisher's information on the elements of M and L, small products of both left out."""
    unmix = _unmixing(matrix, leak)
    own = unmix @ cells.covariance @ unmix.T
    out = np.zeros((18, 18))
    variance = np.maximum(np.einsum("cii->ci", own), 1e-300)
    # The mean of one over a variance from n contrasts is larger than one over its mean, by n / (n - 2).
    count = np.maximum(cells.count - 2.0, 0.0)
    for axis in range(3):
        rows = slice(3 * axis, 3 * axis + 3)
        out[rows, rows] = np.einsum("c,cij->ij", count / variance[:, axis], own[:, 3:, 3:])
        rows = slice(9 + 3 * axis, 12 + 3 * axis)
        out[rows, rows] = np.einsum("c,cij->ij", count / variance[:, 3 + axis], own[:, :3, :3])
        for other in range(3):
            out[3 * axis + other, 9 + 3 * other + axis] = cells.count.sum()
            out[9 + 3 * other + axis, 3 * axis + other] = cells.count.sum()
    return out


def _leak_covariance(cells: Cells, prior: tuple[Floats, Floats], leak: Floats, sigma: float) -> Floats:
    """Return the covariance of the leak's elements (9, 9), the matrix known by its prior only.

    It is widened by the variance of the leak's score between long parts of the record over the stated one:
    slow noise is in many cells at once.
    """
    matrix = prior[0].reshape(3, 3)
    information = _information(cells, matrix, leak)
    unmix = _unmixing(matrix, leak)
    unmixed = unmix @ cells.covariance @ unmix.T
    variance = np.maximum(np.einsum("cii->ci", unmixed)[:, 3:], 1e-300)
    score = (cells.count[:, None] / variance)[:, :, None] * unmixed[:, 3:, :3]
    parts = MIXING_SETTINGS.leak_parts
    sums = np.zeros((parts, 9))
    np.add.at(sums, cells.blocks(parts), score.reshape(-1, 9))
    sums -= sums.mean(axis=0)
    stated = np.linalg.pinv(information[9:, 9:], hermitian=True)
    scatter = float(np.einsum("pi,ij,pj->", sums, stated, sums)) / 9.0 * parts / (parts - 1)
    information /= max(scatter, 1.0)
    information[:9, :9] += np.linalg.inv(prior[1])
    information[9:, 9:] += np.eye(9) / sigma**2
    value, vector = np.linalg.eigh(information)
    return np.asarray((vector / np.maximum(value, 1e-3 / sigma**2)) @ vector.T)[9:, 9:]


class WhitenedRows(NamedTuple):
    """Rows of the matrix as a regression with errors of size one: ``target[k] = design[k] matrix[k]``."""

    design: Floats  # (axis, 3, 3)
    target: Floats  # (axis, 3)


@dataclass(frozen=True)
class SecondMoments:
    """Weighted sums over cells for each axis of the outboard sensor, in blocks of time.

    Attributes
    ----------
    square : ndarray, shape (block, axis, 3, 3)
        Of the stray part of the difference.
    cross : ndarray, shape (block, axis, 3)
        Of it with the outboard reading.
    noise : ndarray, shape (block, axis, 3, 3)
        The white noise's part of the squares.
    error : ndarray, shape (axis, 3, 3)
        Covariance of what leak and shared noise add to the sum of `cross`.
    """

    square: Floats
    cross: Floats
    noise: Floats
    error: Floats

    def solve(self, basis: Floats, prior: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
        """Return the factors of matrices that explain the outboard field, and their covariance.

        The covariance is widened by what blocks of time disagree beyond it: units of different places, which
        no one matrix describes, show there.

        Parameters
        ----------
        basis : ndarray, shape (parameter, 3, 3)
        prior : tuple of ndarray, shapes (9,), (9, 9)
            Prior mean and covariance of the elements of the matrix, row by row.
        """
        flat = basis.reshape(len(basis), 9)
        first, _ = self._regressed(basis, prior, self.whitened(prior[0].reshape(3, 3), 1.0))
        matrix = (first @ flat).reshape(3, 3)
        return self._regressed(basis, prior, self.whitened(matrix, self.excess(matrix)))

    def _regressed(
        self, basis: Floats, prior: tuple[Floats, Floats], rows: WhitenedRows
    ) -> tuple[Floats, Floats]:
        flat = basis.reshape(len(basis), 9)
        precision = np.linalg.inv(prior[1])
        total = flat @ precision @ flat.T
        right = flat @ precision @ prior[0]
        for axis in range(3):
            design = rows.design[axis] @ basis[:, axis].T
            total += design.T @ design
            right += design.T @ rows.target[axis]
        covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
        return covariance @ right, covariance

    def whitened(self, matrix: Floats, excess: float) -> WhitenedRows:
        """Return the regression of all rows with errors of size one about a matrix; `excess` widens them.

        The squares are those less their noise: none is below zero, or above the whole.
        """
        design, target = np.empty((3, 3, 3)), np.empty((3, 3))
        for axis in range(3):
            whole, noise = self.square[:, axis].sum(axis=0), self.noise[:, axis].sum(axis=0)
            value, vector = np.linalg.eigh(whole)
            root = vector * np.sqrt(np.maximum(value, 1e-12))
            inverse = vector / np.sqrt(np.maximum(value, 1e-12))
            share, rotation = np.linalg.eigh(inverse.T @ (whole - noise) @ inverse)
            without_noise = root @ (rotation * np.clip(share, 0.0, 1.0)) @ rotation.T @ root.T
            of_noise = MIXING_SETTINGS.noise_uncertainty * noise @ matrix[axis]
            spread = whole + self.error[axis] + np.outer(of_noise, of_noise)
            value, vector = np.linalg.eigh(excess * spread)
            whiten = (vector / np.sqrt(np.maximum(value, 1e-12))).T
            design[axis] = whiten @ without_noise
            target[axis] = whiten @ self.cross[:, axis].sum(axis=0)
        return WhitenedRows(design, target)

    def scatter(self, matrix: Floats) -> float:
        """Return the variance of an element of the matrix between blocks of time, beyond chance.

        Units of different places have different matrices; the one that switches now is not the mean of all.
        """
        extra = power = 0.0
        for axis in range(3):
            for one, square in zip(self._scores(axis, matrix[axis]), self.square[:, axis], strict=True):
                value, vector = np.linalg.eigh(square)
                observed = value > MIXING_SETTINGS.observed_square
                chi2 = float(np.sum((vector.T @ one)[observed] ** 2 / value[observed]))
                extra += chi2 - float(observed.sum())
                power += float(value[observed].sum())
        return max(extra, 0.0) / power if power > 0 else 0.0

    def excess(self, matrix: Floats) -> float:
        """Return the variance between blocks of time over what the squares state; at least 1."""
        found = 0.0
        for axis in range(3):
            score = self._scores(axis, matrix[axis])
            middle = score.T @ score - np.outer(score.sum(axis=0), score.sum(axis=0)) / len(score)
            stated = np.linalg.pinv(self.square[:, axis].sum(axis=0), hermitian=True)
            found += float(np.trace(middle @ stated)) / 9.0
        return max(found, 1.0)

    def _scores(self, axis: int, row: Floats) -> Floats:
        """Return the gradient of each block's sum of squares by a row of the matrix; (block, 3)."""
        return np.asarray(self.cross[:, axis] - (self.square[:, axis] - self.noise[:, axis]) @ row)


def second_moments(cells: Cells, mixing: Mixing, noise: DifferenceNoise) -> SecondMoments:
    """Return the second moments that determine the matrix, weighted by the ambient field of a mixing.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d].
    mixing : Mixing
    noise : DifferenceNoise
    """
    ambient, stray = mixing.ambient_rows(), mixing.stray_rows()
    product = cells.covariance @ stray.T
    square, cross = stray @ product, product[:, :3]
    field = ambient @ cells.covariance @ ambient.T
    # The noise that both series share is out of the cells, but it is in the residual of the reading.
    both = np.diag(ambient[:, :3] @ (noise.share * noise.covariance) @ ambient[:, 3:].T)
    variance = np.maximum(np.einsum("ckk->ck", field) - 2.0 * both, noise.floor)
    # Half a cell's own variance, half that around it on the same scale: by its own alone a cell in which
    # ambient and stray field cancel by chance would count for many.
    smooth = variance.copy()
    for scale in np.unique(cells.scale):
        here = np.flatnonzero(cells.scale == scale)
        around = scipy.ndimage.uniform_filter1d(
            variance[here], MIXING_SETTINGS.neighbours, axis=0, mode="nearest"
        )
        smooth[here] = 0.5 * variance[here] + 0.5 * around
    weight = cells.count[:, None] / smooth
    blocks = MIXING_SETTINGS.blocks
    block = cells.blocks(blocks)
    sums, crosses = np.zeros((blocks, 3, 3, 3)), np.zeros((blocks, 3, 3))
    weights = np.zeros((blocks, 3))
    np.add.at(sums, block, weight[:, :, None, None] * square[:, None])
    np.add.at(crosses, block, weight[:, :, None] * cross)
    np.add.at(weights, block, weight)
    # Ambient field left in the difference is regressed on itself, and on other axes correlated with it.
    leaked = np.einsum("ck,ckj->kj", weight, field)
    covariance = mixing.leak_covariance.reshape(3, 3, 3, 3)
    error = np.einsum("kj,kl,ijml->kim", leaked, leaked, covariance)
    shared = noise.share_sigma * np.einsum("k,ki->ki", weight.sum(axis=0), noise.covariance)
    error = error + np.einsum("ki,kj->kij", shared, shared)
    return SecondMoments(sums, crosses, weights[:, :, None, None] * noise.covariance, error)
