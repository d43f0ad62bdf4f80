"""The equation of a vector magnetometer on a spinning spacecraft, in parameters that the spin tells apart."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.coupling import coupling
from inflight.effects.base import Effect, Parameter, Values, multiply
from inflight.sensors import Sensor

_SENSORS = ("1", "2", "3")


def _steady(value: Floats) -> Floats:
    """Return values (component,) where those at all times (time, component) are the same."""
    if value.ndim == 2 and len(value) and np.array_equal(value, np.broadcast_to(value[:1], value.shape)):
        return np.asarray(value[0])
    return value


class SpinningSensor(Effect):
    """Twelve parameters of a vector sensor that turns: ``B = Phi Sigma Gamma G (E - offset)``.

    B is in axes that turn with the spacecraft, z along the spin axis (Plaschke et al. 2019, eq. 9). Angles
    count from their nominal values: `elevation` of sensors 1 and 2 from 90 deg to sensor 3, `azimuth` from
    90 deg between their projections, `spin_axis` in the sensor package, `rotation` about it. Gains that
    follow a temperature are the effect `temperature`, which stands before.
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
        told = {key: _steady(value) for key, value in values.items() if key != "offset"}
        alone = ("gain_ratio", "spin_plane_gain", "axial_gain", "azimuth", "rotation")
        shape = max((value.shape[:-1] for value in told.values()), key=len)
        wide = {key: np.broadcast_to(value, (*shape, value.shape[-1])) for key, value in told.items()}
        found = coupling(**{key: value[..., 0] if key in alone else value for key, value in wide.items()})
        return found[0].reshape(*found[0].shape[:-2], 9), found[1].reshape(*found[1].shape[:-2], 9)

    @classmethod
    def candidates(cls, mission: Any) -> list[dict[str, Any]]:
        """Return none: a sensor has one equation."""
        return []
