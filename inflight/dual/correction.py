"""The correction: what is taken off the outboard sensor, its error, and which part of it is applied.

Takes a field with its covariance from one of the methods (states, gradiometer, both); makes the corrected
field, and, where only a part is applied, the correction of that part.

Sensors drift, and ambient field that leaks into the difference is largest on long times: a correction is
often reliable on short times only. An `AppliedPart` is a share of what changes within some time; what changes
more slowly stays in the field. The slow part is that of a whole window of days, kept in the window's table
(variables `left_alone`, `left_time`, `part_middle`, `part_constant`), so that the field does not step between
days.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.readings import Readings

#: Numbers of samples that are in no known state.
UNKNOWN, TRANSIENT = -1, -2


@dataclass(frozen=True, kw_only=True)
class SlowPartSettings:
    """Numbers of the slow part of a correction.

    Attributes
    ----------
    stored_per_width : int
        Values of the slow part that are stored in one width of its means. Assumed: linear between them the
        slow part has an error far below its size.
    """

    stored_per_width: int = 16


SLOW_PART_SETTINGS = SlowPartSettings()

_SLOW, _SLOW_TIME, _MEDIANS, _CONSTANT = "left_alone", "left_time", "part_middle", "part_constant"


@dataclass(frozen=True, kw_only=True)
class Correction:
    """Stray field to take off the outboard reading: ``corrected = outboard - field``; spacecraft axes.

    Attributes
    ----------
    field : ndarray, shape (time, axis)
        nT; NaN where it is not known.
    covariance : ndarray, shape (time, axis, axis)
        Of the error of `field`, nT^2; NaN where `field` is. Where the constant part is not known it is
        that of the part that changes.
    state : ndarray of int64, shape (time,)
        Number of the spacecraft's state; `UNKNOWN` (-1) or `TRANSIENT` (-2) where it is in none.
    probability : ndarray, shape (time,)
        That the state is the right one; NaN for methods without states.
    flag : ndarray of uint32, shape (time,)
        Bits of `inflight.flags.Flag`.
    method : str
        ``states``, ``gradiometer``, ``combined`` or ``none``.
    applied : bool
        Whether it is taken off: a correction that does not help is kept, but not applied.
    reason : str
        Why it is applied or not.
    constant_known : bool
        Whether the part of the stray field that never changes is in `field`. Two sensors alone cannot
        separate it from the ambient field and the offsets; without it `field` is relative to one state.
    """

    field: Floats
    covariance: Floats
    state: npt.NDArray[np.int64]
    probability: Floats
    flag: npt.NDArray[np.uint32]
    method: str
    applied: bool = True
    reason: str = ""
    constant_known: bool = False

    def __len__(self) -> int:
        return len(self.field)

    @property
    def sigma(self) -> Floats:
        """Standard deviation of the correction's components; (time, axis), nT."""
        return np.asarray(np.sqrt(np.clip(np.einsum("tii->ti", self.covariance), 0.0, None)))

    @property
    def known(self) -> npt.NDArray[np.bool_]:
        """Where there is a correction; (time,)."""
        return np.asarray(np.isfinite(self.field).all(axis=1))

    def corrected(self, outboard: Floats) -> Floats:
        """Return the corrected outboard field; (time, axis), nT.

        A correction that is not applied leaves the reading as it is, and so do samples whose correction is
        not known: these have no `sigma` and carry a flag.
        """
        if not self.applied:
            return outboard.copy()
        return np.asarray(outboard - np.nan_to_num(self.field, nan=0.0))

    def withheld(self, reason: str) -> Correction:
        """Return the same correction, not applied for a reason."""
        return replace(self, applied=False, reason=reason)


def no_correction(count: int, reason: str) -> Correction:
    """Return the correction that changes none of `count` samples, and why."""
    nothing = np.full((count, 3), np.nan)
    return Correction(
        field=nothing,
        covariance=np.full((count, 3, 3), np.nan),
        state=np.full(count, UNKNOWN, dtype=np.int64),
        probability=np.full(count, np.nan),
        flag=np.zeros(count, dtype=np.uint32),
        method="none",
        applied=False,
        reason=reason,
    )


@dataclass(frozen=True)
class AppliedPart:
    """Which part of a correction is taken off.

    Attributes
    ----------
    share : float
        1 for all of it.
    seconds : float
        What changes more slowly than means over so long stays in the field; 0 where all is taken off.
    """

    share: float = 1.0
    seconds: float = 0.0

    def __str__(self) -> str:
        share = "all" if self.share == 1.0 else f"{self.share:.2f}"
        if not self.seconds:
            return f"{share} of it"
        hours = self.seconds / 3600.0
        return f"{share} of what changes within {f'{hours:.1f} h' if hours >= 1 else f'{self.seconds:.0f} s'}"


WHOLE = AppliedPart()


def partial_correction(
    correction: Correction,
    part: AppliedPart,
    slope_error: float,
    slow: Floats | None = None,
    medians: Floats | None = None,
) -> Correction:
    """Return the correction of which only a part is taken off.

    Parameters
    ----------
    correction : Correction
    part : AppliedPart
        `WHOLE` for all of it, which is returned as it is.
    slope_error : float
        How far the share is from that of the stray field, rms: it widens the error of what changes.
    slow : ndarray, shape (time, axis), optional
        What of the field is not taken off, as `slow_part_of`, nT, the constant part with it: all that
        changes of it is an error. Nothing by default.
    medians : ndarray, shape (kind, axis), optional
        What changes are relative to, as `medians_of`: that of a window, of which this is a day; else of its
        own.
    """
    known, share = correction.known, part.share
    if part == WHOLE or not known.any():
        return correction
    kept = np.zeros_like(correction.field) if slow is None else slow
    taken = correction.field - kept
    taken_median, kept_median = medians_of(correction, kept) if medians is None else medians
    changes, not_taken = taken - taken_median, kept - kept_median
    constant_known = correction.constant_known and not part.seconds
    # A constant that is known does not depend on the share.
    return replace(
        correction,
        field=share * changes + taken_median if constant_known else share * taken,
        covariance=correction.covariance * (1.0 if constant_known else share**2)
        + slope_error**2 * _outer(changes)
        + _outer(not_taken),
        constant_known=constant_known,
    )


def _outer(vectors: Floats) -> Floats:
    """Return products of components; from (time, axis) to (time, axis, axis)."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])


def slow_part(values: Floats, width: int) -> Floats:
    """Return what of values (time, column) changes more slowly than means over `width` samples.

    A mean of means, whose response is nowhere negative: no frequency is left with more than it had.
    """
    around = width | 1
    once = scipy.ndimage.uniform_filter1d(values, around, axis=0, mode="nearest")
    return np.asarray(scipy.ndimage.uniform_filter1d(once, around, axis=0, mode="nearest"))


def slow_part_of(correction: Correction, readings: Readings, seconds: float) -> Floats:
    """Return what of a correction changes more slowly than means over some seconds; zero for 0 s.

    Returns
    -------
    ndarray, shape (time, axis)
        nT; NaN where the correction is not known.
    """
    known = correction.known
    slow = np.where(known[:, None], 0.0, np.nan) * np.ones(3)
    if seconds and known.any():
        slow[known] = slow_part(correction.field[known], readings.samples_in(seconds))
    return slow


def medians_of(correction: Correction, slow: Floats) -> Floats:
    """Return the medians of what is taken off and of what is not; (kind, axis), nT."""
    known = correction.known
    return np.stack([np.median(one[known], axis=0) for one in (correction.field - slow, slow)])


def applied_part_to_dataset(
    correction: Correction, readings: Readings, part: AppliedPart, constant: Floats
) -> xr.Dataset:
    """Return what the days of a window share of its part of a correction, as variables of a table.

    Parameters
    ----------
    correction : Correction
        All of it, of the whole window.
    readings : Readings
    part : AppliedPart
    constant : ndarray, shape (axis,)
        The constant that the correction has, nT: windows that are joined later have another.

    Returns
    -------
    Dataset
        With variables `part_middle` (kind, axis), nT, the medians of what is taken off and of what is not,
        and `part_constant` (axis), nT; where the slow part is not taken off `left_alone` (left_time, axis),
        nT, and `left_time`, TT2000. Empty for `WHOLE`.
    """
    if part == WHOLE or not correction.known.any():
        return xr.Dataset()
    slow = slow_part_of(correction, readings, part.seconds)
    units = {"units": "nT"}
    found = xr.Dataset(
        {
            _MEDIANS: (("kind", "axis"), medians_of(correction, slow), units),
            _CONSTANT: (("axis",), np.asarray(constant), units),
        }
    )
    if not part.seconds:
        return found
    known = np.flatnonzero(correction.known)
    stride = max(readings.samples_in(part.seconds) // SLOW_PART_SETTINGS.stored_per_width, 1)
    rows = known[np.unique(np.append(np.arange(0, known.size, stride), known.size - 1))]
    return found.assign({_SLOW: ((_SLOW_TIME, "axis"), slow[rows], units)}).assign_coords(
        {_SLOW_TIME: readings.stamps[rows]}
    )


def omits_slow_part(table: xr.Dataset) -> bool:
    """Return True when the correction of a table does not take off what is slow."""
    return _SLOW in table


def slow_part_of_day(
    table: xr.Dataset, correction: Correction, readings: Readings, part: AppliedPart, constant: Floats
) -> tuple[Floats, Floats | None]:
    """Return slow part and medians for `partial_correction`, for one of the days of a window.

    Parameters
    ----------
    table : Dataset
        With the variables of `applied_part_to_dataset`; without them a day stands by itself.
    correction, readings, part
        Of the day.
    constant : ndarray, shape (axis,)
        As in `applied_part_to_dataset`, but as the table has it by now.
    """
    shift = constant - np.asarray(table[_CONSTANT].values) if _CONSTANT in table else np.zeros(3)
    slow = slow_in_window(table, correction, readings, part.seconds, shift)
    if _MEDIANS not in table:
        return slow, None
    # Without its slow part a correction has no constant.
    return slow, np.asarray(table[_MEDIANS].values) + np.stack([shift * (not part.seconds), shift])


def slow_in_window(
    table: xr.Dataset, correction: Correction, readings: Readings, seconds: float, shift: Floats
) -> Floats:
    """Return the slow part of a day's correction, (time, axis) nT, by the table of its window.

    A day outside of the window has that of its own correction; `shift` (axis,) nT is by how much the constant
    of the window has changed since.
    """
    times = (
        np.asarray(table[_SLOW_TIME].values, dtype=np.int64)
        if omits_slow_part(table)
        else np.zeros(0, np.int64)
    )
    if not times.size or readings.stamps[0] > times[-1] or readings.stamps[-1] < times[0]:
        return slow_part_of(correction, readings, seconds)
    since = (readings.stamps - times[0]).astype(np.float64)
    known = (times - times[0]).astype(np.float64)
    values = np.asarray(table[_SLOW].values)
    return np.stack([np.interp(since, known, one) for one in values.T], axis=1) + shift
