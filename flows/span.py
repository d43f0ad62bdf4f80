"""The span a flow works on, as a person gives it: two UTC days, half-open."""

from __future__ import annotations

import datetime as dt
from typing import Self, TypeAlias

from pydantic import BaseModel, ConfigDict, model_validator

from inflight.errors import SettingsError

DateOrNone: TypeAlias = dt.date | None


class DaySpan(BaseModel):
    """Half-open span of UTC days ``[start, end)``; an absent end means all there is on that side."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: DateOrNone = None
    end: DateOrNone = None

    @model_validator(mode="after")
    def _runs_forward(self) -> Self:
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise ValueError(
                f"the span from {self.start} to {self.end} holds no day; "
                "the end is the day after the last one"
            )
        return self

    def as_text(self) -> tuple[str | None, str | None]:
        """Return both ends as ``YYYY-MM-DD``, as the steps take them."""
        start = None if self.start is None else self.start.isoformat()
        return start, None if self.end is None else self.end.isoformat()

    def with_neighbours(self) -> DaySpan:
        """Return the span with a day more on either side: days are made with their neighbours' edges."""
        day = dt.timedelta(days=1)
        return DaySpan(start=self.start and self.start - day, end=self.end and self.end + day)


def month_span(month: str | None, today: dt.date) -> DaySpan:
    """Return the days of a calendar month.

    Parameters
    ----------
    month : str or None
        ``YYYY-MM``; the last month that is over today when None.
    today : date
        UTC.

    Raises
    ------
    SettingsError
        When the text names no month.
    """
    try:
        begin = (
            (today.replace(day=1) - dt.timedelta(days=1)).replace(day=1)
            if month is None
            else dt.datetime.strptime(month, "%Y-%m").replace(tzinfo=dt.UTC).date()
        )
    except ValueError:
        raise SettingsError(f"{month!r} is no month", remedy="write it as YYYY-MM") from None
    return DaySpan(start=begin, end=(begin + dt.timedelta(days=31)).replace(day=1))
