"""What the orbit does to a day of a spinning sensor: eclipses, perigees, and a field that a model tells.

Temperatures change in eclipse and for some time after it, and the axis of the spin moves at perigee (Plaschke
et al. 2019, sections 5.6, 6 and 8). `eclipses_of` gives the spans that no sub-interval may hold, from a flag
or from the position; `perigees_of` the instants at which a day is cut; `model_in_payload` the model's field
near the Earth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.frames import (
    EARTH_RADIUS,
    FRAMES,
    gse_to_itrf,
    gse_to_payload,
    sun_direction_gse,
    sunlit_fraction,
    to_gse,
)
from inflight.main_field import MainField
from inflight.mission import Mission
from inflight.samples import Series
from inflight.spin import Attitude, Exclusion
from inflight.tasks.archive import ArchiveIndex, Need, channel_series
from inflight.time import Int64, day_bounds
from inflight.units import factor_and_offset

#: Where the shadow is computed from the position.
COMPUTED = "computed"

#: A day's spans in the shadow end at readings; further apart than this many cadences they are two.
_JOINED_CADENCES = 3


def eclipses_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
) -> tuple[list[Exclusion], dict[str, str] | None]:
    """Return the spans of a day in the shadow or shortly after it, and a fault where nothing tells them.

    Parameters
    ----------
    needs : sequence of Need
        With that of the flag, or of the position, where the mission has one.

    Returns
    -------
    exclusions : list of Exclusion
    fault : dict of str, or None
        `channel`, `message` and `remedy`: what is missing. The day is then used whole.
    """
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or entry.eclipse is None:
        return [], None
    computed = entry.eclipse == COMPUTED
    need = (
        _position_of(mission, needs)
        if computed
        else next((one for one in needs if one.name == entry.eclipse), None)
    )
    if need is None:
        what = f"no position in {', '.join(FRAMES)}" if computed else f"no channel '{entry.eclipse}'"
        remedy = "give the mission one" if computed else "name a flag of the mission, or 'computed'"
        return [], _fault(f"{comparison}.eclipse", f"the mission has {what}", remedy)
    # An eclipse of the day before may reach into this one.
    spans: list[Exclusion] = []
    for one in (day - 1, day):
        series = channel_series(cat, need, one, index)
        if series is None:
            continue
        dark = _computed_shadow(series, mission, need) if computed else _told_shadow(series, mission, need)
        joined = _JOINED_CADENCES * max(need.cadence_ns, 1)
        spans += _runs(series.stamps[dark], joined, entry.after_eclipse)
    if index.get(need, day) is None:
        where = f"{need.instrument}.{need.channel}"
        return spans, _fault(where, "no day of it in the archive", "ingest the day's file")
    start, end = day_bounds(day)
    return [one for one in spans if one.start < end and one.end > start], None


def _fault(where: str, message: str, remedy: str) -> dict[str, str]:
    text = f"{message}: eclipses are not told, and nothing is left out for them"
    return {"channel": where, "message": text, "remedy": remedy}


def _told_shadow(series: Series, mission: Mission, need: Need) -> np.ndarray:
    """Return where a flag tells the shadow; (time,). What is missing tells nothing."""
    values = np.asarray(series.values, dtype=np.float64)
    if mission.instruments[need.instrument].channels[need.channel].kind == "sunlight":
        return np.asarray(values < 0.5)
    return np.asarray(np.isfinite(values) & (values != 0.0))


def _position_of(mission: Mission, needs: Sequence[Need]) -> Need | None:
    """Return the need of a position in a known frame."""
    for need in needs:
        channel = mission.instruments[need.instrument].channels[need.channel]
        if channel.kind == "position" and channel.frame in FRAMES:
            return need
    return None


def _positions(series: Series, mission: Mission, need: Need) -> Floats:
    """Return positions, km, gse; (time, 3)."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    values = np.asarray(series.values, dtype=np.float64) * factor_and_offset(channel.unit, "km")[0]
    return to_gse(values, series.stamps, channel.frame or "")


def _computed_shadow(series: Series, mission: Mission, need: Need) -> np.ndarray:
    """Return where the Earth hides the Sun, or a part of it; (time,)."""
    sun = sun_direction_gse(series.stamps, None)
    return np.asarray(sunlit_fraction(_positions(series, mission, need), sun) < 1.0)


def _runs(stamps: Int64, joined: int, after: int) -> list[Exclusion]:
    """Return the spans of stamps that lie together, each longer by what follows it.

    What is told at readings began after the one before them and ended before the next.
    """
    if not stamps.size:
        return []
    apart = np.flatnonzero(np.diff(stamps) > joined) + 1
    cadence = joined // _JOINED_CADENCES
    return [
        Exclusion(int(run[0]) - cadence, int(run[-1]) + cadence + after, "eclipse")
        for run in np.split(stamps, apart)
    ]


def perigees_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
) -> tuple[list[int], dict[str, str] | None]:
    """Return the perigees inside a day, TT2000, at which it is cut, and a fault where nothing tells them."""
    entry = mission.comparisons[comparison]
    if entry.kind != "spin" or entry.cut_at is None:
        return [], None
    need = _position_of(mission, needs)
    series = channel_series(cat, need, day, index) if need is not None else None
    if need is None or series is None:
        found = "the mission has no position" if need is None else "no day of it in the archive"
        where = f"{comparison}.cut_at" if need is None else f"{need.instrument}.{need.channel}"
        message = f"{found}: perigees are not told, and no interval ends at one"
        return [], {"channel": where, "message": message, "remedy": "deliver a channel of kind 'position'"}
    distance = np.linalg.norm(_positions(series, mission, need), axis=1)
    start, end = day_bounds(day)
    return [at for at in _least(series.stamps, distance) if start < at < end], None


def _least(stamps: Int64, distance: Floats) -> list[int]:
    """Return the times of least distance, by the parabola through the three readings around each."""
    known = np.isfinite(distance)
    stamps, distance = stamps[known], distance[known]
    inside = (distance[1:-1] <= distance[:-2]) & (distance[1:-1] < distance[2:])
    out = []
    for at in np.flatnonzero(inside) + 1:
        before, here, after = distance[at - 1 : at + 2]
        shift = 0.5 * (before - after) / max(before - 2.0 * here + after, 1e-12)
        out.append(int(stamps[at]) + round(float(np.clip(shift, -1, 1)) * int(stamps[at + 1] - stamps[at])))
    return out


def model_in_payload(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    stamps: Int64,
    attitude: Attitude | None,
) -> tuple[Floats | None, dict[str, str] | None]:
    """Return the field of the comparison's model at stamps (time, 3), nT, payload axes, and what is missing.

    NaN beyond the distance that the comparison states; None where nothing tells where the spacecraft was or
    how it lay.
    """
    entry = mission.comparisons[comparison]
    assert entry.kind == "spin"
    assert entry.field_model is not None
    need = _position_of(mission, needs)
    series = channel_series(cat, need, day, index) if need is not None else None
    if need is None or series is None or attitude is None:
        found = "no spin axis" if attitude is None else "no position of the day"
        message = f"{found}: no field model tells the parameters that leave no tone"
        remedy = "deliver a channel of kind 'position', and state the 'spin_axis'"
        return None, {"channel": f"{comparison}.field_model", "message": message, "remedy": remedy}
    place = _positions(series, mission, need)
    radius = np.interp(stamps, series.stamps, np.linalg.norm(place, axis=1))
    near = np.flatnonzero(radius <= entry.field_model.within * EARTH_RADIUS)
    model = MainField.of(entry.field_model.model, Path(cat.workspace))
    out = np.full((stamps.size, 3), np.nan)
    if near.size:
        # Places far out are no knots of its field.
        low, high = np.searchsorted(series.stamps, stamps[[near[0], near[-1]]])
        some = slice(max(low - 3, 0), high + 3)
        orbit = gse_to_itrf(place[some], series.stamps[some])
        there = model.along_orbit(orbit, series.stamps[some], stamps[near])
        axes = attitude.axis[near], attitude.sunward[near]
        out[near] = gse_to_payload(to_gse(there, stamps[near], "itrf"), *axes)
    return out, None
