"""Where a model fails, in words: the strongest structures of its residual, one after the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dependence import AxisResponse, Dependence, axis_response, dependence

#: Structures told, and the part of the residual's own rms below which one is not worth a sentence.
COUNT, _LEAST_PART = 3, 0.01

#: What a structure in a coordinate could come from, by the coordinate's kind.
_MEANING = {
    "time": "something changed in time: an ageing scale factor, or a step at an event",
    "time_of_day": "something with a daily course: a temperature, or the sensor's surroundings",
    "orbit_phase": "something fixed to the orbit: the field's own strength and direction, or a time lag",
    "sun_phase": "something that light and shadow drive: temperatures, solar array, battery",
    "local_time": "something that the season of the orbit drives: full Sun, eclipses, temperatures",
    "latitude": "something that follows the field along the orbit: a time lag between the instruments, "
    "a scale factor",
    "longitude": "something fixed to the Earth: a field-dependent error, or the positions",
    "sunlit": "light and shadow: two levels of a stray field or of an offset",
    "sun_angle": "a field that depends on where the Sun stands: solar panels, sunlit surfaces, a thermal "
    "gradient",
    "field_direction": "an offset along this axis, or an angle between axes",
    "field_component": "a scale factor or a non-linearity of this axis, or an angle to it",
    "field_strength": "a scale factor of either instrument, a bias of the reference, or a non-linearity",
    "temperature": "a scale factor, an angle or an offset that follows this temperature",
    "solar_current": "a stray field of the solar array's current",
    "battery_current": "a stray field of the battery's current",
    "camera_current": "a stray field of the camera's current",
    "torquer_current": "a stray field of the torquers",
    "current": "a stray field of this current",
    "heater": "a stray field of the heater, or what it warms",
    "voltage": "a stray field of the loads behind this voltage",
    "frequency": "the clock of the reference instrument: a scale factor or a time lag",
    "sun_direction": "a field that depends on where the Sun stands",
    "sunlight": "light and shadow: two levels of a stray field or of an offset",
}
_OTHERWISE = "whatever this channel measures, or something that moves with it"


@dataclass(frozen=True)
class Coordinate:
    """What a residual may follow: its values (sample,), unit, and kind (of a channel, or a geometry's)."""

    name: str
    unit: str
    kind: str
    values: Floats
    rising: Floats | None = None


@dataclass(frozen=True)
class Failure:
    """One structure of the residual, less the stronger ones before it."""

    dependence: Dependence
    response: AxisResponse | None
    kind: str
    rank: int

    @property
    def coordinate(self) -> str:
        """What the residual follows."""
        return self.dependence.coordinate

    @property
    def amplitude(self) -> float:
        """Rms of the structure, nT."""
        return self.dependence.amplitude

    @property
    def sigma(self) -> float:
        """Standard deviation of the amplitude between blocks, nT."""
        return self.dependence.sigma_amplitude

    @property
    def axis(self) -> str:
        """Sensor axis along which a field would make it: x, y, z, or empty when none stands out."""
        return self.response.axis if self.response else ""

    @property
    def sentence(self) -> str:
        """What a physicist would say of it."""
        opening = "The residual" if self.rank == 0 else "Beyond that, the residual"
        meaning = _MEANING.get(self.kind, _OTHERWISE)
        return (
            f"{opening} follows {self.coordinate} with {self.amplitude:.3f} +- {self.sigma:.3f} nT rms"
            f"{self._extremes()}{self._along()}{self._loop()}; it could be {meaning}."
        )

    def _extremes(self) -> str:
        found = self.dependence
        low, high = int(np.nanargmin(found.mean)), int(np.nanargmax(found.mean))
        unit = f" {found.unit}" if found.unit not in ("", "1") else ""
        told = [
            f"{found.mean[at]:+.3f} +- {found.sigma[at]:.3f} nT near {found.centre[at]:.4g}{unit}"
            for at in (low, high)
        ]
        return f" ({told[0]}, {told[1]})"

    def _along(self) -> str:
        if not self.axis or self.response is None:
            return ", along no axis more than another"
        index = "xyz".index(self.axis)
        amplitude, sigma = self.response.amplitude[index], self.response.sigma_amplitude[index]
        return f", as a field along {self.axis} of {amplitude:.3f} +- {sigma:.3f} nT would make it"

    def _loop(self) -> str:
        loop = self.dependence.loop
        if loop is None or not loop.is_open:
            return ""
        return (
            f"; rising and falling differ by {loop.opening:.3f} +- {loop.sigma_opening:.3f} nT "
            "(hysteresis, or a slow response)"
        )


def measure(
    coordinates: Iterable[Coordinate], residual: Floats, block: npt.NDArray[np.int64]
) -> list[Dependence]:
    """Return how the residual (sample,) depends on each coordinate that varies, in their order."""
    found = (
        dependence(one.name, one.unit, one.values, residual, block, one.rising, _bins(one, block))
        for one in coordinates
    )
    return [one for one in found if one is not None]


def _bins(one: Coordinate, block: npt.NDArray[np.int64]) -> int:
    """Return the bins of a coordinate: in time, each takes several blocks."""
    return int(np.clip(np.unique(block).size // 4, 2, 24)) if one.kind == "time" else 24


def find_failures(
    coordinates: Mapping[str, Coordinate],
    found: list[Dependence],
    residual: Floats,
    direction: Floats,
    block: npt.NDArray[np.int64],
) -> list[Failure]:
    """Return the strongest structures, each measured after the stronger ones were taken off.

    Coordinates move together: what one structure leaves in twenty coordinates is told once.

    Parameters
    ----------
    coordinates : mapping of str to Coordinate
        By name.
    found : list of Dependence
        Of the whole residual, as `measure` returns them.
    residual : ndarray, shape (sample,)
        nT.
    direction : ndarray, shape (sample, 3)
        Unit vector of the field, axes of the vector sensor.
    block : ndarray of int, shape (sample,)
        Blocks of the jackknife.
    """
    failures: list[Failure] = []
    left, told = residual, found
    least = _LEAST_PART * float(np.nanstd(residual)) if np.isfinite(residual).any() else 0.0
    while len(failures) < COUNT:
        clear = [one for one in told if one.is_clear and one.amplitude > least]
        if not clear:
            break
        best = max(clear, key=lambda one: one.amplitude)
        one = coordinates[best.coordinate]
        # What follows the field itself is a constant field, or no field at all.
        parts = 1 if one.kind.startswith("field_") else 8
        response = axis_response(one.name, one.unit, one.values, left, direction, block, parts)
        failures.append(Failure(best, response, one.kind, len(failures)))
        left = left - _fitted(best, one, left, response, direction, block)
        told = measure((coordinates[each.coordinate] for each in found), left, block)
    return failures


def _fitted(
    best: Dependence,
    one: Coordinate,
    residual: Floats,
    response: AxisResponse | None,
    direction: Floats,
    block: npt.NDArray[np.int64],
) -> Floats:
    """Return what a structure makes of the residual: its field along the axes, and its mean curve beyond."""
    fitted = np.zeros_like(residual)
    if response is not None and response.axis:
        curves = [np.interp(one.values, response.centre, response.field[:, axis]) for axis in range(3)]
        fitted = np.nan_to_num(np.einsum("at,ta->t", np.array(curves), direction))
        beyond = dependence(one.name, one.unit, one.values, residual - fitted, block, bins=_bins(one, block))
        best = beyond or best
    met = np.isfinite(best.mean)
    return np.asarray(fitted + np.nan_to_num(np.interp(one.values, best.centre[met], best.mean[met])))
