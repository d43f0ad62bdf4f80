"""What an effect is: parameters with units, the channels it needs, the field it adds at a sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import ModelError, SamplesError
from inflight.sensors import Sensor
from inflight.units import factor_and_offset

if TYPE_CHECKING:
    from inflight.mission import Mission

#: Values of an effect's parameters: each an array over the parameter's axes, or (time, axes).
Values = Mapping[str, Floats]
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Parameter:
    """A number of an effect.

    Attributes
    ----------
    unit : str
        Unit of the value.
    axes : tuple of str, optional
        Names of the components; None for a single number.
    default : float or tuple of float
        Value that does nothing, or the nominal one.
    sigma : float
        What is known beforehand: standard deviation of the prior around `default`.
    bounds : tuple of float, optional
        Physical limits.
    step : float
        Typical size, the unit of finite differences and of scaled columns.
    linear : bool
        False when the residual bends within a typical step.
    bank : tuple of float, optional
        Grid of a parameter that is searched, not solved for (a lag, a width).
    """

    unit: str
    axes: tuple[str, ...] | None = None
    default: float | tuple[float, ...] = 0.0
    sigma: float = float("inf")
    bounds: tuple[float, float] | None = None
    step: float = 1.0
    linear: bool = True
    bank: tuple[float, ...] | None = None

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.axes) if self.axes else 1

    @property
    def default_values(self) -> Floats:
        """Default as an array over the axes."""
        return np.broadcast_to(np.asarray(self.default, dtype=np.float64), (self.size,)).copy()


class Effect:
    """One physical cause of disagreement between sensors.

    Subclasses set `family`, `channels` and class attributes of type `Parameter`, and override
    `field`. Effects inside an instrument's equation override `disturb` and `correct`, which must be
    exact inverses of each other.

    Parameters
    ----------
    name : str, optional
        Name in the model; the registered name when absent.
    **options : Any
        The effect's own options, as written in the model YAML (such as ``channel``).
    """

    family: ClassVar[str] = "unknown"
    #: Names in the samples; an option ``channel`` replaces the first one.
    channels: tuple[str, ...] = ()
    #: Options the YAML may give beside parameters.
    options: ClassVar[tuple[str, ...]] = ("channel",)

    def __init__(self, name: str = "", **options: Any) -> None:
        unknown = set(options) - set(self.options)
        if unknown:
            raise ModelError(
                f"effect '{self.label()}' has no option {', '.join(sorted(unknown))}",
                remedy=f"it has options {', '.join(self.options)}, parameters {', '.join(self.parameters())}",
            )
        self.name = name or self.label()
        self.given = dict(options)
        if "channel" in options:
            self.channels = (str(options["channel"]), *self.channels[1:])

    @classmethod
    def label(cls) -> str:
        """Registered name: the class name in snake case."""
        return "".join(f"_{c.lower()}" if c.isupper() else c for c in cls.__name__).lstrip("_")

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """Return the parameters by name, in the order of their definition."""
        found: dict[str, Parameter] = {}
        for base in reversed(cls.__mro__):
            found |= {key: value for key, value in vars(base).items() if isinstance(value, Parameter)}
        return found

    @classmethod
    def candidates(cls, mission: Mission) -> list[dict[str, Any]]:
        """Return the options of one candidate for every channel of the kind the effect is made from."""
        return []

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return what the cause adds at `sensor`; (time, axis) nT in the vector sensor's orthogonal axes."""
        raise NotImplementedError(f"{type(self).__name__} adds no field")

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the effect in it; (time, axis) or, for a scalar sensor, (time,) nT."""
        return reading + self._at(samples, values, sensor)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the reading with the effect taken out; the exact inverse of `disturb`."""
        return reading - self._at(samples, values, sensor)

    def _at(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        """Return the field as the sensor sees it: a vector, or its projection on the field direction."""
        field = self.field(samples, values, sensor)
        if not sensor.is_scalar:
            return field
        return np.asarray(np.einsum("ta,ta->t", direction(samples), field))

    @property
    def is_additive(self) -> bool:
        """True when the effect only adds a field that does not depend on the reading."""
        return type(self).correct is Effect.correct

    def channel(self, samples: xr.Dataset, unit: str, index: int = 0) -> Floats:
        """Return a channel of this effect in `unit`; (time,) or (time, axis).

        Raises
        ------
        SamplesError
            When the channel is missing or has another dimension.
        """
        name = self.channels[index]
        if name not in samples:
            raise SamplesError(
                f"effect '{self.name}' needs a channel the samples have not",
                channel=name,
                remedy="name it in the mission YAML, or drop the effect from the model",
            )
        series = samples[name]
        try:
            factor, offset = factor_and_offset(str(series.attrs.get("units", unit)), unit)
        except ValueError as error:
            raise SamplesError(str(error), channel=name, remedy="correct the channel's unit") from None
        return np.asarray(series.values, dtype=np.float64) * factor + offset


def best_field(samples: xr.Dataset) -> Floats:
    """Return the best present field estimate; (time, axis) nT, vector sensor axes.

    Raises
    ------
    SamplesError
        When there is none yet: an effect that needs the field stands where the field is being made.
    """
    if "field" not in samples:
        raise SamplesError(
            "the field is not known before the vector sensor's readings are corrected",
            channel="field",
            remedy="an effect that follows the field acts on the scalar sensor, or overrides "
            "'correct' and 'disturb' to work on the reading itself",
        )
    return np.asarray(samples["field"].values, dtype=np.float64)


def with_field(samples: xr.Dataset, field: Floats) -> xr.Dataset:
    """Return samples that hold a field estimate (time, axis), nT, and its direction for all who ask."""
    dims = ("time", "axis")
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = field / np.sqrt(np.einsum("ta,ta->t", field, field))[:, None]
    return samples.assign(
        field=(dims, field, {"units": "nT", "frame": "sensor"}), field_direction=(dims, unit, {"units": "1"})
    )


def direction(samples: xr.Dataset) -> Floats:
    """Return the unit vector of the best present field estimate; (time, axis), vector sensor axes."""
    if "field_direction" in samples:
        return np.asarray(samples["field_direction"].values, dtype=np.float64)
    field = best_field(samples)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(field / np.linalg.norm(field, axis=1, keepdims=True))


def multiply(flat: Floats, vectors: Floats) -> Floats:
    """Return matrix times vector at each time; (time, 3).

    Parameters
    ----------
    flat : ndarray, shape (9,) or (time, 9)
        Matrix, row by row, constant or at each time.
    vectors : ndarray, shape (time, 3)
    """
    if flat.ndim == 1:
        return vectors @ flat.reshape(3, 3).T
    return np.asarray(np.einsum("tij,tj->ti", flat.reshape(-1, 3, 3), vectors))


def strength(samples: xr.Dataset) -> Floats:
    """Return |B| of the best present field estimate; (time,) nT."""
    return np.asarray(np.linalg.norm(best_field(samples), axis=1))
