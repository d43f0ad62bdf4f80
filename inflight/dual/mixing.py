"""Ambient/stray separation.

What cells of both sensors say of the matrix from difference to outboard sensor, and how well.

Row k of the matrix is regressed from the outboard reading's axis k on the stray part of the difference, each
cell weighted by the ambient field's variance there. What the difference holds of noise is taken out of its
squares, else the matrix comes out too small; the noise stays in the regression's error, and so does ambient
field that leaks into the difference. Where the ambient field hides everything nothing is said, and what was
known before remains.

Ambient field and stray field told apart in two sensors that both see both.

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
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize

from inflight.arrays import Floats
from inflight.dual.readings import Cells

#: Weighted square of the difference along a direction that tells something of the matrix.
_SEEN = 0.1

#: The noise that both series share is known to this part of the difference's.
_UNSURE = 0.1

#: Blocks of time whose scatter tells how far the variances can be believed.
_BLOCKS = 24

#: Neighbouring cells of a scale whose ambient field is about as lively.
_ALIKE = 5

_LEAST = 1e-12

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
        Part of it that is the outboard sensor's: it stands in both series, with opposite sign.
    """

    covariance: Floats
    share: float
    share_sigma: float

    @property
    def floor(self) -> Floats:
        """Least variance of the outboard reading, nT^2; (axis,)."""
        return np.maximum(self.share * np.diag(self.covariance), 1e-12)


class WhitenedRows(NamedTuple):
    """Rows of the matrix as a regression with errors of size one: ``wanted[k] = design[k] matrix[k]``."""

    design: Floats  # (axis, 3, 3)
    wanted: Floats  # (axis, 3)


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
            Mean and covariance of the elements of the matrix, row by row, before anything is seen.
        """
        flat = basis.reshape(len(basis), 9)
        first, _ = self._regressed(basis, prior, self.whitened(prior[0].reshape(3, 3), 1.0))
        matrix = (first @ flat).reshape(3, 3)
        return self._regressed(basis, prior, self.whitened(matrix, self.excess(matrix)))

    def _regressed(
        self, basis: Floats, prior: tuple[Floats, Floats], told: WhitenedRows
    ) -> tuple[Floats, Floats]:
        flat = basis.reshape(len(basis), 9)
        precision = np.linalg.inv(prior[1])
        total = flat @ precision @ flat.T
        right = flat @ precision @ prior[0]
        for axis in range(3):
            design = told.design[axis] @ basis[:, axis].T
            total += design.T @ design
            right += design.T @ told.wanted[axis]
        covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
        return covariance @ right, covariance

    def whitened(self, matrix: Floats, excess: float) -> WhitenedRows:
        """Return the regression of all rows with errors of size one about a matrix; `excess` widens them."""
        clear = self._clear()
        design, wanted = np.empty((3, 3, 3)), np.empty((3, 3))
        for axis in range(3):
            unsure = _UNSURE * self.noise[:, axis].sum(axis=0) @ matrix[axis]
            spread = self.square[:, axis].sum(axis=0) + self.error[axis] + np.outer(unsure, unsure)
            value, vector = np.linalg.eigh(excess * spread)
            inverse = (vector / np.sqrt(np.maximum(value, _LEAST))).T
            design[axis] = inverse @ clear[axis]
            wanted[axis] = inverse @ self.cross[:, axis].sum(axis=0)
        return WhitenedRows(design, wanted)

    def _clear(self) -> Floats:
        """Return the sums of squares without their noise, (axis, 3, 3): none is below zero, or above all."""
        out = np.empty((3, 3, 3))
        for axis in range(3):
            whole = self.square[:, axis].sum(axis=0)
            value, vector = np.linalg.eigh(whole)
            root = vector * np.sqrt(np.maximum(value, _LEAST))
            inverse = vector / np.sqrt(np.maximum(value, _LEAST))
            share, turn = np.linalg.eigh(inverse.T @ (whole - self.noise[:, axis].sum(axis=0)) @ inverse)
            out[axis] = root @ (turn * np.clip(share, 0.0, 1.0)) @ turn.T @ root.T
        return out

    def scatter(self, matrix: Floats) -> float:
        """Return the variance of an element of the matrix between blocks of time, beyond chance.

        Units of different places have different matrices; the one that switches now is not the mean of all.
        """
        extra = power = 0.0
        for axis in range(3):
            for one, square in zip(self._scores(axis, matrix[axis]), self.square[:, axis], strict=True):
                value, vector = np.linalg.eigh(square)
                seen = value > _SEEN
                extra += float(np.sum((vector.T @ one)[seen] ** 2 / value[seen])) - float(seen.sum())
                power += float(value[seen].sum())
        return max(extra, 0.0) / power if power > 0 else 0.0

    def _scores(self, axis: int, row: Floats) -> Floats:
        return np.asarray(self.cross[:, axis] - (self.square[:, axis] - self.noise[:, axis]) @ row)

    def excess(self, matrix: Floats) -> float:
        """Return the variance between blocks of time beside what the squares state; at least 1."""
        found = 0.0
        for axis in range(3):
            score = self._scores(axis, matrix[axis])
            middle = score.T @ score - np.outer(score.sum(axis=0), score.sum(axis=0)) / len(score)
            stated = np.linalg.pinv(self.square[:, axis].sum(axis=0), hermitian=True)
            found += float(np.trace(middle @ stated)) / 9.0
        return max(found, 1.0)


def moments(cells: Cells, rows: tuple[Floats, Floats], noise: DifferenceNoise, leak: Floats) -> SecondMoments:
    """Return what cells say of the matrix, in blocks of time.

    Parameters
    ----------
    cells : Cells
        Of [B_out, d].
    rows : tuple of ndarray, shape (3, 6) each
        What makes the ambient and the stray field of [B_out, d].
    noise : Noise
    leak : ndarray, shape (9, 9)
        Covariance of the leak's elements, row by row.
    """
    ambient, stray = rows
    bent = cells.covariance @ stray.T
    square, cross = stray @ bent, bent[:, :3]
    field = ambient @ cells.covariance @ ambient.T
    # The noise that both series share is out of the cells, but it is in what is left of the reading.
    both = np.diag(ambient[:, :3] @ (noise.share * noise.covariance) @ ambient[:, 3:].T)
    variance = np.maximum(np.einsum("ckk->ck", field) - 2.0 * both, noise.floor)
    weight = cells.count[:, None] / _usual(variance, cells)
    block = cells.blocks(_BLOCKS)
    sums, crosses = np.zeros((_BLOCKS, 3, 3, 3)), np.zeros((_BLOCKS, 3, 3))
    weights = np.zeros((_BLOCKS, 3))
    np.add.at(sums, block, weight[:, :, None, None] * square[:, None])
    np.add.at(crosses, block, weight[:, :, None] * cross)
    np.add.at(weights, block, weight)
    # Ambient field left in the difference is regressed on itself, and on other axes of it that go with it.
    alike = np.einsum("ck,ckj->kj", weight, field)
    error = np.einsum("kj,kl,ijml->kim", alike, alike, leak.reshape(3, 3, 3, 3))
    shared = noise.share_sigma * np.einsum("k,ki->ki", weight.sum(axis=0), noise.covariance)
    error = error + np.einsum("ki,kj->kij", shared, shared)
    return SecondMoments(sums, crosses, weights[:, :, None, None] * noise.covariance, error)


def _usual(variance: Floats, cells: Cells) -> Floats:
    """Return variances (cell, axis) half their own, half those around them on the same scale.

    By its own alone a cell in which ambient and stray field cancel by chance would count for many.
    """
    out = variance.copy()
    for scale in np.unique(cells.scale):
        here = np.flatnonzero(cells.scale == scale)
        around = ndimage.uniform_filter1d(variance[here], _ALIKE, axis=0, mode="nearest")
        out[here] = 0.5 * variance[here] + 0.5 * around
    return out


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


def usable_cells(cells: Cells, noise: DifferenceNoise) -> Cells:
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


def difference_noise(cells: Cells, covariance: Floats, leak_sigma: float = 0.0) -> DifferenceNoise:
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
        return DifferenceNoise(covariance, 0.5, _SHARE)
    found = -np.einsum("cii->ci", first.covariance[:, :3, 3:]) / variance
    middle = np.median(found, axis=0)
    spread = 1.4826 * np.median(np.abs(found - middle), axis=0) * 1.25 / np.sqrt(len(first)) + 1e-6
    spread += leak_sigma * np.median(np.einsum("cii->ci", first.covariance[:, :3, :3]), axis=0) / variance
    weight, prior = 1.0 / spread**2, 1.0 / _SHARE**2
    total = float(weight.sum()) + prior
    share = np.clip((float(weight @ middle) + 0.5 * prior) / total, 0.02, 0.98)
    return DifferenceNoise(covariance, float(share), 1.0 / np.sqrt(total))


def fit_mixing(
    cells: Cells, noise: DifferenceNoise, prior: tuple[Floats, Floats], leak_sigma: float
) -> Mixing:
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
        value, _ = second_moments(cells, now, noise).solve(ELEMENTS, prior)
        now = replace(now, matrix=value.reshape(3, 3))
    return now


def second_moments(cells: Cells, now: Mixing, noise: DifferenceNoise) -> SecondMoments:
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
