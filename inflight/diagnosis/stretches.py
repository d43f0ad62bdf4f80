"""Rows of a residual relative to the mean of their stretch: what stands still between two moments is out.

Where something nobody recorded switches, every stretch between two switchings has a level of its own. With
these levels free, what is fitted rests on how the residual changes within the stretches, and nothing that
switches at their edges can pass for it, or spoil its values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import Int64

#: What is left of a constant by rounding, as part of its size.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Stretches:
    """A filter of rows: the mean of each stretch is taken off.

    Attributes
    ----------
    edges : tuple of int
        TT2000 at which a stretch ends and the next begins.
    lost : tuple of (int, int)
        Closed TT2000 spans that are in no stretch: something switches there.
    """

    edges: tuple[int, ...]
    lost: tuple[tuple[int, int], ...]

    def is_lost(self, stamps: Int64) -> npt.NDArray[np.bool_]:
        """Return which rows are in no stretch; (time,)."""
        out = np.zeros(stamps.size, dtype=bool)
        for low, high in self.lost:
            begin, end = np.searchsorted(stamps, [low, high + 1])
            out[begin:end] = True
        return out

    def keep(self, values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return values (time, ...) less the mean of their stretch; NaN where they are not good."""
        flat = values.reshape(len(values), -1)
        out = np.full(flat.shape, np.nan)
        used = good & ~self.is_lost(stamps)
        kept = flat[used]
        place = np.searchsorted(np.asarray(self.edges, dtype=np.int64), stamps[used], side="right")
        begins = np.flatnonzero(np.diff(place, prepend=-1))
        if begins.size:
            count = np.diff(np.append(begins, len(kept)))
            mean = np.add.reduceat(kept, begins, axis=0) / count[:, None]
            moved = kept - np.repeat(mean, count, axis=0)
            # A constant leaves nothing, not its rounding: no value can be had of it.
            moved[np.abs(moved) <= _ROUNDING * np.repeat(np.abs(mean), count, axis=0)] = 0.0
            out[used] = moved
        return out.reshape(values.shape)
