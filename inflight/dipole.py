"""The field of one dipole at two sensors, from the difference that a residual gives (Yin 2010, eq. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import SettingsError


@dataclass(frozen=True)
class DipoleSource:
    """A dipole on the spacecraft, of any moment, that more than one sensor sees.

    Attributes
    ----------
    position : tuple of float
        m, where the mission's sensors have their positions.
    sigma : float
        How well the place is known along each axis, m.
    """

    position: tuple[float, float, float]
    sigma: float

    def transfer(self, known: npt.ArrayLike, target: npt.ArrayLike) -> Floats:
        """Return the matrix (3, 3) from the dipole's field at one place to its field at another.

        Raises
        ------
        SettingsError
            When a place is the dipole's own.
        """
        return _transfer(np.asarray(self.position), known, target)

    def errors(
        self,
        known: npt.ArrayLike,
        target: npt.ArrayLike,
        moved: Literal["source", "known", "target"] = "source",
        sigma: float | None = None,
    ) -> Floats:
        """Return what a place wrong by one sigma makes wrong of a field that was told from a difference.

        The difference ``(1 - T) f`` of the fields at both places stays as it was measured, T the `transfer`:
        a field f at the first one is wrong by ``errors @ f``.

        Parameters
        ----------
        known, target : array_like, shape (3,)
            Places of the two sensors, m.
        moved : str
            Whose place is uncertain.
        sigma : float, optional
            Along each axis, m; the source's own unless given.

        Returns
        -------
        ndarray, shape (3, 3, 3)
            By axis of the place, matrices that act on the field at `known`.
        """
        step = self.sigma if sigma is None else sigma
        if step == 0.0:
            return np.zeros((3, 3, 3))
        stated = {
            "source": np.asarray(self.position),
            "known": np.asarray(known, dtype=np.float64),
            "target": np.asarray(target, dtype=np.float64),
        }
        difference = np.eye(3) - _transfer(*stated.values())

        def true_field(off: Floats) -> Floats:
            places = {**stated, moved: stated[moved] + off}
            return np.asarray(np.linalg.solve(np.eye(3) - _transfer(*places.values()), difference))

        sides = [[true_field(sign * step * axis) for sign in (1.0, -1.0)] for axis in np.eye(3)]
        return np.array([(up - down) / 2.0 for up, down in sides])


def _transfer(place: Floats, known: npt.ArrayLike, target: npt.ArrayLike) -> Floats:
    near, far = (np.asarray(one, dtype=np.float64) - place for one in (known, target))
    if not near.any() or not far.any():
        raise SettingsError(
            f"a sensor stands at the dipole, at {place.tolist()} m", remedy="give the dipole's position, m"
        )
    return np.asarray(unit_dipole(far) @ np.linalg.inv(unit_dipole(near)))


@dataclass(frozen=True)
class DipoleSplit:
    """What one dipole makes at both sensors; arrays of shape (3,), nT/A.

    `factor` are the shares of the difference where they are the same for all axes, else NaN.
    """

    vector: Floats
    scalar: Floats
    sigma_vector: Floats
    sigma_scalar: Floats
    factor: tuple[float, float]


def dipole_split(
    difference: npt.ArrayLike,
    r_vector: npt.ArrayLike,
    r_scalar: npt.ArrayLike,
    *,
    covariance: npt.ArrayLike | None = None,
    direction: npt.ArrayLike | None = None,
) -> DipoleSplit:
    """Split ``A_vector - A_scalar`` by the fall-off of a dipole (Yin 2010, after eq. 3.1).

    On one line through the dipole the field falls with the cube of the distance whatever the moment's
    direction, so ``A_scalar = A_vector (r_v/r_s)^3`` and the vector sensor has ``1 / (1 - (r_v/r_s)^3)``
    of the difference: 1.64001 for 4.75 and 6.5 m, the scalar sensor 0.64001.

    Parameters
    ----------
    difference : array_like, shape (3,)
        nT/A, spacecraft axes.
    r_vector, r_scalar : float or array_like, shape (3,)
        Positions of the sensors from the dipole, m: distances on the boom's axis, or vectors.
    covariance : array_like, shape (3, 3), optional
        Of the difference.
    direction : array_like, shape (3,), optional
        Of the dipole's moment; needed where the sensors are not on one line through the dipole. Its
        size is then fitted to the difference by least squares.

    Raises
    ------
    SettingsError
        Sensors at equal distances or at the dipole; off one line without a direction.
    """
    observed = np.asarray(difference, dtype=np.float64)
    spread = np.zeros((3, 3)) if covariance is None else np.asarray(covariance, dtype=np.float64)
    places = (np.asarray(place, dtype=np.float64) for place in (r_vector, r_scalar))
    near, far = (place if place.ndim else np.array([float(place), 0.0, 0.0]) for place in places)
    size = [float(np.linalg.norm(one)) for one in (near, far)]
    if min(size) == 0.0:
        raise SettingsError("a sensor stands at the dipole", remedy="give positions from the dipole, m")
    if np.linalg.norm(np.cross(near, far)) <= 1e-9 * size[0] * size[1]:
        ratio = (size[0] / size[1]) ** 3
        if abs(1.0 - ratio) < 1e-9:
            raise SettingsError(
                f"both sensors are {size[0]:g} m from the dipole: their difference does not hold its field",
                remedy="give the true positions",
            )
        parts = np.eye(3) / (1.0 - ratio), np.eye(3) * ratio / (1.0 - ratio)
        factor = 1.0 / (1.0 - ratio), ratio / (1.0 - ratio)
    else:
        parts = _along_moment(near, far, direction)
        factor = float("nan"), float("nan")
    vector, scalar = (part @ observed for part in parts)
    sigma = [np.sqrt(np.clip(np.diag(part @ spread @ part.T), 0.0, None)) for part in parts]
    return DipoleSplit(vector, scalar, sigma[0], sigma[1], factor)


def _along_moment(near: Floats, far: Floats, direction: npt.ArrayLike | None) -> tuple[Floats, Floats]:
    """Return the matrices from the difference to both fields for a moment of known direction."""
    if direction is None:
        raise SettingsError(
            f"the sensors at {near.tolist()} and {far.tolist()} m are not on one line through the dipole",
            remedy="give 'direction', the dipole's moment, or positions along the boom's axis",
        )
    moment = np.asarray(direction, dtype=np.float64)
    fields = [unit_dipole(place) @ moment for place in (near, far)]
    apart = fields[0] - fields[1]
    power = float(apart @ apart)
    if power <= 1e-12 * float(fields[0] @ fields[0]):
        raise SettingsError("both sensors see the same field of this moment", remedy="give another direction")
    return np.outer(fields[0], apart) / power, np.outer(fields[1], apart) / power


def unit_dipole(place: Floats) -> Floats:
    """Return the matrix from moment to field, up to a constant: ``(3 r r^T - 1) / r^3``.

    Parameters
    ----------
    place : ndarray, shape (..., 3)
        From the dipole, any length.

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    square = (place * place).sum(axis=-1)[..., None, None]
    both = 3.0 * place[..., :, None] * place[..., None, :] / square - np.eye(3)
    return np.asarray(both / (square * np.sqrt(square)))
