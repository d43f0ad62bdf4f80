"""What is taken off the outboard sensor, how sure that is, and whether it is applied at all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

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
