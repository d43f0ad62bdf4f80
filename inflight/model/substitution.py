"""Typical values for missing channels, and how uncertain they make the fields.

Where a channel is missing, its typical value (the mean of known samples) is taken: the effect is corrected
as usual, and the field is uncertain by what the effect does when the channel deviates by its own scatter.
Where no value of the channel is known, effects made from it are left out, and the uncertainty is their whole
size: over the channel's possible range, or NaN where none is stated. These samples carry the flag
CHANNEL_MISSING, which takes them out of every fit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats, finite_rows
from inflight.effects import Effect, Values
from inflight.flags import Flag
from inflight.mission import Sensor
from inflight.model.apply import ModelEffect, at_all_sensors
from inflight.model.model import Model
from inflight.samples import channel_product, parse_channel
from inflight.time import GAP, SECOND, Int64

if TYPE_CHECKING:
    import xarray as xr

Rows = npt.NDArray[np.bool_]

#: Possible values of geometry, in its units.
GEOMETRY_RANGES: dict[str, tuple[float, float]] = {
    "latitude": (-90.0, 90.0),
    "longitude": (-180.0, 180.0),
    "orbit_phase": (0.0, 360.0),
    "sun_phase": (0.0, 360.0),
    "local_time": (0.0, 24.0),
    "sunlit": (0.0, 1.0),
}

#: What is tried instead: light and shadow, the Sun on and against each axis.
_TRIED_VALUES = {"sunlit": np.array([0.0, 1.0]), "sun_direction": np.concatenate([np.eye(3), -np.eye(3)])}


@dataclass(frozen=True, kw_only=True)
class SubstitutionSettings:
    """How the uncertainty of a substituted channel is worked out.

    Attributes
    ----------
    margin : int
        Samples on either side of the missing ones that are computed with them: effects take rates of change
        over at most some samples (derived).
    parts : int
        Values of a channel's range that are tried, in the middles of as many equal parts, so that both ends
        of a circle count once (assumed).
    flat : float
        A direction of the covariance with less than this part of the largest one is rounding (derived).
    """

    margin: int = 8
    parts: int = 8
    flat: float = 1e-12


SUBSTITUTION_SETTINGS = SubstitutionSettings()


@dataclass(frozen=True)
class TypicalValue:
    """What a channel usually reads.

    Channels of one delivery deviate together: currents of one bus balance each other.

    Attributes
    ----------
    mean : ndarray, shape (component,)
        In the channel's unit; one component for a channel of one number a time.
    modes : ndarray, shape (mode, component)
        Deviations of one sigma, independent of each other in value and in rate of change: their outer
        products sum to the covariance. All channels of a group have as many, and deviate together in each.
    rates : ndarray, shape (mode,)
        How fast each mode changes, rad/s: rms of its rate of change over that of its deviation.
    group : tuple of str
        Channels that this one deviates with, itself among them.
    source : str
        Where it was taken from, in words.
    """

    mean: Floats
    modes: Floats
    rates: Floats
    group: tuple[str, ...]
    source: str

    @classmethod
    def of(cls, values: Mapping[str, Floats], stamps: Int64, source: str) -> dict[str, TypicalValue]:
        """Return those of a group of channels, by name; a channel with fewer than two values has none.

        Parameters
        ----------
        values : mapping of str to ndarray, (time,) or (time, component)
            By channel; NaN where it is not known. Of two channels that were never known at once nothing
            joint is known: they count as independent.
        stamps : ndarray of int, shape (time,)
            TT2000.
        """
        rows = {name: one.reshape(len(one), -1) for name, one in values.items()}
        there = {name: finite_rows(one) for name, one in rows.items()}
        group = tuple(name for name in rows if np.count_nonzero(there[name]) >= 2)
        if not group:
            return {}
        pairs = [_normalised(rows[name][there[name]], there[name], stamps) for name in group]
        deviation, change = (np.concatenate(one, axis=1) for one in zip(*pairs, strict=True))
        scale = np.linalg.norm(deviation, axis=0)
        scale[scale == 0] = 1.0
        deviation, change = deviation / scale, change / scale
        own, vectors = np.linalg.eigh(deviation.T @ deviation)
        used = own > SUBSTITUTION_SETTINGS.flat * max(float(own[-1]), 1e-300)
        size = np.sqrt(own[used])
        rate = change @ (vectors[:, used] / size)
        # In these axes deviations are a unit sphere, which stays one when the rates' axes are taken.
        squares, turn = np.linalg.eigh(rate.T @ rate)
        modes = (turn.T @ (vectors[:, used] * size).T) * scale
        ends = np.cumsum([rows[name].shape[1] for name in group])
        return {
            name: cls(
                np.asarray(rows[name][there[name]].mean(axis=0)),
                modes[:, end - rows[name].shape[1] : end],
                np.sqrt(np.maximum(squares, 0.0)),
                group,
                source,
            )
            for name, end in zip(group, ends, strict=True)
        }


def _normalised(known: Floats, there: Rows, stamps: Int64) -> tuple[Floats, Floats]:
    """Return a channel's deviations from its mean, and its rates of change, 1/s; (time, component) both.

    They are 0 where not known, and over the root of their number: products of columns are covariances, and
    the matrix of several channels' has no negative eigenvalue whatever each of them lacks.
    """
    deviation, rate = np.zeros((2, len(there), known.shape[1]))
    deviation[there] = (known - known.mean(axis=0)) / np.sqrt(len(known))
    steps = np.diff(stamps[there] / SECOND)
    near = steps <= GAP * np.median(steps)
    change = np.diff(known, axis=0)[near] / steps[near, None]
    rate[np.flatnonzero(there)[1:][near]] = change / np.sqrt(len(change))
    return deviation, rate


@dataclass(frozen=True)
class EffectSubstitution:
    """What was substituted for one effect: how many samples, which missing channels, and by what."""

    samples: int
    channels: tuple[str, ...]
    instead: str

    def __str__(self) -> str:
        """Return it as part of a sentence."""
        return f"{self.samples} samples without {', '.join(self.channels)} ({self.instead})"


@dataclass(frozen=True)
class SubstitutedSamples:
    """Samples whose missing channels have typical values.

    Attributes
    ----------
    samples : xarray.Dataset
        Filled where a typical value is known; every sample without one of its channels is flagged.
    rows : mapping of str to ndarray of bool, (time,) or (time, component)
        What was missing, by channel; none of them is all False.
    typical : mapping of str to TypicalValue
        By channel, those that have one.
    ranges : mapping of str to (float, float)
        Possible values of channels of one number a time.
    """

    samples: xr.Dataset
    rows: Mapping[str, Rows]
    typical: Mapping[str, TypicalValue]
    ranges: Mapping[str, tuple[float, float]]

    @property
    def lost(self) -> Rows:
        """Samples without one of their channels; (time,)."""
        return np.asarray(np.logical_or.reduce([_any_component(one) for one in self.rows.values()]))

    def model(self, model: Model) -> Model:
        """Return a model that leaves effects out where nothing of their channels is known."""
        unknown = set(self.rows) - set(self.typical)
        return replace(
            model,
            effects=tuple(
                replace(entry, effect=_WithoutUnknown(entry))
                if unknown & _series_of(entry, self.samples)
                else entry
                for entry in model.effects
            ),
        )

    def by_effect(self, model: Model, part: slice = slice(None)) -> dict[str, EffectSubstitution]:
        """Return what was substituted within a part of the samples, by effect."""
        out = {}
        for entry in model.effects:
            names = sorted(_series_of(entry, self.samples) & set(self.rows))
            if names:
                rows = np.logical_or.reduce([_any_component(self.rows[name]) for name in names])[part]
                if not rows.any():
                    continue
                instead = {self.typical[name].source if name in self.typical else "" for name in names}
                replaced_by = f"mean of {' and '.join(sorted(instead))}" if "" not in instead else "left out"
                out[entry.name] = EffectSubstitution(int(rows.sum()), tuple(names), replaced_by)
        return out

    def variance(self, model: Model) -> tuple[Floats, Floats]:
        """Return the variance of the fields by the substituted values.

        Channels of one `TypicalValue.group` deviate together as far as they are missing, groups are taken as
        independent. A sample's own error lasts as long as its channel is missing: it does not average out.

        Parameters
        ----------
        model : Model
            With the values that hold.

        Returns
        -------
        vector, scalar : ndarray, shape (time, axis) and (time,)
            nT^2, orthogonal axes of the vector sensor; 0 where no channel is missing, NaN where not
            even the size of an effect is known.
        """
        count = self.samples.sizes["time"]
        vector, scalar = np.zeros((count, 3)), np.zeros(count)
        known = self.model(model)
        for names in self._groups():
            users = [entry for entry in model.effects if _series_of(entry, self.samples) & set(names)]
            missing = np.logical_or.reduce([_any_component(self.rows[name]) for name in names])
            near = np.convolve(missing, np.ones(2 * SUBSTITUTION_SETTINGS.margin + 1), mode="same") > 0
            part = self.samples.isel(time=near)
            before = _fields(known, part)
            inside, of_vector = (
                missing[near],
                any(one.sensor.role == "vector" for one in at_all_sensors(users)),
            )
            changes, weight = self._changes(names, part, near)
            for changed in changes:
                after = _fields(known, changed)
                if of_vector:
                    vector[missing] += weight * (after[0] - before[0])[inside] ** 2
                scalar[missing] += weight * (after[1] - before[1])[inside] ** 2
            if not weight:
                scalar[missing] = np.nan
                vector[missing] = np.nan if of_vector else vector[missing]
        return vector, scalar

    def _groups(self) -> list[tuple[str, ...]]:
        """Return the missing channels, those together that deviate together."""
        groups: dict[tuple[str, ...], list[str]] = {}
        for name in self.rows:
            groups.setdefault(self.typical[name].group if name in self.typical else (name,), []).append(name)
        return [tuple(names) for names in groups.values()]

    def _changes(
        self, names: tuple[str, ...], part: xr.Dataset, near: Rows
    ) -> tuple[Iterable[xr.Dataset], float]:
        """Return samples in which missing channels read otherwise, and the weight of each; 0 without any."""
        if names[0] in self.typical:
            return self._deviations(names, part, near), 1.0
        (name,) = names
        places = _TRIED_VALUES.get(name, np.empty(0))
        if not len(places) and name in self.ranges:
            low, high = self.ranges[name]
            parts = SUBSTITUTION_SETTINGS.parts
            places = low + (high - low) * (np.arange(parts) + 0.5) / parts
        values, rows = np.asarray(part[name].values), self.rows[name][near]
        changes = (_with_series(part, name, np.where(rows, place, values)) for place in places)
        return changes, 1.0 / len(places) if len(places) else 0.0

    def _deviations(self, names: tuple[str, ...], part: xr.Dataset, near: Rows) -> Iterator[xr.Dataset]:
        """Yield samples in which channels deviate by each of their common modes where they were missing.

        Sine and cosine together are one sigma at every time, and change as fast as the mode does: some
        effects follow its rate.
        """
        seconds = (part["tt2000"].values - part["tt2000"].values[0]) / SECOND
        for place, rate in enumerate(self.typical[names[0]].rates):
            for wave in (np.cos(rate * seconds), np.sin(rate * seconds)):
                changed = part
                for name in names:
                    mode, values = self.typical[name].modes[place], np.asarray(part[name].values, np.float64)
                    change = wave[:, None] * mode if values.ndim == 2 else wave * mode[0]
                    changed = _with_series(changed, name, values + self.rows[name][near] * change)
                yield changed


def substitute(
    model: Model,
    samples: xr.Dataset,
    typical: Mapping[str, TypicalValue],
    ranges: Mapping[str, tuple[float, float]] | None = None,
    missing: Mapping[str, Rows] | None = None,
) -> SubstitutedSamples | None:
    """Put typical values in the place of what is missing of a model's channels.

    Parameters
    ----------
    model : Model
        Its effects name the channels.
    samples : xarray.Dataset
        Aligned raw samples.
    typical : mapping of str to TypicalValue
        By name in the samples; of a derived channel, that of the series it is made from.
    ranges : mapping of str to (float, float), optional
        Possible values of channels, in addition to `GEOMETRY_RANGES`.
    missing : mapping of str to ndarray of bool, optional
        As `missing_rows` returns it; looked for when absent.

    Returns
    -------
    SubstitutedSamples or None
        None when nothing is missing.
    """
    rows = missing_rows(model, samples) if missing is None else missing
    if not rows:
        return None
    out = samples
    for name in rows:
        if name in typical:
            values = np.asarray(samples[name].values, dtype=np.float64)
            mean = typical[name].mean if values.ndim == 2 else typical[name].mean[0]
            out = _with_series(out, name, np.where(rows[name], mean, values))
    flag = samples["flag"].values.copy()
    flag[np.logical_or.reduce([_any_component(one) for one in rows.values()])] |= np.uint32(
        Flag.CHANNEL_MISSING
    )
    out = out.assign(flag=("time", flag, samples["flag"].attrs))
    used = {name: one for name, one in typical.items() if name in rows}
    # A slow response or a play of geometry stays within its possible values; a product does not.
    single = {name: parts[0].channel for name in rows if len(parts := parse_channel(name).parts) == 1}
    possible = {name: GEOMETRY_RANGES[base] for name, base in single.items() if base in GEOMETRY_RANGES}
    return SubstitutedSamples(out, rows, used, possible | dict(ranges or {}))


def missing_rows(model: Model, samples: xr.Dataset) -> dict[str, Rows]:
    """Return what is missing of each channel the model uses: (time,) or (time, component), by name.

    A channel is not missing where the sensor has no reading to be corrected.
    """
    users: dict[str, set[str]] = {}
    for entry in model.effects:
        for name in _series_of(entry, samples):
            users.setdefault(name, set()).add(entry.sensor.role)
    found: dict[str, Rows] = {}
    for name in sorted(users):
        unknown = ~np.isfinite(np.asarray(samples[name].values, dtype=np.float64))
        if not unknown.any():
            continue
        readings = [np.asarray(samples[role].values, dtype=np.float64) for role in users[name]]
        read = np.logical_or.reduce([finite_rows(one) for one in readings])
        lost = unknown & (read if unknown.ndim == 1 else read[:, None])
        if lost.any():
            found[name] = lost
    return found


class _WithoutUnknown(Effect):
    """An effect that is not there where one of its channels is unknown."""

    def __init__(self, entry: ModelEffect) -> None:
        self.name, self.channels = entry.effect.name, entry.effect.channels
        self._inner, self._adds = entry.effect, entry.is_additive

    @property
    def is_additive(self) -> bool:
        return self._adds

    def field(self, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        return self._known(samples, self._inner.field(samples, values, sensor), 0.0)

    def correct(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        return self._known(samples, self._inner.correct(reading, samples, values, sensor), reading)

    def disturb(self, reading: Floats, samples: xr.Dataset, values: Values, sensor: Sensor) -> Floats:
        return self._known(samples, self._inner.disturb(reading, samples, values, sensor), reading)

    def _known(self, samples: xr.Dataset, made: Floats, otherwise: Floats | float) -> Floats:
        lost = np.logical_or.reduce(
            [_any_component(~np.isfinite(samples[name].values)) for name in self.channels if name in samples]
        )
        return np.where(lost[:, None] if made.ndim == 2 else lost, otherwise, made)


def _series_of(entry: ModelEffect, samples: xr.Dataset) -> set[str]:
    """Return the series in the samples that an effect's channels are, or are products of."""
    found: set[str] = set()
    for name in entry.effect.channels:
        parts = _parts(name, samples)
        found |= set(parts) if parts else {name} & set(map(str, samples.data_vars))
    return found


def _parts(name: str, samples: xr.Dataset) -> Sequence[str]:
    """Return the factors of a product of series that are in the samples; none of anything else."""
    parts = [part.name for part in parse_channel(name).parts] if "*" in name else []
    return parts if all(part in samples for part in parts) else []


def _with_series(samples: xr.Dataset, name: str, values: Floats) -> xr.Dataset:
    """Return samples with other values of a series, and with the products it is a factor of."""
    out = samples.assign({name: samples[name].copy(data=values)})
    for whole in map(str, samples.data_vars):
        parts = _parts(whole, samples)
        if name in parts:
            made = channel_product([np.asarray(out[part].values, dtype=np.float64) for part in parts])
            out[whole] = samples[whole].copy(data=made)
    return out


def _fields(model: Model, samples: xr.Dataset) -> tuple[Floats, Floats]:
    corrected = model.corrected(samples)
    return np.asarray(corrected["field"].values), np.asarray(corrected["scalar"].values)


def _any_component(rows: Rows) -> Rows:
    return rows if rows.ndim == 1 else np.asarray(rows.any(axis=1))
