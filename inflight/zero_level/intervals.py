"""A record in intervals of one length: what all methods of the zero level take.

Takes: times and readings, nT, of a record, with flags. Makes (`Intervals.of`): `Intervals`, the readings
without spikes, saturation and gaps, and of each interval the mean, the fluctuation and their covariance. All
methods work on the same intervals, so that their errors can be compared interval by interval.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.residual import STEP_SIGNIFICANCE, channel_noise
from inflight.time import GAP, SECOND, Int64

Bools = npt.NDArray[np.bool_]

AXES = ("x", "y", "z")


@dataclass(frozen=True, kw_only=True)
class IntervalSettings:
    """What an interval and a record must have.

    Attributes
    ----------
    fewest_intervals : int
        Of an estimate. Derived: eight give their own scatter to 25 %.
    fewest_samples : int
        Of an interval. Derived: a covariance of three components has six numbers.
    coverage : float
        An interval is kept with this part of its samples or more. Assumed.
    above_noise : float
        Fluctuations count from this many times the variance from reading to reading on. Derived: white noise
        has it once, within 20 % of chance for fifty samples.
    stuck : int
        So many equal readings at the end of the range in a row are saturation. Derived: noise would move
        them.
    returns : float
        A spike comes back: the sum of the two changes is less than this part of the smaller one. Assumed.
    sphere : float
        Readings all around an offset lie on a sphere about it when their distance varies by no more than this
        part of it. Derived: that of a Gaussian cloud about its own mean varies by 0.42 of it.
    """

    fewest_intervals: int = 8
    fewest_samples: int = 16
    coverage: float = 0.5
    above_noise: float = 2.0
    stuck: int = 3
    returns: float = 0.5
    sphere: float = 0.25


INTERVAL_SETTINGS = IntervalSettings()


@dataclass(frozen=True, kw_only=True)
class Intervals:
    """Readings in intervals of one length.

    Attributes
    ----------
    tt2000 : ndarray of int64, shape (interval, sample)
        0 where there is no sample.
    field : ndarray, shape (interval, sample, 3)
        Readings, nT, in axes in which the offset is constant, or in despun axes when only the offset along
        the spin axis is asked for; NaN where missing.
    start, end : ndarray of int64, shape (interval,)
        TT2000, half-open.
    noise : ndarray, shape (3,)
        Fluctuation from reading to reading, nT: at least the white noise; turbulence adds to it.
    white : float
        White noise per component as stated for the instrument, nT; 0 where nothing is stated.
    cadence_s : float
        Usual distance of samples.
    notes : tuple of str
        What was left out, and why.
    """

    tt2000: Int64
    field: Floats
    start: Int64
    end: Int64
    noise: Floats
    white: float
    cadence_s: float
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        tt2000: Int64,
        field: Floats,
        length_s: float,
        good: Bools | None = None,
        *,
        white: float = 0.0,
        fewest: int = INTERVAL_SETTINGS.fewest_intervals,
    ) -> Intervals:
        """Cut a record into intervals.

        Parameters
        ----------
        tt2000 : ndarray of int64, shape (time,)
            Rising.
        field : ndarray, shape (time, 3)
            nT; NaN where missing.
        length_s : float
            Length of an interval: long against the correlation of the fluctuations, short against their
            whole record; half an hour in the solar wind, minutes in a magnetosheath.
        good : ndarray of bool, shape (time,), optional
            Usable samples. Spikes, saturation and missing readings are left out in any case.
        white : float
            Known white noise per component, nT.
        fewest : int
            Fewest intervals.

        Raises
        ------
        SamplesError
            Shapes that differ, or times that do not rise.
        CalibrationError
            Too few samples or intervals.
        """
        times, values = np.asarray(tt2000, dtype=np.int64), np.asarray(field, dtype=np.float64)
        if values.shape != (times.size, 3):
            raise SamplesError(
                f"times have shape {times.shape}, the field {values.shape}",
                remedy="give (time,) and (time, 3)",
            )
        if np.any(np.diff(times) <= 0):
            raise SamplesError("times do not rise", remedy="sort them and drop duplicates")
        finite = np.isfinite(values).all(axis=1)
        allowed = np.ones(len(values), dtype=bool) if good is None else np.asarray(good, dtype=bool)
        use, notes = _clean(values, np.asarray(finite & allowed))
        times, values = times[use], values[use]
        if times.size < INTERVAL_SETTINGS.fewest_samples:
            raise CalibrationError(
                f"{times.size} usable readings found, at least {INTERVAL_SETTINGS.fewest_samples} needed",
                remedy="see the record's gaps and flags, or take a longer span",
            )
        cadence = float(np.median(np.diff(times))) / SECOND
        stamps, filled, start = _fill(times, values, length_s, cadence)
        if len(stamps) < fewest:
            raise CalibrationError(
                f"{len(stamps)} intervals of {length_s:g} s at least half full found, {fewest} needed",
                remedy="take a longer span, or shorter intervals",
            )
        noise = np.array([channel_noise(values[:, axis])[0] for axis in range(3)])
        return cls(
            tt2000=stamps,
            field=filled,
            start=start,
            end=start + round(length_s * SECOND),
            noise=noise,
            white=white,
            cadence_s=cadence,
            notes=notes,
        )

    def __len__(self) -> int:
        return len(self.start)

    def select(self, chosen: Bools | npt.NDArray[np.int64]) -> Intervals:
        """Return some of the intervals; a boolean mask (interval,) or indices."""
        parts = ("tt2000", "field", "start", "end")
        kept: dict[str, Any] = {name: getattr(self, name)[chosen] for name in parts}
        return replace(self, **kept)

    @cached_property
    def count(self) -> Floats:
        """Samples of each interval; (interval,)."""
        return np.asarray(np.isfinite(self.field[..., 0]).sum(axis=1), dtype=np.float64)

    @cached_property
    def mean(self) -> Floats:
        """Mean reading; (interval, 3), nT."""
        return np.asarray(np.nansum(self.field, axis=1) / self.count[:, None])

    @property
    def fluctuation(self) -> Floats:
        """Readings less their interval's mean, 0 where missing; (interval, sample, 3), nT."""
        return np.nan_to_num(self.field - self.mean[:, None, :])

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the components; (interval, 3, 3), nT^2."""
        delta = self.fluctuation
        return np.asarray(np.einsum("ksi,ksj->kij", delta, delta) / self.count[:, None, None])

    @cached_property
    def above_noise(self) -> Bools:
        """Whether more than noise fluctuates; (interval,)."""
        total = np.trace(self.covariance, axis1=1, axis2=2)
        noise = 3.0 * self.white**2 or np.sum(self.noise**2)
        return np.asarray(total > INTERVAL_SETTINGS.above_noise * noise)

    def encloses(self, offset: Floats, turning: bool = False) -> bool:
        """Whether an offset lies within the readings themselves: there a direction has no meaning.

        The mean of the corrected field is then, in half of the intervals, smaller than its fluctuation.

        Parameters
        ----------
        offset : ndarray, shape (3,)
            nT.
        turning : bool
            The sensor is known to turn right round: then such an offset is one where the field's size stays
            nearly the same. Of a sensor that does not, every arc of readings has such a centre.
        """
        square = np.sum((self.mean - offset) ** 2, axis=1)
        if np.median(square / np.trace(self.covariance, axis1=1, axis2=2)) >= 1.0:
            return False
        if not turning:
            return True
        size = np.linalg.norm(self.field - offset, axis=2)
        mean = np.nansum(size, axis=1) / self.count
        variance = np.nansum((size - mean[:, None]) ** 2, axis=1) / self.count
        return bool(np.median(variance / mean**2) > INTERVAL_SETTINGS.sphere**2)

    @cached_property
    def neighbours(self) -> Bools:
        """Whether sample s + 1 follows sample s without a gap; (interval, sample - 1)."""
        apart = np.diff(self.tt2000, axis=1) / SECOND
        there = np.isfinite(self.field[:, 1:, 0]) & np.isfinite(self.field[:, :-1, 0])
        return np.asarray(there & (apart < GAP * self.cadence_s))


def _clean(values: Floats, use: Bools) -> tuple[Bools, tuple[str, ...]]:
    """Return usable samples without spikes and saturation, and what was left out."""
    missing, kept = int((~use).sum()), use.copy()
    spikes = np.zeros_like(use)
    spikes[kept] = _spikes(values[kept])
    kept &= ~spikes
    stuck = np.zeros_like(use)
    stuck[kept] = _saturated(values[kept])
    kept &= ~stuck
    lost = ((missing, "missing or flagged"), (int(stuck.sum()), "saturated"), (int(spikes.sum()), "spikes"))
    return kept, tuple(f"{number} readings left out: {why}" for number, why in lost if number)


def _saturated(values: Floats) -> Bools:
    """Return readings that stand still at an end of their range, in any component."""
    if len(values) < INTERVAL_SETTINGS.stuck:
        return np.zeros(len(values), dtype=bool)
    out = np.zeros(len(values), dtype=bool)
    for column in values.T:
        at_end = (column == column.max()) | (column == column.min())
        runs = np.convolve(at_end, np.ones(INTERVAL_SETTINGS.stuck), mode="valid") == INTERVAL_SETTINGS.stuck
        if column.max() > column.min():
            out |= np.convolve(runs, np.ones(INTERVAL_SETTINGS.stuck)) > 0
    return out


def _spikes(values: Floats) -> Bools:
    """Return single readings that leave their neighbours and come back at once, in any component.

    Steps of the field do not come back. The limit is that of `inflight.residual.channel_steps`, or eight
    times the usual change between neighbours where that is larger: a turbulent field moves on its own.
    """
    out = np.zeros(len(values), dtype=bool)
    if len(values) < INTERVAL_SETTINGS.fewest_samples:
        return out
    for column in values.T:
        change = np.diff(column)
        usual = max(float(np.sqrt(2.0)) * channel_noise(column)[0], 1.4826 * float(np.median(np.abs(change))))
        ahead, behind = change[:-1], change[1:]
        least = np.minimum(np.abs(ahead), np.abs(behind))
        out[1:-1] |= (least > STEP_SIGNIFICANCE * usual) & (
            np.abs(ahead + behind) < INTERVAL_SETTINGS.returns * least
        )
    return out


def _fill(times: Int64, values: Floats, length_s: float, cadence: float) -> tuple[Int64, Floats, Int64]:
    """Return times, readings (NaN-filled) and starts of the intervals with enough samples."""
    length = round(length_s * SECOND)
    number = (times - times[0]) // length
    which, first, count = np.unique(number, return_index=True, return_counts=True)
    needed = max(INTERVAL_SETTINGS.fewest_samples, INTERVAL_SETTINGS.coverage * length_s / cadence)
    row = np.repeat(np.arange(which.size), count)
    place = np.arange(times.size) - np.repeat(first, count)
    field = np.full((which.size, int(count.max()), 3), np.nan)
    stamps = np.zeros(field.shape[:2], dtype=np.int64)
    field[row, place], stamps[row, place] = values, times
    start = times[0] + which * length
    kept = count >= needed
    return stamps[kept], field[kept], start[kept]
