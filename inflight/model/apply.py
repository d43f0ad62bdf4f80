"""One effect of a model, and effects applied to samples: corrected in the model's order, disturbed backwards.

Vector sensors come first: their corrected field gives the direction along which a scalar sensor sees the
fields of the spacecraft. Of two vector sensors each is corrected in its own axes, and the outboard one,
which is farther from the spacecraft, gives `field`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.effects import VECTOR_ROLES, Effect, with_field
from inflight.errors import SamplesError
from inflight.mission import Sensor
from inflight.model.time_dependence import TimedValue
from inflight.samples import PlainSamples

if TYPE_CHECKING:
    import xarray as xr

#: What a correction makes of the vector reading.
_FIELD = ["field", "field_direction"]


@dataclass(frozen=True)
class ModelEffect:
    """One effect of a model: the cause, the sensor it acts on, and its values."""

    effect: Effect
    sensor: Sensor
    parameters: Mapping[str, TimedValue]

    @property
    def name(self) -> str:
        """Name in the model."""
        return self.effect.name

    @property
    def is_additive(self) -> bool:
        """True when at its sensor it only adds a field that does not depend on the sensor's reading."""
        follows = self.effect.follows_field and type(self.effect).correct is Effect.correct
        return self.effect.is_additive or (follows and self.sensor.is_scalar)

    def values(self, tt2000: npt.ArrayLike) -> dict[str, Floats]:
        """Return every parameter's value at a time, or at times."""
        return {name: timed.at(tt2000) for name, timed in self.parameters.items()}

    def as_empirical(self) -> ModelEffect:
        """Return a copy that says of itself that its cause is not known."""
        effect = copy(self.effect)
        effect.empirical = True
        return replace(self, effect=effect)

    def with_parameters(self, parameters: Mapping[str, TimedValue]) -> ModelEffect:
        """Return a copy with other values."""
        return replace(self, parameters=dict(parameters))

    def with_columns(self, value: Mapping[str, float], sigma: Mapping[str, float]) -> ModelEffect:
        """Return a copy with new values of named columns; itself when none of them is here."""
        named = value.keys() | sigma.keys()
        if not any(named & set(timed.columns) for timed in self.parameters.values()):
            return self
        return self.with_parameters(
            {key: timed.with_columns(value, sigma) for key, timed in self.parameters.items()}
        )

    def as_yaml(self) -> dict[str, Any]:
        """Return the entry of the model YAML."""
        entry: dict[str, Any] = {"effect": self.effect.label()}
        if self.effect.source is not None:
            entry["source"] = self.effect.source.sha
        if self.effect.name != self.effect.label():
            entry["name"] = self.effect.name
        return (
            entry
            | self.effect.given
            | ({"empirical": True} if self.effect.empirical and not type(self.effect).empirical else {})
            | {"sensor": self.sensor.name}
            | {name: timed.as_yaml() for name, timed in self.parameters.items()}
        )


Effects = Sequence[ModelEffect]


def correct(effects: Effects, samples: xr.Dataset) -> xr.Dataset:
    """Take the model's effects out of the readings.

    Parameters
    ----------
    effects : sequence of ModelEffect
        In the order of correction.
    samples : xarray.Dataset
        Aligned readings; dims time, axis; by role, in nT: `vector` (time, axis) and `scalar` (time),
        or `inboard` and `outboard` (time, axis).

    Returns
    -------
    xarray.Dataset
        The samples with corrected readings and `field` (time, axis), nT, orthogonal axes of the
        vector sensor (of two, the outboard one).

    Raises
    ------
    SamplesError
        When a reading is missing.
    """
    known = correct_plain(effects, samples)
    made = {role: known[role] for role in (*VECTOR_ROLES, "scalar") if role in known}
    made |= {name: known[name] for name in _FIELD if name in known}
    return samples.drop_vars(_FIELD, errors="ignore").assign(made)


def correct_plain(effects: Effects, samples: xr.Dataset | PlainSamples) -> PlainSamples:
    """Return what `correct` does as plain variables: a Dataset would check each of them again.

    Parameters and errors are those of `correct`.
    """
    known = samples if isinstance(samples, PlainSamples) else PlainSamples.of(samples)
    times = _times(cast("xr.Dataset", known))
    # A field of an earlier correction is none of this one's.
    if any(role in known for role in VECTOR_ROLES):
        known = known.drop_vars(_FIELD)
    for role in (*VECTOR_ROLES, "scalar"):
        entries = [entry for entry in effects if entry.sensor.role == role]
        if role not in known:
            if entries:
                raise SamplesError(
                    f"the samples have no '{role}' reading", remedy="align the comparison's sensors"
                )
            continue
        if role in VECTOR_ROLES:
            # The other sensor's field is in the other sensor's axes.
            known = known.drop_vars(_FIELD)
        raw = known[role]
        reading = np.asarray(raw.values, dtype=np.float64)
        for entry in entries:
            reading = entry.effect.correct(
                reading, cast("xr.Dataset", known), entry.values(times), entry.sensor
            )
        known = known.assign({role: (raw.dims, reading, raw.attrs)})
        if role in VECTOR_ROLES:
            known = cast("PlainSamples", with_field(cast("xr.Dataset", known), reading))
    return known


def disturb(effects: Effects, samples: xr.Dataset) -> xr.Dataset:
    """Put the model's effects into true fields: the exact inverse of `correct`.

    Parameters
    ----------
    effects : sequence of ModelEffect
        In the order of correction; they are run backwards.
    samples : xarray.Dataset
        True readings by role, nT: `vector` (time, axis) and `scalar` (time), or `inboard` and
        `outboard` (time, axis).

    Returns
    -------
    xarray.Dataset
        The samples with raw readings; `field` keeps the true field.
    """
    out, changed = samples, {}
    for role in (*VECTOR_ROLES, "scalar"):
        if role not in samples:
            continue
        reading = np.asarray(samples[role].values, dtype=np.float64)
        if role in VECTOR_ROLES:
            out = with_field(out, reading)
        for entry in reversed([entry for entry in effects if entry.sensor.role == role]):
            reading = entry.effect.disturb(reading, out, entry.values(_times(samples)), entry.sensor)
        changed[role] = (samples[role].dims, reading, samples[role].attrs)
    return out.assign(changed)


def correction_terms(effects: Effects, samples: xr.Dataset) -> dict[str, Floats]:
    """Return what each additive effect's correction subtracted from its sensor's reading.

    Parameters
    ----------
    samples : xarray.Dataset
        Corrected samples (they hold `field`).

    Returns
    -------
    dict of ndarray
        ``<effect>`` of a vector sensor: (time, axis) nT, sensor axes; ``<effect>`` of a scalar
        sensor: (time,) nT, along the field. Subtracting it from the reading is the correction.
    """
    terms, times = {}, _times(samples)
    for entry in effects:
        if entry.is_additive:
            zero = np.zeros(times.size if entry.sensor.is_scalar else (times.size, 3))
            terms[entry.name] = -entry.effect.correct(zero, samples, entry.values(times), entry.sensor)
    return terms


def _times(samples: xr.Dataset) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.asarray(samples["tt2000"].values, dtype=np.int64)
