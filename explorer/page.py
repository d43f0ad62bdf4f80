"""The page: what is looked at on the left, how it is looked at in tabs."""

from __future__ import annotations

import datetime as dt
from typing import Any

import numpy as np
import panel as pn

from inflight.explorer import drawing
from inflight.explorer.missing_view import MissingView
from inflight.explorer.offer import Offer, comparisons, first_step, offer_of
from inflight.explorer.sitting import Days, Sitting
from inflight.explorer.views import MeasurementView, TablesView, View
from inflight.figures import facts_table
from inflight.tasks import told_error

_COLOUR = "#1f3a52"
#: Of the widgets on the left, pixels.
_WIDTH = 230


class Page:
    """One browser's page over a sitting.

    Parameters
    ----------
    sitting : Sitting
        Shared by all pages of the server.
    """

    def __init__(self, sitting: Sitting) -> None:
        self._sitting = sitting
        self._mission = sitting.mission()
        names = comparisons(self._mission)
        self._comparison = pn.widgets.Select(name="Comparison", options=names, value=names[0], width=_WIDTH)
        self._first = pn.widgets.DatePicker(name="First day", width=_WIDTH)
        self._last = pn.widgets.DatePicker(name="Last day", width=_WIDTH)
        self._look = pn.widgets.Button(name="Look", button_type="primary")
        self._facts, self._hint = pn.Column(), pn.Column(sizing_mode="stretch_width")
        self._views: tuple[View, ...] = (
            MeasurementView(sitting),
            MissingView(sitting, self._model_changed),
            TablesView(sitting),
        )
        self._tabs = pn.Tabs(
            *((view.title, view.panel) for view in self._views), dynamic=True, sizing_mode="stretch_width"
        )
        self._seen: dict[int, tuple[Any, ...]] = {}
        self._offer: Offer | None = None
        self._comparison.param.watch(lambda event: self._choose(), "value")
        self._tabs.param.watch(lambda event: self._look_at(), "active")
        self._look.on_click(lambda event: self._choose(keep=True))
        self._choose()

    def template(self) -> pn.template.BootstrapTemplate:
        """Return the page; it asks nothing of any other server."""
        return pn.template.BootstrapTemplate(
            title=f"{self._mission.mission}: in-flight calibration",
            site="Inflight",
            header_background=_COLOUR,
            sidebar=[self._comparison, self._first, self._last, self._look, self._facts],
            sidebar_width=_WIDTH + 60,
            main=[pn.Column(self._hint, self._tabs, sizing_mode="stretch_width")],
        )

    def _choose(self, keep: bool = False) -> None:
        """Take up what the catalog has of the chosen comparison; `keep` the span that was asked for."""
        try:
            self._mission = self._sitting.mission()
            offer = offer_of(self._sitting.cat, self._mission, self._comparison.value)
        except Exception as error:
            self._offer = None
            self._hint.objects = [drawing.error(told_error(error))]
            return
        self._offer = offer
        step = first_step(self._sitting.workspace, offer)
        self._hint.objects = [drawing.hint(step)] if step else []
        self._bound_span(offer, keep)
        self._show_facts(offer)
        self._seen.clear()
        self._look_at()

    def _show_facts(self, offer: Offer) -> None:
        listed = {
            "mission": self._mission.mission,
            "kind": offer.kind,
            "archive": f"{offer.archived} days" if offer.archived else "empty",
            "products": f"{offer.products} days" if offer.products else "none",
            "model": offer.model,
        }
        self._facts.objects = [drawing.text(facts_table(listed))]

    def _model_changed(self) -> None:
        """Tell which model is in use now; what is shown stays."""
        if self._offer is not None:
            self._show_facts(offer_of(self._sitting.cat, self._mission, self._offer.comparison))

    def _bound_span(self, offer: Offer, keep: bool) -> None:
        span = offer.span()
        for picker, end in ((self._first, 0), (self._last, 1)):
            picker.disabled = span is None
            if span is not None:
                picker.start, picker.end = _date(offer.first), _date(offer.last)
                if not keep or picker.value is None:
                    picker.value = _date(span[end])

    def _look_at(self) -> None:
        """Have the view that is in front show what is chosen, unless it does already."""
        if self._offer is None:
            return
        days = self._days()
        chosen = (self._offer, days)
        if self._seen.get(self._tabs.active) != chosen:
            self._seen[self._tabs.active] = chosen
            self._views[self._tabs.active].look_at(self._offer, days)

    def _days(self) -> Days | None:
        first, last = self._first.value, self._last.value
        if first is None or last is None:
            return None
        first, last = sorted((np.datetime64(first, "D"), np.datetime64(last, "D")))
        return Days(first, last)


def _date(day: np.datetime64 | None) -> dt.date | None:
    return None if day is None else dt.date.fromisoformat(str(day))
