"""Every channel of a mission at the cadence of the search, day by day, with history and placebos.

`ChannelReader` puts archived channels on bins, `DerivedChannels` makes slow responses, plays, products and
placebos of them. Of a spin comparison, channels that show the spin are folded like the field (`SpinClock`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.design import ChannelSummary, bin_channel, bin_edges
from inflight.effects import NO_CAUSE
from inflight.frames import add_geometry
from inflight.mission import Mission
from inflight.model import folding_of
from inflight.residual import piecewise_mean
from inflight.samples import ChannelFactor, Folding, channel_product, fold_series, parse_channel
from inflight.tasks.archive.inputs import INPUT_SETTINGS, ArchiveIndex, Need, channels_by_name, clock_of
from inflight.tasks.archive.samples import channel_series, spin_phase
from inflight.time import SECOND, Int64, day_bounds


def resolves_spin(mission: Mission, comparison: str, cadence_ns: int) -> bool:
    """Return True when a channel of a cadence shows what goes with a spin comparison's spin."""
    if folding_of(mission, comparison) is None:
        return False
    return INPUT_SETTINGS.readings_per_turn * cadence_ns <= mission.periods["spin"]


@dataclass(frozen=True, kw_only=True)
class SpinClock:
    """The clock of a spin comparison on one day."""

    cat: Catalog
    mission: Mission
    comparison: str
    index: ArchiveIndex
    day: np.datetime64
    folding: Folding
    clock: Need

    @classmethod
    def of(
        cls, cat: Catalog, mission: Mission, comparison: str, index: ArchiveIndex, day: np.datetime64
    ) -> SpinClock | None:
        """Return the clock; None of a comparison that folds nothing."""
        folding = folding_of(mission, comparison)
        if folding is None:
            return None
        return cls(
            cat=cat,
            mission=mission,
            comparison=comparison,
            index=index,
            day=day,
            folding=folding,
            clock=clock_of(mission, comparison)[0],
        )

    def is_resolved_by(self, cadence_ns: int) -> bool:
        """Return True when a channel of a cadence shows what goes with the spin."""
        return resolves_spin(self.mission, self.comparison, cadence_ns)

    def phase(self, stamps: Int64) -> Floats:
        """Return the phase at the stamps of an instrument's channels, rad; NaN where it is not known."""
        series = channel_series(self.cat, self.clock, self.day, self.index)
        found = spin_phase(self.mission, self.comparison, self.clock, series, stamps)
        return np.asarray(found.phase.values, dtype=np.float64)

    def folded(self, values: Floats, stamps: Int64, phase: Floats, edges: Int64) -> Floats:
        """Return a channel on the synthetic turns whose bins have these edges; NaN without a phase."""
        flat = np.asarray(values, dtype=np.float64)
        out = np.full((edges.size - 1, *flat.shape[1:]), np.nan)
        if not np.isfinite(phase).any():
            return out
        found = fold_series(flat, stamps, phase, self.folding, day_bounds(self.day))
        count = min(len(out), len(found))
        out[:count] = found[:count]
        return out


_DAY = np.timedelta64(1, "D")


@dataclass
class ChannelReader:
    """Reads channels of single days, onto bins; keeps the last days it read.

    A channel's lag and its averaging are those of the mission, as in the samples of a model.

    Attributes
    ----------
    index : ArchiveIndex
        The days there are; one list of needs, one need a channel.
    cadence_ns : int
        Of the bins.
    span : tuple of int
        First and last TT2000 of the whole record: bins do not reach beyond it.
    comparison : str
        Of a spin comparison, channels fast enough to go with the spin are folded like its field.
    by_levels : bool
        Whether readings are replaced by the levels between which they switch. Where currents make fields
        of many times the noise, the noise of their readings would otherwise count as field.
    kept_days : int
        Days kept.
    """

    cat: Catalog
    mission: Mission
    needs: Sequence[Need]
    index: ArchiveIndex
    cadence_ns: int
    span: tuple[int, int]
    comparison: str = "main"
    by_levels: bool = False
    kept_days: int = INPUT_SETTINGS.cached_days
    _read: dict[np.datetime64, dict[str, Floats]] = field(default_factory=dict)

    @property
    def scalars(self) -> list[str]:
        """Names of the channels of one number a time, attitudes and positions not among them."""
        homes = channels_by_name(self.mission)
        found = []
        for need in self.needs:
            instrument, name = homes[need.name]
            channel = self.mission.instruments[instrument].channels[name]
            if not channel.axis_names and channel.kind not in NO_CAUSE:
                found.append(need.name)
        return found

    def edges(self, day: np.datetime64) -> Int64:
        """Return the edges of a day's bins."""
        start, end = day_bounds(day)
        return bin_edges(max(start, self.span[0]), min(end, self.span[1]), self.cadence_ns)

    def clear_cache(self) -> None:
        """Forget the days that were read."""
        self._read.clear()

    def day(self, day: np.datetime64) -> dict[str, Floats]:
        """Return every channel of a day on its bins; NaN where there is nothing."""
        if day not in self._read:
            while len(self._read) >= self.kept_days:
                self._read.pop(next(iter(self._read)))
            self._read[day] = self._load(day)
        return self._read[day]

    def _load(self, day: np.datetime64) -> dict[str, Floats]:
        edges = self.edges(day)
        homes = channels_by_name(self.mission)
        clock = SpinClock.of(self.cat, self.mission, self.comparison, self.index, day)
        by_dataset: dict[str, list[Need]] = {}
        for need in self.needs:
            by_dataset.setdefault(need.dataset, []).append(need)
        out: dict[str, Floats] = {}
        for needs in by_dataset.values():
            source, channels = self.index.get(needs[0], day), [need.channel for need in needs]
            data = None if source is None else self.cat.read(source, channels, with_time=False)
            phases: dict[tuple[int, int], Floats] = {}
            for need in needs:
                instrument, name = homes[need.name]
                width = len(self.mission.instruments[instrument].channels[name].axis_names)
                if data is None:
                    out[need.name] = np.full((edges.size - 1, width) if width else edges.size - 1, np.nan)
                    continue
                cadence = need.cadence_ns
                # Quaternions and positions are interpolated: their mean over a bin is none.
                if self.mission.instruments[instrument].channels[name].kind in ("attitude", "position"):
                    cadence = max(cadence, self.cadence_ns + 1)
                values, stamps = data[need.channel].values, data["tt2000"].values
                if need.lag_ns or need.smooth_ns:
                    # As the model's samples have it: averaged as the mission says, and late by its lag.
                    series = channel_series(self.cat, need, day, self.index)
                    assert series is not None
                    values, stamps = series.values, series.stamps + need.lag_ns
                if self.by_levels and values.ndim == 1:
                    values = piecewise_mean(np.asarray(values, dtype=np.float64))
                if clock is not None and clock.is_resolved_by(cadence):
                    # One instrument's channels have the same stamps, those of one lag.
                    delay = need.lag_ns, need.smooth_ns
                    phases[delay] = clock.phase(stamps) if delay not in phases else phases[delay]
                    out[need.name] = clock.folded(values, stamps, phases[delay], edges)
                else:
                    out[need.name] = bin_channel(values, stamps, edges, cadence)
        return out


def orbit_of(mission: Mission, reader: ChannelReader, day: np.datetime64) -> dict[str, xr.Variable]:
    """Return stamps, position and attitude on a day's bins, by their kinds; those there are."""
    read = reader.day(day)
    edges = reader.edges(day)
    data: dict[str, xr.Variable] = {"tt2000": xr.Variable("time", edges[:-1] + np.diff(edges) // 2)}
    for kind in ("position", "attitude"):
        for instrument, name, channel in mission.channel_instruments():
            home = name if name in read else f"{instrument}.{name}"
            if channel.kind == kind and kind not in data and home in read:
                width = "axis" if kind == "position" else "quaternion"
                attrs = {"units": channel.unit, "frame": channel.frame or "", "kind": kind}
                data[kind] = xr.Variable(("time", width), read[home], attrs)
    return data


@dataclass
class DerivedChannels:
    """Makes the channels that the terms of the library need, one day after the other.

    Attributes
    ----------
    reader : ChannelReader
    days : sequence of datetime64[D]
        All days of the span: placebos come from other days of it.
    summaries : mapping of str to ChannelSummary
        Their means replace missing values.
    shifts : mapping of str to float
        Placebo, such as ``heater~1`` -> seconds.
    wrapped_at : int
        Placebos of the first days come from the end of so many days; all of them when 0.
    """

    reader: ChannelReader
    days: Sequence[np.datetime64]
    summaries: Mapping[str, ChannelSummary]
    shifts: Mapping[str, float]
    wrapped_at: int = 0
    _by_orbit: dict[tuple[np.datetime64, str], Floats] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def _places(self) -> dict[np.datetime64, int]:
        return {day: place for place, day in enumerate(self.days)}

    def of_day(
        self, day: np.datetime64, names: Sequence[str], geometry: Mapping[str, Floats]
    ) -> dict[str, Floats]:
        """Return channels of a day by their derived names; (bin,) or (bin, axis)."""
        out, known = {}, set(self.reader.day(day)) | set(geometry)
        for name in names:
            if name in geometry or not name:
                continue
            parts = (ChannelFactor(name),) if name in known else parse_channel(name).parts
            out[name] = channel_product([self._part(day, part, geometry) for part in parts])
        return out

    def _part(self, day: np.datetime64, part: ChannelFactor, geometry: Mapping[str, Floats]) -> Floats:
        """Return one factor of a derived channel on the bins of a day."""
        if part.channel in geometry and part.is_plain:
            return geometry[part.channel]
        place = self._places[day]
        bins = self.reader.edges(day).size - 1
        step = self.reader.cadence_ns / SECOND
        if part.channel in geometry:
            earlier = [self._from_orbit(before, part.channel) for before in self._day_before(place)]
            return part.of(np.concatenate([*earlier, geometry[part.channel]]), step)[-bins:]
        if not part.placebo:
            history = self._day_before(place) if not part.is_plain else []
            whole = np.concatenate([self._filled(known, part.channel) for known in [*history, day]])
            return part.of(whole, step)[-bins:] if not part.is_plain else whole
        shift = round(self.shifts[f"{part.channel}~{part.placebo}"] / step)
        need = bins + int(np.ceil(part.history_s / step))
        return part.of(self._wrapped(place, part.channel, shift, need), step)[-bins:]

    def _from_orbit(self, day: np.datetime64, name: str) -> Floats:
        """Return what geometry makes of the orbit of a day."""
        if (day, name) not in self._by_orbit:
            while len(self._by_orbit) >= self.reader.kept_days:
                self._by_orbit.pop(next(iter(self._by_orbit)))
            orbit = xr.Dataset(orbit_of(self.reader.mission, self.reader, day))
            found = add_geometry(orbit, [name])[name]
            self._by_orbit[day, name] = np.asarray(found.values, dtype=np.float64)
        return self._by_orbit[day, name]

    def _day_before(self, place: int) -> list[np.datetime64]:
        """Return the day before the day at a place of the span; none after a gap."""
        adjacent = place > 0 and self.days[place] - self.days[place - 1] == _DAY
        return [self.days[place - 1]] if adjacent else []

    def _wrapped(self, place: int, channel: str, shift: int, need: int) -> Floats:
        """Return `need` bins of a channel, `shift` bins before the day's own, around the end of the days."""
        pieces: list[Floats] = []
        at, missing = place, shift + need
        while missing > 0:
            piece = self._filled(self.days[at], channel)
            pieces.insert(0, piece)
            missing -= len(piece)
            at = at - 1 if at else (self.wrapped_at or len(self.days)) - 1
        whole = np.concatenate(pieces)
        end = len(whole) - shift
        return whole[end - need : end]

    def _filled(self, day: np.datetime64, channel: str) -> Floats:
        """Return a channel of a day with its mean in the place of missing values."""
        values = self.reader.day(day)[channel]
        return np.where(np.isfinite(values), values, replacement_value(self.summaries, channel))


def replacement_value(summaries: Mapping[str, ChannelSummary], channel: str) -> float:
    """Return what replaces a channel's missing values: its mean, or zero for one with components."""
    return summaries[channel].mean if channel in summaries else 0.0


def as_variables(
    mission: Mission, values: Mapping[str, Floats], geometry: xr.Dataset | None
) -> dict[str, xr.Variable]:
    """Return channels as variables of samples, with their units."""
    homes = channels_by_name(mission)
    out: dict[str, xr.Variable] = {}
    for name, array in values.items():
        parts = [name] if name in homes else [part.channel for part in parse_channel(name).parts]
        units = [
            mission.instruments[homes[part][0]].channels[homes[part][1]].unit if part in homes else "1"
            for part in parts
        ]
        unit = units[0] if len(units) == 1 else "*".join(f"({factor})" for factor in units)
        dims = ("time", "axis" if array.ndim == 2 and array.shape[1] == 3 else f"{name}_component")
        out[name] = xr.Variable(dims[: array.ndim], array, {"units": unit})
    if geometry is not None:
        out |= {str(name): geometry[name].variable for name in geometry.data_vars if name != "tt2000"}
    return out
