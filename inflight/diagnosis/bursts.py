"""Bursts: stretches in which the residual scatters far beyond what is usual, sample by sample.

What a burst is, is judged by the bends of the residual, each sample against the straight line through its
neighbours: a switch, a slow field, a storm seen through a clock offset bend at most a few samples. What also
bends both instruments' readings, or goes with a recorded channel that is as lively, is a signal and stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.comparison import Rows
from inflight.time import SECOND, Int64, utc_text

#: A burst scatters this many times as much as usual; so much livelier is a channel that makes one.
FAR = 10.0
#: Never is more of a span than this left out as bursts.
MOST = 0.02
#: Samples the scatter is the median of, odd; how far a sample must bend to be in a burst, in usual scatters;
#: samples a record needs; bursts told of a block, and of a span.
_AROUND, _WILD, _FEWEST, _TOLD, _NAMED = 11, 6.0, 100, 20, 12
#: An instrument that is not wild itself is lively when it fluctuates so many times as much as usual.
_LIVELY = 2.0


class Burst(NamedTuple):
    """A burst: the samples from `first` to before `last`, and its median scatter over the usual one."""

    first: int
    last: int
    times_usual: float


@dataclass(frozen=True)
class Outliers:
    """What a pass left out, over the whole span.

    Attributes
    ----------
    spikes, burst_samples, burst_count : int
    share : float
        Part of the usable samples that bursts hold.
    kept : bool
        True when the bursts hold too much of the span to be left out; they are in the evidence then.
    bursts : tuple of dict
        ``start``, ``end`` (UTC), ``samples``, ``times_usual`` of the first ones.
    """

    spikes: int = 0
    burst_samples: int = 0
    burst_count: int = 0
    share: float = 0.0
    kept: bool = False
    bursts: tuple[dict[str, Any], ...] = ()

    @classmethod
    def of(cls, reports: Sequence[Mapping[str, Any]], kept: bool) -> Outliers:
        """Return the outliers of blocks' reports, in order of time."""
        samples = sum(int(one["burst_samples"]) for one in reports)
        good = sum(float(one["count"]) for one in reports)
        told = [burst for one in reports for burst in one["bursts"]][:_NAMED]
        return cls(
            sum(int(one["spikes"]) for one in reports),
            samples,
            sum(int(one["burst_count"]) for one in reports),
            samples / max(good + (0.0 if kept else samples), 1.0),
            kept,
            tuple(
                {
                    "start": utc_text(int(start)),
                    "end": utc_text(int(end)),
                    "samples": int(count),
                    "times_usual": float(times),
                }
                for start, end, count, times in told
            ),
        )

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name, and `samples`, all that was left out."""
        return {"samples": self.spikes + (0 if self.kept else self.burst_samples), **vars(self)}


def bursts(residual: Floats, stamps: Int64, usable: npt.NDArray[np.bool_]) -> list[Burst]:
    """Return the bursts of a residual (time, row), whatever made them, in order.

    The usual scatter is the record's median one, so that a residual that is lively all the time has none.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    usable : ndarray of bool, shape (time,)
    """
    place = np.flatnonzero(usable)
    if place.size < _FEWEST:
        return []
    size = _bends(residual[place], stamps[place])
    local = np.stack([median_filter(row, size=_AROUND, mode="nearest") for row in size.T], axis=1)
    usual = np.array([np.median(row[row > 0]) if (row > 0).any() else np.inf for row in local.T])
    times = (local / usual).max(axis=1)
    wild = np.asarray((size > _WILD * usual).any(axis=1))
    return [
        Burst(int(place[first]), int(place[last - 1]) + 1, float(np.median(times[first:last])))
        for first, last in _stretches(times > FAR, wild, stamps[place])
    ]


def _bends(values: Floats, stamps: Int64) -> Floats:
    """Return how far each sample is from the line through its neighbours, in sizes of noise; (time, row)."""
    seconds = (stamps - stamps[0]) / SECOND
    part = ((seconds[1:-1] - seconds[:-2]) / (seconds[2:] - seconds[:-2]))[:, None]
    off = values[1:-1] - (1.0 - part) * values[:-2] - part * values[2:]
    out = np.abs(off) / np.sqrt(1.0 + part**2 + (1.0 - part) ** 2)
    # Across a gap the line says nothing.
    wide = np.diff(seconds) > _AROUND * np.median(np.diff(seconds))
    out[wide[1:] | wide[:-1]] = 0.0
    return np.asarray(np.pad(out, ((1, 1), (0, 0)), mode="edge"))


def _stretches(
    far: npt.NDArray[np.bool_], wild: npt.NDArray[np.bool_], stamps: Int64
) -> list[tuple[int, int]]:
    """Return first and last+1 of the stretches around far samples, from the first wild one to the last."""
    if not far.any():
        return []
    core = np.flatnonzero(far)
    step = float(np.median(np.diff(stamps)))
    apart = (np.diff(core) > 2 * _AROUND) | (np.diff(stamps[core]) > 2 * _AROUND * step)
    out = []
    for group in np.split(core, np.flatnonzero(apart) + 1):
        low, high = max(int(group[0]) - _AROUND, 0), min(int(group[-1]) + _AROUND + 1, far.size)
        near = np.abs(stamps[low:high] - stamps[group[0]]) <= stamps[group[-1]] - stamps[group[0]] + (
            _AROUND * step
        )
        inside = low + np.flatnonzero(wild[low:high] & near)
        if inside.size:
            out.append((int(inside[0]), int(inside[-1]) + 1))
    return out


def is_signal(
    burst: Burst,
    others: Sequence[Burst],
    rows: Rows,
    stamps: Int64,
    channels: Mapping[str, Floats],
    edges: Int64,
) -> bool:
    """Return True when a burst is more than wild readings of one instrument.

    Both instruments are livelier than usual, and their difference is not far beyond what they share: the
    field itself is lively. Or a recorded channel does there what it does nowhere else: it was switched on.

    Parameters
    ----------
    others : sequence of Burst
        Every burst of the record.
    stamps : ndarray of int64, shape (time,)
        TT2000 of the samples.
    channels : mapping of str to ndarray, shape (bin, ...)
        As they were recorded, on bins.
    edges : ndarray of int64, shape (bin + 1,)
        TT2000 of the bins.
    """
    return _both_fluctuate(burst, others, rows, stamps) or _goes_with(burst, others, stamps, channels, edges)


def _both_fluctuate(burst: Burst, others: Sequence[Burst], rows: Rows, stamps: Int64) -> bool:
    pair = _readings(rows)
    quiet = np.ones(len(stamps), dtype=bool)
    for one in others:
        quiet[max(one.first - 2, 0) : one.last + 2] = False
    inside = np.zeros(len(stamps), dtype=bool)
    inside[burst.first : burst.last] = True
    lively, sizes = True, []
    for values in (*pair, rows.residual):
        ripple = _ripple(values, stamps, rows.good)
        there, usual = _median_square(ripple[inside]), _median_square(ripple[quiet])
        sizes.append(max(there - usual, 0.0))
        lively &= there > _LIVELY**2 * usual
    return lively and FAR**2 * min(sizes[:-1]) > sizes[-1]


def _readings(rows: Rows) -> list[Floats]:
    """Return what each of the two instruments says; (time, component)."""
    if rows.residual.shape[1] == 1:
        size = np.linalg.norm(rows.field, axis=1, keepdims=True)
        return [size, size - rows.residual]
    return list(rows.fields.values())


def _ripple(values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
    """Return fourth differences, in sizes of noise; (time,), NaN where neighbours are missing.

    The field that an orbit leads through bends by as much as noise does; hardly anything of it is left here.
    """
    known = np.where(good[:, None], values, np.nan)
    out = np.full(len(values), np.nan)
    if len(values) < 5:
        return out
    off = known[2:-2] - (4.0 * (known[1:-3] + known[3:-1]) - known[:-4] - known[4:]) / 6.0
    even = np.abs(np.diff(stamps) / np.median(np.diff(stamps)) - 1.0) < 0.1
    off[~(even[:-3] & even[1:-2] & even[2:-1] & even[3:])] = np.nan
    out[2:-2] = np.linalg.norm(off, axis=1) / np.sqrt(1.0 + 34.0 / 36.0)
    return out


def _median_square(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known) ** 2) if known.size else 0.0


def _goes_with(
    burst: Burst, others: Sequence[Burst], stamps: Int64, channels: Mapping[str, Floats], edges: Int64
) -> bool:
    """Return True when some channel is lively all through the burst and not elsewhere, or is on for it."""
    between, width = edges[1:-1], int(edges[1] - edges[0])
    quiet = np.ones(between.size, dtype=bool)
    for one in others:
        quiet &= (between < stamps[one.first] - width) | (between > stamps[one.last - 1] + width)
    start, end = int(stamps[burst.first]), int(stamps[burst.last - 1])
    inside = (between >= start - width) & (between <= end + width)
    ends = [np.abs(between - at) <= width for at in (start, end)]
    if not inside.any() or not quiet.any():
        return False
    # One change in the midst of a long burst is chance.
    short = end - start <= 2 * width
    for values in channels.values():
        change = np.linalg.norm(np.diff(values.reshape(len(values), -1), axis=0), axis=1)
        change = np.where(np.isfinite(change), change, 0.0)
        least = max(FAR * float(np.sqrt(np.mean(change[quiet] ** 2))), 1e-300)
        through = change[inside].max() if short else float(np.median(change[inside]))
        if through > least or min(change[at].max(initial=0.0) for at in ends) > least:
            return True
    return False


def told_of(found: Sequence[Burst], stamps: Int64, usable: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return what a block's report says of its bursts: how many, how long, and the first ones."""
    samples = [int(usable[one.first : one.last].sum()) for one in found]
    return {
        "burst_samples": sum(samples),
        "burst_count": len(found),
        "bursts": [
            [int(stamps[one.first]), int(stamps[one.last - 1]), count, round(one.times_usual, 1)]
            for one, count in zip(found[:_TOLD], samples, strict=False)
        ],
    }
