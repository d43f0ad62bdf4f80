"""What one channel tells of itself: a reading that repeats, a temperature or an angle in another unit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from inflight.arrays import Floats
from inflight.plumbing.findings import Finding, Remedy, channel_path
from inflight.plumbing.records import PLUMBING_SETTINGS, Record, chance_text
from inflight.time import SECOND, Int64
from inflight.units import factor_and_offset

#: Kinds of channels that stand still for good reasons.
_STILL_KINDS = ("flag", "sun_pulse", "sunlight", "spin_axis")

_KELVIN = 273.15


class Stale(NamedTuple):
    """A run of one number (first and last row), how often it repeats, and how long others are at most."""

    first: int
    last: int
    repeats: int
    usual: int
    p: float


def stale_findings(record: Record) -> list[Finding]:
    """Return the stretches in which a channel repeats a number for much longer than it ever does else."""
    if record.kind in _STILL_KINDS:
        return []
    flat = record.values.reshape(len(record.values), -1)
    names = record.entry.axis_names or ("",) * flat.shape[1]
    by_axis = {name: stale_runs(column) for name, column in zip(names, flat.T, strict=True)}
    found = [(run, name) for name, runs in by_axis.items() for run in runs]
    if not found:
        return []
    longest = max(found, key=lambda one: one[0].repeats)[0]
    axes = tuple(name for name, runs in by_axis.items() if runs and name)
    cadence = record.cadence_ns / SECOND
    starts = {run.first for run, _ in found}
    words = f"'{record.channel}' of '{record.instrument}' repeats a stale value"
    words += f" on {', '.join(axes)}" if axes and len(axes) < flat.shape[1] else ""
    words += f", {len(starts)} times" if len(starts) > 1 else ""
    usual = max(run.usual for run, _ in found)
    sure = (
        f"the same number {longest.repeats} times in a row, where it else stays for {longest.usual} readings "
        f"at most (chance {chance_text(longest.p)})"
    )
    # Between both: other months may hold somewhat longer runs.
    limit = int(np.sqrt(usual * min(run.repeats for run, _ in found)))
    line = (channel_path(record.instrument, record.channel, "most_repeats"), str(limit))
    return [
        Finding(
            fault="stale",
            words=words,
            instrument=record.instrument,
            channel=record.channel,
            axes=axes,
            start=int(record.stamps[min(run.first for run, _ in found)]),
            end=int(record.stamps[max(run.last for run, _ in found)]),
            how_sure=sure,
            p=longest.p,
            before=longest.repeats * cadence,
            after=longest.usual * cadence,
            unit="s",
            remedies=(Remedy("the readings are stale", (line,)),),
        )
    ]


def stale_runs(values: Floats) -> list[Stale]:
    """Return runs of one number that are far longer than the others of a series (time,); gaps end none.

    A channel that switches stays at its levels for long, at rest it reads zero or an end of its range: a run
    counts only at a number that lies between others and is no level, which is where the channel stays for
    long once more.
    """
    rows = np.flatnonzero(np.isfinite(values))
    first = np.flatnonzero(np.diff(values[rows], prepend=np.nan) != 0.0)
    if first.size < PLUMBING_SETTINGS.least_runs:
        return []
    length, number = np.diff(np.append(first, rows.size)), values[rows][first]
    apart = PLUMBING_SETTINGS.stale_runs
    usual = int(np.sort(length)[-1 - apart])
    low, high = number.min(), number.max()
    out = []
    for place in np.flatnonzero(length >= PLUMBING_SETTINGS.longer * usual):
        here = number[place]
        others = length[(number == here) & (np.arange(number.size) != place)]
        is_level = bool(others.size and others.max() > 2 * usual)
        # Were lengths exponential, so many runs would hold one as long with this chance.
        p = float(first.size * (apart / first.size) ** (length[place] / usual))
        if low < here < high and here != 0.0 and not is_level and p < PLUMBING_SETTINGS.chance:
            last = first[place] + length[place] - 1
            out.append(Stale(int(rows[first[place]]), int(rows[last]), int(length[place]), usual, p))
    return out


def temperature_findings(record: Record) -> list[Finding]:
    """Return whether a temperature is in kelvins where degrees are stated, or the other way round."""
    if record.entry.unit not in ("degC", "K") or not np.isfinite(record.values).any():
        return []
    low, high = PLUMBING_SETTINGS.earth_temperatures
    zero = _KELVIN if record.entry.unit == "K" else 0.0
    typical = float(np.nanmedian(record.values)) - zero
    really = {"K": typical - _KELVIN, "degC": typical + _KELVIN}
    unit = next((name for name, value in really.items() if low < value < high), None)
    if low <= typical <= high or unit is None:
        return []
    words = f"'{record.channel}' of '{record.instrument}' is in {unit}, not as stated"
    sure = (
        f"a typical temperature of {typical:.4g} degC is beyond {low:g} to {high:g} degC, "
        f"{really[unit]:.4g} is not"
    )
    line = (channel_path(record.instrument, record.channel, "file_unit"), unit)
    return [_of_record(record, words, sure, typical, really[unit], "degC", [Remedy(words, (line,))])]


def angle_findings(record: Record) -> list[Finding]:
    """Return whether an angle that goes round is in radians where degrees are stated, or in degrees."""
    try:
        turn = factor_and_offset("deg", record.entry.unit)[0] * 360.0
    except ValueError:
        return []
    if record.entry.unit not in ("deg", "rad", "degree", "radian") or record.values.ndim != 1:
        return []
    values = record.values[np.isfinite(record.values)]
    if values.size < PLUMBING_SETTINGS.least_runs:
        return []
    span, jump = float(np.ptp(values)), float(np.abs(np.diff(values)).max())
    # An angle that goes round falls by a whole turn; nothing else does exactly that.
    if span <= 0 or jump < 0.9 * span:
        return []
    ratio = turn / span
    for unit, size in (("rad", np.degrees(1.0)), ("deg", np.radians(1.0))):
        if abs(ratio / size - 1.0) < 0.02:
            words = f"'{record.channel}' of '{record.instrument}' is in {unit}, not as stated"
            sure = f"it falls by {jump:.5g} {record.entry.unit} at its ends, where a turn has {turn:.5g}"
            line = (channel_path(record.instrument, record.channel, "file_unit"), unit)
            return [
                _of_record(
                    record, words, sure, span, span * size, record.entry.unit, [Remedy(words, (line,))]
                )
            ]
    return []


def _of_record(
    record: Record, words: str, sure: str, before: float, after: float, unit: str, remedies: Sequence[Remedy]
) -> Finding:
    stamps: Int64 = record.stamps
    return Finding(
        fault="unit",
        words=words[0].upper() + words[1:],
        instrument=record.instrument,
        channel=record.channel,
        start=int(stamps[0]),
        end=int(stamps[-1]),
        how_sure=sure,
        p=0.0,
        before=before,
        after=after,
        unit=unit,
        remedies=tuple(remedies),
    )
