"""Two vector sensors and a scalar one: the rotation between the two, and which of the three disagrees.

Takes corrected fields or residuals; makes the relation of the two vector sensors (`relation_of`) and the
variance of each sensor's own error (`three_cornered_hat`), both from sums of clusters that are stored day by
day.

Along the field direction b three sensors have three residuals: ``main = b.f1 - s``, ``second = b.f2 - s``
and ``between = f1 - f2``, with f1, f2 the errors at the vector sensors and s that of the scalar one. So
``main - second = b.between`` always; what `between` adds are the two components across the field, which no
scalar sensor measures: the rotation of one sensor against the other among them.

An error of the scalar sensor is in `main` and `second` alike and never in `between`; a field at one
vector sensor only is in one of the first two and in `between`. When errors of different sensors are
unrelated their variances follow from the three pairs (the three-cornered hat, Gray and Allan 1974):
``var(s) = cov(main, second)``, ``var(f1) = var(main) - var(s)``, ``var(f2) = var(second) - var(s)``.
A field that is the same at both vector sensors looks like one of the scalar sensor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.effects import AXES
from inflight.errors import CalibrationError
from inflight.lsq import SOLVER_SETTINGS, ClusteredFit, grams_by_cluster, robust_sigma, solve_clusters
from inflight.time import SECOND, Int64

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class TwoFluxgateSettings:
    """How samples of two sensors are weighted.

    Attributes
    ----------
    far : float
        Samples so many robust sigmas off are left out; assumed.
    passes : int
        Passes of leaving them out; assumed.
    """

    far: float = 6.0
    passes: int = 4


TWO_FLUXGATE_SETTINGS = TwoFluxgateSettings()


#: Two orbits: clusters of samples whose errors belong together.
CLUSTER_S = 10_800.0


#: Field strength that makes columns of like size, nT.
_STRENGTH = 3e4

_STRETCH = ("xx", "yy", "zz", "xy", "xz", "yz")

NAMES = (
    *(f"rotation[{axis}]" for axis in AXES),
    *(f"stretch[{pair}]" for pair in _STRETCH),
    *(f"shift[{axis}]" for axis in AXES),
)

_UNITS = ("deg",) * 3 + ("1",) * 6 + ("nT",) * 3

_SCALE = np.concatenate([np.full(3, np.rad2deg(1.0 / _STRENGTH)), np.full(6, 1.0 / _STRENGTH), np.ones(3)])


@dataclass(frozen=True)
class Relation:
    """Relation of two vector sensors: ``first = (1 + stretch) rotation second + shift``.

    Attributes
    ----------
    fit : ClusteredFit
        Of ``first - second``, to first order in rotation and stretch; scaled, in the order of `table`.
    rms : float
        Residual, nT a component.
    """

    fit: ClusteredFit
    rms: float

    def table(self, calibrations: Floats | None = None) -> xr.Dataset:
        """Return `value`, `sigma`, `covariance`, `units` along parameter.

        `rotation` (deg) is that of the second sensor against its stated orientation, when the first one is
        not rotated; `stretch` (1) the symmetric rest, `shift` in nT. The matrix is taken apart exactly: half
        a milliradian squared matters.

        Parameters
        ----------
        calibrations : ndarray, shape (12, 12), optional
            What both calibrations add to the covariance, as `relation_covariance` returns it: what is wrong
            with them is the same in all clusters.
        """
        import xarray as xr

        matrix = np.eye(3) + _columns(np.eye(3) * _STRENGTH)[:, :, :9] @ self.fit.value[:9] / _STRENGTH
        # Row k of the product above is what the matrix makes of the k-th axis: its column.
        rotation, stretch = scipy.linalg.polar(matrix.T, side="left")
        angles = scipy.spatial.transform.Rotation.from_matrix(rotation).as_rotvec(degrees=True)
        symmetric = (stretch - np.eye(3))[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        value = np.concatenate([angles, symmetric, self.fit.value[9:]])
        covariance = self.fit.covariance * np.outer(_SCALE, _SCALE)
        if calibrations is not None:
            covariance = covariance + calibrations
        return xr.Dataset(
            {
                "value": ("parameter", value),
                "sigma": ("parameter", np.sqrt(np.diag(covariance))),
                "covariance": (("parameter", "other"), covariance),
                "units": ("parameter", np.array(_UNITS, dtype="U8")),
            },
            coords={"parameter": list(NAMES), "other": list(NAMES)},
            attrs={"rms_nT": self.rms, "clusters": self.fit.clusters, "rows": self.fit.rows},
        )


def relation_covariance(
    value: Floats, covariance: Floats, rotation: scipy.spatial.transform.Rotation
) -> Floats:
    """Return what the error of one sensor's calibration does to a relation; (12, 12), units of `table`.

    ``K (E - E0)`` with wrong K, E0 is ``dK K^-1 B - K dE0`` off: the antisymmetric part of the matrix turns,
    the symmetric one stretches.

    Parameters
    ----------
    value : ndarray, shape (9,)
        Scale factors, angles (deg), offsets (nT).
    covariance : ndarray, shape (9, 9)
    rotation : scipy Rotation
        From the sensor's axes to the spacecraft's.
    """
    kernel, to_spacecraft = np.eye(3), rotation.as_matrix()
    kernel[range(3), range(3)] = value[:3]
    above = (0, 0, 1), (1, 2, 2)
    kernel[above] = np.cos(np.deg2rad(value[3:6]))
    inverse, slope = np.linalg.inv(kernel), np.zeros((len(NAMES), 9))
    for place, at in enumerate([(0, 0), (1, 1), (2, 2), *zip(*above, strict=True)]):
        change = np.zeros((3, 3))
        change[at] = 1.0 if place < 3 else -np.sin(np.deg2rad(value[place])) * np.deg2rad(1.0)
        wrong = to_spacecraft @ change @ inverse @ to_spacecraft.T
        turn = np.array([wrong[2, 1] - wrong[1, 2], wrong[0, 2] - wrong[2, 0], wrong[1, 0] - wrong[0, 1]])
        even = 0.5 * (wrong + wrong.T)[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
        slope[:9, place] = np.concatenate([np.rad2deg(0.5 * turn), even])
    slope[9:, 6:] = -to_spacecraft @ kernel
    return np.asarray(slope @ covariance @ slope.T)


def fit_relation(
    first: Floats,
    second: Floats,
    stamps: Int64,
    good: npt.NDArray[np.bool_] | None = None,
    cluster_s: float = CLUSTER_S,
) -> Relation:
    """Fit rotation, stretch and shift of one vector sensor's field against another's.

    Parameters
    ----------
    first, second : ndarray, shape (time, 3)
        Corrected fields, spacecraft axes by the stated orientations, nT; NaN where missing.
    stamps : ndarray of int64, shape (time,)
        TT2000.
    good : ndarray of bool, shape (time,), optional
        Samples to use; those far off are left out in any case.
    cluster_s : float
        Length of the spans whose scatter gives the uncertainty, s.

    Returns
    -------
    Relation

    Raises
    ------
    CalibrationError
        When the samples fill fewer than five clusters, or the field does not turn enough.
    """
    parts = relation_grams(first, second, stamps, good, cluster_s)
    return relation_of(*parts)


def relation_grams(
    first: Floats,
    second: Floats,
    stamps: Int64,
    good: npt.NDArray[np.bool_] | None = None,
    cluster_s: float = CLUSTER_S,
) -> tuple[Floats, Floats]:
    """Return the Gram matrices of a relation, samples far off left out; parameters as `fit_relation`.

    Returns
    -------
    gram : ndarray, shape (cluster, 13, 13)
        Of [twelve columns | difference], nT^2; those of several stretches are concatenated.
    rows : ndarray, shape (cluster,)
    """
    use = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    use &= True if good is None else good
    difference, columns = first - second, _columns(second)
    cluster = _cluster_of(stamps, cluster_s)
    for _ in range(TWO_FLUXGATE_SETTINGS.passes):
        gram, rows = _grams(columns[use], difference[use], cluster[use])
        fit = solve_clusters(gram, rows)
        residual = difference - columns @ fit.value
        size = np.array([robust_sigma(component, floor=1e-9) for component in residual[use].T])
        near = use & (np.abs(residual) <= TWO_FLUXGATE_SETTINGS.far * size).all(axis=1)
        if np.array_equal(near, use):
            break
        use = near
    return _grams(columns[use], difference[use], cluster[use])


def relation_of(gram: Floats, rows: Floats) -> Relation:
    """Return the relation that all clusters determine; as `relation_grams` makes them.

    Raises
    ------
    CalibrationError
        When there are fewer than five clusters, or the field does not turn enough.
    """
    fit = solve_clusters(gram, rows)
    change = np.append(-fit.value, 1.0)
    square = float(change @ gram.sum(axis=0) @ change)
    return Relation(fit, float(np.sqrt(max(square, 0.0) / rows.sum())))


def _columns(field: Floats) -> Floats:
    """Return what each of the twelve numbers does to the difference; (time, 3, 12), scaled."""
    x, y, z = field.T / _STRENGTH
    out = np.zeros((len(field), 3, len(NAMES)))
    # rotation x B
    out[:, 1, 0], out[:, 2, 0] = -z, y
    out[:, 0, 1], out[:, 2, 1] = z, -x
    out[:, 0, 2], out[:, 1, 2] = -y, x
    for place, (row, column) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), start=3):
        out[:, row, place] = (x, y, z)[column]
        out[:, column, place] = (x, y, z)[row]
    out[:, range(3), range(9, 12)] = 1.0
    return out


def _grams(columns: Floats, difference: Floats, cluster: Int64) -> tuple[Floats, Floats]:
    wide = columns.reshape(-1, len(NAMES))
    weight = np.ones(len(wide))
    return grams_by_cluster(wide, difference.reshape(-1), weight, np.repeat(cluster, 3))


def _cluster_of(stamps: Int64, cluster_s: float) -> Int64:
    return np.asarray(stamps // round(cluster_s * SECOND), dtype=np.int64)


@dataclass(frozen=True)
class ThreeCornerVariances:
    """The part of each of three sensors in their disagreement; nT^2, means over `mean_s`.

    Attributes
    ----------
    value, sigma : ndarray, shape (3,)
        Variances of the first vector sensor, the second, and the scalar one; an estimate may be negative.
    covariance : ndarray, shape (3, 3)
    closure : float
        Rms of ``main - second - b.between``, nT: 0 but for rounding when all three are of the same
        samples and values; NaN when `between` was not given.
    mean_s : float
    clusters : int
    """

    value: Floats
    covariance: Floats
    closure: float
    mean_s: float
    clusters: int

    @property
    def sigma(self) -> Floats:
        """Standard deviations of the variances; (3,)."""
        return np.sqrt(np.diag(self.covariance))

    def table(self) -> xr.Dataset:
        """Return `value`, `sigma`, `covariance`, `units` along sensor: first, second, scalar."""
        import xarray as xr

        names = ["first", "second", "scalar"]
        return xr.Dataset(
            {
                "value": ("sensor", self.value),
                "sigma": ("sensor", self.sigma),
                "covariance": (("sensor", "other"), self.covariance),
                "units": ("sensor", np.array(["nT2"] * 3)),
            },
            coords={"sensor": names, "other": names},
            attrs={"closure_nT": self.closure, "mean_s": self.mean_s, "clusters": self.clusters},
        )


def corners(
    main: Floats,
    second: Floats,
    stamps: Int64,
    along: Floats | None = None,
    mean_s: float = 60.0,
    cluster_s: float = CLUSTER_S,
) -> ThreeCornerVariances:
    """Return which of three sensors a disagreement belongs to: the variance of each.

    Parameters
    ----------
    main, second : ndarray, shape (time,)
        Residuals of both vector sensors against the scalar one, nT; NaN where missing.
    stamps : ndarray of int64, shape (time,)
        TT2000.
    along : ndarray, shape (time,), optional
        ``b.between``: the two vector sensors' difference along the field, nT, for the closure.
    mean_s : float
        The residuals are averaged over so many seconds first: white noise hides what lasts longer.
    cluster_s : float
        Length of the spans left out one after the other for the uncertainty, s.

    Raises
    ------
    CalibrationError
        When the samples fill fewer than five clusters.
    """
    closure = np.nan
    if along is not None:
        use = np.isfinite(main) & np.isfinite(second)
        closure = float(np.sqrt(np.nanmean((main - second - along)[use] ** 2)))
    return three_cornered_hat(
        three_cornered_hat_sums(main, second, stamps, mean_s, cluster_s), mean_s, closure
    )


def three_cornered_hat_sums(
    main: Floats, second: Floats, stamps: Int64, mean_s: float = 60.0, cluster_s: float = CLUSTER_S
) -> Floats:
    """Return the sums of clusters that the three variances are made of; parameters as `corners`.

    Returns
    -------
    ndarray, shape (cluster, 6)
        Number of means, their sums (main, second), and those of main^2, main second and second^2.
    """
    use = np.isfinite(main) & np.isfinite(second)
    if not use.any():
        return np.zeros((0, 6))
    bins, index = np.unique(_cluster_of(stamps[use], mean_s), return_inverse=True)
    count = np.bincount(index)
    a, b = (np.bincount(index, one[use]) / count for one in (main, second))
    _, which = np.unique(bins * round(mean_s * SECOND) // round(cluster_s * SECOND), return_inverse=True)
    return np.stack([np.bincount(which, one) for one in (np.ones(a.size), a, b, a * a, a * b, b * b)], axis=1)


def three_cornered_hat(
    moments: Floats, mean_s: float = 60.0, closure: float = np.nan
) -> ThreeCornerVariances:
    """Return the variances that all clusters determine; as `three_cornered_hat_sums` makes them.

    Raises
    ------
    CalibrationError
        When there are fewer than five clusters.
    """
    total = len(moments)
    if total < SOLVER_SETTINGS.fewest_clusters:
        raise CalibrationError(
            f"{total} clusters with data found, "
            f"at least {SOLVER_SETTINGS.fewest_clusters} needed for an uncertainty",
            remedy="take a longer span or shorter clusters",
        )
    whole = moments.sum(axis=0)
    without = _variances(whole - moments)
    spread = without - without.mean(axis=0)
    covariance = (total - 1) / total * spread.T @ spread
    return ThreeCornerVariances(_variances(whole), covariance, closure, mean_s, total)


def _variances(moments: Floats) -> Floats:
    """Return the variances of first, second and scalar sensor from sums; (..., 3)."""
    count, a, b, aa, ab, bb = np.moveaxis(moments, -1, 0)
    own_main, shared, own_second = (
        (product - one * other / count) / (count - 1)
        for product, one, other in ((aa, a, a), (ab, a, b), (bb, b, b))
    )
    return np.stack([own_main - shared, own_second - shared, shared], axis=-1)
