"""Spin phase at sample times: from Sun pulses, from a delivered angle, or from a constant period.

The phase is the angle of XA from XP, the projection of the Sun into the spin plane, towards YP: ``w t`` in
eq. (1) of Farrell et al. (1995). A Sun pulse, or an angle read now and then, is a *mark*: a time with a known
part of a turn. Marks that lie whole turns from their neighbours are believed; the turns between two marks are
counted where the spin rate is known well enough to leave no other count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.flags import Flag
from inflight.spin.fine_angle import thinned
from inflight.spin.marks import Marks, believed, count_turns, steadied, usual_period
from inflight.time import SECOND, Int64, utc_text

TURN = 2.0 * np.pi
#: A phase less certain than this (1 degree) is none: it leaves 2 % of the spin-plane field turning.
LEAST_CERTAIN = float(np.deg2rad(1.0))
#: Missions state their spin period to a percent; a stated one further off is called wrong.
_NOMINAL = 0.01
#: Before the first and after the last mark the phase is carried on for this many turns.
_CARRIED = 1.0
#: Hermite's cubic through both ends: an error of the rate at both ends makes at most this part of it, times
#: the gap, in the middle.
_BENT = 0.15
#: What becomes of samples where the phase jumps, and where marks are missing.
_MOVED = "marks between jumps that come back are taken back by their size, samples there carry phase_jump"
_DOUBTFUL = "nothing tells which side of it is right, and samples on both carry the flag phase_jump"
_BRIDGED = "samples between carry the flag phase_bridged, or no_phase where that is not sure enough"
_UNKNOWN = "samples without a phase carry the flag no_phase and have their field in turning axes only"


class Fault(NamedTuple):
    """Something about the marks that was not as it should be, and what to do about it; a sentence each."""

    found: str
    remedy: str


@dataclass(frozen=True)
class SpinPhase:
    """Phase at samples and how it was found.

    Attributes
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000.
    phase : ndarray, shape (time,)
        Unwrapped, radians; NaN where it cannot be trusted. Across a jump whole turns are counted as well as
        they can be.
    sigma : ndarray, shape (time,)
        Standard deviation, radians, by the scatter of the marks and the change of the rate across gaps.
    flag : ndarray of uint32, shape (time,)
        `inflight.flags.Flag`.
    marks : Marks
        What the phase rests on.
    nominal : float
        The period that was stated, s; NaN when none was.
    faults : tuple of Fault
        Everything that was not as it should be.
    """

    stamps: Int64
    phase: Floats
    sigma: Floats
    flag: npt.NDArray[np.uint32]
    marks: Marks
    nominal: float = float("nan")
    faults: tuple[Fault, ...] = ()

    @property
    def reports(self) -> tuple[str, ...]:
        """What was not as it should be, a sentence each."""
        return tuple(fault.found for fault in self.faults)

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        """Where there is a phase; (time,)."""
        return np.isfinite(self.phase)

    @property
    def period(self) -> float:
        """Median spin period, s."""
        return float(np.median(self.marks.period))

    def table(self) -> xr.Dataset:
        """Return the spin period at the marks with its sigma, and what lies behind each, along ``mark``."""
        table = self.marks.table()
        table.attrs |= {"nominal_period_s": self.nominal, "reports": list(self.reports), "told": self.told()}
        return table

    def told(self) -> str:
        """Say it in a sentence or more."""
        known = 100.0 * float(self.good.mean()) if self.good.size else 0.0
        text = f"spin period {self.period:.6g} s, phase known for {known:.1f} % of {self.stamps.size} samples"
        return "; ".join((text, *self.reports))


def phase_from_pulses(
    pulses: Int64,
    stamps: Int64,
    *,
    nominal_period: float | None = None,
    mark_phase: float = 0.0,
    certain: float = LEAST_CERTAIN,
) -> SpinPhase:
    """Return the spin phase from the times of Sun pulses.

    Parameters
    ----------
    pulses : ndarray of int64, shape (pulse,)
        TT2000 of the Sun sensor's pulses, any order; some may be missing, repeated or spurious.
    stamps : ndarray of int64, shape (time,)
        TT2000 of the samples.
    nominal_period : float, optional
        Stated spin period, s. It decides only whether some pulses are missing everywhere; a period that no
        interval shows is reported and not used.
    mark_phase : float
        Phase at a pulse, radians: minus the azimuth of the Sun sensor from XA.
    certain : float
        Samples whose phase is less certain have none, radians.

    Returns
    -------
    SpinPhase

    Raises
    ------
    CalibrationError
        With fewer than three pulses, or when they show no period.
    """
    marks = np.asarray(pulses, dtype=np.int64)
    return _from_marks(marks, np.zeros(marks.size), stamps, nominal_period, mark_phase, certain, "Sun pulse")


def phase_from_angle(
    times: Int64,
    angle: Floats,
    stamps: Int64,
    *,
    nominal_period: float,
    sense: int = 1,
    certain: float = LEAST_CERTAIN,
) -> SpinPhase:
    """Return the spin phase from a delivered angle, read fast or slowly, wrapped or not.

    An angle read more often than about four times a turn is thinned to about three readings a turn.

    Parameters
    ----------
    times : ndarray of int64, shape (reading,)
        TT2000 of the angle's readings.
    angle : ndarray, shape (reading,)
        Degrees from XP to XA; NaN where missing.
    stamps : ndarray of int64, shape (time,)
        TT2000 of the samples.
    nominal_period : float
        Stated spin period, s. Readings alone do not tell it: an angle read every 10 s that moves on by a
        tenth of a turn may have made any number of turns besides.
    sense : int
        1 when the angle grows with time; -1 for one counted from XA to XP.
    certain : float
        As for `phase_from_pulses`.

    Raises
    ------
    CalibrationError
        When whole turns between readings cannot be counted.
    """
    times, angle = np.asarray(times, dtype=np.int64), np.asarray(angle, dtype=np.float64)
    if times.shape != angle.shape or sense not in {1, -1}:
        raise SamplesError(
            f"{times.size} times, {angle.size} angles and the sense {sense} found",
            remedy="give one time an angle, and the sense 1 or -1",
        )
    known = np.isfinite(angle)
    turns = (sense * angle[known] / 360.0) % 1.0
    return _from_marks(times[known], turns, stamps, nominal_period, 0.0, certain, "angle")


def phase_from_period(stamps: Int64, period: float, epoch: int, phase: float = 0.0) -> Floats:
    """Return the phase (time,) of a constant spin, radians: `phase` at the TT2000 `epoch`; period in s."""
    if not period > 0:
        raise SamplesError(f"a spin period of {period:g} s found", remedy="state one above 0")
    return np.asarray(phase + TURN * ((stamps - np.int64(epoch)) / (period * SECOND)))


def _from_marks(
    times: Int64,
    turns: Floats,
    stamps: Int64,
    nominal: float | None,
    offset: float,
    certain: float,
    kind: str,
) -> SpinPhase:
    order = np.argsort(times, kind="stable")
    times, turns = times[order], turns[order]
    once = np.concatenate([[True], np.diff(times) > 0]) if times.size else np.empty(0, dtype=bool)
    faults = []
    if not once.all():
        found = f"{np.count_nonzero(~once)} repeated {kind}s dropped"
        faults.append(Fault(found, "see why the deliveries hold them twice; nothing is lost"))
    times, turns = times[once], turns[once]
    if times.size < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, at least 3 needed for a spin period",
            remedy="take a longer span, or state a period and an epoch",
        )
    seconds = (times - times[0]) / SECOND
    period = usual_period(seconds, turns, nominal)
    kept = believed(seconds, turns, period)
    if np.count_nonzero(kept) < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, none of them whole turns of {period:.6g} s from its neighbours",
            remedy="see whether the times are those of one Sun sensor",
        )
    few = np.flatnonzero(kept)
    some = thinned(seconds[few], turns[few], period)
    spared, few = times[few[~some]], few[some]
    if spared.size and few.size > 2:
        # Neighbours of a fine angle hardly move: that readings agree over a turn they show only now.
        few = few[believed(seconds[few], turns[few], period)]
    if few.size < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, of {seconds[-1] / period:.2g} turns or not {period:.6g} s a turn",
            remedy="take a span of several turns",
        )
    counted = count_turns(times[few], turns[few], period)
    marks = steadied(counted)
    wrong = np.setdiff1d(times, np.concatenate([marks.time, spared]))
    spurious = int(np.count_nonzero((wrong >= stamps.min()) & (wrong <= stamps.max()))) if stamps.size else 0
    if spurious:
        found = f"{spurious} spurious {kind}s dropped"
        faults.append(Fault(found, "see what else the Sun sensor saw; the rest tells the phase without them"))
    held = _turns_between(marks, stamps)
    faults += _faults(counted, held, nominal, kind) + _jumps(marks, held)
    return _at_samples(marks, np.asarray(stamps, dtype=np.int64), offset, certain, nominal, kind, faults)


def _turns_between(marks: Marks, stamps: Int64) -> Floats:
    """Return how many turns the samples between neighbouring marks last, -1 for none; (mark - 1,).

    Marks that are missing where nothing was measured are no fault.
    """
    if not stamps.size:
        return np.full(marks.time.size - 1, -1.0)
    ordered = np.sort(stamps)
    first = np.searchsorted(ordered, marks.time[:-1], side="right")
    last = np.searchsorted(ordered, marks.time[1:], side="left") - 1
    there = last >= first
    first, last = np.minimum(first, ordered.size - 1), np.maximum(last, 0)
    return np.where(there, (ordered[last] - ordered[first]) / SECOND * marks.rate[:-1], -1.0)


def _faults(marks: Marks, held: Floats, nominal: float | None, kind: str) -> list[Fault]:
    """Say what the marks about the samples show that should not be.

    Parameters
    ----------
    held : ndarray, shape (mark - 1,)
        See `_turns_between`.
    """
    faults = []
    usual = float(np.median(marks.period))
    if nominal is not None and abs(usual / nominal - 1.0) > _NOMINAL:
        found = f"the stated spin period of {nominal:.6g} s is wrong: {usual:.6g} s seen"
        faults.append(Fault(found, f"state 'spin: {usual:.6g} s' under the mission's periods"))
    missing = int(np.minimum(marks.lacking, np.floor(np.maximum(held, 0.0))).sum())
    if kind == "Sun pulse" and missing:
        faults.append(Fault(f"{missing} Sun pulses missing", f"deliver them; {_BRIDGED}"))
    lost = np.flatnonzero(marks.uncounted & (held > 2.0 * _CARRIED))
    if lost.size:
        longest = float((np.diff(marks.time)[lost] / SECOND).max())
        found = f"{lost.size} gap(s) too long to count turns, the longest {longest:.0f} s"
        faults.append(Fault(found, f"deliver more {kind}s; {_UNKNOWN}"))
    return faults


def _jumps(marks: Marks, held: Floats) -> list[Fault]:
    """Say where the phase jumps: the first ten places, and how many more there are."""
    places = np.flatnonzero(marks.jumped & (held >= 0.0))
    touched = marks.moved | marks.doubtful
    if not places.size and not np.any((touched[1:] | touched[:-1]) & (held >= 0.0)):
        return []
    remedy = "see the Sun sensor and its clock; "
    remedy += _DOUBTFUL if marks.doubtful.any() else _MOVED
    found = []
    for place in places[:10]:
        size, when = 360.0 * marks.left[place], utc_text(int(marks.time[place]))
        found.append(Fault(f"the phase jumps by {size:+.2f} degrees after {when}", remedy))
    if not found:
        found.append(Fault("the phase jumps before or after the samples", remedy))
    return [*found, Fault(f"and {places.size - 10} more jumps", remedy)] if places.size > 10 else found


def _at_samples(
    marks: Marks,
    stamps: Int64,
    offset: float,
    certain: float,
    nominal: float | None,
    kind: str,
    faults: list[Fault],
) -> SpinPhase:
    """Carry the phase from the marks to the samples."""
    place = np.clip(np.searchsorted(marks.time, stamps, side="right") - 1, 0, marks.time.size - 2)
    apart = np.diff(marks.time) / SECOND
    share = ((stamps - marks.time[place]) / SECOND) / apart[place]
    advance = np.diff(marks.turn)[place]
    phase = marks.turn[place] + share * advance
    flag = np.zeros(stamps.size, dtype=np.uint32)
    sigma = np.full(stamps.size, marks.sigma)
    bridged = (marks.gap[place]) & (share > 0) & (share < 1)
    at = place[bridged]
    phase[bridged] += _bend(share[bridged], apart[at], marks.rate[at], marks.rate[at + 1], advance[bridged])
    sigma[bridged] = np.hypot(sigma[bridged], _BENT * marks.unsure[at])
    flag[bridged] |= np.uint32(Flag.PHASE_BRIDGED)
    # In a gap whose turns cannot be counted the phase is carried on as before the first and after the last.
    outside = (share < 0) | (share > 1) | (marks.uncounted[place] & (share > 0) & (share < 1))
    end = np.where(share < 0.5, place, place + 1)
    since = (stamps - marks.time[end]) / SECOND * marks.rate[end]
    phase = np.where(outside, marks.turn[end] + since, phase)
    flag[outside] |= np.uint32(Flag.PHASE_BRIDGED)
    jump = marks.jumped[place] & (share > 0) & (share < 1)
    touched = marks.moved | marks.doubtful
    flag[jump] |= np.uint32(Flag.PHASE_JUMP)
    flag[touched[place] | (touched[place + 1] & (share >= 1))] |= np.uint32(Flag.PHASE_JUMP)
    sigma[marks.moved[place]] = np.hypot(
        sigma[marks.moved[place]], np.hypot.reduce(marks.unsure[marks.jumped])
    )
    bad = jump | (outside & (np.abs(since) > _CARRIED)) | (TURN * sigma > certain)
    flag[bad] &= ~np.uint32(Flag.PHASE_BRIDGED)
    flag[bad] |= np.uint32(Flag.NO_PHASE)
    beyond = int(np.count_nonzero(bad & (stamps < marks.time[0]) | bad & (stamps > marks.time[-1])))
    if beyond:
        found = f"{beyond} samples lie beyond the first or last {kind}, which tell no phase there"
        faults.append(Fault(found, f"deliver more {kind}s; {_UNKNOWN}"))
    phase = np.where(bad, np.nan, TURN * phase + offset)
    if not np.isfinite(phase).any() and stamps.size:
        found = f"no sample has a phase; marks scatter by {360 * marks.sigma:.2g} degrees"
        faults.append(Fault(found, f"see whether the times are those of one Sun sensor; {_UNKNOWN}"))
    stated = float("nan") if nominal is None else float(nominal)
    return SpinPhase(stamps, phase, TURN * sigma, flag, marks, stated, tuple(faults))


def _bend(share: Floats, apart: Floats, first: Floats, last: Floats, advance: Floats) -> Floats:
    """Return what a cubic with the rates at both ends has above the straight line; turns."""
    before, after = first * apart - advance, last * apart - advance
    return np.asarray(share * (1.0 - share) * ((1.0 - share) * before - share * after))
