"""The spin phase at sample times, from Sun pulses or from a delivered angle.

The phase is the angle of XA from XP, the projection of the Sun into the spin plane, towards YP: ``w t`` in
eq. (1) of Farrell et al. (1995). It grows with time.

Takes: times of Sun pulses, or an angle and its times, TT2000; sample times. Makes: `SpinPhase`, the phase in
radians with its standard deviation, flags and what was wrong (`phase_from_pulses`, `phase_from_angle`); and,
as a check, the spin period that the field itself shows (`check_period`).

A pulse, or one reading of the angle, is a *mark*: a time with a known part of a turn. The steps are

1. The usual period (`find_period`): the one most intervals between marks agree with. An angle that is read
   many times a turn shows it by itself (`period_of_fine_angle`).
2. Marks that lie whole turns from their neighbours are kept (`are_consistent`).
3. A finely read angle is thinned to about three readings a turn (`thin_readings`).
4. Turns between marks are counted where the rate is known well enough to leave no other count
   (`count_turns`); jumps that come back are corrected (`correct_jumps`).
5. The phase is interpolated to the samples, with a cubic across turns without a mark.

The check of the period: the spin-plane field in turning axes, ``BX + i BY = Bsp exp(-i (w t - psi))`` (eq.
8), is one tone of negative frequency. The top of the spectrum gives the frequency, the phases of stretches of
the record make it sharp. No paper stands behind the counting of turns and its limits: they are derived here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from inflight.arrays import Floats
from inflight.errors import CalibrationError, SamplesError
from inflight.flags import Flag
from inflight.lsq import MAD_TO_SIGMA, robust_sigma
from inflight.residual import STEP_SIGNIFICANCE
from inflight.time import SECOND, Int64, utc_text


@dataclass(frozen=True, kw_only=True)
class ThinningSettings:
    """When an angle is read finely, and how far apart the readings are that count its turns.

    Attributes
    ----------
    fine : float
        An angle is finely read where its readings are less than this part of a turn apart: more than four
        and a half a turn. Assumed.
    apart : float
        Distance of the readings that are kept, turns. Derived: a third is far from both 0 and a whole turn.
    stretch_gap : float
        Turns without a reading that end a stretch of fine readings. Assumed.
    around : int
        Intervals around a reading that decide whether it is one of many. Assumed.
    percentile : int
        Percentile of their lengths that must be below `fine`. Derived: more than two in three must be short,
        as two in three are where slow readings come three times.
    """

    fine: float = 0.22
    apart: float = 1.0 / 3.0
    stretch_gap: float = 0.5
    around: int = 21
    percentile: int = 75


THINNING_SETTINGS = ThinningSettings()


@dataclass(frozen=True, kw_only=True)
class MarkSettings:
    """Which marks agree with each other, and when turns between them are counted.

    Attributes
    ----------
    finest, coarsest : float
        A mark may be off whole turns by this part of a turn: at least `finest` (0.04 degrees; a finer limit
        would see variations of the spin rate as faults), at most `coarsest` (beyond it chance agrees too
        often). Assumed.
    near : float
        A stated period is right when the median interval is within this part of a turn of whole turns; marks
        nearer than this repeat one another. Assumed.
    single : float
        ... and this part of the intervals is of a single turn; else pulses are not missing but never came.
        Assumed.
    lags : int
        Neighbours on each side that a mark is compared with. Assumed.
    agreement : float
        Part of them it must agree with. Derived: the majority.
    around : int
        Intervals whose median gives the local period. Assumed.
    count_sigmas : float
        Standard deviations of a predicted count that must fit into half a turn, and beyond which a residual
        is a jump. Level of significance: 0.3 %.
    """

    finest: float = 1e-4
    coarsest: float = 0.1
    near: float = 0.1
    single: float = 0.05
    lags: int = 4
    agreement: float = 0.5
    around: int = 21
    count_sigmas: float = 3.0


MARK_SETTINGS = MarkSettings()


def is_finely_sampled(apart: Floats, turns: Floats, advance: Floats) -> bool:
    """Return whether most readings of an angle are less than `ThinningSettings.fine` of a turn apart.

    Parameters
    ----------
    apart, advance : ndarray, shape (reading - 1,)
        From each reading to the next, in s and in turns.
    turns : ndarray, shape (reading,)
        Parts of a turn in [0, 1); pulses, all of them 0, are never fine.
    """
    usual = float(np.median(apart))
    moved = abs(float(np.median(advance))) * float(np.percentile(apart, THINNING_SETTINGS.percentile)) / usual
    return bool(np.any(turns > 0)) and moved < THINNING_SETTINGS.fine


def period_of_fine_angle(seconds: Floats, turns: Floats, nominal: float) -> float | None:
    """Return the period that a finely read angle shows, s; None where it is not finely read.

    From one reading to the next the angle may move less than it scatters. The lag is doubled until it moves
    by a third of a turn; the rate from each lag counts the turns of the next.

    Parameters
    ----------
    seconds, turns : ndarray, shape (reading,)
        Times in order, and parts of a turn in [0, 1).
    nominal : float
        Stated period, s, above 0; from it the whole turns are counted that lie between neighbouring readings.

    Returns
    -------
    float or None
        Not above 0 for an angle that falls, infinite for one that stands still.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    if not np.median(apart) < 0.5 * nominal:
        return None
    if not is_finely_sampled(apart, turns, np.rint(apart / nominal - part) + part):
        return None
    lag, rate = 1, 1.0 / nominal
    while True:
        ahead, part = seconds[lag:] - seconds[:-lag], turns[lag:] - turns[:-lag]
        moved = float(np.median(np.rint(ahead * rate - part) + part))
        rate = moved / float(np.median(ahead))
        if abs(moved) >= THINNING_SETTINGS.apart or 2 * lag >= seconds.size:
            return 1.0 / rate if rate else float("inf")
        lag *= 2


def thin_readings(seconds: Floats, turns: Floats, period: float) -> npt.NDArray[np.bool_]:
    """Return which readings to count turns with: of finely read stretches about three a turn, all others.

    They are chosen by their times, not by their angles, which scatter. Both ends of a fine stretch are kept,
    so that no sample between readings comes to lie outside them. Pulses are never thinned.

    Parameters
    ----------
    seconds, turns : ndarray, shape (reading,)
        Times in order, and parts of a turn in [0, 1), of readings that agree with each other; at least two.
    period : float
        Usual period, s.
    """
    if not np.any(turns > 0):
        return np.ones(seconds.size, dtype=bool)
    ahead = seconds / period
    step = np.diff(ahead)
    usual = scipy.ndimage.percentile_filter(
        step, THINNING_SETTINGS.percentile, THINNING_SETTINGS.around, mode="nearest"
    )
    usual = np.concatenate([usual[:1], usual])
    fine = usual < THINNING_SETTINGS.fine
    fine[0] = False
    if not fine.any():
        return np.ones(seconds.size, dtype=bool)
    place = np.arange(seconds.size)
    # The reading nearest to a third of a turn on, or the next that is none of many.
    following = np.searchsorted(
        ahead, ahead + THINNING_SETTINGS.apart - 0.5 * np.minimum(usual, THINNING_SETTINGS.fine)
    )
    alone = np.append(np.flatnonzero(~fine), seconds.size)
    following = np.minimum(following, alone[np.searchsorted(alone, place, side="right")]).tolist()
    kept = np.zeros(seconds.size, dtype=bool)
    at = 0
    while at < seconds.size:
        kept[at] = True
        at = following[at]
    first = np.concatenate([[True], step > THINNING_SETTINGS.stretch_gap])
    last_kept, moved_to = np.maximum.accumulate(np.where(kept, place, -1)), -1
    for end in np.flatnonzero(np.append(first[1:], True) & ~kept):
        before = max(int(last_kept[end]), moved_to)
        if fine[before] and not first[before]:
            kept[before], kept[end], moved_to = False, True, int(end)
    return kept


@dataclass(frozen=True, kw_only=True)
class Marks:
    """Marks that agree with their neighbours, in order of time.

    Attributes
    ----------
    time : ndarray of int64, shape (mark,)
        TT2000.
    turn : ndarray, shape (mark,)
        Turns since the first mark's whole turn; whole for pulses.
    rate : ndarray, shape (mark,)
        Local spin rate, turns a second.
    residual : ndarray, shape (mark - 1,)
        Turns predicted to the next mark, less those counted.
    predicted_sigma : ndarray, shape (mark - 1,)
        Standard deviation of the turns predicted to the next mark.
    jumped, uncountable, gap : ndarray of bool, shape (mark - 1,)
        The turns do not fit; cannot be counted; are more than one and were counted.
    shifted, ambiguous : ndarray of bool, shape (mark,)
        The mark's turn was corrected by the size of a jump; a jump leaves its turn ambiguous. See
        `correct_jumps`.
    sigma : float
        Scatter of a mark, turns.
    repeated : int
        Marks dropped because they repeat another's turn.
    """

    time: Int64
    turn: Floats
    rate: Floats
    residual: Floats
    predicted_sigma: Floats
    jumped: npt.NDArray[np.bool_]
    uncountable: npt.NDArray[np.bool_]
    gap: npt.NDArray[np.bool_]
    shifted: npt.NDArray[np.bool_]
    ambiguous: npt.NDArray[np.bool_]
    sigma: float
    repeated: int

    @property
    def period(self) -> Floats:
        """Local spin period, s; (mark,)."""
        return np.asarray(1.0 / self.rate)

    @property
    def missing(self) -> int:
        """Number of whole turns without a mark, where they could be counted."""
        return int(self.missing_turns.sum())

    @property
    def missing_turns(self) -> Int64:
        """Whole turns without a mark in each interval, 0 where they cannot be counted; (mark - 1,)."""
        missing = np.maximum(np.rint(np.diff(self.turn)) - 1, 0)
        return np.where(self.uncountable, 0, missing).astype(np.int64)


def find_period(seconds: Floats, turns: Floats, nominal: float | None) -> float:
    """Return the period that most intervals show, s.

    Parameters
    ----------
    seconds, turns : ndarray, shape (mark,)
        Times, and parts of a turn in [0, 1); 0 for pulses.
    nominal : float, optional
        Stated period, s; it only bounds how many turns an interval may have.

    Raises
    ------
    CalibrationError
        When the angle is read too slowly to show a period and the stated one does not fit, when it falls or
        stands still, or when none is stated for it.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    angle = bool(np.any(turns > 0))
    if angle and (nominal is None or not nominal > 0):
        raise CalibrationError(
            "an angle is given without a spin period, and may have made any number of turns between readings",
            remedy="state the spin period to better than a tenth of a turn between readings",
        )
    if angle and nominal is not None:
        fine = period_of_fine_angle(seconds, turns, nominal)
        if fine is not None and 0.0 < fine < np.inf:
            return fine
        if fine is not None:
            raise CalibrationError(
                f"the angle, read every {np.median(apart):.4g} s, does not grow by turns of {nominal:.6g} s",
                remedy="see whether it stands still, or is counted from XA to XP",
            )
    if nominal is not None and nominal > 0:
        advance = np.rint(apart / nominal - part) + part
        residual = apart / nominal - advance
        near = (advance > 0.25) & (np.abs(residual) < MARK_SETTINGS.near)
        single = np.mean((advance < 1.5) & (np.abs(residual) < MARK_SETTINGS.near))
        if (
            near.any()
            and np.median(np.abs(residual)) < MARK_SETTINGS.near
            and (angle or single > MARK_SETTINGS.single)
        ):
            return float(np.median(apart[near] / advance[near]))
    if not angle:
        return float(np.median(apart))
    # Read more than twice a turn, an angle moves on by less than half a turn each time.
    step = part % 1.0
    if nominal is None or not np.median(apart) < 0.5 * nominal or not 0.0 < np.median(step) < 0.5:
        raise CalibrationError(
            f"the angle is read every {np.median(apart):.4g} s, and turns of {nominal:.6g} s do not fit it",
            remedy="state the spin period to better than a tenth of a turn between readings",
        )
    return float(np.median(apart[step > 0] / step[step > 0]))


def are_consistent(seconds: Floats, turns: Floats, period: float) -> npt.NDArray[np.bool_]:
    """Return which marks are whole turns from at least half of their neighbours before, or of those after.

    One side is enough: after a jump of the phase the marks agree among themselves.
    """
    rate = _local_rate(seconds, turns, period)
    tolerance = _tolerance(_scatter(seconds, turns, rate))
    agreeing, compared = np.zeros((2, seconds.size)), np.zeros((2, seconds.size))
    for lag in range(1, min(MARK_SETTINGS.lags, seconds.size - 1) + 1):
        ahead = (seconds[lag:] - seconds[:-lag]) * 0.5 * (rate[lag:] + rate[:-lag])
        residual = ahead - (turns[lag:] - turns[:-lag])
        near = np.abs(residual - np.rint(residual)) < tolerance
        for side, part in enumerate((slice(lag, None), slice(None, -lag))):
            agreeing[side, part] += near
            compared[side, part] += 1
    return np.asarray(np.any((agreeing >= MARK_SETTINGS.agreement * compared) & (compared > 0), axis=0))


def count_turns(times: Int64, turns: Floats, period: float) -> Marks:
    """Return the marks with their turns counted, and where these do not fit.

    Across an interval the rate is the mean of those before and after it; half their difference and the
    scatter of the marks give the standard deviation of the count. A finely read angle must be thinned before:
    marks nearer than a tenth of a turn repeat one another.

    Raises
    ------
    CalibrationError
        When all marks are of one turn.
    """
    if times.size < 2:
        raise CalibrationError("all marks are of one turn", remedy="take a longer span")
    seconds = (times - times[0]) / SECOND
    rate = _local_rate(seconds, turns, period)
    # The rate before and after each interval is from medians that do not reach over it.
    reach, place = MARK_SETTINGS.around // 2, np.arange(rate.size - 1)
    before = rate[np.maximum(place - reach, 0)]
    after = rate[np.minimum(place + 1 + reach, rate.size - 1)]
    apart, part = np.diff(seconds), np.diff(turns)
    advance = np.asarray(np.rint(0.5 * (before + after) * apart - part) + part)
    repeated = np.concatenate([[False], advance < MARK_SETTINGS.near])
    if repeated.any():
        rest = count_turns(times[~repeated], turns[~repeated], period)
        return replace(rest, repeated=rest.repeated + int(repeated.sum()))
    sigma = _scatter(seconds, turns, rate)
    rate_error = np.hypot(
        0.5 * np.abs(after - before), sigma * rate.mean() * np.sqrt(2.0 / MARK_SETTINGS.around)
    )
    predicted_sigma = rate_error * apart
    residual = 0.5 * (before + after) * apart - advance
    uncountable = MARK_SETTINGS.count_sigmas * predicted_sigma > 0.5
    jumped = ~uncountable & (
        np.abs(residual) > _tolerance(sigma) + MARK_SETTINGS.count_sigmas * predicted_sigma
    )
    turn = turns[0] + np.concatenate([[0.0], np.cumsum(advance)])
    ends = np.stack([np.append(before, after[-1]), np.append(before[0], after)])
    none = np.zeros(turn.size, dtype=bool)
    return Marks(
        time=times,
        turn=turn,
        rate=ends.mean(axis=0),
        residual=residual,
        predicted_sigma=predicted_sigma,
        jumped=jumped,
        uncountable=uncountable,
        gap=(advance > 1.5) & ~jumped & ~uncountable,
        shifted=none,
        ambiguous=none,
        sigma=sigma,
        repeated=0,
    )


def correct_jumps(marks: Marks) -> Marks:
    """Return the marks with jumps of their phase taken out, where it is clear which marks are right.

    The spin of a body does not jump: the clock of its marks does, or single marks do. Marks between jumps
    that cancel are corrected by the size of the jumps. Where the jumps of a stretch do not cancel, nothing
    shows which side is right: all its marks are ambiguous. Stretches end where turns cannot be counted.
    """
    if not marks.jumped.any():
        return marks
    turn, shifted, ambiguous = marks.turn.copy(), marks.shifted.copy(), marks.ambiguous.copy()
    starts = np.concatenate([[0], np.flatnonzero(marks.uncountable) + 1])
    for first, last in zip(starts, [*starts[1:], turn.size], strict=True):
        inside = slice(first, last - 1)
        jumped = marks.jumped[inside]
        off = np.concatenate([[0.0], np.cumsum(np.where(jumped, marks.residual[inside], 0.0))])
        error = np.hypot.reduce(np.where(jumped, marks.predicted_sigma[inside], 0.0))
        near = _tolerance(marks.sigma) * np.sqrt(max(jumped.sum(), 1)) + MARK_SETTINGS.count_sigmas * error
        away = np.abs(off - np.rint(off)) > near
        if away.size and away[-1]:
            ambiguous[first:last] = True
        else:
            turn[first:last] += off
            shifted[first:last] = away
    return replace(marks, turn=turn, shifted=shifted, ambiguous=ambiguous)


def _local_rate(seconds: Floats, turns: Floats, period: float) -> Floats:
    """Return the rate around each mark by the median of the intervals of few turns; turns a second.

    A finely read angle has the usual rate: its intervals are too short, and those above a quarter turn
    misread.
    """
    apart, part = np.diff(seconds), np.diff(turns)
    advance = np.rint(apart / period - part) + part
    usual = max(float(np.median(advance)), 1.0)
    near = (
        (advance > 0.25)
        & (advance < 3.0 * usual)
        & (np.abs(apart / period - advance) < MARK_SETTINGS.coarsest)
    )
    if not near.any() or is_finely_sampled(apart, turns, advance):
        return np.full(seconds.size, 1.0 / period)
    middle = 0.5 * (seconds[1:] + seconds[:-1])[near]
    rates = scipy.ndimage.median_filter(
        advance[near] / apart[near], min(MARK_SETTINGS.around, int(near.sum())), mode="nearest"
    )
    return np.asarray(np.interp(seconds, middle, rates))


def _scatter(seconds: Floats, turns: Floats, rate: Floats) -> float:
    """Return the scatter of a mark, turns, from the intervals between neighbours."""
    residual = np.diff(seconds) * 0.5 * (rate[1:] + rate[:-1]) - np.diff(turns)
    residual -= np.rint(residual)
    close = np.abs(residual) < MARK_SETTINGS.coarsest
    return robust_sigma(residual[close]) / np.sqrt(2.0) if close.any() else MARK_SETTINGS.coarsest


def _tolerance(sigma: float) -> float:
    """Return by how much of a turn marks of a scatter may be off whole turns from each other."""
    return float(
        np.clip(STEP_SIGNIFICANCE * np.sqrt(2.0) * sigma, MARK_SETTINGS.finest, MARK_SETTINGS.coarsest)
    )


@dataclass(frozen=True, kw_only=True)
class PeriodSettings:
    """When the field shows a spin period, and when that of a phase contradicts it.

    Attributes
    ----------
    contradiction : float
        Standard deviations between the two periods from which on the phase is wrong. Level of significance:
        6e-7.
    tone_power : float
        The tone must stand this many times above the median of the power spectrum. Derived: noise alone
        reaches the logarithm of the number of frequencies, less than 20.
    stretches, fewest : int
        Most and fewest stretches of the record whose phases are compared. Assumed.
    shortest : float
        Turns of the shortest stretch. Assumed.
    readings : int
        Fewest readings of a record. Assumed.
    empty : float
        Largest part of the even grid without a reading. Assumed.
    limit : float
        Readings are pulled in to this many times the usual size: one outlier is white, and may stand above
        any tone. Assumed.
    """

    contradiction: float = 5.0
    tone_power: float = 50.0
    stretches: int = 40
    fewest: int = 4
    shortest: float = 4.0
    readings: int = 64
    empty: float = 0.75
    limit: float = 6.0


PERIOD_SETTINGS = PeriodSettings()


@dataclass(frozen=True, kw_only=True)
class PeriodCheck:
    """Spin period by the field and by the phase, s.

    Attributes
    ----------
    period, sigma : float
        By the field. The sigma holds for a field direction that changes as a random walk; it is an upper
        bound where the direction comes back.
    used : float
        Mean period of the phase that is used; NaN when none was given.
    tone : float
        Amplitude of the tone, nT.
    agrees : bool
        False when the two differ by more than five sigmas; True where the field shows no period.
    aliased : bool
        The readings are slower than twice a turn of the used period: the field shows no period.
    """

    period: float
    sigma: float
    used: float
    tone: float
    agrees: bool
    aliased: bool

    def summary(self) -> str:
        """Return one sentence."""
        if self.aliased:
            return f"readings are too slow to tell a spin of {self.used:.6g} s"
        text = f"the field turns once in {self.period:.7g} +- {self.sigma:.2g} s"
        if np.isnan(self.used):
            return text
        if self.agrees:
            return f"{text}, as the phase does ({self.used:.7g} s)"
        return f"{text}, but the phase once in {self.used:.7g} s: the phase is WRONG"


def check_period(
    stamps: Int64,
    field: Floats,
    phase: Floats | None = None,
    *,
    good: npt.NDArray[np.bool_] | None = None,
) -> PeriodCheck:
    """Estimate the spin period from the spin-plane field, and hold a phase against it.

    Parameters
    ----------
    stamps : ndarray of int64, shape (time,)
        TT2000, nearly even; gaps allowed.
    field : ndarray, shape (time, 2 or 3)
        Apparent axes (they spin), nT; the first two are used.
    phase : ndarray, shape (time,), optional
        The phase that is used, radians.
    good : ndarray of bool, shape (time,), optional

    Raises
    ------
    CalibrationError
        Too few readings, or no tone that stands out.
    """
    if field.ndim != 2 or field.shape[1] < 2 or field.shape[0] != stamps.size:
        raise SamplesError(f"a field of shape {field.shape} found", remedy="give (time, 2 or 3)")
    kept = np.isfinite(field[:, :2]).all(axis=1)
    kept &= True if good is None else good
    if np.count_nonzero(kept) < PERIOD_SETTINGS.readings:
        raise CalibrationError(
            f"{np.count_nonzero(kept)} readings found, at least {PERIOD_SETTINGS.readings} needed",
            remedy="take a longer span",
        )
    seconds = (stamps[kept] - stamps[kept][0]) / SECOND
    plane = field[kept, 0] + 1j * field[kept, 1]
    plane = plane - np.median(plane.real) - 1j * np.median(plane.imag)
    size = np.abs(plane)
    most = PERIOD_SETTINGS.limit * MAD_TO_SIGMA * float(np.median(size))
    plane = np.asarray(plane * np.minimum(1.0, most / np.maximum(size, 1e-300)))
    cadence = float(np.median(np.diff(seconds)))
    used = float("nan")
    if phase is not None:
        known = np.flatnonzero(np.isfinite(phase))
        turns = (phase[known[-1]] - phase[known[0]]) / TURN if known.size > 1 else 0.0
        used = float((stamps[known[-1]] - stamps[known[0]]) / SECOND / turns) if turns > 0 else used
    if used < 2.0 * cadence:
        nan = float("nan")
        return PeriodCheck(period=nan, sigma=nan, used=used, tone=nan, agrees=True, aliased=True)
    rate, sigma, tone = _refined_frequency(seconds, plane, _top_frequency(seconds, plane, cadence))
    period, error = 1.0 / rate, sigma / rate**2
    agrees = bool(np.isnan(used) or abs(used - period) <= PERIOD_SETTINGS.contradiction * error)
    return PeriodCheck(period=period, sigma=error, used=used, tone=tone, agrees=agrees, aliased=False)


def _top_frequency(seconds: Floats, plane: npt.NDArray[np.complex128], cadence: float) -> float:
    """Return the frequency of the highest tone of negative frequency, Hz, on a grid four times as fine."""
    place = np.rint(seconds / cadence).astype(np.int64)
    span = int(place[-1]) + 1
    if place.size < (1.0 - PERIOD_SETTINGS.empty) * span:
        raise CalibrationError(
            f"{100 * (1 - place.size / span):.0f} % of the record is gaps", remedy="take a span with fewer"
        )
    even = np.zeros(span, dtype=np.complex128)
    even[place] = plane
    size = scipy.fft.next_fast_len(4 * span)
    power = np.abs(scipy.fft.fft(even, size)) ** 2
    # Negative frequencies, lowest first; those slower than two turns a record are the zero level's.
    falling = power[: size // 2 : -1]
    least = max(2 * size // span, 1)
    best = least + int(np.argmax(falling[least:]))
    if falling[best] < PERIOD_SETTINGS.tone_power * float(np.median(power)):
        raise CalibrationError(
            "no tone stands out of the spin-plane field",
            remedy="see whether the field spins, which axis is the spin axis, and the sense of the spin",
        )
    return (best + 1) / (size * cadence)


def _refined_frequency(
    seconds: Floats, plane: npt.NDArray[np.complex128], rate: float
) -> tuple[float, float, float]:
    """Return frequency and its sigma, Hz, and amplitude, from the phases of stretches of the record."""
    length = max(seconds[-1] / PERIOD_SETTINGS.stretches, PERIOD_SETTINGS.shortest / rate)
    number = int(seconds[-1] // length)
    if number < PERIOD_SETTINGS.fewest:
        raise CalibrationError(
            f"{seconds[-1] * rate:.1f} turns found,"
            f" at least {PERIOD_SETTINGS.fewest * PERIOD_SETTINGS.shortest:.0f} needed",
            remedy="take a longer span",
        )
    stretch = np.minimum((seconds / length).astype(np.int64), number - 1)
    still = plane * np.exp(1j * TURN * rate * seconds)
    count = np.bincount(stretch, minlength=number)
    parts = [np.bincount(stretch, part, number) for part in (still.real, still.imag)]
    filled = count > 0.25 * np.median(count)
    mean = (parts[0] + 1j * parts[1])[filled] / count[filled]
    middle = np.bincount(stretch, seconds, number)[filled] / count[filled]
    turned = np.unwrap(np.angle(mean)) / TURN
    apart, step = np.diff(middle), np.diff(turned)
    slope = (turned[-1] - turned[0]) / (middle[-1] - middle[0])
    residual = step - slope * apart
    # The field's direction is taken as a random walk: the ends' difference is the sum of the steps.
    sigma = float(np.sqrt(np.sum(residual**2) * residual.size / max(residual.size - 1, 1)))
    sigma = sigma / (middle[-1] - middle[0])
    # A field of one direction leaves the resolution of the arithmetic.
    return rate - slope, max(sigma, 1e-12 * rate), float(np.mean(np.abs(mean)))


TURN = 2.0 * np.pi


@dataclass(frozen=True, kw_only=True)
class PhaseSettings:
    """From marks to samples.

    Attributes
    ----------
    max_sigma : float
        A phase with a larger standard deviation is none, rad. Derived: 1 degree leaves 2 % of the spin-plane
        field turning.
    nominal : float
        A stated period is called wrong when the marks' differs by more than this part. Assumed: missions
        state their spin period to a percent.
    carried : float
        Turns for which the phase is extrapolated before the first and after the last mark. Assumed.
    cubic_error : float
        An error of the rate at both ends of a gap makes at most this part of it, times the gap, in the
        middle. Derived: Hermite's cubic through both ends.
    """

    max_sigma: float = float(np.deg2rad(1.0))
    nominal: float = 0.01
    carried: float = 1.0
    cubic_error: float = 0.15


PHASE_SETTINGS = PhaseSettings()

#: What becomes of samples where the phase jumps, and where marks are missing.
_CORRECTED_JUMP = (
    "marks between jumps that come back are taken back by their size, samples there carry phase_jump"
)

_AMBIGUOUS_JUMP = "nothing tells which side of it is right, and samples on both carry the flag phase_jump"

_BRIDGED = "samples between carry the flag phase_bridged, or no_phase where that is not sure enough"

_UNKNOWN = "samples without a phase carry the flag no_phase and have their field in turning axes only"


class PhaseFault(NamedTuple):
    """Something about the marks that was not as it should be, and what to do about it; a sentence each."""

    found: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
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
    faults : tuple of PhaseFault
        Everything that was not as it should be.
    """

    stamps: Int64
    phase: Floats
    sigma: Floats
    flag: npt.NDArray[np.uint32]
    marks: Marks
    nominal: float = float("nan")
    faults: tuple[PhaseFault, ...] = ()

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

    def summary(self) -> str:
        """Return one or more sentences: the period, the part of samples with a phase, and the faults."""
        known = 100.0 * float(self.good.mean()) if self.good.size else 0.0
        text = f"spin period {self.period:.6g} s, phase known for {known:.1f} % of {self.stamps.size} samples"
        return "; ".join((text, *self.reports))


def phase_from_pulses(
    pulses: Int64,
    stamps: Int64,
    *,
    nominal_period: float | None = None,
    mark_phase: float = 0.0,
    max_sigma: float = PHASE_SETTINGS.max_sigma,
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
    max_sigma : float
        Samples whose phase has a larger standard deviation have none, radians.

    Returns
    -------
    SpinPhase

    Raises
    ------
    CalibrationError
        With fewer than three pulses, or when they show no period.
    """
    marks = np.asarray(pulses, dtype=np.int64)
    return _from_marks(
        marks, np.zeros(marks.size), stamps, nominal_period, mark_phase, max_sigma, "Sun pulse"
    )


def phase_from_angle(
    times: Int64,
    angle: Floats,
    stamps: Int64,
    *,
    nominal_period: float,
    sense: int = 1,
    max_sigma: float = PHASE_SETTINGS.max_sigma,
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
        Stated spin period, s. Readings alone do not show it: an angle read every 10 s that moves on by a
        tenth of a turn may have made any number of turns besides.
    sense : int
        1 when the angle grows with time; -1 for one counted from XA to XP.
    max_sigma : float
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
    return _from_marks(times[known], turns, stamps, nominal_period, 0.0, max_sigma, "angle")


def _from_marks(
    times: Int64,
    turns: Floats,
    stamps: Int64,
    nominal: float | None,
    offset: float,
    max_sigma: float,
    kind: str,
) -> SpinPhase:
    order = np.argsort(times, kind="stable")
    times, turns = times[order], turns[order]
    once = np.concatenate([[True], np.diff(times) > 0]) if times.size else np.empty(0, dtype=bool)
    faults = []
    if not once.all():
        found = f"{np.count_nonzero(~once)} repeated {kind}s dropped"
        faults.append(PhaseFault(found, "see why the deliveries hold them twice; nothing is lost"))
    times, turns = times[once], turns[once]
    if times.size < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, at least 3 needed for a spin period",
            remedy="take a longer span, or state a period and an epoch",
        )
    seconds = (times - times[0]) / SECOND
    period = find_period(seconds, turns, nominal)
    kept = are_consistent(seconds, turns, period)
    if np.count_nonzero(kept) < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, none of them whole turns of {period:.6g} s from its neighbours",
            remedy="see whether the times are those of one Sun sensor",
        )
    chosen = np.flatnonzero(kept)
    some = thin_readings(seconds[chosen], turns[chosen], period)
    thinned_out, chosen = times[chosen[~some]], chosen[some]
    if thinned_out.size and chosen.size > 2:
        # Neighbours of a fine angle hardly move: only now is it seen whether readings agree over a turn.
        chosen = chosen[are_consistent(seconds[chosen], turns[chosen], period)]
    if chosen.size < 3:
        raise CalibrationError(
            f"{times.size} {kind}s found, of {seconds[-1] / period:.2g} turns or not {period:.6g} s a turn",
            remedy="take a span of several turns",
        )
    counted = count_turns(times[chosen], turns[chosen], period)
    marks = correct_jumps(counted)
    used = np.zeros(times.size, dtype=bool)
    used[np.searchsorted(times, np.concatenate([marks.time, thinned_out]))] = True
    wrong = times[~used]
    spurious = int(np.count_nonzero((wrong >= stamps.min()) & (wrong <= stamps.max()))) if stamps.size else 0
    if spurious:
        found = f"{spurious} spurious {kind}s dropped"
        faults.append(
            PhaseFault(found, "see what else the Sun sensor saw; the rest tells the phase without them")
        )
    covered = _turns_between(marks, stamps)
    faults += _mark_faults(counted, covered, nominal, kind) + _jump_faults(marks, covered)
    return _at_samples(marks, np.asarray(stamps, dtype=np.int64), offset, max_sigma, nominal, kind, faults)


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


def _mark_faults(marks: Marks, covered: Floats, nominal: float | None, kind: str) -> list[PhaseFault]:
    """Return what is wrong with the marks around the samples; `covered` is of `_turns_between`."""
    faults = []
    usual = float(np.median(marks.period))
    if nominal is not None and abs(usual / nominal - 1.0) > PHASE_SETTINGS.nominal:
        found = f"the stated spin period of {nominal:.6g} s is wrong: {usual:.6g} s seen"
        faults.append(PhaseFault(found, f"state 'spin: {usual:.6g} s' under the mission's periods"))
    missing = int(np.minimum(marks.missing_turns, np.floor(np.maximum(covered, 0.0))).sum())
    if kind == "Sun pulse" and missing:
        faults.append(PhaseFault(f"{missing} Sun pulses missing", f"deliver them; {_BRIDGED}"))
    lost = np.flatnonzero(marks.uncountable & (covered > 2.0 * PHASE_SETTINGS.carried))
    if lost.size:
        longest = float((np.diff(marks.time)[lost] / SECOND).max())
        found = f"{lost.size} gap(s) too long to count turns, the longest {longest:.0f} s"
        faults.append(PhaseFault(found, f"deliver more {kind}s; {_UNKNOWN}"))
    return faults


def _jump_faults(marks: Marks, covered: Floats) -> list[PhaseFault]:
    """Return where the phase jumps: the first ten places, and how many more there are."""
    places = np.flatnonzero(marks.jumped & (covered >= 0.0))
    touched = marks.shifted | marks.ambiguous
    if not places.size and not np.any((touched[1:] | touched[:-1]) & (covered >= 0.0)):
        return []
    remedy = "see the Sun sensor and its clock; "
    remedy += _AMBIGUOUS_JUMP if marks.ambiguous.any() else _CORRECTED_JUMP
    found = []
    for place in places[:10]:
        size, when = 360.0 * marks.residual[place], utc_text(int(marks.time[place]))
        found.append(PhaseFault(f"the phase jumps by {size:+.2f} degrees after {when}", remedy))
    if not found:
        found.append(PhaseFault("the phase jumps before or after the samples", remedy))
    return [*found, PhaseFault(f"and {places.size - 10} more jumps", remedy)] if places.size > 10 else found


def _at_samples(
    marks: Marks,
    stamps: Int64,
    offset: float,
    max_sigma: float,
    nominal: float | None,
    kind: str,
    faults: list[PhaseFault],
) -> SpinPhase:
    """Interpolate the phase from the marks to the samples."""
    place = np.clip(np.searchsorted(marks.time, stamps, side="right") - 1, 0, marks.time.size - 2)
    apart = np.diff(marks.time) / SECOND
    share = ((stamps - marks.time[place]) / SECOND) / apart[place]
    advance = np.diff(marks.turn)[place]
    phase = marks.turn[place] + share * advance
    flag = np.zeros(stamps.size, dtype=np.uint32)
    sigma = np.full(stamps.size, marks.sigma)
    bridged = (marks.gap[place]) & (share > 0) & (share < 1)
    at = place[bridged]
    # What a cubic with the rates at both ends has above the straight line.
    before = marks.rate[at] * apart[at] - advance[bridged]
    after = marks.rate[at + 1] * apart[at] - advance[bridged]
    inside = share[bridged]
    phase[bridged] += inside * (1.0 - inside) * ((1.0 - inside) * before - inside * after)
    sigma[bridged] = np.hypot(sigma[bridged], PHASE_SETTINGS.cubic_error * marks.predicted_sigma[at])
    flag[bridged] |= np.uint32(Flag.PHASE_BRIDGED)
    # In a gap whose turns cannot be counted the phase is extrapolated as before the first and after the last.
    outside = (share < 0) | (share > 1) | (marks.uncountable[place] & (share > 0) & (share < 1))
    end = np.where(share < 0.5, place, place + 1)
    since = (stamps - marks.time[end]) / SECOND * marks.rate[end]
    phase = np.where(outside, marks.turn[end] + since, phase)
    flag[outside] |= np.uint32(Flag.PHASE_BRIDGED)
    jump = marks.jumped[place] & (share > 0) & (share < 1)
    touched = marks.shifted | marks.ambiguous
    flag[jump] |= np.uint32(Flag.PHASE_JUMP)
    flag[touched[place] | (touched[place + 1] & (share >= 1))] |= np.uint32(Flag.PHASE_JUMP)
    sigma[marks.shifted[place]] = np.hypot(
        sigma[marks.shifted[place]], np.hypot.reduce(marks.predicted_sigma[marks.jumped])
    )
    bad = jump | (outside & (np.abs(since) > PHASE_SETTINGS.carried)) | (TURN * sigma > max_sigma)
    flag[bad] &= ~np.uint32(Flag.PHASE_BRIDGED)
    flag[bad] |= np.uint32(Flag.NO_PHASE)
    beyond = int(np.count_nonzero(bad & (stamps < marks.time[0]) | bad & (stamps > marks.time[-1])))
    if beyond:
        found = f"{beyond} samples lie beyond the first or last {kind}, which tell no phase there"
        faults.append(PhaseFault(found, f"deliver more {kind}s; {_UNKNOWN}"))
    phase = np.where(bad, np.nan, TURN * phase + offset)
    if not np.isfinite(phase).any() and stamps.size:
        found = f"no sample has a phase; marks scatter by {360 * marks.sigma:.2g} degrees"
        faults.append(PhaseFault(found, f"see whether the times are those of one Sun sensor; {_UNKNOWN}"))
    stated = float("nan") if nominal is None else float(nominal)
    return SpinPhase(
        stamps=stamps,
        phase=phase,
        sigma=TURN * sigma,
        flag=flag,
        marks=marks,
        nominal=stated,
        faults=tuple(faults),
    )
