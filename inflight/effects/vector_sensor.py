"""The equation of a vector magnetometer: scale factors, misalignment angles, offsets, and its finer terms."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import AXES, Effect, Parameter, Values, multiply
from inflight.effects.families import channels_of_kind, options_of_channels
from inflight.errors import ModelError
from inflight.mission import Mission
from inflight.sensors import Sensor

ANGLES = ("xy", "xz", "yz")
#: Roles of sensors that read a vector.
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


def sheared(reading: Floats, about: Floats, change: Floats) -> Floats:
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


def unsheared(reading: Floats, about: Floats, change: Floats) -> Floats:
    """Return what `sheared` made the reading from: back substitution; shapes and units as there."""
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
        """Return the bent reading: the root of the cubic next to the linear one, by Newton's method.

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


class ScaledReading(Effect):
    """An effect that multiplies the reading less `about`, the nominal offset, by a factor near 1.

    Whoever derives from it states `about`, a parameter in nT an axis, and says what the factor is.
    """

    acts_on = VECTOR_ROLES

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
        dt = (self.channel(samples, "degC") - values["reference"][..., 0])[:, None]
        return np.asarray(1.0 - dt * (values["linear"] + values["quadratic"] * dt))

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
