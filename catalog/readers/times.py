"""Times of a file as TT2000, exact to the nanosecond.

Numbers count a CF unit since an epoch without leap seconds ("seconds since 2000-01-01 12:00:00", CF
conventions 1.10, section 4.4) or are TT2000 themselves; text follows ISO 8601 or a strptime layout.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import numpy.typing as npt

from inflight.catalog.readers.patterns import NameSpan
from inflight.catalog.readers.source import Array, Source, Variable
from inflight.errors import ContentError
from inflight.instruments import Files
from inflight.time import DAY, SECOND, TT2000_FILL, TT2000_PAD, Datetimes, Int64, parse_utc, to_tt2000

_CF = re.compile(r"^\s*([A-Za-zµ]+)\s+since\s+(.+?)\s*(?:UTC|Z)?\s*$")
_UNIT_NS = {
    "nanosecond": 1,
    "ns": 1,
    "microsecond": 10**3,
    "us": 10**3,
    "millisecond": 10**6,
    "ms": 10**6,
    "second": SECOND,
    "sec": SECOND,
    "s": SECOND,
    "minute": 60 * SECOND,
    "min": 60 * SECOND,
    "hour": 3600 * SECOND,
    "h": 3600 * SECOND,
    "day": DAY,
    "d": DAY,
}
_HALF_DAY = DAY // 2


def is_cf_unit(text: str | None) -> bool:
    """Return True when a unit is one of time since an epoch."""
    match = _CF.match(text or "")
    return bool(match) and _unit_length(match[1] if match else "") is not None


def from_cf(values: Array, unit: str, fill: tuple[float, ...] = ()) -> Int64:
    """Convert counts since a UTC epoch to TT2000; fill and not finite give `TT2000_FILL`.

    Whole units are converted as integers and only the fraction as a float, so that nothing is lost to
    the 53 bits of a product.

    Raises
    ------
    ValueError
        When the unit is no time since an epoch, or a count lies outside the years 1678 to 2261.
    """
    match = _CF.match(unit)
    length = _unit_length(match[1]) if match else None
    if match is None or length is None:
        raise ValueError(f"{unit!r} is no unit of time; write 'seconds since 2000-01-01 12:00:00'")
    epoch = parse_utc(match[2]).astype(np.int64)
    missing = np.isin(values, np.array(fill)) if fill else np.zeros(values.shape, dtype=bool)
    if values.dtype.kind == "f":
        missing |= ~np.isfinite(values)
    counts = np.where(missing, 0, values)
    whole = np.floor(counts) if counts.dtype.kind == "f" else counts
    if counts.size and float(np.abs(whole).max()) * length > 9.2e18 - abs(float(epoch)):
        raise ValueError(f"a time of {float(np.abs(counts).max()):g} {unit!r} lies outside 1678 to 2261")
    nanoseconds = whole.astype(np.int64) * length
    if counts.dtype.kind == "f":
        nanoseconds += np.rint((counts - whole).astype(np.float64) * length).astype(np.int64)
    ticks = to_tt2000((nanoseconds + epoch).astype("datetime64[ns]"))
    return np.where(missing, TT2000_FILL, ticks)


def from_tt2000(values: Array) -> Int64:
    """Return counts that are TT2000 already as int64; the fill and pad values of CDF become `TT2000_FILL`."""
    ticks = values.astype(np.int64)
    return np.where(ticks <= TT2000_PAD, TT2000_FILL, ticks)


def _unit_length(text: str) -> int | None:
    plain = text.replace("µ", "u")
    return _UNIT_NS.get(plain) or _UNIT_NS.get(plain.lower().removesuffix("s") or plain)


def decode_times(source: Source, files: Files, span: NameSpan) -> Int64:
    """Return the times of a file's rows, `clock_offset` not yet added.

    Parameters
    ----------
    source : Source
        An open file.
    files : Files
        The time options of the mission YAML.
    span : NameSpan
        The span of the file's name; it completes times without a date.

    Returns
    -------
    ndarray of int64
        TT2000 of shape (row,) or (report, sample); `TT2000_FILL` where a row has no time.

    Raises
    ------
    ContentError
        When a variable is missing or its values are no times under the options given.
    """
    names = files.time or []
    if not names:
        raise _error(source, "the mission YAML names no 'time' variable", "add 'time' or 'time_start'")
    variables = [source.read(name) for name in names]
    try:
        if len(variables) > 1 or files.time_format is not None:
            return _from_text([variable.values for variable in variables], files, span, source)
        return _from_variable(variables[0], files, span, source)
    except (ValueError, OverflowError) as error:
        if isinstance(error, ContentError):
            raise
        raise _error(
            source, f"variable {names[0]!r}: {error}", "correct 'time_unit' or 'time_format'"
        ) from None


def _from_variable(variable: Variable, files: Files, span: NameSpan, source: Source) -> Int64:
    values = variable.values
    if files.time_unit == "tt2000":
        return from_tt2000(values)
    if files.time_unit is not None:
        numbers = values.astype(np.float64) if values.dtype.kind in "OUST" else values
        return from_cf(numbers, files.time_unit, variable.fill)
    if variable.times is not None:
        return variable.times
    if values.dtype.kind == "M":
        return to_tt2000(values)
    if values.dtype.kind in "OUST":
        return _from_text([values], files, span, source)
    raise _error(
        source,
        "the times are plain numbers",
        "say in 'time_unit' what they count, as in 'seconds since 2000-01-01 12:00:00'",
    )


def _from_text(columns: list[Array], files: Files, span: NameSpan, source: Source) -> Int64:
    text = _as_text(columns[0])
    for column in columns[1:]:
        text = np.strings.add(np.strings.add(text, " "), _as_text(column))
    layout = files.time_format
    if layout is None:
        return _from_iso(text, source)
    if re.search(r"%[djxcDF]", layout):
        if not re.search(r"%[YycxDFG]", layout):
            return _without_year(text, layout, span, source)
        return to_tt2000(_strptime(text, layout, source))
    return _without_date(text, layout, span, source)


def _as_text(values: Array) -> npt.NDArray[np.str_]:
    if values.dtype.kind == "S":
        return np.strings.strip(np.strings.decode(values, "latin-1"))
    return np.strings.strip(values.astype(np.str_))


def _from_iso(text: npt.NDArray[np.str_], source: Source) -> Int64:
    """Read ISO 8601; second 60 is the inserted leap second."""
    plain = np.strings.replace(np.strings.replace(text, " ", "T"), "Z", "")
    leaping = np.strings.find(plain, ":60") == 16
    plain = np.where(leaping, np.strings.replace(plain, ":60", ":59"), plain)
    try:
        stamps = plain.astype("datetime64[ns]")
    except ValueError as error:
        raise _error(source, f"the times are not ISO 8601 ({error})", "give 'time_format'") from None
    return np.asarray(to_tt2000(stamps) + leaping * SECOND)


def _strptime(text: npt.NDArray[np.str_], layout: str, source: Source) -> Datetimes:
    import pandas as pd

    parsed = pd.to_datetime(pd.Series(text), format=layout, errors="coerce")
    bad = np.flatnonzero(parsed.isna().to_numpy() & (text != "") & (text != "nan"))
    if bad.size:
        raise _error(
            source,
            f"row {bad[0] + 1}: {str(text[bad[0]])!r} is no time of the form {layout!r}",
            "correct 'time', 'time_format' or 'skip'",
        )
    return np.asarray(parsed.to_numpy(dtype="datetime64[ns]"))


def _without_year(text: npt.NDArray[np.str_], layout: str, span: NameSpan, source: Source) -> Int64:
    """Give each row the year that brings it nearest to the day in the file's name."""
    day = _named_day(source, span)
    year = int(str(day)[:4])
    best: Any = None
    for candidate in (year - 1, year, year + 1):
        stamps = _strptime(np.strings.add(f"{candidate} ", text), f"%Y {layout}", source)
        distance = np.abs((stamps - day.astype("datetime64[ns]")).astype(np.int64))
        if best is None:
            best, nearest = stamps, distance
        best, nearest = np.where(distance < nearest, stamps, best), np.minimum(distance, nearest)
    return to_tt2000(best)


def _without_date(text: npt.NDArray[np.str_], layout: str, span: NameSpan, source: Source) -> Int64:
    """Place times of day: a fall of more than 12 h is midnight; the name's day is the one with most rows."""
    day = _named_day(source, span)
    stamps = _strptime(np.strings.add("1970-01-01 ", text), f"%Y-%m-%d {layout}", source)
    steps = np.diff(stamps.astype(np.int64))
    midnights = np.concatenate([[0], np.cumsum(steps < -_HALF_DAY)]).astype(np.int64)
    own = int(np.bincount(midnights).argmax()) if midnights.size else 0
    shift = (midnights - own)[: stamps.size] * np.timedelta64(DAY, "ns")
    return to_tt2000(stamps + shift + (day.astype("datetime64[ns]") - np.datetime64("1970-01-01", "ns")))


def _named_day(source: Source, span: NameSpan) -> np.datetime64:
    if span.day is None:
        raise _error(
            source, "the times have no date and the file's name has none", "put {day:...} into 'pattern'"
        )
    return span.day


def _error(source: Source, message: str, remedy: str) -> ContentError:
    return ContentError(message, remedy=remedy, file=str(source.path))
