"""The equation of an absolute scalar magnetometer: clock, oscillator, bias and its own heading error."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values, strength
from inflight.effects.families import channels_of_kind, options_of_channels
from inflight.effects.rates import slope
from inflight.mission import Mission
from inflight.sensors import Sensor
from inflight.time import SECOND, usual_step


class TimeShift(Effect):
    """A scalar reading taken `seconds` before the vector reading with the same stamp.

    Corrected ``F + seconds dF/dt``: the same sense as adding `seconds` to the stamps of the vector
    sensor (Yin 2010, section 2.5). dF/dt is that of the corrected vector field, so that `disturb`
    is the exact inverse and the scalar's noise is not differentiated.
    """

    family = "clock"
    acts_on = ("scalar",)
    seconds = Parameter("s", step=1e-2, sigma=0.1)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the early reading; (time,) nT."""
        return np.asarray(reading - _shifted(values, samples))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the vector sensor's time; (time,) nT."""
        return np.asarray(reading + _shifted(values, samples))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class ScalarResponse(Effect):
    """A scalar reading that is a mean over some time: ``F + half_variance d2F/dt2``, as a bandwidth makes it.

    To second order a symmetric response of standard deviation s (in time) adds ``s^2 / 2`` times the second
    rate of change: 0.11 s^2 for a Gaussian of 0.28 Hz, 8 pT over the poles of a low orbit. The rate is that
    of the corrected vector field over a minute, in which it hardly changes.
    """

    family = "clock"
    acts_on = ("scalar",)
    half_variance = Parameter("s^2", step=1e-2, sigma=1.0)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a slow instrument; (time,) nT."""
        return np.asarray(reading + _bent(values, samples))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of an instrument without delay or mean; (time,) nT."""
        return np.asarray(reading - _bent(values, samples))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return none: it is known from an instrument's description, and looks like its neighbours' scale."""
        return []


class Oscillator(Effect):
    """Frequency of the instrument's oscillator against its nominal one; corrected ``F f / f_ref``."""

    family = "clock"
    acts_on = ("scalar",)
    channels = ("frequency_ratio",)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of an instrument whose oscillator is off; (time,) nT."""
        return np.asarray(reading / self.channel(samples, "1"))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the nominal frequency; (time,) nT (Yin 2010, section 2.5)."""
        return np.asarray(reading * self.channel(samples, "1"))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every measured frequency ratio."""
        return options_of_channels(channels_of_kind(mission, "frequency"))


class ScalarBias(Effect):
    """A constant the scalar instrument adds to every reading: corrected ``F - bias``."""

    family = "bias"
    acts_on = ("scalar",)
    bias = Parameter("nT", sigma=1.0)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the biased reading; (time,) nT."""
        return np.asarray(reading + values["bias"][..., 0])

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading without bias; (time,) nT."""
        return np.asarray(reading - values["bias"][..., 0])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class Heading(Effect):
    """Heading error of the scalar sensor: a constant vector, seen along the field (Yin 2010, section 2.5)."""

    family = "sensor"
    acts_on = ("scalar",)
    vector = Parameter("nT", AXES, sigma=0.5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the constant vector; (time, axis) nT."""
        return np.asarray(np.broadcast_to(values["vector"], (samples.sizes["time"], 3)))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


#: Seconds between the two rates that tell how a rate changes.
_BEND_STEP = 20.0


def _bent(values: Values, samples: xr.Dataset) -> Floats:
    """Return ``half_variance d2F/dt2`` of the field in the samples; (time,) nT, 0 where nothing tells it."""
    size, stamps = strength(samples), np.asarray(samples["tt2000"].values, dtype=np.int64)
    usual = usual_step(stamps, SECOND) / SECOND
    reach = max(1, round(_BEND_STEP / usual))
    out = np.zeros_like(size)
    if size.size > 2 * reach:
        before, here, after = size[: -2 * reach], size[reach:-reach], size[2 * reach :]
        span = (stamps[2 * reach :] - stamps[: -2 * reach]) / (2.0 * SECOND)
        bend = (before - 2.0 * here + after) / span**2
        whole = np.isfinite(bend) & (np.abs(span - reach * usual) < 0.5 * usual)
        out[reach:-reach] = np.where(whole, bend, 0.0)
    return np.asarray(np.broadcast_to(values["half_variance"][..., 0], size.size) * out)


def _shifted(values: Values, samples: xr.Dataset) -> Floats:
    """Return the change of the field within the shift; (time,) nT, 0 without a shift."""
    seconds = np.broadcast_to(values["seconds"][..., 0], samples.sizes["time"])
    return np.where(seconds == 0.0, 0.0, seconds * rate(samples))


def rate(samples: xr.Dataset) -> Floats:
    """Return d|B|/dt of the best present field estimate; (time,) nT/s, NaN where no neighbour is.

    Central within gap-free runs, one-sided at their ends.
    """
    return slope(strength(samples), samples["tt2000"].values)
