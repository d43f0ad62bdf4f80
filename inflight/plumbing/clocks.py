"""Clocks: by how many seconds or hours the stamps of one record are off from those of another.

`clock_findings` takes pairs of records that tell of one field, shifts one against the other, and asks the
other pairs which of both is at fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from inflight.arrays import Floats
from inflight.mission import Mission
from inflight.plumbing.fields import finding_of
from inflight.plumbing.findings import Finding, Remedy, clock_lines
from inflight.plumbing.records import (
    PLUMBING_SETTINGS,
    Choice,
    Record,
    chance_of,
    choose,
    gains,
    mean_gain,
    typical_squares,
)
from inflight.time import SECOND, Int64, to_utc

_J2000 = np.datetime64("2000-01-01T12:00:00", "ns")


@dataclass(frozen=True)
class Pair:
    """Two records of one field.

    Attributes
    ----------
    first, second : Record
    stamps : ndarray of int64, shape (row,)
        TT2000, where they are held together.
    step_s : int
        Seconds between the lags that are tried: what is smooth needs few of them.
    clears : bool
        Whether a shift of either record is a shift of one against the other: then the pair clears a clock.
    residual : callable
        What is left between the first and the second, shifted by nanoseconds: the second is read at
        ``stamps + lag``; (row,) or (row, axis), nT.
    """

    first: Record
    second: Record
    stamps: Int64
    residual: Callable[[int], Floats]
    step_s: int = 1
    clears: bool = True

    @property
    def instruments(self) -> set[str]:
        """Both instruments."""
        return {self.first.instrument, self.second.instrument}

    def squares(self, lag_ns: int) -> Floats:
        """Return the typical squares of blocks at a lag."""
        return typical_squares(self.residual(lag_ns))

    def lag_of(self, instrument: str, late_s: float) -> int:
        """Return the lag that this pair shows when an instrument's stamps are late by so much, ns."""
        return round((late_s if self.second.instrument == instrument else -late_s) * SECOND)


def linear_pair(
    first: Record, second: Record, columns: Callable[[Floats], Floats] | None = None, step_s: int = 1
) -> Pair:
    """Return a pair in which the first is any linear combination of what `columns` makes of the second.

    The faster of both is shifted; a scalar is told by the squares and products of a vector's components.
    """
    slow_second = second.cadence_ns > first.cadence_ns
    rows = PLUMBING_SETTINGS.rows // (1 if step_s == 1 else 2)
    stamps = (second if slow_second else first).thinned(rows)
    fixed = (second if slow_second else first).at(stamps)
    make = columns or with_constant

    def residual(lag_ns: int) -> Floats:
        moved = first.at(stamps - lag_ns) if slow_second else second.at(stamps + lag_ns)
        target, source = (moved, fixed) if slow_second else (fixed, moved)
        return left_by(make(source), target)

    return Pair(first, second, stamps, residual, step_s)


def with_constant(values: Floats) -> Floats:
    """Return a record's columns and a constant."""
    wide = values.reshape(len(values), -1)
    # One run of memory a column.
    return np.vstack([wide.T, np.ones(len(wide))]).T


def scalar_pair(scalar: Record, vector: Record, step_s: int = 1) -> Pair:
    """Return a scalar instrument and a vector one of any nine parameters.

    ``F^2 = |K (E - E0)|^2`` is linear in the products of the components of E, and in E.
    """
    strength = float(np.nanmedian(np.abs(scalar.values))) or 1.0
    squared = replace(scalar, values=scalar.values**2 / (2.0 * strength))
    columns = quadratic_columns(vector.values)
    return linear_pair(squared, vector, columns, step_s)


def quadratic_columns(values: Floats) -> Callable[[Floats], Floats]:
    """Return what makes of vectors (row, axis) their components, products of these and a constant: (row, 10).

    Counted from the typical vector in units of their spread, so that a field that hardly turns makes columns
    that differ.
    """
    middle = np.nanmedian(values, axis=0)
    spread = np.nanstd(values, axis=0)
    spread = np.where(spread > 0, spread, 1.0)

    def columns(vectors: Floats) -> Floats:
        x, y, z = (np.ascontiguousarray(vectors.T) - middle[:, None]) / spread[:, None]
        return np.array([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z, np.ones(len(x))]).T

    return columns


def left_by(columns: Floats, target: Floats) -> Floats:
    """Return what columns (row, column) leave of a target (row,) or (row, axis); outliers have no say."""
    wide = target.reshape(len(target), -1)
    good = np.isfinite(columns.sum(axis=1) + wide.sum(axis=1))
    residual = np.full(wide.shape, np.nan)
    known, told = (columns, wide) if good.all() else (columns[good], wide[good])
    used, seen = known, told
    for _ in range(2):
        if len(used) < 2 * columns.shape[1]:
            return residual.reshape(target.shape)
        gram = used.T @ used
        scale = np.sqrt(np.diag(gram) / len(used)) + 1e-300
        inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-13, hermitian=True)
        left = told - known @ ((inverse @ ((used.T @ seen) / scale[:, None])) / scale[:, None])
        residual[good] = left
        size = np.abs(left[:, 0]) if left.shape[1] == 1 else np.linalg.norm(left, axis=1)
        # Five sigma of a normal deviate.
        kept = size <= 5.0 / 0.6745 * np.median(size)
        if np.count_nonzero(kept) == len(used):
            break
        used, seen = known[kept], told[kept]
    return residual.reshape(target.shape)


def clock_findings(mission: Mission, pairs: Sequence[Pair]) -> list[Finding]:
    """Return the clocks that are off, by pairs of records that tell of one field."""
    told: list[tuple[dict[str, float], Finding]] = []
    shifts = [(pair, *shift) for pair in pairs if (shift := find_lag(pair)) is not None]
    for pair, lag_s, choice in shifts:
        # The second is read so much later: its stamps are late, or those of the first are early.
        suspects = {pair.second.instrument: lag_s, pair.first.instrument: -lag_s}
        kept = {one: late for one, late in suspects.items() if not _is_cleared(one, late, pair, pairs)}
        guilty = kept or suspects
        told.append((guilty, _clock_finding(mission, pair, guilty, choice)))
    out: list[Finding] = []
    known: dict[str, float] = {}
    for guilty, finding in sorted(told, key=lambda one: len(one[0])):
        # Another pair shows the same clock once more.
        if any(abs(known.get(name, np.inf) - late) < 2.0 for name, late in guilty.items()):
            continue
        known |= guilty
        out.append(finding)
    return out


def find_lag(pair: Pair) -> tuple[float, Choice[int]] | None:
    """Return by how many seconds the second record of a pair is late, and how sure that is."""
    stated, step = pair.squares(0), pair.step_s
    if not gains(stated, stated).size:
        return None

    def tried(lags: Iterable[int]) -> dict[int, Floats]:
        return {lag: pair.squares(lag) for lag in lags}

    near = [one * SECOND for one in range(-PLUMBING_SETTINGS.seconds, PLUMBING_SETTINGS.seconds + 1, step)]
    most = PLUMBING_SETTINGS.half_hours
    trials = tried({*near, *(one * 1800 * SECOND for one in range(-most, most + 1))})
    best = max(trials, key=lambda lag: mean_gain(stated, trials[lag]))
    if abs(best) >= 1800 * SECOND:
        trials |= tried(best + by for by in near)
        best = max(trials, key=lambda lag: mean_gain(stated, trials[lag]))
    trials |= tried(best + by * SECOND for by in range(1 - step, step))
    trials.pop(0, None)
    found = choose(stated, trials)
    if found is None or any(abs(lag - found.name) > 3 * SECOND for lag in found.rivals):
        return None
    lag_s = _between(pair, found.name)
    for unit in (1800.0, 1.0):
        if abs(lag_s) >= 0.5 * unit and abs(lag_s - unit * round(lag_s / unit)) <= PLUMBING_SETTINGS.whole:
            lag_s = unit * round(lag_s / unit)
    return (round(lag_s, 2), found) if abs(lag_s) >= 0.5 else None


def _between(pair: Pair, lag_ns: int) -> float:
    """Return the lag between whole seconds at which the squares of all blocks are least, by a parabola; s."""
    before, here, after = (pair.squares(lag_ns + by * SECOND) for by in (-1, 0, 1))
    both = np.isfinite(before) & np.isfinite(here) & np.isfinite(after)
    bend = float(np.sum((before - 2.0 * here + after)[both]))
    if bend <= 0:
        return lag_ns / SECOND
    return lag_ns / SECOND + float(np.clip(0.5 * np.sum((before - after)[both]) / bend, -1.0, 1.0))


def _is_cleared(instrument: str, late_s: float, pair: Pair, pairs: Sequence[Pair]) -> bool:
    """Return True when another pair agrees better as stated than with the stamps of an instrument moved."""
    for other in pairs:
        if not other.clears or instrument not in other.instruments or other.instruments == pair.instruments:
            continue
        moved = other.squares(other.lag_of(instrument, late_s))
        if chance_of(moved, other.squares(0)) < PLUMBING_SETTINGS.chance:
            return True
    return False


def _clock_finding(mission: Mission, pair: Pair, guilty: Mapping[str, float], choice: Choice[int]) -> Finding:
    remedies = [
        Remedy(f"the clock of '{name}' is off", clock_lines(mission, name, -late))
        for name, late in guilty.items()
    ]
    name, late = next(iter(guilty.items()))
    record = pair.second if pair.second.instrument == name else pair.first
    size = f"{abs(late) / 3600:g} h" if abs(late) % 1800 == 0 else f"{abs(late):g} s"
    words = f"The stamps of '{name}' are {size} {'late' if late > 0 else 'early'}"
    if len(guilty) > 1:
        others = ", ".join(f"'{one}'" for one in guilty if one != name)
        words += f" against those of {others}"
    named = _named_offset(abs(late), int(pair.stamps[0]))
    return finding_of("clock", words + named, record, pair.stamps, replace(choice, rivals=()), remedies)


def _named_offset(seconds: float, tt2000: int) -> str:
    """Return what an offset is known as, in brackets; empty for others."""
    tt = float((tt2000 - (to_utc(tt2000) - _J2000).astype(np.int64)) / SECOND)
    known = {
        1.0: "a leap second",
        tt: "TT less UTC",
        tt - 32.184: "TAI less UTC",
        tt - 51.184: "GPS time less UTC",
    }
    name = next((name for size, name in known.items() if abs(size - seconds) <= PLUMBING_SETTINGS.whole), "")
    return f" ({name})" if name else ""
