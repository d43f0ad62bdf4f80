"""One channel of one day as the archive has it, with a margin of its neighbours and what is made of it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from inflight.alignment import FIELD_ROLES
from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.derived import Part
from inflight.errors import SamplesError
from inflight.geometry import GEOMETRY, SLOW_GEOMETRY, add_geometry
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.needs import Need
from inflight.time import SECOND, Int64, day_bounds

_DAY = np.timedelta64(1, "D")


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
