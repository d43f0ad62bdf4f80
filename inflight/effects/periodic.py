"""Fields that come back: with the orbit, with the Sun, with local time, or at a period of their own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.channels import weigh
from inflight.effects.families import knows_orbit
from inflight.mission import Mission
from inflight.sensors import Sensor

#: Highest order of a series; above it a shape is better told by its own channel.
MOST_ORDER = 12


def of_orders(order: int, sines: bool) -> tuple[str, ...]:
    """Return component names of a series: cx1, cy1, cz1, sx1, sy1, sz1, cx2, ..."""
    parts = "cs" if sines else "c"
    return tuple(f"{part}{axis}{k}" for k in range(1, order + 1) for part in parts for axis in AXES)


class Periodic(Effect):
    """A Fourier series of an angle with a vector for each cosine and sine, up to option ``order``.

    ``sum over k of c_k cos(k angle) + s_k sin(k angle)``; a constant is the sensor's offset. What the
    angle is, subclasses say. Components of `amplitude` are named cx1, cy1, cz1, sx1, ...
    """

    options: ClassVar[tuple[str, ...]] = ("order",)
    #: Without sines the series is even: the same before and after the angle's zero.
    sines: ClassVar[bool] = True
    default_order: ClassVar[int] = 2
    amplitude = Parameter("nT", of_orders(2, True), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Give every order its vectors."""
        self._order = self.whole("order", self.default_order, MOST_ORDER)
        axes = of_orders(self._order, self.sines)
        self.sized = {"amplitude": replace(self.amplitude, axes=axes)}

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the angle of the series; (time,) rad."""
        raise NotImplementedError(f"{type(self).__name__} is a series of no angle")

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the series; (time, axis) nT."""
        angles = self.angle(samples)[:, None] * np.arange(1, self._order + 1)
        parts = [np.cos(angles), np.sin(angles)] if self.sines else [np.cos(angles)]
        return weigh(np.stack(parts, axis=2).reshape(len(angles), -1), values["amplitude"])


class OrbitPeriodic(Periodic):
    """A field that repeats with the orbit: series of `orbit_phase`, 0 at the ascending node."""

    channels = ("orbit_phase",)

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the orbit phase; (time,) rad."""
        return np.deg2rad(self.channel(samples, "deg"))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate where the mission delivers positions."""
        return [{}] if knows_orbit(mission) else []


class SunPeriodic(OrbitPeriodic):
    """A field that repeats with the Sun's place along the orbit: series of `sun_phase`, 0 nearest the Sun."""

    family = "day_night"
    channels = ("sun_phase",)


class DayNightSeries(SunPeriodic):
    """The day/night field without a flag: cosines of `sun_phase` (Yin 2010, chapter 4).

    ``sum of a_k cos(2 pi k (t - t0) / T)`` with t0 nearest the Sun and T the orbit; the first k of a
    square wave of any duty. Its constant part is not told from an offset.
    """

    sines = False
    default_order = 4
    amplitude = Parameter("nT", of_orders(4, False), sigma=5.0, step=0.1)


class LocalTimePeriodic(Periodic):
    """A field that repeats with local time: series of `local_time`, 24 h a turn, 0 at midnight."""

    family = "sun_angle"
    channels = ("local_time",)

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the local time; (time,) rad."""
        return self.series(samples) * (2.0 * np.pi / 24.0)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate where the mission delivers positions."""
        return [{}] if knows_orbit(mission) else []


class Tone(Periodic):
    """A field of one fixed period that no channel tells: option ``period``, a duration.

    Phases count from 2000-01-01T12:00:00 TT, in SI seconds, so that a tone runs on over days and gaps.
    Option ``order`` adds harmonics; 1 when left out.
    """

    family = "tone"
    options: ClassVar[tuple[str, ...]] = ("period", "order")
    default_order = 1
    amplitude = Parameter("nT", of_orders(1, True), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Read the period."""
        super().prepare()
        self._period = self.duration("period")

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the phase since the epoch; (time,) rad."""
        # The remainder is taken of integers: a float of 26 years has no room left for the phase.
        passed = samples["tt2000"].values % self._period
        return np.asarray(2.0 * np.pi * passed / self._period)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every period the mission names."""
        return [{"period": f"{period / 1e9:.12g} s"} for period in mission.periods.values()]
