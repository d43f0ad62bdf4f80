"""From the archive to samples: the channels a model needs, on one time base, for one day."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from inflight.alignment import FIELD_ROLES, align
from inflight.catalog import Catalog, Day
from inflight.errors import SamplesError
from inflight.mission import Mission
from inflight.model import Model
from inflight.time import day_bounds

_DAY = np.timedelta64(1, "D")
#: Samples kept of the neighbouring days, so that filters and lags run on across midnight.
_MARGIN_CADENCES = 40


@dataclass(frozen=True)
class Need:
    """One series the samples hold: its name there, and the instrument and channel it comes from."""

    name: str
    instrument: str
    channel: str
    cadence_ns: int
    lag_ns: int = 0

    @property
    def dataset(self) -> str:
        """Name of the instrument's archive dataset."""
        return f"l1/{self.instrument}"


def channel_homes(mission: Mission) -> dict[str, tuple[str, str]]:
    """Return name in the samples -> (instrument, channel).

    A name that several instruments use is written ``instrument.channel``; the plain name then
    means none of them.
    """
    plain = [name for _, name, _ in mission.channel_instruments()]
    return {
        (name if plain.count(name) == 1 else f"{instrument}.{name}"): (instrument, name)
        for instrument, name, _ in mission.channel_instruments()
    }


def needs_of(mission: Mission, model: Model, extra: Iterable[str] = ()) -> list[Need]:
    """Return what the samples of a model's comparison are made from.

    Parameters
    ----------
    extra : iterable of str
        More channels by name; those the mission has not are left out.

    Raises
    ------
    SamplesError
        When the model uses a channel the mission has not.
    """
    roles = mission.comparisons[model.comparison].instruments()
    needs = [Need(role, name, "field", mission.instruments[name].cadence) for role, name in roles.items()]
    homes = channel_homes(mission)
    used = {channel for entry in model.effects for channel in entry.effect.channels}
    if unknown := used - set(homes):
        raise SamplesError(
            f"the model uses channels the mission has not: {', '.join(sorted(unknown))}",
            remedy=f"the mission has {', '.join(sorted(homes))}",
        )
    wanted = used | (set(extra) & set(homes))
    for name in sorted(wanted):
        instrument, channel = homes[name]
        home = mission.instruments[instrument]
        needs.append(Need(name, instrument, channel, home.cadence, home.channels[channel].lag))
    return needs


def geometry_channels(mission: Mission) -> list[str]:
    """Return the names of attitude and position channels, which products use when they exist."""
    return [
        name
        for name, (instrument, channel) in channel_homes(mission).items()
        if mission.instruments[instrument].channels[channel].kind in ("attitude", "position")
    ]


def base_role(mission: Mission, comparison: str) -> str:
    """Return the role whose stamps carry the samples: the stated one, else the slowest instrument."""
    entry = mission.comparisons[comparison]
    roles = entry.instruments()
    if entry.base:
        return next(role for role, name in roles.items() if name == entry.base)
    return max(roles, key=lambda role: mission.instruments[roles[role]].cadence)


@dataclass(frozen=True)
class ArchiveIndex:
    """The published days of the archive that some needs are made from; no database behind it."""

    days: Mapping[tuple[str, np.datetime64], Day]

    @classmethod
    def of(cls, cat: Catalog, needs: Sequence[Need], time: slice | None = None) -> ArchiveIndex:
        """Read the index from the catalog, one query a dataset."""
        return cls(
            {
                (name, day.day): day
                for name in sorted({need.dataset for need in needs})
                for day in cat.days(name, time, states=("published",))
            }
        )

    def get(self, need: Need, day: np.datetime64) -> Day | None:
        """Return the published day a need is read from."""
        return self.days.get((need.dataset, day))

    def around(self, days: Sequence[np.datetime64]) -> ArchiveIndex:
        """Return the part some days need, their neighbours included: what a worker is sent."""
        wanted = {day + step for day in days for step in (-_DAY, 0 * _DAY, _DAY)}
        return ArchiveIndex({key: day for key, day in self.days.items() if key[1] in wanted})

    def with_all(self, needs: Sequence[Need]) -> list[np.datetime64]:
        """Return the days on which every field is there."""
        sets = [
            {day for name, day in self.days if name == need.dataset}
            for need in needs
            if need.name in FIELD_ROLES
        ]
        return sorted(set.intersection(*sets)) if sets else []

    def sources(self, needs: Sequence[Need], day: np.datetime64, base: Need) -> list[Day]:
        """Return the archive days one day's samples are made from, in a fixed order."""
        found = []
        for need in needs:
            steps = (0 * _DAY,) if self.stands_alone(need, base, day) else (-_DAY, 0 * _DAY, _DAY)
            found += [self.get(need, day + step) for step in steps]
        unique = {source.id: source for source in found if source is not None}
        return [unique[key] for key in sorted(unique)]

    def stands_alone(self, need: Need, base: Need, day: np.datetime64) -> bool:
        """Return True when a series has the base's stamps, so that nothing is interpolated."""
        own, other = self.get(need, day), self.get(base, day)
        if own is None or other is None:
            return True
        if need.lag_ns or need.cadence_ns != base.cadence_ns:
            return False
        return (own.first_tt2000 - other.first_tt2000) % need.cadence_ns == 0


def load_samples(
    cat: Catalog, mission: Mission, model: Model, day: np.datetime64, needs: list[Need], index: ArchiveIndex
) -> xr.Dataset:
    """Read one day from the archive and align it.

    Parameters
    ----------
    needs : list of Need
        As `needs_of` returns them.
    index : ArchiveIndex
        The days around.

    Returns
    -------
    xarray.Dataset
        Samples of `inflight.align`, cut to the UTC day; attitude and position under these names.

    Raises
    ------
    SamplesError
        When a field's day is not in the archive.
    """
    base = next(need for need in needs if need.name == base_role(mission, model.comparison))
    channels = {}
    for need in needs:
        alone = index.stands_alone(need, base, day)
        channels[need.name] = _series(cat, need, day, index, alone)
    missing = [need for need in needs if need.name in FIELD_ROLES and channels[need.name] is None]
    if missing:
        raise SamplesError(
            f"no measurements of '{missing[0].instrument}'", day=str(day), remedy="ingest the day's files"
        )
    present = {name: series for name, series in channels.items() if series is not None}
    stamps = present[base.name]["tt2000"].values
    start, end = day_bounds(day)
    samples = align(present, stamps[(stamps >= start) & (stamps < end)])
    for need in needs:
        if need.name not in samples:
            samples[need.name] = _absent(mission, need, samples.sizes["time"])
    return _name_geometry(mission, samples)


class _Part(NamedTuple):
    """Rows of one day of a channel, as plain arrays: xarray is slow for many small pieces."""

    values: np.ndarray[Any, Any]
    stamps: np.ndarray[Any, np.dtype[np.int64]]
    flag: np.ndarray[Any, np.dtype[np.uint32]] | None
    attrs: dict[str, Any]

    def between(self, low: int, high: int) -> _Part:
        """Return the rows of a half-open TT2000 span."""
        first, last = np.searchsorted(self.stamps, (low, high))
        rows = slice(int(first), int(last))
        flag = self.flag[rows] if self.flag is not None else None
        return _Part(self.values[rows], self.stamps[rows], flag, self.attrs)


def _series(
    cat: Catalog, need: Need, day: np.datetime64, index: ArchiveIndex, alone: bool
) -> xr.DataArray | None:
    """Return a channel of a day, with a margin of its neighbours unless it stands alone."""
    today = index.get(need, day)
    if today is None:
        return None
    parts = [_read(cat, today, need)]
    if not alone:
        reach = _MARGIN_CADENCES * need.cadence_ns + abs(need.lag_ns)
        start, end = day_bounds(day)
        before, after = index.get(need, day - _DAY), index.get(need, day + _DAY)
        if before is not None:
            parts.insert(0, _read(cat, before, need).between(start - reach, start))
        if after is not None:
            parts.append(_read(cat, after, need).between(end, end + reach))
    # The mission's lag and cadence hold, not those of the day the files were taken in.
    attrs = {**parts[0].attrs, "cadence_ns": need.cadence_ns, "lag_ns": need.lag_ns}
    values = np.concatenate([part.values for part in parts])
    coords: dict[str, Any] = {"tt2000": ("time", np.concatenate([part.stamps for part in parts]))}
    flags = [part.flag for part in parts if part.flag is not None]
    if len(flags) == len(parts):
        coords["flag"] = ("time", np.concatenate(flags))
    return xr.DataArray(values, dims=("time", "component")[: values.ndim], coords=coords, attrs=attrs)


def _read(cat: Catalog, day: Day, need: Need) -> _Part:
    flagged = need.name in FIELD_ROLES
    data = cat.read(day, [need.channel, "flag"] if flagged else [need.channel])
    series = data[need.channel]
    flag = data["flag"].values if flagged else None
    return _Part(series.values, data["tt2000"].values, flag, dict(series.attrs))


def _absent(mission: Mission, need: Need, count: int) -> xr.DataArray:
    """Return a channel of nothing but gaps, so that the samples say what is missing."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    width = len(channel.axis_names)
    shape = (count, width) if width else (count,)
    dims = ("time", "axis" if width == 3 else f"{need.name}_component")[: len(shape)]
    return xr.DataArray(
        np.full(shape, np.nan), dims=dims, attrs={"units": channel.unit, "kind": channel.kind}
    )


def _name_geometry(mission: Mission, samples: xr.Dataset) -> xr.Dataset:
    """Call the attitude and the position by their kinds, whatever the mission names them."""
    found = {}
    for name, (instrument, channel) in channel_homes(mission).items():
        kind = mission.instruments[instrument].channels[channel].kind
        if name in samples and kind in ("attitude", "position") and name != kind:
            found[name] = kind
    return samples.rename(found)
