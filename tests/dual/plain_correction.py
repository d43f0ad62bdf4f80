"""A correction that is just a field."""

import numpy as np

from inflight.dual import Correction
from inflight.dual.correction import UNKNOWN


def plain(field, state=None, method="gradiometer", constant_known=False):
    """Return a correction of a field (time, axis) nT with a sigma of 0.01 nT, in no state unless told."""
    count = len(field)
    return Correction(
        field=np.asarray(field, dtype=np.float64),
        covariance=np.full((count, 3, 3), 1e-4) * np.eye(3),
        state=np.full(count, UNKNOWN) if state is None else state,
        probability=np.full(count, np.nan),
        flag=np.zeros(count, dtype=np.uint32),
        method=method,
        constant_known=constant_known,
    )
