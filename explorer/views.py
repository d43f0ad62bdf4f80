"""What the page shows of a comparison: model against measurement, and the published tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane, lazy_tabs
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.session import Days, ExplorerSession
from inflight.figures import Section


class View(Protocol):
    """One tab of the page."""

    #: Its heading.
    title: str
    #: What the page holds.
    panel: pn.viewable.Viewable

    def look_at(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show a comparison and a span."""
        ...


class MeasurementView:
    """Model against measurement: the residual before and after, where it fails, what it follows."""

    title = "Model against measurement"

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._place = JobPane(session.background)
        self.panel = self._place.panel

    def look_at(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Measure the residual of a span and show it; say why when there is none."""
        if overview.note:
            self._place.put(panes.hint(f"{overview.note[:1].upper()}{overview.note[1:]}: see Tables."))
        elif days is None or not overview.products:
            self._place.put(panes.hint("There are no products to hold against the measurements yet."))
        else:
            self._place.begin(
                "Model against measurement",
                lambda progress: self._session.compare(overview.comparison, days, progress),
                lambda parts: lazy_tabs(parts, self._session.drawing),
            )


class TablesView:
    """The published tables: parameters over days with errors, and everything found beside them."""

    title = "Tables"

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._place = JobPane(session.background)
        self.panel = self._place.panel

    def look_at(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show the newest tables of a comparison; they hold for spans of their own."""
        del days
        self._place.begin(
            "Tables", lambda progress: self._session.tables(overview.comparison, progress), self._show
        )

    def _show(self, found: Sequence[Section]) -> pn.viewable.Viewable:
        if not found:
            return panes.hint(
                "There is no table of parameters: 'inflight reprocess' makes those of a calibration; "
                "states of two sensors stand with model against measurement."
            )
        return panes.sections(found)
