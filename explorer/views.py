"""Tabs of the page about a comparison: model against measurement, and the published tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane, lazy_tabs
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.residual_rows import product_rows
from inflight.explorer.session import Contributions, Days, ExplorerSession
from inflight.explorer.table_versions import TableVersions
from inflight.explorer.time_view import TimeView
from inflight.explorer.view_state import ViewState
from inflight.figures import Section
from inflight.tasks.pipelines import CompareResult


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
    """Model against measurement: the residual before and after, where it fails, what it follows, and when.

    Parameters
    ----------
    session : ExplorerSession
    state : ViewState
        The visible span in time is kept in it.
    """

    title = "Model against measurement"

    def __init__(self, session: ExplorerSession, state: ViewState) -> None:
        self._session = session
        self._pane, self._known_pane = JobPane(session.background), JobPane(session.figure_background)
        self._made_pane = JobPane(session.background)
        self._time = TimeView(session, state)
        self._comparison = ""
        self.panel = pn.Column(self._pane.panel, self._known_pane.panel, sizing_mode="stretch_width")

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Measure the residual of a span and show it; without products, show why there is none."""
        self._time.clear()
        self._pane.put()
        self._known_pane.put()
        if overview.comparison != self._comparison:
            self._time.show_contributions(None)
        self._comparison = overview.comparison
        if overview.note:
            self._pane.put(panes.hint(f"{overview.note[:1].upper()}{overview.note[1:]}: see Tables."))
        elif days is None or not overview.products:
            self._pane.put(panes.hint("There are no products to hold against the measurements yet."))
        else:
            # What is measured already waits for no other work.
            known = self._session.measured(overview.comparison, days) is not None
            (self._known_pane if known else self._pane).begin(
                "Model against measurement",
                lambda progress: self._session.measure(overview.comparison, days, progress),
                self._shown,
            )

    def _shown(self, measured: CompareResult[Any]) -> pn.viewable.Viewable:
        if (rows := product_rows(measured)) is not None:
            self._time.show(self._comparison, rows, are_products=True)
            if self._session.last_diagnosis(self._comparison) is not None:
                self._made_pane.begin(
                    "Reads the equations of the last diagnosis",
                    lambda progress: self._session.open_contributions(self._comparison, progress),
                    self._opened,
                )
        tabs = lazy_tabs(measured.parts, self._session.figure_background)
        if rows is not None:
            in_time = pn.Column(self._time.panel, self._made_pane.panel, sizing_mode="stretch_width")
            tabs.append(("In time", in_time))
        return tabs

    def _opened(self, made: Contributions | None) -> pn.viewable.Viewable:
        self._time.show_contributions(made)
        return panes.text()


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
