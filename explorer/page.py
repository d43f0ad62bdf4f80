"""The page: the comparison and span chosen in the sidebar, and tabs with the views of them."""

from __future__ import annotations

import datetime as dt
from typing import Any

import numpy as np
import panel as pn

from inflight.explorer import panes
from inflight.explorer.diagnosis_view import DiagnosisView
from inflight.explorer.overview import ComparisonOverview, list_comparisons, next_step, summarise_comparison
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.views import MeasurementView, TablesView, View
from inflight.figures import facts_table
from inflight.tasks import error_fields

_COLOUR = "#1f3a52"
#: Width of the widgets in the sidebar, pixels.
_WIDTH = 230


class Page:
    """The page of one browser.

    Parameters
    ----------
    session : ExplorerSession
        Shared by all pages of the server.
    """

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._mission = session.mission()
        names = list_comparisons(self._mission)
        self._comparison = pn.widgets.Select(name="Comparison", options=names, value=names[0], width=_WIDTH)
        self._first = pn.widgets.DatePicker(name="First day", width=_WIDTH)
        self._last = pn.widgets.DatePicker(name="Last day", width=_WIDTH)
        self._apply = pn.widgets.Button(name="Look", button_type="primary")
        self._facts, self._hint = pn.Column(), pn.Column(sizing_mode="stretch_width")
        self._views: tuple[View, ...] = (
            MeasurementView(session),
            DiagnosisView(session, self._model_changed),
            TablesView(session),
        )
        self._tabs = pn.Tabs(
            *((view.title, view.panel) for view in self._views), dynamic=True, sizing_mode="stretch_width"
        )
        self._shown: dict[int, tuple[Any, ...]] = {}
        self._overview: ComparisonOverview | None = None
        self._comparison.param.watch(lambda event: self._choose(), "value")
        self._tabs.param.watch(lambda event: self._show_active(), "active")
        self._apply.on_click(lambda event: self._choose(keep=True))
        self._choose()

    def template(self) -> pn.template.BootstrapTemplate:
        """Return the page; it asks nothing of any other server."""
        return pn.template.BootstrapTemplate(
            title=f"{self._mission.mission}: in-flight calibration",
            site="Inflight",
            header_background=_COLOUR,
            sidebar=[self._comparison, self._first, self._last, self._apply, self._facts],
            sidebar_width=_WIDTH + 60,
            main=[pn.Column(self._hint, self._tabs, sizing_mode="stretch_width")],
        )

    def _choose(self, keep: bool = False) -> None:
        """Show the chosen comparison as the catalog has it now; `keep` the chosen span."""
        try:
            self._mission = self._session.mission()
            overview = summarise_comparison(self._session.cat, self._mission, self._comparison.value)
        except Exception as error:
            self._overview = None
            self._hint.objects = [panes.error(error_fields(error))]
            return
        self._overview = overview
        step = next_step(self._session.workspace, overview)
        self._hint.objects = [panes.hint(step)] if step else []
        self._bound_span(overview, keep)
        self._show_facts(overview)
        self._shown.clear()
        self._show_active()

    def _show_facts(self, overview: ComparisonOverview) -> None:
        listed = {
            "mission": self._mission.mission,
            "kind": overview.kind,
            "archive": f"{overview.archived} days" if overview.archived else "empty",
            "products": f"{overview.products} days" if overview.products else "none",
            "model": overview.model,
        }
        self._facts.objects = [panes.text(facts_table(listed))]

    def _model_changed(self) -> None:
        """Show which model is in use now; the views stay as they are."""
        if self._overview is not None:
            self._show_facts(
                summarise_comparison(self._session.cat, self._mission, self._overview.comparison)
            )

    def _bound_span(self, overview: ComparisonOverview, keep: bool) -> None:
        span = overview.span()
        for picker, end in ((self._first, 0), (self._last, 1)):
            picker.disabled = span is None
            if span is not None:
                picker.start, picker.end = _date(overview.first), _date(overview.last)
                if not keep or picker.value is None:
                    picker.value = _date(span[end])

    def _show_active(self) -> None:
        """Let the active view show what is chosen, unless it does already."""
        if self._overview is None:
            return
        days = self._days()
        chosen = (self._overview, days)
        if self._shown.get(self._tabs.active) != chosen:
            self._shown[self._tabs.active] = chosen
            self._views[self._tabs.active].show(self._overview, days)

    def _days(self) -> Days | None:
        first, last = self._first.value, self._last.value
        if first is None or last is None:
            return None
        first, last = sorted((np.datetime64(first, "D"), np.datetime64(last, "D")))
        return Days(first, last)


def _date(day: np.datetime64 | None) -> dt.date | None:
    return None if day is None else dt.date.fromisoformat(str(day))
