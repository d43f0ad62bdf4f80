"""Effects bound to a time: steps of a sensor's parameters, a bias or a clock, episodes, and slow drifts.

Takes Gram blocks and the library's columns that may change in time (`time_variable_columns`); makes `Change`
candidates. They need no columns of their own in the pass: a parameter that changes from block to block is its
column times a function of the block.

`Stretches` is a filter of rows. Where something nobody recorded switches, every stretch between two
switchings has a level of its own: the mean of each stretch is taken off rows and columns. What is fitted
then rests on how the residual changes within the stretches, and nothing that switches at their edges can
pass for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.design import Library
from inflight.effects import Affine, ScalarBias, TimeShift, VectorSensor
from inflight.lsq import GramBlocks
from inflight.model import TimeDependence
from inflight.time import DAY, Int64, to_utc

#: Kinds of drifts.
DRIFTS = ("scale_drift", "offset_drift", "angle_drift", "clock_drift", "bias_drift")


@dataclass(frozen=True, kw_only=True)
class ChangeSettings:
    """Which changes in time are tried.

    Attributes
    ----------
    edges : int
        Block edges at which steps are tried, at most: a bound on time, assumed.
    episodes : int
        Episodes that are scored in full, of those a scan over all pairs of edges finds best; assumed.
    longest : int
        An episode lasts no more than one part in so many of the blocks: more of them is the rule.
    batch_columns : int
        Columns scored together: a bound on memory, for products of two changes are never needed.
    rounding : float
        Part of a constant's size below which what is left of it is rounding.
    """

    edges: int = 48
    episodes: int = 3
    longest: int = 2
    batch_columns: int = 144
    rounding: float = 1e-12


CHANGE_SETTINGS = ChangeSettings()


@dataclass(frozen=True)
class Change:
    """A candidate bound to a time.

    Attributes
    ----------
    name, mechanism, family : str
        As in `Candidate`.
    functions : dict of str to (str, ndarray)
        New column -> (column of the library, factor of each block); none when it has columns of its own.
    at : tuple of int
        When it begins, and ends when it does, TT2000; empty for drifts.
    unit : str
        What the coefficient is multiplied by, such as ``/d``.
    sharpness : int
        How far off the times of `at` may be, ns: blocks are no finer. Of a time that was refined among the
        rows, its standard deviation.
    windows : int
        Blocks of a window, of a parameter that has a value in the middle of each; else 0.
    """

    name: str
    mechanism: str
    family: str
    functions: Mapping[str, tuple[str, Floats]]
    at: tuple[int, ...] = ()
    unit: str = ""
    sharpness: int = 0
    windows: int = 0

    @property
    def interleaved(self) -> bool:
        """True when blocks around those held out must be among the fitted: a value holds in few blocks."""
        return len(self.at) == 2 or self.windows > 0

    def is_like(self, other: Change) -> bool:
        """Return True for the same change at times that blocks cannot separate."""
        return self.mechanism == other.mechanism and self.is_when(other)

    def is_when(self, other: Change) -> bool:
        """Return True for changes of anything at times that blocks cannot separate."""
        if len(self.at) != len(other.at) or not self.at:
            return False
        return all(
            abs(a - b) <= self.sharpness + other.sharpness for a, b in zip(self.at, other.at, strict=True)
        )


@dataclass(frozen=True)
class TimeVariableColumns:
    """Columns of the library that may change in time; empty where there are none."""

    offset: tuple[str, ...] = ()
    scale: tuple[str, ...] = ()
    clock: tuple[str, ...] = ()
    bias: tuple[str, ...] = ()
    angle: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """All of them."""
        return [*self.offset, *self.scale, *self.angle, *self.clock, *self.bias]

    @property
    def kinds(self) -> dict[str, tuple[str, tuple[str, ...]]]:
        """What may change at a time: kind -> (family, columns), without those that have no column."""
        every = {
            "offset": ("offset_step", self.offset),
            "scale": ("sensor", self.scale),
            "angle": ("sensor", self.angle),
            "bias": ("bias", self.bias),
            "clock": ("clock", self.clock),
        }
        return {kind: found for kind, found in every.items() if found[1]}

    def outside(self, base: Sequence[str]) -> TimeVariableColumns:
        """Return those of clock and bias that no calibration marginalises: their episodes can be seen."""
        clock = tuple(name for name in self.clock if name not in base)
        return TimeVariableColumns(clock=clock, bias=tuple(name for name in self.bias if name not in base))


def block_length(grams: GramBlocks) -> int:
    """Return the usual length of a block, ns."""
    return int(np.median(grams.end - grams.start))


def lines_between_windows(grams: GramBlocks, blocks: int) -> TimeDependence:
    """Return lines between values at the middles of windows of so many blocks, of those that have rows."""
    block = block_length(grams)
    place = (grams.start - grams.start[0] + block // 2) // (blocks * block)
    middles = [
        int(grams.start[inside[0]] // 2 + grams.end[inside[-1]] // 2)
        for one in np.unique(place[grams.count > 0])
        if (inside := np.flatnonzero((place == one) & (grams.count > 0))).size
    ]
    return TimeDependence("spline", at=tuple(middles), interpolation="linear")


def time_text(when: int) -> str:
    """Return a time, TT2000, as names have it: UTC, no finer than it is."""
    text = str(to_utc(when).astype("datetime64[ns]"))
    whole, _, part = text.partition(".")
    return f"{whole}.{part.rstrip('0')}".rstrip(".")


def drifts(grams: GramBlocks, changing: TimeVariableColumns) -> list[Change]:
    """Return drifts of everything that may drift, linear in time; factors in days from the middle."""
    middle = grams.start / 2 + grams.end / 2
    days = (middle - middle.mean()) / DAY
    found = []
    for name in DRIFTS:
        columns = getattr(changing, name.removesuffix("_drift"))
        if columns and np.ptp(days) > 0:
            functions = {f"{name}.{column}": (column, days) for column in columns}
            family = name.removesuffix("_drift") if name in ("clock_drift", "bias_drift") else "ageing"
            found.append(Change(name, name, family, functions, unit="/d"))
    return found


def steps(grams: GramBlocks, changing: TimeVariableColumns) -> list[Change]:
    """Return steps of every kind at the edges between blocks."""
    found = []
    blocks = len(grams)
    places = np.linspace(1, blocks - 1, min(CHANGE_SETTINGS.edges, blocks - 1)) if blocks > 3 else np.zeros(0)
    edges = [int(place) for place in np.unique(places.round())]
    starts = [*grams.start.tolist(), int(grams.end[-1])]
    for before, edge, behind in zip([0, *edges], edges, [*edges[1:], blocks], strict=False):
        after = (np.arange(len(grams)) >= edge).astype(np.float64)
        when = starts[edge]
        # A step may be a block away from the edge tried, or half way to the next edge tried.
        block = max(when - starts[edge - 1], starts[edge + 1] - when)
        sharp = max(block, max(when - starts[before], starts[behind] - when) // 2)
        for name, (family, columns) in changing.kinds.items():
            label = f"{name}_step@{to_utc(when).astype('datetime64[s]')}"
            functions = {f"{label}.{column}": (column, after) for column in columns}
            found.append(Change(label, f"{name}_step", family, functions, (when,), sharpness=sharp))
    return found


def batch_changes(changes: Sequence[Change]) -> Iterator[list[Change]]:
    """Yield changes some at a time, those of a batch held out in the same way."""
    for interleaved in (False, True):
        batch: list[Change] = []
        columns = 0
        for change in (one for one in changes if one.interleaved is interleaved):
            batch.append(change)
            columns += len(change.functions)
            if columns >= CHANGE_SETTINGS.batch_columns:
                yield batch
                batch, columns = [], 0
        if batch:
            yield batch


def episodes(
    grams: GramBlocks, marginalised: GramBlocks, changing: TimeVariableColumns, y: int
) -> list[Change]:
    """Return the best episodes of clock and bias, found by a scan over all pairs of edges.

    Parameters
    ----------
    grams, marginalised : GramBlocks
        Before and after the calibration was marginalised; the scan takes blocks as independent.
    """
    found = []
    lengths = np.diff([*grams.start.tolist(), int(grams.end[-1])])
    for name, (family, columns) in changing.kinds.items():
        if len(columns) != 1 or len(grams) < 6:
            continue
        column = int(marginalised.index(columns)[0])
        score = marginalised.rows(columns)[:, 0, y]
        for first, last in _best_spans(score, marginalised.squares[:, column]):
            inside = np.zeros(len(grams))
            inside[first:last] = 1.0
            when: tuple[int, ...] = (int(grams.start[first]), int(grams.end[last - 1]))
            sharp = int(lengths[max(first - 1, 0) : last + 1].max())
            kind = "episode"
            if first == 0 or last == len(grams):
                # What lasts to the end of the record, or from its beginning, is a step.
                kind, when = "step", when[1:] if first == 0 else when[:1]
                inside = (grams.start >= when[0]).astype(np.float64)
            label = f"{name}_{kind}@{'/'.join(str(to_utc(one).astype('datetime64[s]')) for one in when)}"
            functions = {f"{label}.{columns[0]}": (columns[0], inside)}
            found.append(Change(label, f"{name}_{kind}", family, functions, when, sharpness=sharp))
    return found


def _best_spans(score: Floats, information: Floats) -> list[tuple[int, int]]:
    """Return the spans of blocks that explain most by one value of their own, best first."""
    s, m = (np.concatenate([[0.0], np.cumsum(part)]) for part in (score, information))
    first, last = np.triu_indices(len(s), 1)
    # Against the value of all blocks together: a constant is no episode.
    own_s, own_m = s[last] - s[first], m[last] - m[first]
    rest_s, rest_m = s[-1] - own_s, m[-1] - own_m
    usable = (own_m > 0) & (rest_m > 0) & (last - first <= (len(s) - 1) // CHANGE_SETTINGS.longest)
    gain = np.zeros(first.size)
    gain[usable] = (
        own_s[usable] ** 2 / own_m[usable]
        + rest_s[usable] ** 2 / rest_m[usable]
        - s[-1] ** 2 / max(m[-1], 1e-300)
    )
    order = np.argsort(-gain)
    chosen: list[tuple[int, int]] = []
    for place in order:
        span = (int(first[place]), int(last[place]))
        if all(span[1] <= other[0] or span[0] >= other[1] for other in chosen):
            chosen.append(span)
        if len(chosen) == CHANGE_SETTINGS.episodes:
            break
    return chosen


def time_variable_columns(library: Library) -> TimeVariableColumns:
    """Return the library's columns that may change in time."""

    def columns(kind: type, parameter: str) -> tuple[str, ...]:
        for term in library.all_terms:
            if isinstance(term.entry.effect, kind) and parameter in term.parameters:
                return tuple(name for name in term.columns if f".{parameter}" in name)
        return ()

    return TimeVariableColumns(
        offset=columns(VectorSensor, "offset") or columns(Affine, "shift"),
        scale=columns(VectorSensor, "scale_factor"),
        clock=columns(TimeShift, "seconds"),
        bias=columns(ScalarBias, "bias"),
        angle=columns(VectorSensor, "misalignment"),
    )


@dataclass(frozen=True)
class Stretches:
    """A filter of rows: the mean of each stretch is taken off.

    Attributes
    ----------
    edges : tuple of int
        TT2000 at which a stretch ends and the next begins.
    lost : tuple of (int, int)
        Closed TT2000 spans that are in no stretch: something switches there.
    """

    edges: tuple[int, ...]
    lost: tuple[tuple[int, int], ...]

    def is_lost(self, stamps: Int64) -> npt.NDArray[np.bool_]:
        """Return which rows are in no stretch; (time,)."""
        out = np.zeros(stamps.size, dtype=bool)
        for low, high in self.lost:
            begin, end = np.searchsorted(stamps, [low, high + 1])
            out[begin:end] = True
        return out

    def keep(self, values: Floats, stamps: Int64, good: npt.NDArray[np.bool_]) -> Floats:
        """Return values (time, ...) less the mean of their stretch; NaN where they are not good."""
        flat = values.reshape(len(values), -1)
        out = np.full(flat.shape, np.nan)
        used = good & ~self.is_lost(stamps)
        kept = flat[used]
        place = np.searchsorted(np.asarray(self.edges, dtype=np.int64), stamps[used], side="right")
        begins = np.flatnonzero(np.diff(place, prepend=-1))
        if begins.size:
            count = np.diff(np.append(begins, len(kept)))
            mean = np.add.reduceat(kept, begins, axis=0) / count[:, None]
            moved = kept - np.repeat(mean, count, axis=0)
            # A constant leaves nothing, not its rounding: no value can be had of it.
            moved[np.abs(moved) <= CHANGE_SETTINGS.rounding * np.repeat(np.abs(mean), count, axis=0)] = 0.0
            out[used] = moved
        return out.reshape(values.shape)
