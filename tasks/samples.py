"""From the archive to samples: the channels a model needs, on one time base, for one day."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from inflight.alignment import FIELD_ROLES, align
from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.comparison import folding_of
from inflight.derived import Part, parse, product
from inflight.errors import SamplesError
from inflight.folding import fold
from inflight.geometry import GEOMETRY, SLOW_GEOMETRY, add_geometry
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.needs import (
    SPIN_PHASE,
    Need,
    base_role,
    channel_homes,
    geometry_channels,
    needs_of,
    position_channel,
)
from inflight.tasks.spinning import spin_phase
from inflight.time import SECOND, Int64, day_bounds
from inflight.units import parse_unit

__all__ = [
    "ArchiveIndex",
    "Need",
    "base_role",
    "channel_homes",
    "geometry_channels",
    "load_samples",
    "needs_of",
]

_DAY = np.timedelta64(1, "D")
#: A channel's typical value comes from its own day when this part of it is known, else from other days.
_ENOUGH = 0.1
#: Other days are looked for this far on both sides.
STAND_IN_DAYS = 15


@dataclass(frozen=True)
class ArchiveIndex:
    """The published days of the archive that some needs are made from; no database behind it.

    Attributes
    ----------
    days : mapping of (dataset, day) to Day
        What is there.
    before : int
        Days before its own that a day's samples are made from.
    replaceable : tuple of Need
        Those whose typical value is taken where they are missing.
    """

    days: Mapping[tuple[str, np.datetime64], Day]
    before: int = 1
    replaceable: tuple[Need, ...] = ()

    @classmethod
    def of(cls, cat: Catalog, needs: Sequence[Need], time: slice | None = None) -> ArchiveIndex:
        """Read the index from the catalog, one query a dataset."""
        return cls(
            {
                (name, day.day): day
                for name in sorted({need.dataset for need in needs})
                for day in cat.days(name, time, states=("published",))
            },
            max((need.days_before for need in needs), default=1),
            tuple(need for need in needs if need.replaceable),
        )

    def get(self, need: Need, day: np.datetime64) -> Day | None:
        """Return the published day a need is read from."""
        return self.days.get((need.dataset, day))

    def around(self, days: Sequence[np.datetime64]) -> ArchiveIndex:
        """Return the part some days need, their neighbours included: what a worker is sent."""
        wanted = {day + step * _DAY for day in days for step in range(-self.before, 2)}
        others = {
            (one.dataset, one.day)
            for need in self.replaceable
            for day in days
            for one in self.typical_days(need, day)
        }
        return ArchiveIndex(
            {key: day for key, day in self.days.items() if key[1] in wanted or key in others},
            self.before,
            self.replaceable,
        )

    def typical_days(self, need: Need, day: np.datetime64) -> list[Day]:
        """Return the days that tell what a channel usually reads on a day: its own, else the nearest two.

        One before and one after, at most `STAND_IN_DAYS` away; none when there is none. A day that
        hardly has the channel counts only when no other does.
        """
        far = STAND_IN_DAYS + 1
        for least in (_ENOUGH, np.finfo(float).tiny):
            for sides in ((range(1),), (range(-1, -far, -1), range(1, far))):
                near = [self._first(need, [day + step * _DAY for step in side], least) for side in sides]
                if found := [one for one in near if one is not None]:
                    return found
        return []

    def _first(self, need: Need, days: Sequence[np.datetime64], least: float) -> Day | None:
        """Return the first of some days of which at least a part has the channel."""
        there = (self.get(need, day) for day in days)
        return next((one for one in there if one is not None and _known_part(one, need) >= least), None)

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
            steps = range(1) if self.stands_alone(need, base, day) else range(-need.days_before, 2)
            found += [self.get(need, day + step * _DAY) for step in steps]
            if need.replaceable:
                found += self.typical_days(need, day)
        unique = {source.id: source for source in found if source is not None}
        return [unique[key] for key in sorted(unique)]

    def stands_alone(self, need: Need, base: Need, day: np.datetime64) -> bool:
        """Return True when a series has the base's stamps, so that nothing is interpolated."""
        own, other = self.get(need, day), self.get(base, day)
        if own is None or other is None:
            return True
        if need.lag_ns or need.part or need.smooth_ns or need.cadence_ns != base.cadence_ns:
            return False
        return (own.first_tt2000 - other.first_tt2000) % need.cadence_ns == 0


def _known_part(day: Day, need: Need) -> float:
    """Return the part of a day on which a channel has values; 1 where the archive does not tell."""
    told = day.report.get("channels", {}).get(need.channel, {})
    return float(told.get("coverage", 1.0))


def load_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: list[Need],
    index: ArchiveIndex,
    geometry: bool = True,
    folded: bool = True,
) -> xr.Dataset:
    """Read one day from the archive and align it.

    Parameters
    ----------
    needs : list of Need
        As `needs_of` returns them.
    index : ArchiveIndex
        The days around.
    geometry : bool
        False leaves out what `add_geometry` makes unless a need or the model asks for it.
    folded : bool
        False leaves a spin comparison's samples as they were measured.

    Returns
    -------
    xarray.Dataset
        Samples of `inflight.align`, cut to the UTC day; attitude and position under these names,
        derived channels under theirs, and what `inflight.geometry.add_geometry` makes of them. Those of
        a spin comparison have `spin_phase`, and are folded (`inflight.folding.fold`).

    Raises
    ------
    SamplesError
        When a field's day is not in the archive.
    """
    base = next(need for need in needs if need.name == base_role(mission, model.comparison))
    channels = {}
    clock = next((need for need in needs if need.name == SPIN_PHASE), None)
    for need in needs:
        if need is not clock:
            alone = index.stands_alone(need, base, day)
            channels[need.name] = channel_series(cat, need, day, index, alone)
    missing = [need for need in needs if need.name in FIELD_ROLES and channels[need.name] is None]
    if missing:
        raise SamplesError(
            f"no measurements of '{missing[0].instrument}'", day=str(day), remedy="ingest the day's files"
        )
    present = {name: series for name, series in channels.items() if series is not None}
    stamps = present[base.name]["tt2000"].values
    start, end = day_bounds(day)
    samples = align(present, stamps[(stamps >= start) & (stamps < end)])
    if clock is not None:
        told = channel_series(cat, clock, day, index, alone=False)
        samples[SPIN_PHASE] = spin_phase(
            mission, model.comparison, clock, told, samples["tt2000"].values, str(day)
        )
    for need in needs:
        if need.name not in samples:
            samples[need.name] = _absent(mission, need, samples.sizes["time"])
    samples = _oriented(mission, model, _name_geometry(mission, samples))
    wanted = GEOMETRY if geometry else _asked_geometry(model, needs)
    if wanted:
        samples = add_geometry(samples, wanted)
    samples = _with_products(samples, needs)
    folding = folding_of(mission, model.comparison) if folded else None
    return samples if folding is None else fold(samples, folding, (start, end))


def _asked_geometry(model: Model, needs: Sequence[Need]) -> set[str]:
    """Return the factors of a model or a product that only geometry makes."""
    names = {channel for entry in model.effects for channel in entry.effect.channels}
    names |= {name for need in needs for name in need.products}
    return {factor for name in names for factor in name.split("*")} & set(GEOMETRY)


def _oriented(mission: Mission, model: Model, samples: xr.Dataset) -> xr.Dataset:
    """Tell each vector reading how its sensor is mounted."""
    for role, name in mission.comparisons[model.comparison].instruments().items():
        if role in samples and samples[role].ndim == 2:
            samples[role].attrs["orientation"] = tuple(mission.instruments[name].orientation)
    return samples


def _with_products(samples: xr.Dataset, needs: Sequence[Need]) -> xr.Dataset:
    """Add the products of channels; a factor that is missing makes a product of nothing but gaps."""
    for name in sorted({name for need in needs for name in need.products}):
        factors = [samples[part.name] for part in parse(name).parts]
        values = product([np.asarray(factor.values, dtype=np.float64) for factor in factors])
        dims = next((factor.dims for factor in factors if factor.ndim == values.ndim), ("time",))
        unit = parse_unit("1")
        for factor in factors:
            unit = unit * parse_unit(str(factor.attrs.get("units", "1")))
        samples[name] = xr.Variable(dims, values, {"units": str(unit), "kind": "other"})
    return samples


class _Rows(NamedTuple):
    """Rows of one day of a channel, as plain arrays: xarray is slow for many small pieces."""

    values: np.ndarray[Any, Any]
    stamps: np.ndarray[Any, np.dtype[np.int64]]
    flag: np.ndarray[Any, np.dtype[np.uint32]] | None
    attrs: dict[str, Any]

    def between(self, low: int, high: int) -> _Rows:
        """Return the rows of a half-open TT2000 span."""
        first, last = np.searchsorted(self.stamps, (low, high))
        rows = slice(int(first), int(last))
        flag = self.flag[rows] if self.flag is not None else None
        return _Rows(self.values[rows], self.stamps[rows], flag, self.attrs)


def channel_series(
    cat: Catalog, need: Need, day: np.datetime64, index: ArchiveIndex, alone: bool
) -> xr.DataArray | None:
    """Return a channel of a day, with a margin of its neighbours unless it stands alone."""
    today = index.get(need, day)
    if today is None:
        return None
    rows = _read(cat, today, need)
    parts = [rows]
    if not alone:
        reach = need.margin_ns
        start, end = day_bounds(day)
        for step in range(1, need.days_before + 1):
            before = index.get(need, day - step * _DAY)
            if before is not None:
                parts.insert(0, _read(cat, before, need).between(start - reach - need.history_ns, start))
        after = index.get(need, day + _DAY)
        if after is not None:
            parts.append(_read(cat, after, need).between(end, end + reach))
    # The mission's lag and cadence hold, not those of the day the files were taken in.
    attrs = {**rows.attrs, "cadence_ns": need.cadence_ns, "lag_ns": need.lag_ns}
    values = np.concatenate([part.values for part in parts])
    if need.smooth_ns:
        values = _smoothed(values, np.concatenate([part.stamps for part in parts]), need.smooth_ns)
    coords: dict[str, Any] = {"tt2000": ("time", np.concatenate([part.stamps for part in parts]))}
    flags = [part.flag for part in parts if part.flag is not None]
    if len(flags) == len(parts):
        coords["flag"] = ("time", np.concatenate(flags))
    series = xr.DataArray(values, dims=("time", "component")[: values.ndim], coords=coords, attrs=attrs)
    return _made(series, need.part) if need.part else series


def _smoothed(values: Floats, stamps: Int64, over_ns: int) -> Floats:
    """Return means of the readings within half of `over_ns` on either side; NaN stays where it is.

    Both sides reach equally far, so that at a gap or an end nothing is shifted in time.
    """
    flat = np.asarray(values, dtype=np.float64).reshape(len(values), -1)
    known = np.isfinite(flat).all(axis=1)
    own, told = stamps[known], flat[known]
    sums = np.concatenate([np.zeros((1, told.shape[1])), np.cumsum(told - told[:1], axis=0)])
    place = np.arange(own.size)
    after = np.searchsorted(own, own + over_ns // 2, side="right") - 1 - place
    before = place - np.searchsorted(own, own - over_ns // 2)
    each = np.minimum(after, before)
    out = flat.copy()
    out[known] = (sums[place + each + 1] - sums[place - each]) / (2 * each + 1)[:, None] + told[:1]
    return out.reshape(np.shape(values))


def _made(series: xr.DataArray, part: Part) -> xr.DataArray:
    """Return a slow response or a play of a channel, or of what its positions tell, at its own stamps."""
    stamps = np.asarray(series["tt2000"].values, dtype=np.int64)
    attrs = dict(series.attrs)
    values = np.asarray(series.values, dtype=np.float64)
    if part.channel in GEOMETRY and series.attrs.get("kind") == "position":
        values = _told_by_position(series, part)
        attrs = {
            "cadence_ns": attrs["cadence_ns"],
            "lag_ns": attrs["lag_ns"],
            "units": GEOMETRY[part.channel],
        }
    made = part.of(values, np.diff(stamps) / SECOND)
    return xr.DataArray(made, dims=("time", "component")[: made.ndim], coords=series.coords, attrs=attrs)


def _told_by_position(series: xr.DataArray, part: Part) -> Floats:
    """Return sunlight or latitude at the positions' own stamps; (time,)."""
    if part.channel not in SLOW_GEOMETRY:
        raise SamplesError(
            f"'{part.channel}' has no slow response here",
            channel=part.name,
            remedy="of what the orbit tells, only 'sunlit' and 'latitude' may carry a lag or a width",
        )
    position = (("time", "axis"), series.values, series.attrs)
    told = add_geometry(xr.Dataset({"position": position, "tt2000": ("time", series["tt2000"].values)}))
    return np.asarray(told[part.channel].values, dtype=np.float64)


class _Kept(threading.local):
    """Channels that were read last, by place and name, where a batch of days asks for it."""

    rows: OrderedDict[tuple[Any, ...], _Rows] | None = None


_KEPT = _Kept()
#: Channels kept: those of some three days.
_MOST_KEPT = 48


@contextmanager
def kept_readings() -> Iterator[None]:
    """Keep channels that were read last: margins of a day are its neighbours', which a batch reads, too."""
    before, _KEPT.rows = _KEPT.rows, OrderedDict()
    try:
        yield
    finally:
        _KEPT.rows = before


def own_readings(
    cat: Catalog, index: ArchiveIndex, need: Need, day: np.datetime64
) -> np.ndarray[Any, Any] | None:
    """Return a channel's readings of a day as they were archived; None without an archived day."""
    today = index.get(need, day)
    return None if today is None else _read(cat, today, need).values


def _read(cat: Catalog, day: Day, need: Need) -> _Rows:
    kept, flagged = _KEPT.rows, need.name in FIELD_ROLES
    key = (day.segment, day.rows, need.channel, flagged)
    found = kept.pop(key, None) if kept is not None else None
    if found is None:
        data = cat.read(day, [need.channel, "flag"] if flagged else [need.channel], dated=False)
        series = data[need.channel]
        flag = data["flag"].values if flagged else None
        found = _Rows(series.values, data["tt2000"].values, flag, dict(series.attrs))
    if kept is not None:
        kept[key] = found
        if len(kept) > _MOST_KEPT:
            kept.popitem(last=False)
    return found


def _absent(mission: Mission, need: Need, count: int) -> xr.DataArray:
    """Return a channel of nothing but gaps, so that the samples say what is missing."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    from_geometry = need.part is not None and need.part.channel in GEOMETRY
    width = 0 if from_geometry else len(channel.axis_names)
    shape = (count, width) if width else (count,)
    dims = ("time", "axis" if width == 3 else f"{need.name}_component")[: len(shape)]
    attrs = {"units": channel.unit, "kind": channel.kind} | (
        {"frame": channel.frame} if channel.frame else {}
    )
    return xr.DataArray(np.full(shape, np.nan), dims=dims, attrs=attrs)


def _name_geometry(mission: Mission, samples: xr.Dataset) -> xr.Dataset:
    """Call the attitude and the position by their kinds, whatever the mission names them."""
    first = {"position": position_channel(mission)}
    for name in geometry_channels(mission):
        instrument, channel = channel_homes(mission)[name]
        kind = mission.instruments[instrument].channels[channel].kind
        if name in samples:
            first[kind] = first.get(kind) or name
    return samples.rename(
        {
            name: kind
            for kind, name in first.items()
            if name in samples and name != kind and kind not in samples
        }
    )
