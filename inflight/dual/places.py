"""Where the spacecraft's dipole stands: its matrix, its fitted place, what geometry says alone."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.estimators.dipole import unit_dipole

#: Units are taken to stand around the middle of the body, one standard deviation this part of the inboard
#: sensor's distance away.
BODY = 0.2
_DRAWS = 400


def dipole_matrix(positions: Floats, place: Floats) -> Floats:
    """Return what takes the difference of both sensors to the outboard field of a dipole; (3, 3).

    ``G_out (G_in - G_out)^-1`` with ``G = (3 r r^T - 1) / r^3``: whatever the moment, on one line with the
    sensors it is ``k / (1 - k)`` with ``k = (r_in / r_out)^3`` (Ness et al. 1971).

    Parameters
    ----------
    positions : ndarray, shape (2, 3)
        Of the inboard and the outboard sensor, m.
    place : ndarray, shape (3,)
        Of the dipole, m, same axes and origin.
    """
    near, far = (unit_dipole(one - place) for one in positions)
    return np.asarray(np.linalg.solve((near - far).T, far.T).T)


def matrix_from_geometry(positions: Floats, body: float | None = None) -> tuple[Floats, Floats]:
    """Return what positions alone say of the matrix: mean (9,) and covariance (9, 9).

    Parameters
    ----------
    positions : ndarray, shape (2, 3)
        Of the inboard and the outboard sensor from the middle of the spacecraft's body, m.
    body : float, optional
        Standard deviation of the units' places on each axis, m.
    """
    spread = BODY * float(np.linalg.norm(positions[0])) if body is None else body
    places = np.random.default_rng(1).normal(0.0, 1.0, (_DRAWS, 3)).clip(-2.0, 2.0) * spread
    drawn = np.array([dipole_matrix(positions, place).ravel() for place in places])
    middle = np.median(drawn, axis=0)
    # Places next to a sensor make matrices without bound: the spread is that of the inner part.
    inner = drawn[np.all(np.abs(drawn - middle) <= 6.0 * _spread(drawn), axis=1)]
    spread_of_one = np.cov(inner.T)
    # Several units at once make matrices that no single place makes: as far away, in any direction.
    return middle, spread_of_one + np.trace(spread_of_one) / 9.0 * np.eye(9)


def _spread(drawn: Floats) -> Floats:
    low, high = np.quantile(drawn, [0.16, 0.84], axis=0)
    return np.asarray(0.5 * (high - low) + 1e-12)


def fit_place(positions: Floats, square: Floats, cross: Floats) -> tuple[Floats, Floats]:
    """Fit the place of one dipole to weighted sums of contrasts.

    Parameters
    ----------
    positions : ndarray, shape (2, 3)
        m.
    square : ndarray, shape (axis, 3, 3)
        Weighted squares of the difference, for each outboard axis.
    cross : ndarray, shape (axis, 3)
        Weighted products of it with the outboard reading.

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
    value, vector = np.linalg.eigh(square)
    roots = vector * np.sqrt(np.clip(value, 0.0, None))[:, None, :]
    # |L^T m - L^+ x|^2 is the weighted sum of squares of a row m of the matrix, but for a constant.
    keep = np.sqrt(np.clip(value, max(1e-9 * float(value.max()), 1e-12), None))
    wanted = np.einsum("kij,ki->kj", vector, cross) / keep
    spread = BODY * float(np.linalg.norm(positions[0]))

    def misfit(place: Floats) -> Floats:
        rows = np.einsum("kij,ki->kj", roots, dipole_matrix(positions, place)) - wanted
        return np.concatenate([rows.ravel(), place / spread])

    starts = spread * np.array(
        [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]]
    )
    fits = [least_squares(misfit, start, x_scale=spread) for start in starts]
    best = min(fits, key=lambda one: float(one.cost))
    if not np.all(np.isfinite(best.x)):
        raise CalibrationError("no place of a dipole fits", remedy="use another form")
    step = 1e-4 * float(np.linalg.norm(positions[0]))
    slope = np.array(
        [
            (dipole_matrix(positions, best.x + step * e) - dipole_matrix(positions, best.x - step * e))
            / (2 * step)
            for e in np.eye(3)
        ]
    )
    return np.asarray(best.x), slope
