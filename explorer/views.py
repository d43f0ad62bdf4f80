"""What the page shows of a comparison: model against measurement, and the published tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import panel as pn

from inflight.explorer import drawing
from inflight.explorer.offer import Offer
from inflight.explorer.sitting import Days, Sitting
from inflight.explorer.watching import Place, later_tabs
from inflight.figures import Section


class View(Protocol):
    """One tab of the page."""

    #: Its heading.
    title: str
    #: What the page holds.
    panel: pn.viewable.Viewable

    def look_at(self, offer: Offer, days: Days | None) -> None:
        """Show a comparison and a span."""
        ...


class MeasurementView:
    """Model against measurement: the residual before and after, where it fails, what it follows."""

    title = "Model against measurement"

    def __init__(self, sitting: Sitting) -> None:
        self._sitting = sitting
        self._place = Place(sitting.background)
        self.panel = self._place.panel

    def look_at(self, offer: Offer, days: Days | None) -> None:
        """Measure the residual of a span and show it; say why when there is none."""
        if offer.note:
            self._place.put(drawing.hint(f"{offer.note[:1].upper()}{offer.note[1:]}: see Tables."))
        elif days is None or not offer.products:
            self._place.put(drawing.hint("There are no products to hold against the measurements yet."))
        else:
            self._place.begin(
                "Model against measurement",
                lambda progress: self._sitting.compare(offer.comparison, days, progress),
                lambda parts: later_tabs(parts, self._sitting.drawing),
            )


class TablesView:
    """The published tables: parameters over days with errors, and everything found beside them."""

    title = "Tables"

    def __init__(self, sitting: Sitting) -> None:
        self._sitting = sitting
        self._place = Place(sitting.background)
        self.panel = self._place.panel

    def look_at(self, offer: Offer, days: Days | None) -> None:
        """Show the newest tables of a comparison; they hold for spans of their own."""
        del days
        self._place.begin(
            "Tables", lambda progress: self._sitting.tables(offer.comparison, progress), self._show
        )

    def _show(self, found: Sequence[Section]) -> pn.viewable.Viewable:
        if not found:
            return drawing.hint(
                "There is no table of parameters: 'inflight reprocess' makes those of a calibration; "
                "states of two sensors stand with model against measurement."
            )
        return drawing.sections(found)
