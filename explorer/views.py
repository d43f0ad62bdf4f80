"""Tabs of the page about a comparison: model against measurement, and the published tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane, lazy_tabs
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.table_versions import TableVersions
from inflight.figures import Section


class View(Protocol):
    """One tab of the page."""

    #: Heading of the tab.
    title: str
    #: Panel object in the page.
    panel: pn.viewable.Viewable

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show a comparison and a span."""
        ...


class MeasurementView:
    """Model against measurement: the residual before and after, where it fails, what it follows."""

    title = "Model against measurement"

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._pane = JobPane(session.background)
        self.panel = self._pane.panel

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Measure the residual of a span and show it; without products, show why there is none."""
        if overview.note:
            self._pane.put(panes.hint(f"{overview.note[:1].upper()}{overview.note[1:]}: see Tables."))
        elif days is None or not overview.products:
            self._pane.put(panes.hint("There are no products to hold against the measurements yet."))
        else:
            self._pane.begin(
                "Model against measurement",
                lambda progress: self._session.compare(overview.comparison, days, progress),
                lambda parts: lazy_tabs(parts, self._session.figure_background),
            )


class TablesView:
    """The published tables: parameters over days with errors, and what was published with them."""

    title = "Tables"

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._pane = JobPane(session.background)
        self._versions = TableVersions(session)
        self.panel = pn.Column(self._pane.panel, self._versions.panel, sizing_mode="stretch_width")

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show the newest tables of a comparison; they have their own spans, so `days` is not used."""
        del days
        self._versions.show(overview)
        self._pane.begin(
            "Tables", lambda progress: self._session.tables(overview.comparison, progress), _tables_pane
        )


def _tables_pane(found: Sequence[Section]) -> pn.viewable.Viewable:
    if found:
        return panes.sections(found)
    return panes.hint(
        "There is no table of parameters: 'inflight reprocess' makes those of a calibration; "
        "states of two sensors stand with model against measurement."
    )
