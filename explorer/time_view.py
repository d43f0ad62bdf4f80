"""The residual in time, from the whole record to samples: with flags, events, and what each effect makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import RangesUpdate
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

from inflight.arrays import Floats
from inflight.explorer import panes
from inflight.explorer.residual_rows import ResidualRows
from inflight.explorer.session import Contributions, ExplorerSession, TimeEvent
from inflight.explorer.traces import thin_trace
from inflight.explorer.view_state import ViewState
from inflight.figures import (
    StackRow,
    contribution_figure,
    mark_events,
    paragraph,
    stack_rows,
    trace_figure,
)
from inflight.time import Int64, day_bounds, to_tt2000, to_utc

#: Points of a curve, at most: more than a screen is wide.
_POINTS = 1600
#: Native samples that are read for a picture, at most; a longer span is drawn from means with their extremes.
_SAMPLES = 260_000
#: Part of the visible span by which it must change to be drawn anew; assumed.
_MOVED = 0.01
_TRACE = 290


class TimeView:
    """The residual of what is shown, in time; zoomed in far enough, its samples.

    Parameters
    ----------
    session : ExplorerSession
    state : ViewState
        The visible span is kept in it.
    """

    def __init__(self, session: ExplorerSession, state: ViewState) -> None:
        self._session, self._state = session, state
        self._rows: ResidualRows | None = None
        self._comparison, self._are_products = "", False
        self._events: Sequence[TimeEvent] = ()
        self._made: Contributions | None = None
        self._trace: figure | None = None
        self._sources: Mapping[str, ColumnDataSource] = {}
        self._stack: Sequence[StackRow] = ()
        self._stacked: Mapping[str, ColumnDataSource] = {}
        self._drawn = (0.0, 0.0)
        self._heading = pn.Column(sizing_mode="stretch_width")
        self._whole = pn.widgets.Button(name="Whole span", align="center")
        self._whole.on_click(lambda event: self._look_at(*self._ends))
        self._figures = pn.Column(sizing_mode="stretch_width")
        row = pn.Row(self._heading, self._whole, sizing_mode="stretch_width")
        self.panel = pn.Column(row, self._figures, sizing_mode="stretch_width", visible=False)

    def clear(self) -> None:
        """Show nothing until there are rows again."""
        self._rows = self._trace = None
        self.panel.visible = False

    def show(self, comparison: str, rows: ResidualRows, are_products: bool) -> None:
        """Show rows; of products their samples can be seen.

        Parameters
        ----------
        rows : ResidualRows
            Without a residual where nothing is selected.
        """
        was, old = self._visible if self._trace is not None else None, self._rows
        self._comparison, self._rows, self._are_products = comparison, rows, are_products
        self._events = self._session.events(comparison)
        # What is looked at stays, unless other days are shown.
        same = old is not None and bool((old.tt2000[[0, -1]] == rows.tt2000[[0, -1]]).all())
        kept = was if same else None
        self.panel.visible = True
        self._draw(*(kept or (_read_zoom(self._state.zoom) if was is None else None) or self._ends))

    def show_contributions(self, made: Contributions | None) -> None:
        """Show what each effect of the model makes."""
        self._made = made
        if self._rows is not None:
            self._draw(*self._visible)

    def go_to(self, day: np.datetime64) -> None:
        """Look at one day."""
        if self._trace is not None:
            first, last = day_bounds(day)
            self._look_at(*(_milliseconds(np.array([first, last]))))

    @property
    def _ends(self) -> tuple[float, float]:
        assert self._rows is not None
        first, last = _milliseconds(self._rows.tt2000[[0, -1]])
        return float(first), float(last)

    @property
    def _visible(self) -> tuple[float, float]:
        if self._trace is None:
            return self._ends
        return float(self._trace.x_range.start), float(self._trace.x_range.end)

    def _draw(self, begin: float, end: float) -> None:
        """Make the figures anew, with a visible span, ms of UTC."""
        assert self._rows is not None
        labels = ("before", "after") if self._rows.after is not None else ("residual",)
        self._sources = {name: ColumnDataSource({}) for name in (*labels, "flagged")}
        span = Range1d(begin, end)
        plot = trace_figure(self._sources, span)
        plot.sizing_mode, plot.height = "stretch_width", _TRACE
        mark_events(plot, [(one.ms, one.end_ms, one.text) for one in self._events])
        plot.on_event(RangesUpdate, self._moved)
        self._trace, parts = plot, [panes.picture(plot)]
        self._stack = ()
        if self._made is not None and self._made.effects:
            residual = self._rows.traces()[labels[-1]][1]
            self._stack = stack_rows({labels[-1]: residual, **self._made.effects})
            self._stacked = {row.name: ColumnDataSource({}) for row in self._stack}
            made = contribution_figure(self._stacked, self._stack, span)
            made.sizing_mode = "stretch_width"
            parts.append(panes.picture(made))
        self._fill(begin, end)
        self._figures.objects = parts

    def _look_at(self, begin: float, end: float) -> None:
        if self._trace is not None:
            self._trace.x_range.update(start=begin, end=end)
            self._fill(begin, end)

    def _moved(self, event: RangesUpdate) -> None:
        begin, end = float(event.x0), float(event.x1)
        was = self._drawn
        if max(abs(begin - was[0]), abs(end - was[1])) > _MOVED * max(end - begin, 1.0):
            self._fill(begin, end)

    def _fill(self, begin: float, end: float) -> None:
        """Fill the sources with what is visible; ms of UTC."""
        assert self._rows is not None
        self._drawn = begin, end
        self._state.zoom = "" if (begin, end) == self._ends else _write_zoom(begin, end)
        # A little more than is visible: a curve goes on to the edge.
        room = 0.02 * (end - begin)
        first, last = (int(one) for one in _tt2000(np.array([begin - room, end + room])))
        rows = self._rows
        samples = None
        if self._are_products:
            samples = self._session.samples(self._comparison, first, last, _SAMPLES)
        if samples is not None:
            residual = np.where(rows.holds(samples.tt2000), samples.residual, np.nan)
            states, how = {"residual": (samples.tt2000, residual, residual, residual)}, "samples"
            bad = np.flatnonzero(samples.flags != "")
            bad = bad[:: max(1, -(-bad.size // _POINTS))]
            value = np.nan_to_num(samples.residual[bad])
            flagged = {"x": _milliseconds(samples.tt2000[bad]), "y": value, "flag": samples.flags[bad]}
        else:
            states, how = rows.traces(), f"means of {rows.step_s:.4g} s with their extremes"
            flagged = {"x": np.empty(0), "y": np.empty(0), "flag": np.empty(0, dtype=str)}
        for name, trace in states.items():
            self._sources[name].data = _data(thin_trace(*trace, first, last, _POINTS))
        self._sources["flagged"].data = flagged
        for place, row in enumerate(self._stack):
            assert self._made is not None  # there is a stack of what it makes
            if place == 0:
                time, mean = states[row.name][:2]
            else:
                time, mean = self._made.tt2000, self._made.effects[row.name]
            thin = thin_trace(time, mean, mean, mean, first, last, _POINTS)
            self._stacked[row.name].data = _in_rows(thin, row)
        ends = " to ".join(
            str(to_utc(one).astype("datetime64[m]")) for one in _tt2000(np.array([begin, end]))
        )
        text = f" {ends} UTC: {how}. Wheel and drag zoom and move; click a day of the map to be there."
        self._heading.objects = [panes.text(paragraph(text, bold="In time."))]


def _in_rows(trace: tuple[Int64, Floats, Floats, Floats], row: StackRow) -> dict[str, Any]:
    """Return a curve as a row of a stack has it."""
    time, mean, low, high = trace
    y, below, above = (row.place + (one - row.mean) * row.scale for one in (mean, low, high))
    return {"x": _milliseconds(time), "y": y, "low": below, "high": above, "nT": mean}


def _data(trace: tuple[Int64, Floats, Floats, Floats]) -> dict[str, Any]:
    time, mean, low, high = trace
    return {"x": _milliseconds(time), "mean": mean, "low": low, "high": high}


def _milliseconds(tt2000: Int64) -> Floats:
    """Return times as Bokeh's axes have them: ms of UTC since 1970."""
    return np.asarray(to_utc(tt2000).astype("datetime64[us]").astype(np.int64) / 1e3)


def _tt2000(milliseconds: Floats) -> Int64:
    return np.asarray(to_tt2000((np.asarray(milliseconds) * 1e3).astype(np.int64).astype("datetime64[us]")))


def _write_zoom(begin: float, end: float) -> str:
    times = (np.datetime64(round(one), "ms").astype("datetime64[s]") for one in (begin, end))
    return "~".join(map(str, times))


def _read_zoom(text: str) -> tuple[float, float] | None:
    """Return a visible span of the address, ms of UTC; None for none, and for what is no span."""
    try:
        begin, end = (float(np.datetime64(one, "ms").astype(np.int64)) for one in text.split("~"))
    except ValueError:
        return None
    return (begin, end) if begin < end else None
