"""Residual steps, unrecorded switchings, channel attribution.

How far the corrected field still steps where the spacecraft switches: what a correction is judged by.

The ambient field does not know when the spacecraft switches, so a field without stray field steps there no
more than anywhere else. That is all two sensors tell without a known field: a constant error is not in it.

Switchings that no channel follows: jumps of the difference of two sensors beside those of housekeeping.

A unit without housekeeping that switches is no noise. Its field stands for an hour, in the difference and in
the reading that the difference is calibrated against, so that everything fitted beside it is wrong by more
than its scatter tells. What switches together with a channel is told by the sizes: steps are regressed on the
changes of the channels, robustly, and one that disagrees is unexplained, too.

Which housekeeping channel stands behind a unit that switches, or that none does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.change_points import Rows, find_jumps
from inflight.dual.correction import TRANSIENT
from inflight.dual.readings import white_covariance
from inflight.lsq import TO_SIGMA
from inflight.time import Int64

#: Samples of a mean on either side; longer ones see more of the ambient field, shorter ones more noise.
WIDTH = 8

_WIDTHS = (1, 2, 4, 8, 16, 32)

#: The fewest switchings whose scatter says anything, and errors that must be passed to be told.
_FEWEST_SWITCHINGS, _CLEAR = 4, 4.0

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Switchings:
    """Where one state ends and another begins.

    Attributes
    ----------
    last, first : ndarray of int64, shape (switching,)
        Rows of the last sample before and the first after; samples in no state lie between.
    before, after : ndarray of int64, shape (switching,)
        The states.
    room : ndarray of int64, shape (switching, 2)
        Samples of the state before and after, without a gap.
    """

    last: Ints
    first: Ints
    before: Ints
    after: Ints
    room: Ints

    def __len__(self) -> int:
        return int(self.last.size)


def switchings(state: Ints, stamps: Ints, step: int) -> Switchings:
    """Return where the state changes.

    Parameters
    ----------
    state : ndarray of int64, shape (time,)
        Of a product; `TRANSIENT` samples are in none.
    stamps : ndarray of int64, shape (time,)
        TT2000; a gap ends a state without a switching.
    step : int
        Usual spacing, ns.
    """
    settled = np.flatnonzero(state != TRANSIENT)
    if not settled.size:
        nothing = np.empty(0, dtype=np.int64)
        return Switchings(nothing, nothing, nothing, nothing, np.empty((0, 2), dtype=np.int64))
    told = state[settled]
    gap = np.diff(stamps[settled]) > (np.diff(settled) + 2) * step
    change = np.diff(told) != 0
    cuts = np.flatnonzero(change | gap)
    edges = np.concatenate([[-1], cuts, [settled.size - 1]])
    lengths = np.diff(edges)
    real = change[cuts] & ~gap[cuts]
    where = cuts[real]
    room = np.column_stack([lengths[:-1][real], lengths[1:][real]])
    return Switchings(settled[where], settled[where + 1], told[where], told[where + 1], room)


def steps_across(field: Floats, at: Switchings, width: int = WIDTH) -> Floats:
    """Return the step of a field at each switching, means after less before; (switching, axis), nT.

    NaN where a state is shorter than `width` samples or more than half of them are missing.
    """
    out = np.full((len(at), field.shape[1]), np.nan)
    reach = np.arange(width)
    enough = (at.room >= width).all(axis=1)
    if not enough.any():
        return out
    before = field[at.last[enough][:, None] - reach]
    after = field[at.first[enough][:, None] + reach]
    counts = [np.isfinite(part).all(axis=2).sum(axis=1) for part in (before, after)]
    with np.errstate(invalid="ignore", divide="ignore"):
        step = np.nansum(after, axis=1) / counts[1][:, None] - np.nansum(before, axis=1) / counts[0][:, None]
    step[np.minimum(*counts) < max(1, width // 2)] = np.nan
    out[enough] = step
    return out


def quiet_steps(field: Floats, at: Switchings, width: int = WIDTH) -> Floats:
    """Return the same steps where nothing switches: at a third and two thirds of the states between.

    The same number of samples is left out in the middle as at the switchings, in the median.
    """
    if not len(at):
        return np.empty((0, field.shape[1]))
    between = int(np.median(at.first - at.last))
    third = at.room[:, 1] // 3
    far = third >= width + between
    last = np.concatenate([at.first[far] + third[far], at.first[far] + 2 * third[far] - between])
    first = last + between
    kept = first + width < len(field)
    room = np.full((int(kept.sum()), 2), width, dtype=np.int64)
    nothing = np.zeros(int(kept.sum()), dtype=np.int64)
    return steps_across(field, Switchings(last[kept], first[kept], nothing, nothing, room), width)


def quietest_width(field: Floats, at: Switchings) -> int:
    """Return the width whose steps are smallest where nothing switches; `WIDTH` where none tells."""
    sizes = {width: rms(quiet_steps(field, at, width)) for width in _WIDTHS}
    known = {width: size for width, size in sizes.items() if np.isfinite(size)}
    return min(known, key=lambda width: known[width]) if known else WIDTH


def rms(steps: Floats) -> float:
    """Return the root mean square of a component of steps, nT; NaN where there is none."""
    known = steps[np.isfinite(steps).all(axis=1)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


@dataclass(frozen=True)
class ResidualStep:
    """What is left at the switchings of one state, one unit or one channel.

    Attributes
    ----------
    coordinate : str
        What it goes with.
    value, sigma : ndarray, shape (3,)
        nT, or nT per unit of the channel; the error follows from the scatter.
    count : int
        Switchings.
    """

    coordinate: str
    value: Floats
    sigma: Floats
    count: int

    @property
    def is_clear(self) -> bool:
        """Whether a component is certainly not zero."""
        return bool(np.any(np.abs(self.value) > _CLEAR * self.sigma))

    def told(self, unit: str) -> str:
        """Return a sentence."""
        axis = int(np.argmax(np.abs(self.value) / self.sigma))
        size = f"{self.value[axis]:+.3g} ± {self.sigma[axis]:.2g} {unit} along {'xyz'[axis]}"
        return f"after the correction {size} still goes with {self.coordinate} ({self.count} switchings)"


def regress_steps(coordinate: str, steps: Floats, change: Floats) -> ResidualStep | None:
    """Return how steps follow a change of something at the same switchings; None where too few tell.

    Parameters
    ----------
    steps : ndarray, shape (switching, axis)
        nT.
    change : ndarray, shape (switching,)
        Of a channel, or +1, 0, -1 for a state or a unit; zero where it does not take part.

    Returns
    -------
    Remaining or None
        The slope through zero: where nothing changes there is no step. Its error is the sandwich of the
        scatter, each switching with its leverage (MacKinnon and White 1985).
    """
    known = np.isfinite(steps).all(axis=1) & np.isfinite(change) & (change != 0)
    x, y = change[known], steps[known]
    if x.size < _FEWEST_SWITCHINGS:
        return None
    square = float(x @ x)
    value = x @ y / square
    left = (y - x[:, None] * value) / (1.0 - x**2 / square)[:, None]
    sigma = np.sqrt(x**2 @ left**2) / square
    return ResidualStep(coordinate, value, np.maximum(sigma, np.finfo(float).tiny), int(x.size))


def residual_steps_by_state(at: Switchings, steps: Floats) -> Iterator[ResidualStep]:
    """Yield what is left when a state is entered, and with the other sign when it is left."""
    for state in np.unique(np.concatenate([at.before, at.after])):
        sign = (at.after == state).astype(float) - (at.before == state)
        name = f"state {state}" if state >= 0 else "unknown states"
        if (found := regress_steps(name, steps, sign)) is not None:
            yield found


#: Rows of a mean on either side of a jump, at most; jumps this near to each other are one.
_WIDTH, _ONE = 8, 2

#: A channel changes at a jump when it moves by so many of its usual changes and this part of its range.
_CHANGED, _PART = 8.0, 0.02

#: Jumps at which a channel must change to be regressed on, and scatters beyond which a step disagrees.
_FEWEST_JUMPS, _DISAGREES = 3, 6.0

#: Turns of the robust fit, and residuals (in scatters) that count half.
_TURNS, _HALF = 40, 2.0

#: Median of the length of a vector of three components of unit variance.
_MEDIAN_LENGTH = 1.5382

#: Steps belong to one unit when they agree within so many scatters, or this part of their size.
_LIKE, _LIKE_PART = 6.0, 0.05


@dataclass(frozen=True)
class JumpAttribution:
    """Switchings that a difference shows.

    Attributes
    ----------
    last, first : ndarray of int64, shape (switching,)
        TT2000 of the last row before it and the first one after that know nothing of it; where channels
        follow, of these, too.
    follows : ndarray of bool, shape (switching,)
        Whether changes of channels explain it.
    step : ndarray, shape (switching, axis)
        What the channels do not explain of the step of the difference, nT.
    scatter : float
        Of a component of the steps that channels explain, nT.
    """

    last: Int64
    first: Int64
    follows: npt.NDArray[np.bool_]
    step: Floats
    scatter: float

    @property
    def unexplained(self) -> int:
        """Number of switchings that no channel follows."""
        return int(np.count_nonzero(~self.follows))

    @property
    def units(self) -> list[tuple[Floats, Floats, int]]:
        """Return step, standard deviation and number of switchings of each unit, the busiest first.

        A unit switches on and off by the same vector; its sign is that which makes the largest component
        positive.
        """
        left = np.flatnonzero(~self.follows)
        out = []
        while left.size:
            near = [_like(self.step[left], self.step[one], self.scatter) for one in left]
            signs = max(near, key=lambda sign: int(np.count_nonzero(sign)))
            own = (self.step[left] * signs[:, None])[signs != 0]
            mean = np.median(own, axis=0)
            mean = mean * np.sign(mean[np.argmax(np.abs(mean))])
            spread = TO_SIGMA * np.median(np.abs(own - np.median(own, axis=0)), axis=0)
            # A median is a little less sure than a mean.
            sigma = np.maximum(spread, self.scatter) * np.sqrt(np.pi / 2.0 / len(own))
            out.append((mean, sigma, len(own)))
            left = left[signs == 0]
        return out


def _like(steps: Floats, one: Floats, scatter: float) -> Floats:
    """Return +1 or -1 for steps that are one step or its negative, 0 for others; (step,)."""
    limit = max(_LIKE * scatter, _LIKE_PART * float(np.linalg.norm(one)))
    up, down = (np.linalg.norm(steps - sign * one, axis=1) < limit for sign in (1.0, -1.0))
    return np.where(up, 1.0, np.where(down, -1.0, 0.0))


def attribute_jumps(
    stamps: Int64, difference: Floats, channels: Mapping[str, Floats], reach: Mapping[str, int]
) -> JumpAttribution | None:
    """Return the jumps of a difference, and which of them channels explain; None when there are none.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, increasing; of rows in which both sensors are known.
    difference : ndarray, shape (time, axis)
        nT, one frame, finite.
    channels : mapping of str to ndarray, shape (time,)
        Housekeeping on the same rows; NaN where it is missing.
    reach : mapping of str to int
        Rows that a step of each channel is spread over.
    """
    places, _ = find_jumps(difference)
    if not places.size:
        return None
    first, last = _joined(places)
    step, rows = _steps(difference, first, last)
    changes = {name: _changes(channels[name], first, last, reach[name]) for name in sorted(channels)}
    names = [name for name, one in changes.items() if np.count_nonzero(one[0]) >= _FEWEST_JUMPS]
    used = [changes[name] for name in names]
    change = np.stack([one[0] for one in used], axis=1) if used else np.zeros((first.size, 0))
    white = np.sqrt(np.trace(white_covariance(difference)) / 3.0)
    # A step's own noise at least: where all steps agree by chance there is no smaller scatter.
    least = float(white * np.sqrt(2.0 / np.median(rows)))
    left, scatter = _regressed(step, change, np.array([one[1] for one in used]), least)
    follows = np.linalg.norm(left, axis=1) <= _DISAGREES * scatter
    spread = 1 + max((reach[name] for name in names), default=0) * follows
    before, after = np.maximum(first - spread, 0), np.minimum(last + spread - 1, stamps.size - 1)
    return JumpAttribution(stamps[before], stamps[after], follows, left, float(np.median(scatter)))


def _joined(places: Rows) -> tuple[Rows, Rows]:
    """Return the first and the last of jumps that are too near to be told apart."""
    edges = np.flatnonzero(np.diff(places) > _ONE) + 1
    return places[np.concatenate([[0], edges])], places[np.concatenate([edges - 1, [places.size - 1]])]


def _steps(values: Floats, first: Rows, last: Rows) -> tuple[Floats, Floats]:
    """Return mean after less mean before, the rows next to a jump left out, and the rows of the shorter."""
    ends = np.concatenate([[0], last + 1])[:-1]
    begins = np.concatenate([first, [len(values)]])[1:]
    step, rows = np.zeros((first.size, values.shape[1])), np.ones(first.size)
    for one in range(first.size):
        low, high = max(int(first[one]) - 1, 1), min(int(last[one]) + 1, len(values) - 1)
        before = values[max(int(ends[one]), low - _WIDTH, 0) : low]
        after = values[high : min(int(begins[one]), high + _WIDTH)]
        before = before if len(before) else values[low - 1 : low]
        after = after if len(after) else values[high : high + 1]
        step[one] = after.mean(axis=0) - before.mean(axis=0)
        rows[one] = min(len(before), len(after))
    return step, rows


def _changes(values: Floats, first: Rows, last: Rows, reach: int) -> tuple[Floats, float]:
    """Return the change of a channel across each jump, 0 where it is no more than elsewhere or unknown.

    With it comes the size of its usual change, one sigma.
    """
    top = values.size - 1
    change = values[np.minimum(last + reach, top)] - values[np.maximum(first - 1 - reach, 0)]
    known = values[np.isfinite(values)]
    width = int(np.median(last - first)) + 1 + 2 * reach
    if known.size < 2 * width + 2:
        return np.zeros(first.size), 0.0
    usual = TO_SIGMA * float(np.median(np.abs(known[width:] - known[:-width])))
    limit = max(_CHANGED * usual, _PART * float(np.ptp(known)))
    return np.where(np.isfinite(change) & (np.abs(change) > limit), change, 0.0), usual


def _regressed(step: Floats, change: Floats, usual: Floats, least: float) -> tuple[Floats, Floats]:
    """Return what changes of channels leave of steps (robust fit), and the scatter of a component of each.

    Parameters
    ----------
    step : ndarray, shape (jump, axis)
    change : ndarray, shape (jump, channel)
    usual : ndarray, shape (channel,)
        Noise of such a change.
    least : float
        Scatter of a component at least, nT.
    """
    takes: npt.NDArray[np.bool_] = np.asarray((change != 0).any(axis=1))
    alone = np.full(len(step), least)
    if np.count_nonzero(takes) <= change.shape[1]:
        return step, alone
    x, y = change[takes] / np.abs(change).max(axis=0), step[takes]
    weight, scatter, slope = np.ones(len(x)), least, np.zeros((x.shape[1], 3))
    for turn in range(_TURNS):
        slope = np.linalg.lstsq(x * weight[:, None], y * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(y - x @ slope, axis=1)
        scatter = max(float(np.median(size)) / _MEDIAN_LENGTH, least)
        # Least absolute lengths first, which no start misleads; then what lies near.
        root = size / scatter if turn < _TURNS // 2 else 1.0 + (size / (_HALF * scatter)) ** 2
        weight = 1.0 / np.sqrt(np.maximum(root, 1e-2))
    left = step.copy()
    left[takes] = y - x @ slope
    # A channel's own noise, read into nT, is part of what is left where it changes.
    read = usual / np.abs(change).max(axis=0) * np.linalg.norm(slope, axis=1)
    noise = np.sqrt(scatter**2 + ((change != 0) @ read**2) / 3.0)
    return left, np.where(takes, noise, alone)


#: Part of a channel's changes and of a unit's switchings that belong to each other in a match.
MATCH = 0.5

#: Rearrangements of a channel's changes that may do as well, by chance.
_CHANCE, _REARRANGED = 0.005, 20_000

#: The fewest switchings of a unit that tell anything.
_FEWEST_OF_UNIT = 4

#: A rival is told beside the best channel when it explains nearly as much.
_RIVAL = 0.9


@dataclass(frozen=True)
class NamedUnit:
    """A unit and the channels that switch with it.

    Attributes
    ----------
    unit : int
    switchings : int
        How often it was seen to switch.
    channels : tuple of str
        The best first; more than one when these cannot be told apart, none without housekeeping.
    agreement : tuple of float
        Squared correlation of the channel's changes with the unit's switchings, over all switchings.
    per_unit : tuple of float
        Change of the channel when the unit is switched on, in the channel's unit.
    reason : str
        Why none is named; empty when one is.
    """

    unit: int
    switchings: int
    channels: tuple[str, ...]
    agreement: tuple[float, ...]
    per_unit: tuple[float, ...]
    reason: str = ""


def name_units(signs: Floats, changes: Mapping[str, Floats], *, seed: int = 0) -> list[NamedUnit]:
    """Return the channels behind units.

    Parameters
    ----------
    signs : ndarray, shape (switching, unit)
        +1 where a unit is switched on, -1 where off, 0 where it does not take part.
    changes : mapping of str to ndarray, shape (switching,)
        Change of each housekeeping channel across each switching, in its unit; NaN where it is missing.
    seed : int
        Of the rearrangements.

    Returns
    -------
    list of NamedUnit
        A channel is named when it explains at least half of a unit's switchings and hardly any
        rearrangement of its changes among the switchings does as well; the level is shared by all pairs
        of unit and channel (Bonferroni).
    """
    random = np.random.default_rng(seed)
    # Rearrangements tell no smaller level than their number does.
    pairs = min(max(1, signs.shape[1] * len(changes)), round(_CHANCE * _REARRANGED / 2.0))
    return [_named(unit, signs[:, unit], changes, _CHANCE / pairs, random) for unit in range(signs.shape[1])]


def _named(
    unit: int, sign: Floats, changes: Mapping[str, Floats], level: float, random: np.random.Generator
) -> NamedUnit:
    count = int(np.count_nonzero(sign))
    if count < _FEWEST_OF_UNIT:
        return NamedUnit(
            unit, count, (), (), (), f"it was seen to switch {count} times, at least {_FEWEST_OF_UNIT} needed"
        )
    if not changes:
        return NamedUnit(unit, count, (), (), (), "there is no housekeeping at its switchings")
    found = []
    for name, change in changes.items():
        known = np.isfinite(change)
        if np.count_nonzero(sign[known]) < _FEWEST_OF_UNIT:
            continue
        agreement, per_unit = _agreement(sign[known], change[known])
        if agreement >= MATCH and _by_chance(sign[known], change[known], agreement, random) <= level:
            found.append((agreement, name, per_unit))
    if not found:
        return NamedUnit(unit, count, (), (), (), "no channel changes when it switches")
    found.sort(reverse=True)
    near = [one for one in found if one[0] >= _RIVAL * found[0][0]]
    return NamedUnit(
        unit,
        count,
        tuple(one[1] for one in near),
        tuple(one[0] for one in near),
        tuple(one[2] for one in near),
    )


def _agreement(sign: Floats, change: Floats) -> tuple[float, float]:
    """Return the squared correlation through zero, and the change for one switching on."""
    squares = float(change @ change) * float(sign @ sign)
    product = float(sign @ change)
    return (product**2 / squares if squares > 0 else 0.0), product / float(sign @ sign)


def _by_chance(sign: Floats, change: Floats, agreement: float, random: np.random.Generator) -> float:
    """Return how probable it is that the same changes, at the switchings in another order, agree as well."""
    rearranged = random.permuted(np.broadcast_to(change, (_REARRANGED, change.size)), axis=1)
    squares = float(change @ change) * float(sign @ sign)
    better = int(np.count_nonzero((rearranged @ sign) ** 2 / squares >= agreement * (1.0 - 1e-9)))
    return (better + 1) / (_REARRANGED + 1)
