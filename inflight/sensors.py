"""A sensor as the physics sees it: a place, an orientation, a role."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from inflight.mission import Mission


@dataclass(frozen=True)
class Sensor:
    """One magnetometer of a comparison.

    Attributes
    ----------
    name : str
        Instrument in the mission YAML.
    role : str
        Its role in the comparison: vector, scalar, inboard, outboard.
    position : tuple of float, optional
        Metres from the assumed dipole, spacecraft axes.
    orientation : tuple of float
        Quaternion x, y, z, w that turns sensor axes into spacecraft axes.
    dipole_reduction : float, optional
        Field of the assumed dipole here relative to its field at the first vector sensor,
        ``(r_first / r_here) ** 3`` (1 at that sensor; None while a position is unknown).
    """

    name: str
    role: str
    position: tuple[float, float, float] | None = None
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    dipole_reduction: float | None = None

    @property
    def is_scalar(self) -> bool:
        """True for an instrument that reads the field strength."""
        return self.role == "scalar"

    @property
    def rotation(self) -> Rotation:
        """Rotation from sensor to spacecraft axes."""
        return Rotation.from_quat(self.orientation)


def sensors_of(mission: Mission, comparison: str = "main") -> dict[str, Sensor]:
    """Return the sensors of a comparison by instrument name.

    Raises
    ------
    KeyError
        When the mission has no such comparison.
    """
    roles = mission.comparisons[comparison].instruments()
    first = mission.instruments[next(iter(roles.values()))]
    sensors = {}
    for role, name in roles.items():
        instrument = mission.instruments[name]
        reduction = None
        if first.position is not None and instrument.position is not None:
            here, there = np.linalg.norm(instrument.position), np.linalg.norm(first.position)
            reduction = float((there / here) ** 3) if here > 0 else None
        sensors[name] = Sensor(name, role, instrument.position, instrument.orientation, reduction)
    return sensors
