"""Stretches of the difference between two jumps: their levels, and what drifts within them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.jumps import FALSE_ALARMS, LONGEST, Places, StepNoise, find_jumps, spikes
from inflight.dual.level_noise import level_noise
from inflight.dual.readings import Readings
from inflight.dual.tails import confirmed, without_tails
from inflight.errors import SamplesError
from inflight.time import SECOND, Int64

#: A stretch with fewer samples than this is no state but a passing disturbance or a transition.
SHORTEST = 10


@dataclass(frozen=True)
class Segments:
    """Stretches between jumps, in the order of time; d is the difference of the two sensors, nT.

    Attributes
    ----------
    first, last : ndarray of int64, shape (segment,)
        Half-open rows of the readings; rows without a reading belong to the segment before them.
    start, end : ndarray of int64, shape (segment,)
        TT2000 of the first and of the last good sample.
    count : ndarray of int64, shape (segment,)
        Good samples.
    level : ndarray, shape (segment, axis)
        Mean of d.
    begin, finish : Ends
        The first and the last samples, at most `window`; both the whole of a segment shorter than twice that.
    covariance : ndarray, shape (segment, axis, axis)
        Of the noise of the mean at either end, nT^2.
    slope_variance : ndarray, shape (segment, axis)
        Of the noise of the slope at either end, nT^2/s^2.
    transient : ndarray of bool, shape (segment,)
        Too short to be a state.
    noise : StepNoise
        Of d, without its drift.
    window : int
        Samples.
    spikes : ndarray of int64, shape (spike,)
        Rows of single samples that stand out from their neighbours; they count nowhere.
    """

    first: Places
    last: Places
    start: Int64
    end: Int64
    count: Places
    level: Floats
    begin: Ends
    finish: Ends
    covariance: Floats
    slope_variance: Floats
    transient: npt.NDArray[np.bool_]
    noise: StepNoise
    window: int
    spikes: Places

    def __len__(self) -> int:
        return int(self.first.size)

    @property
    def seconds(self) -> Floats:
        """Time between the middles of both ends; (segment,), s, 0 where they are one."""
        return np.asarray((self.finish.middle - self.begin.middle) / SECOND)


class Ends(NamedTuple):
    """Mean and slope of one end of each segment.

    Attributes
    ----------
    middle : ndarray of int64, shape (segment,)
        TT2000.
    mean, slope : ndarray, shape (segment, axis)
        nT and nT/s.
    """

    middle: Int64
    mean: Floats
    slope: Floats


def segments_of(
    readings: Readings,
    *,
    shortest: int = SHORTEST,
    false_alarms: float = FALSE_ALARMS,
    longest: int = LONGEST,
    jumps: Places | None = None,
) -> Segments:
    """Cut readings where their difference jumps.

    Parameters
    ----------
    readings : Readings
    shortest : int
        Minimum dwell, samples; neighbouring stretches that are shorter become one transient segment.
    false_alarms, longest
        See `find_jumps`.
    jumps : ndarray of int64, optional
        Rows of the readings where jumps are known to be, such as those of `published_jumps`; searched when
        absent.

    Raises
    ------
    SamplesError
        No sample has both sensors.
    """
    rows = np.flatnonzero(readings.good)
    if not rows.size:
        raise SamplesError("no sample has both sensors", remedy="take a span where both measured")
    # Copying a million rows costs more than looking whether one is missing.
    d = readings.difference if rows.size == len(readings) else readings.difference[rows]
    lone = np.flatnonzero(spikes(d))
    if lone.size:
        d = d.copy()
        d[lone] = 0.5 * (d[lone - 1] + d[lone + 1])
    d = without_tails(d)
    places, noise = find_jumps(d, false_alarms=false_alarms, longest=longest)
    places = confirmed(d, places)
    if jumps is not None:
        places = np.unique(np.searchsorted(rows, jumps))
    edges = np.concatenate([[0], places[(places > 0) & (places < rows.size)], [rows.size]]).astype(np.int64)
    edges, transient = _without_short(edges, shortest)
    level = level_noise(d, edges[1:-1], noise)
    # Where the drift is a random walk longer stretches are less sure than shorter ones.
    best = int(np.argmin(np.einsum("sii->s", level.covariance)))
    window = int(level.length[best] if best + 1 < level.length.size else noise.length[-1])
    return _measured(readings, rows, d, edges, transient, (level, window), rows[lone])


def _without_short(edges: Places, shortest: int) -> tuple[Places, npt.NDArray[np.bool_]]:
    """Return edges with neighbouring short stretches joined, and which stretches are short."""
    short = np.diff(edges) < shortest
    kept = np.ones(edges.size, dtype=bool)
    kept[1:-1] = ~(short[:-1] & short[1:])
    return edges[kept], short[kept[:-1]]


def _measured(
    readings: Readings,
    rows: Places,
    d: Floats,
    edges: Places,
    transient: npt.NDArray[np.bool_],
    measured: tuple[StepNoise, int],
    lone: Places,
) -> Segments:
    count = np.diff(edges)
    noise, window = measured
    width = np.where(count >= 2 * window, window, count)
    good = readings.stamps if rows.size == len(readings) else readings.stamps[rows]
    begin = _end(d, good, edges[:-1], edges[:-1] + width)
    finish = _end(d, good, edges[1:] - width, edges[1:])
    half = np.maximum(width // 2, 1)
    apart = np.maximum(good[edges[:-1] + width - 1] - good[edges[:-1]], 1) / SECOND / 2.0
    slope_noise = 2.0 * np.einsum("sii->si", noise.of_mean(half)) / apart[:, None] ** 2
    last = np.append(rows[edges[1:-1]], len(readings)).astype(np.int64)
    return Segments(
        np.concatenate([[0], last[:-1]]).astype(np.int64),
        last,
        good[edges[:-1]],
        good[edges[1:] - 1],
        count,
        _means(d, edges[:-1], edges[1:]),
        begin,
        finish,
        noise.of_mean(width),
        np.where(width[:, None] > 1, slope_noise, np.inf),
        transient,
        noise,
        window,
        lone,
    )


def _end(d: Floats, stamps: Int64, first: Places, last: Places) -> Ends:
    """Return mean and slope of ranges of rows; the slope by the means of both halves."""
    middle = first + np.maximum((last - first) // 2, 1)
    both = np.minimum(middle, last - 1)
    early, late = _means(d, first, np.maximum(both, first + 1)), _means(d, both, last)
    apart = np.maximum(stamps[last - 1] - stamps[first], 1) / SECOND / 2.0
    centre = stamps[first] + (stamps[last - 1] - stamps[first]) // 2
    return Ends(centre, _means(d, first, last), (late - early) / apart[:, None])


def _means(values: Floats, first: Places, last: Places) -> Floats:
    """Return the mean of each half-open range of rows; (range, axis)."""
    if not first.size:
        return np.empty((0, values.shape[1]))
    # Between two ranges lies what does not count; a range that ends the record has no such part.
    bounds = np.stack([first, np.minimum(last, len(values) - 1)], axis=1).ravel()
    sums = np.add.reduceat(values, bounds, axis=0)[::2]
    ends = last == len(values)
    # `reduceat` sums to the end only from the last bound on, which here is the row before it.
    short = ends & (bounds[1::2] > first)
    sums[short] += values[-1]
    return np.asarray(sums / (last - first)[:, None])
