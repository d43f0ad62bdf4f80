"""The calibration equation of a magnetometer on a spinning spacecraft (Plaschke et al. 2019, eq. 9).

Takes: readings along the sensor axes, corrected for temperature. Makes: the field in axes that turn with the
spacecraft, z along the spin axis, and back (`CalibrationParameters.correct`, `disturb`).

``B = Phi Sigma Gamma G (G_T B_S - O)``; O stands outside G. The sensor's own angles (Gamma), the direction of
the spin axis in the sensor package (Sigma), the rotation about it (Phi) and the gains (G) are separate
parameters, so that a manoeuvre, which moves the spin axis in the spacecraft, changes two of them only::

    rows of Gamma^-1: [sin th1, 0, cos th1], [cos ph12 sin th2, sin ph12 sin th2, cos th2], [0, 0, 1]
    Sigma = [c 0 -s; 0 1 0; s 0 c](sPx) [1 0 0; 0 c -s; 0 s c](sPy),   G = diag(g Gp, Gp / g, Ga)

`spin_related` gives the eight parameters that disturb the field at the spin frequency or at twice it (eq.
21).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects import coupling, gains_of, package_to_spin, sensor_axes
from inflight.errors import CalibrationError

#: The twelve parameters in the order of tables.
PARAMETER_NAMES = (
    "gain_ratio",
    "spin_plane_gain",
    "axial_gain",
    "elevation[1]",
    "elevation[2]",
    "azimuth",
    "spin_axis[x]",
    "spin_axis[y]",
    "rotation",
    "offset[1]",
    "offset[2]",
    "offset[3]",
)

#: The eight that disturb the field at the spin frequency or at twice it.
SPIN_RELATED = (
    "gain_ratio",
    "elevation[1]",
    "elevation[2]",
    "azimuth",
    "spin_axis[x]",
    "spin_axis[y]",
    "offset[1]",
    "offset[2]",
)

#: Units of the parameters by name.
PARAMETER_UNITS: Mapping[str, str] = MappingProxyType(
    {
        name: "nT" if name.startswith("offset") else "1" if "gain" in name else "rad"
        for name in PARAMETER_NAMES
    }
)


@dataclass(frozen=True)
class CalibrationParameters:
    """Parameters of the calibration equation; the default is a perfect sensor.

    Attributes
    ----------
    gain_ratio : float
        g: the square root of the gain along sensor axis 1 over that along axis 2.
    spin_plane_gain, axial_gain : float
        Gp, the geometric mean of the first two gains, and Ga, the third; nT per delivered unit.
    elevation : tuple of 2 floats
        By how much sensor axes 1 and 2 stand further than 90 deg from axis 3, rad.
    azimuth : float
        By how much their projections on the plane across axis 3 stand further than 90 deg apart, rad.
    spin_axis : tuple of 2 floats
        sPx, sPy: the spin axis in the sensor package is (sin sPx, cos sPx sin sPy, cos sPx cos sPy), rad.
    rotation : float
        phi_a, turn of the package about the spin axis, rad.
    offset : tuple of 3 floats
        Reading in no field along the sensor axes, after the temperature correction, delivered unit (nT).
    """

    gain_ratio: float = 1.0
    spin_plane_gain: float = 1.0
    axial_gain: float = 1.0
    elevation: tuple[float, float] = (0.0, 0.0)
    azimuth: float = 0.0
    spin_axis: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_values(cls, values: npt.ArrayLike) -> CalibrationParameters:
        """Return parameters from twelve numbers in the order of `NAMES`."""
        one = [float(value) for value in np.asarray(values, dtype=np.float64)]
        if len(one) != len(PARAMETER_NAMES):
            raise CalibrationError(
                f"{len(one)} values found, {len(PARAMETER_NAMES)} needed",
                remedy=f"give them in the order {PARAMETER_NAMES}",
            )
        elevation, axis, offset = (one[3], one[4]), (one[6], one[7]), (one[9], one[10], one[11])
        return cls(one[0], one[1], one[2], elevation, one[5], axis, one[8], offset)

    def values(self) -> Floats:
        """Return the twelve numbers in the order of `NAMES`; shape (12,)."""
        return np.array(
            [
                self.gain_ratio,
                self.spin_plane_gain,
                self.axial_gain,
                *self.elevation,
                self.azimuth,
                *self.spin_axis,
                self.rotation,
                *self.offset,
            ],
            dtype=np.float64,
        )

    def spin_related(self) -> Floats:
        """Return the eight numbers in the order of `SPIN_RELATED`; shape (8,)."""
        return self.values()[[PARAMETER_NAMES.index(name) for name in SPIN_RELATED]]

    def changed(self, new: Mapping[str, float]) -> CalibrationParameters:
        """Return the same parameters but for those named."""
        unknown = sorted(set(new) - set(PARAMETER_NAMES))
        if unknown:
            raise CalibrationError(
                f"no parameter is called {unknown}", remedy=f"take one of {PARAMETER_NAMES}"
            )
        values = self.values()
        for name, value in new.items():
            values[PARAMETER_NAMES.index(name)] = value
        return CalibrationParameters.from_values(values)

    def factors(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return Phi, Sigma, Gamma and G (eqs. 4 to 7), each of shape (3, 3)."""
        turn, none = np.array(self.rotation), np.zeros(2)
        phi = package_to_spin(none, turn)
        sigma = package_to_spin(np.array(self.spin_axis), np.zeros_like(turn))
        axes = sensor_axes(np.array(self.elevation), np.array(self.azimuth))
        gains = [np.array(one) for one in (self.gain_ratio, self.spin_plane_gain, self.axial_gain)]
        return phi, sigma, np.asarray(np.linalg.inv(axes), dtype=np.float64), np.diag(gains_of(*gains))

    def matrix(self) -> Floats:
        """Return the coupling matrix Phi Sigma Gamma G; shape (3, 3)."""
        angles = (self.elevation, self.azimuth, self.spin_axis, self.rotation)
        return coupling(self.gain_ratio, self.spin_plane_gain, self.axial_gain, *angles)[0]

    def correct(self, readings: Floats) -> Floats:
        """Return the field of temperature-corrected readings.

        Parameters
        ----------
        readings : ndarray, shape (time, 3)
            Along the sensor axes, nT.

        Returns
        -------
        ndarray, shape (time, 3)
            Spin-aligned axes that turn with the spacecraft, z along the spin axis; nT.
        """
        return np.asarray((readings - np.array(self.offset)) @ self.matrix().T)

    def disturb(self, fields: Floats) -> Floats:
        """Return the readings in a field: the exact inverse of `correct`; same shapes."""
        return np.asarray(fields @ np.linalg.inv(self.matrix()).T + np.array(self.offset))
