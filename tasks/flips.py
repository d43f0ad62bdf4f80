"""A flipper's two positions: which one each day is calibrated for.

Events of kind ``flip`` and ``flip_back`` tell when sensors 1 and 3 change places (see
`inflight.zero_level.flipper`); readings are delivered in the spacecraft's axes throughout, so that a flip
changes the offsets of x and z. A day is calibrated for the position that holds longest on it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from inflight.flags import Flag
from inflight.mission import Mission
from inflight.time import Int64, as_day, day_bounds, utc_text

_KINDS = ("flip", "flip_back")
_DAY = np.timedelta64(1, "D")


def flips_of(mission: Mission) -> list[tuple[int, bool]]:
    """Return the flips in order of time: TT2000, and whether the sensors lie flipped from then on."""
    return sorted((event.at, event.kind == "flip") for event in mission.events if event.kind in _KINDS)


def kept_span(mission: Mission, day: np.datetime64) -> tuple[int, int]:
    """Return the half-open TT2000 span of a day's position: that which holds longest."""
    start, end = day_bounds(day)
    edges = [start, *(at for at, _ in flips_of(mission) if start < at < end), end]
    return max(itertools.pairwise(edges), key=lambda span: span[1] - span[0])


def flip_flags(mission: Mission, day: np.datetime64, stamps: Int64) -> np.ndarray:
    """Return ``FLIPPED`` for the samples of a day that its calibration is not for; (time,) uint32."""
    low, high = kept_span(mission, day)
    outside = (stamps < low) | (stamps >= high)
    return np.where(outside, np.uint32(Flag.FLIPPED), np.uint32(0))


def position_edges(mission: Mission) -> list[np.datetime64]:
    """Return the first days of each position after the first one."""
    edges = []
    for at, _ in flips_of(mission):
        day = as_day(utc_text(at)[:10])
        edges.append(day if kept_span(mission, day)[0] >= at else day + _DAY)
    return sorted(set(edges))


def cut_at_flips(edges: Sequence[np.datetime64], mission: Mission) -> list[np.datetime64]:
    """Return edges of windows with those of the positions among them: no window holds two."""
    inside = [day for day in position_edges(mission) if edges[0] < day < edges[-1]]
    return sorted({*edges, *inside})
