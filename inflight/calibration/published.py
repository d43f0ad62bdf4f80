"""The two published linearisations of the scalar calibration, and both published forms of its parameters.

For comparison with the exact fit, and by choice in its place (`published_gram`, `published_fit`). Both
linearisations treat the raw readings as nearly right and are linear in products of the parameters; iterated
they reach the exact least squares (Yin 2010, section 2.2).

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
from inflight.errors import CalibrationError, ModelError
from inflight.lsq import SOLVER_SETTINGS


def _least_squares(rows: Floats, right: Floats) -> Floats:
    """Solve scaled least squares; a singular system is an error, not an invented number."""
    scale = np.linalg.norm(rows, axis=0)
    found, _, _, singular = np.linalg.lstsq(rows / scale, right, rcond=None)
    if singular[-1] < SOLVER_SETTINGS.singular * singular[0]:
        raise CalibrationError(
            "the directions of the field do not determine nine parameters",
            remedy="use the fit with priors, which says what is determined",
        )
    return np.asarray(found / scale)


def fit_difference(reading: Floats, scalar: Floats, passes: int = 1) -> Floats:
    """Fit dB = |E| - F linearly in the parameters (Yin 2010, eq. 2.7, with the minus signs the scan lost).

    Parameters
    ----------
    reading : ndarray, shape (time, 3)
        Readings, nT.
    scalar : ndarray, shape (time,)
        Scalar field, nT.
    passes : int
        1 is the published fit; further ones repeat it on the calibrated readings.

    Returns
    -------
    ndarray, shape (9,)
        Scale factors (1), misalignment angles (deg), offsets (nT).

    Raises
    ------
    CalibrationError
        When the field's directions do not determine nine parameters.
    """
    k, offset = np.eye(3), np.zeros(3)
    for _ in range(passes):
        rows, right = _difference_rows((reading - offset) @ k.T, scalar)
        step, shift = _from_difference(_least_squares(rows, right))
        k, offset = step @ k, offset + np.linalg.solve(k, shift)
    return _pack(k, offset)


def _difference_rows(e: Floats, scalar: Floats) -> tuple[Floats, Floats]:
    """Return rows (time, 9) and right side of eq. 2.7 for readings that are nearly right."""
    x, y, z = e.T
    rows = np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z], axis=1) / scalar[:, None]
    return rows, np.linalg.norm(e, axis=1) - scalar


def _from_difference(p: Floats) -> tuple[Floats, Floats]:
    """Return matrix and offset of eq. 2.7's parameters."""
    step = np.array([[1 - p[0], -p[3], -p[4]], [0.0, 1 - p[1], -p[5]], [0.0, 0.0, 1 - p[2]]])
    # B = step e - p', with p' = step E0' of the last three: exact, not the approximation P ~ E0.
    return step, np.linalg.solve(step, p[6:])


def fit_squares(reading: Floats, scalar: Floats, passes: int = 1) -> Floats:
    """Fit F^2 = P M + Q linearly in P, rows weighted by 1 / 2F (Yin 2010, section 2.2, second form).

    Parameters
    ----------
    reading, scalar, passes
        As in `fit_difference`; the first pass neglects Q, each further one uses the last result.

    Returns
    -------
    ndarray, shape (9,)
        Scale factors (1), misalignment angles (deg), offsets (nT).

    Raises
    ------
    CalibrationError
        When the field's directions do not determine nine parameters, or a square turns negative.
    """
    _, y, z = reading.T
    rows, right = _squares_rows(reading, scalar)
    rest = np.zeros_like(scalar)
    for _ in range(passes):
        k, offset = _from_squares(_least_squares(rows, right - rest / (2.0 * scalar)))
        shift, (k2, k3, k5) = -k @ offset, (k[0, 1], k[0, 2], k[1, 2])
        rest = (
            (k2 * y + k3 * z) ** 2
            + (k5 * z) ** 2
            + 2.0 * (shift[0] * (k2 * y + k3 * z) + shift[1] * k5 * z)
            + shift @ shift
        )
    return _pack(k, offset)


def _squares_rows(e: Floats, scalar: Floats) -> tuple[Floats, Floats]:
    """Return rows (time, 9) and right side of ``F^2 = P M``, both over 2F: Q is neglected."""
    x, y, z = e.T
    moments = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    return moments / (2.0 * scalar)[:, None], 0.5 * scalar


def _from_squares(p: Floats) -> tuple[Floats, Floats]:
    """Return matrix and offset of the parameters of ``F^2 = P M + Q``."""
    if np.any(p[:3] <= 0):
        raise CalibrationError("a squared scale factor is negative", remedy="check the readings' unit")
    l1, l4, l6 = np.sqrt(p[:3])
    k = np.array([[l1, p[3] / l1, p[4] / l1], [0.0, l4, p[5] / l4], [0.0, 0.0, l6]])
    return k, -np.linalg.solve(k, np.array([p[6] / l1, p[7] / l4, p[8] / l6]))


#: Least eigenvalue of scaled squares over the largest one: less is rounding.
_ROUNDING = 1e-13

#: The published forms by the name that a comparison's `estimate` states.
_FORMS = {"difference": (_difference_rows, _from_difference), "squares": (_squares_rows, _from_squares)}


def published_gram(form: str, field: Floats, scalar: Floats) -> Floats:
    """Return the sums that one pass of a published form is solved from; those of several days add up.

    Parameters
    ----------
    form : str
        ``difference`` (eq. 2.7) or ``squares`` (the second form, without Q).
    field : ndarray, shape (time, 3)
        Calibrated by the parameters that `published_fit` is told, nT.
    scalar : ndarray, shape (time,)
        nT.

    Returns
    -------
    ndarray, shape (10, 10)
        Of [rows | right side].
    """
    rows, right = _FORMS[form][0](field, scalar)
    both = np.column_stack([rows, right])
    return np.asarray(both.T @ both)


def published_fit(form: str, gram: Floats, value: Floats) -> Floats:
    """Return the nine parameters that one pass of a published form makes of those before; (9,).

    Parameters
    ----------
    gram : ndarray, shape (10, 10)
        As `published_gram`, of any number of days.
    value : ndarray, shape (9,)
        The nine with which the fields were calibrated: scale factors, angles (deg), offsets (nT).

    Raises
    ------
    CalibrationError
        As `fit_difference` and `fit_squares`.
    """
    scale = np.maximum(np.sqrt(np.diag(gram)[:9]), 1e-300)
    square, right = gram[:9, :9] / np.outer(scale, scale), gram[:9, 9] / scale
    size = np.linalg.eigvalsh(square)
    if not size[0] > _ROUNDING * size[-1]:
        raise CalibrationError(
            "the directions of the field do not determine nine parameters",
            remedy="use the fit with priors, which says what is determined",
        )
    step, shift = _FORMS[form][1](np.linalg.solve(square, right) / scale)
    k = np.diag(value[:3])
    k[(0, 0, 1), (1, 2, 2)] = np.cos(np.deg2rad(value[3:6]))
    return _pack(step @ k, value[6:] + np.linalg.solve(k, shift))


def _pack(k: Floats, offset: Floats) -> Floats:
    angles = np.rad2deg(np.arccos([k[0, 1], k[0, 2], k[1, 2]]))
    return np.concatenate([np.diag(k), angles, offset])


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
    sensor = SensorAngles(np.asarray(sensitivity, dtype=np.float64), np.asarray(angles, dtype=np.float64))
    if np.any(sensor.sensitivity <= 0) or np.any(np.abs(sensor.angles) >= 90.0):
        raise ModelError(
            f"sensitivities {sensor.sensitivity.tolist()} and angles {sensor.angles.tolist()} make no sensor",
            remedy="sensitivities are near 1, U near 0 degrees; angles between axes are not U",
        )
    k = np.linalg.inv(sensor.sensitivity[:, None] * sensor.axes)
    cosines = np.array([k[0, 1], k[0, 2], k[1, 2]])
    if np.any(np.abs(cosines) > 1.0):
        raise ModelError("an entry of K exceeds 1 and has no arccosine", remedy="check the angles' unit")
    return np.diag(k).copy(), np.rad2deg(np.arccos(cosines))
