"""The two published linearisations of the scalar calibration, for comparison with the exact fit.

Both treat the raw readings as nearly right and are linear in products of the parameters; iterated
they reach the exact least squares (Yin 2010, section 2.2).
"""

from __future__ import annotations

import numpy as np

from inflight.arrays import Floats
from inflight.calibration.solution import SINGULAR
from inflight.errors import CalibrationError


def _least_squares(rows: Floats, right: Floats) -> Floats:
    """Solve scaled least squares; a singular system is an error, not an invented number."""
    scale = np.linalg.norm(rows, axis=0)
    found, _, _, singular = np.linalg.lstsq(rows / scale, right, rcond=None)
    if singular[-1] < SINGULAR * singular[0]:
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
        e = (reading - offset) @ k.T
        x, y, z = e.T
        rows = np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z], axis=1) / scalar[:, None]
        p = _least_squares(rows, np.linalg.norm(e, axis=1) - scalar)
        step = np.array([[1 - p[0], -p[3], -p[4]], [0.0, 1 - p[1], -p[5]], [0.0, 0.0, 1 - p[2]]])
        # B = step e - p', with p' = step E0' of the last three: exact, not the approximation P ~ E0.
        offset = offset + np.linalg.solve(k, np.linalg.solve(step, p[6:]))
        k = step @ k
    return _pack(k, offset)


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
    x, y, z = reading.T
    moments = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z], axis=1)
    rows = moments / (2.0 * scalar)[:, None]
    rest = np.zeros_like(scalar)
    for _ in range(passes):
        p = _least_squares(rows, (scalar**2 - rest) / (2.0 * scalar))
        if np.any(p[:3] <= 0):
            raise CalibrationError("a squared scale factor is negative", remedy="check the readings' unit")
        l1, l4, l6 = np.sqrt(p[:3])
        k2, k3, k5 = p[3] / l1, p[4] / l1, p[5] / l4
        shift = np.array([p[6] / l1, p[7] / l4, p[8] / l6])
        rest = (
            (k2 * y + k3 * z) ** 2
            + (k5 * z) ** 2
            + 2.0 * (shift[0] * (k2 * y + k3 * z) + shift[1] * k5 * z)
            + shift @ shift
        )
    k = np.array([[l1, k2, k3], [0.0, l4, k5], [0.0, 0.0, l6]])
    return _pack(k, -np.linalg.solve(k, shift))


def _pack(k: Floats, offset: Floats) -> Floats:
    angles = np.rad2deg(np.arccos([k[0, 1], k[0, 2], k[1, 2]]))
    return np.concatenate([np.diag(k), angles, offset])
