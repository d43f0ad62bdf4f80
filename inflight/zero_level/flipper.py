"""Offsets of sensors and fields of the spacecraft, separated by a flipper (Helios).

Takes: the corrections found before and after a flip. Makes (`separate_flipped`): `FlipperSolution`, the
offsets of two sensors and the spacecraft's field along two axes, with their covariance. A flipper turns two
sensors into each other's place.

Before the flip sensor 1 lies along x and sensor 3 along z, after it 3 along x and 1 against z. With offsets
C1, C3 of the sensors' package and fields S_x, S_z of the spacecraft the corrections found are

    D' = C1 + S_x,  D'' = C3 + S_x,  C' = C3 + S_z,  C'' = S_z - C1.

Sensor 2 is not turned: its offset and the spacecraft's field along it cannot be separated. Nor can a part
that changes with the flip: the flipper's own field counts as the sensors'. (Where C1 = C3 = 0, S_x = D' and
S_z = C'; the report's remark on that case is wrong.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError

PARTS = ("sensor_1", "sensor_3", "spacecraft_x", "spacecraft_z")

#: Rows C', C'', D', D''; columns as `PARTS`.
_SEEN = np.array([[0, 1, 0, 1], [-1, 0, 0, 1], [1, 0, 1, 0], [0, 1, 1, 0]], dtype=np.float64)


@dataclass(frozen=True)
class FlipperSolution:
    """Offsets of the sensors and fields of the spacecraft, nT, in the order of `PARTS`.

    Attributes
    ----------
    value : ndarray, shape (4,)
    covariance : ndarray, shape (4, 4)
    """

    value: Floats
    covariance: Floats

    @property
    def sigma(self) -> Floats:
        """Standard deviations; (4,), nT."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def significant(self, part: str) -> bool:
        """Whether a part differs from zero by more than twice its error."""
        place = PARTS.index(part)
        return bool(abs(self.value[place]) > 2.0 * self.sigma[place])

    def summary(self) -> str:
        """Return one sentence."""
        parts = [
            f"{name} {v:.2f} +- {s:.2f} nT" for name, v, s in zip(PARTS, self.value, self.sigma, strict=True)
        ]
        return f"{', '.join(parts)}; sensor 2 and the spacecraft's field along it cannot be told apart"


def separate_flipped(
    along_z: tuple[float, float], along_x: tuple[float, float], covariance: Floats
) -> FlipperSolution:
    """Separate sensors and spacecraft.

    Parameters
    ----------
    along_z : tuple of float
        C', C'': corrections along the spin axis before and after the flip, nT.
    along_x : tuple of float
        D', D'': offsets in the spin plane less their pre-flight values, nT.
    covariance : ndarray, shape (4, 4)
        Of (C', C'', D', D''), nT^2.

    Raises
    ------
    CalibrationError
        A correction is missing: three leave one part open.
    """
    seen = np.array([*along_z, *along_x], dtype=np.float64)
    if not np.isfinite(seen).all():
        raise CalibrationError(
            f"{int(np.isfinite(seen).sum())} of the corrections C', C'', D', D'' found, all four needed",
            remedy="take corrections from before and after a flip, with pre-flight values in the spin plane",
        )
    inverse = np.linalg.inv(_SEEN)
    return FlipperSolution(inverse @ seen, inverse @ np.asarray(covariance, dtype=np.float64) @ inverse.T)
