"""Ambient field and stray field told apart in two sensors that both see both.

``B_out = B + M e`` and ``d = B_in - B_out = L B + e``: the matrix M takes the stray part e of the difference
to the outboard sensor, the leak L is what badly aligned or scaled sensors let through of the ambient field.
The two fields do not know of each other. In every cell of time and scale they are uncorrelated, while their
sizes differ from cell to cell: the spacecraft switches where the ambient field is quiet, the ambient field
moves where the spacecraft rests. That is enough to find both matrices, by Gaussian maximum likelihood with
the variances of each cell as they come (Pham and Cardoso 2001, IEEE Trans. Signal Process. 49); where all
cells have the same proportion it is not, and the covariance says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from inflight.arrays import Floats
from inflight.dual.moments import ELEMENTS, Moments, Noise, moments
from inflight.dual.scales import Cells

#: A cell whose difference is not this many times its noise (nor its outboard reading that many times)
#: knows of no matrix.
_LOUD_DIFFERENCE, _LOUD_OUTBOARD = 6.0, 10.0
#: The sensors' shares of the noise are seen where the difference is less than this many times its noise.
_QUIET = 1.5
#: Standard deviation of the outboard sensor's part of the noise about a half, before anything is seen.
_SHARE = 0.3
#: Standard deviations of what is known before that a fit may go.
_FAR = 3.0
#: Contrasts that a cell's variances are taken to have beside its own, of the size of the noise.
_OWN = 1.0
#: Parts of the record whose scatter tells how far the leak's likelihood can be believed.
_PARTS = 6
#: How often the cells are weighed anew.
_TURNS = 6


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


def usable_cells(cells: Cells, noise: Noise) -> Cells:
    """Return the cells with more than noise in them, their shared noise taken out."""
    size = np.einsum("cii->ci", cells.covariance)
    level = max(float(np.trace(noise.covariance)), 1e-300)
    use = size[:, 3:].sum(axis=1) > _LOUD_DIFFERENCE * level
    use |= size[:, :3].sum(axis=1) > _LOUD_OUTBOARD * level
    kept = cells.part(use)
    covariance = kept.covariance.copy()
    covariance[:, :3, 3:] += noise.share * noise.covariance
    covariance[:, 3:, :3] += noise.share * noise.covariance
    # The products of a cell need not allow for the whole of it.
    return Cells(_bounded(covariance), kept.count, kept.scale, kept.row)


def _bounded(covariance: Floats) -> Floats:
    """Return covariances whose correlations are below one."""
    size = np.sqrt(np.einsum("cii->ci", covariance)) + 1e-300
    most = 0.999999 * size[:, :, None] * size[:, None, :]
    off = ~np.eye(6, dtype=bool)
    return np.where(off, np.clip(covariance, -most, most), covariance)


def noise_of(cells: Cells, covariance: Floats, leak_sigma: float = 0.0) -> Noise:
    """Return the noise of the difference with the part of it that is the outboard sensor's, 0.02 to 0.98.

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
    quiet = np.einsum("cii->c", cells.covariance[:, 3:, 3:]) < _QUIET * float(np.trace(covariance))
    first = cells.part((cells.scale == 1) & quiet)
    variance = np.diag(covariance)
    if len(first) < 4 or not np.all(variance > 0):
        return Noise(covariance, 0.5, _SHARE)
    found = -np.einsum("cii->ci", first.covariance[:, :3, 3:]) / variance
    middle = np.median(found, axis=0)
    spread = 1.4826 * np.median(np.abs(found - middle), axis=0) * 1.25 / np.sqrt(len(first)) + 1e-6
    spread += leak_sigma * np.median(np.einsum("cii->ci", first.covariance[:, :3, :3]), axis=0) / variance
    weight, prior = 1.0 / spread**2, 1.0 / _SHARE**2
    total = float(weight.sum()) + prior
    share = np.clip((float(weight @ middle) + 0.5 * prior) / total, 0.02, 0.98)
    return Noise(covariance, float(share), 1.0 / np.sqrt(total))


def fit_mixing(cells: Cells, noise: Noise, prior: tuple[Floats, Floats], leak_sigma: float) -> Mixing:
    """Fit both matrices: the leak where the spacecraft rests, then the matrix in all cells.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d], as `usable_cells` makes them.
    noise : Noise
    prior : tuple of ndarray, shapes (9,), (9, 9)
        Mean and covariance of the elements of M before anything is seen.
    leak_sigma : float
        Standard deviation of the elements of L before anything is seen; 0 when there is none.
    """
    size = np.einsum("cii->ci", cells.covariance)
    # Where the difference holds more than a leak can make, the units' field would be taken for one: it stands
    # in the outboard reading, too.
    most = 3.0 * (_FAR * leak_sigma) ** 2
    restful = cells.part(size[:, 3:].sum(axis=1) < most * size[:, :3].sum(axis=1))
    floor = np.maximum(np.concatenate([noise.floor, np.diag(noise.covariance)]), 1e-12)
    leak, of_leak = np.zeros((3, 3)), np.zeros((9, 9))
    if leak_sigma > 0:
        leak = _most_likely(restful, floor, prior, leak_sigma)
        of_leak = _leak_covariance(restful, prior, leak, leak_sigma)
    now = Mixing(prior[0].reshape(3, 3), leak, of_leak, noise.share)
    for _ in range(_TURNS):
        value, _ = moments_of(cells, now, noise).solve(ELEMENTS, prior)
        now = replace(now, matrix=value.reshape(3, 3))
    return now


def moments_of(cells: Cells, now: Mixing, noise: Noise) -> Moments:
    """Return what cells say of the matrix, weighted by the ambient field that a mixing tells."""
    return moments(cells, (now.ambient_rows(), now.stray_rows()), noise, now.leak_covariance)


def _most_likely(cells: Cells, floor: Floats, prior: tuple[Floats, Floats], leak_sigma: float) -> Floats:
    """Return the leak of the most likely pair of matrices; (3, 3)."""
    precision = np.linalg.inv(prior[1])
    start = np.concatenate([prior[0], np.zeros(9)])
    spread = np.concatenate([np.sqrt(np.diag(prior[1])), np.full(9, leak_sigma)])
    known = np.diag(_information(cells, prior[0].reshape(3, 3), np.zeros((3, 3))))
    # Steps of the size that the cells tell apart: the likelihood is then about as wide in every direction.
    unit = 1.0 / np.sqrt(known + 1.0 / spread**2)

    def cost(scaled: Floats) -> tuple[float, Floats]:
        value = start + scaled * unit
        total, slope = _likelihood(cells, floor, value[:9].reshape(3, 3), value[9:].reshape(3, 3))
        away = value[:9] - prior[0]
        slope[:9] += 2.0 * precision @ away
        slope[9:] += 2.0 * value[9:] / leak_sigma**2
        total += float(away @ precision @ away + np.sum((value[9:] / leak_sigma) ** 2))
        return total, slope * unit

    # So far and no further: beyond it the leak could stand for the matrix.
    limits = [(-far, far) for far in (_FAR * spread / unit).tolist()]
    nothing = np.zeros(start.size)
    best = minimize(cost, nothing, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": 300}).x
    return np.asarray((start + best * unit)[9:].reshape(3, 3))


def _leak_covariance(restful: Cells, prior: tuple[Floats, Floats], leak: Floats, sigma: float) -> Floats:
    """Return the covariance of the leak's elements, the matrix being known as little as before.

    It is widened by what long parts of the record disagree: slow noise is in many cells at once.
    """
    matrix = prior[0].reshape(3, 3)
    information = _information(restful, matrix, leak)
    information /= _excess(restful, matrix, leak, information[9:, 9:])
    information[:9, :9] += np.linalg.inv(prior[1])
    information[9:, 9:] += np.eye(9) / sigma**2
    value, vector = np.linalg.eigh(information)
    return np.asarray((vector / np.maximum(value, 1e-3 / sigma**2)) @ vector.T)[9:, 9:]


def _excess(cells: Cells, matrix: Floats, leak: Floats, information: Floats) -> float:
    """Return the variance of the leak's score between parts of the record beside what is stated; at least 1.

    Parameters
    ----------
    information : ndarray, shape (9, 9)
        On the elements of the leak.
    """
    unmix = _unmixing(matrix, leak)
    own = unmix @ cells.covariance @ unmix.T
    variance = np.maximum(np.einsum("cii->ci", own)[:, 3:], 1e-300)
    score = (cells.count[:, None] / variance)[:, :, None] * own[:, 3:, :3]
    sums = np.zeros((_PARTS, 9))
    np.add.at(sums, cells.blocks(_PARTS), score.reshape(-1, 9))
    sums -= sums.mean(axis=0)
    stated = np.linalg.pinv(information, hermitian=True)
    scatter = float(np.einsum("pi,ij,pj->", sums, stated, sums)) / 9.0 * _PARTS / (_PARTS - 1)
    return max(scatter, 1.0)


def _unmixing(matrix: Floats, leak: Floats) -> Floats:
    """Return the rows that make ``B_out - M d`` and ``d - L B_out`` of [B_out, d]; (6, 6)."""
    return np.block([[np.eye(3), -matrix], [-leak, np.eye(3)]])


def _variance(values: Floats, cells: Cells, floor: Floats) -> Floats:
    """Return variances of cells (cell, row) with a little of the noise's: a few cancel by chance."""
    own = cells.count[:, None]
    return np.asarray((own * np.maximum(values, 0.0) + _OWN * floor) / (own + _OWN))


def _likelihood(cells: Cells, floor: Floats, matrix: Floats, leak: Floats) -> tuple[float, Floats]:
    """Return minus twice the logarithm of the likelihood, and its slope by the elements of M and L.

    Sum over cells and axes of the logarithms of the variances of ``B_out - M d`` and ``d - L B_out``, less
    that of the determinant of both rows together.
    """
    unmix = _unmixing(matrix, leak)
    weight = cells.count + _OWN
    count = float(weight.sum())
    bent = cells.covariance @ unmix.T
    variance = _variance(np.einsum("cik,ki->ck", bent, unmix), cells, floor)
    sign, logarithm = np.linalg.slogdet(unmix)
    if sign <= 0:
        return 1e30, np.zeros(18)
    total = float(weight @ np.log(variance).sum(axis=1)) - 2.0 * count * logarithm
    slope = 2.0 * np.einsum("ck,cik->ki", cells.count[:, None] / variance, bent)
    slope -= 2.0 * count * np.linalg.inv(unmix).T
    return total, np.concatenate([-slope[:3, 3:].ravel(), -slope[3:, :3].ravel()])


def _information(cells: Cells, matrix: Floats, leak: Floats) -> Floats:
    """Return Fisher's information on the elements of M and L, small products of both left out."""
    unmix = _unmixing(matrix, leak)
    own = unmix @ cells.covariance @ unmix.T
    out = np.zeros((18, 18))
    variance = np.maximum(np.einsum("cii->ci", own), 1e-300)
    # The mean of one over a variance that n contrasts tell is larger than one over its mean, by n / (n - 2).
    told = np.maximum(cells.count - 2.0, 0.0)
    for axis in range(3):
        rows = slice(3 * axis, 3 * axis + 3)
        out[rows, rows] = np.einsum("c,cij->ij", told / variance[:, axis], own[:, 3:, 3:])
        rows = slice(9 + 3 * axis, 12 + 3 * axis)
        out[rows, rows] = np.einsum("c,cij->ij", told / variance[:, 3 + axis], own[:, :3, :3])
        for other in range(3):
            out[3 * axis + other, 9 + 3 * other + axis] = cells.count.sum()
            out[9 + 3 * other + axis, 3 * axis + other] = cells.count.sum()
    return out
