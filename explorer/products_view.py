"""The tab of products and runs: which days there are and why others are missing, and what makes them."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence

import numpy as np
import panel as pn

from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.product_day import day_table
from inflight.explorer.runs_panel import RunsPanel
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.view_state import ViewState, parsed_day
from inflight.figures import coverage_figure, coverage_legend, paragraph
from inflight.tasks import CoverageDay
from inflight.tasks.pipelines import product_of


class ProductsView:
    """A calendar of each dataset, the day chosen in it, and the runs.

    Parameters
    ----------
    session : ExplorerSession
    state : ViewState
        Dataset and day chosen are kept in it.
    changed : callable
        Called when there may be other products.
    """

    title = "Products and runs"

    def __init__(self, session: ExplorerSession, state: ViewState, changed: Callable[[], None]) -> None:
        self._session, self._state, self._notify = session, state, changed
        self._days: list[CoverageDay] = []
        self._comparison = ""
        self._dataset = pn.widgets.Select(name="Dataset", options=[], width=220)
        self._date = pn.widgets.DatePicker(name="Day", width=130)
        self._calendar = JobPane(session.figure_background)
        self._day = JobPane(session.figure_background)
        self._runs = RunsPanel(session, self._made)
        self._dataset.param.watch(lambda event: self._choose(event.new), "value")
        self._date.param.watch(lambda event: self._show_day(), "value")
        left = pn.Column(
            panes.text(paragraph("", bold="What there is")),
            pn.Row(self._dataset, self._date),
            self._calendar.panel,
            self._day.panel,
            styles={"flex": "1.4 1 0", "min-width": "0"},
            sizing_mode="stretch_width",
        )
        self.panel = pn.Row(left, self._runs.panel, sizing_mode="stretch_width")

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Show the products of a comparison; the calendar has its own span."""
        names, own = self._session.datasets(), product_of(overview.comparison)
        # Of another comparison than before, its own product.
        same = self._comparison in ("", overview.comparison)
        wanted = [self._state.dataset, own] if same else [own]
        self._comparison = overview.comparison
        chosen = next((name for name in (*wanted, *names) if name in names), None)
        before = self._dataset.value
        self._dataset.param.update(options=names, value=chosen)
        if chosen == before or chosen is None:
            self._show_calendar()
        self._runs.show(overview, days)
        self._date.value = parsed_day(self._state.day)

    def _choose(self, dataset: str | None) -> None:
        if dataset:
            self._state.dataset = dataset
            self._show_calendar()
            self._show_day()

    def _made(self) -> None:
        """Show what work has made, here and in what other tabs have of it."""
        self._notify()
        self._show_calendar()
        self._show_day()

    def _show_calendar(self) -> None:
        dataset = self._dataset.value
        if dataset is None:
            self._calendar.put(panes.hint("The archive is empty: 'inflight ingest' fills it."))
            return
        self._calendar.begin(
            "Coverage", lambda progress: self._session.coverage(dataset, progress), self._drawn
        )

    def _drawn(self, days: list[CoverageDay]) -> pn.viewable.Viewable:
        self._days = days
        if not days:
            return panes.hint("Nothing is known of this dataset.")
        plot, source = coverage_figure(
            f"{self._dataset.value}: {days[0].day} to {days[-1].day}",
            [(one.day, one.kind, one.why) for one in days],
        )
        plot.sizing_mode = "stretch_width"
        plot.toolbar.autohide = True
        source.selected.on_change("indices", lambda name, old, new: self._tapped(new))
        return pn.Column(
            panes.picture(plot),
            panes.text(
                coverage_legend([one.kind for one in days]),
                paragraph(f"{len(days)} days. Click one to see it.", kind="quiet"),
            ),
            sizing_mode="stretch_width",
        )

    def _tapped(self, selected: Sequence[int]) -> None:
        if selected:
            self._date.value = parsed_day(str(self._days[selected[0]].day))

    def _show_day(self) -> None:
        dataset, day = self._dataset.value, self._date.value
        if dataset is None or day is None:
            return
        self._state.day, date = str(day), np.datetime64(day, "D")
        why = next((one.why for one in self._days if one.day == date), "")
        self._day.begin(
            f"{dataset} {day}",
            lambda progress: self._session.product_day(dataset, date, progress),
            lambda sections: pn.Column(
                *([panes.text(paragraph(why, kind="quiet"))] if why and len(sections) > 1 else []),
                panes.sections(sections),
                *([self._download(dataset, date)] if len(sections) > 1 else []),
            ),
        )

    def _download(self, dataset: str, day: np.datetime64) -> pn.viewable.Viewable:
        """Return a button that gives the samples of a day as CSV."""
        return pn.widgets.FileDownload(
            label="Samples of this day as CSV",
            filename=f"{dataset.replace('/', '-')}-{day}.csv",
            callback=lambda: io.StringIO(day_table(self._session.cat, dataset, day)),
            margin=(5, 10),
        )
