"""Times of HAPI: restricted ISO 8601 in UTC, read and written exactly; leap seconds have second 60.

Reference: HAPI data access specification 3.2, sections 3.7.6.1 and 3.7.6.2.
"""

from __future__ import annotations

import datetime as dt
import re
from typing import Final

import numpy as np
import numpy.typing as npt

from inflight.time import SECOND, day_bounds, in_leap_second, to_utc

#: Characters of a time in a record: nanoseconds, so that no two samples share one.
LENGTH: Final = len("2005-01-01T00:00:00.000000000Z")

_TIME: Final = re.compile(
    r"(?P<year>\d{4})(?:-(?P<ordinal>\d{3})|-(?P<month>\d\d)(?:-(?P<day>\d\d))?)?"
    r"(?:T(?P<hour>\d\d)(?::(?P<minute>\d\d)(?::(?P<second>\d\d)(?:\.(?P<fraction>\d*))?)?)?)?Z?",
    re.ASCII,
)
#: Years that TT2000 can count with room to spare; beyond, a time is before or after everything.
_YEARS: Final = (1710, 2290)


def parse_time(text: str) -> int:
    """Read a time of a request; elements left out have their smallest value.

    Parameters
    ----------
    text : str
        ``yyyy-mm-ddThh:mm:ss.sssZ`` or ``yyyy-dddThh:mm:ss.sssZ``, cut anywhere between elements, with or
        without ``Z``; ``T24:00`` ends a day, and second 60 is allowed in a leap second.

    Returns
    -------
    int
        TT2000 of the first nanosecond that is not before it.

    Raises
    ------
    ValueError
        When it is no such time.
    """
    found = _TIME.fullmatch(text)
    if found is None or (found["hour"] and found["month"] and not found["day"]):
        raise ValueError("no time of the form yyyy-mm-ddThh:mm:ss.sssZ or yyyy-dddThh:mm:ss.sssZ")
    if found["hour"] and not (found["ordinal"] or found["month"]):
        raise ValueError("a time of day without a day")
    date = _date(found)
    hour, minute, second = (int(found[name] or 0) for name in ("hour", "minute", "second"))
    fraction = found["fraction"] or ""
    # Rounded up: a sample before the time asked for is not at or after it.
    part = -(-int(fraction or 0) * SECOND // int(10 ** len(fraction)))
    if hour > 24 or minute > 59 or second > 60 or (hour == 24 and (minute or second or part)):
        raise ValueError("an hour, minute or second that does not exist")
    if not _YEARS[0] <= date.year <= _YEARS[1]:
        return int(np.iinfo(np.int64).min if date.year < _YEARS[0] else np.iinfo(np.int64).max)
    start, end = day_bounds(np.datetime64(date, "D"))
    if hour == 24:
        return end
    whole = start + ((60 * hour + minute) * 60 + second) * SECOND
    if second == 60 and ((hour, minute) != (23, 59) or whole >= end):
        raise ValueError("no leap second was inserted there")
    return whole + part


def _date(found: re.Match[str]) -> dt.date:
    year = int(found["year"])
    if found["ordinal"]:
        ordinal = int(found["ordinal"])
        days = (dt.date(year + 1, 1, 1) - dt.date(year, 1, 1)).days if year < dt.MAXYEAR else 365
        if not 1 <= ordinal <= days:
            raise ValueError("no such day of the year")
        return dt.date(year, 1, 1) + dt.timedelta(days=ordinal - 1)
    return dt.date(year, int(found["month"] or 1), int(found["day"] or 1))


def day_text(day: dt.date) -> str:
    """Return the beginning of a UTC day as HAPI writes it."""
    return f"{day.isoformat()}T00:00:00Z"


def duration_text(ns: int) -> str:
    """Return a distance of samples as an ISO 8601 duration, such as ``PT0.1S``."""
    whole, part = divmod(ns, SECOND)
    return f"PT{whole}.{part:09d}".rstrip("0").rstrip(".") + "S" if part else f"PT{whole}S"


def time_texts(tt2000: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """Return the times of samples of one UTC day as text.

    Parameters
    ----------
    tt2000 : ndarray of int64, shape (n,)
        All in one UTC day; n > 0.

    Returns
    -------
    ndarray of uint8, shape (n, 30)
        ASCII, as in ``2016-12-31T23:59:60.250000000Z``; ordered as `tt2000` is, leap seconds, too.
    """
    utc = to_utc(tt2000)
    day = utc[0].astype("datetime64[D]")
    ns = (utc - day).astype(np.int64)
    seconds, fraction = np.divmod(ns, SECOND)
    minutes, second = np.divmod(seconds, 60)
    hour, minute = np.divmod(minutes, 60)
    second = second + in_leap_second(tt2000)
    texts = np.empty((tt2000.size, LENGTH), dtype=np.uint8)
    texts[:] = np.frombuffer(f"{day}T00:00:00.000000000Z".encode(), dtype=np.uint8)
    for column, digits, values in ((11, 2, hour), (14, 2, minute), (17, 2, second), (20, 9, fraction)):
        for place in range(column + digits - 1, column - 1, -1):
            texts[:, place] += (values // 10 ** (column + digits - 1 - place) % 10).astype(np.uint8)
    return texts
