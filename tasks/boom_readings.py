"""What two sensors on one boom deliver, looked through before anything is learnt from it.

A sensor that is dead or not plugged in reads one value. Its difference to the other is then the ambient field
itself, and a gradiometer would take that off: readings that stay the same while the other sensor's change are
no measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.errors import SamplesError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples

#: So many samples in which all axes read the very same: noise does not do that.
_STILL = 100
#: The other sensor moves by so many of the smallest steps that the still one takes.
_MOVES = 5.0
#: nT; no sensor on a boom reads this: a fill value that nobody declared.
_IMPOSSIBLE = 1e7
_ROLES = ("inboard", "outboard")


def boom_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> xr.Dataset:
    """Return a day's samples of both sensors, readings that are no measurements flagged.

    Raises
    ------
    SamplesError
        When a sensor's day is not in the archive, or it reads one and the same value all day.
    """
    samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
    values = {role: np.asarray(samples[role].values, dtype=np.float64) for role in _ROLES}
    flag = np.asarray(samples["flag"].values, dtype=np.uint32).copy()
    for role in _ROLES:
        with np.errstate(invalid="ignore"):
            wild = np.asarray((np.abs(values[role]) > _IMPOSSIBLE).any(axis=1))
        flag[wild] |= np.uint32(Flag.OUT_OF_RANGE)
        values[role] = np.where(wild[:, None], np.nan, values[role])
    for role, other in (_ROLES, _ROLES[::-1]):
        still = still_rows(values[role], values[other])
        read = np.asarray(np.isfinite(values[role]).all(axis=1))
        if read.any() and still[read].all():
            name = mission.comparisons[model.comparison].instruments()[role]
            raise SamplesError(
                f"'{name}', the {role} sensor, reads one and the same value while the other one's change",
                day=str(day),
                remedy="its readings are no measurements: leave the day's file out, or flag it ('good_when')",
            )
        flag[still] |= np.uint32(Flag.STILL)
    samples["flag"] = samples["flag"].copy(data=flag)
    return samples


def still_rows(values: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return where a sensor's reading stays the very same for long while another one's changes.

    Parameters
    ----------
    values, other : ndarray, shape (time, axis)
        nT, at the same times; NaN where missing.

    Returns
    -------
    ndarray of bool, shape (time,)
    """
    out = np.zeros(len(values), dtype=bool)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if rows.size < _STILL:
        return out
    steps = np.abs(np.diff(values[rows], axis=0))
    edges = np.concatenate([[0], np.flatnonzero(steps.any(axis=1)) + 1, [rows.size]])
    smallest = float(steps[steps > 0.0].min(initial=np.inf))
    least = _MOVES * smallest if np.isfinite(smallest) else 0.0
    for first, last in pairwise(edges.tolist()):
        if last - first >= _STILL and _moved(other[rows[first:last]]) > least:
            out[rows[first:last]] = True
    return out


def _moved(values: Floats) -> float:
    """Return the largest range of an axis, nT; 0 without readings."""
    known = values[np.isfinite(values).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) if len(known) else 0.0
