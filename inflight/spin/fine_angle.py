"""An angle read many times a turn: its period, and the few readings a turn that count its turns."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import percentile_filter

from inflight.arrays import Floats

#: Turns between readings below which an angle is finely read: more than four and a half readings a turn.
FINE = 0.22
#: What is left of a fine angle: readings about this part of a turn apart, far from both 0 and a whole turn.
_APART = 1.0 / 3.0
#: Turns without a reading that end a stretch of fine ones.
_BREAK = 0.5
#: Intervals around each reading that say whether it is one of many, and the percentage of them that must be
#: short: more than two in three, as they are where slow readings come three times.
_AROUND, _MOST = 21, 75


def finely_read(apart: Floats, turns: Floats, advance: Floats) -> bool:
    """Return whether most readings are of an angle that moves on by less than `FINE` from one to the next.

    Parameters
    ----------
    apart, advance : ndarray, shape (reading - 1,)
        From each reading to the next, in s and in turns.
    turns : ndarray, shape (reading,)
        Parts of a turn in [0, 1); pulses, all of them 0, are never fine.
    """
    usual = float(np.median(apart))
    moved = abs(float(np.median(advance))) * float(np.percentile(apart, _MOST)) / usual
    return bool(np.any(turns > 0)) and moved < FINE


def fine_period(seconds: Floats, turns: Floats, nominal: float) -> float | None:
    """Return the period that a finely read angle shows, s; None where it is not finely read.

    From one reading to the next the angle may move less than it scatters. The lag is doubled until it moves
    by a third of a turn; the rate from each lag counts the turns of the next.

    Parameters
    ----------
    seconds, turns : ndarray, shape (reading,)
        Times in order, and parts of a turn in [0, 1).
    nominal : float
        Stated period, s, above 0; it says how many whole turns lie between neighbouring readings.

    Returns
    -------
    float or None
        Not above 0 for an angle that falls, infinite for one that stands still.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    if not np.median(apart) < 0.5 * nominal:
        return None
    if not finely_read(apart, turns, np.rint(apart / nominal - part) + part):
        return None
    lag, rate = 1, 1.0 / nominal
    while True:
        ahead, part = seconds[lag:] - seconds[:-lag], turns[lag:] - turns[:-lag]
        moved = float(np.median(np.rint(ahead * rate - part) + part))
        rate = moved / float(np.median(ahead))
        if abs(moved) >= _APART or 2 * lag >= seconds.size:
            return 1.0 / rate if rate else float("inf")
        lag *= 2


def thinned(seconds: Floats, turns: Floats, period: float) -> npt.NDArray[np.bool_]:
    """Return which readings to count turns with: of finely read stretches about three a turn, all others.

    They are chosen by their times, not by their angles, which scatter. Both ends of a fine stretch are kept,
    so that no sample between readings comes to lie outside them. Pulses are never thinned.

    Parameters
    ----------
    seconds, turns : ndarray, shape (reading,)
        Times in order, and parts of a turn in [0, 1), of readings that are believed; two at least.
    period : float
        Usual period, s.
    """
    everything = np.ones(seconds.size, dtype=bool)
    if not np.any(turns > 0):
        return everything
    ahead = seconds / period
    step = np.diff(ahead)
    usual = percentile_filter(step, _MOST, _AROUND, mode="nearest")
    usual = np.concatenate([usual[:1], usual])
    fine = usual < FINE
    fine[0] = False
    if not fine.any():
        return everything
    place = np.arange(seconds.size)
    # The reading nearest to a third of a turn on, or the next that is none of many.
    following = np.searchsorted(ahead, ahead + _APART - 0.5 * np.minimum(usual, FINE))
    alone = np.append(np.flatnonzero(~fine), seconds.size)
    following = np.minimum(following, alone[np.searchsorted(alone, place, side="right")]).tolist()
    kept = np.zeros(seconds.size, dtype=bool)
    at = 0
    while at < seconds.size:
        kept[at] = True
        at = following[at]
    first = np.concatenate([[True], step > _BREAK])
    for end in np.flatnonzero(np.append(first[1:], True) & ~kept):
        before = int(np.flatnonzero(kept[:end])[-1])
        if fine[before] and not first[before]:
            kept[before], kept[end] = False, True
    return kept
