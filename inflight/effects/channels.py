"""Fields that follow housekeeping channels, and fields made by the field itself.

The generic effects, for causes without an equation of their own: proportional to a channel, its square, its
rate, its play, a spline of it, or of two. A coefficient is per unit of the channel: a model may state the
whole unit (``unit: nT/A``), which is converted when the channel comes in another; with plain ``unit: nT`` it
is per unit of the channel as the mission YAML states it.

From the field: soft magnetic parts and eddy currents (Tolles and Lawson; Leliak 1961), and cross-talk.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy

from inflight.arrays import Floats, times_axes
from inflight.effects.base import (
    AXES,
    CHANNEL_OPTIONS,
    Effect,
    Parameter,
    Values,
    best_field,
    knots_of,
    multiply,
    reach_of_rate,
    response_name,
    time_derivative,
)
from inflight.effects.families import channels_of, channels_of_kind, options_of_channels
from inflight.effects.sensors import ANGLES, VECTOR_ROLES
from inflight.errors import ModelError
from inflight.expression import Expression
from inflight.mission import Mission, Sensor

if TYPE_CHECKING:
    import xarray as xr

MATRIX = tuple(f"{row}{column}" for row in AXES for column in AXES)


class ChannelField(Effect):
    """A field proportional to any channel, one coefficient an axis: ``coefficient * channel``.

    The plainest generic effect: the stray field of a current, the thermo-electric field of a
    temperature difference, the field of a switch. Option ``lag`` makes it follow the channel's slow
    response (a heater's field behind its current), ``width`` its play.
    """

    family = "current"
    family_by_channel = True
    channels = ("",)
    coefficient = Parameter("nT", AXES, sigma=10.0, per_channel=1)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``coefficient * channel``; (time, axis) nT."""
        return times_axes(self.along_axes(samples, "coefficient"), values["coefficient"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the channel, in units of the parameter; (time,)."""
        return self.drive(samples, parameter)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of one number a time."""
        return options_of_channels(channels_of_kind(mission))


class ChannelPower(Effect):
    """A field proportional to the square of a channel: the heat of a current, ``coefficient * c^2``."""

    family = "current"
    family_by_channel = True
    channels = ("",)
    coefficient = Parameter("nT", AXES, sigma=10.0, per_channel=2)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``coefficient * channel ** 2``; (time, axis) nT."""
        return times_axes(self.along_axes(samples, "coefficient"), values["coefficient"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the channel, in units of the parameter; (time,)."""
        return self.drive(samples, parameter)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every current: of other channels the field itself is nearly straight."""
        kinds = ("solar_current", "battery_current", "camera_current", "current", "heater", "other")
        return options_of_channels(channels_of_kind(mission, *kinds))


class ChannelMatrix(Effect):
    """A field made from a channel of three components: ``matrix @ channel``.

    Rows of the matrix are field axes, columns the components.
    """

    family = "current"
    family_by_channel = True
    channels = ("",)
    matrix = Parameter("nT", MATRIX, sigma=10.0, per_channel=1)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``matrix @ channel``; (time, axis) nT."""
        return multiply(values["matrix"], self.along_axes(samples, "matrix"))

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the channel's components, in units of the parameter; (time, source)."""
        return self.drive(samples, parameter)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of three components that is no torquer's current."""
        names = channels_of_kind(mission, width=3)
        known = channels_of(mission)
        return options_of_channels([name for name in names if known[name].kind != "torquer_current"])


class ChannelRate(Effect):
    """A field proportional to the rate of change of a channel: ``coefficient * dc/dt``.

    With `channel_field` of the same channel it is the first-order form of a lag, and of a hysteresis
    that depends on how fast the channel moves.
    """

    family = "current"
    family_by_channel = True
    channels = ("",)
    coefficient = Parameter("nT*s", AXES, sigma=1e4, per_channel=1)
    reach_s = reach_of_rate

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``coefficient * dc/dt``; (time, axis) nT."""
        return times_axes(self.along_axes(samples, "coefficient"), values["coefficient"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the channel's rate of change; (time,)."""
        return time_derivative(self.drive(samples, parameter), samples["tt2000"].values)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature: currents change in steps."""
        return options_of_channels(channels_of_kind(mission, "temperature"))


class Hysteresis(Effect):
    """A field that follows a channel and its play: ``direct * c + play * play(c, width)``.

    The play (backlash) operator of option ``width``, in the channel's unit, is the simplest
    hysteresis: the field differs on rising and falling branches and the loop closes where the channel
    turns.
    """

    family = "hysteresis"
    options: ClassVar[tuple[str, ...]] = ("channel", "width")
    channels: tuple[str, ...] = ("", "")
    direct = Parameter("nT", AXES, sigma=10.0, per_channel=1)
    play = Parameter("nT", AXES, sigma=10.0, per_channel=1)

    def prepare(self) -> None:
        """Name the channel and its play; a search makes the effect before it knows a width."""
        plain = response_name(str(self.given["channel"]), self.given.get("lag"))
        known = "width" in self.given
        self.channels = (plain, response_name(plain, width=self.given["width"])) if known else (plain,)

    def require_complete(self) -> None:
        """Refuse a hysteresis without a width."""
        self.required("width")

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the sum of both; (time, axis) nT."""
        direct, play = (self.along_axes(samples, name) for name in ("direct", "play"))
        return times_axes(direct, values["direct"]) + times_axes(play, values["play"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the channel, or its play; (time,)."""
        self.require_complete()
        return self.drive(samples, parameter, ("direct", "play").index(parameter))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of one number a time; widths are tried by the search."""
        return options_of_channels(channels_of_kind(mission))


class FunctionOfChannel(Effect):
    """Any smooth function of a channel: a natural cubic spline through values at knots.

    Option ``knots`` lists them, rising, in the channel's unit. Beyond the outer ones the value stays.
    Components of `value` are named by axis and knot: x0, y0, z0, x1, ...
    """

    family = "current"
    family_by_channel = True
    options: ClassVar[tuple[str, ...]] = ("channel", "lag", "width", "knots")
    source_first = True
    channels = ("",)
    value = Parameter("nT", AXES, sigma=10.0)

    def prepare(self) -> None:
        """Give every knot three components."""
        self._knots = knots_of(self, "knots")
        axes = tuple(f"{axis}{knot}" for knot in range(self._knots.size) for axis in AXES)
        self.sized = {"value": replace(self.value, axes=axes)}

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the spline's value; (time, axis) nT."""
        return weighted_vectors(self.along_axes(samples, "value"), values["value"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the spline of each knot; (time, source)."""
        return spline_basis(self.series(samples), self._knots)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate, with five knots, for every channel whose range the mission states."""
        known = channels_of(mission)
        ranged = [name for name in channels_of_kind(mission) if known[name].range is not None]
        return [
            {"channel": name, "knots": np.linspace(*(known[name].range or (0.0, 1.0)), 5).tolist()}
            for name in ranged
        ]


class FunctionOfTwo(Effect):
    """Any smooth function of two channels: products of the splines of each.

    Options ``channel`` with ``knots`` and ``second`` with ``second_knots``, in the channels' units.
    Components of `value` are named by axis and knots: x0_0, y0_0, z0_0, x0_1, ...
    """

    family = "current"
    family_by_channel = True
    options: ClassVar[tuple[str, ...]] = (*CHANNEL_OPTIONS, "knots", "second", "second_knots")
    source_first = True
    channels = ("", "")
    value = Parameter("nT", AXES, sigma=10.0)

    def prepare(self) -> None:
        """Give every pair of knots three components."""
        self.channels = (self.channels[0], str(self.required("second")))
        self._knots = knots_of(self, "knots"), knots_of(self, "second_knots")
        first, second = (knots.size for knots in self._knots)
        pairs = [f"{axis}{i}_{k}" for i in range(first) for k in range(second) for axis in AXES]
        self.sized = {"value": Parameter("nT", tuple(pairs), sigma=10.0)}

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the surface's value; (time, axis) nT."""
        return weighted_vectors(self.along_axes(samples, "value"), values["value"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the product of splines of each pair of knots; (time, source)."""
        first, second = (spline_basis(self.series(samples, i), knots) for i, knots in enumerate(self._knots))
        return np.asarray(np.einsum("ti,tk->tik", first, second).reshape(len(first), -1))


class FormulaField(Effect):
    """A field proportional to a formula of channels: ``coefficient * formula``.

    Option ``formula`` is an expression of channels in the units of the mission YAML (`Expression`), such as
    ``heater_current * (boom_temperature < 10)``; of a channel of several components ``name[0]`` is the first.
    """

    family = "unknown"
    options: ClassVar[tuple[str, ...]] = ("formula",)
    # The unit of a formula is the user's own: of its size nothing is known beforehand.
    coefficient = Parameter("nT", AXES, sigma=1e5)

    def prepare(self) -> None:
        """Read the formula; its variables are the channels."""
        text = str(self.required("formula"))
        try:
            self._formula = Expression(text)
        except ValueError as error:
            raise ModelError(
                f"'{self.name}': formula: {error}",
                remedy="write such as heater_current * (boom_temperature < 10)",
            ) from None
        self.channels = self._formula.names

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``coefficient * formula``; (time, axis) nT, missing where a channel is."""
        return times_axes(self.along_axes(samples, "coefficient"), values["coefficient"])

    def along_axes(self, samples: xr.Dataset, parameter: str) -> Floats:
        """Return the formula's value; (time,)."""
        series = {name: self.series(samples, index) for index, name in enumerate(self.channels)}
        try:
            found = self._formula.compute(series)
        except (ValueError, IndexError) as error:
            raise ModelError(f"'{self.name}': formula: {error}", remedy="use channels of numbers") from None
        if found.ndim != 1:
            raise ModelError(
                f"'{self.name}': the formula {self._formula.text!r} has several components",
                remedy="name one of a channel's, such as channel[0]",
            )
        return found


def spline_basis(values: Floats, knots: Floats) -> Floats:
    """Return natural cubic splines that are 1 at one knot and 0 at the others; (time, knot)."""
    held = np.clip(values, knots[0], knots[-1])
    return np.asarray(scipy.interpolate.CubicSpline(knots, np.eye(knots.size), bc_type="natural")(held))


def weighted_vectors(basis: Floats, vectors: Floats) -> Floats:
    """Return a sum of vectors, each weighted by a function of time; (time, 3).

    Parameters
    ----------
    basis : ndarray, shape (time, function)
    vectors : ndarray, shape (3 * function,) or (time, 3 * function)
        x, y, z of the first function, then of the second, ...
    """
    if vectors.ndim == 1:
        return np.asarray((vectors.reshape(-1, 3).T @ basis.T).T)
    return np.asarray(np.einsum("tk,tka->ta", basis, vectors.reshape(len(basis), -1, 3)))


#: Components of a symmetric matrix: its diagonal, then above it.
SYMMETRIC = ("xx", "yy", "zz", "xy", "xz", "yz")


class Induced(Effect):
    """Field proportional to the ambient one, axis by axis: ``diagonal * B`` (Yin 2010, section 2.5).

    Soft magnetic material, or a scale factor of one sensor alone.
    """

    family = "induced"
    acts_on = ("scalar", "vector", "inboard", "outboard")
    follows_field = True
    diagonal = Parameter("1", AXES, step=1e-6, sigma=5e-5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``diagonal * B``; (time, axis) nT (Yin 2010, section 2.5, the q terms)."""
        return np.asarray(best_field(samples) * values["diagonal"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class SoftIron(Induced):
    """`induced` with coupling between the axes: a full symmetric matrix times the field.

    The matrix of a body without currents is symmetric (Leliak 1961, eq. 12).
    """

    coupling = Parameter("1", ANGLES, step=1e-6, sigma=5e-5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``matrix @ B``; (time, axis) nT."""
        parts = np.broadcast_arrays(values["diagonal"], values["coupling"])
        return _symmetric(np.concatenate(parts, axis=-1), best_field(samples))


class Eddy(Effect):
    """Field of eddy currents an axis, in seconds: ``diagonal * dB/dt``.

    The field at the sensor is late by `diagonal`, along the boom and across it differently.
    """

    family = "eddy"
    follows_field = True
    diagonal = Parameter("s", AXES, step=1e-2, sigma=0.3)
    reach_s = reach_of_rate

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``diagonal * dB/dt``; (time, axis) nT, NaN where a sample has no neighbour."""
        diagonal = values["diagonal"]
        return np.where(diagonal == 0.0, 0.0, _field_rate(samples) * diagonal)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class VectorClock(Effect):
    """Readings of a vector sensor that are late by `seconds`: ``-seconds * dB/dt``, every axis alike.

    The rate is that in the sensor's axes: the field's along the orbit, and the sensor's turn. Positions that
    are early do the same, but for what attitude manoeuvres add to the turn.
    """

    family = "clock"
    acts_on = ("vector",)
    follows_field = True
    seen_in = ("field_model",)
    seconds = Parameter("s", step=1e-2, sigma=1.0)
    reach_s = reach_of_rate

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``-seconds * dB/dt``; (time, axis) nT, NaN where a sample has no neighbour."""
        seconds = values["seconds"]
        return np.where(seconds == 0.0, 0.0, -seconds * _field_rate(samples))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class ChannelTurn(Effect):
    """A sensor that turns with any channel: ``angle x B`` with the angle ``coefficient * channel``, small.

    A boom or a star tracker's bracket that bends with heat turns the vector sensor against the attitude; only
    another vector of the field shows it. Angles about the axes x, y, z of the sensor.
    """

    family = "sensor"
    family_by_channel = True
    acts_on = VECTOR_ROLES
    channels = ("",)
    follows_field = True
    seen_in = ("field_model",)
    coefficient = Parameter("deg", AXES, step=1e-4, sigma=0.1, per_channel=1)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``angle x B``; (time, axis) nT."""
        angle = times_axes(self.drive(samples, "coefficient"), np.deg2rad(values["coefficient"]))
        return np.asarray(np.cross(angle, best_field(samples)))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature: structures bend with heat."""
        return options_of_channels(channels_of_kind(mission, "temperature"))


class TollesLawson(Effect):
    """Permanent, induced and eddy-current field of a platform (Tolles and Lawson; Leliak 1961).

    ``permanent + induced @ B + eddy @ dB/dt`` with 3, 6 and 9 coefficients; rows of `eddy` are field
    axes. Of a scalar sensor's eighteen columns two are the field strength and its rate, which change
    little on the way: expect them to be badly determined.
    """

    family = "induced"
    acts_on = ("scalar", "vector", "inboard", "outboard")
    follows_field = True
    permanent = Parameter("nT", AXES, step=1.0, sigma=1e3)
    induced = Parameter("1", SYMMETRIC, step=1e-6, sigma=0.1)
    eddy = Parameter("s", MATRIX, step=1e-2, sigma=1.0)
    reach_s = reach_of_rate

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the sum of the three; (time, axis) nT."""
        induced = _symmetric(values["induced"], best_field(samples))
        return np.asarray(
            values["permanent"] + induced + multiply(values["eddy"], _field_rate(samples, order=2))
        )

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is, for a platform that turns in the field."""
        return [{}] if _compares(mission, "platform") else []


class CrossTalk(Effect):
    """Each axis reads some of the others: ``reading = (1 + C) E`` with six numbers off the diagonal.

    Components are named by what reads and what is read: xy is what axis x reads of y. It acts on the
    reading as the electronics pass it on, offsets included.
    """

    family = "sensor"
    acts_on = VECTOR_ROLES
    follows_field = True
    coupling = Parameter("1", ("xy", "xz", "yx", "yz", "zx", "zy"), step=1e-6, sigma=1e-3)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``C @ E``; (time, axis) nT."""
        ex, ey, ez = best_field(samples).T
        c = np.moveaxis(values["coupling"], -1, 0)
        return np.stack([c[0] * ey + c[1] * ez, c[2] * ex + c[3] * ez, c[4] * ex + c[5] * ey], axis=1)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is: a field strength alone cannot separate it from the nine."""
        return [{}] if _compares(mission, "dual") else []


def _compares(mission: Mission, kind: str) -> bool:
    return any(comparison.kind == kind for comparison in mission.comparisons.values())


def _symmetric(parts: Floats, field: Floats) -> Floats:
    """Return a symmetric matrix, (6,) or (time, 6) ordered as `SYMMETRIC`, times vectors; (time, 3)."""
    xx, yy, zz, xy, xz, yz = np.moveaxis(parts, -1, 0)
    bx, by, bz = field.T
    return np.stack([xx * bx + xy * by + xz * bz, xy * bx + yy * by + yz * bz, xz * bx + yz * by + zz * bz]).T


def _field_rate(samples: xr.Dataset, order: int = 4) -> Floats:
    """Return dB/dt of the best present field; (time, axis) nT/s."""
    return time_derivative(best_field(samples), samples["tt2000"].values, order)
