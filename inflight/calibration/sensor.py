"""The nine parameters of a model's vector sensor: their reference and prior, and the chain around them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.effects.base import with_field
from inflight.effects.vector_sensor import VectorSensor
from inflight.errors import ModelError
from inflight.flags import UNUSABLE
from inflight.model import Model, ModelEffect
from inflight.model.chain import corrected
from inflight.model.timed import component_names
from inflight.plain import PlainSamples

#: Physical size of one scaled unit: 10 ppm, a thousandth of a degree, 1 nT.
SCALE = np.array([1e-5] * 3 + [1e-3] * 3 + [1.0] * 3)
PARTS = ("scale_factor", "misalignment", "offset")
UNITS = ("1",) * 3 + ("deg",) * 3 + ("nT",) * 3


@dataclass(frozen=True)
class Reference:
    """Where the fit starts and what is known beforehand, physical units; shape (9,) each."""

    value: Floats
    sigma: Floats
    name: str = "vector_sensor"

    @property
    def columns(self) -> list[str]:
        """Names of the nine columns, ``vector_sensor.scale_factor[x]`` and so on."""
        parameters = VectorSensor.parameters()
        return [name for part in PARTS for name in component_names(f"{self.name}.{part}", parameters[part])]


def vector_sensor_of(model: Model) -> ModelEffect:
    """Return the model's nine-parameter effect.

    Raises
    ------
    ModelError
        When the model has none, or more than one.
    """
    found = [entry for entry in model.effects if isinstance(entry.effect, VectorSensor)]
    if len(found) != 1:
        raise ModelError(
            f"model '{model.name}' has {len(found)} effects 'vector_sensor', a scalar calibration needs one",
            remedy="add one to the model YAML",
        )
    return found[0]


def reference_of(model: Model, tt2000: int) -> Reference:
    """Return values and prior sigmas of the nine parameters at a time; those no block fits get sigma 0.

    A parameter that is free but constant, or a function of time, is refined over the whole span (see
    `inflight.diagnosis`); a block's own fit leaves it alone.

    Raises
    ------
    ModelError
        When a block's own parameter has an infinite sigma.
    """
    entry = vector_sensor_of(model)
    timed = [entry.parameters[part] for part in PARTS]
    own = [part.free and part.time == "block" for part in timed]
    for part, is_own in zip(timed, own, strict=True):
        if is_own and not np.all(np.isfinite(part.sigma)):
            raise ModelError(
                f"'{part.key}' is fitted once a block and its sigma is {part.sigma[:, 0].tolist()}",
                remedy="give a finite sigma, however wide",
            )
    value = np.concatenate([part.at(tt2000) for part in timed])
    sigma = np.concatenate(
        [part.sigma[:, 0] if is_own else np.zeros(3) for part, is_own in zip(timed, own, strict=True)]
    )
    return Reference(value, sigma, entry.name)


def split_chain(model: Model, samples: xr.Dataset) -> tuple[Floats, Floats, Floats]:
    """Take everything but the nine parameters out of the readings.

    Returns
    -------
    reading : ndarray, shape (time, 3)
        What enters the sensor's equation, nT.
    additive : ndarray, shape (time, 3) or (1, 3)
        Fields to be subtracted behind it, nT, orthogonal sensor axes.
    scalar : ndarray, shape (time,)
        Corrected scalar field at the reference parameters, nT.

    Raises
    ------
    ModelError
        When an effect behind ``vector_sensor`` is not additive.
    """
    own = vector_sensor_of(model)
    known = PlainSamples.of(samples)
    light, times = cast("xr.Dataset", known), known["tt2000"].values
    reading = sensor_reading(model, samples)
    additive = np.zeros((1, 3))
    entries = [entry for entry in model.effects if entry.sensor.role == "vector"]
    for entry in entries[entries.index(own) + 1 :]:
        if not entry.effect.is_additive:
            raise ModelError(
                f"effect '{entry.name}' stands behind '{own.name}' but does not only add a field",
                remedy="list it before the vector_sensor",
            )
        additive = additive + entry.effect.field(light, entry.values(times), entry.sensor)
    field = own.effect.correct(reading, light, own.values(times), own.sensor) - additive
    # With the field given, and no vector reading to make it from, the scalar sensor's chain is left.
    seen = with_field(cast("xr.Dataset", known.drop_vars(["vector"])), field)
    scalar = corrected(
        [entry for entry in model.effects if entry.sensor.role == "scalar"], cast("PlainSamples", seen)
    )
    return reading, additive, np.asarray(scalar["scalar"].values, dtype=np.float64)


def sensor_reading(model: Model, samples: xr.Dataset) -> Floats:
    """Return what enters the equation of the model's vector sensor; (time, 3) nT."""
    own = vector_sensor_of(model)
    known = PlainSamples.of(samples)
    light, times = cast("xr.Dataset", known), known["tt2000"].values
    reading = np.asarray(known["vector"].values, dtype=np.float64)
    entries = [entry for entry in model.effects if entry.sensor.role == "vector"]
    for entry in entries[: entries.index(own)]:
        reading = entry.effect.correct(reading, light, entry.values(times), entry.sensor)
    return reading


def usable(samples: xr.Dataset, reading: Floats, additive: Floats, scalar: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples may enter a fit; (time,)."""
    good = (samples["flag"].values & np.uint32(UNUSABLE)) == 0
    finite = np.isfinite(reading.sum(axis=1)) & np.isfinite(scalar) & np.isfinite(additive.sum(axis=1))
    return np.asarray(good & finite & (scalar > 0))


def kernel_parameters(value: Floats) -> Floats:
    """Return the kernel's parameters (9,) of physical ones (9,): angles in degrees become entries of K."""
    return np.concatenate([value[:3], np.cos(np.deg2rad(value[3:6])), value[6:]])


def kernel_scale(value: Floats) -> Floats:
    """Return the change of the kernel's parameters (9,) by one scaled unit, at physical ones (9,)."""
    scale = SCALE.copy()
    scale[3:6] *= -np.sin(np.deg2rad(value[3:6])) * np.pi / 180.0
    return scale


def bend(value: Floats, reference: Floats, strength: float) -> float:
    """Return by how much the residual bends between two sets of parameters; nT.

    A change dB of the corrected field across the field's direction lengthens it by dB^2 / 2 B; a
    change of all scale factors alike is along the field and bends nothing.

    Parameters
    ----------
    value, reference : ndarray, shape (9,)
        Physical units.
    strength : float
        Field strength, nT.
    """
    change = kernel_parameters(value) - kernel_parameters(reference)
    change[:3] -= change[:3].mean()
    across = float(np.hypot(np.linalg.norm(change[:6]) * strength, np.linalg.norm(change[6:])))
    return across**2 / (2.0 * strength)
