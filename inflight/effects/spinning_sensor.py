"""The equation of a vector magnetometer on a spinning spacecraft (Plaschke et al. 2019, eq. 9).

Twelve parameters chosen so that the spin separates them: gains, sensor directions, spin axis, offsets.
`coupling` makes the matrix of the equation from them, at one time or at many.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects.base import Effect, Parameter, Values, multiply
from inflight.mission import Sensor

if TYPE_CHECKING:
    import xarray as xr


def sensor_axes(elevation: Floats, azimuth: Floats) -> Floats:
    """Return the directions of the three sensors in package axes, one a row (Plaschke et al. 2019, eq. 4).

    Parameters
    ----------
    elevation : ndarray, shape (..., 2)
        Angles of sensors 1 and 2 from sensor 3 less 90 deg, rad.
    azimuth : ndarray, shape (...)
        Angle between their projections less 90 deg, rad.

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
    phi = np.zeros((*rotation.shape, 3, 3))
    phi[..., 0, 0] = phi[..., 1, 1] = np.cos(rotation)
    phi[..., 1, 0], phi[..., 0, 1] = np.sin(rotation), -np.sin(rotation)
    phi[..., 2, 2] = 1.0
    return phi @ sigma


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
    angles = (elevation, azimuth, spin_axis, rotation)
    given = [np.asarray(one, dtype=np.float64) for one in (gain_ratio, spin_plane_gain, axial_gain, *angles)]
    gains, axes, to_spin = gains_of(*given[:3]), sensor_axes(*given[3:5]), package_to_spin(*given[5:])
    inverse = (axes @ np.swapaxes(to_spin, -1, -2)) / gains[..., :, None]
    return np.asarray(np.linalg.inv(inverse)), inverse


_SENSORS = ("1", "2", "3")


def _constant_rows(value: Floats) -> Floats:
    """Return values (component,) where those at all times (time, component) are the same."""
    if value.ndim == 2 and len(value) and np.array_equal(value, np.broadcast_to(value[:1], value.shape)):
        return np.asarray(value[0])
    return value


class SpinningSensor(Effect):
    """Twelve parameters of a vector sensor that turns: ``B = Phi Sigma Gamma G (E - offset)``.

    B is in axes that turn with the spacecraft, z along the spin axis (Plaschke et al. 2019, eq. 9). Angles
    count from their nominal values: `elevation` of sensors 1 and 2 from 90 deg to sensor 3, `azimuth` from
    90 deg between their projections, `spin_axis` in the sensor package, `rotation` about it. Gains that
    follow a temperature are the effect `temperature`, listed before it.
    """

    family = "sensor"
    acts_on = ("vector", "inboard", "outboard")
    gain_ratio = Parameter("1", default=1.0, sigma=0.01, step=1e-5)
    spin_plane_gain = Parameter("1", default=1.0, sigma=0.01, step=1e-5)
    axial_gain = Parameter("1", default=1.0, sigma=0.01, step=1e-5)
    elevation = Parameter("rad", _SENSORS[:2], sigma=0.02, step=1e-5)
    azimuth = Parameter("rad", sigma=0.02, step=1e-5)
    spin_axis = Parameter("rad", ("x", "y"), sigma=0.02, step=1e-5)
    rotation = Parameter("rad", sigma=0.02, step=1e-5)
    offset = Parameter("nT", _SENSORS, sigma=200.0)

    #: The eight of the twelve that show in the spin's tones.
    SPIN_RELATED: ClassVar[dict[str, tuple[int, ...]]] = {
        "gain_ratio": (0,),
        "elevation": (0, 1),
        "azimuth": (0,),
        "spin_axis": (0, 1),
        "offset": (0, 1),
    }

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field in turning axes along the spin axis; (time, axis) nT."""
        matrix, _ = self._matrices(values)
        return multiply(matrix, reading - values["offset"])

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return what the sensor reads in a field of turning axes along the spin axis; (time, axis) nT."""
        _, inverse = self._matrices(values)
        return np.asarray(multiply(inverse, reading) + values["offset"])

    @staticmethod
    def _matrices(values: Values) -> tuple[Floats, Floats]:
        """Return the coupling matrix and its inverse, row by row; (9,) or (time, 9)."""
        steady = {key: _constant_rows(value) for key, value in values.items() if key != "offset"}
        single = ("gain_ratio", "spin_plane_gain", "axial_gain", "azimuth", "rotation")
        shape = max((value.shape[:-1] for value in steady.values()), key=len)
        wide = {key: np.broadcast_to(value, (*shape, value.shape[-1])) for key, value in steady.items()}
        found = coupling(**{key: value[..., 0] if key in single else value for key, value in wide.items()})
        return found[0].reshape(*found[0].shape[:-2], 9), found[1].reshape(*found[1].shape[:-2], 9)

    @classmethod
    def candidates(cls, mission: Any) -> list[dict[str, Any]]:
        """Return none: a sensor has one equation."""
        return []
