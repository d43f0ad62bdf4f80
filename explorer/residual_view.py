"""Where a residual fails, in pictures that react together: time, orbit, channel, axis, period, place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import SelectionGeometry, Tap
from bokeh.models import BoxSelectTool
from bokeh.plotting import figure

from inflight.diagnosis import BeforeAfter, HeatMap
from inflight.explorer import panes
from inflight.explorer.job_pane import JobPane, lazy_tabs
from inflight.explorer.overview import ComparisonOverview
from inflight.explorer.residual_rows import ResidualRows, Selection, product_rows
from inflight.explorer.session import Days, ExplorerSession
from inflight.explorer.view_state import ViewState
from inflight.figures import (
    channel_figures,
    draw_floor,
    heat_map_figures,
    legend_below,
    log_ticks,
    paragraph,
    place_map_figures,
    spectrum_figure,
)
from inflight.residual import Dependence, drawn_periods
from inflight.tasks.pipelines import CompareResult

#: Heights of figures, pixels: of a map alone, of one of two, of a curve and of the curve along an axis.
_MAP, _HALF_MAP, _CURVE, _AXIS, _LEGEND = 330, 215, 270, 160, 56
#: Structures below this part of the noise do not matter, as `inflight compare` has it.
_MATTERS = 0.1
#: Part of a picture's range that a brush must reach over to mean that direction; assumed.
_BRUSHED = 0.03
_PICTURES = ("Along each axis", "Spectrum", "Local time, latitude")
_HELP = "Drag over the map or a curve to look at a part alone; click a day to see its samples."


class ResidualView:
    """Pictures of a residual; what is brushed in one restricts all.

    Parameters
    ----------
    session : ExplorerSession
    state : ViewState
        Channel, picture and selection are kept in it.
    select : callable
        Called with the days that were brushed; None for the default span.
    go_to : callable
        Called with the day that was clicked.
    shown : callable
        Called with the rows that are shown, and whether they are those of products; None of no rows.
    """

    def __init__(
        self,
        session: ExplorerSession,
        state: ViewState,
        select: Callable[[Days | None], None],
        go_to: Callable[[np.datetime64], None],
        shown: Callable[[ResidualRows | None, bool], None],
    ) -> None:
        self._session, self._state = session, state
        self._select, self._go_to, self._shown = select, go_to, shown
        self._days: Days | None = None
        self._span: tuple[np.datetime64, np.datetime64] | None = None
        self._measured: CompareResult[Any] | None = None
        self._products: ResidualRows | None = None
        self._rows: ResidualRows | None = None
        self._labels, self._level = ("", ""), float("nan")
        self._floor, self._what = float("nan"), ""
        self._pane = JobPane(session.background)
        self._maps, self._curve, self._lower = (pn.Column(sizing_mode="stretch_width") for _ in range(3))
        self._note = pn.Column(sizing_mode="stretch_width")
        self._channel = pn.widgets.Select(
            name="Residual against", options=[], sizing_mode="stretch_width", visible=False
        )
        self._picture = pn.widgets.RadioButtonGroup(
            options=list(_PICTURES), value=_PICTURES[0], sizing_mode="stretch_width", visible=False
        )
        if state.picture in _PICTURES:
            self._picture.value = state.picture
        self._typed = pn.widgets.TextInput(
            name="Only where", placeholder="channel=low~high", sizing_mode="stretch_width"
        )
        self._typed.param.watch(lambda event: self._selection_typed(event.new), "value")
        self._clear = pn.widgets.Button(name="Clear selection", align="center", visible=False)
        self._back = pn.widgets.Button(name="Show products", align="center", visible=False)
        self._clear.on_click(lambda event: self._clear_selection())
        self._back.on_click(lambda event: self._show_products())
        self._channel.param.watch(lambda event: self._channel_chosen(event.new), "value")
        self._picture.param.watch(lambda event: self._picture_chosen(event.new), "value")
        self.parts = (
            self._pane.panel,
            pn.Row(self._note, self._back, self._clear, sizing_mode="stretch_width"),
            self._maps,
            pn.Row(self._channel, self._typed, sizing_mode="stretch_width"),
            self._curve,
            self._picture,
            self._lower,
        )

    @property
    def selection(self) -> Selection:
        """What is brushed."""
        return Selection.of_text(self._state.select)

    def show(self, overview: ComparisonOverview, days: Days | None) -> None:
        """Measure the residual of a span's products and show it."""
        self._days, self._span = days, overview.span()
        self._measured = self._products = self._rows = None
        self._shown(None, False)
        for part in (self._maps, self._curve, self._lower, self._note):
            part.objects = []
        for one in (self._channel, self._typed, self._picture, self._clear, self._back):
            one.visible = False
        if overview.note:
            self._pane.put(panes.hint(f"{overview.note[:1].upper()}{overview.note[1:]}: see Tables."))
        elif days is None or not overview.products:
            self._pane.put(panes.hint("There are no products to hold against the measurements yet."))
        else:
            self._pane.begin(
                "Model against measurement",
                lambda progress: self._session.measure(overview.comparison, days, progress),
                self._take,
            )

    @property
    def channel(self) -> str:
        """What the residual is drawn against."""
        return self._state.channel

    def show_change(
        self, seen: BeforeAfter | None, effect: str, what: str, floor: float | None, *, earlier: str
    ) -> None:
        """Show the residual before and after what was tried or changed, against the channel it follows.

        Parameters
        ----------
        effect : str
            Its name; a channel in it is drawn.
        what : str
            What was done.
        floor : float, optional
            Noise floor, nT.
        earlier : str
            The channel that was drawn when the change was asked for: one chosen since then stays.
        """
        if seen is None:
            return
        rows = ResidualRows.of_change(seen)
        if self._state.channel == earlier:
            self._state.channel = _channel_in(effect, rows) or earlier
        self._what = f"Residual before and after: {what}."
        self._show(rows, ("before", "after"), float("nan") if floor is None else floor)

    def follow(self, effect: str) -> None:
        """Draw the residual against the channel that an effect follows, if its name has one."""
        name = _channel_in(effect, self._rows)
        if name and name in self._channel.options:
            self._channel.value = name

    def _take(self, measured: CompareResult[Any]) -> pn.viewable.Viewable:
        if measured.data is None:
            # A turning sensor, or two of them: what there is instead of a residual at every sample.
            return lazy_tabs(measured.parts, self._session.figure_background, _narrow_section)
        self._measured, self._products = measured, product_rows(measured)
        self._show_products()
        return panes.text()

    def _show_products(self) -> None:
        if self._products is not None and self._measured is not None:
            report = self._measured.report
            self._what = f"Residual of products of model version {report.version}."
            self._show(self._products, (f"model version {report.version}", ""), report.floor.level_nT)

    def _show(self, rows: ResidualRows, labels: tuple[str, str], floor: float) -> None:
        self._rows, self._labels, self._floor, self._level = rows, labels, floor, _MATTERS * floor
        self._back.visible = rows.after is not None and self._products is not None
        names = [name for name in self._ranked() if name in rows.coordinates]
        names += [name for name in rows.coordinates if name not in names]
        own = self._state.channel or _channel_in(self._state.candidate, rows)
        chosen = own if own in names else next(iter(names), None)
        # Set beforehand, it does not draw by itself.
        self._state.channel = chosen or ""
        self._channel.param.update(options=names, value=chosen, visible=bool(names))
        self._picture.visible = self._typed.visible = True
        self._draw()

    def _ranked(self) -> list[str]:
        """Return what the products' residual follows, what is clear first."""
        found: Sequence[Dependence] = self._measured.data.found if self._measured else ()
        order = sorted(found, key=lambda one: (not one.is_clear, -one.amplitude))
        return [one.coordinate for one in order]

    # What is drawn.

    def _draw(self) -> None:
        rows = self._selected()
        if rows is None:
            return
        self._draw_note(rows)
        self._draw_maps(rows)
        self._draw_curve(rows)
        self._draw_picture(rows)
        self._shown(rows, rows.after is None)

    def _selected(self) -> ResidualRows | None:
        """Return the rows that are looked at; products are those of the chosen days already."""
        if self._rows is None:
            return None
        return self._rows.selected(self.selection, self._days if self._rows.after is not None else None)

    def _draw_note(self, rows: ResidualRows) -> None:
        assert self._rows is not None
        chosen = [
            f"{name} {low:.4g} to {high:.4g} {self._rows.units.get(name, '')}".strip()
            for name, (low, high) in self.selection.ranges.items()
        ]
        default = self._days is None or self._span == (self._days.first, self._days.last)
        if not default and self._days is not None:
            chosen.insert(0, f"{self._days.first} to {self._days.last}")
        sizes = " → ".join(f"{size:.4g}" for size in rows.sizes)
        part = f"{int(rows.known.sum())} of {int(self._rows.known.sum())} rows, {sizes} nT rms"
        chosen_text = f" Selected: {'; '.join(chosen)} ({part})." if chosen else f" {_HELP}"
        self._note.objects = [panes.text(paragraph(self._what + chosen_text, kind="quiet"))]
        self._clear.visible, self._typed.value = bool(chosen), self._state.select

    def _draw_maps(self, rows: ResidualRows) -> None:
        if not rows.known.any():
            self._maps.objects = [panes.hint("Nothing was measured in what is selected.")]
            return
        found, changed = rows.map(), rows.after is not None
        plots = heat_map_figures(found, changed, stacked=True)
        for plot in plots:
            fit_figure(plot, _HALF_MAP if changed else _MAP)
            self._brush(plot, "both", lambda event: self._map_brushed(event, found))
            plot.on_event(Tap, self._map_clicked)
        self._maps.objects = [panes.picture(plot) for plot in plots]

    def _draw_curve(self, rows: ResidualRows) -> None:
        name = self._channel.value
        found = None if name is None else rows.response(name, axes=False)
        if name is None or found is None:
            text = "The residual is not drawn against it: it does not vary in what is selected."
            self._curve.objects = [panes.text(paragraph(text, kind="quiet"))] if name else []
            return
        earlier = self._measured.data.earlier.get(name) if self._measured and rows.after is None else None
        plots = channel_figures(found, self._labels, self._level, rows.amplitude(name), earlier)
        self._curve.objects = [self._channel_pane(plot, name, _CURVE) for plot in plots]

    def _channel_pane(self, plot: figure, name: str, height: int) -> pn.viewable.Viewable:
        fit_figure(plot, height)
        self._brush(plot, "width", lambda event: self._curve_brushed(event, name))
        return panes.picture(plot)

    def _draw_picture(self, rows: ResidualRows) -> None:
        draw = dict(zip(_PICTURES, (self._axes, self._spectrum, self._places), strict=True))
        self._lower.objects = draw[self._picture.value](rows)

    def _axes(self, rows: ResidualRows) -> list[pn.viewable.Viewable]:
        name = self._channel.value
        found = None if name is None else rows.response(name, axes=True)
        if found is None or not rows.is_scalar:
            text = "Too few rows." if rows.is_scalar else "The components of this residual are drawn above."
            return [panes.text(paragraph(text, kind="quiet"))]
        plots = channel_figures(found, self._labels, self._level)
        note = (
            "The field along each sensor axis that would make the residual follow it; bands are one sigma "
            "between blocks, grey is what the same channel at other times makes by chance, and between the "
            "dotted lines lies a tenth of the noise floor."
        )
        # The last one has the legend.
        heights = [_AXIS] * (len(plots) - 1) + [_AXIS + _LEGEND]
        drawn = [
            self._channel_pane(*one) for one in zip(plots, [str(name)] * len(plots), heights, strict=True)
        ]
        return [panes.text(paragraph(note, kind="quiet")), *drawn]

    def _spectrum(self, rows: ResidualRows) -> list[pn.viewable.Viewable]:
        known: Mapping[str, float] = self._measured.data.spectra.known if self._measured else {}
        whole = self._measured.data.spectra if self._measured and rows is self._products else None
        if whole is not None and whole.fast is not None:
            # Of whole products it is that of every sample, as `inflight compare` has it.
            made, lines, floor = [whole.fast], whole.lines, self._floor
        else:
            (made, lines), floor = rows.spectra(known), self._floor_of_means(rows)
        if not made:
            return [panes.text(paragraph("The record is too short for a spectrum.", kind="quiet"))]
        last, before = made[-1], made[0].density[0] if len(made) == 2 else None
        plot = spectrum_figure(
            last.frequency, before, last.density[0], drawn_periods(known), lines, labels=self._two_labels
        )
        draw_floor(plot, last.frequency, floor)
        legend_below(plot)
        if (ticks := log_ticks(np.sqrt(last.density[0]))) is not None:
            plot.yaxis.ticker = ticks
        fit_figure(plot, _MAP)
        note = (
            "Grey dotted lines are known periods: of orbit, day, spin and mission; a red point is a line "
            "that nothing known explains."
        )
        return [panes.picture(plot), panes.text(paragraph(note, kind="quiet"))]

    def _floor_of_means(self, rows: ResidualRows) -> float:
        """Return the noise floor of the rows, which are means of samples, nT; NaN where it is not known."""
        samples = self._measured.report.floor.samples if self._measured else 0
        each = samples / max(int(self._products.known.sum()), 1) if self._products else 0.0
        if rows.after is not None and self._products is not None:
            each *= rows.step_s / self._products.step_s
        return self._floor / max(each, 1.0) ** 0.5 if each else float("nan")

    @property
    def _two_labels(self) -> tuple[str, str]:
        return self._labels if self._labels[1] else ("", self._labels[0])

    def _places(self, rows: ResidualRows) -> list[pn.viewable.Viewable]:
        found = rows.places()
        if found is None:
            text = "The mission has no positions: there is neither latitude nor local time."
            return [panes.text(paragraph(text, kind="quiet"))]
        names = self._labels if len(found) == 2 else ("",)
        plots = place_map_figures(dict(zip(names, found, strict=True)))
        for plot in plots:
            fit_figure(plot, _HALF_MAP if len(plots) > 1 else _MAP)
            self._brush(plot, "both", self._places_brushed)
        return [panes.picture(plot) for plot in plots]

    # What is chosen and brushed.

    def _channel_chosen(self, name: str | None) -> None:
        if name and name != self._state.channel:
            self._state.channel = name
            if (rows := self._selected()) is not None:
                self._draw_curve(rows)
                self._draw_picture(rows)

    def _picture_chosen(self, name: str) -> None:
        self._state.picture = name
        if (rows := self._selected()) is not None:
            self._draw_picture(rows)

    def _brush(self, plot: figure, dimensions: str, brushed: Callable[[SelectionGeometry], None]) -> None:
        tool = BoxSelectTool(dimensions=dimensions, persistent=False)
        plot.add_tools(tool)
        plot.toolbar.active_drag = tool
        plot.on_event(SelectionGeometry, brushed)

    def _map_brushed(self, event: SelectionGeometry, found: HeatMap) -> None:
        """Look at the days between the ends of a selection alone, or at the phases, or at both."""
        name = found.coordinate.replace("_", " ").removesuffix(" (UTC)")
        low, high = _ends(event, "x", 0.0, found.reach)
        assert self._rows is not None
        if high - low > _BRUSHED * found.reach and name in self._rows.coordinates:
            self._restrict(name, low, high)
        ends = sorted(event.geometry[end] for end in ("y0", "y1"))
        first, last = (np.datetime64(int(end), "ms").astype("datetime64[D]") for end in ends)
        if self._days is None or ends[1] - ends[0] < _BRUSHED * (found.span[1] - found.span[0]) / 1e6:
            return
        days = Days(max(first, self._days.first), min(last, self._days.last))
        if days.first <= days.last and days != self._days:
            self._select(days)

    def _map_clicked(self, event: Tap) -> None:
        self._go_to(np.datetime64(int(event.y), "ms").astype("datetime64[D]"))

    def _curve_brushed(self, event: SelectionGeometry, name: str) -> None:
        low, high = _ends(event, "x")
        if high > low:
            self._restrict(name, low, high)

    def _places_brushed(self, event: SelectionGeometry) -> None:
        for axis, name, ends in (("x", "local time", (0.0, 24.0)), ("y", "latitude", (-90.0, 90.0))):
            low, high = _ends(event, axis, *ends)
            if high - low > _BRUSHED * (ends[1] - ends[0]):
                self._restrict(name, low, high)

    def _selection_typed(self, text: str) -> None:
        """Take what was typed: what a brush does, by the keyboard."""
        text = Selection.of_text(text).text
        if text != self._state.select:
            self._state.select = text
            self._draw()

    def _restrict(self, name: str, low: float, high: float) -> None:
        self._state.select = self.selection.with_range(name, low, high).text
        self._draw()

    def _clear_selection(self) -> None:
        default = self._days is None or self._span == (self._days.first, self._days.last)
        self._state.select = ""
        if default:
            self._draw()
        else:
            self._select(None)


def _narrow_section(text: Sequence[str], figures: Sequence[figure]) -> pn.viewable.Viewable:
    """Return the body of a section in a column that is narrower than its figures; tables are too wide."""
    told = [one for one in text if "<table" not in one]
    if len(told) < len(text):
        told.append(paragraph("Its numbers stand in the tab Model against measurement.", kind="quiet"))
    drawn = [panes.picture(fit_figure(plot, plot.height or _MAP)) for plot in figures]
    return pn.Column(*drawn, panes.text(*told), sizing_mode="stretch_width")


def _channel_in(effect: str, rows: ResidualRows | None) -> str:
    """Return the longest name of a coordinate that stands in an effect's name; empty without any."""
    named = [name for name in (rows.coordinates if rows else ()) if name in effect]
    return max(named, key=len, default="")


def _ends(
    event: SelectionGeometry, axis: str, least: float = -np.inf, most: float = np.inf
) -> tuple[float, float]:
    """Return the ends of a selection along an axis, no further than some limits."""
    low, high = sorted(float(event.geometry[f"{axis}{end}"]) for end in "01")
    return max(low, least), min(high, most)


def fit_figure(plot: figure, height: int) -> figure:
    """Let a figure take the width there is, its tools beside it: a row of tools has no room above."""
    plot.sizing_mode, plot.height = "stretch_width", height
    plot.toolbar_location, plot.toolbar.autohide = "right", True
    return plot
