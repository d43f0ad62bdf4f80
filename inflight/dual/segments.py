"""Stationary segments, common drift.

Stretches of the difference between two jumps: their levels, and what drifts within them.

The drift of the difference that all states share: how fast it goes, and where it stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.change_points import (
    FALSE_ALARMS,
    LONGEST,
    Rows,
    StepNoise,
    confirm_jumps,
    find_jumps,
    find_spikes,
    level_noise,
    winsorise,
)
from inflight.dual.readings import Readings
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

    first: Rows
    last: Rows
    start: Int64
    end: Int64
    count: Rows
    level: Floats
    begin: Ends
    finish: Ends
    covariance: Floats
    slope_variance: Floats
    transient: npt.NDArray[np.bool_]
    noise: StepNoise
    window: int
    find_spikes: Rows

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
    jumps: Rows | None = None,
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
    lone = np.flatnonzero(find_spikes(d))
    if lone.size:
        d = d.copy()
        d[lone] = 0.5 * (d[lone - 1] + d[lone + 1])
    d = winsorise(d)
    places, noise = find_jumps(d, false_alarms=false_alarms, longest=longest)
    places = confirm_jumps(d, places)
    if jumps is not None:
        places = np.unique(np.searchsorted(rows, jumps))
    edges = np.concatenate([[0], places[(places > 0) & (places < rows.size)], [rows.size]]).astype(np.int64)
    edges, transient = _without_short(edges, shortest)
    level = level_noise(d, edges[1:-1], noise)
    # Where the drift is a random walk longer stretches are less sure than shorter ones.
    best = int(np.argmin(np.einsum("sii->s", level.covariance)))
    window = int(level.length[best] if best + 1 < level.length.size else noise.length[-1])
    return _measured(readings, rows, d, edges, transient, (level, window), rows[lone])


def _without_short(edges: Rows, shortest: int) -> tuple[Rows, npt.NDArray[np.bool_]]:
    """Return edges with neighbouring short stretches joined, and which stretches are short."""
    short = np.diff(edges) < shortest
    kept = np.ones(edges.size, dtype=bool)
    kept[1:-1] = ~(short[:-1] & short[1:])
    return edges[kept], short[kept[:-1]]


def _measured(
    readings: Readings,
    rows: Rows,
    d: Floats,
    edges: Rows,
    transient: npt.NDArray[np.bool_],
    measured: tuple[StepNoise, int],
    lone: Rows,
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


def _end(d: Floats, stamps: Int64, first: Rows, last: Rows) -> Ends:
    """Return mean and slope of ranges of rows; the slope by the means of both halves."""
    middle = first + np.maximum((last - first) // 2, 1)
    both = np.minimum(middle, last - 1)
    early, late = _means(d, first, np.maximum(both, first + 1)), _means(d, both, last)
    apart = np.maximum(stamps[last - 1] - stamps[first], 1) / SECOND / 2.0
    centre = stamps[first] + (stamps[last - 1] - stamps[first]) // 2
    return Ends(centre, _means(d, first, last), (late - early) / apart[:, None])


def _means(values: Floats, first: Rows, last: Rows) -> Floats:
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


#: Median of a squared Gaussian of variance one.
_MEDIAN_SQUARE = 0.4549

#: The fewest groups of slopes that tell how fast they change.
_GROUPS = 6


@dataclass
class DriftFilter:
    """The common drift as it is carried along: its value and its slope, each axis for itself.

    Attributes
    ----------
    value, slope : ndarray, shape (axis,)
        nT, nT/s.
    covariance : ndarray, shape (axis, 2, 2)
        Of value and slope.
    rate : DriftRate
    """

    value: Floats
    slope: Floats
    covariance: Floats
    rate: DriftRate

    @classmethod
    def start(cls, rate: DriftRate) -> DriftFilter:
        """Return a drift of zero whose slope is not known."""
        covariance = np.zeros((3, 2, 2))
        covariance[:, 1, 1] = rate.slope
        return cls(np.zeros(3), np.zeros(3), covariance, rate)

    def forward(self, seconds: float) -> None:
        """Let time pass in which nothing is seen."""
        self.value = self.value + seconds * self.slope
        move = np.array([[1.0, seconds], [0.0, 1.0]])
        self.covariance = move @ self.covariance @ move.T
        walk = self.rate.bend * seconds
        self.covariance[:, 0, 0] += self.rate.value * seconds + walk * seconds**2 / 3.0
        self.covariance[:, 0, 1] += walk * seconds / 2.0
        self.covariance[:, 1, 0] += walk * seconds / 2.0
        # The slope stays what slopes usually are, however long nobody looks.
        free = self.covariance[:, 1, 1] + walk
        known = np.minimum(free, 4.0 * self.rate.slope)
        # Value and slope stay as much alike: else the covariance would be none, and the drift run away.
        alike = np.sqrt(np.where(free > 0, known / np.where(free > 0, free, 1.0), 1.0))
        self.covariance[:, 1, 1] = known
        self.covariance[:, 0, 1] *= alike
        self.covariance[:, 1, 0] *= alike

    def sloping(self, slope: Floats, variance: Floats) -> None:
        """Take the slope within a segment into account, which does not need its state."""
        total = self.covariance[:, 1, 1] + variance
        gain = np.where(total > 0, self.covariance[:, :, 1].T / np.where(total > 0, total, 1.0), 0.0).T
        left = slope - self.slope
        self.value, self.slope = self.value + gain[:, 0] * left, self.slope + gain[:, 1] * left
        self.covariance = self.covariance - gain[:, :, None] * self.covariance[:, None, 1, :]

    def through(self, segments: Segments, one: int) -> None:
        """Go from a segment's beginning to its end, between which the drift itself is seen."""
        seconds = float(segments.seconds[one])
        if not seconds > 0:
            return
        known = self.covariance[:, 0, 0].copy()
        value = self.value
        self.forward(seconds)
        expected = np.maximum(self.covariance[:, 0, 0] - known, 0.0)
        noise = 2.0 * np.diag(segments.covariance[one])
        gain = expected / np.maximum(expected + noise, 1e-300)
        change = segments.finish.mean[one] - segments.begin.mean[one]
        self.value = self.value + gain * (change - (self.value - value))
        self.covariance[:, 0, 0] = known + gain * noise
        self.covariance[:, 0, 1] = self.covariance[:, 1, 0] = 0.0
        self.sloping(segments.finish.slope[one], segments.slope_variance[one])

    def seen(self, left: Floats, variance: Floats) -> None:
        """Take a segment in a known state into account: what is left of it, and the variance; (axis,)."""
        gain = self.covariance[:, :, 0] / variance[:, None]
        self.value, self.slope = self.value + gain[:, 0] * left, self.slope + gain[:, 1] * left
        self.covariance = self.covariance - gain[:, :, None] * self.covariance[:, None, 0, :]

    @property
    def spread(self) -> Floats:
        """Covariance of the value; (axis, axis)."""
        return np.diag(self.covariance[:, 0, 0])


class DriftRate(NamedTuple):
    """How fast the difference drifts; each of shape (axis,).

    Attributes
    ----------
    slope : ndarray
        Variance of the slope, nT^2/s^2.
    bend : ndarray
        Variance by which the slope changes, nT^2/s^3.
    value : ndarray
        Variance by which the drift itself wanders beside that, nT^2/s.
    """

    slope: Floats
    bend: Floats
    value: Floats


def drift_rate(segments: Segments) -> DriftRate:
    """Return how fast the segments drift; zero where they do so by no more than noise."""
    zero = np.zeros(3)
    # A stretch that is too short for a slope has an infinite variance.
    told = ~segments.transient & np.isfinite(segments.slope_variance).all(axis=1)
    steady = np.flatnonzero(told)
    if steady.size < 3:
        return DriftRate(zero, zero, zero)
    noise, slope = segments.slope_variance[steady], segments.begin.slope[steady]
    usual, bend = _sloping(slope, noise, segments.begin.middle[steady] / SECOND)
    long = np.flatnonzero(~segments.transient & (segments.seconds > 0))
    if not long.size:
        return DriftRate(usual, bend, zero)
    span = segments.seconds[long]
    mean = 0.5 * (segments.begin.slope[long] + segments.finish.slope[long])
    change = segments.finish.mean[long] - segments.begin.mean[long]
    error = 2.0 * np.einsum("sii->si", segments.covariance[long])
    error += 0.5 * span[:, None] ** 2 * segments.slope_variance[long]
    wander = _beyond(change - mean * span[:, None], error, span)
    return DriftRate(usual, bend, wander)


def _sloping(slope: Floats, noise: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return the variance of slopes, and that a second by which they change; (axis,) each.

    The largest that groups of any size show: one slope is often lost in its noise where the mean of many is
    not. Slopes are not taken to change less than turns a usual one round in the whole record.
    """
    usual, bend = np.zeros(3), np.zeros(3)
    size = 1
    while len(slope) // size >= _GROUPS:
        edges = np.arange(0, len(slope) - size + 1, size)
        weight = 1.0 / np.maximum(noise, 1e-300)
        error = 1.0 / np.add.reduceat(weight, edges, axis=0)
        mean = np.add.reduceat(slope * weight, edges, axis=0) * error
        middle = np.add.reduceat(at, edges) / np.diff(np.append(edges, len(slope)))
        seconds = np.maximum(np.diff(middle), 1e-9)
        usual = np.maximum(usual, _beyond(mean, error, np.ones(edges.size)))
        bend = np.maximum(bend, _beyond(np.diff(mean, axis=0), error[1:] + error[:-1], seconds))
        size *= 2
    least = usual / max(float(at[-1] - at[0]) if at.size else 0.0, 1e-9)
    return usual, np.asarray(np.where(usual > 0, np.maximum(bend, least), 0.0))


def _beyond(values: Floats, noise: Floats, unit: Floats) -> Floats:
    """Return the variance of values (row, axis) a unit (row,) beyond their noise; (axis,), 0 if no more."""
    ratio = values**2 / noise
    middle = np.median(ratio, axis=0) / _MEDIAN_SQUARE
    # The median of n squares of noise alone scatters by 2.3 / sqrt(n).
    over = middle - 1.0 > 2.0 * 2.3 / np.sqrt(len(values))
    size = np.median((values**2 / _MEDIAN_SQUARE - noise) / unit[:, None], axis=0)
    return np.asarray(np.where(over, np.maximum(size, 0.0), 0.0))


def own_drift(segments: Segments, one: int, rate: DriftRate) -> Floats:
    """Return the covariance (axis, axis) that allows a state's own drift: what changed within the segment.

    Where all segments drift alike the common drift takes the change; where only this one does, its unit
    warms up, and the next time the level is another.
    """
    seconds = float(segments.end[one] - segments.start[one]) / SECOND
    if not seconds > 0:
        return np.zeros((3, 3))
    whole = segments.finish.mean[one] - segments.begin.mean[one]
    noise = 2.0 * np.diag(segments.covariance[one])
    if not segments.seconds[one] > 0:
        whole = segments.begin.slope[one] * seconds
        noise = np.where(seconds > 0, segments.slope_variance[one], 0.0) * seconds**2
    allowed = 4.0 * noise + seconds * rate.value + seconds**2 * rate.slope
    return np.diag(np.where(whole**2 > allowed, whole**2, 0.0))
