"""Sub-intervals of a record: blocks of whole spins, and which are left out and why.

Takes: readings, unwrapped spin phase and times of a record, with the spans that no estimate may use. Makes
(`cut_into_blocks`): `BlockLayout`, the samples of every block, the good ones, and the reasons for what is
left out. A sub-interval is a run of blocks, so that neighbours overlap by whole blocks and sums over blocks
are made once (Plaschke et al. 2019, section 5.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError, TooLittleError
from inflight.time import Int64

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class BlockSettings:
    """Numbers of the blocks of a record.

    Attributes
    ----------
    widest_step : float
        Samples further apart than this do not show the tone at twice the spin between them, rad. Derived.
    jump : float
        A phase that leaves a steady turn by more than this between two samples has jumped, rad. Derived: a
        twentieth of a turn costs one part in twenty of the second harmonic.
    fewest_spins : int
        At least this many whole spins make a block: neighbouring frequencies must keep apart. Assumed.
    """

    widest_step: float = 0.5 * np.pi
    jump: float = 0.1 * np.pi
    fewest_spins: int = 10


BLOCK_SETTINGS = BlockSettings()


@dataclass(frozen=True)
class Exclusion:
    """A span [start, end) of TT2000 that no estimate may use: eclipse, manoeuvre, relaxation after either."""

    start: int
    end: int
    reason: str


@dataclass(frozen=True)
class SubIntervals:
    """Settings of the sub-intervals: how a record is cut and what a sub-interval must have.

    Attributes
    ----------
    spins : int
        Spins of a sub-interval; 100 in Plaschke et al. (2019).
    overlap : float
        Part shared with the next one: 0, 1/2, 2/3, 3/4, ... Assumed; the paper's sub-intervals overlap, too.
    filled : float
        Least part of the spins that good samples cover. Assumed.
    saturation : float
        A sub-interval with a reading beyond this is left out, nT; the instrument's range (2e4 nT for THEMIS,
        Plaschke et al. 2019, section 5).
    neighbours : tuple of 2 floats
        Distances from the tones, in spin frequencies, at which natural fluctuations are measured: over whole
        sub-intervals (85, 115, 185, 215 % as published) and in each block alone.
    """

    spins: int = 100
    overlap: float = 0.5
    filled: float = 0.8
    saturation: float = 2e4
    neighbours: tuple[float, float] = (0.15, 0.10)

    def __post_init__(self) -> None:
        blocks = 1.0 / (1.0 - self.overlap) if 0.0 <= self.overlap < 1.0 else 0.0
        if abs(blocks - round(blocks)) > 1e-3 or round(blocks) < 1 or self.spins % max(round(blocks), 1):
            raise CalibrationError(
                f"overlap {self.overlap} cuts {self.spins} spins into parts that are not whole",
                remedy="take 0, 0.5, 2/3 or 0.75 and a number of spins that divides",
            )
        nearest = min(self.neighbours) * self.spins / round(blocks)
        if self.spins // round(blocks) < BLOCK_SETTINGS.fewest_spins or nearest < 1.0:
            raise CalibrationError(
                f"{self.spins // round(blocks)} spins a block with neighbours {nearest:.2g} turns away: "
                f"at least {BLOCK_SETTINGS.fewest_spins} spins and 1 turn needed",
                remedy="take longer sub-intervals, less overlap or neighbours further away",
            )

    @property
    def blocks(self) -> int:
        """Blocks of a sub-interval."""
        return round(1.0 / (1.0 - self.overlap))

    @property
    def distances(self) -> tuple[float, float]:
        """`neighbours` where tones leak nothing: whole turns over a sub-interval and over a block."""
        whole, part = float(self.spins), float(self.spins // self.blocks)
        return round(self.neighbours[0] * whole) / whole, round(self.neighbours[1] * part) / part

    @property
    def turn(self) -> float:
        """Phase of a block, rad."""
        return 2.0 * np.pi * (self.spins // self.blocks)


@dataclass(frozen=True)
class BlockLayout:
    """Blocks of a record as ranges of samples, and samples and blocks that are of no use.

    Attributes
    ----------
    start, stop : ndarray of int64, shape (block,)
        Samples of each block, half-open; none in a gap.
    good : ndarray of bool, shape (time,)
    reasons : tuple of (str, ndarray of bool of shape (block,))
        Why blocks are left out.
    settings : SubIntervals
    """

    start: Int64
    stop: Int64
    good: Bools
    reasons: tuple[tuple[str, Bools], ...]
    settings: SubIntervals

    @property
    def count(self) -> int:
        """Number of sub-intervals."""
        return max(self.start.size - self.settings.blocks + 1, 0)

    def excluded(self) -> tuple[tuple[str, Bools], ...]:
        """Return the reasons with the sub-intervals they hit: one bad block is enough."""
        return tuple((name, np.asarray(self.over_blocks(hit).any(axis=1))) for name, hit in self.reasons)

    def over_blocks(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return a view (sub-interval, block of it, ...) of something by block."""
        view = np.lib.stride_tricks.sliding_window_view(values, self.settings.blocks, axis=0)
        return np.moveaxis(view, -1, 1)


def cut_into_blocks(
    readings: Floats,
    phase: Floats,
    stamps: Int64,
    good: Bools | None = None,
    settings: SubIntervals | None = None,
    exclusions: Sequence[Exclusion] = (),
) -> BlockLayout:
    """Cut a record into blocks of whole spins.

    Parameters
    ----------
    readings : ndarray, shape (time, 3)
        Temperature-corrected, sensor axes, nT; NaN where missing.
    phase : ndarray, shape (time,)
        Unwrapped spin phase, rad; NaN where it is not to be trusted.
    stamps : ndarray of int64, shape (time,)
        TT2000, rising.
    good : ndarray of bool, shape (time,), optional
        False for samples that flags forbid.
    settings : SubIntervals, optional
    exclusions : sequence of Exclusion

    Raises
    ------
    SamplesError
        Shapes that differ, or times that do not rise.
    TooLittleError
        Less than one sub-interval of usable phase.
    """
    settings = settings or SubIntervals()
    if readings.shape != (stamps.size, 3) or phase.shape != stamps.shape:
        raise SamplesError(
            f"readings have shape {readings.shape}, phase {phase.shape}, times {stamps.shape}",
            remedy="give (time, 3), (time,) and (time,)",
        )
    if stamps.size > 1 and np.any(stamps[1:] <= stamps[:-1]):
        raise SamplesError("times do not rise", remedy="sort them and drop duplicates")
    usable = np.isfinite(phase)
    for axis in range(3):
        usable &= np.isfinite(readings[:, axis])
    if good is not None:
        usable &= good
    known = phase if np.isfinite(phase).all() else np.fmax.accumulate(phase)
    edges = _edges(known, settings)
    # Samples before the first known phase lie before the first block.
    known = np.where(np.isnan(known), -np.inf, known)
    bounds = np.searchsorted(np.maximum.accumulate(known), edges)
    start, stop = bounds[:-1].astype(np.int64), bounds[1:].astype(np.int64)
    beyond = (readings > settings.saturation) | (readings < -settings.saturation)
    within = np.flatnonzero(beyond.any(axis=1)) if beyond.any() else np.empty(0, dtype=np.int64)
    reasons = [
        ("saturated", _blocks_of(within, bounds)),
        ("phase jump", _blocks_of(_jumps(phase, stamps), bounds)),
    ]
    for one in exclusions:
        low, high = np.searchsorted(stamps, [one.start, one.end])
        reasons.append((one.reason, (start < high) & (stop > low)))
    together: dict[str, Bools] = {}
    for name, hit in reasons:
        together[name] = together.get(name, np.zeros_like(hit)) | hit
    return BlockLayout(start, stop, usable, tuple(together.items()), settings)


def _edges(phase: Floats, settings: SubIntervals) -> Floats:
    """Return the phases at which blocks begin and end."""
    known = phase[np.isfinite(phase)]
    turns = float(known.max() - known.min()) if known.size else 0.0
    # The last spin may lack its last sample.
    blocks = int((turns + BLOCK_SETTINGS.widest_step) // settings.turn)
    if blocks < settings.blocks:
        raise TooLittleError(
            f"{turns / (2.0 * np.pi):.1f} spins of known phase found, {settings.spins} needed",
            remedy="take a longer span, or sub-intervals of fewer spins",
        )
    # Half a step before the samples: those that fall on an edge would go to either side by rounding.
    half = 0.5 * float(np.median(np.diff(known[: int(1e4)])))
    return np.asarray(known[0] - half + settings.turn * np.arange(blocks + 1))


def _jumps(phase: Floats, stamps: Int64) -> Int64:
    """Return the samples before which the phase left its steady turn."""
    at = np.flatnonzero(np.isfinite(phase))
    whole = at.size == phase.size
    turned = np.diff(phase if whole else phase[at])
    passed = np.diff(stamps if whole else stamps[at]).astype(np.float64)
    part = slice(None, None, max(1, turned.size // 20_000))
    rate = float(np.median(turned[part] / passed[part]))
    # Over a gap the rate itself is not known well enough; a gap is judged by how much it leaves unfilled.
    jumped = (np.abs(turned - rate * passed) > BLOCK_SETTINGS.jump) & (passed * rate < 2.0 * np.pi)
    return np.asarray(at[1:][jumped], dtype=np.int64)


def _blocks_of(samples: npt.NDArray[np.integer], bounds: npt.NDArray[np.integer]) -> Bools:
    """Return which blocks hold any of some samples; a jump at an edge hits both sides."""
    hit = np.zeros(bounds.size - 1, dtype=np.bool_)
    for sides in (samples, samples - 1):
        block = np.searchsorted(bounds, sides, side="right") - 1
        hit[block[(block >= 0) & (block < hit.size)]] = True
    return hit
