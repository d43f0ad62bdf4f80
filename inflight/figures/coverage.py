"""Coverage of a dataset as a calendar: years down, days of the year across, a colour for each day."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bokeh.models import ColumnDataSource, FixedTicker, HoverTool, TapTool
from bokeh.plotting import figure
from markupsafe import Markup

from inflight.figures.style import plain_figure
from inflight.figures.text import render
from inflight.time import Int64

#: Okabe and Ito's colours, told apart by colour-blind readers; grey where nothing is there. A day of which a
#: few samples lack something is pale: it is there.
COVERAGE_COLOURS = {
    "failed": "#d55e00",
    "missing": "#c4c4c4",
    "excluded": "#cc79a7",
    "partial": "#f5cf8a",
    "old model": "#f0e442",
    "quick-look": "#56b4e9",
    "preliminary": "#0072b2",
    "definitive": "#009e73",
    "archived": "#0072b2",
}
#: Days that the shortest calendar is wide, and height of a year and of what is around them, pixels.
_LEAST_DAYS, _YEAR_PX, _AROUND_PX = 31, 30, 112
_COMMON_YEAR = np.datetime64("2001-01-01")


def coverage_figure(
    title: str, days: Sequence[tuple[np.datetime64, str, str]]
) -> tuple[figure, ColumnDataSource]:
    """Return the calendar of some days and the source of its cells, in their order.

    Parameters
    ----------
    title : str
    days : sequence of (datetime64[D], str, str)
        Day, what became of it (a key of `COVERAGE_COLOURS`), and why.
    """
    dates = np.array([day for day, _, _ in days], dtype="datetime64[D]")
    years = dates.astype("datetime64[Y]").astype(np.int64) + 1970
    day_of_year = (dates - dates.astype("datetime64[Y]")).astype(np.int64) + 1
    kinds = [kind for _, kind, _ in days]
    source = ColumnDataSource(
        {
            "x": day_of_year,
            "year": years,
            "day": dates.astype(str).tolist(),
            "kind": kinds,
            "why": [why for _, _, why in days],
            "colour": [COVERAGE_COLOURS[kind] for kind in kinds],
        }
    )
    begin, end = int(day_of_year.min()), int(day_of_year.max())
    if np.unique(years).size > 1:
        begin, end = 1, 366
    end = max(end, begin + _LEAST_DAYS - 1)
    first, last = int(years.min()), int(years.max())
    plot = plain_figure(
        title,
        "day of the year",
        "",
        height=_AROUND_PX + _YEAR_PX * (last - first + 1),
        x_range=(begin - 0.5, end + 0.5),
        y_range=(last + 0.5, first - 0.5),
    )
    wide = end - begin < 2 * _LEAST_DAYS
    cells = plot.rect(
        "x",
        "year",
        width=0.92 if wide else 1.0,
        height=0.86,
        fill_color="colour",
        # Narrow cells without a line of their own leave seams.
        line_color=None if wide else "colour",
        source=source,
        nonselection_fill_alpha=1.0,
        nonselection_line_alpha=1.0,
        selection_line_color="black",
    )
    hover = plot.select_one(HoverTool)
    hover.renderers, hover.tooltips = [cells], [("day", "@day"), ("", "@kind"), ("", "@why")]
    plot.add_tools(TapTool(renderers=[cells]))
    plot.min_border_bottom, plot.yaxis.axis_label = 0, None
    plot.yaxis.ticker = FixedTicker(ticks=list(range(first, last + 1, -(-(last - first + 1) // 20))))
    _name_months(plot, begin, end, years)
    plot.grid.visible = False
    return plot, source


def _name_months(plot: figure, begin: int, end: int, years: Int64) -> None:
    """Write months below the days, and the days themselves where there is room."""
    if end - begin < 2 * _LEAST_DAYS:
        new_year = np.datetime64(f"{int(years.min())}-01-01")
        step = 1 if end - begin < _LEAST_DAYS else 5
        ticks = list(range(begin, end + 1, step))
        labels = {tick: str(new_year + np.timedelta64(tick - 1, "D"))[5:] for tick in ticks}
        plot.xaxis.axis_label = "month-day"
        plot.xaxis.major_label_orientation = 0.9
    else:
        months = _COMMON_YEAR.astype("datetime64[M]") + np.arange(12)
        starts = (months.astype("datetime64[D]") - _COMMON_YEAR).astype(np.int64) + 1
        labels = {int(start): str(month)[5:] for start, month in zip(starts, months, strict=True)}
        ticks, plot.xaxis.axis_label = list(labels), "month"
    plot.xaxis.ticker = FixedTicker(ticks=ticks)
    plot.xaxis.major_label_overrides = labels


def coverage_legend(kinds: Sequence[str]) -> Markup:
    """Return how many days are of each kind, with its colour, as HTML."""
    counts = [(kind, colour, kinds.count(kind)) for kind, colour in COVERAGE_COLOURS.items() if kind in kinds]
    return render("coverage.html", counts=counts)
