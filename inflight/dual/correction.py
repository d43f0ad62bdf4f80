"""Correction, its slow part.

What is taken off the outboard sensor, how sure that is, and whether it is applied at all.

What of a correction changes slowly, and is left alone where it may be the sensors' own.

Sensors drift, and ambient field that leaks into the difference is largest on long times: a correction is
often sure on short times only. What is slow is that of a whole window; its days find it in the table, so
that the field does not step between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy import ndimage

from inflight.arrays import Floats
from inflight.dual.readings import Readings

#: Numbers of samples that are in no known state.
UNKNOWN, TRANSIENT = -1, -2

METHODS = ("states", "gradiometer", "combined", "none")


@dataclass(frozen=True)
class Correction:
    """Stray field to take off the outboard reading: ``corrected = outboard - field``; spacecraft axes.

    Attributes
    ----------
    field : ndarray, shape (time, axis)
        nT; NaN where nothing can be said.
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
        Whether the part of the stray field that never changes is in `field`. Two sensors alone cannot tell
        it from the ambient field and the offsets; without it `field` is relative to one state.
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

        A correction that is not applied leaves the reading as it is, and so do samples about which nothing
        can be said: these have no `sigma` and carry a flag.
        """
        if not self.applied:
            return outboard.copy()
        return np.asarray(outboard - np.nan_to_num(self.field, nan=0.0))

    def withheld(self, reason: str) -> Correction:
        """Return the same correction, not applied for a reason."""
        return replace(self, applied=False, reason=reason)


def no_correction(count: int, reason: str) -> Correction:
    """Return the correction that leaves `count` samples alone, and why."""
    nothing = np.full((count, 3), np.nan)
    return Correction(
        nothing,
        np.full((count, 3, 3), np.nan),
        np.full(count, UNKNOWN, dtype=np.int64),
        np.full(count, np.nan),
        np.zeros(count, dtype=np.uint32),
        "none",
        applied=False,
        reason=reason,
    )


#: The variable of a table, and its times.
_NAME, _TIMES = "left_alone", "left_time"

#: Medians in the window of what is taken off and of what is left alone, and the constant they are told with.
_MIDDLE, _CONSTANT = "part_middle", "part_constant"

#: Values of the slow part in one width.
_DENSE = 16


@dataclass(frozen=True)
class AppliedPart:
    """What of a correction is taken off.

    Attributes
    ----------
    share : float
        1 for all of it.
    seconds : float
        What changes more slowly than means over so long is left alone; 0 where nothing is.
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


def slow_part(values: Floats, width: int) -> Floats:
    """Return what of values (time, column) changes more slowly than means over `width` samples.

    A mean of means: a response that is nowhere negative, so that no frequency is left with more than it had.
    """
    around = width | 1
    once = ndimage.uniform_filter1d(values, around, axis=0, mode="nearest")
    return np.asarray(ndimage.uniform_filter1d(once, around, axis=0, mode="nearest"))


def slow_part_of(correction: Correction, readings: Readings, seconds: float) -> Floats:
    """Return what of a correction changes more slowly than means over some seconds; nothing for 0.

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


def part_variables(
    correction: Correction, readings: Readings, part: AppliedPart, constant: Floats
) -> xr.Dataset:
    """Return what the days of a window share of its part of a correction, as variables of a table.

    Parameters
    ----------
    correction : Correction
        All of it, of the whole window.
    readings : Readings
    part : Part
    constant : ndarray, shape (axis,)
        The constant that the correction has, nT: windows that are joined later have another.

    Returns
    -------
    Dataset
        With variables `part_middle` (kind, axis), nT, of what is taken off and of what is left alone, and
        `part_constant` (axis), nT; where the part leaves alone what is slow `left_alone` (left_time, axis),
        nT, and `left_time`, TT2000. Empty for `WHOLE`.
    """
    if part == WHOLE or not correction.known.any():
        return xr.Dataset()
    slow = slow_part_of(correction, readings, part.seconds)
    units = {"units": "nT"}
    told = xr.Dataset(
        {
            _MIDDLE: (("kind", "axis"), medians_of(correction, slow), units),
            _CONSTANT: (("axis",), np.asarray(constant), units),
        }
    )
    if not part.seconds:
        return told
    known = np.flatnonzero(correction.known)
    every = max(readings.samples_in(part.seconds) // _DENSE, 1)
    rows = known[np.unique(np.append(np.arange(0, known.size, every), known.size - 1))]
    return told.assign({_NAME: ((_TIMES, "axis"), slow[rows], units)}).assign_coords(
        {_TIMES: readings.stamps[rows]}
    )


def part_of_day(
    table: xr.Dataset, correction: Correction, readings: Readings, part: AppliedPart, constant: Floats
) -> tuple[Floats, Floats | None]:
    """Return the slow part and the medians of a window for `partial_correction`, for the correction of one of its days.

    Parameters
    ----------
    table : Dataset
        With the variables of `part_variables`; without them a day goes by itself.
    correction, readings, part
        Of the day.
    constant : ndarray, shape (axis,)
        As in `part_variables`, but as the table has it by now.
    """
    moved = constant - np.asarray(table[_CONSTANT].values) if _CONSTANT in table else np.zeros(3)
    slow = slow_in_window(table, correction, readings, part.seconds, moved)
    if _MIDDLE not in table:
        return slow, None
    # What is quick has no constant.
    return slow, np.asarray(table[_MIDDLE].values) + np.stack([moved * (not part.seconds), moved])


def omits_slow_part(table: xr.Dataset) -> bool:
    """Return True when the correction of a table leaves alone what is slow."""
    return _NAME in table


def slow_in_window(
    table: xr.Dataset, correction: Correction, readings: Readings, seconds: float, moved: Floats
) -> Floats:
    """Return the slow part of a day's correction, (time, axis) nT, by the table of its window.

    A day outside of the window has that of its own correction; `moved` (axis,) nT is by how much the constant
    of the window's has moved since.
    """
    times = (
        np.asarray(table[_TIMES].values, dtype=np.int64) if omits_slow_part(table) else np.zeros(0, np.int64)
    )
    if not times.size or readings.stamps[0] > times[-1] or readings.stamps[-1] < times[0]:
        return slow_part_of(correction, readings, seconds)
    since = (readings.stamps - times[0]).astype(np.float64)
    known = (times - times[0]).astype(np.float64)
    values = np.asarray(table[_NAME].values)
    return np.stack([np.interp(since, known, one) for one in values.T], axis=1) + moved


def medians_of(correction: Correction, slow: Floats) -> Floats:
    """Return the medians of what is taken off and of what is left alone; (kind, axis), nT."""
    known = correction.known
    return np.stack([np.median(one[known], axis=0) for one in (correction.field - slow, slow)])


def partial_correction(
    correction: Correction,
    part: AppliedPart,
    away: float,
    slow: Floats | None = None,
    middle: Floats | None = None,
) -> Correction:
    """Return the correction of which only a part is taken off.

    Parameters
    ----------
    correction : Correction
    part : Part
        `WHOLE` for all of it, which is returned as it is.
    away : float
        How far the share is from that of the stray field, rms: it widens the error of what changes.
    slow : ndarray, shape (time, axis), optional
        What of the field is left alone, as `slow_part_of`, nT, the constant part with it: all that changes of it
        is an error. Without it nothing is.
    middle : ndarray, shape (kind, axis), optional
        What changes are told from, as `medians_of`: that of a window, of which this is a day; else of its own.
    """
    known, share = correction.known, part.share
    if part == WHOLE or not known.any():
        return correction
    left = np.zeros_like(correction.field) if slow is None else slow
    taken = correction.field - left
    taken_middle, left_middle = medians_of(correction, left) if middle is None else middle
    changes, stays = taken - taken_middle, left - left_middle
    constant_known = correction.constant_known and not part.seconds
    # A constant that is known is no matter of the share.
    return replace(
        correction,
        field=share * changes + taken_middle if constant_known else share * taken,
        covariance=correction.covariance * (1.0 if constant_known else share**2)
        + away**2 * _squares(changes)
        + _squares(stays),
        constant_known=constant_known,
    )


def _squares(vectors: Floats) -> Floats:
    """Return products of components; from (time, axis) to (time, axis, axis)."""
    return np.asarray(vectors[:, :, None] * vectors[:, None, :])
