"""Time: TT2000, UTC, days, and days since 2000 (MJD2000).

TT2000 is integer nanoseconds since 2000-01-01T12:00:00 TT, the one time of stores and mathematics. It
counts SI seconds, so leap seconds are ordinary seconds in it. UTC is what people see: as
``datetime64[ns]``, which has no stamp for an inserted second; such a sample carries the stamp of
the second before it and the flag ``LEAP_SECOND``. A *day* is a UTC day and has 86 401 s when it
ends with a leap second. MJD2000 is the thesis' day number: 0 is 2000-01-01T00:00 UTC. All intervals are
half-open.

Leap-second dates: IERS Bulletin C (TAI - UTC since 1972); CDF's TT2000 definition: TT = TAI + 32.184 s.
"""

from __future__ import annotations

import datetime as dt
import io
import re
from fractions import Fraction
from typing import cast

import numpy as np
import numpy.typing as npt

from inflight.arrays import Floats

SECOND = 1_000_000_000

DAY = 86_400 * SECOND

#: Neighbouring samples further apart than this many cadences have a gap between them.
GAP = 1.5

#: "No time": CDF's fill value and pad value of CDF_TIME_TT2000.
TT2000_FILL = np.int64(-(2**63))

TT2000_PAD = np.int64(-(2**63) + 1)

#: UTC dates on which TAI - UTC became 10, 11, ... seconds.
_LEAP_DATES = (
    np.loadtxt(
        io.StringIO(
            """1972-01-01 1972-07-01 1973-01-01 1974-01-01 1975-01-01 1976-01-01 1977-01-01
        1978-01-01 1979-01-01 1980-01-01 1981-07-01 1982-07-01 1983-07-01 1985-07-01
        1988-01-01 1990-01-01 1991-01-01 1992-07-01 1993-07-01 1994-07-01 1996-01-01
        1997-07-01 1999-01-01 2006-01-01 2009-01-01 2012-07-01 2015-07-01 2017-01-01"""
        ),
        dtype="U10",
    )
    .ravel()
    .astype("datetime64[ns]")
)

_TAI_MINUS_UTC = np.arange(10, 10 + _LEAP_DATES.size, dtype=np.int64)

_J2000_UTC_LABEL = np.datetime64("2000-01-01T12:00:00", "ns")

_TT_MINUS_TAI = 32_184_000_000

#: TT2000 at which each offset begins: the first instant after the inserted second.
_LEAP_TT2000 = (_LEAP_DATES - _J2000_UTC_LABEL).astype(np.int64) + _TAI_MINUS_UTC * SECOND + _TT_MINUS_TAI

_LAST_TICK = np.iinfo(np.int64).max

Int64 = npt.NDArray[np.int64]

Datetimes = npt.NDArray[np.datetime64]

DayLike = str | dt.date | np.datetime64


def to_tt2000(utc: npt.ArrayLike) -> Int64:
    """Convert UTC stamps to TT2000.

    Parameters
    ----------
    utc : array_like of datetime64
        Any shape. Stamps before 1972 take the first offset (10 s); NaT gives `TT2000_FILL`.

    Returns
    -------
    ndarray of int64
        Nanoseconds since 2000-01-01T12:00:00 TT, same shape.
    """
    stamps = np.asarray(utc, dtype="datetime64[ns]")
    index = np.clip(np.searchsorted(_LEAP_DATES, stamps, side="right") - 1, 0, None)
    ticks = (stamps - _J2000_UTC_LABEL).astype(np.int64) + _TAI_MINUS_UTC[index] * SECOND + _TT_MINUS_TAI
    return np.where(np.isnat(stamps), TT2000_FILL, ticks).astype(np.int64)


def to_utc(tt2000: npt.ArrayLike) -> Datetimes:
    """Convert TT2000 to UTC stamps; samples inside an inserted second get the stamp one second earlier.

    Parameters
    ----------
    tt2000 : array_like of int64
        Nanoseconds since 2000-01-01T12:00:00 TT, any shape; fill and pad values give NaT.

    Returns
    -------
    ndarray of datetime64[ns]
    """
    ticks = np.asarray(tt2000, dtype=np.int64)
    offset = _one_offset(ticks)
    if offset is not None:
        shift = _J2000_UTC_LABEL.astype(np.int64) - _TT_MINUS_TAI - offset * SECOND
        return np.asarray((ticks + shift).view("datetime64[ns]"))
    missing = ticks <= TT2000_PAD
    ticks = np.where(missing, 0, ticks)
    index = np.clip(np.searchsorted(_LEAP_TT2000, ticks, side="right") - 1, 0, None)
    label = ticks - _TT_MINUS_TAI - _TAI_MINUS_UTC[index] * SECOND - in_leap_second(ticks) * SECOND
    stamps = _J2000_UTC_LABEL + label.astype("timedelta64[ns]")
    return np.where(missing, np.datetime64("NaT", "ns"), stamps)


def utc_text(tt2000: int) -> str:
    """Return a TT2000 as UTC to the second, such as ``2005-01-07T12:00:00Z``."""
    return f"{to_utc(tt2000).astype('datetime64[s]')}Z"


def in_leap_second(tt2000: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return True where a TT2000 lies inside an inserted second (23:59:60)."""
    ticks = np.asarray(tt2000, dtype=np.int64)
    if _one_offset(ticks) is not None:
        return np.zeros(ticks.shape, dtype=bool)
    following = np.searchsorted(_LEAP_TT2000, ticks, side="right")
    upcoming = _LEAP_TT2000[np.minimum(following, _LEAP_TT2000.size - 1)]
    return (following < _LEAP_TT2000.size) & (following > 0) & (upcoming - ticks <= SECOND)


def _one_offset(ticks: Int64) -> int | None:
    """Return TAI - UTC in seconds where all times have one and none is in an inserted second; None otherwise.

    So it is on nearly every day: two looks at the table of leap seconds instead of one a sample.
    """
    if ticks.ndim == 0 or ticks.size == 0:
        return None
    low, high = int(ticks.min()), int(ticks.max())
    if low <= TT2000_PAD or high > _LAST_TICK - SECOND:
        return None
    first, last = np.searchsorted(_LEAP_TT2000, [low, high + SECOND], side="right")
    return int(_TAI_MINUS_UTC[max(first - 1, 0)]) if first == last else None


_UTC_TEXT = re.compile(r"^\d{4}(-\d\d){0,2}([T ]\d\d(:\d\d){1,2}(\.\d{1,9})?)?$")


def parse_utc(text: str | dt.date | dt.datetime | np.datetime64) -> np.datetime64:
    """Read a UTC date or time as a person writes it; a trailing ``Z`` is allowed, other zones are not.

    Raises
    ------
    ValueError
        When the text is no ISO 8601 date or time in UTC.
    """
    if isinstance(text, dt.datetime) and text.tzinfo is not None:
        text = text.astimezone(dt.UTC).replace(tzinfo=None)
    if isinstance(text, str):
        text = text.strip().removesuffix("Z").removesuffix("+00:00")
    try:
        # numpy alone would also take "now", an empty text as no time, and shift by any zone.
        if not _UTC_TEXT.match(str(text)):
            raise ValueError
        return cast("np.datetime64", np.array(str(text), dtype="datetime64[ns]")[()])
    except ValueError:
        raise ValueError(
            f"{text!r} is no UTC date or time; write 2005-01-31 or 2005-01-31T12:00:00"
        ) from None


def day_of(tt2000: npt.ArrayLike) -> Datetimes:
    """Return the UTC day (datetime64[D]) each TT2000 belongs to."""
    return to_utc(tt2000).astype("datetime64[D]")


def usual_step(stamps: Int64, alone: int = 1) -> int:
    """Return the median distance of neighbouring stamps, ns; `alone` for fewer than two.

    Steps are nearly all alike, the slowest case of a partition: the commonest one is tried first.
    """
    if stamps.size < 2:
        return alone
    steps = np.diff(stamps)
    likely = steps[steps.size // 2]
    below, upto = int(np.count_nonzero(steps < likely)), int(np.count_nonzero(steps <= likely))
    if below <= (steps.size - 1) // 2 and upto > steps.size // 2:
        return int(likely)
    return int(np.median(steps))


def other_cadence(stamps: Int64, stated: int) -> str:
    """Return in words that stamps lie at another distance than stated, ns; empty when they do not.

    Samples further apart than one and a half stated cadences count as gaps (`GAP`), all of them here.
    """
    step = usual_step(np.sort(stamps), stated)
    if step <= 0 or 1.0 / GAP < step / stated < GAP:
        return ""
    own, there = f"{step / SECOND:.3g} s", f"{stated / SECOND:.3g} s"
    return f"samples are {own} apart, but the mission file states {there}: write 'cadence: {own}'"


def as_day(day: DayLike) -> np.datetime64:
    """Return a UTC day as datetime64[D]."""
    return cast("np.datetime64", np.array(day, dtype="datetime64[D]")[()])


def day_bounds(day: DayLike) -> tuple[int, int]:
    """Return the half-open TT2000 span of a UTC day; its length is 86 401 s when a leap second ends it."""
    start = as_day(day)
    bounds = to_tt2000(np.array([start, start + 1], dtype="datetime64[ns]"))
    return int(bounds[0]), int(bounds[1])


def is_within(day: np.datetime64, start: DayLike | None, end: DayLike | None) -> bool:
    """Return True when a UTC day lies in the half-open span of days; None is open."""
    return bool((start is None or day >= as_day(start)) and (end is None or day < as_day(end)))


def day_range(start: DayLike, end: DayLike) -> list[np.datetime64]:
    """Return the UTC days of the half-open span ``[start, end)``."""
    first, count = as_day(start), int((as_day(end) - as_day(start)).astype(np.int64))
    return [as_day(first + np.timedelta64(step, "D")) for step in range(count)]


_DURATION = re.compile(r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(ns|us|ms|s|min|h|d)\s*$")

_UNIT_NS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": SECOND, "min": 60 * SECOND, "h": 3600 * SECOND, "d": DAY}


def parse_duration(text: str) -> int:
    """Read a duration such as ``10 s``, ``15 ms`` or ``260.5 d``; return integer nanoseconds.

    Raises
    ------
    ValueError
        When number or unit is missing or unknown.
    """
    match = _DURATION.match(str(text))
    if not match:
        raise ValueError(
            f"{text!r} is no duration; write a number and one of {', '.join(_UNIT_NS)}, as in '10 s'"
        )
    return round(Fraction(match[1]) * _UNIT_NS[match[2]])


_EPOCH = np.datetime64("2000-01-01T00:00:00", "ns")

_DAY_NS = 86_400_000_000_000


def mjd2000(tt2000: npt.ArrayLike) -> Floats:
    """Return days of UTC since 2000-01-01T00:00 of TT2000 times, as Yin (2010) counts them; same shape."""
    return np.asarray((to_utc(tt2000) - _EPOCH) / np.timedelta64(1, "D"), dtype=np.float64)


def from_mjd2000(mjd: npt.ArrayLike) -> Int64:
    """Return the TT2000 of day numbers since 2000-01-01T00:00 UTC; same shape."""
    ticks = np.rint(np.asarray(mjd, dtype=np.float64) * _DAY_NS).astype(np.int64)
    return to_tt2000(_EPOCH + ticks.astype("timedelta64[ns]"))
