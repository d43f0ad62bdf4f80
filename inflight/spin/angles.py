"""Sensors that are not quite where they should be: exact directions, exact and first-order removal.

Farrell et al. (1995), eqs. (2) to (20), with sensor 2 at the azimuth 90 degrees + dph2, whose direction is
therefore ``(-dph2, 1, dth2)`` to first order: eq. (13) starts with *minus* dph2 Bsp cos wt.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.spin.fits import SpinFits

#: The inverse of directions nearer to a plane than this is not trusted.
_FLAT = 0.05


@dataclass(frozen=True)
class SensorAngles:
    """Directions of the sensors in apparent axes, and their zero levels; angles in radians.

    Attributes
    ----------
    elevation : ndarray, shape (2,)
        Of sensors 1 and 2 out of the spin plane, towards +Z.
    azimuth : ndarray, shape (2,)
        Of sensor 1 from XA and of sensor 2 from YA, both positive in the sense from XA to YA.
    tilt, tilt_azimuth : float
        Of sensor 3 from the spin axis, and the azimuth from XA it is tilted towards.
    zero : ndarray, shape (3,)
        Zero levels, nT: what the sensors read in no field.
    """

    elevation: Floats = field(default_factory=lambda: np.zeros(2))
    azimuth: Floats = field(default_factory=lambda: np.zeros(2))
    tilt: float = 0.0
    tilt_azimuth: float = 0.0
    zero: Floats = field(default_factory=lambda: np.zeros(3))

    def matrix(self) -> Floats:
        """Return the directions R1, R2, R3 as rows, exact; (3, 3)."""
        out = np.empty((3, 3))
        azimuth = self.azimuth + np.array([0.0, np.pi / 2])
        flat = np.cos(self.elevation)
        out[:2, 0], out[:2, 1] = flat * np.cos(azimuth), flat * np.sin(azimuth)
        out[:2, 2] = np.sin(self.elevation)
        aside = np.sin(self.tilt)
        out[2] = aside * np.cos(self.tilt_azimuth), aside * np.sin(self.tilt_azimuth), np.cos(self.tilt)
        return out

    def disturb(self, fields: Floats) -> Floats:
        """Return what the sensors read in apparent fields (time, 3), nT."""
        return np.asarray(_vectors(fields) @ self.matrix().T + self.zero)

    def remove(self, readings: Floats) -> Floats:
        """Return apparent fields (time, 3), nT, from readings, by the exact inverse of [R1; R2; R3].

        Raises
        ------
        CalibrationError
            When the three directions lie in a plane.
        """
        matrix = self.matrix()
        if abs(float(np.linalg.det(matrix))) < _FLAT:
            raise CalibrationError(
                f"the three sensors' directions are nearly in one plane: {matrix.round(3).tolist()}",
                remedy="see the angles and their sigmas before they are used",
            )
        return np.asarray((_vectors(readings) - self.zero) @ np.linalg.inv(matrix).T)

    def remove_first_order(self, readings: Floats, *, azimuth: bool = False, second: bool = False) -> Floats:
        """Return apparent fields by the steps of IMP-8, as a check on the exact inverse.

        The zero levels and ``dth Bz`` leave sensors 1 and 2, ``dth3 Bsp cos(ph3 - sg)`` leaves sensor 3, with
        ``sg = atan2(B2, B1)`` (eqs. 26, 27, 30; here each sample's own Bz, not the fit's C0).

        Parameters
        ----------
        readings : ndarray, shape (time, 3)
            nT.
        azimuth : bool
            Also B1 - dph1 B2 and B2 + dph2 B1 (eq. 32 with its sign reversed, and eq. 33).
        second : bool
            Also ``e B`` (eq. 35), with e of the elevation alone where `azimuth` is taken out: e with dph in
            it after (32) and (33) counts dph^2 twice.
        """
        one, two, three = (_vectors(readings) - self.zero).T
        x, y = one - self.elevation[0] * three, two - self.elevation[1] * three
        strength, angle = np.hypot(x, y), np.arctan2(y, x)
        z = three - self.tilt * strength * np.cos(self.tilt_azimuth - angle)
        if azimuth:
            x, y = x - self.azimuth[0] * y, y + self.azimuth[1] * x
        if second:
            turned = 0.0 if azimuth else 1.0
            share = 0.5 * (self.elevation**2 + turned * self.azimuth**2)
            x, y, z = x * (1.0 + share[0]), y * (1.0 + share[1]), z * (1.0 + 0.5 * self.tilt**2)
        return np.stack([x, y, z], axis=1)


def _vectors(given: Floats) -> Floats:
    if given.ndim != 2 or given.shape[1] != 3:
        raise SamplesError(f"vectors of shape {given.shape} found", remedy="give (time, 3)")
    return given


def phase_between(fits: SpinFits, first: int, second: int) -> npt.NDArray[np.float64]:
    """Return the azimuth of one sensor from another at every fit, radians in (-pi, pi]; (fit,).

    ``arg(Z_second / Z_first) = atan2(C1, C2) of the first - atan2(C1, C2) of the second``: eqs. (24) and (31)
    with their signs reversed, and the ratio of (31) the right way up.
    """
    phasor = fits.phasor
    return np.asarray(np.angle(phasor[:, second] * np.conj(phasor[:, first])))
