"""The page: the comparison and span chosen on top, and tabs with the views of them."""

from __future__ import annotations

import datetime as dt
import traceback
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import DocumentReady
from bokeh.models import CustomJS

from inflight.explorer import panes
from inflight.explorer.diagnosis_view import DiagnosisView
from inflight.explorer.drawing import DRAWING
from inflight.explorer.keyboard import KEYS
from inflight.explorer.loop_view import LoopView
from inflight.explorer.overview import ComparisonOverview, list_comparisons, next_step, summarise_comparison
from inflight.explorer.products_view import ProductsView
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.view_state import ViewState, parsed_day
from inflight.explorer.views import MeasurementView, TablesView, View
from inflight.figures import paragraph
from inflight.tasks import error_fields

_COLOUR = "#1f3a52"
#: For a reader who asks for a dark page: lightness is turned over, hues stay, on canvases as well; the header
#: is turned over twice.
_DARK = """
@media (prefers-color-scheme: dark) {
  html { background: #fff; filter: invert(0.92) hue-rotate(180deg) }
  #header { filter: invert(1) hue-rotate(180deg) }
}
"""


def open_page(session: ExplorerSession) -> pn.template.BootstrapTemplate:
    """Return the page of a browser; where the workspace cannot be read, one that says what to do."""
    try:
        return Page(session).template()
    except Exception as error:
        fields = error_fields(error)
        if fields["message"].startswith("unexpected"):
            traceback.print_exc()
        hint = panes.hint("Mend the workspace and load this page again.")
        return _template(session.workspace.root.name, panes.error(fields), hint)


def _template(title: str, *parts: pn.viewable.Viewable) -> pn.template.BootstrapTemplate:
    """Return a page; it asks nothing of any other server."""
    made = pn.template.BootstrapTemplate(
        title=title,
        site="Inflight",
        header_background=_COLOUR,
        main=[pn.Column(*parts, sizing_mode="stretch_width")],
    )
    made.config.raw_css = [_DARK]
    if pn.state.curdoc is not None:
        pn.state.curdoc.js_on_event(DocumentReady, CustomJS(code=KEYS + DRAWING))
    return made


class Page:
    """The page of one browser; what is chosen in it stands in its address.

    Parameters
    ----------
    session : ExplorerSession
        Shared by all pages of the server.
    """

    def __init__(self, session: ExplorerSession) -> None:
        self._session = session
        self._mission = session.mission()
        self._state = ViewState()  # type: ignore[no-untyped-call]  # Param is untyped here
        self._state.follow_address()
        names = list_comparisons(self._mission)
        chosen = self._state.comparison if self._state.comparison in names else names[0]
        self._comparison = pn.widgets.Select(name="Comparison", options=names, value=chosen, width=170)
        self._first = pn.widgets.DatePicker(name="First day", width=130)
        self._last = pn.widgets.DatePicker(name="Last day", width=130)
        self._apply = pn.widgets.Button(name="Look", button_type="primary", align="end")
        self._facts, self._hint = pn.Column(align="end"), pn.Column(sizing_mode="stretch_width")
        self._views: tuple[View, ...] = (
            LoopView(session, self._state, self._model_changed, self._select_days),
            MeasurementView(session, self._state),
            DiagnosisView(session),
            ProductsView(session, self._state, self._model_changed),
            TablesView(session),
        )
        self._tabs = pn.Tabs(
            *((view.title, view.panel) for view in self._views), dynamic=True, sizing_mode="stretch_width"
        )
        slugs = [view.title.lower().replace(" ", "-") for view in self._views]
        self._slugs = slugs
        if self._state.tab in slugs:
            self._tabs.active = slugs.index(self._state.tab)
        self._shown: dict[int, tuple[Any, ...]] = {}
        self._overview: ComparisonOverview | None = None
        self._comparison.param.watch(lambda event: self._choose(), "value")
        self._tabs.param.watch(lambda event: self._show_active(), "active")
        self._apply.on_click(lambda event: self._choose(keep=True))
        for picker, end in ((self._first, self._state.first), (self._last, self._state.last)):
            picker.value = parsed_day(end)
        self._choose(keep=True)

    def template(self) -> pn.template.BootstrapTemplate:
        """Return the page."""
        chosen = pn.Row(
            self._comparison,
            self._first,
            self._last,
            self._apply,
            self._facts,
            sizing_mode="stretch_width",
        )
        title = f"{self._mission.mission}: in-flight calibration"
        return _template(title, chosen, self._hint, self._tabs)

    def _choose(self, keep: bool = False) -> None:
        """Show the chosen comparison as the catalog has it now; `keep` the chosen span."""
        try:
            self._mission = self._session.mission()
            overview = self._summary(self._comparison.value)
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

    def _summary(self, comparison: str) -> ComparisonOverview:
        history = self._session.history(comparison)
        return summarise_comparison(self._session.cat, self._mission, comparison, history)

    def _show_facts(self, overview: ComparisonOverview) -> None:
        listed = {
            "kind": overview.kind,
            "archive": f"{overview.archived} days" if overview.archived else "empty",
            "products": f"{overview.products} days" if overview.products else "none",
            "model": overview.model,
        }
        text = "; ".join(f"{name} {value}" for name, value in listed.items())
        self._facts.objects = [panes.text(paragraph(text, kind="quiet"))]

    def _model_changed(self) -> None:
        """Show model and products as they are now; the view in which they changed shows that, others anew."""
        if self._overview is not None:
            own = self._shown.get(self._tabs.active)
            self._shown = {} if own is None else {self._tabs.active: own}
            self._show_facts(self._summary(self._overview.comparison))

    def _bound_span(self, overview: ComparisonOverview, keep: bool) -> None:
        span = overview.span()
        for picker, end in ((self._first, 0), (self._last, 1)):
            picker.disabled = span is None
            if span is not None:
                picker.start, picker.end = _date(overview.first), _date(overview.last)
                if not keep or picker.value is None or not picker.start <= picker.value <= picker.end:
                    picker.value = _date(span[end])

    def _select_days(self, days: Days | None) -> None:
        """Show some days alone; the default span when there are none."""
        if days is None:
            self._choose()
            return
        self._first.value, self._last.value = _date(days.first), _date(days.last)
        self._choose(keep=True)

    def _show_active(self) -> None:
        """Let the active view show what is chosen, unless it does already."""
        if self._overview is None:
            return
        days = self._days()
        self._state.param.update(
            comparison=self._comparison.value,
            first=str(days.first) if days else "",
            last=str(days.last) if days else "",
            tab=self._slugs[self._tabs.active],
        )
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
