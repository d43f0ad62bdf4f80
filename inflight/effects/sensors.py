"""The equations of vector and scalar magnetometers.

Vector: scale factors, misalignment angles, offsets (Yin 2010, eq. 2.5), non-linearity, temperature, and
parameters that follow a channel. Scalar: time shift, response, oscillator, bias, heading errors (Yin 2010,
section 2.5). `correct` gives the reading of a perfect sensor, `disturb` the raw one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from inflight.arrays import Floats, straight_pieces, times_axes
from inflight.effects.base import (
    AXES,
    Effect,
    Parameter,
    Values,
    field_direction,
    field_strength,
    knots_of,
    multiply,
    reach_of_rate,
    time_derivative,
)
from inflight.effects.families import channels_of_kind, options_of_channels
from inflight.errors import ModelError
from inflight.mission import Mission, Sensor
from inflight.time import SECOND, usual_step

if TYPE_CHECKING:
    import xarray as xr

ANGLES = ("xy", "xz", "yz")

#: Roles that read a vector, in the order of correction: of two fields that of the last one is kept.
VECTOR_ROLES = ("vector", "inboard", "outboard")


class VectorSensor(Effect):
    """Nine parameters of a linear vector sensor: ``B = K (E - E0)``.

    K is upper triangular: its diagonal is `scale_factor`, its entries xy, xz, yz are the cosines of
    `misalignment` (Yin 2010, eq. 2.5). The orthogonal frame has z along the sensor's z axis and y in
    the plane of its y and z axes.
    """

    family = "sensor"
    acts_on = VECTOR_ROLES
    scale_factor = Parameter("1", AXES, default=1.0, sigma=0.01, step=1e-5)
    misalignment = Parameter("deg", ANGLES, default=90.0, sigma=1.0, step=1e-3)
    offset = Parameter("nT", AXES, default=0.0, sigma=200.0)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field in orthogonal sensor axes; (time, axis) nT (Yin 2010, eq. 2.5)."""
        k, c = values["scale_factor"], np.cos(np.deg2rad(values["misalignment"]))
        ex, ey, ez = (reading - values["offset"]).T
        field = np.empty_like(reading)
        field[:, 0] = k[..., 0] * ex + c[..., 0] * ey + c[..., 1] * ez
        field[:, 1] = k[..., 1] * ey + c[..., 2] * ez
        field[:, 2] = k[..., 2] * ez
        return field

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return what the sensor reads in a field; back substitution of eq. 2.5, (time, axis) nT."""
        k, c = values["scale_factor"], np.cos(np.deg2rad(values["misalignment"]))
        bx, by, bz = reading.T
        raw = np.empty_like(reading)
        raw[:, 2] = bz / k[..., 2]
        raw[:, 1] = (by - c[..., 2] * raw[:, 2]) / k[..., 1]
        raw[:, 0] = (bx - c[..., 0] * raw[:, 1] - c[..., 1] * raw[:, 2]) / k[..., 0]
        return raw + values["offset"]


def subtract_angles(reading: Floats, about: Floats, change: Floats) -> Floats:
    """Return the reading of a sensor whose misalignment angles are smaller by a change.

    To first order in the change d of an angle next to 90 deg: ``cos(a + d) - cos(a) = -d`` (Yin 2010,
    eq. 2.5).

    Parameters
    ----------
    reading : ndarray, shape (time, 3)
        nT, sensor axes.
    about : ndarray, shape (3,) or (time, 3)
        Nominal offset, nT: what the angles do not act on.
    change : ndarray, shape (time, 3)
        Of the angles xy, xz, yz; deg.
    """
    xy, xz, yz = -np.deg2rad(change).T
    out = np.array(reading)
    _, ey, ez = (reading - about).T
    out[:, 0] += xy * ey + xz * ez
    out[:, 1] += yz * ez
    return out


def add_angles(reading: Floats, about: Floats, change: Floats) -> Floats:
    """Return what `subtract_angles` made the reading from: back substitution; shapes and units as there."""
    xy, xz, yz = -np.deg2rad(change).T
    zero = np.broadcast_to(about, reading.shape)
    out = np.array(reading)
    ez = out[:, 2] - zero[:, 2]
    out[:, 1] -= yz * ez
    out[:, 0] -= xy * (out[:, 1] - zero[:, 1]) + xz * ez
    return out


class Nonlinearity(Effect):
    """Quadratic and cubic deviation of each axis from a straight line.

    With ``e = E - about``, the linearised reading is ``about + e + quadratic e^2 + cubic e^3``
    (Yin 2010, section 2.4 step 2, divided by the scale factor: ``quadratic = l2 / l0``). `about` is
    the nominal offset, which the thesis takes off first.
    """

    family = "nonlinearity"
    acts_on = VECTOR_ROLES
    axis_by_axis = True
    quadratic = Parameter("1/nT", AXES, step=1e-10, sigma=1e-8)
    cubic = Parameter("1/nT^2", AXES, step=1e-15, sigma=1e-12)
    about = Parameter("nT", AXES)
    #: Newton stops here; the polynomial is so nearly linear that three steps reach rounding.
    _NEWTON_STEPS: ClassVar[int] = 8

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the linearised reading; (time, axis) nT."""
        e = reading - values["about"]
        return np.asarray(reading + e * e * (values["quadratic"] + values["cubic"] * e))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the raw reading: the root of the cubic next to the linear one, by Newton's method.

        Raises
        ------
        ModelError
            When the polynomial is not monotonic within the reading's range.
        """
        q, c = values["quadratic"], values["cubic"]
        target = reading - values["about"]
        e = target.copy()
        for _ in range(self._NEWTON_STEPS):
            slope = 1.0 + e * (2.0 * q + 3.0 * c * e)
            if np.any(slope <= 0.0):
                raise ModelError("the non-linearity is not monotonic over the readings", remedy="lower it")
            e = e - (e + e * e * (q + c * e) - target) / slope
        return np.asarray(e + values["about"])

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


class ResponseCurve(Effect):
    """Deviation of each axis from a straight line, whatever its form: straight pieces between knots.

    Option ``knots`` lists readings, nT, rising. With h_k the piecewise straight function that is 1 at one
    inner knot and 0 at all others, the linearised reading is ``E + sum_k value_k h_k(E)``. At the outer knots
    and beyond the deviation is 0, for a straight line is the sensor's own scale factor and offset. For a
    converter, for measuring ranges of other gains, for a saturation: what no polynomial describes.
    Components of `value` are named by axis and inner knot: x0, y0, z0, x1, ...
    """

    family = "nonlinearity"
    acts_on = VECTOR_ROLES
    options: ClassVar[tuple[str, ...]] = ("knots",)
    value = Parameter("nT", AXES, sigma=10.0)
    #: Deviations are so small a part of the reading that three steps reach rounding.
    _STEPS: ClassVar[int] = 5

    def prepare(self) -> None:
        """Give every inner knot three components.

        Raises
        ------
        ModelError
            When no knot is between two others.
        """
        self._knots = knots_of(self, "knots")
        if self._knots.size < 3:
            raise ModelError(
                f"'{self.name}': knots has no inner one", remedy="list three readings or more, nT"
            )
        axes = tuple(f"{axis}{knot}" for knot in range(self._knots.size - 2) for axis in AXES)
        self.sized = {"value": replace(self.value, axes=axes)}

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the linearised reading; (time, axis) nT."""
        return np.asarray(reading + self._deviation(reading, values["value"]))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the raw reading, by iteration."""
        raw = reading
        for _ in range(self._STEPS):
            raw = reading - self._deviation(raw, values["value"])
        return np.asarray(raw)

    def _deviation(self, reading: Floats, value: Floats) -> Floats:
        """Return what is added to each reading; (time, axis) nT."""
        at = np.broadcast_to(value, (len(reading), value.shape[-1])).reshape(len(reading), -1, len(AXES))
        pieces = straight_pieces(reading, self._knots)[..., 1:-1]
        return np.asarray(np.einsum("tak,tka->ta", pieces, at))


class ScaledReading(Effect):
    """An effect that multiplies the reading less `about`, the nominal offset, by a factor near 1.

    A subclass states `about`, a parameter in nT an axis, and the factor.
    """

    acts_on = VECTOR_ROLES
    axis_by_axis = True

    def factor(self, samples: xr.Dataset, values: Values) -> Floats:
        """Return what the corrected reading is of the reading; (time, axis), 1."""
        raise NotImplementedError

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a sensor without the effect; (time, axis) nT."""
        about = values["about"]
        return np.asarray(about + (reading - about) * self.factor(samples, values))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading as the sensor gives it; (time, axis) nT."""
        about = values["about"]
        return np.asarray(about + (reading - about) / self.factor(samples, values))


class Temperature(ScaledReading):
    """Scale factors that follow a temperature: ``1 - linear dT - quadratic dT^2`` an axis.

    ``dT = T - reference``, T as the channel gives it after its lag (Yin 2010, section 2.4 step 4).
    The factor multiplies the reading less `about`, the nominal offset.
    """

    family = "temperature"
    channels = ("coil_temperature",)
    linear = Parameter("1/K", AXES, step=1e-6, sigma=1e-4)
    quadratic = Parameter("1/K^2", AXES, step=1e-8, sigma=1e-6)
    reference = Parameter("degC", default=20.0)
    about = Parameter("nT", AXES)

    def factor(self, samples: xr.Dataset, values: Values) -> Floats:
        """Return 1 less what the temperature does; (time, axis)."""
        dt = self.channel(samples, "degC") - values["reference"][..., 0]
        slope = times_axes(dt, values["quadratic"]) + values["linear"]
        return np.asarray(1.0 - dt[:, None] * slope)

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature."""
        return options_of_channels(channels_of_kind(mission, "temperature"))


class Affine(Effect):
    """A full affine calibration ``B = matrix E + shift``, as observatories publish it.

    The matrix may rotate; nine parameters of an upper triangular K are the special case without
    rotation.
    """

    family = "sensor"
    acts_on = VECTOR_ROLES
    matrix = Parameter(
        "1",
        tuple(f"{row}{column}" for row in AXES for column in AXES),
        default=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        step=1e-5,
    )
    shift = Parameter("nT", AXES)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``matrix @ reading + shift``; (time, axis) nT."""
        return np.asarray(multiply(values["matrix"], reading) + values["shift"])

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the raw reading; solves the matrix, (time, axis) nT."""
        matrix = values["matrix"].reshape(-1, 3, 3)
        return np.asarray(np.linalg.solve(matrix, (reading - values["shift"])[:, :, None])[:, :, 0])


class TimeShift(Effect):
    """A scalar reading taken `seconds` before the vector reading with the same stamp.

    Corrected ``F + seconds dF/dt``: the same sense as adding `seconds` to the stamps of the vector
    sensor (Yin 2010, section 2.5). dF/dt is that of the corrected vector field, so that `disturb`
    is the exact inverse and the scalar's noise is not differentiated.
    """

    family = "clock"
    acts_on = ("scalar",)
    seconds = Parameter("s", step=1e-2, sigma=0.1)
    reach_s = reach_of_rate

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the early reading; (time,) nT."""
        return np.asarray(reading - _shift_effect(values, samples))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the vector sensor's time; (time,) nT."""
        return np.asarray(reading + _shift_effect(values, samples))

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

    def reach_s(self, cadence_s: float) -> float:
        """Return the time between the two rates, a sample at least, s."""
        return max(_CURVATURE_STEP, cadence_s) + cadence_s

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a slow instrument; (time,) nT."""
        return np.asarray(reading + _mean_effect(values, samples))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of an instrument without delay or mean; (time,) nT."""
        return np.asarray(reading - _mean_effect(values, samples))

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


class HeadingAnisotropy(Effect):
    """Heading error of second order: a scalar reading that depends on the axis of the field in the sensor.

    Corrected ``F - h M h`` with the field's direction h and a symmetric matrix M without trace, of which `zz`
    is ``-(xx + yy)``: the trace is `scalar_bias`, and what follows h itself is `heading`. Unlike what a scale
    factor does, it does not grow with the field.
    """

    family = "sensor"
    acts_on = ("scalar",)
    follows_field = True
    matrix = Parameter("nT", ("xx", "yy", "xy", "xz", "yz"), sigma=0.5)

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return ``M h``, whose part along h the sensor reads; (time, axis) nT."""
        xx, yy, xy, xz, yz = np.moveaxis(values["matrix"], -1, 0)
        flat = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy], axis=-1)
        return multiply(flat, field_direction(samples))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the one candidate there is."""
        return [{}]


#: Seconds between the two rates whose difference is the second rate of change (assumed: a minute in all).
_CURVATURE_STEP = 20.0


def _mean_effect(values: Values, samples: xr.Dataset) -> Floats:
    """Return ``half_variance d2F/dt2`` of the field in the samples; (time,) nT, 0 where it is not known."""
    size, stamps = field_strength(samples), np.asarray(samples["tt2000"].values, dtype=np.int64)
    usual = usual_step(stamps, SECOND) / SECOND
    reach = max(1, round(_CURVATURE_STEP / usual))
    out = np.zeros_like(size)
    if size.size > 2 * reach:
        before, here, after = size[: -2 * reach], size[reach:-reach], size[2 * reach :]
        span = (stamps[2 * reach :] - stamps[: -2 * reach]) / (2.0 * SECOND)
        curvature = (before - 2.0 * here + after) / span**2
        whole = np.isfinite(curvature) & (np.abs(span - reach * usual) < 0.5 * usual)
        out[reach:-reach] = np.where(whole, curvature, 0.0)
    return np.asarray(np.broadcast_to(values["half_variance"][..., 0], size.size) * out)


def _shift_effect(values: Values, samples: xr.Dataset) -> Floats:
    """Return the change of the field within the shift; (time,) nT, 0 without a shift."""
    seconds = np.broadcast_to(values["seconds"][..., 0], samples.sizes["time"])
    return np.where(seconds == 0.0, 0.0, seconds * field_strength_rate(samples))


def field_strength_rate(samples: xr.Dataset) -> Floats:
    """Return d|B|/dt of the best present field estimate; (time,) nT/s, NaN where no neighbour is.

    Central within gap-free runs, one-sided at their ends.
    """
    return time_derivative(field_strength(samples), samples["tt2000"].values)


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
        return np.asarray(1.0 - times_axes(change, values["coefficient"]))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every channel of one number a time."""
        return options_of_channels(channels_of_kind(mission))


class ChannelBias(Effect):
    """A scalar sensor's bias that follows any channel: corrected ``F - coefficient * channel``.

    The channel carries its own reference, ``channel: electronics_temperature@about=20``.
    """

    family = "bias"
    family_by_channel = True
    acts_on = ("scalar",)
    channels = ("",)
    coefficient = Parameter("nT", sigma=1.0, per_channel=1)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with its bias; (time,) nT."""
        return np.asarray(reading + values["coefficient"][..., 0] * self.drive(samples, "coefficient"))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading without it; (time,) nT."""
        return np.asarray(reading - values["coefficient"][..., 0] * self.drive(samples, "coefficient"))


class ChannelClock(Effect):
    """A scalar reading that is early by what follows any channel: `time_shift` of ``coefficient * channel``.

    The channel carries its own reference, ``channel: electronics_temperature@about=20``.
    """

    family = "clock"
    family_by_channel = True
    acts_on = ("scalar",)
    channels = ("",)
    coefficient = Parameter("s", step=1e-2, sigma=0.1, per_channel=1)
    reach_s = reach_of_rate

    def _shift(self, samples: xr.Dataset, values: Values) -> Floats:
        seconds = values["coefficient"][..., 0] * self.drive(samples, "coefficient")
        return _shift_effect({"seconds": np.reshape(seconds, (-1, 1))}, samples)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the early reading; (time,) nT."""
        return np.asarray(reading - self._shift(samples, values))

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading at the vector sensor's time; (time,) nT."""
        return np.asarray(reading + self._shift(samples, values))


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
        return times_axes(change, values["bias"])

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
        return times_axes(change, values["coefficient"])

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading of a sensor with the reference's angles; (time, axis) nT."""
        return subtract_angles(reading, values["about"], self._change(samples, values))

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the channel's angles: back substitution; (time, axis) nT."""
        return add_angles(reading, values["about"], self._change(samples, values))

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return one candidate for every temperature: angles move with heat."""
        return options_of_channels(channels_of_kind(mission, "temperature"))
