"""Parameters of a vector sensor that follow a channel: scale factors, angles, electronics."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.families import channels_of_kind, options_of_channels
from inflight.effects.vector_sensor import ANGLES, VECTOR_ROLES, ScaledReading, sheared, unsheared
from inflight.mission import Mission
from inflight.sensors import Sensor


class ChannelScale(ScaledReading):
    """Scale factors that follow any channel: corrected = reading times ``1 - coefficient (c - reference)``.

    `reference` is in the channel's own unit. The factor multiplies the reading less `about`, the
    nominal offset. `temperature` is the same with a quadratic term, for the sensor's own heat (Yin 2010,
    section 2.4 step 4).
    """

    family = "sensor"
    family_by_channel = True
    channels = ("",)
    coefficient = Parameter("1", AXES, step=1e-6, sigma=1e-3, per_channel=1)
    reference = Parameter("1")
    about = Parameter("nT", AXES)

    def factor(self, samples: xr.Dataset, values: Values) -> Floats:
        """Return 1 less what the channel does; (time, axis)."""
        change = self.drive(samples, "coefficient", about=values["reference"][..., 0])
        return np.asarray(1.0 - change[:, None] * values["coefficient"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of one number a time."""
        return options_of_channels(channels_of_kind(mission))


class AdcTemperature(ChannelScale):
    """The converter's reference and zero follow the temperature of the electronics.

    The corrected reading is `channel_scale` of the reading less ``bias (c - reference)``; bias and
    scale share one cause, and one reference.
    """

    family = "temperature"
    channels = ("electronics_temperature",)
    bias = Parameter("nT", AXES, sigma=1.0, per_channel=1)

    def _zero(self, samples: xr.Dataset, values: Values) -> Floats:
        change = self.drive(samples, "bias", about=values["reference"][..., 0])
        return np.asarray(change[:, None] * values["bias"])

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the reference temperature; (time, axis) nT."""
        return super().correct(reading - self._zero(samples, values), samples, values, sensor)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the electronics' temperature; (time, axis) nT."""
        return super().disturb(reading, samples, values, sensor) + self._zero(samples, values)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature."""
        return options_of_channels(channels_of_kind(mission, "temperature"))


class ChannelAngle(Effect):
    """Misalignment angles that follow any channel: ``a = a0 + coefficient (c - reference)``.

    To first order in the change d of an angle, which is small: ``cos(a0 + d) - cos(a0) = -d`` (Yin
    2010, eq. 2.5). `reference` is in the channel's own unit; `about` is the nominal offset.
    """

    family = "sensor"
    family_by_channel = True
    acts_on = VECTOR_ROLES
    channels = ("",)
    coefficient = Parameter("deg", ANGLES, step=1e-4, sigma=0.1, per_channel=1)
    reference = Parameter("1")
    about = Parameter("nT", AXES)

    def _change(self, samples: xr.Dataset, values: Values) -> Floats:
        change = self.drive(samples, "coefficient", about=values["reference"][..., 0])
        return np.asarray(change[:, None] * values["coefficient"])

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a sensor with the reference's angles; (time, axis) nT."""
        return sheared(reading, values["about"], self._change(samples, values))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the channel's angles: back substitution; (time, axis) nT."""
        return unsheared(reading, values["about"], self._change(samples, values))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature: angles move with heat."""
        return options_of_channels(channels_of_kind(mission, "temperature"))
