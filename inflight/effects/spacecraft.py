"""Fields the spacecraft itself makes at a sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values, multiply
from inflight.mission import Mission
from inflight.sensors import Sensor


class Torquer(Effect):
    """Stray field of the three magneto-torquers: ``matrix @ current`` (Yin 2010, section 2.3).

    Rows of the matrix are field axes, columns the coils; each sensor has its own matrix.
    """

    family = "torquer"
    channels = ("torquer_current",)
    matrix = Parameter("nT/A", tuple(f"{row}{coil}" for row in AXES for coil in AXES), sigma=5.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the stray field; (time, axis) nT."""
        current = self.channel(samples, "A")
        return multiply(values["matrix"], current)


class Remanent(Effect):
    """Constant field of the spacecraft's magnetised parts at one sensor."""

    family = "remanent"
    vector = Parameter("nT", AXES, sigma=1.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the constant vector; (time, axis) nT."""
        return np.asarray(np.broadcast_to(values["vector"], (samples.sizes["time"], 3)))


class ChannelField(Effect):
    """A field proportional to any channel, one coefficient an axis, in nT per unit of the channel.

    The plainest generic effect: the stray field of a current, the thermo-electric field of a
    temperature difference, the field of a switch.
    """

    family = "current"
    channels = ("",)
    coefficient = Parameter("nT", AXES, sigma=10.0)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``coefficient * channel``; (time, axis) nT."""
        name = self.channels[0]
        unit = str(samples[name].attrs.get("units", "1")) if name in samples else "1"
        return np.asarray(self.channel(samples, unit)[:, None] * values["coefficient"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of one number a time."""
        return [
            {"channel": name} for _, name, channel in mission.channel_instruments() if not channel.axis_names
        ]
