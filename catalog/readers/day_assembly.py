"""UTC days out of the rows of several files: order, repeats, clashes, a clock that ran backwards, coverage.

The rule for one day:

* rows are sorted by time; that they were not in order is reported;
* rows of one time whose values agree (a missing value agrees with any) are one row, counted as repeated;
* two different values for one time refuse the day (`ClashError`);
* a file whose clock stepped back covers a span twice. Where the repeated rows agree they are merged and
  flagged CLOCK_REPAIRED. Where they do not, the day is refused with the place, except for an excursion:
  a clock that jumped away and back, with a gap of exactly as many rows as it was away. Those
  rows have no known time; they are dropped and reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from inflight.catalog.readers.raw import Flags, RawTable
from inflight.catalog.readers.source import Float
from inflight.errors import ClashError, ContentError
from inflight.flags import Flag
from inflight.instruments import Channel, Instrument
from inflight.time import GAP, Int64, day_bounds, day_of, in_leap_second, to_utc

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, kw_only=True)
class DayAssemblySettings:
    """How the rows of a day are put in order.

    Attributes
    ----------
    near : float
        Rows of two passes of one clock that are this near, in cadences, cover one span twice. Derived: of two
        interleaved series some rows lie half a cadence apart or less, and stamps jitter.
    excursion_gap : float
        The gap of an excursion may differ from the time of its rows by less than this, in cadences (assumed).
    listed_gaps : int
        Gaps listed one by one in a report; the number and the missing samples always cover all.
    """

    near: float = 0.6
    excursion_gap: float = 0.75
    listed_gaps: int = 200


DAY_ASSEMBLY_SETTINGS = DayAssemblySettings()


@dataclass(frozen=True)
class _Rows:
    """Rows of one day out of all files, in order of time."""

    times: Int64
    channels: dict[str, Float]
    flag: Flags
    #: Which part a row came from, its number in the file, and which ascending run of the file it is in.
    part: Int64
    row: Int64
    run: Int64


def split_days(table: RawTable) -> dict[np.datetime64, RawTable]:
    """Split the rows of a file by the UTC day of their own time, the order of the file kept.

    Returns
    -------
    dict of datetime64[D] -> RawTable
        Every row is in exactly one of them.
    """
    days = day_of(table.times)
    if days.size and (days == days[0]).all():
        return {days[0]: table}
    return {day: table.take(days == day) for day in np.unique(days)}


def assemble_day(
    day: np.datetime64, parts: Sequence[RawTable], name: str, instrument: Instrument
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Make the level-1 Dataset of one instrument and day.

    Parameters
    ----------
    day : datetime64[D]
        The UTC day all rows belong to.
    parts : sequence of RawTable
        The rows of that day, one part a file.
    name : str
        The instrument's name.
    instrument : Instrument
        Channels and cadence.

    Returns
    -------
    dataset : Dataset
        dims ``time`` and ``axis`` (or ``<channel>_axis`` when the axes are not x, y, z); ``tt2000`` int64,
        the channels, ``flag`` uint32.
    report : dict
        Rows, files, coverage and gaps per channel, what was dropped, repeated or out of order.

    Raises
    ------
    ClashError
        Two values for one time, or a clock that ran backwards.
    ContentError
        When every value of the field, or of all channels, is missing.
    """
    cleaned, excursions = zip(*(_without_excursions(part, instrument.cadence) for part in parts), strict=True)
    rows, unsorted = _concatenate(cleaned)
    files = [part.file for part in parts]
    _refuse_backwards(rows, files, day, instrument.cadence)
    merged, repeated = _merge_repeats(rows, files, day)
    leap = np.where(in_leap_second(merged.times), Flag.LEAP_SECOND, 0).astype(np.uint32)
    flag = merged.flag | leap
    missing = {"vector": Flag.VECTOR_MISSING, "scalar": Flag.SCALAR_MISSING}
    of_field = missing.get(instrument.role, Flag.CHANNEL_MISSING)
    for channel_name, values in merged.channels.items():
        bit = of_field if channel_name == "field" else Flag.CHANNEL_MISSING
        flag |= np.where(valid_rows(values), 0, bit).astype(np.uint32)
    dataset = _dataset(merged, flag, name, instrument)
    report = {
        "rows": int(merged.times.size),
        "files": files,
        "dropped": {
            reason: count
            for reason, count in {"clock_excursion": sum(excursions), "repeated": repeated}.items()
            if count
        },
        "unsorted": unsorted,
        "channels": {
            channel: coverage(merged.times[valid_rows(values)], day, instrument.cadence)
            for channel, values in merged.channels.items()
        },
    }
    _refuse_all_fill(report, instrument, day, files)
    return dataset, report


def valid_rows(values: Float) -> npt.NDArray[np.bool_]:
    """Return the rows (row,) in which all axes are finite."""
    finite = np.isfinite(values)
    return np.asarray(finite if finite.ndim == 1 else finite.all(axis=1))


def coverage(times: Int64, day: np.datetime64, cadence: int) -> dict[str, Any]:
    """Report valid samples against what the cadence expects, and the gaps, of one channel and UTC day.

    Parameters
    ----------
    times : ndarray of int64
        TT2000 of the valid samples, ascending (time,).
    day : datetime64[D]
        The day, which the edges are counted from.
    cadence : int
        Nanoseconds.
    """
    start, end = day_bounds(day)
    expected = max(1, round((end - start) / cadence))
    fence = np.concatenate([[start - cadence], times, [end]])
    spacing = np.diff(fence)
    at = np.flatnonzero(spacing > GAP * cadence)
    missing = np.rint(spacing[at] / cadence).astype(np.int64) - 1
    begins, ends = to_utc(fence[at] + cadence), to_utc(fence[at + 1])
    gaps = list(zip(begins, ends, missing, strict=True))[: DAY_ASSEMBLY_SETTINGS.listed_gaps]
    listed = [[str(begin), str(stop), int(count)] for begin, stop, count in gaps]
    return {
        "valid": int(times.size),
        "expected": expected,
        "coverage": min(1.0, times.size / expected),
        "gap_count": int(at.size),
        "gap_samples": int(missing.sum()),
        "gaps": listed,
    }


def _without_excursions(part: RawTable, cadence: int) -> tuple[RawTable, int]:
    """Drop the rows of a clock that jumped away and back (see the module's rule)."""
    times = part.times
    descents = np.flatnonzero(np.diff(times) < 0) + 1
    crowded = np.less_equal(np.diff(np.sort(times)), DAY_ASSEMBLY_SETTINGS.near * cadence)
    if not descents.size or not crowded.any():
        return part, 0
    keep = np.ones(times.size, dtype=bool)
    for begin in descents:
        later = np.flatnonzero(times[begin:] > times[begin - 1])
        if not later.size:
            continue
        stop = begin + int(later[0])
        missing = int(times[stop] - times[begin - 1]) - (stop - begin + 1) * cadence
        others = np.sort(np.delete(times, slice(begin, stop)))
        after = np.clip(np.searchsorted(others, times[begin:stop]), 1, others.size - 1)
        distance = np.abs(others[[after - 1, after]] - times[begin:stop]).min(axis=0)
        near = (distance <= DAY_ASSEMBLY_SETTINGS.near * cadence).all()
        if abs(missing) < DAY_ASSEMBLY_SETTINGS.excursion_gap * cadence and near:
            keep[begin:stop] = False
    return part.take(keep), int((~keep).sum())


def _concatenate(parts: Sequence[RawTable]) -> tuple[_Rows, int]:
    """Join the parts in order of time; return also how many rows followed a later one in their file."""
    times = np.concatenate([part.times for part in parts])
    steps = [np.concatenate([[0], np.diff(part.times) < 0]) for part in parts]
    order = np.argsort(times, kind="stable")
    sizes = [part.times.size for part in parts]
    rows = _Rows(
        times[order],
        {name: np.concatenate([part.channels[name] for part in parts])[order] for name in parts[0].channels},
        np.concatenate([part.flag for part in parts])[order],
        np.repeat(np.arange(len(parts)), sizes)[order],
        np.concatenate([part.rows for part in parts])[order],
        np.concatenate([np.cumsum(step) for step in steps]).astype(np.int64)[order],
    )
    return rows, int(sum(step.sum() for step in steps))


def _refuse_backwards(rows: _Rows, files: Sequence[str], day: np.datetime64, cadence: int) -> None:
    spacing = np.diff(rows.times)
    twice = (spacing > 0) & (spacing <= DAY_ASSEMBLY_SETTINGS.near * cadence) & _same_file_other_run(rows)
    if not twice.any():
        return
    at = int(np.flatnonzero(twice)[0])
    first, second = sorted((at, at + 1), key=lambda index: int(rows.row[index]))
    raise ClashError(
        f"the clock ran backwards: row {rows.row[second]} at {to_utc(rows.times[second])} repeats the span "
        f"of row {rows.row[first]} at {to_utc(rows.times[first])}, and {int(twice.sum())} rows do not agree",
        remedy="repair the file's times, remove the repeated span, or correct 'cadence' if it is shorter",
        file=files[rows.part[at]],
        day=str(day),
    )


def _same_file_other_run(rows: _Rows) -> npt.NDArray[np.bool_]:
    return np.asarray((np.diff(rows.part) == 0) & (np.diff(rows.run) != 0))


def _merge_repeats(rows: _Rows, files: Sequence[str], day: np.datetime64) -> tuple[_Rows, int]:
    """Make one row of each time; the values must agree where both are there."""
    same = np.diff(rows.times) == 0
    repeated = int(same.sum())
    if not repeated:
        return rows, 0
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    channels = {}
    for name, values in rows.channels.items():
        low = np.fmin.reduceat(values, starts, axis=0)
        clashing = np.fmax.reduceat(values, starts, axis=0) > low
        if clashing.any():
            group = int(np.flatnonzero(clashing.reshape(clashing.shape[0], -1).any(axis=1))[0])
            raise _clash(rows, name, int(starts[group]), files, day)
        channels[name] = low
    repaired = np.concatenate([[False], same & _same_file_other_run(rows)])
    flag = rows.flag | np.where(repaired, Flag.CLOCK_REPAIRED, 0).astype(np.uint32)
    return (
        _Rows(
            rows.times[starts],
            channels,
            np.bitwise_or.reduceat(flag, starts),
            rows.part[starts],
            rows.row[starts],
            rows.run[starts],
        ),
        repeated,
    )


def _clash(rows: _Rows, name: str, start: int, files: Sequence[str], day: np.datetime64) -> ClashError:
    values = rows.channels[name]
    members = np.flatnonzero(rows.times == rows.times[start])
    first = int(members[0])
    other = next(
        (
            int(index)
            for index in members[1:]
            if (
                np.isfinite(values[index]) & np.isfinite(values[first]) & (values[index] != values[first])
            ).any()
        ),
        int(members[-1]),
    )
    both = " and ".join(
        f"{values[index].tolist()} ({files[rows.part[index]]}, row {rows.row[index]})"
        for index in (first, other)
    )
    backwards = rows.part[first] == rows.part[other] and rows.run[first] != rows.run[other]
    return ClashError(
        f"{'the clock ran backwards and gives ' if backwards else ''}two different values for "
        f"{to_utc(rows.times[start])}: {both}",
        remedy="remove the wrong delivery, or name the right one as a later version of the same file",
        file=files[rows.part[other]],
        channel=name,
        day=str(day),
    )


def _refuse_all_fill(
    report: dict[str, Any], instrument: Instrument, day: np.datetime64, files: Sequence[str]
) -> None:
    valid = {name: summary["valid"] for name, summary in report["channels"].items()}
    needed = ["field"] if instrument.role in ("vector", "scalar") else []
    empty = [name for name in needed if not valid[name]] or ([] if any(valid.values()) else list(valid))
    if empty:
        raise ContentError(
            f"all {report['rows']} values are missing (fill, out of range or not finite)",
            remedy="check 'fill', 'range' and the delivery; the day is left out",
            file=", ".join(files),
            channel=empty[0],
            day=str(day),
        )


def _dataset(rows: _Rows, flag: Flags, name: str, instrument: Instrument) -> xr.Dataset:
    import xarray as xr

    variables: dict[str, Any] = {
        "tt2000": ("time", rows.times, {"units": "ns", "long_name": "TT2000, ns since 2000-01-01T12:00 TT"}),
        "flag": ("time", flag, {"units": "1", "long_name": "quality bits, 0 is good"}),
    }
    for channel_name, values in rows.channels.items():
        channel = instrument.channels[channel_name]
        dims = ("time", axis_dimension(channel_name, channel)) if values.ndim == 2 else ("time",)
        variables[channel_name] = (dims, values, channel_attributes(channel_name, channel, instrument))
    attributes = {"instrument": name, "role": instrument.role, "cadence_ns": instrument.cadence}
    return xr.Dataset(variables, attrs=attributes)


def axis_dimension(name: str, channel: Channel) -> str:
    """Return the dimension of a channel's axes: ``axis`` for x, y, z, else one of its own."""
    return "axis" if channel.axis_names == ("x", "y", "z") else f"{name}_axis"


def channel_attributes(name: str, channel: Channel, instrument: Instrument) -> dict[str, Any]:
    """Return a channel's attributes in the archive; `resolution` is given only when the YAML states it."""
    vector = instrument.role == "vector" and name == "field"
    attributes: dict[str, Any] = {
        "units": channel.unit,
        "kind": channel.kind,
        "cadence_ns": instrument.cadence,
        "lag_ns": channel.lag,
        "frame": channel.frame or ("sensor" if vector else ""),
        "long_name": channel.description or name.replace("_", " "),
    }
    if channel.axis_names:
        attributes["axes"] = " ".join(channel.axis_names)
    if channel.resolution is not None:
        attributes["resolution"] = channel.resolution
    return attributes
