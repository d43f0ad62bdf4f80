"""Where the spacecraft's units stand, and the matrix from the difference to the outboard sensor that follows.

Takes the positions of both sensors and the box in which all units stand; makes the matrices of dipoles in it,
their mean and spread (the prior of every fit), and the fitted place of one dipole. Without positions: the
matrices of dipoles nearer to the inboard sensor, wherever the boom points.

A dipole of moment m has the field ``G m`` with ``G = (3 r r^T - 1) / r^3``, so that the outboard field is
``G_out (G_in - G_out)^-1 d`` of the difference d. On one line with the sensors that is ``k / (1 - k) d`` with
``k = (r_in / r_out)^3`` (Ness et al. 1971).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import scipy

from inflight.arrays import Floats
from inflight.dipole import unit_dipole
from inflight.dual.mixing import WhitenedRows
from inflight.errors import CalibrationError


@dataclass(frozen=True, kw_only=True)
class GeometrySettings:
    """Numbers of the geometry of units and sensors.

    Attributes
    ----------
    draws : int
        Places of dipoles that are drawn. Assumed: chances of one in a thousand are estimated from these and
        the draws of the sensors' drift (`held_out.HELD_OUT_SETTINGS`).
    ratios : (float, float)
        Of a boom of unknown geometry: range of the size of a dipole's field at the outboard sensor over
        that at the inboard one. Assumed.
    offset : float
        Of the same: the places of dipoles on each axis, in distances of the inboard sensor. Assumed.
    log_distance : (float, float)
        Units outside of the stated body are so far from the inboard sensor: logarithm, in baselines. Assumed;
        those whose ratio of fields is not in `ratios` are left out.
    outliers : float
        Matrices farther from the median than so many standard deviations in any element are left out: next
        to a sensor they have no bound. Assumed.
    """

    draws: int = 600
    ratios: tuple[float, float] = (0.02, 0.75)
    offset: float = 0.4
    log_distance: tuple[float, float] = (-1.5, 3.0)
    outliers: float = 6.0


GEOMETRY_SETTINGS = GeometrySettings()


@dataclass(frozen=True)
class Body:
    """Where both sensors are and where the spacecraft's units may be: one frame and origin, m.

    Attributes
    ----------
    positions : ndarray, shape (2, 3)
        Of the inboard and the outboard sensor.
    centre, half_size : ndarray, shape (3,)
        Of the box in which all units stand.
    """

    positions: Floats
    centre: Floats
    half_size: Floats

    @cached_property
    def matrices(self) -> Floats:
        """Of dipoles drawn all over the body, the same each time, without those next to a sensor.

        Shape (place, 3, 3).
        """
        drawn = np.random.default_rng(1).uniform(-1.0, 1.0, (GEOMETRY_SETTINGS.draws, 3))
        places = self.centre + drawn * self.half_size
        return _without_outliers(dipole_matrix(self.positions, places))

    @property
    def spread(self) -> Floats:
        """Standard deviation of the units' places on each axis, m."""
        return np.asarray(np.maximum(self.half_size, 1e-6 * self.baseline) / np.sqrt(3.0))

    @property
    def baseline(self) -> float:
        """Distance of the two sensors, m."""
        return float(np.linalg.norm(self.positions[1] - self.positions[0]))


def dipole_matrix(positions: Floats, place: Floats) -> Floats:
    """Return what takes the difference of both sensors to the outboard field of a dipole; (..., 3, 3).

    ``G_out (G_in - G_out)^-1`` with ``G = (3 r r^T - 1) / r^3``: whatever the moment, on one line with the
    sensors it is ``k / (1 - k)`` with ``k = (r_in / r_out)^3`` (Ness et al. 1971).

    Parameters
    ----------
    positions : ndarray, shape (2, 3)
        Of the inboard and the outboard sensor, m.
    place : ndarray, shape (..., 3)
        Of the dipole, m, same axes and origin; one or many.
    """
    both = unit_dipole(positions - place[..., None, :])
    near, far = both[..., 0, :, :], both[..., 1, :, :]
    # All of these matrices are symmetric: the transposed product is solved for.
    return np.asarray(np.swapaxes(np.linalg.solve(near - far, far), -1, -2))


@cache
def matrices_of_any_boom() -> Floats:
    """Return matrices of dipoles that stand nearer to the inboard sensor than to the outboard one.

    The boom points anywhere; the sensors are close together or far apart.

    Returns
    -------
    ndarray, shape (place, 3, 3)
    """
    random = np.random.default_rng(3)
    drawn = []
    for rotation in scipy.spatial.transform.Rotation.random(GEOMETRY_SETTINGS.draws, rng=random):
        ratio = random.uniform(*GEOMETRY_SETTINGS.ratios)
        sensors = np.array([[1.0, 0.0, 0.0], [ratio ** (-1.0 / 3.0), 0.0, 0.0]])
        inside = dipole_matrix(
            sensors, random.uniform(-GEOMETRY_SETTINGS.offset, GEOMETRY_SETTINGS.offset, 3)
        )
        drawn.append(rotation.as_matrix() @ inside @ rotation.as_matrix().T)
    return _without_outliers(np.array(drawn))


def matrices_near_inboard(body: Body) -> Floats:
    """Return matrices of dipoles nearer to the inboard than to the outboard sensor, (place, 3, 3).

    Of units outside of the stated body: the sensors' positions are still known. The units are in any
    direction from the inboard sensor, at any distance of which the field's ratio is that of
    `GEOMETRY_SETTINGS`.
    """
    random = np.random.default_rng(4)
    away = random.normal(size=(4 * GEOMETRY_SETTINGS.draws, 3))
    away *= (
        np.exp(random.uniform(*GEOMETRY_SETTINGS.log_distance, len(away))) / np.linalg.norm(away, axis=1)
    )[:, None]
    places = body.positions[0] + body.baseline * away
    near, far = (np.linalg.norm(places - one, axis=1) for one in body.positions)
    ratio = (near / far) ** 3
    places = places[(ratio > GEOMETRY_SETTINGS.ratios[0]) & (ratio < GEOMETRY_SETTINGS.ratios[1])]
    return _without_outliers(dipole_matrix(body.positions, places))


def matrix_spread(matrix: Floats) -> Floats:
    """Return the covariance of units' matrices on a boom of unknown geometry with a fitted matrix; (9, 9).

    The boom points anywhere: the spread is the same in all elements.
    """
    size = float(np.trace(matrix)) / 3.0
    ratio = (
        float(np.clip(size / (1.0 + size), *GEOMETRY_SETTINGS.ratios))
        if size > 0
        else GEOMETRY_SETTINGS.ratios[0]
    )
    sensors = np.array([[1.0, 0.0, 0.0], [ratio ** (-1.0 / 3.0), 0.0, 0.0]])
    single = np.cov(
        Body(sensors, np.zeros(3), np.full(3, GEOMETRY_SETTINGS.offset)).matrices.reshape(-1, 9).T
    )
    return np.asarray(np.trace(single) / 9.0 * np.eye(9))


def matrix_prior(matrices: Floats) -> tuple[Floats, Floats]:
    """Return the prior of the matrix of all units, from single places: mean (9,) and covariance (9, 9)."""
    flat = matrices.reshape(-1, 9)
    spread_of_one = np.cov(flat.T)
    # Several units at once make matrices that no single place makes: as far away, in any direction.
    return flat.mean(axis=0), spread_of_one + np.trace(spread_of_one) / 9.0 * np.eye(9)


def _without_outliers(drawn: Floats) -> Floats:
    """Return matrices (place, 3, 3) without those next to a sensor, which have no bound."""
    flat = drawn.reshape(-1, 9)
    low, high = np.quantile(flat, [0.16, 0.84], axis=0)
    sigma = np.asarray(0.5 * (high - low) + 1e-12)
    away = np.abs(flat - np.median(flat, axis=0))
    return np.asarray(drawn[np.all(away <= GEOMETRY_SETTINGS.outliers * sigma, axis=1)])


def fit_place(body: Body, regression: WhitenedRows) -> tuple[Floats, Floats]:
    """Fit the place of one dipole in the body, by least squares.

    Parameters
    ----------
    body : Body
    regression : WhitenedRows
        Rows of the matrix, with errors of size one.

    Returns
    -------
    place : ndarray, shape (3,)
        m.
    slope : ndarray, shape (3, 3, 3)
        Of the matrix by the place's components, 1/m.

    Raises
    ------
    CalibrationError
        When no place fits.
    """
    spread = body.spread

    def matrix(place: Floats) -> Floats:
        return dipole_matrix(body.positions, place)

    def residuals(place: Floats) -> Floats:
        rows = np.einsum("kij,kj->ki", regression.design, matrix(place)) - regression.target
        return np.concatenate([rows.ravel(), (place - body.centre) / spread])

    starts = body.centre + spread * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    fits = [scipy.optimize.least_squares(residuals, start, x_scale=spread) for start in starts]
    best = min(fits, key=lambda one: float(one.cost))
    if not np.all(np.isfinite(best.x)):
        raise CalibrationError("no place of a dipole fits", remedy="use another form")
    step = 1e-4 * body.baseline
    slope = [(matrix(best.x + step * e) - matrix(best.x - step * e)) / (2 * step) for e in np.eye(3)]
    return np.asarray(best.x), np.array(slope)
