"""Fields that come with the Sun, and fields that repeat.

By day and night and by the direction the Sun shines from (Yin 2010, chapter 4); Fourier series of the orbit
phase, the Sun's phase, local time, or a fixed period.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from inflight.arrays import Floats, times_axes
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.channels import weighted_vectors
from inflight.effects.families import channels_of_kind, has_orbit, has_sun_direction, options_of_channels
from inflight.mission import Mission, Sensor

if TYPE_CHECKING:
    import xarray as xr


class DayNight(Effect):
    """A field that is there by day and not by night: ``vector * sunlit`` (Yin 2010, chapter 4).

    `sunlit` is 1 in the Sun and 0 in the shadow, of the orbit's geometry, or any channel of kind
    sunlight. Without nights it is a constant and cannot be separated from an offset.
    """

    family = "day_night"
    channels = ("sunlit",)
    vector = Parameter("nT", AXES, sigma=5.0, step=0.1)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field by day; (time, axis) nT."""
        return times_axes(self.along_axes(samples, "vector"), values["vector"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return whether the Sun shines; (time,)."""
        return self.series(samples)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate from geometry, and one for every channel of sunlight."""
        return [
            *([{}] if has_orbit(mission) else []),
            *options_of_channels(channels_of_kind(mission, "sunlight")),
        ]


def _of_harmonics(degree: int) -> tuple[str, ...]:
    """Return component names: axis, degree and order, as in x1_-1."""
    orders = [(n, m) for n in range(1, degree + 1) for m in range(-n, n + 1)]
    return tuple(f"{axis}{n}_{m}" for n, m in orders for axis in AXES)


class SunDirectionField(Effect):
    """Thermo-electric field by the Sun's direction in sensor axes: real spherical harmonics of it.

    Option ``degree``: 1 (the direction's components y, z, x) or 2 (and its products xy, yz,
    3 z^2 - 1, xz, x^2 - y^2, unnormalised but for factors that make each reach 1). In the shadow the
    field is 0. Components of `amplitude` are named by axis, degree and order: x1_-1, y1_-1, ...
    """

    family = "sun_angle"
    options: ClassVar[tuple[str, ...]] = ("channel", "degree")
    source_first = True
    channels: tuple[str, ...] = ("sun_direction", "sunlit")
    amplitude = Parameter("nT", _of_harmonics(1), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Give every harmonic a vector."""
        self._degree = self.whole_number("degree", 1, 2)
        self.sized = {"amplitude": replace(self.amplitude, axes=_of_harmonics(self._degree))}
        if "channel" in self.given:
            # A delivered direction is NaN or 0 where there is no Sun.
            self.channels = self.channels[:1]

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the sum of harmonics; (time, axis) nT."""
        return weighted_vectors(self.along_axes(samples, "amplitude"), values["amplitude"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the harmonics, 0 in the shadow; (time, source)."""
        basis = spherical_harmonics(self.series(samples), self._degree)
        if len(self.channels) > 1:
            lit = self.series(samples, 1)[:, None]
            basis = np.where(lit == 0.0, 0.0, basis * lit)
        return basis

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate from geometry, or one for every channel with the Sun's direction."""
        given = channels_of_kind(mission, "sun_direction", width=3)
        found: list[dict[str, Any]] = options_of_channels(given) or (
            [{}] if has_sun_direction(mission) else []
        )
        return [options | more for options in found for more in ({}, {"degree": 2})]


def spherical_harmonics(direction: Floats, degree: int) -> Floats:
    """Return real spherical harmonics of degree 1 to `degree` (at most 2); (time, harmonic).

    Parameters
    ----------
    direction : ndarray, shape (time, 3)
        Unit vectors.
    """
    x, y, z = direction.T
    found = [y, z, x]
    if degree > 1:
        found += [2 * x * y, 2 * y * z, 0.5 * (3 * z * z - 1), 2 * x * z, x * x - y * y]
    return np.stack(found).T


#: Highest order of a series; above it the shape is better taken from a channel.
MAX_HARMONIC = 12


def order_names(order: int, sines: bool) -> tuple[str, ...]:
    """Return component names of a series: cx1, cy1, cz1, sx1, sy1, sz1, cx2, ..."""
    parts = "cs" if sines else "c"
    return tuple(f"{part}{axis}{k}" for k in range(1, order + 1) for part in parts for axis in AXES)


class Periodic(Effect):
    """A Fourier series of an angle with a vector for each cosine and sine, up to option ``order``.

    ``sum over k of c_k cos(k angle) + s_k sin(k angle)``; a constant is the sensor's offset. Subclasses
    define the angle. Components of `amplitude` are named cx1, cy1, cz1, sx1, ...
    """

    empirical = True
    options: ClassVar[tuple[str, ...]] = ("order",)
    source_first = True
    #: Without sines the series is even: the same before and after the angle's zero.
    sines: ClassVar[bool] = True
    default_order: ClassVar[int] = 2
    amplitude = Parameter("nT", order_names(2, True), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Give every order its vectors."""
        self._order = self.whole_number("order", self.default_order, MAX_HARMONIC)
        axes = order_names(self._order, self.sines)
        self.sized = {"amplitude": replace(self.amplitude, axes=axes)}

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the angle of the series; (time,) rad."""
        raise NotImplementedError(f"{type(self).__name__} is a series of no angle")

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the series; (time, axis) nT."""
        return weighted_vectors(self.along_axes(samples, "amplitude"), values["amplitude"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the cosine and the sine of each order; (time, source)."""
        angles = np.arange(1, self._order + 1)[:, None] * self.angle(samples)
        parts = [np.cos(angles), np.sin(angles)] if self.sines else [np.cos(angles)]
        return np.stack(parts, axis=1).reshape(-1, angles.shape[1]).T


class OrbitPeriodic(Periodic):
    """A field that repeats with the orbit: ``sum over k of c_k cos(k u) + s_k sin(k u)``.

    u is `orbit_phase`, the argument of latitude, 0 at the ascending node.
    """

    channels = ("orbit_phase",)

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the orbit phase; (time,) rad."""
        return np.deg2rad(self.channel(samples, "deg"))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate where the mission delivers positions."""
        return [{}] if has_orbit(mission) else []


class SunPeriodic(OrbitPeriodic):
    """A field that repeats with the Sun's place along the orbit: ``sum of c_k cos(k p) + s_k sin(k p)``.

    p is `sun_phase`, 0 where the orbit is nearest the Sun.
    """

    family = "day_night"
    channels = ("sun_phase",)


class DayNightSeries(SunPeriodic):
    """The day/night field without a flag: cosines of `sun_phase` (Yin 2010, chapter 4).

    ``sum of a_k cos(2 pi k (t - t0) / T)`` with t0 nearest the Sun and T the orbit; the first k of a
    square wave of any duty. Its constant part cannot be separated from an offset.
    """

    sines = False
    default_order = 4
    amplitude = Parameter("nT", order_names(4, False), sigma=5.0, step=0.1)


class LocalTimePeriodic(Periodic):
    """A field that repeats with local time: ``sum over k of c_k cos(k h) + s_k sin(k h)``.

    h is `local_time`, 24 h a turn, 0 at midnight.
    """

    family = "sun_angle"
    channels = ("local_time",)

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the local time; (time,) rad."""
        return self.series(samples) * (2.0 * np.pi / 24.0)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate where the mission delivers positions."""
        return [{}] if has_orbit(mission) else []


class Tone(Periodic):
    """A field of one fixed period without a channel: option ``period``, a duration.

    Phases count from 2000-01-01T12:00:00 TT, in SI seconds, so that a tone runs on over days and gaps.
    Option ``order`` adds harmonics; 1 when left out.
    """

    family = "tone"
    options: ClassVar[tuple[str, ...]] = ("period", "order")
    default_order = 1
    amplitude = Parameter("nT", order_names(1, True), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Read the period."""
        super().prepare()
        self._period = self.duration("period")

    def angle(self, samples: xr.Dataset) -> Floats:
        """Return the phase since the epoch; (time,) rad."""
        # The remainder is taken of integers: a float of 26 years is too coarse for the phase.
        passed = samples["tt2000"].values % self._period
        return np.asarray(2.0 * np.pi * passed / self._period)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every period the mission names."""
        return [{"period": f"{period / 1e9:.12g} s"} for period in mission.periods.values()]
