"""A day of a comparison as rows: means over short spans of the residual and of all it may follow.

`rows_of_day` takes a day's product and the archive days behind it (`Sources`) and returns one row a span
(`Spans`). `blocks_of` says which rows count as one block when uncertainties are computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.effects import NO_CAUSE, position_channel
from inflight.errors import CatalogError, SettingsError
from inflight.frames import add_geometry
from inflight.instruments import Channel
from inflight.mission import Mission
from inflight.tasks.archive import channels_by_name, geometry_channels
from inflight.tasks.pipelines.base.planning import product_of
from inflight.time import DAY, SECOND, Int64, day_bounds, day_of

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class BlockLengths:
    """Blocks between which uncertainties are measured.

    Attributes
    ----------
    least_days : int
        Spans of at least so many days have blocks of a day; assumed.
    short_s : float
        Block of shorter spans, s; assumed.
    """

    least_days: int = 10
    short_s: float = 3 * 3600.0


BLOCK_LENGTHS = BlockLengths()

#: Channels of these kinds are no coordinates: geometry makes coordinates of them, or they are no numbers.
_NO_COORDINATE = (*NO_CAUSE, "flag")

#: Angles and hours on a circle are taken at one instant: their mean would be wrong at the seam.
_GEOMETRY = ("latitude", "longitude", "orbit_phase", "sun_phase", "local_time", "sunlit")


def published_products(cat: Catalog, comparison: str, span: slice) -> list[Day]:
    """Return the days of a comparison's products in a span.

    Raises
    ------
    CatalogError
        When there are none.
    """
    product = product_of(comparison)
    days = cat.days(product, span, states=("published",))
    if not days:
        where = " in the span" if span.start or span.stop else ""
        first = (
            "'inflight reprocess'" if cat.dataset_names() else "'inflight ingest', then 'inflight reprocess',"
        )
        raise CatalogError(f"'{product}' has no published days{where}", remedy=f"run {first} first")
    return days


@dataclass(frozen=True)
class EarlierProducts:
    """Products of days that an earlier version of the model made, where there are any.

    Attributes
    ----------
    model, version : str, int
        Name and version of the model.
    message : str
        What made the version that came after it: ``add ...``; empty when the versions do not follow.
    days : list of Day
    """

    model: str
    version: int
    message: str
    days: list[Day]


def earlier_products(
    cat: Catalog, comparison: str, days: Sequence[Day], version: int | None = None
) -> EarlierProducts | None:
    """Return the products of some days as an earlier version of the model made them.

    Parameters
    ----------
    days : sequence of Day
        The present products.
    version : int, optional
        Of the model; that of the products published last before the present ones when absent.

    Returns
    -------
    EarlierProducts or None
        None without any such product.

    Raises
    ------
    SettingsError
        When no product of a version that is named was ever published.
    """
    product = product_of(comparison)
    present = {day.day: day for day in days}
    span = slice(str(days[0].day), str(days[-1].day + np.timedelta64(1, "D")))
    found = [one for one in cat.revisions(product, span) if one.day in present and one.context]
    contexts = {name: cat.context(name) for name in {str(one.context) for one in found}}
    own = contexts.get(str(days[-1].context))
    versions = [contexts[str(one.context)].model_version for one in found]
    others = [one for one in versions if own is not None and one != own.model_version]
    if version is not None and version not in versions:
        known = ", ".join(map(str, sorted(set(versions)))) or "none"
        raise SettingsError(
            f"--against {version}: no product of the span was made with version {version} of the model",
            remedy=f"there are products of versions {known}; 'inflight model history' tells what each is",
        )
    chosen = version if version is not None else (others[-1] if others else None)
    if chosen is None or own is None:
        return None
    newest = {one.day: one for one, made in zip(found, versions, strict=True) if made == chosen}
    after = [one for one in cat.models() if one.name == own.model_name and one.version == own.model_version]
    message = after[0].message if after and after[0].parent == chosen else ""
    return EarlierProducts(own.model_name, chosen, message, [newest[day] for day in sorted(newest)])


def blocks_of(tt2000: Floats, days: int) -> tuple[np.ndarray[Any, np.dtype[np.int64]], str]:
    """Return the number of each row's block, (row,), and the length of a block in words."""
    if days >= BLOCK_LENGTHS.least_days:
        first = day_bounds(np.datetime64("2000-01-01", "D"))[0]
        return np.floor((tt2000 - first) / DAY).astype(np.int64), "day"
    return (tt2000 / (BLOCK_LENGTHS.short_s * SECOND)).astype(np.int64), "3 h"


@dataclass(frozen=True)
class Sources:
    """The published archive days behind a comparison, one query an instrument."""

    days: Mapping[tuple[str, np.datetime64], Day]

    @classmethod
    def of(cls, cat: Catalog, mission: Mission, span: slice) -> Sources:
        """Return the published days of every instrument whose channels are compared."""
        instruments = {instrument for instrument, _ in channels_by_name(mission).values()}
        return cls(
            {
                (instrument, day.day): day
                for instrument in sorted(instruments)
                for day in cat.days(f"l1/{instrument}", span, states=("published",))
            }
        )

    def of_days(self, days: Iterable[np.datetime64]) -> Sources:
        """Return those of some days."""
        wanted = set(days)
        return Sources({place: day for place, day in self.days.items() if place[1] in wanted})


def scalar_channels(mission: Mission, flags: bool = False) -> dict[str, tuple[str, str, Channel]]:
    """Return the coordinates that channels make: name -> (instrument, channel, description).

    Components of vector channels are named ``channel[axis]``; channels of kind ``flag`` are states, included
    with `flags`.
    """
    found: dict[str, tuple[str, str, Channel]] = {}
    for name, (instrument, channel) in channels_by_name(mission).items():
        stated = mission.instruments[instrument].channels[channel]
        if stated.kind in _NO_COORDINATE and not (flags and stated.kind == "flag"):
            continue
        names = [f"{name}[{axis}]" for axis in stated.axis_names] or [name]
        found |= dict.fromkeys(names, (instrument, channel, stated))
    return found


@dataclass(frozen=True)
class Spans:
    """Short spans of one day, those that hold samples.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000 of the day's samples.
    length : float
        Of a span, s.
    midnight : int
        TT2000; where the first span begins.
    """

    stamps: Int64
    length: float
    midnight: int

    @classmethod
    def of(cls, stamps: Int64, length: float) -> Spans:
        """Cut a day's stamps, which are not empty, into spans that begin at midnight."""
        return cls(stamps, length, day_bounds(day_of(stamps[:1])[0])[0])

    def number(self, stamps: Int64) -> Int64:
        """Return the number of the span that each stamp is in, from midnight."""
        return np.asarray((stamps - self.midnight) // round(self.length * SECOND), dtype=np.int64)

    @cached_property
    def numbers(self) -> Int64:
        """Numbers of the spans that hold samples."""
        number = self.number(self.stamps)
        return number[np.flatnonzero(np.diff(number, prepend=number[0] - 1))]

    def edges(self, stamps: Int64) -> Int64:
        """Return the first stamp of each span and the one after its last, in turn; (2 * span,).

        `stamps` increase; of a span without any of them both are the same.
        """
        step = round(self.length * SECOND)
        begin = self.midnight + self.numbers * step
        return np.searchsorted(stamps, np.stack([begin, begin + step], axis=1).ravel()).astype(np.int64)

    @property
    def middle(self) -> Int64:
        """TT2000 of the spans' middles."""
        return self.midnight + np.asarray((self.numbers + 0.5) * self.length * SECOND).astype(np.int64)

    def mean(self, values: Floats, stamps: Int64 | None = None) -> Floats:
        """Return means of finite values; (span,), or (span, component); NaN where there are none."""
        edges = self.edges(self.stamps if stamps is None else stamps)
        columns = np.ascontiguousarray(values.reshape(len(values), -1).T, dtype=np.float64)
        count = np.diff(edges)[::2].astype(np.float64)
        finite = np.isfinite(columns)
        if not finite.all():
            columns = np.where(finite, columns, 0.0)
            count = _sums(finite.astype(np.float64), edges)
        with np.errstate(invalid="ignore"):
            means = np.where(count > 0, _sums(columns, edges) / np.maximum(count, 1), np.nan)
        return means.T.reshape(self.numbers.size, *values.shape[1:])

    def extremes(self, values: Floats) -> tuple[Floats, Floats]:
        """Return least and largest finite value of each span; NaN where there are none."""
        first = self.edges(self.stamps)[::2]
        values = np.where(np.isfinite(values), values, np.nan)
        return np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)


def _sums(columns: Floats, edges: Int64) -> Floats:
    """Return the sums of (component, time) between the first and the second, third and fourth ... edge."""
    # The sum of no samples would be a sample; one after the last is there for the last edge.
    padded = np.concatenate([columns, np.zeros((len(columns), 1))], axis=1)
    sums = np.add.reduceat(padded, edges, axis=1)[:, ::2]
    return np.where(np.diff(edges)[::2] > 0, sums, 0.0)


def rows_of_day(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    sources: Sources,
    product: xr.Dataset,
    before: Floats,
    after: Floats,
    spans: Spans,
) -> dict[str, Floats]:
    """Return one day's means: residuals, field, geometry, every channel; (span,) each.

    Parameters
    ----------
    product : xarray.Dataset
        The day's level-2 product.
    before, after : ndarray, shape (time,)
        Residuals, NaN where they are not to be used.
    spans : Spans
        Of the product's stamps.
    """
    field_ = np.where(np.isfinite(after)[:, None], product["field_sensor"].values, np.nan)
    size = np.sqrt(np.einsum("ta,ta->t", field_, field_))
    low, high = spans.extremes(after)
    # Coordinates are those of the span's middle: a day's rows stay within their day.
    out = {
        "tt2000": spans.middle.astype(np.float64),
        "before": spans.mean(before),
        "after": spans.mean(after),
        "low": low,
        "high": high,
        "time of day": (spans.middle - spans.midnight) / (3600.0 * SECOND),
        "field strength": spans.mean(size),
    }
    directions, components = spans.mean(field_ / size[:, None]), spans.mean(field_)
    out |= {f"field direction {axis}": directions[:, i] for i, axis in enumerate("xyz")}
    out |= {f"field component {axis}": components[:, i] for i, axis in enumerate("xyz")}
    day = day_of(spans.stamps[:1])[0]
    out |= channel_means(cat, mission, sources, day, spans)
    return out | geometry_means(cat, mission, comparison, sources, day, spans)


def channel_means(
    cat: Catalog, mission: Mission, sources: Sources, day: np.datetime64, spans: Spans, flags: bool = False
) -> dict[str, Floats]:
    """Return the means of every channel's components; (span,) each, NaN where the day has none.

    Of a channel slower than the spans it is the reading nearest to a span's middle, within its cadence.
    """
    channels = scalar_channels(mission, flags)
    found = {name: np.full(spans.numbers.size, np.nan) for name in channels}
    for instrument in dict.fromkeys(instrument for instrument, _, _ in channels.values()):
        source = sources.days.get((instrument, day))
        if source is None:
            continue
        components: dict[str, list[str]] = {}
        for name, (home, own, _) in channels.items():
            if home == instrument:
                components.setdefault(own, []).append(name)
        data = cat.read(source, list(components), with_time=False)
        stamps = np.asarray(data["tt2000"].values, dtype=np.int64)
        if not stamps.size:
            continue
        cadence = mission.instruments[instrument].cadence
        # All at once: where the spans begin is looked for once an instrument.
        names, columns = [], []
        for own, parts in components.items():
            values = np.asarray(data[own].values, dtype=np.float64).reshape(stamps.size, -1)
            names += parts[: values.shape[1]]
            columns += list(values.T[: len(parts)])
        values = np.stack(columns, axis=1)
        if cadence <= spans.length * SECOND:
            means = spans.mean(values, stamps)
        else:
            index, distance = _nearest(stamps, spans.middle)
            means = np.where((distance <= cadence)[:, None], values[index], np.nan)
        found |= dict(zip(names, means.T, strict=True))
    return found


def _nearest(stamps: Int64, times: Int64) -> tuple[Int64, Int64]:
    """Return the index of the stamp nearest to each time, and the distance, ns; (time,)."""
    after = np.clip(np.searchsorted(stamps, times), 0, stamps.size - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(stamps[after] - times) < np.abs(times - stamps[before]), after, before)
    return index, np.abs(stamps[index] - times)


def geometry_means(
    cat: Catalog, mission: Mission, comparison: str, sources: Sources, day: np.datetime64, spans: Spans
) -> dict[str, Floats]:
    """Return orbit, Sun and local time at the middles of the spans.

    Returns
    -------
    dict of str to ndarray, shape (span,)
        By the names that people read; the Sun's direction as two angles, deg. NaN where the day has no
        positions; empty for a mission without.
    """
    import xarray as xr

    position = position_channel(mission)
    if not position:
        return {}
    homes = channels_by_name(mission)
    channels = {"position": position}
    for name in geometry_channels(mission):
        instrument, own = homes[name]
        if mission.instruments[instrument].channels[own].kind == "attitude":
            channels.setdefault("attitude", name)
    samples = xr.Dataset({"tt2000": ("time", spans.middle)})
    for kind, name in channels.items():
        found = _at_middles(cat, mission, sources, day, spans, *homes[name])
        if found is not None:
            samples[kind] = found
    nothing = np.full(spans.numbers.size, np.nan)
    vector = mission.comparisons[comparison].instruments()["vector"]
    mounted = {"orientation": mission.instruments[vector].orientation}
    samples["vector"] = (("time", "axis"), np.stack([nothing] * 3, axis=1), mounted)
    geometry = add_geometry(samples)
    known = [name for name in _GEOMETRY if name in geometry]
    out = {
        name.replace("_", " "): geometry[name].values.astype(np.float64) if known else nothing
        for name in known or _GEOMETRY
    }
    out |= {"Sun azimuth": nothing, "Sun elevation": nothing}
    if "sun_direction" in geometry:
        x, y, z = geometry["sun_direction"].values.T
        out["Sun azimuth"] = np.rad2deg(np.arctan2(y, x))
        out["Sun elevation"] = np.rad2deg(np.arcsin(np.clip(z, -1.0, 1.0)))
    return out


def _at_middles(
    cat: Catalog,
    mission: Mission,
    sources: Sources,
    day: np.datetime64,
    spans: Spans,
    instrument: str,
    channel: str,
) -> tuple[tuple[str, str], Floats, dict[str, Any]] | None:
    """Return a vector channel at the middles of the spans: dims, values, attributes; None without one.

    Attitudes are the nearest reading, all else is interpolated; NaN farther than 1.5 cadences from a reading.
    """
    source = sources.days.get((instrument, day))
    if source is None:
        return None
    data = cat.read(source, [channel], with_time=False)
    stamps = np.asarray(data["tt2000"].values, dtype=np.int64)
    values = np.asarray(data[channel].values, dtype=np.float64)
    if stamps.size < 2:
        return None
    index, distance = _nearest(stamps, spans.middle)
    chosen = values[index]
    if data[channel].attrs.get("kind") != "attitude":
        chosen = np.stack([np.interp(spans.middle, stamps, column) for column in values.T], axis=1)
    chosen = np.where((distance <= 1.5 * mission.instruments[instrument].cadence)[:, None], chosen, np.nan)
    dim = "axis" if chosen.shape[1] == 3 else f"{channel}_component"
    return ("time", dim), chosen, dict(data[channel].attrs)
