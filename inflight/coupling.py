"""From twelve parameters to the matrix of the calibration equation, at one time or at many."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats


def sensor_axes(elevation: Floats, azimuth: Floats) -> Floats:
    """Return the directions of the three sensors in package axes, one a row (Plaschke et al. 2019, eq. 4).

    Parameters
    ----------
    elevation : ndarray, shape (..., 2)
        By how much sensors 1 and 2 stand further than 90 deg from sensor 3, rad.
    azimuth : ndarray, shape (...)
        By how much their projections stand further than 90 deg apart, rad.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        The inverse of Gamma.
    """
    out = np.zeros((*azimuth.shape, 3, 3))
    # Angles count from 90 deg: sin(90 deg + d) = cos d and cos(90 deg + d) = -sin d.
    out[..., 0, 0], out[..., 0, 2] = np.cos(elevation[..., 0]), -np.sin(elevation[..., 0])
    out[..., 1, 0] = -np.sin(azimuth) * np.cos(elevation[..., 1])
    out[..., 1, 1] = np.cos(azimuth) * np.cos(elevation[..., 1])
    out[..., 1, 2] = -np.sin(elevation[..., 1])
    out[..., 2, 2] = 1.0
    return out


def package_to_spin(spin_axis: Floats, rotation: Floats) -> Floats:
    """Return Phi Sigma, which turns package axes into axes along the spin axis (eqs. 5, 6); (..., 3, 3).

    Parameters
    ----------
    spin_axis : ndarray, shape (..., 2)
        The spin axis in the package is (sin x, cos x sin y, cos x cos y), rad.
    rotation : ndarray, shape (...)
        Turn about it, rad.
    """
    (sx, cx), (sy, cy) = ((np.sin(one), np.cos(one)) for one in np.moveaxis(spin_axis, -1, 0))
    sigma = np.zeros((*rotation.shape, 3, 3))
    sigma[..., 0, 0], sigma[..., 0, 1], sigma[..., 0, 2] = cx, -sx * sy, -sx * cy
    sigma[..., 1, 1], sigma[..., 1, 2] = cy, -sy
    sigma[..., 2, 0], sigma[..., 2, 1], sigma[..., 2, 2] = sx, cx * sy, cx * cy
    return _about_z(rotation) @ sigma


def _about_z(angle: Floats) -> Floats:
    out = np.zeros((*angle.shape, 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(angle)
    out[..., 1, 0], out[..., 0, 1] = np.sin(angle), -np.sin(angle)
    out[..., 2, 2] = 1.0
    return out


def gains_of(gain_ratio: Floats, spin_plane_gain: Floats, axial_gain: Floats) -> Floats:
    """Return the diagonal of G (eq. 7); (..., 3)."""
    return np.stack([gain_ratio * spin_plane_gain, spin_plane_gain / gain_ratio, axial_gain], axis=-1)


def coupling(
    gain_ratio: npt.ArrayLike,
    spin_plane_gain: npt.ArrayLike,
    axial_gain: npt.ArrayLike,
    elevation: npt.ArrayLike,
    azimuth: npt.ArrayLike,
    spin_axis: npt.ArrayLike,
    rotation: npt.ArrayLike,
) -> tuple[Floats, Floats]:
    """Return Phi Sigma Gamma G and its inverse; (..., 3, 3) each (Plaschke et al. 2019, eq. 9).

    Angles in rad as in `sensor_axes` and `package_to_spin`, `elevation` and `spin_axis` of shape (..., 2).
    """
    whole = [
        np.asarray(one, dtype=np.float64)
        for one in (gain_ratio, spin_plane_gain, axial_gain, elevation, azimuth, spin_axis, rotation)
    ]
    gains = gains_of(*whole[:3])
    axes, turn = sensor_axes(whole[3], whole[4]), package_to_spin(whole[5], whole[6])
    inverse = (axes @ np.swapaxes(turn, -1, -2)) / gains[..., :, None]
    return np.asarray(np.linalg.inv(inverse)), inverse
