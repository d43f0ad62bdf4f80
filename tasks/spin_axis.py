"""How a spinning spacecraft's axis lies in space on a day, from what a mission states or delivers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.errors import MissionError
from inflight.geocentric import FRAMES, sunward, to_gse
from inflight.mission import Mission, SpinAxis
from inflight.spin.product import Attitude
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.channel_series import channel_series
from inflight.tasks.needs import SPIN_AXIS, Need
from inflight.time import SECOND, Int64
from inflight.units import factor_and_offset

#: The axis moves slowly: between two directions no farther apart than this, or than three cadences, it is
#: carried along the straight line.
_LONGEST_GAP = 7200 * SECOND


def attitude_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    samples: xr.Dataset,
) -> Attitude | None:
    """Return where spin axis and Sun stand at samples; None where nothing states or tells the axis.

    Parameters
    ----------
    needs : sequence of Need
        With that of the axis, where a channel tells it.
    samples : xarray.Dataset
        `tt2000` (time); `position` (time, axis) with attributes `units` and `frame`, where it is known.

    Raises
    ------
    MissionError
        When the frame of a channel is none that can be turned.
    """
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    entry = mission.comparisons[comparison]
    stated = entry.spin_axis if entry.kind == "spin" else None
    need = next((one for one in needs if one.name == SPIN_AXIS), None)
    # All days of a store have the same variables: a day without directions has empty ones.
    axis: Floats = np.full((stamps.size, 3), np.nan)
    if isinstance(stated, list):
        axis = _stated(stated, stamps)
    elif need is None:
        return None
    elif (series := channel_series(cat, need, day, index, alone=False)) is not None:
        axis = _delivered(series, need, mission, stamps)
    return Attitude(axis, sunward(stamps, _position(samples)))


def _stated(axes: Sequence[SpinAxis], stamps: Int64) -> Floats:
    """Return the axis, gse, as the mission's file has it; NaN before the first one."""
    out = np.full((stamps.size, 3), np.nan)
    for one in sorted(axes, key=_since):
        here = stamps >= _since(one)
        direction = np.broadcast_to(_unit(np.array([one.direction])), (int(here.sum()), 3))
        out[here] = to_gse(np.array(direction), stamps[here], one.frame)
    return out


def _since(axis: SpinAxis) -> int:
    return np.iinfo(np.int64).min if axis.since is None else axis.since


def _delivered(series: xr.DataArray, need: Need, mission: Mission, stamps: Int64) -> Floats:
    """Return the axis, gse, as a channel has it, between its readings; NaN where they are too rare."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    frame, values = channel.frame or "", np.asarray(series.values, dtype=np.float64)
    if frame not in FRAMES or values.ndim != 2 or values.shape[1] not in (2, 3):
        raise MissionError(
            f"the spin axis has {values.shape[1] if values.ndim == 2 else 1} numbers in the frame {frame!r}",
            remedy=f"give a vector, or right ascension and declination, and a frame of {', '.join(FRAMES)}",
        )
    if values.shape[1] == 2:
        values = values * factor_and_offset(channel.unit, "deg")[0]
    times = np.asarray(series["tt2000"].values, dtype=np.int64)
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return np.full((stamps.size, 3), np.nan)
    times, axis = times[known], to_gse(_unit(values[known]), times[known], frame)
    carried = np.stack([np.interp(stamps, times, one) for one in axis.T], axis=1)
    return np.where(_is_near(times, stamps, need.cadence_ns)[:, None], carried, np.nan)


def _is_near(times: Int64, stamps: Int64, cadence: int) -> np.ndarray:
    """Return which stamps lie between readings that are near enough, or beside one."""
    longest = max(_LONGEST_GAP, 3 * cadence)
    after = np.searchsorted(times, stamps)
    before, beyond = np.maximum(after - 1, 0), np.minimum(after, times.size - 1)
    inside = (after > 0) & (after < times.size)
    apart = np.where(inside, times[beyond] - times[before], 2 * np.abs(stamps - times[before]))
    return np.asarray(apart <= longest)


def _unit(directions: Floats) -> Floats:
    """Return unit vectors of vectors, or of right ascensions and declinations in degrees; (time, 3)."""
    if directions.shape[1] == 2:
        right, up = np.deg2rad(directions.T)
        return np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _position(samples: xr.Dataset) -> Floats | None:
    """Return the positions, km, gse; None where they are not known in a frame that can be turned."""
    position = samples.get("position")
    if position is None or position.attrs.get("frame") not in FRAMES:
        return None
    factor, _ = factor_and_offset(str(position.attrs.get("units", "km")), "km")
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    place = np.asarray(position.values, dtype=np.float64) * factor
    return to_gse(place, stamps, str(position.attrs["frame"]))
