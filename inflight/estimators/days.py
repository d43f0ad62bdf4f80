"""The thesis' day number (MJD 0 is 2000-01-01T00:00 UTC) and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.time import Int64, to_tt2000, to_utc

_EPOCH = np.datetime64("2000-01-01T00:00:00", "ns")
_DAY_NS = 86_400_000_000_000


def mjd_of(tt2000: npt.ArrayLike) -> Floats:
    """Return days of UTC since 2000-01-01T00:00 of TT2000 times, as Yin (2010) counts them; same shape."""
    return np.asarray((to_utc(tt2000) - _EPOCH) / np.timedelta64(1, "D"), dtype=np.float64)


def tt2000_of(mjd: npt.ArrayLike) -> Int64:
    """Return the TT2000 of day numbers since 2000-01-01T00:00 UTC; same shape."""
    ticks = np.rint(np.asarray(mjd, dtype=np.float64) * _DAY_NS).astype(np.int64)
    return to_tt2000(_EPOCH + ticks.astype("timedelta64[ns]"))
