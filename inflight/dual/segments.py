"""Segments of the difference between two jumps, and the drift that all of them share.

Takes readings; makes *segments*: the stretches between neighbouring change points of the difference, with
their levels, and the mean and slope at both *ends*, head and tail. A segment shorter than the minimum dwell
is a *transient*, in no state.

The drift of the difference, of the sensors' offsets or of units that warm up, is common to all segments: a
value and a slope for each axis, a random walk each, at the rates of `DriftRate`. `DriftFilter` is the Kalman
filter that follows it from segment to segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual import drift_loops
from inflight.dual.change_points import (
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


@dataclass(frozen=True, kw_only=True)
class SegmentSettings:
    """Numbers of segments and of their drift.

    Attributes
    ----------
    shortest : int
        Minimum dwell, samples: a stretch with fewer is no state but a disturbance or a transition. Assumed.
    median_square : float
        Median of a squared Gaussian of variance one. Derived: chi-square with one degree of freedom.
    median_scatter : float
        Standard deviation of the median of n squares of noise, relative, times the root of n. Derived:
        ``1 / (2 f(m) m)`` with the density f and median m of chi-square with one degree of freedom.
    drift_sigmas : float
        The median square of slopes must exceed noise by so many of its standard deviations to count as
        drift. Level of significance: two sigmas.
    fewest_groups : int
        Groups of slopes that show how fast slopes change at least. Assumed.
    slope_bound : float
        The variance of the slope never exceeds so many times the usual one. Assumed: two sigmas.
    own_drift_bound : float
        A change within a segment is its own when its square exceeds so many times the variance of its noise.
        Assumed: two sigmas.
    """

    shortest: int = 10
    median_square: float = 0.4549
    median_scatter: float = 2.3
    drift_sigmas: float = 2.0
    fewest_groups: int = 6
    slope_bound: float = 4.0
    own_drift_bound: float = 4.0


SEGMENT_SETTINGS = SegmentSettings()


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


@dataclass(frozen=True, kw_only=True)
class Segments:
    """Segments: stretches between jumps, in the order of time; d is the difference of the two sensors, nT.

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
    head, tail : Ends
        The first and the last samples, at most `end_length`; both are all of a segment shorter than twice
        that.
    covariance : ndarray, shape (segment, axis, axis)
        Of the noise of the mean at either end, nT^2.
    slope_variance : ndarray, shape (segment, axis)
        Of the noise of the slope at either end, nT^2/s^2.
    transient : ndarray of bool, shape (segment,)
        Too short to be a state.
    noise : StepNoise
        Of d, without its drift.
    end_length : int
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
    head: Ends
    tail: Ends
    covariance: Floats
    slope_variance: Floats
    transient: npt.NDArray[np.bool_]
    noise: StepNoise
    end_length: int
    spikes: Rows

    def __len__(self) -> int:
        return int(self.first.size)

    @property
    def seconds(self) -> Floats:
        """Time between the middles of both ends; (segment,), s, 0 where they are one."""
        return np.asarray((self.tail.middle - self.head.middle) / SECOND)


def segments_of(readings: Readings) -> Segments:
    """Divide readings into segments where their difference jumps.

    Neighbouring stretches below the minimum dwell become one transient segment.

    Raises
    ------
    SamplesError
        No sample has both sensors.
    """
    rows = np.flatnonzero(readings.good)
    if not rows.size:
        raise SamplesError("no sample has both sensors", remedy="take a span where both measured")
    # Copying a million rows costs more than checking whether one is missing.
    d = readings.difference if rows.size == len(readings) else readings.difference[rows]
    spikes = np.flatnonzero(find_spikes(d))
    if spikes.size:
        d = d.copy()
        d[spikes] = 0.5 * (d[spikes - 1] + d[spikes + 1])
    d = winsorise(d)
    jumps, noise = find_jumps(d)
    jumps = confirm_jumps(d, jumps)
    edges = np.concatenate([[0], jumps, [rows.size]]).astype(np.int64)
    short = np.diff(edges) < SEGMENT_SETTINGS.shortest
    kept = np.ones(edges.size, dtype=bool)
    kept[1:-1] = ~(short[:-1] & short[1:])
    edges, transient = edges[kept], short[kept[:-1]]
    level = level_noise(d, edges[1:-1], noise)
    # Where the drift is a random walk the means of longer stretches are less precise than of shorter ones.
    best = int(np.argmin(np.einsum("sii->s", level.covariance)))
    end_length = int(level.length[best] if best + 1 < level.length.size else noise.length[-1])
    count = np.diff(edges)
    width = np.where(count >= 2 * end_length, end_length, count)
    good = readings.stamps if rows.size == len(readings) else readings.stamps[rows]
    half = np.maximum(width // 2, 1)
    apart = np.maximum(good[edges[:-1] + width - 1] - good[edges[:-1]], 1) / SECOND / 2.0
    slope_noise = 2.0 * np.einsum("sii->si", level.of_mean(half)) / apart[:, None] ** 2
    last = np.append(rows[edges[1:-1]], len(readings)).astype(np.int64)
    return Segments(
        first=np.concatenate([[0], last[:-1]]).astype(np.int64),
        last=last,
        start=good[edges[:-1]],
        end=good[edges[1:] - 1],
        count=count,
        level=_means(d, edges[:-1], edges[1:]),
        head=_ends(d, good, edges[:-1], edges[:-1] + width),
        tail=_ends(d, good, edges[1:] - width, edges[1:]),
        covariance=level.of_mean(width),
        slope_variance=np.where(width[:, None] > 1, slope_noise, np.inf),
        transient=transient,
        noise=level,
        end_length=end_length,
        spikes=rows[spikes],
    )


def _ends(d: Floats, stamps: Int64, first: Rows, last: Rows) -> Ends:
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
    # `reduceat` alternates between ranges and the rows between them; at the record's end there are none.
    bounds = np.stack([first, np.minimum(last, len(values) - 1)], axis=1).ravel()
    sums = np.add.reduceat(values, bounds, axis=0)[::2]
    ends = last == len(values)
    # `reduceat` sums to the end only from the last bound on, which here is the row before it.
    short = ends & (bounds[1::2] > first)
    sums[short] += values[-1]
    return np.asarray(sums / (last - first)[:, None])


class DriftRate(NamedTuple):
    """How fast the difference drifts; each of shape (axis,).

    Attributes
    ----------
    slope : ndarray
        Variance of the slope, nT^2/s^2.
    slope_walk : ndarray
        Rate of variance by which the slope changes, a random walk, nT^2/s^3.
    level_walk : ndarray
        Rate of variance by which the drift itself walks in addition, nT^2/s.
    """

    slope: Floats
    slope_walk: Floats
    level_walk: Floats


@dataclass
class DriftFilter:
    """Kalman filter of the common drift: its value and its slope, each axis for itself.

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

    @property
    def spread(self) -> Floats:
        """Covariance of the value; (axis, axis)."""
        return np.diag(self.covariance[:, 0, 0])

    @property
    def arrays(self) -> drift_loops.Drift:
        """The same for compiled loops, which change it in place."""
        most = SEGMENT_SETTINGS.slope_bound * self.rate.slope
        return drift_loops.Drift(
            self.value, self.slope, self.covariance, most, self.rate.slope_walk, self.rate.level_walk
        )

    def predict(self, seconds: float) -> None:
        """Advance the time without an observation."""
        drift_loops.predict(self.arrays, seconds)

    def observe_slope(self, slope: Floats, variance: Floats) -> None:
        """Update with the slope within a segment, which does not need its state."""
        drift_loops.observe_slope(self.arrays, slope, variance)

    def observe_value(self, innovation: Floats, variance: Floats) -> None:
        """Update with a segment in a known state: its residual, and the residual's variance; (axis,) each."""
        drift_loops.observe(self.arrays, 0, innovation, np.array(variance))

    def cross_segment(self, segments: Segments, one: int) -> None:
        """Go from a segment's beginning to its end, between which the drift itself is observed."""
        drift_loops.cross_segment(
            self.arrays,
            float(segments.seconds[one]),
            segments.tail.mean[one] - segments.head.mean[one],
            2.0 * np.diag(segments.covariance[one]),
            segments.tail.slope[one],
            segments.slope_variance[one],
        )


def drift_rate(segments: Segments) -> DriftRate:
    """Return how fast the segments drift; zero where they do so by no more than noise."""
    zero = np.zeros(3)
    # A stretch that is too short for a slope has an infinite variance.
    sloped = ~segments.transient & np.isfinite(segments.slope_variance).all(axis=1)
    steady = np.flatnonzero(sloped)
    if steady.size < 3:
        return DriftRate(zero, zero, zero)
    noise, slope = segments.slope_variance[steady], segments.head.slope[steady]
    usual, slope_walk = _slope_rates(slope, noise, segments.head.middle[steady] / SECOND)
    long = np.flatnonzero(~segments.transient & (segments.seconds > 0))
    if not long.size:
        return DriftRate(usual, slope_walk, zero)
    span = segments.seconds[long]
    mean = 0.5 * (segments.head.slope[long] + segments.tail.slope[long])
    change = segments.tail.mean[long] - segments.head.mean[long]
    error = 2.0 * np.einsum("sii->si", segments.covariance[long])
    error += 0.5 * span[:, None] ** 2 * segments.slope_variance[long]
    level_walk = _excess_variance(change - mean * span[:, None], error, span)
    return DriftRate(usual, slope_walk, level_walk)


def _slope_rates(slope: Floats, noise: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Return the variance of slopes, and that a second by which they change; (axis,) each.

    The largest over groups of any size: one slope is often lost in its noise where the mean of many is not.
    The slope walks at least as fast as reverses a usual one in the whole record.
    """
    usual, walk = np.zeros(3), np.zeros(3)
    size = 1
    while len(slope) // size >= SEGMENT_SETTINGS.fewest_groups:
        edges = np.arange(0, len(slope) - size + 1, size)
        weight = 1.0 / np.maximum(noise, 1e-300)
        error = 1.0 / np.add.reduceat(weight, edges, axis=0)
        mean = np.add.reduceat(slope * weight, edges, axis=0) * error
        middle = np.add.reduceat(at, edges) / np.diff(np.append(edges, len(slope)))
        seconds = np.maximum(np.diff(middle), 1e-9)
        usual = np.maximum(usual, _excess_variance(mean, error, np.ones(edges.size)))
        change = _excess_variance(np.diff(mean, axis=0), error[1:] + error[:-1], seconds)
        walk = np.maximum(walk, change)
        size *= 2
    least = usual / max(float(at[-1] - at[0]) if at.size else 0.0, 1e-9)
    return usual, np.asarray(np.where(usual > 0, np.maximum(walk, least), 0.0))


def _excess_variance(values: Floats, noise: Floats, unit: Floats) -> Floats:
    """Return the variance of values (row, axis) a unit (row,) beyond their noise; (axis,), 0 if no more."""
    ratio = values**2 / noise
    median = np.median(ratio, axis=0) / SEGMENT_SETTINGS.median_square
    significant = median - 1.0 > SEGMENT_SETTINGS.drift_sigmas * SEGMENT_SETTINGS.median_scatter / np.sqrt(
        len(values)
    )
    size = np.median((values**2 / SEGMENT_SETTINGS.median_square - noise) / unit[:, None], axis=0)
    return np.asarray(np.where(significant, np.maximum(size, 0.0), 0.0))


def segment_drift_covariance(segments: Segments, rate: DriftRate) -> Floats:
    """Return covariances (segment, axis, axis), nT^2, that allow for a state's own drift within a segment.

    Where all segments drift alike the common drift takes the change; where only this one does, its unit
    warms up, and the next time the level is another.
    """
    seconds = ((segments.end - segments.start) / SECOND)[:, None]
    by_slope = ~(segments.seconds > 0)[:, None]
    whole = np.where(by_slope, segments.head.slope * seconds, segments.tail.mean - segments.head.mean)
    slope_noise = np.where(seconds > 0, segments.slope_variance, 0.0) * seconds**2
    noise = np.where(by_slope, slope_noise, 2.0 * np.einsum("sii->si", segments.covariance))
    allowed = SEGMENT_SETTINGS.own_drift_bound * noise + seconds * rate.level_walk + seconds**2 * rate.slope
    variance = np.where((seconds > 0) & (whole**2 > allowed), whole**2, 0.0)
    return np.asarray(variance[:, :, None] * np.eye(3))
