"""Field of a magnetic dipole at a position; everything on the spacecraft is made of these."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.simulate.grid import Float

#: mu0 / 4 pi in nT m^3 / (A m^2).
_MU0_4PI = 100.0


def dipole_matrix(displacement: npt.ArrayLike) -> Float:
    """Return the field a unit moment makes: ``B = matrix @ moment``.

    Parameters
    ----------
    displacement : array_like, shape (3,)
        From the dipole to the point, m, spacecraft axes.

    Returns
    -------
    ndarray, shape (3, 3)
        nT / (A m^2). ``mu0/(4 pi r^3) (3 r r^T - 1)`` with r the unit vector (Yin 2010, after eq. 3.1).
    """
    arm = np.asarray(displacement, dtype=np.float64)
    distance = float(np.linalg.norm(arm))
    unit = arm / distance
    return (_MU0_4PI / distance**3) * (3.0 * np.outer(unit, unit) - np.eye(3))


def dipole_field(source: npt.ArrayLike, moment: npt.ArrayLike, place: npt.ArrayLike) -> Float:
    """Return the field (3,), nT, of a moment (3,), A m^2, at a place; places in m, spacecraft axes."""
    return np.asarray(dipole_matrix(np.asarray(place) - np.asarray(source)) @ np.asarray(moment))


def extrapolate_dipole(
    field: npt.ArrayLike, source: npt.ArrayLike, known: npt.ArrayLike, target: npt.ArrayLike
) -> Float:
    """Return a dipole's field at one point from its field at another.

    Parameters
    ----------
    field : array_like, shape (3,)
        At `known`, nT or nT/A.
    source, known, target : array_like, shape (3,)
        Positions of dipole and points, m, spacecraft axes.

    Returns
    -------
    ndarray, shape (3,)
        At `target`, unit of `field`.
    """
    origin = np.asarray(source, dtype=np.float64)
    moment = np.linalg.solve(dipole_matrix(np.asarray(known) - origin), np.asarray(field, dtype=np.float64))
    return dipole_matrix(np.asarray(target) - origin) @ moment
