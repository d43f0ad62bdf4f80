"""What is taken off the outboard sensor, how sure that is, and whether it is applied at all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from inflight.arrays import Floats

#: Numbers of samples that are in no known state.
UNKNOWN, TRANSIENT = -1, -2
METHODS = ("states", "gradiometer", "combined", "none")


@dataclass(frozen=True)
class Part:
    """What of a correction is taken off.

    Attributes
    ----------
    share : float
        1 for all of it.
    width : int
        What changes more slowly than means over so many samples is left alone; 0 where it is not.
    """

    share: float = 1.0
    width: int = 0


WHOLE = Part()


def slow_part(values: Floats, width: int) -> Floats:
    """Return what of values (time, column) changes more slowly than means over so many samples."""
    once = ndimage.uniform_filter1d(values, width, axis=0, mode="nearest")
    return np.asarray(ndimage.uniform_filter1d(once, width, axis=0, mode="nearest"))


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

    def partly(self, part: Part, away: float) -> Correction:
        """Return the correction of which only a part is taken off.

        Parameters
        ----------
        part : Part
            `WHOLE` for the whole, which is returned as it is.
        away : float
            How far the share is from that of the stray field, rms: it widens the error of what changes. What
            is left alone because it is slow is an error as a whole.
        """
        known = self.known
        if part == WHOLE or not known.any():
            return self
        field = self.field[known]
        changes, slow = field - np.median(field, axis=0), np.zeros_like(field)
        if part.width:
            slow = slow_part(changes, part.width)
            field = changes = changes - slow
        taken, covariance = np.full_like(self.field, np.nan), np.full_like(self.covariance, np.nan)
        taken[known] = part.share * field
        covariance[known] = (
            self.covariance[known] * part.share**2
            + away**2 * changes[:, :, None] * changes[:, None, :]
            + slow[:, :, None] * slow[:, None, :]
        )
        return replace(self, field=taken, covariance=covariance)

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
