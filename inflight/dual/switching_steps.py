"""Switchings: the steps of a field at them, those without a record, and the channels behind units.

A *switching* is where one state ends and another begins; a *step* is the mean of a field after less that
before.

- `switchings`, `steps_across`, `quiet_steps`, `regress_steps`: how far the corrected field still steps where
  the spacecraft switches. The ambient field is independent of the spacecraft, so a field without stray field
  steps there no more than anywhere else. A constant error is not in it.
- `attribute_jumps`: which jumps of the difference no housekeeping channel follows. The field of a unit
  without housekeeping stays for an hour, in the difference and in the reading that it is calibrated against,
  so that everything fitted with it is wrong by more than its scatter shows. What switches together with a
  channel is found by the sizes: steps are regressed on the changes of the channels, robustly.
- `match_channels_to_units`: which channel switches with which unit, by a permutation test.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.change_points import Rows, find_jumps
from inflight.dual.correction import TRANSIENT
from inflight.dual.readings import white_covariance
from inflight.lsq import MAD_TO_SIGMA
from inflight.time import Int64


@dataclass(frozen=True, kw_only=True)
class ResidualStepSettings:
    """Numbers of steps at switchings.

    Attributes
    ----------
    width : int
        Samples of a mean on either side where no width is measured. Assumed: longer ones hold more of the
        ambient field, shorter ones more noise.
    widths : tuple of int
        Widths of which that with the smallest steps without a switching is taken. Assumed: an octave apart.
    fewest : int
        Switchings whose scatter gives an error, at least. Assumed.
    clear_sigmas : float
        A residual step is reported from so many errors on. Level of significance: four sigmas.
    """

    width: int = 8
    widths: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    fewest: int = 4
    clear_sigmas: float = 4.0


@dataclass(frozen=True, kw_only=True)
class AttributionSettings:
    """Numbers of the attribution of jumps to channels.

    Attributes
    ----------
    width : int
        Rows of a mean on either side of a jump, at most. Assumed.
    one_jump : int
        Jumps this near to each other are one, rows. Assumed.
    changed_sigmas, changed_range : float
        A channel changes at a jump when it moves by so many of its usual changes and by this part of its
        range. Level of significance, and assumed.
    fewest_jumps : int
        Jumps at which a channel changes to be regressed on, at least. Assumed.
    disagrees : float
        Scatters beyond which a step is not explained by the channels. Level of significance: six sigmas.
    rounds : int
        Rounds of the robust fit. Assumed: half by least absolute lengths, half by weights.
    half_weight : float
        Residuals, in scatters, that have half the weight. Assumed.
    median_length : float
        Median of the length of a vector of three components of unit variance. Derived: the root of the median
        of chi-square with three degrees of freedom.
    same_sigmas, same_size : float
        Steps belong to one unit when they agree within so many scatters, or this part of their size. Level
        of significance, and assumed: units age.
    """

    width: int = 8
    one_jump: int = 2
    changed_sigmas: float = 8.0
    changed_range: float = 0.02
    fewest_jumps: int = 3
    disagrees: float = 6.0
    rounds: int = 40
    half_weight: float = 2.0
    median_length: float = 1.5382
    same_sigmas: float = 6.0
    same_size: float = 0.05


@dataclass(frozen=True, kw_only=True)
class NamingSettings:
    """Numbers of the match of channels and units.

    Attributes
    ----------
    agreement : float
        Squared correlation of a channel's changes with a unit's switchings from which they match. Assumed:
        the unit explains half of the channel's changes.
    chance : float
        Part of the rearrangements that may agree as well. Level of significance, shared by all pairs of unit
        and channel (Bonferroni).
    rearrangements : int
        Of a channel's changes among the switchings. Derived: they resolve the level down to one in twenty
        thousand.
    fewest : int
        Switchings of a unit at least. Assumed.
    rival : float
        A channel is named after the best one when it agrees by this part of it. Assumed.
    """

    agreement: float = 0.5
    chance: float = 0.005
    rearrangements: int = 20_000
    fewest: int = 4
    rival: float = 0.9


RESIDUAL_STEP_SETTINGS = ResidualStepSettings()
ATTRIBUTION_SETTINGS = AttributionSettings()
NAMING_SETTINGS = NamingSettings()

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
    known = state[settled]
    gap = np.diff(stamps[settled]) > (np.diff(settled) + 2) * step
    change = np.diff(known) != 0
    ends = np.flatnonzero(change | gap)
    edges = np.concatenate([[-1], ends, [settled.size - 1]])
    lengths = np.diff(edges)
    real = change[ends] & ~gap[ends]
    where = ends[real]
    room = np.column_stack([lengths[:-1][real], lengths[1:][real]])
    return Switchings(settled[where], settled[where + 1], known[where], known[where + 1], room)


def steps_across(field: Floats, at: Switchings, width: int = RESIDUAL_STEP_SETTINGS.width) -> Floats:
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


def quiet_steps(field: Floats, at: Switchings, width: int = RESIDUAL_STEP_SETTINGS.width) -> Floats:
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
    """Return the width whose steps are smallest where nothing switches; the default without any such step."""
    sizes = {width: rms_of_steps(quiet_steps(field, at, width)) for width in RESIDUAL_STEP_SETTINGS.widths}
    known = {width: size for width, size in sizes.items() if np.isfinite(size)}
    return min(known, key=lambda width: known[width]) if known else RESIDUAL_STEP_SETTINGS.width


def rms_of_steps(steps: Floats) -> float:
    """Return the root mean square of a component of steps, nT; NaN where there is none."""
    known = steps[np.isfinite(steps).all(axis=1)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


@dataclass(frozen=True)
class ResidualStep:
    """Residual step at the switchings of one state, one unit or one channel.

    Attributes
    ----------
    coordinate : str
        What it is regressed on.
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
        return bool(np.any(np.abs(self.value) > RESIDUAL_STEP_SETTINGS.clear_sigmas * self.sigma))

    def sentence(self, unit: str) -> str:
        """Return the finding in words."""
        axis = int(np.argmax(np.abs(self.value) / self.sigma))
        size = f"{self.value[axis]:+.3g} ± {self.sigma[axis]:.2g} {unit} along {'xyz'[axis]}"
        return f"after the correction {size} still goes with {self.coordinate} ({self.count} switchings)"


def regress_steps(coordinate: str, steps: Floats, change: Floats) -> ResidualStep | None:
    """Return the regression of steps on a change at the same switchings; None for too few.

    Parameters
    ----------
    steps : ndarray, shape (switching, axis)
        nT.
    change : ndarray, shape (switching,)
        Of a channel, or +1, 0, -1 for a state or a unit; zero where it does not take part.

    Returns
    -------
    ResidualStep or None
        The slope through zero: where nothing changes there is no step. Its error is the sandwich of the
        scatter, each switching with its leverage (MacKinnon and White 1985).
    """
    known = np.isfinite(steps).all(axis=1) & np.isfinite(change) & (change != 0)
    x, y = change[known], steps[known]
    if x.size < RESIDUAL_STEP_SETTINGS.fewest:
        return None
    square = float(x @ x)
    value = x @ y / square
    residual = (y - x[:, None] * value) / (1.0 - x**2 / square)[:, None]
    sigma = np.sqrt(x**2 @ residual**2) / square
    return ResidualStep(coordinate, value, np.maximum(sigma, np.finfo(float).tiny), int(x.size))


def residual_steps_by_state(at: Switchings, steps: Floats) -> Iterator[ResidualStep]:
    """Yield the residual step of each state: where it begins, and with the other sign where it ends."""
    for state in np.unique(np.concatenate([at.before, at.after])):
        sign = (at.after == state).astype(float) - (at.before == state)
        name = f"state {state}" if state >= 0 else "unknown states"
        if (found := regress_steps(name, steps, sign)) is not None:
            yield found


@dataclass(frozen=True)
class JumpAttribution:
    """Jumps of a difference, and which of them changes of channels explain.

    Attributes
    ----------
    last, first : ndarray of int64, shape (switching,)
        TT2000 of the last row before it and the first one after it; where channels follow, of their changes,
        too.
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
        remaining = np.flatnonzero(~self.follows)
        out = []
        while remaining.size:
            signs = self._busiest(remaining)
            own = (self.step[remaining] * signs[:, None])[signs != 0]
            mean = np.median(own, axis=0)
            mean = mean * np.sign(mean[np.argmax(np.abs(mean))])
            spread = MAD_TO_SIGMA * np.median(np.abs(own - np.median(own, axis=0)), axis=0)
            # A median is a little less precise than a mean.
            sigma = np.maximum(spread, self.scatter) * np.sqrt(np.pi / 2.0 / len(own))
            out.append((mean, sigma, len(own)))
            remaining = remaining[signs == 0]
        return out

    def switchings_of_first(self) -> tuple[Int64, Floats]:
        """Return the places of the switchings of the first of the units, and their steps with its sign.

        Returns
        -------
        places : ndarray of int64, shape (own,)
        steps : ndarray, shape (own, axis)
            nT.
        """
        remaining = np.flatnonzero(~self.follows)
        signs = self._busiest(remaining)
        own = (self.step[remaining] * signs[:, None])[signs != 0]
        mean = np.median(own, axis=0)
        return remaining[signs != 0], own * np.sign(mean[np.argmax(np.abs(mean))])

    def _busiest(self, remaining: Int64) -> Floats:
        """Return the signs with which most of some switchings are one unit's; 0 of those that are not."""
        near = [_sign_of_same(self.step[remaining], self.step[one], self.scatter) for one in remaining]
        return max(near, key=lambda sign: int(np.count_nonzero(sign)))


def _sign_of_same(steps: Floats, one: Floats, scatter: float) -> Floats:
    """Return +1 or -1 for steps that are one step or its negative, 0 for others; (step,)."""
    limit = max(
        ATTRIBUTION_SETTINGS.same_sigmas * scatter,
        ATTRIBUTION_SETTINGS.same_size * float(np.linalg.norm(one)),
    )
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
    jumps, _ = find_jumps(difference)
    if not jumps.size:
        return None
    # Jumps that are too near to be distinguished are one, from its first to its last row.
    edges = np.flatnonzero(np.diff(jumps) > ATTRIBUTION_SETTINGS.one_jump) + 1
    first = jumps[np.concatenate([[0], edges])]
    last = jumps[np.concatenate([edges - 1, [jumps.size - 1]])]
    step, rows = _steps_at_jumps(difference, first, last)
    changes = {name: _channel_changes(channels[name], first, last, reach[name]) for name in sorted(channels)}
    names = [
        name for name, one in changes.items() if np.count_nonzero(one[0]) >= ATTRIBUTION_SETTINGS.fewest_jumps
    ]
    used = [changes[name] for name in names]
    change = np.stack([one[0] for one in used], axis=1) if used else np.zeros((first.size, 0))
    white = np.sqrt(np.trace(white_covariance(difference)) / 3.0)
    # A step's own noise at least: where all steps agree by chance there is no smaller scatter.
    least = float(white * np.sqrt(2.0 / np.median(rows)))
    residual, scatter = _robust_residuals(step, change, np.array([one[1] for one in used]), least)
    follows = np.linalg.norm(residual, axis=1) <= ATTRIBUTION_SETTINGS.disagrees * scatter
    spread = 1 + max((reach[name] for name in names), default=0) * follows
    before, after = np.maximum(first - spread, 0), np.minimum(last + spread - 1, stamps.size - 1)
    return JumpAttribution(stamps[before], stamps[after], follows, residual, float(np.median(scatter)))


def _steps_at_jumps(values: Floats, first: Rows, last: Rows) -> tuple[Floats, Floats]:
    """Return mean after less mean before, the rows next to a jump left out, and the rows of the shorter."""
    ends = np.concatenate([[0], last + 1])[:-1]
    begins = np.concatenate([first, [len(values)]])[1:]
    step, rows = np.zeros((first.size, values.shape[1])), np.ones(first.size)
    for one in range(first.size):
        low, high = max(int(first[one]) - 1, 1), min(int(last[one]) + 1, len(values) - 1)
        before = values[max(int(ends[one]), low - ATTRIBUTION_SETTINGS.width, 0) : low]
        after = values[high : min(int(begins[one]), high + ATTRIBUTION_SETTINGS.width)]
        before = before if len(before) else values[low - 1 : low]
        after = after if len(after) else values[high : high + 1]
        step[one] = after.mean(axis=0) - before.mean(axis=0)
        rows[one] = min(len(before), len(after))
    return step, rows


def _channel_changes(values: Floats, first: Rows, last: Rows, reach: int) -> tuple[Floats, float]:
    """Return the change of a channel across each jump, 0 where it is no more than elsewhere or unknown.

    With it comes the size of its usual change, one sigma.
    """
    top = values.size - 1
    change = values[np.minimum(last + reach, top)] - values[np.maximum(first - 1 - reach, 0)]
    known = values[np.isfinite(values)]
    width = int(np.median(last - first)) + 1 + 2 * reach
    if known.size < 2 * width + 2:
        return np.zeros(first.size), 0.0
    usual = MAD_TO_SIGMA * float(np.median(np.abs(known[width:] - known[:-width])))
    limit = max(
        ATTRIBUTION_SETTINGS.changed_sigmas * usual, ATTRIBUTION_SETTINGS.changed_range * float(np.ptp(known))
    )
    return np.where(np.isfinite(change) & (np.abs(change) > limit), change, 0.0), usual


def _robust_residuals(step: Floats, change: Floats, usual: Floats, least: float) -> tuple[Floats, Floats]:
    """Return residuals of steps after the changes of channels (robust fit), and the scatter of each.

    Parameters
    ----------
    step : ndarray, shape (jump, axis)
    change : ndarray, shape (jump, channel)
    usual : ndarray, shape (channel,)
        Noise of such a change.
    least : float
        Scatter of a component at least, nT.
    """
    changes: npt.NDArray[np.bool_] = np.asarray((change != 0).any(axis=1))
    alone = np.full(len(step), least)
    if np.count_nonzero(changes) <= change.shape[1]:
        return step, alone
    x, y = change[changes] / np.abs(change).max(axis=0), step[changes]
    weight, scatter, slope = np.ones(len(x)), least, np.zeros((x.shape[1], 3))
    for number in range(ATTRIBUTION_SETTINGS.rounds):
        slope = np.linalg.lstsq(x * weight[:, None], y * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(y - x @ slope, axis=1)
        scatter = max(float(np.median(size)) / ATTRIBUTION_SETTINGS.median_length, least)
        # Least absolute lengths first, which no start misleads; then what lies near.
        root = (
            size / scatter
            if number < ATTRIBUTION_SETTINGS.rounds // 2
            else 1.0 + (size / (ATTRIBUTION_SETTINGS.half_weight * scatter)) ** 2
        )
        weight = 1.0 / np.sqrt(np.maximum(root, 1e-2))
    residual = step.copy()
    residual[changes] = y - x @ slope
    # A channel's own noise, in nT, is part of the residual where it changes.
    of_channel = usual / np.abs(change).max(axis=0) * np.linalg.norm(slope, axis=1)
    noise = np.sqrt(scatter**2 + ((change != 0) @ of_channel**2) / 3.0)
    return residual, np.where(changes, noise, alone)


@dataclass(frozen=True, kw_only=True)
class UnitChannels:
    """A unit and the channels that switch with it.

    Attributes
    ----------
    unit : int
    switchings : int
        How often it was seen to switch.
    channels : tuple of str
        The best first; more than one when these cannot be distinguished, none without housekeeping.
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


def match_channels_to_units(
    signs: Floats, changes: Mapping[str, Floats], *, seed: int = 0
) -> list[UnitChannels]:
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
    list of UnitChannels
        A channel is named when it explains at least half of a unit's switchings and hardly any
        rearrangement of its changes among the switchings does as well; the level is shared by all pairs
        of unit and channel (Bonferroni).
    """
    random = np.random.default_rng(seed)
    # A level below one over the number of rearrangements cannot be shown.
    pairs = min(
        max(1, signs.shape[1] * len(changes)),
        round(NAMING_SETTINGS.chance * NAMING_SETTINGS.rearrangements / 2.0),
    )
    return [
        _named(unit, signs[:, unit], changes, NAMING_SETTINGS.chance / pairs, random)
        for unit in range(signs.shape[1])
    ]


def _named(
    unit: int, sign: Floats, changes: Mapping[str, Floats], level: float, random: np.random.Generator
) -> UnitChannels:
    """Return the channels of one unit, or why none is named."""
    count = int(np.count_nonzero(sign))
    nameless = UnitChannels(unit=unit, switchings=count, channels=(), agreement=(), per_unit=())
    if count < NAMING_SETTINGS.fewest:
        too_few = f"it was seen to switch {count} times, at least {NAMING_SETTINGS.fewest} needed"
        return replace(nameless, reason=too_few)
    if not changes:
        return replace(nameless, reason="there is no housekeeping at its switchings")
    found = []
    for name, change in changes.items():
        known = np.isfinite(change)
        if np.count_nonzero(sign[known]) < NAMING_SETTINGS.fewest:
            continue
        on, by = sign[known], change[known]
        # The squared correlation through zero, and the change for one switching on.
        squares, product = float(by @ by) * float(on @ on), float(on @ by)
        agreement = product**2 / squares if squares > 0 else 0.0
        if agreement < NAMING_SETTINGS.agreement:
            continue
        # The chance that the same changes, at the switchings in another order, agree as well.
        rearranged = random.permuted(np.broadcast_to(by, (NAMING_SETTINGS.rearrangements, by.size)), axis=1)
        better = np.count_nonzero((rearranged @ on) ** 2 / squares >= agreement * (1.0 - 1e-9))
        if (better + 1) / (NAMING_SETTINGS.rearrangements + 1) <= level:
            found.append((agreement, name, product / float(on @ on)))
    if not found:
        return replace(nameless, reason="no channel changes when it switches")
    found.sort(reverse=True)
    near = [one for one in found if one[0] >= NAMING_SETTINGS.rival * found[0][0]]
    agreements, names, per_units = zip(*near, strict=True)
    return replace(nameless, channels=names, agreement=agreements, per_unit=per_units)
