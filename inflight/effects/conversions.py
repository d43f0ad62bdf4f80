"""The nine parameters in the two published forms: correction side (K, E0) and sensor side (S, U, E0).

*Correction side* (Yin 2010, eq. 2.5): ``B = K (E - E0)``; `scale_factor` is the diagonal of K and
`misalignment` the arccosine of K_xy, K_xz, K_yz, in degrees. These are **not** the angles between
the sensor's axes.

*Sensor side* (Yin 2010, eqs. 2.1 to 2.4): ``E = S A B + E0`` with rows of A the sensor's axes,
``(1, tan U2, tan U3) / W``, ``(0, cos U1, sin U1)``, ``(0, 0, 1)`` and
``W = sqrt(1 + tan^2 U2 + tan^2 U3)``. K is the inverse of S A, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import ModelError


@dataclass(frozen=True)
class SensorAngles:
    """The sensor side of eq. 2.4.

    Attributes
    ----------
    sensitivity : ndarray, shape (3,)
        S_x, S_y, S_z, reading per field along the sensor's own axes.
    angles : ndarray, shape (3,)
        U_1, U_2, U_3, degrees; zero for orthogonal axes.
    """

    sensitivity: Floats
    angles: Floats

    @property
    def axes(self) -> Floats:
        """Unit vectors of the sensor's axes as rows, shape (3, 3), in the orthogonal frame (eq. 2.2)."""
        u1, u2, u3 = np.deg2rad(self.angles)
        first = np.array([1.0, np.tan(u2), np.tan(u3)])
        second = np.array([0.0, np.cos(u1), np.sin(u1)])
        return np.stack([first / np.linalg.norm(first), second, np.array([0.0, 0.0, 1.0])])

    @property
    def between_axes(self) -> Floats:
        """Angles between the sensor's axes xy, xz, yz, shape (3,), degrees.

        To first order in U they are ``90 - U2, 90 - U3, 90 - U1``, on the other side of 90 degrees
        than `misalignment`.
        """
        x, y, z = self.axes
        return np.rad2deg(np.arccos([x @ y, x @ z, y @ z]))


def to_sensor_angles(scale_factor: Floats, misalignment: Floats) -> SensorAngles:
    """Return the sensor side of the correction side's parameters; exact.

    Parameters
    ----------
    scale_factor : ndarray, shape (3,)
        Diagonal of K.
    misalignment : ndarray, shape (3,)
        Arccosines of K_xy, K_xz, K_yz, degrees.

    Raises
    ------
    ModelError
        When a scale factor is not positive.
    """
    k = np.asarray(scale_factor, dtype=np.float64)
    if np.any(k <= 0):
        raise ModelError(f"scale factors {k.tolist()} are not all positive", remedy="check their order")
    cos = np.cos(np.deg2rad(np.asarray(misalignment, dtype=np.float64)))
    inverse = np.linalg.inv(np.array([[k[0], cos[0], cos[1]], [0.0, k[1], cos[2]], [0.0, 0.0, k[2]]]))
    angles = np.arctan2(
        [inverse[1, 2], inverse[0, 1], inverse[0, 2]], [inverse[1, 1], inverse[0, 0], inverse[0, 0]]
    )
    return SensorAngles(np.linalg.norm(inverse, axis=1), np.rad2deg(angles))


def from_sensor_angles(sensitivity: Floats, angles: Floats) -> tuple[Floats, Floats]:
    """Return (scale_factor, misalignment) of the sensor side's parameters; exact.

    Parameters
    ----------
    sensitivity : ndarray, shape (3,)
        S_x, S_y, S_z.
    angles : ndarray, shape (3,)
        U_1, U_2, U_3, degrees, each below 90 in size.

    Returns
    -------
    scale_factor : ndarray, shape (3,)
        Diagonal of K.
    misalignment : ndarray, shape (3,)
        Arccosines of K_xy, K_xz, K_yz, degrees.

    Raises
    ------
    ModelError
        When a sensitivity is not positive, or an angle reaches 90 degrees.
    """
    told = SensorAngles(np.asarray(sensitivity, dtype=np.float64), np.asarray(angles, dtype=np.float64))
    if np.any(told.sensitivity <= 0) or np.any(np.abs(told.angles) >= 90.0):
        raise ModelError(
            f"sensitivities {told.sensitivity.tolist()} and angles {told.angles.tolist()} make no sensor",
            remedy="sensitivities are near 1, U near 0 degrees; angles between axes are not U",
        )
    k = np.linalg.inv(told.sensitivity[:, None] * told.axes)
    beside = np.array([k[0, 1], k[0, 2], k[1, 2]])
    if np.any(np.abs(beside) > 1.0):
        raise ModelError("an entry of K exceeds 1 and has no arccosine", remedy="check the angles' unit")
    return np.diag(k).copy(), np.rad2deg(np.arccos(beside))
