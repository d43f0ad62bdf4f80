"""Steps and levels of a housekeeping channel, found from its readings alone.

Takes times and readings; makes their noise and smallest step (`channel_noise`), the readings without spikes
(`clean_readings`), the fast changes of a current (`find_steps`), and the readings without noise between
switchings (`piecewise_mean`).

A current that a switch or a regulator changes within seconds separates its stray field from everything
that follows the orbit (Yin 2010, section 3.4.1). A *step* is a run of readings that change faster
than their surroundings, by far more than the channel's own noise and quantisation, between two
levels that are straight lines before and after. A kink, where only the slope changes, is no step.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.errors import SamplesError
from inflight.lsq import MAD_TO_SIGMA, robust_sigma
from inflight.time import SECOND, Int64

if TYPE_CHECKING:
    import xarray as xr

#: Changes between neighbours, and sizes, count from this many sigma on: with 86 400 readings a day
#: and Gaussian noise one false alarm in 10^10 days.
STEP_SIGNIFICANCE = 8.0


@dataclass(frozen=True, kw_only=True)
class StepSettings:
    """How steps and levels of a channel are found.

    Attributes
    ----------
    fewest : int
        Fewest readings of a level. Derived: a line needs two, its scatter a third.
    settled, rest : float
        A transition ends where the reading is within this many sigma of the level, or this part of the size.
        Assumed.
    scale_s : float
        Changes are looked for over this many seconds, so that a fast channel is no noisier than a slow one.
        Assumed.
    rounds : int
        Rounds in which ends of the transition and levels are fitted in turn.
    jump : float
        A change from one reading to the next is a switching beyond so many of its usual sizes. Assumed.
    steady : float
        Readings between switchings have one level when they scatter no more than so many times their white
        noise. Assumed.
    fewest_steady : int
        Fewest readings of such a level. Assumed.
    """

    fewest: int = 3
    settled: float = 3.0
    rest: float = 0.02
    scale_s: float = 10.0
    rounds: int = 6
    jump: float = 8.0
    steady: float = 1.5
    fewest_steady: int = 4


STEP_SETTINGS = StepSettings()


def channel_noise(values: Floats, resolution: float | None = None) -> tuple[float, float]:
    """Return white noise and smallest step of readings, in their unit.

    The noise is that of second differences, which a drift does not reach, by the median of their
    sizes; rounding to a step q leaves at least ``q / sqrt(12)``.

    Parameters
    ----------
    values : ndarray, shape (reading,)
        Finite.
    resolution : float, optional
        The smallest step where it is known. Else it is the smallest change seen, unless that is more
        than a third of the range: two or three levels are those of a switch, not of a converter.
    """
    span = float(np.ptp(values)) if values.size else 0.0
    if resolution is None:
        sizes = np.abs(np.diff(values))
        # Decimal readings differ by rounding errors of their binary form too: those are no steps.
        least = float(
            sizes[sizes > 1e-9 * max(float(np.abs(values).max(initial=0.0)), 1e-30)].min(initial=span)
        )
        resolution = least if least < span / 3.0 else 0.0
    spread = (
        MAD_TO_SIGMA * float(np.median(np.abs(np.diff(values, 2)))) / np.sqrt(6.0) if values.size > 2 else 0.0
    )
    # A switch without noise still has the rounding of its binary form.
    return max(spread, resolution / np.sqrt(12.0), 1e-9 * span), resolution


def clean_readings(stamps: Int64, current: Floats, resolution: float | None = None) -> tuple[Int64, Floats]:
    """Return times and values of the finite readings that are no spikes.

    Parameters
    ----------
    stamps : ndarray of int64, shape (reading,)
        TT2000, rising.
    current : ndarray, shape (reading,)
    resolution : float, optional
        As for `channel_noise`.

    Raises
    ------
    SamplesError
        Shapes that differ, times that do not rise, or too few readings.
    """
    times, values = np.asarray(stamps, dtype=np.int64), np.asarray(current, dtype=np.float64)
    if times.shape != values.shape or times.ndim != 1:
        raise SamplesError(
            f"times have shape {times.shape}, the current {values.shape}", remedy="give one current a call"
        )
    good = np.isfinite(values)
    times, values = times[good], values[good]
    if times.size < 2 * STEP_SETTINGS.fewest + 2:
        raise SamplesError(
            f"{times.size} readings of the current found, at least {2 * STEP_SETTINGS.fewest + 2} needed",
            remedy="take a longer span",
        )
    if np.any(np.diff(times) <= 0):
        raise SamplesError("times of the current do not rise", remedy="sort them and drop duplicates")
    # Single readings that leave their neighbours' level and come back to it are dropped.
    limit = STEP_SIGNIFICANCE * np.sqrt(2.0) * channel_noise(values, resolution)[0]
    ahead, behind = np.diff(values)[:-1], np.diff(values)[1:]
    out_and_back = np.minimum(np.abs(ahead), np.abs(behind))
    kept = np.ones(values.size, dtype=bool)
    kept[1:-1] = (out_and_back <= limit) | (np.abs(ahead + behind) >= 0.5 * out_and_back)
    return times[kept], values[kept]


@dataclass(frozen=True, kw_only=True)
class CurrentSteps:
    """Steps of one channel in order of time; arrays of shape (step,).

    Attributes
    ----------
    time : ndarray of int64
        TT2000 at which half of the change was passed.
    start, end : ndarray of int64
        TT2000 of the last reading on the old level and of the first on the new.
    before, after : ndarray
        Levels, extrapolated to `time`, in the channel's unit.
    sigma : ndarray
        Standard deviation of ``after - before``.
    noise, resolution : float
        White noise of a reading and its smallest step, channel's unit.
    cadence : float
        Usual seconds between readings.
    unit : str
    """

    time: Int64
    start: Int64
    end: Int64
    before: Floats
    after: Floats
    sigma: Floats
    noise: float
    resolution: float
    cadence: float
    unit: str = "A"

    @classmethod
    def of_rows(
        cls, times: Int64, levels: Floats, channel: tuple[float, float, float], unit: str
    ) -> CurrentSteps:
        """Return steps from rows of (time, start, end) and (before, after, sigma), both (step, 3).

        `channel` is its noise, resolution and cadence.
        """
        time, start, end = times.T
        before, after, sigma = levels.T
        noise, resolution, cadence = channel
        return cls(
            time=time,
            start=start,
            end=end,
            before=before,
            after=after,
            sigma=sigma,
            noise=noise,
            resolution=resolution,
            cadence=cadence,
            unit=unit,
        )

    @property
    def size(self) -> Floats:
        """Change of the current, negative for a drop."""
        return self.after - self.before

    @property
    def direction(self) -> npt.NDArray[np.int64]:
        """-1 for a drop, 1 for a rise."""
        return np.sign(self.size).astype(np.int64)

    @property
    def duration(self) -> Floats:
        """Seconds from the last reading on the old level to the first on the new."""
        return (self.end - self.start) / SECOND

    def __len__(self) -> int:
        return int(self.time.size)

    def where(self, chosen: npt.NDArray[np.bool_]) -> CurrentSteps:
        """Return some of the steps; `chosen` has shape (step,)."""
        kept = {
            one.name: getattr(self, one.name)[chosen]
            if isinstance(getattr(self, one.name), np.ndarray)
            else getattr(self, one.name)
            for one in fields(self)
        }
        return CurrentSteps(**kept)

    def table(self) -> xr.Dataset:
        """Return the steps with `value` (the change) and `sigma` along ``step``."""
        import xarray as xr

        times = {
            name: ("step", getattr(self, name), {"scale": "TT2000"}) for name in ("time", "start", "end")
        }
        numbers = {
            name: ("step", getattr(self, name), {"units": self.unit}) for name in ("before", "after", "sigma")
        }
        return xr.Dataset(
            times
            | numbers
            | {
                "value": ("step", self.size, {"units": self.unit}),
                "duration": ("step", self.duration, {"units": "s"}),
                "direction": ("step", self.direction),
            },
            attrs={"noise": self.noise, "resolution": self.resolution, "cadence_s": self.cadence},
        )


def find_steps(
    stamps: Int64,
    current: Floats,
    *,
    unit: str = "A",
    longest: float = 60.0,
    window: float = 60.0,
    significance: float = STEP_SIGNIFICANCE,
    smallest: float = 0.0,
    resolution: float | None = None,
) -> CurrentSteps:
    """Find the fast drops and rises of a current.

    Parameters
    ----------
    stamps : ndarray of int64, shape (reading,)
        TT2000, rising; any cadence, gaps allowed.
    current : ndarray, shape (reading,)
        NaN where it is missing.
    unit : str
        Of the current.
    longest : float
        Slower changes are no steps, s; also the longest gap a step may lie in.
    window : float
        The levels are lines through the readings of this many seconds before and after.
    significance : float
        Least size of a change and of a step in standard deviations.
    smallest : float
        Least size of a step in the current's unit.
    resolution : float, optional
        Smallest step of the delivered numbers; from the readings when absent.

    Returns
    -------
    CurrentSteps
        None at all for a current that never changes.

    Raises
    ------
    SamplesError
        Shapes that differ, times that do not rise, or too few readings.
    """
    times, values = clean_readings(stamps, current, resolution)
    seconds = (times - times[0]) / SECOND
    cadence = float(np.median(np.diff(seconds)))
    noise, smallest_step = channel_noise(values, resolution)
    lag = min(max(1, round(STEP_SETTINGS.scale_s / cadence)), values.size // 4)
    change, apart = _own_change(seconds, values, lag, longest)
    # Two readings differ by the noise of both; noise that is not white shows in the changes themselves.
    usual = robust_sigma(change, floor=float(np.sqrt(2.0)) * noise)
    near = scipy.ndimage.maximum_filter1d(np.abs(change), 2 * int(np.ceil(longest / cadence)) + 1)
    fast = (np.abs(change) > np.maximum(significance * usual, STEP_SETTINGS.rest * near)) & (apart <= longest)
    runs = _runs(change, fast, lag)
    channel = _Readings(seconds, values, noise, longest, window)
    # A run's own readings: from the end of the run before it to the start of the next.
    low = [0, *(last for _, last in runs)]
    high = [*(first + 1 for first, _ in runs[1:]), seconds.size]
    fitted = [
        _fit_step(channel, own, run) for own, run in zip(zip(low, high, strict=False), runs, strict=False)
    ]
    kept = [
        one
        for one in fitted
        if one is not None and abs(one.after - one.before) >= max(significance * one.sigma, smallest)
    ]
    ticks = [[round(t * SECOND) for t in (one.middle, one.first, one.last)] for one in kept]
    when = times[0] + np.array(ticks, dtype=np.int64).reshape(-1, 3)
    levels = np.array([[one.before, one.after, one.sigma] for one in kept]).reshape(-1, 3)
    return CurrentSteps.of_rows(when, levels, (noise, smallest_step, cadence), unit)


def _own_change(seconds: Floats, values: Floats, lag: int, longest: float) -> tuple[Floats, Floats]:
    """Return changes over `lag` readings less what the slope makes, and their seconds; (reading - lag,).

    The slope is a running median over more than twice the longest transition: it follows a kink at
    once and a step not at all.
    """
    apart = seconds[lag:] - seconds[:-lag]
    change = values[lag:] - values[:-lag]
    size = 2 * int(np.ceil(longest / float(np.median(np.diff(seconds))))) + 2 * lag - 1
    slope = scipy.ndimage.median_filter(change / apart, min(size, change.size), mode="nearest")
    return change - slope * apart, apart


def _runs(change: Floats, fast: npt.NDArray[np.bool_], lag: int) -> list[tuple[int, int]]:
    """Return first and last reading of runs of fast changes of one sign; one slow change may be inside.

    A sudden step is seen in `lag` changes: the run is that much shorter.
    """
    spans: list[tuple[int, int]] = []
    for index in np.flatnonzero(fast):
        near = spans and index - spans[-1][1] <= 2 and change[index] * change[spans[-1][1]] > 0
        if near:
            spans[-1] = (spans[-1][0], int(index))
        else:
            spans.append((int(index), int(index)))
    runs = []
    for first, last in spans:
        low, high = first + lag - 1, last + 1
        middle = (low + high) // 2
        runs.append((low, high) if low < high else (middle, middle + 1))
    return runs


@dataclass(frozen=True, kw_only=True)
class _Step:
    first: float
    middle: float
    last: float
    before: float
    after: float
    sigma: float


@dataclass(frozen=True)
class _Readings:
    """The readings of a channel (s, its unit), their noise, and limits of a step (s)."""

    seconds: Floats
    values: Floats
    noise: float
    longest: float
    window: float


def _fit_step(channel: _Readings, allowed: tuple[int, int], run: tuple[int, int]) -> _Step | None:
    """Fit lines before and after a run of fast changes; None for no step."""
    found = _lines_around(channel, allowed, run)
    if found is None:
        return None
    (first, last), middle, old, new = found
    sigma = float(np.hypot(old.sigma, new.sigma))
    start, end = float(channel.seconds[first]), float(channel.seconds[last])
    # Lines that meet inside the transition are a kink.
    if (
        abs(new.level - old.level)
        <= abs(new.slope - old.slope) * 0.5 * (end - start) + STEP_SIGNIFICANCE * sigma
    ):
        return None
    half = _half_passed(channel.seconds, channel.values, (first, last), 0.5 * (old.level + new.level))
    before, after = (line.level + line.slope * (half - middle) for line in (old, new))
    return _Step(first=start, middle=half, last=end, before=before, after=after, sigma=sigma)


def _lines_around(
    channel: _Readings, allowed: tuple[int, int], run: tuple[int, int]
) -> tuple[tuple[int, int], float, _Line, _Line] | None:
    """Return transition, its middle and both lines, the transition widened until both hold."""
    seconds, values = channel.seconds, channel.values
    span, found = run, None
    for _ in range(STEP_SETTINGS.rounds):
        middle = float(0.5 * (seconds[span[0]] + seconds[span[1]]))
        before, after = _sides(seconds, allowed, span, channel.window)
        old = _Line.through(seconds[before] - middle, values[before], channel.noise)
        new = _Line.through(seconds[after] - middle, values[after], channel.noise)
        if old is None or new is None or seconds[span[1]] - seconds[span[0]] > channel.longest:
            return None
        found = span, middle, old, new
        # A line is itself known to its own sigma only.
        spread = float(np.sqrt(channel.noise**2 + max(old.sigma, new.sigma) ** 2))
        rest = max(STEP_SETTINGS.settled * spread, STEP_SETTINGS.rest * abs(new.level - old.level))
        wider = _widened(seconds - middle, values, allowed, run, (old, new), rest)
        if wider == span:
            break
        span = wider
    return found


def _sides(
    seconds: Floats, allowed: tuple[int, int], run: tuple[int, int], window: float
) -> tuple[slice, slice]:
    """Return the readings of both lines: half a transition away from it, where its tail has died out."""
    guard = 0.5 * (seconds[run[1]] - seconds[run[0]])
    old, new = seconds[run[0]] - guard, seconds[run[1]] + guard
    edges = np.searchsorted(seconds, [old - window, new])
    stops = np.searchsorted(seconds, [old, new + window], side="right")
    return (
        slice(max(allowed[0], int(edges[0])), int(stops[0])),
        slice(int(edges[1]), min(allowed[1], int(stops[1]))),
    )


@dataclass(frozen=True)
class _Line:
    """A level with a slope: `level` at time 0 and its standard deviation."""

    level: float
    slope: float
    sigma: float

    @classmethod
    def through(cls, seconds: Floats, values: Floats, noise: float) -> _Line | None:
        if seconds.size < STEP_SETTINGS.fewest:
            return None
        shapes = np.column_stack([np.ones_like(seconds), seconds])
        inverse = np.linalg.inv(shapes.T @ shapes)
        fit = inverse @ (shapes.T @ values)
        scatter = float(np.sum((values - shapes @ fit) ** 2)) / max(seconds.size - 2, 1)
        return cls(float(fit[0]), float(fit[1]), float(np.sqrt(max(scatter, noise**2) * inverse[0, 0])))


def _widened(
    seconds: Floats,
    values: Floats,
    allowed: tuple[int, int],
    run: tuple[int, int],
    lines: tuple[_Line, _Line],
    rest: float,
) -> tuple[int, int]:
    """Return the run from the last reading on the old line to the first on the new one."""
    off = [np.abs(values - line.level - line.slope * seconds) > rest for line in lines]
    first, last = run
    while first > allowed[0] and off[0][first]:
        first -= 1
    while last < allowed[1] - 1 and off[1][last]:
        last += 1
    return first, last


def _half_passed(seconds: Floats, values: Floats, run: tuple[int, int], level: float) -> float:
    """Return when the readings pass a level, between the two readings around it."""
    part = slice(run[0], run[1] + 1)
    above = values[part] > level
    change = np.flatnonzero(above[1:] != above[:-1])
    if not change.size:
        return float(0.5 * (seconds[run[0]] + seconds[run[1]]))
    low = run[0] + int(change[0])
    share = (level - values[low]) / (values[low + 1] - values[low])
    return float(seconds[low] + share * (seconds[low + 1] - seconds[low]))


def piecewise_mean(values: Floats) -> Floats:
    """Return readings with their mean between switchings in the place of each, where that is a level.

    A field of many nanotesla that is taken off by a noisy current is taken off with its noise, and the
    regression that finds its size is diluted. What drifts between its switchings, a temperature, stays.

    Parameters
    ----------
    values : ndarray, shape (time,)
        Readings in order of time, any unit; NaN where one is missing.
    """
    known = np.isfinite(values)
    readings = values[known]
    change = np.diff(readings)
    white = MAD_TO_SIGMA * float(np.median(np.abs(change))) / np.sqrt(2.0) if readings.size > 1 else 0.0
    if not white > 0.0:
        return values
    begins = np.concatenate(
        [[0], np.flatnonzero(np.abs(change) > STEP_SETTINGS.jump * np.sqrt(2.0) * white) + 1]
    )
    count = np.diff(np.append(begins, readings.size))
    mean = np.add.reduceat(readings, begins) / count
    scatter = np.sqrt(np.add.reduceat((readings - np.repeat(mean, count)) ** 2, begins) / count)
    level = np.repeat(
        (scatter <= STEP_SETTINGS.steady * white) & (count >= STEP_SETTINGS.fewest_steady), count
    )
    out = values.copy()
    out[known] = np.where(level, np.repeat(mean, count), readings)
    return out
