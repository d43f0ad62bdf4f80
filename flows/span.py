"""The span a flow works on, as a person gives it: two UTC days, half-open."""

from __future__ import annotations

import datetime as dt
from typing import Self, TypeAlias

from pydantic import BaseModel, ConfigDict, model_validator

DateOrNone: TypeAlias = dt.date | None


class Span(BaseModel):
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
