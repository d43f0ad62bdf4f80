"""Which intervals are Alfvenic (the field turns), which compressional (its size varies), and which neither.

The parts of the variance are those of the field less the present offset; a wrong offset makes turning
look like compression. The kinds are therefore found anew after each estimate until they stay
(`inflight.zero_level.combined`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.time import Int64
from inflight.zero_level.davis_smith import compression
from inflight.zero_level.intervals import Bools, Intervals

#: Of the variance of an interval, compression is a third when all directions are alike. Alfvenic intervals
#: have less than a tenth, compressional ones more than twice the third: limits chosen here. They decide which
#: intervals a method sees; its errors come from what these show.
ALFVENIC, COMPRESSIONAL = 0.10, 2.0 / 3.0
#: The direction of most variance is told from the next when it has this many times its variance.
_ELONGATED = 2.0


@dataclass(frozen=True)
class Kinds:
    """What fluctuates in each interval; all (interval,).

    Attributes
    ----------
    compression : ndarray
        Variance of the size over that of the vector, 0 to 1.
    rotation : ndarray
        Root mean square of the turning over that of the field: radians while it is small.
    alfvenic, compressional : ndarray of bool
    start, end : ndarray of int64
        TT2000.
    """

    compression: Floats
    rotation: Floats
    alfvenic: Bools
    compressional: Bools
    start: Int64
    end: Int64

    @property
    def neither(self) -> Bools:
        """Intervals of no kind."""
        return ~(self.alfvenic | self.compressional)

    def told(self) -> str:
        """Say how many there are of each kind."""
        counts = [int(part.sum()) for part in (self.alfvenic, self.compressional, self.neither)]
        return f"{counts[0]} Alfvenic, {counts[1]} compressional, {counts[2]} neither"

    def table(self) -> xr.Dataset:
        """Return everything along interval; `value` is the compression, its sigma is not known (NaN)."""
        return xr.Dataset(
            {
                "value": ("interval", self.compression),
                "sigma": ("interval", np.full(self.compression.size, np.nan)),
                "rotation": ("interval", self.rotation, {"units": "rad"}),
                "alfvenic": ("interval", self.alfvenic),
                "compressional": ("interval", self.compressional),
                "start": ("interval", self.start, {"scale": "TT2000"}),
                "end": ("interval", self.end, {"scale": "TT2000"}),
            }
        )


def kinds(intervals: Intervals, offset: Floats) -> Kinds:
    """Tell Alfvenic from compressional intervals.

    Parameters
    ----------
    intervals : Intervals
    offset : ndarray, shape (3,)
        The present offset, nT.
    """
    covariance = intervals.covariance - intervals.white**2 * np.eye(3)
    own = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    total = np.maximum(own.sum(axis=1), 1e-300)
    mean = np.linalg.norm(intervals.mean - offset, axis=1)
    squeezed = np.maximum(compression(intervals, offset) - intervals.white**2, 0.0)
    part = np.minimum(squeezed / total, 1.0)
    rotation = np.sqrt(np.maximum(total - squeezed, 0.0) / (mean**2 + total))
    lively = intervals.lively
    elongated = own[:, 2] > _ELONGATED * own[:, 1]
    return Kinds(
        part, rotation, lively & (part < ALFVENIC), lively & elongated & (part > COMPRESSIONAL),
        intervals.start, intervals.end,
    )  # fmt: skip
