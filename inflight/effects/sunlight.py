"""Fields that come with the Sun: by day and by night, and by the direction it shines from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values
from inflight.effects.channels import weigh
from inflight.effects.families import channels_of_kind, knows_orbit, knows_sun, options_of_channels
from inflight.mission import Mission
from inflight.sensors import Sensor


class DayNight(Effect):
    """A field that is there by day and not by night: ``vector * sunlit`` (Yin 2010, chapter 4).

    `sunlit` is 1 in the Sun and 0 in the shadow, of the orbit's geometry, or any channel of kind
    sunlight. Where no night falls it is a constant and not told from an offset.
    """

    family = "day_night"
    channels = ("sunlit",)
    vector = Parameter("nT", AXES, sigma=5.0, step=0.1)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field by day; (time, axis) nT."""
        return np.asarray(self.series(samples)[:, None] * values["vector"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate from geometry, and one for every channel of sunlight."""
        return [
            *([{}] if knows_orbit(mission) else []),
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
    channels: tuple[str, ...] = ("sun_direction", "sunlit")
    amplitude = Parameter("nT", _of_harmonics(1), sigma=5.0, step=0.1)

    def prepare(self) -> None:
        """Give every harmonic a vector."""
        self._degree = self.whole("degree", 1, 2)
        self.sized = {"amplitude": replace(self.amplitude, axes=_of_harmonics(self._degree))}
        if "channel" in self.given:
            # A direction that is delivered says by itself, as NaN or 0, where there is no Sun.
            self.channels = self.channels[:1]

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the sum of harmonics; (time, axis) nT."""
        basis = harmonics(self.series(samples), self._degree)
        if len(self.channels) > 1:
            lit = self.series(samples, 1)[:, None]
            basis = np.where(lit == 0.0, 0.0, basis * lit)
        return weigh(basis, values["amplitude"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate from geometry, or one for every channel with the Sun's direction."""
        given = channels_of_kind(mission, "sun_direction", width=3)
        found: list[dict[str, Any]] = options_of_channels(given) or ([{}] if knows_sun(mission) else [])
        return [options | more for options in found for more in ({}, {"degree": 2})]


def harmonics(direction: Floats, degree: int) -> Floats:
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
    return np.stack(found, axis=1)
