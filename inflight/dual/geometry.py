"""Where the spacecraft's dipole stands: its matrix, its fitted place, what geometry says alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.dipole import unit_dipole
from inflight.dual.mixing import WhitenedRows
from inflight.errors import CalibrationError

_DRAWS = 600

#: Of a boom of which nothing is known: size of a dipole's field at the outboard beside that at the inboard
#: sensor, and the places of dipoles on each axis in distances of the inboard sensor.
_RATIOS, _ANYWHERE = (0.02, 0.75), 0.4

#: Units outside of the body that was told are so far from the inboard sensor: logarithm, in baselines.
_AWAY = (-1.5, 3.0)


@dataclass(frozen=True)
class Body:
    """Where both sensors are and where the spacecraft's units may be: one frame and origin, m.

    Attributes
    ----------
    positions : ndarray, shape (2, 3)
        Of the inboard and the outboard sensor.
    middle, reach : ndarray, shape (3,)
        Middle and half the size of the box in which all units stand.
    """

    positions: Floats
    middle: Floats
    reach: Floats

    def places(self, count: int = _DRAWS) -> Floats:
        """Return places in the box, the same each time; (count, axis), m."""
        drawn = np.random.default_rng(1).uniform(-1.0, 1.0, (count, 3))
        return np.asarray(self.middle + drawn * self.reach)

    @cached_property
    def matrices(self) -> Floats:
        """Those of dipoles all over the body, (place, 3, 3); those next to a sensor are left out."""
        return _inner(np.array([dipole_matrix(self.positions, place) for place in self.places()]))

    @property
    def spread(self) -> Floats:
        """Standard deviation of the units' places on each axis, m."""
        return np.asarray(np.maximum(self.reach, 1e-6 * self.baseline) / np.sqrt(3.0))

    @property
    def baseline(self) -> float:
        """Distance of the two sensors, m."""
        return float(np.linalg.norm(self.positions[1] - self.positions[0]))


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


@cache
def matrices_of_any_boom() -> Floats:
    """Return matrices of dipoles that stand nearer to the inboard sensor than to the outboard one.

    Nothing is known of where: the boom points anywhere, the sensors are close together or far apart.

    Returns
    -------
    ndarray, shape (place, 3, 3)
    """
    random = np.random.default_rng(3)
    drawn = []
    for turn in Rotation.random(_DRAWS, rng=random):
        ratio = random.uniform(*_RATIOS)
        sensors = np.array([[1.0, 0.0, 0.0], [ratio ** (-1.0 / 3.0), 0.0, 0.0]])
        inside = dipole_matrix(sensors, random.uniform(-_ANYWHERE, _ANYWHERE, 3))
        drawn.append(turn.as_matrix() @ inside @ turn.as_matrix().T)
    return _inner(np.array(drawn))


def matrices_near_inboard(body: Body) -> Floats:
    """Return matrices of dipoles nearer to the inboard than to the outboard sensor, (place, 3, 3).

    Of units outside of the body that was told: where the sensors are is still known. The units are in any
    direction from the inboard sensor, at any distance of which the field's ratio is that of `_RATIOS`.
    """
    random = np.random.default_rng(4)
    away = random.normal(size=(4 * _DRAWS, 3))
    away *= (np.exp(random.uniform(*_AWAY, len(away))) / np.linalg.norm(away, axis=1))[:, None]
    places = body.positions[0] + body.baseline * away
    near, far = (np.linalg.norm(places - one, axis=1) for one in body.positions)
    ratio = (near / far) ** 3
    places = places[(ratio > _RATIOS[0]) & (ratio < _RATIOS[1])]
    return _inner(np.array([dipole_matrix(body.positions, place) for place in places]))


def matrix_spread(matrix: Floats) -> Floats:
    """Return how matrices of units differ on a boom of which nothing is known but a fitted matrix; (9, 9).

    The boom points anywhere: the spread is the same in all elements.
    """
    size = float(np.trace(matrix)) / 3.0
    ratio = float(np.clip(size / (1.0 + size), *_RATIOS)) if size > 0 else _RATIOS[0]
    sensors = np.array([[1.0, 0.0, 0.0], [ratio ** (-1.0 / 3.0), 0.0, 0.0]])
    single = np.cov(Body(sensors, np.zeros(3), np.full(3, _ANYWHERE)).matrices.reshape(-1, 9).T)
    return np.asarray(np.trace(single) / 9.0 * np.eye(9))


def matrix_prior(matrices: Floats) -> tuple[Floats, Floats]:
    """Return what matrices of single places say of that of all units: mean (9,) and covariance (9, 9)."""
    flat = matrices.reshape(-1, 9)
    spread_of_one = np.cov(flat.T)
    # Several units at once make matrices that no single place makes: as far away, in any direction.
    return flat.mean(axis=0), spread_of_one + np.trace(spread_of_one) / 9.0 * np.eye(9)


def _inner(drawn: Floats) -> Floats:
    """Return matrices without those next to a sensor, which have no bound."""
    flat = drawn.reshape(-1, 9)
    return np.asarray(drawn[np.all(np.abs(flat - np.median(flat, axis=0)) <= 6.0 * _spread(flat), axis=1)])


def _spread(drawn: Floats) -> Floats:
    low, high = np.quantile(drawn, [0.16, 0.84], axis=0)
    return np.asarray(0.5 * (high - low) + 1e-12)


def fit_place(body: Body, told: WhitenedRows) -> tuple[Floats, Floats]:
    """Fit the place of one dipole in the body.

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

    def misfit(place: Floats) -> Floats:
        rows = np.einsum("kij,kj->ki", told.design, matrix(place)) - told.wanted
        return np.concatenate([rows.ravel(), (place - body.middle) / spread])

    starts = body.middle + spread * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    fits = [least_squares(misfit, start, x_scale=spread) for start in starts]
    best = min(fits, key=lambda one: float(one.cost))
    if not np.all(np.isfinite(best.x)):
        raise CalibrationError("no place of a dipole fits", remedy="use another form")
    step = 1e-4 * body.baseline
    slope = [(matrix(best.x + step * e) - matrix(best.x - step * e)) / (2 * step) for e in np.eye(3)]
    return np.asarray(best.x), np.array(slope)
