"""Units of the simulated spacecraft and when they switch: each by itself, or one of six states at a time.

The six states are those of Table 1 of the Venus Express paper along x; along y and z they are chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.simulate.dipole import dipole_field
from inflight.simulate.grid import Float
from inflight.simulate.randomness import generator

#: Seconds of a day, and of the half of a commissioning day in which units are switched one by one.
_DAY, _ONE_BY_ONE_S = 86_400.0, 43_200.0
#: Commissioning: a unit is on and off for so long, as often.
_ON_S, _CYCLES = 1200.0, 2
#: Nothing switches this near to midnight or to the unit's last switching, s.
_APART = 120.0
#: A commissioning day of six states stays this long in each.
_STATE_S = 1800.0


@dataclass(frozen=True)
class Unit:
    """A part of the spacecraft with a field of its own.

    Attributes
    ----------
    position, moment : tuple of float
        m, and A m^2 when it is on; spacecraft axes.
    current : float
        Of its housekeeping when it is on, mA; 0 where it has none.
    switches : float
        Mean number of switchings a day.
    """

    name: str
    position: tuple[float, float, float]
    moment: tuple[float, float, float]
    current: float
    switches: float

    def field_at(self, place: tuple[float, float, float]) -> Float:
        """Return its field when it is on at a place, nT, spacecraft axes; (3,)."""
        return dipole_field(self.position, self.moment, place)


UNITS = (
    Unit("transmitter", (0.35, -0.25, -0.55), (0.045, -0.03, 0.05), 2400.0, 6.0),
    Unit("spectrometer", (-0.40, 0.30, -0.35), (-0.028, 0.02, 0.03), 850.0, 9.0),
    Unit("camera", (0.20, 0.45, -0.30), (0.012, 0.022, -0.016), 310.0, 12.0),
    Unit("survival_heater", (-0.15, -0.40, -0.45), (0.02, 0.026, 0.018), 0.0, 10.0),
)
#: Appears late, and has no housekeeping.
NEW_UNIT = Unit("new_unit", (0.05, 0.20, -0.25), (-0.02, 0.012, -0.018), 0.0, 14.0)

#: Outboard less inboard, and what is added to the outboard reading, along x, nT (Table 1 of the Venus
#: Express paper); along y and z the paper gives none: chosen.
_TABLE_1_X = ((-9.39, -6.18), (-6.71, -6.12), (-4.05, -1.68), (0.5, 0.5), (2.89, 2.49), (2.72, 3.63))
_TABLE_1_YZ = (
    ((-3.1, -1.2), (2.4, 0.9)),
    ((-1.9, -0.8), (-3.6, -1.5)),
    ((1.2, 0.6), (-1.1, -0.2)),
    ((0.3, 0.1), (0.2, 0.1)),
    ((2.2, 1.1), (1.5, 0.4)),
    ((-1.4, -0.5), (3.0, 1.3)),
)


def six_states() -> tuple[Float, Float]:
    """Return the stray field of each of the six states at the inboard and the outboard sensor, nT; (6, 3).

    The published corrections are added, so that the field is their negative; the inboard one is the sum
    of both columns.
    """
    columns = np.array([(x, *yz) for x, yz in zip(_TABLE_1_X, _TABLE_1_YZ, strict=True)])
    return -columns.sum(axis=2), -columns[:, :, 1]


@dataclass(frozen=True)
class Calendar:
    """When a mission switches; any day without its neighbours.

    Attributes
    ----------
    seed : int
    first : int
        Number of the first day, from 1970.
    commissioning : int
        Days on which the first half switches units one by one.
    """

    seed: int
    first: int
    commissioning: int

    def _overnight(self, name: str, day: int) -> bool:
        """Return whether a unit is on at the begin of a day."""
        if day <= self.first:
            return False
        return bool(generator(self.seed, f"{name} overnight", day).random() < 0.5)

    def switchings(self, unit: Unit, place: int, units: int, day: int) -> tuple[bool, Float]:
        """Return whether a unit begins a day switched on, and the seconds of the day at which it switches.

        Parameters
        ----------
        place, units : int
            Its turn among all of a commissioning day.
        day : int
            From 1970.
        """
        begins, ends = self._overnight(unit.name, day), self._overnight(unit.name, day + 1)
        is_first = self.first <= day < self.first + self.commissioning
        low = _ONE_BY_ONE_S if is_first else 0.0
        random = generator(self.seed, f"{unit.name} switching", day)
        turns: Float = np.empty(0)
        if is_first:
            length = _ONE_BY_ONE_S / units
            turns = place * length + 600.0 + _ON_S * np.arange(2.0 * _CYCLES)
            first: Float = np.full(int(begins), 60.0)
            turns = np.concatenate([first, turns[turns < (place + 1) * length]])
            if (turns.size + begins) % 2:
                turns = turns[:-1]
        starts = begins != bool(turns.size % 2)
        count = int(random.poisson(unit.switches * (1.0 - low / _DAY)))
        count += (count % 2) != (starts != ends)
        times = np.sort(random.uniform(low + _APART, _DAY - _APART, count))
        return begins, np.concatenate([turns, _spaced(times)])

    def states(self, count: int, day: int) -> tuple[npt.NDArray[np.int64], Float]:
        """Return the states of a day, one of `count` after the other, and when each starts, s."""
        random = generator(self.seed, "states", day)
        if self.first <= day < self.first + self.commissioning:
            begins = np.arange(0.0, _DAY, _STATE_S)
            return np.arange(begins.size) % count, begins
        begins = np.concatenate([[0.0], _spaced(np.sort(random.uniform(_APART, _DAY - _APART, 40)))])
        chosen = np.cumsum(random.integers(1, count, begins.size)) % count
        return chosen.astype(np.int64), begins


def _spaced(times: Float) -> Float:
    """Leave out pairs of times that are too near: what switches twice is where it was."""
    kept: list[float] = []
    for time in times.tolist():
        if kept and time - kept[-1] < _APART:
            kept.pop()
        else:
            kept.append(time)
    return np.array(kept)


def align_switchings(times: Float, others: Float) -> Float:
    """Move every second switching to the nearest of another unit; two at one time undo each other."""
    if not others.size or not times.size:
        return times
    moved = times.copy()
    moved[::2] = others[np.argmin(np.abs(others[None] - times[::2, None]), axis=1)]
    values, counts = np.unique(moved, return_counts=True)
    return np.asarray(values[counts % 2 == 1])


def switched_part(seconds: Float, begins: bool, times: Float, rise: float) -> Float:
    """Return how far a unit is switched on, 0 to 1; it needs `rise` seconds each time."""
    level = np.full(seconds.size, float(begins))
    sign = -1.0 if begins else 1.0
    for time in times:
        level += sign * np.clip((seconds - time) / max(rise, 1e-9), 0.0, 1.0)
        sign = -sign
    return np.asarray(np.clip(level, 0.0, 1.0))
