"""How a published field was made of two sensors: coefficient, rotations and constant, with their errors.

A two-sensor product takes the inner sensor's larger share of the stray field out of the outer one (Ness et
al. 1971): ``B = (1 + k) R_out B_out - k R_in B_in + c``. All ten numbers follow from the three fields.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.lsq import SOLVER_SETTINGS, grams_by_cluster, solve_clusters
from inflight.time import SECOND, Int64

#: Steps of the iteration at most, and when it has ended: changes in units of their errors.
_MOST_STEPS, _ENOUGH = 50, 1e-4

#: Seconds of one mean, and of one cluster: a cluster's neighbours are taken as independent.
MEAN_S, CLUSTER_S = 2.0, 120.0


@dataclass(frozen=True)
class TwoSensorRelation:
    """``published = (1 + k) R_out outboard - k R_in inboard + c``.

    Attributes
    ----------
    coefficient, coefficient_sigma : float
        k, without unit.
    outboard, inboard : ndarray, shape (3, 3)
        Rotations from sensor axes to the published ones.
    outboard_sigma, inboard_sigma : ndarray, shape (3,)
        Errors of small turns about the published axes, rad.
    constant, constant_sigma : ndarray, shape (3,)
        nT, published axes.
    rms : float
        What is left of a component of a mean, nT.
    means : int
    """

    coefficient: float
    coefficient_sigma: float
    outboard: Floats
    inboard: Floats
    outboard_sigma: Floats
    inboard_sigma: Floats
    constant: Floats
    constant_sigma: Floats
    rms: float
    means: int

    @property
    def distance_ratio_cubed(self) -> float:
        """(r_out / r_in)^3 when the source is a dipole in line with both: 1 + 1/k."""
        return 1.0 + 1.0 / self.coefficient


def relation_to_published(
    stamps: Int64,
    inboard: Floats,
    outboard: Floats,
    published: Floats,
    *,
    mean_s: float = MEAN_S,
    cluster_s: float = CLUSTER_S,
) -> TwoSensorRelation:
    """Return how a published field was made of both sensors.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, common to all.
    inboard, outboard : ndarray, shape (time, 3)
        nT, each sensor's own axes; NaN where a reading is missing.
    published : ndarray, shape (time, 3)
        nT, axes of the product.
    mean_s, cluster_s : float
        The product may be low-passed: means of so many seconds are compared. Errors are those of the
        jackknife over clusters of so many seconds.

    Raises
    ------
    CalibrationError
        When the record is too short, or its field varies too little to tell ten numbers.
    """
    centre, means = _means(stamps, np.hstack([inboard, outboard, published]), mean_s)
    cluster = (centre // round(cluster_s * SECOND)).astype(np.int64)
    stretches = np.unique(cluster).size
    if stretches < SOLVER_SETTINGS.fewest_clusters:
        raise CalibrationError(
            f"{stretches} stretches of {cluster_s:g} s found, "
            f"at least {SOLVER_SETTINGS.fewest_clusters} needed",
            remedy="give a longer record, or shorter clusters",
        )
    inner, outer, target = means[:, :3], means[:, 3:6], means[:, 6:]
    k, r_in, r_out, constant = _start(inner, outer, target)
    for _ in range(_MOST_STEPS):
        turned_in, turned_out = inner @ r_in.T, outer @ r_out.T
        left = target - ((1.0 + k) * turned_out - k * turned_in + constant)
        columns = _columns(turned_in, turned_out, k)
        fit = solve_clusters(
            *grams_by_cluster(columns, left.ravel(), np.ones(left.size), np.repeat(cluster, 3))
        )
        step = fit.value
        k += float(step[0])
        r_in = Rotation.from_rotvec(step[1:4]).as_matrix() @ r_in
        r_out = Rotation.from_rotvec(step[4:7]).as_matrix() @ r_out
        constant = constant + step[7:]
        if np.all(np.abs(step) <= _ENOUGH * fit.sigma):
            break
    else:
        raise CalibrationError(
            f"the fit of the relation does not come to rest in {_MOST_STEPS} steps",
            remedy="leave out samples with bad flags, or take a record in which the field varies more",
        )
    sigma = fit.sigma
    return TwoSensorRelation(
        k,
        float(sigma[0]),
        r_out,
        r_in,
        sigma[4:7],
        sigma[1:4],
        constant,
        sigma[7:],
        float(np.sqrt(np.mean(left**2))),
        len(left),
    )


def _start(inner: Floats, outer: Floats, target: Floats) -> tuple[float, Floats, Floats, Floats]:
    """Return a start from the unconstrained linear fit: two matrices and a constant."""
    columns = np.column_stack([inner, outer, np.ones(len(inner))])
    middle = columns.mean(axis=0) * (np.arange(7) < 6)
    found, *_ = np.linalg.lstsq(columns - middle, target, rcond=None)
    outside, inside = found[3:6].T, -found[:3].T
    scale = float(np.cbrt(max(np.linalg.det(outside), 1e-9)))
    k = max(scale - 1.0, 0.05)
    r_out, r_in = _nearest_rotation(outside), _nearest_rotation(inside)
    constant = target.mean(axis=0) - (1.0 + k) * r_out @ outer.mean(axis=0) + k * r_in @ inner.mean(axis=0)
    return k, r_in, r_out, constant


def _nearest_rotation(matrix: Floats) -> Floats:
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def _columns(turned_in: Floats, turned_out: Floats, k: float) -> Floats:
    """Return what a small change of each number does; (3 x mean, 10)."""
    out = np.zeros((len(turned_in), 3, 10))
    out[:, :, 0] = turned_out - turned_in
    for axis in range(3):
        unit = np.eye(3)[axis]
        out[:, :, 1 + axis] = -k * np.cross(unit, turned_in)
        out[:, :, 4 + axis] = (1.0 + k) * np.cross(unit, turned_out)
        out[:, axis, 7 + axis] = 1.0
    return out.reshape(-1, 10)


def _means(stamps: Int64, values: Floats, seconds: float) -> tuple[Int64, Floats]:
    """Return means of whole spans and their begins; spans with a missing reading are left out."""
    number = (stamps - stamps[0]) // round(seconds * SECOND)
    which, first, counts = np.unique(number, return_index=True, return_counts=True)
    sums = np.add.reduceat(values, first, axis=0)
    means = sums / counts[:, None]
    kept = np.isfinite(means).all(axis=1) & (counts >= 0.9 * np.median(counts))
    return np.asarray(stamps[0] + which[kept] * round(seconds * SECOND), dtype=np.int64), means[kept]
