"""Spans of time as people and programs give them, half-open."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from typing import Any

import numpy as np

from inflight.catalog.records import utc_day
from inflight.errors import CatalogError
from inflight.time import day_bounds, day_of, parse_utc, to_tt2000

#: An instant: TT2000 as an integer, or UTC as text, date or datetime64.
Instant = int | np.integer[Any] | str | dt.date | dt.datetime | np.datetime64
#: A span: a slice of instants, one day, or None for everything.
TimeSpan = slice | str | dt.date | np.datetime64 | None


@dataclass(frozen=True)
class Span:
    """Half-open span ``[start, end)`` in TT2000; None is open-ended."""

    start: int | None
    end: int | None

    def first_day(self) -> dt.date | None:
        """Return the first UTC day the span touches."""
        return None if self.start is None else as_date(day_of(np.int64(self.start)))

    def last_day(self) -> dt.date | None:
        """Return the last UTC day the span touches."""
        return None if self.end is None else as_date(day_of(np.int64(self.end - 1)))


def parse_span(time: TimeSpan) -> Span:
    """Read a span: None, one day, or a slice whose stop is excluded.

    Raises
    ------
    CatalogError
        When it is none of these, has a step, or ends before it starts.
    """
    if time is None:
        return Span(None, None)
    if not isinstance(time, slice):
        return Span(*day_bounds(utc_day(_utc(time))))
    if time.step is not None:
        raise CatalogError(f"a span has no step, found {time.step!r}", remedy="select after opening")
    start = None if time.start is None else instant(time.start)
    end = None if time.stop is None else instant(time.stop)
    if start is not None and end is not None and end < start:
        raise CatalogError(f"span ends before it starts: {time.start} to {time.stop}", remedy="swap the two")
    return Span(start, end)


def instant(value: Instant) -> int:
    """Return an instant as TT2000; integers are taken as they are.

    Raises
    ------
    CatalogError
        When it is no time.
    """
    if isinstance(value, int | np.integer):
        return int(value)
    return int(to_tt2000(_utc(value)))


def as_date(day: Any) -> dt.date:
    """Return a UTC day as a date."""
    date: dt.date = utc_day(day).astype(dt.date)
    return date


def _utc(value: str | dt.date | np.datetime64) -> np.datetime64:
    try:
        return parse_utc(value)
    except ValueError as error:
        raise CatalogError(str(error)) from None
