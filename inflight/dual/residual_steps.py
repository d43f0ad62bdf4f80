"""How far the corrected field still steps where the spacecraft switches: what a correction is judged by.

The ambient field does not know when the spacecraft switches, so a field without stray field steps there no
more than anywhere else. That is all two sensors tell without a known field: a constant error is not in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats
from inflight.dual.correction import TRANSIENT

#: Samples of a mean on either side; longer ones see more of the ambient field, shorter ones more noise.
WIDTH = 8
_WIDTHS = (1, 2, 4, 8, 16, 32)
#: The fewest switchings whose scatter says anything, and errors that must be passed to be told.
_FEWEST, _CLEAR = 4, 4.0

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
class Remaining:
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


def regressed(coordinate: str, steps: Floats, change: Floats) -> Remaining | None:
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
    if x.size < _FEWEST:
        return None
    square = float(x @ x)
    value = x @ y / square
    left = (y - x[:, None] * value) / (1.0 - x**2 / square)[:, None]
    sigma = np.sqrt(x**2 @ left**2) / square
    return Remaining(coordinate, value, np.maximum(sigma, np.finfo(float).tiny), int(x.size))


def by_state(at: Switchings, steps: Floats) -> Iterator[Remaining]:
    """Yield what is left when a state is entered, and with the other sign when it is left."""
    for state in np.unique(np.concatenate([at.before, at.after])):
        sign = (at.after == state).astype(float) - (at.before == state)
        name = f"state {state}" if state >= 0 else "unknown states"
        if (found := regressed(name, steps, sign)) is not None:
            yield found
