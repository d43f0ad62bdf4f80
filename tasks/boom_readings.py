"""What two sensors on one boom deliver, looked through before anything is learnt from it.

A sensor that is dead or not plugged in reads one value, and so does an axis that is stuck or full. The
difference to the other sensor is then the ambient field itself, and a gradiometer would take that off:
readings that stay the same while the other sensor's change are no measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.spatial.transform import Rotation

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.errors import SamplesError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples
from inflight.tasks.spinning import saturated

#: So many samples in which an axis reads the very same: noise does not do that.
_STILL = 100
#: The other sensor moves by so many of the smallest steps that the still axis takes before and after, noise
#: averaged over so many parts of the time.
_MOVES, _PARTS = 5.0, 10
#: Part of the inboard sensor's moves that the outboard one makes at least: units are nearer to the former.
_SEEN_OUTBOARD = 0.05
#: Steps before and after that tell how small steps are: a sensor may change its range.
_NEARBY = 1000
#: Readings that are nearer than this part of the largest are the same: those between two stamps are computed.
_SAME = 1e-12
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
        When a sensor's day is not in the archive, or an axis of it reads one and the same value all day.
    """
    samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
    values = {role: np.asarray(samples[role].values, dtype=np.float64) for role in _ROLES}
    flag = np.asarray(samples["flag"].values, dtype=np.uint32).copy()
    for role in _ROLES:
        with np.errstate(invalid="ignore"):
            wild = np.asarray((np.abs(values[role]) > _IMPOSSIBLE).any(axis=1))
        flag[wild] |= np.uint32(Flag.OUT_OF_RANGE)
        values[role] = np.where(wild[:, None], np.nan, values[role])
    turns = {role: Rotation.from_quat(samples[role].attrs["orientation"]) for role in _ROLES}
    for role, other in (_ROLES, _ROLES[::-1]):
        need = next(one for one in needs if one.name == role)
        flag |= saturated(values[role], mission.instruments[need.instrument].channels[need.channel])
        # In the axes of the sensor: one of those is what sticks.
        seen = turns[role].inv().apply(turns[other].apply(values[other]))
        still = still_axes(values[role], seen * (_SEEN_OUTBOARD if role == "outboard" else 1.0))
        _refuse_stuck(still, values[role], role, need.instrument, day)
        flag[still.any(axis=1)] |= np.uint32(Flag.STILL)
    samples["flag"] = samples["flag"].copy(data=flag)
    return samples


def _refuse_stuck(
    still: npt.NDArray[np.bool_], values: Floats, role: str, name: str, day: np.datetime64
) -> None:
    read = np.isfinite(values).all(axis=1)
    stuck = still[read].all(axis=0) if read.any() else np.zeros(3, dtype=bool)
    if stuck.any():
        along = "" if stuck.all() else f" along {'xyz'[int(np.argmax(stuck))]}, an axis of its own,"
        raise SamplesError(
            f"'{name}', the {role} sensor, reads one and the same value{along} while the other one's change",
            day=str(day),
            remedy="its readings are no measurements: leave the day's file out, or flag it ('good_when')",
        )


def still_axes(values: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return where an axis of a sensor reads the very same for long while another sensor's changes.

    Parameters
    ----------
    values, other : ndarray, shape (time, axis)
        nT, at the same times and in the same axes, NaN where missing; of the other what both must see.

    Returns
    -------
    ndarray of bool, shape (time, axis)
    """
    out = np.zeros(values.shape, dtype=bool)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if rows.size < _STILL:
        return out
    for axis in range(values.shape[1]):
        own = values[rows, axis]
        steps = np.abs(np.diff(own))
        steps[steps <= _SAME * float(np.abs(own).max())] = 0.0
        edges = np.concatenate([[0], np.flatnonzero(steps) + 1, [rows.size]])
        for first, last in pairwise(edges.tolist()):
            if last - first < _STILL:
                continue
            before, after = steps[max(first - _NEARBY, 0) : first], steps[last - 1 : last - 1 + _NEARBY]
            least = _MOVES * max(_smallest(before), _smallest(after))
            if _moved(other[rows[first:last], axis]) > least:
                out[rows[first:last], axis] = True
    return out


def _smallest(steps: Floats) -> float:
    """Return the smallest step that is one, nT; 0 for none."""
    taken = steps[steps > 0.0]
    return float(taken.min()) if taken.size else 0.0


def _moved(values: Floats) -> float:
    """Return how far a component moves, nT: the range of means over parts of the time; 0 without readings."""
    known = values[np.isfinite(values)]
    if known.size < _PARTS:
        return 0.0
    return float(np.ptp([one.mean() for one in np.array_split(known, _PARTS)]))
