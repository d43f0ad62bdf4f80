"""What the tests of plumbing read, channels of some days at their own stamps, and how residuals are compared.

A `Record` is one channel, a `Survey` all of a comparison's. `typical_squares` makes of a residual one number
a block, `choose` asks which of several explanations agrees best with the data, and whether by more than the
scatter between blocks.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from inflight.arrays import Floats
from inflight.instruments import Channel
from inflight.mission import Mission
from inflight.time import GAP, Int64


@dataclass(frozen=True, kw_only=True)
class PlumbingSettings:
    """When a fault of plumbing is told, and what is tried.

    Attributes
    ----------
    chance : float
        Records without a fault in which one is told, by all explanations of one question together; stated.
    part_left : float
        A fault is told when mending it leaves at most this part of the typical residual: what takes off less
        is left to the search, and averaging two readings cannot take off so much; assumed.
    days : int
        Days that are read, evenly spread over the record; a bound on time.
    part_left_by_model : float
        The same of a channel judged by the model's coefficients; assumed.
    rows : int
        Rows of a question about fields at most; a bound on time.
    blocks, least_rows, least_blocks : int
        Blocks a record is divided into, as many as a search has; rows of each, and blocks that two
        explanations must have in common, at least; assumed.
    unit_tolerance : float
        Part by which gains and offsets may keep a ratio of two fields from a power of ten; assumed.
    seconds : int
        Whole seconds of a clock that are tried: TT is ahead of UTC by less than so many.
    half_hours : int
        Half hours that are tried: time zones reach 14 hours.
    whole : float
        A clock is told to be off by whole seconds, or half hours, when it is within so many seconds of these:
        the rest is a small shift, which the effect ``time_shift`` finds; assumed.
    main_field_radii : float
        The main field alone describes what is measured up to so many Earth radii; assumed.
    earth_temperatures : tuple of float
        Temperatures of units aboard, degC; assumed.
    longer : float
        A run of one number is stale when it is so many times as long as the channel's others; assumed.
    stale_runs : int
        The longest of the others, but for so many of them, is the usual length; assumed.
    least_runs : int
        A channel of fewer runs than so many has no usual length; assumed.
    """

    chance: float = 1e-4
    part_left: float = 0.5
    part_left_by_model: float = 0.3
    days: int = 4
    rows: int = 4000
    blocks: int = 96
    least_rows: int = 12
    least_blocks: int = 24
    unit_tolerance: float = 0.1
    seconds: int = 70
    half_hours: int = 28
    whole: float = 0.25
    main_field_radii: float = 1.5
    earth_temperatures: tuple[float, float] = (-150.0, 150.0)
    longer: float = 20.0
    stale_runs: int = 8
    least_runs: int = 100


PLUMBING_SETTINGS = PlumbingSettings()


@dataclass(frozen=True, kw_only=True)
class Record:
    """One channel of an instrument on some days.

    Attributes
    ----------
    name : str
        In samples: a role for a field, else the channel's name.
    instrument, channel : str
        In the mission YAML.
    entry : Channel
        Its entry there.
    cadence_ns : int
    stamps : ndarray of int64, shape (time,)
        TT2000.
    values : ndarray, shape (time,) or (time, axis)
        As archived, in the channel's unit; NaN where missing.
    """

    name: str
    instrument: str
    channel: str
    entry: Channel
    cadence_ns: int
    stamps: Int64
    values: Floats

    def at(self, stamps: Int64) -> Floats:
        """Return the values at other stamps, linear between readings at most a cadence and a half apart."""
        after = np.clip(np.searchsorted(self.stamps, stamps), 1, self.stamps.size - 1)
        low, high = self.stamps[after - 1], self.stamps[after]
        share = np.where(high > low, (stamps - low) / np.maximum(high - low, 1), 0.0)
        inside = (stamps >= low) & (stamps <= high)
        known = inside & ((high - low <= GAP * self.cadence_ns) | (share == 0.0) | (share == 1.0))
        share = share.reshape(-1, *[1] * (self.values.ndim - 1))
        before, behind = self.values[after - 1], self.values[after]
        # Where a stamp is met, the reading beside it has no say.
        found = np.where(
            share == 0.0, before, np.where(share == 1.0, behind, before + share * (behind - before))
        )
        found[~known] = np.nan
        return np.asarray(found)

    def thinned(self, rows: int) -> Int64:
        """Return at most so many of the stamps with a reading, evenly spread."""
        flat = self.values.reshape(len(self.values), -1)
        known = self.stamps[np.isfinite(flat).all(axis=1)]
        return known[:: max(1, -(-known.size // rows))]

    @property
    def kind(self) -> str:
        """Kind in the mission YAML."""
        return self.entry.kind


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What a comparison is made from, on some days.

    Attributes
    ----------
    mission : Mission
    comparison : str
    fields : mapping of str to Record
        By role: vector and scalar, or inboard and outboard.
    channels : mapping of str to Record
        All other channels, by name in samples.
    """

    mission: Mission
    comparison: str
    fields: Mapping[str, Record]
    channels: Mapping[str, Record] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Kind of the comparison."""
        return self.mission.comparisons[self.comparison].kind

    @property
    def records(self) -> list[Record]:
        """Fields and channels."""
        return [*self.fields.values(), *self.channels.values()]

    def of_kind(self, kind: str, frames: tuple[str, ...]) -> Record | None:
        """Return the first channel of a kind in one of some frames."""
        found = (one for one in self.channels.values() if one.kind == kind and one.entry.frame in frames)
        return next(found, None)


def typical_squares(residual: Floats) -> Floats:
    """Return the typical square of a residual in consecutive blocks; NaN for one of too few rows; (block,).

    By the median of the squares, whatever a few outliers read.

    Parameters
    ----------
    residual : ndarray, shape (row,) or (row, axis)
        In order of time; NaN where missing.
    """
    blocks = PLUMBING_SETTINGS.blocks
    size = np.abs(residual) if residual.ndim == 1 else np.linalg.norm(residual, axis=1)
    each = size.size // blocks
    if each < PLUMBING_SETTINGS.least_rows:
        return np.full(blocks, np.nan)
    # Missing rows are sorted to the end of their block.
    ranked = np.sort(size[: each * blocks].reshape(blocks, each), axis=1)
    count = np.isfinite(ranked).sum(axis=1)
    place, row = np.maximum(count - 1, 0), np.arange(blocks)
    middle = 0.5 * (ranked[row, place // 2] + ranked[row, (place + 1) // 2])
    # A normal deviate's square has the median 0.455.
    squares = middle**2 / 0.455 + np.finfo(float).tiny
    return np.where(count >= PLUMBING_SETTINGS.least_rows, squares, np.nan)


def gains(worse: Floats, better: Floats) -> Floats:
    """Return the logarithms by which blocks agree better, of those that both have; empty of too few."""
    found = np.log(worse) - np.log(better)
    found = found[np.isfinite(found)]
    return np.asarray(found if found.size >= PLUMBING_SETTINGS.least_blocks else found[:0])


def mean_gain(worse: Floats, better: Floats) -> float:
    """Return the mean of `gains`; that of something infinitely worse when there is none."""
    found = gains(worse, better)
    return float(np.mean(found)) if found.size else -np.inf


def chance_of(worse: Floats, better: Floats) -> float:
    """Return how likely blocks agree so much better by chance, one-sided.

    Were both as good, the logarithm of each block's ratio would be as likely negative: Chernoff's bound of
    the sum with random signs. Blocks without information neither add to it nor take from it.
    """
    gain = gains(worse, better)
    total, size = float(np.sum(gain)), float(np.max(np.abs(gain), initial=0.0))
    if total <= 0 or size <= 1e-9:
        return 1.0
    slopes = np.geomspace(1e-3, 1e3, 60)[:, None] / size
    # log(cosh) without overflow.
    steps = np.abs(slopes * gain)
    bound = np.sum(steps + np.log1p(np.exp(-2.0 * steps)) - np.log(2.0), axis=1) - slopes[:, 0] * total
    return float(np.exp(min(0.0, float(bound.min()))))


Name = TypeVar("Name", bound=Hashable)


@dataclass(frozen=True)
class Choice(Generic[Name]):
    """An explanation that agrees with the data far better than what the mission states.

    Attributes
    ----------
    name : hashable
        Of the best one.
    rivals : tuple
        Names of those that explain as well.
    before, after : float
        Typical residual as stated and under it.
    p : float
        Chance of agreeing so much better, for as many explanations as were tried.
    """

    name: Name
    rivals: tuple[Name, ...]
    before: float
    after: float
    p: float
    blocks: int

    @property
    def how_sure(self) -> str:
        """The statement in words."""
        rivals = f", and {len(self.rivals)} other explanation" + ("s" if len(self.rivals) > 1 else "")
        return (
            f"the typical residual falls from {self.before:.3g} to {self.after:.3g} nT in {self.blocks} "
            f"blocks of the record (chance {chance_text(self.p)}{rivals + ' as good' if self.rivals else ''})"
        )


def choose(
    stated: Floats, trials: Mapping[Name, Floats], part_left: float = PLUMBING_SETTINGS.part_left
) -> Choice[Name] | None:
    """Return the explanation that agrees best, when that is beyond chance and not a small matter.

    Parameters
    ----------
    stated : ndarray, shape (block,)
        Typical squares as the mission states it.
    trials : mapping
        Those under each explanation.
    part_left : float
        Part of the typical residual that it may leave.
    """
    settings = PLUMBING_SETTINGS
    gain = {name: mean_gain(stated, squares) for name, squares in trials.items()}
    best = max(gain, key=lambda name: gain[name], default=None)
    if best is None:
        return None
    both = np.isfinite(stated) & np.isfinite(trials[best])
    p = min(1.0, chance_of(stated, trials[best]) * len(trials))
    if p > settings.chance:
        return None
    before, after = (float(np.sqrt(np.mean(squares[both]))) for squares in (stated, trials[best]))
    if after > part_left * before:
        return None
    level = settings.chance / len(trials)
    rivals = [
        name
        for name, squares in trials.items()
        if name != best and gain[name] > 0 and chance_of(squares, trials[best]) > level
    ]
    rivals.sort(key=lambda name: -gain[name])
    return Choice(best, tuple(rivals), before, after, p, int(both.sum()))


def chance_text(p: float) -> str:
    """Return a chance in words."""
    return f"{p:.0e}" if p > 1e-12 else "below 1e-12"


def plain(value: Any) -> str:
    """Return a number as a YAML has it."""
    return f"{value:.10g}"
