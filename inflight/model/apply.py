"""One effect of a model, and effects applied to samples: corrected in the model's order, disturbed backwards.

Vector sensors come first: their corrected field gives the direction along which a scalar sensor sees the
fields of the spacecraft. Of two vector sensors each is corrected in its own axes, and the outboard one,
which is farther from the spacecraft, gives `field`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dipole import DipoleSource
from inflight.effects import AXES, VECTOR_ROLES, Effect, Values, with_field
from inflight.errors import SamplesError
from inflight.mission import Sensor
from inflight.model.time_dependence import TimedValue
from inflight.samples import PlainSamples

if TYPE_CHECKING:
    import xarray as xr

#: Samples at which `number_fields` computes what follows the field.
_ROWS = 1440

#: A change of the field smaller than this counts as none, nT: readings have a coarser resolution.
_NEGLIGIBLE = 1e-4

#: Of each axis a change of the field (time,), nT; None where there is none.
FieldChange = tuple[Floats | None, ...]

#: What a correction makes of the vector reading.
_FIELD = ["field", "field_direction"]


@dataclass(frozen=True)
class ModelEffect:
    """One effect of a model: the cause, the sensor it acts on, and its values.

    Attributes
    ----------
    effect, sensor : Effect, Sensor
    parameters : mapping of str to TimedValue
    dipole : DipoleSource, optional
        Of a source that all sensors of the comparison see: the values hold at `sensor`, and those of a
        dipole there at the `others` (Yin 2010, after eq. 3.1). Without it the residual alone is
        described, and what the other sensor saw stays in the product.
    others : tuple of Sensor
    """

    effect: Effect
    sensor: Sensor
    parameters: Mapping[str, TimedValue]
    dipole: DipoleSource | None = None
    others: tuple[Sensor, ...] = ()

    @property
    def name(self) -> str:
        """Name in the model."""
        return self.effect.name

    @property
    def is_additive(self) -> bool:
        """True when at its sensor it only adds a field that does not depend on the sensor's reading."""
        follows = self.effect.follows_field and type(self.effect).correct is Effect.correct
        return self.effect.is_additive or (follows and self.sensor.is_scalar)

    @property
    def tables(self) -> dict[str, TimedValue]:
        """Parameters whose values are those of a stored table, by name."""
        return {name: timed for name, timed in self.parameters.items() if timed.time == "table"}

    def transfers(self) -> dict[str, Floats]:
        """Return, by each other sensor's name, the matrix (3, 3) from the field at `sensor` to the one there.

        Each in its sensor's own axes; of a scalar sensor in those of `sensor`, as all fields there.
        """
        if self.dipole is None:
            return {}
        found = {}
        for other in self.others:
            matrix = self.dipole.transfer(_place(self.sensor), _place(other))
            found[other.name] = _turned(matrix, self.sensor, self.sensor if other.is_scalar else other)
        return found

    def at_others(self) -> tuple[ModelEffect, ...]:
        """Return what the effect is at the other sensors that see its dipole."""
        transfers = self.transfers()
        return tuple(
            replace(
                self,
                effect=_AtOtherSensor(self.effect, self.sensor, transfers[other.name], other.name),
                sensor=other,
                dipole=None,
                others=(),
            )
            for other in self.others
            if other.name in transfers
        )

    def place_errors(self) -> dict[tuple[str, str], Floats]:
        """Return matrices (axis, 3, 3) on the field at `sensor`: what an uncertain place makes of it.

        See `DipoleSource.errors`; the others are the first of `others`, with which the values were told. By
        whose place it is: of the effect's source, and of the sensors whose positions have a sigma.
        """
        if self.dipole is None or not self.others:
            return {}
        here, other = self.sensor, self.others[0]
        between = _place(here), _place(other)
        made = {
            ("source", self.name): self.dipole.errors(*between),
            ("sensor", here.name): self.dipole.errors(*between, "known", here.sigma.position),
            ("sensor", other.name): self.dipole.errors(*between, "target", other.sigma.position),
        }
        return {
            whose: np.array([_turned(one, here, here) for one in each])
            for whose, each in made.items()
            if each.any()
        }

    def values(self, tt2000: npt.ArrayLike) -> dict[str, Floats]:
        """Return every parameter's value at a time, or at times."""
        return {name: timed.at(tt2000) for name, timed in self.parameters.items()}

    def with_tables(self, find: Callable[[str], xr.Dataset | None]) -> ModelEffect:
        """Return a copy whose parameters of time ``table`` have the tables that `find` returns by name."""
        bound = {}
        for key, timed in self.tables.items():
            table = find(timed.table_name)
            if table is not None:
                bound[key] = timed.with_table(table)
        return replace(self, parameters={**self.parameters, **bound}) if bound else self

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
            | self._dipole_as_yaml()
            | {name: timed.as_yaml() for name, timed in self.parameters.items()}
        )

    def _dipole_as_yaml(self) -> dict[str, Any]:
        if self.dipole is None:
            return {}
        return {"dipole": {"position": list(self.dipole.position), "sigma": self.dipole.sigma}}


def _place(sensor: Sensor) -> Floats:
    return np.asarray(sensor.position, dtype=np.float64)


def _turned(matrix: Floats, before: Sensor, after: Sensor) -> Floats:
    """Return a matrix of spacecraft axes as one from the axes of a sensor to those of another."""
    return np.asarray(after.rotation.as_matrix().T @ matrix @ before.rotation.as_matrix())


class _AtOtherSensor(Effect):
    """A source's field at a sensor, made from its field at another one."""

    def __init__(self, effect: Effect, seen_from: Sensor, transfer: Floats, at: str) -> None:
        self.name, self.channels, self.family = f"{effect.name}_{at}", effect.channels, effect.family
        self.empirical = effect.empirical
        self._effect, self._seen_from, self._transfer = effect, seen_from, transfer

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        return np.asarray(self._effect.field(samples, values, self._seen_from) @ self._transfer.T)


Effects = Sequence[ModelEffect]


def at_all_sensors(effects: Effects) -> list[ModelEffect]:
    """Return the effects with what those of a dipole are at the other sensors, each behind its own."""
    return [one for entry in effects for one in (entry, *entry.at_others())]


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


def correct_plain(
    effects: Effects,
    samples: xr.Dataset | PlainSamples,
    values_of: Callable[[ModelEffect], dict[str, Floats]] | None = None,
) -> PlainSamples:
    """Return what `correct` does as plain variables: a Dataset would check each of them again.

    Other parameters and errors are those of `correct`.

    Parameters
    ----------
    values_of : callable, optional
        Returns an effect's parameters at the samples' times, for who corrects the same samples many times.
    """
    known = samples if isinstance(samples, PlainSamples) else PlainSamples.of(samples)
    effects = at_all_sensors(effects)
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
            values = entry.values(times) if values_of is None else values_of(entry)
            reading = entry.effect.correct(reading, cast("xr.Dataset", known), values, entry.sensor)
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
    effects = at_all_sensors(effects)
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
        sensor: (time,) nT, along the field; ``<effect>_<sensor>`` of the other sensor that sees a dipole.
        Subtracting it from the reading is the correction.
    """
    terms, times = {}, _times(samples)
    for entry in at_all_sensors(effects):
        if entry.is_additive:
            zero = np.zeros(times.size if entry.sensor.is_scalar else (times.size, 3))
            terms[entry.name] = -entry.effect.correct(zero, samples, entry.values(times), entry.sensor)
    return terms


def before_corrections(effects: Effects, samples: xr.Dataset, terms: Mapping[str, Floats]) -> Floats | None:
    """Return the vector sensor's field with what `correction_terms` lists for it still in; (time, axis) nT.

    None without such a term, and where the field is not simply the sum: the sensor's equation, or an effect
    that follows the field, comes behind the first of them.
    """
    own = [entry for entry in at_all_sensors(effects) if entry.sensor.role in VECTOR_ROLES]
    added = [entry for entry in own if entry.is_additive]
    if not added or added != own[own.index(added[0]) :]:
        return None
    parts = [terms[entry.name] for entry in added]
    return np.asarray(samples["field"].values + np.sum(parts, axis=0))


def place_variance(effects: Effects, samples: xr.Dataset) -> Floats:
    """Return what uncertain places of dipoles add to the variance of the vector sensor's field.

    Parameters
    ----------
    samples : xarray.Dataset
        With the effects' channels and `tt2000`.

    Returns
    -------
    ndarray, shape (time, axis)
        nT^2, vector sensor axes. Places of different sources are independent, and that of a sensor is the
        same for all sources; each is the same at all times, so that its error does not average out.
    """
    times = _times(samples)
    off: dict[tuple[str, str], Floats] = {}
    for entry in effects:
        if entry.dipole is not None and entry.sensor.role in VECTOR_ROLES:
            field = entry.effect.field(samples, entry.values(times), entry.sensor)
            for whose, matrices in entry.place_errors().items():
                own = np.stack([field @ matrix.T for matrix in matrices])
                off[whose] = off[whose] + own if whose in off else own
    return np.asarray(sum(((each**2).sum(axis=0) for each in off.values()), np.zeros((times.size, 3))))


def delay_number(sensor: Sensor) -> str:
    """Return the name of a sensor's delay among the numbers that a calibration holds."""
    return f"{sensor.name}.delay"


def number_fields(
    effects: Effects, samples: xr.Dataset, sigma: Mapping[str, float]
) -> dict[str, FieldChange]:
    """Return by how much the corrected vector field changes where numbers are one sigma larger.

    Parameters
    ----------
    samples : xarray.Dataset
        Raw samples with the effects' channels.
    sigma : mapping of str to float
        By column; those of other sensors, and of no effect, are left out.

    Returns
    -------
    dict of tuple
        Of each axis of the vector sensor a change (time,) in nT; None where there is none. An effect inside
        the sensor's equation follows the field, which is smooth: it is computed at some 1440 samples.
    """
    effects = [entry for entry in effects if entry.sensor.role in VECTOR_ROLES]
    few: _FewSamples | None = None
    plain = cast("xr.Dataset", PlainSamples.of(samples))
    found = {}
    for place, entry in enumerate(effects):
        for key, timed in entry.parameters.items():
            asked = [(index, name) for index, name in enumerate(timed.columns) if name in sigma]
            if not asked:
                continue
            if entry.is_additive and timed.time == "constant" and entry.effect.acts_along_axes():
                series = entry.effect.along_axes(plain, key).reshape(_times(plain).size, -1)
                for index, name in asked:
                    found[name] = _along_one_axis(entry.effect, index, -sigma[name] * series)
                continue
            values = timed.value.ravel()
            moved = {
                name: entry.with_columns({name: float(values[index]) + sigma[name]}, {})
                for index, name in asked
            }
            if entry.is_additive:
                found |= _changes_of_field(entry, moved, plain)
                continue
            few = few or _FewSamples(effects, samples)
            found |= {name: few.change(place, one) for name, one in moved.items()}
    return found


def _by_axis(rows: Sequence[Floats]) -> FieldChange:
    """Return the rows of all axes; None for one that is negligible, and 0 where it is not known."""
    known = [row if np.isfinite(row.sum()) else np.nan_to_num(row) for row in rows]
    return tuple(
        row if max(row.max(initial=0.0), -row.min(initial=0.0)) > _NEGLIGIBLE else None for row in known
    )


def _along_one_axis(effect: Effect, index: int, series: Floats) -> FieldChange:
    """Return a change along the axis of a component; `series` (time, source) are those of its parameter."""
    # Source by source, or axis by axis: see `Effect.source_first`.
    axis, source = index // series.shape[1], index % series.shape[1]
    if effect.source_first:
        axis, source = index % len(AXES), index // len(AXES)
    (own,) = _by_axis([series[:, source]])
    return tuple(own if one == axis else None for one in range(len(AXES)))


def _changes_of_field(
    entry: ModelEffect, moved: Mapping[str, ModelEffect], samples: xr.Dataset
) -> dict[str, FieldChange]:
    """Return what effects in the place of one that adds a field do to what a correction leaves, by name."""
    times = _times(samples)
    before = entry.effect.field(samples, entry.values(times), entry.sensor)
    return {
        name: _by_axis(list((before - one.effect.field(samples, one.values(times), one.sensor)).T))
        for name, one in moved.items()
    }


class _FewSamples:
    """What a change of one effect does to the corrected field, computed at some samples and drawn between.

    Parameters
    ----------
    effects : sequence of ModelEffect
        Of vector sensors.
    samples : xarray.Dataset
        Raw samples.
    """

    def __init__(self, effects: Sequence[ModelEffect], samples: xr.Dataset) -> None:
        times = _times(samples)
        self._effects = effects
        self._step = max(1, times.size // _ROWS)
        self._few = PlainSamples.of(samples.isel(time=slice(None, None, self._step)))
        self._times = _times(cast("xr.Dataset", self._few))
        self._between = np.diff(self._times).astype(np.float64)
        self._behind = (times - self._every(self._times, times.size)).astype(np.float64)
        # By identity: a changed effect has the name of the one in whose place it is.
        self._values = {id(entry): entry.values(self._times) for entry in effects}
        self._field = self._corrected(effects)

    def change(self, place: int, moved: ModelEffect) -> FieldChange:
        """Return by how much the field changes with another effect in the place of one."""
        changed = self._corrected([*self._effects[:place], moved, *self._effects[place + 1 :]])
        rows = _by_axis(list((changed - self._field).T))
        return tuple(None if row is None else self._drawn(row) for row in rows)

    def _drawn(self, row: Floats) -> Floats:
        """Return the values at all samples: straight lines between the few, level behind the last of them."""
        slope = np.append(np.diff(row) / self._between, 0.0)
        every = self._behind.size
        return np.asarray(self._every(slope, every) * self._behind + self._every(row, every))

    def _every(self, values: npt.NDArray[Any], size: int) -> npt.NDArray[Any]:
        """Return for each of all samples the value of the last of the few at or before it."""
        return values.repeat(self._step)[:size]

    def _corrected(self, effects: Effects) -> Floats:
        def values_of(entry: ModelEffect) -> dict[str, Floats]:
            known = self._values.get(id(entry))
            return entry.values(self._times) if known is None else known

        return np.asarray(correct_plain(effects, self._few, values_of)["field"].values)


def instrument_variance(
    sensor: Sensor,
    field: Floats,
    tt2000: npt.NDArray[np.int64],
    *,
    mounting: bool = True,
    clock: bool = True,
) -> Floats:
    """Return what sigmas of a sensor's orientation and of its readings' moments add to the field's variance.

    A turn by small angles ``a`` about the axes moves B by ``a x B``, a clock that is wrong by ``t`` by
    ``t dB/dt``. Both are the same at all times, so that they do not average out.

    Parameters
    ----------
    sensor : Sensor
    field : ndarray, shape (time, 3)
        nT, in axes that are fixed to the sensor or to the spacecraft.
    tt2000 : ndarray of int64, shape (time,)
    mounting : bool
        Whether the field is one in spacecraft axes that the stated orientation makes.
    clock : bool
        Whether the error of the delay is not counted elsewhere.

    Returns
    -------
    ndarray, shape (time, 3)
        nT^2, the same axes; the slope is the steeper one to the neighbours, 0 without any.
    """
    found = np.zeros(field.shape)
    if mounting and sensor.sigma.orientation:
        square = field**2
        found += np.deg2rad(sensor.sigma.orientation) ** 2 * (square.sum(axis=1, keepdims=True) - square)
    if clock and sensor.sigma.delay and len(field) > 1:
        step = np.diff(tt2000).astype(np.float64)[:, None]
        slope = np.divide(np.diff(field, axis=0), step, out=np.zeros((len(field) - 1, 3)), where=step > 0)
        slope = np.abs(np.nan_to_num(slope))
        found += (
            sensor.sigma.delay * np.fmax(*(np.pad(slope, (side, (0, 0))) for side in ((1, 0), (0, 1))))
        ) ** 2
    return found


def table_variance(effects: Effects, samples: xr.Dataset) -> Floats:
    """Return what values taken from tables, and the numbers beside them, add to the vector field's variance.

    Parameters
    ----------
    samples : xarray.Dataset
        With the effects' channels and `tt2000`.

    Returns
    -------
    ndarray, shape (time, axis)
        nT^2, vector sensor axes; of the effects that have a parameter with time ``table``, each component
        changed by one sigma. They count as independent.
    """
    times = _times(samples)
    found = np.zeros((times.size, 3))
    for entry in effects:
        if not entry.tables or entry.sensor.role not in VECTOR_ROLES or not entry.is_additive:
            continue
        values = entry.values(times)
        field = entry.effect.field(samples, values, entry.sensor)
        for key, timed in entry.parameters.items():
            sigma = timed.sigma_at(times)
            for place in np.flatnonzero(sigma.reshape(-1, sigma.shape[-1]).any(axis=0)):
                moved = values[key] + sigma * (np.arange(sigma.shape[-1]) == place)
                changed = entry.effect.field(samples, {**values, key: moved}, entry.sensor)
                found += (changed - field) ** 2
    return found


def _times(samples: xr.Dataset) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.asarray(samples["tt2000"].values, dtype=np.int64)
