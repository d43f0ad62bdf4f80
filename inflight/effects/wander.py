"""A parameter of a vector sensor that is not what it was: an irregular drift, followed and not explained."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.sensors import ANGLES, VECTOR_ROLES, add_angles, subtract_angles
from inflight.errors import ModelError
from inflight.mission import Sensor

if TYPE_CHECKING:
    import xarray as xr

_OF = re.compile(r"^(?P<parameter>scale_factor|misalignment|offset)\[(?P<axis>\w+)\]$")

#: Unit, usual step and what is known beforehand of a change, by the parameter.
_CHANGES = {
    "scale_factor": Parameter("1", step=1e-6, sigma=1e-3),
    "misalignment": Parameter("deg", step=1e-4, sigma=0.1),
    "offset": Parameter("nT", sigma=10.0),
}


class Wander(Effect):
    """One parameter of a vector sensor changes: `change` is added to the one that option ``of`` names.

    ``of: scale_factor[z]``, ``misalignment[xy]`` or ``offset[x]``. With ``time: spline`` it follows what
    drifts irregularly. A scale factor is multiplied by ``1 + change``; scale factors and angles act on the
    reading less `about`, the nominal offset.
    """

    family = "unknown"
    empirical = True
    acts_on = VECTOR_ROLES
    options: ClassVar[tuple[str, ...]] = ("of",)
    change = _CHANGES["scale_factor"]
    about = Parameter("nT", AXES)

    def prepare(self) -> None:
        """Read which parameter it is."""
        of = _OF.match(str(self.required("of")))
        axes = ANGLES if of and of["parameter"] == "misalignment" else AXES
        if not of or of["axis"] not in axes:
            raise ModelError(
                f"'{self.name}': of: {self.given['of']!r} is no parameter of a vector sensor",
                remedy="write such as of: scale_factor[z], misalignment[xy] or offset[x]",
            )
        self._parameter, self._axis = of["parameter"], axes.index(of["axis"])
        self.sized = {"change": _CHANGES[self._parameter]}

    def _spread(self, reading: Floats, values: Values) -> Floats:
        """Return the change on its axis, 0 on the others; (time, axis)."""
        out = np.zeros_like(reading)
        out[:, self._axis] = values["change"][..., 0]
        return out

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a sensor whose parameter did not change; (time, axis) nT."""
        change, about = self._spread(reading, values), values["about"]
        if self._parameter == "misalignment":
            return subtract_angles(reading, about, change)
        if self._parameter == "offset":
            return np.asarray(reading - change)
        return np.asarray(about + (reading - about) * (1.0 + change))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading as the sensor gives it; (time, axis) nT."""
        change, about = self._spread(reading, values), values["about"]
        if self._parameter == "misalignment":
            return add_angles(reading, about, change)
        if self._parameter == "offset":
            return np.asarray(reading + change)
        return np.asarray(about + (reading - about) / (1.0 + change))
