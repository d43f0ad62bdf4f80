"""Pictures of days that need no scripts: a calendar with a thumbnail a day, and a picture of each as SVG.

In go arrays of one day; out come SVG and HTML as text, always the same for the same numbers. What is drawn
is the range of the values in short spans, so that no spike is lost.
"""

from __future__ import annotations

import calendar
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from inflight.arrays import Floats
from inflight.calibration import TableChanges
from inflight.figures.text import render
from inflight.time import to_utc

#: Okabe and Ito's colours for the axes: told apart by colour-blind readers.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
#: Part of a calendar's days whose range its thumbnails hold; wilder days are cut off.
_USUAL = 0.9
#: Width and height of a thumbnail and of a panel of a day's picture, pixels, and spans across each.
_SMALL, THUMBNAIL_BINS = (84, 34), 42
_PANEL, _PANEL_BINS = (900, 150), 450
_MARGIN = 70


@dataclass(frozen=True)
class Panel:
    """Curves of one unit over a day.

    Attributes
    ----------
    title, unit : str
    names : sequence of str
    values : ndarray, shape (time, curve)
    """

    title: str
    unit: str
    names: Sequence[str]
    values: Floats


@dataclass(frozen=True)
class CalendarDay:
    """What the calendar shows of a day.

    Attributes
    ----------
    words : str
    link : str
        To its picture; empty where there is none.
    low, high : ndarray, shape (bin,)
        Range of what the thumbnail shows, in `THUMBNAIL_BINS` spans of the day.
    """

    words: str
    link: str = ""
    low: Floats = field(default_factory=lambda: np.empty(0))
    high: Floats = field(default_factory=lambda: np.empty(0))


def ranges(part_of_day: Floats, values: Floats, bins: int) -> tuple[Floats, Floats]:
    """Return smallest and largest value in each of equal spans of a day; (bin,), NaN where there is none."""
    good = np.isfinite(values) & (part_of_day >= 0) & (part_of_day < 1)
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    place = (part_of_day[good] * bins).astype(np.int64)
    np.minimum.at(low, place, values[good])
    np.maximum.at(high, place, values[good])
    empty = ~np.isfinite(low)
    low[empty] = high[empty] = np.nan
    return low, high


def _paths(
    part_of_day: Floats, panel: Panel, bins: int, size: tuple[int, int]
) -> tuple[list[dict[str, str]], tuple[float, float]]:
    """Return the curves as outlines of SVG, and the smallest and largest value."""
    width, height = size
    found = [ranges(part_of_day, column, bins) for column in panel.values.T]
    known = np.concatenate([np.concatenate(pair) for pair in found]) if found else np.empty(0)
    known = known[np.isfinite(known)]
    least, most = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    scale = (height - 2.0) / (most - least) if most > least else 0.0
    out = []
    for name, colour, (low, high) in zip(panel.names, COLOURS, found, strict=False):
        top, bottom = (height - 1.0 - scale * (edge - least) for edge in (high, low))
        x = (np.arange(bins) + 0.5) * width / bins
        out.append({"name": name, "colour": colour, "d": _outline(x, top, bottom)})
    return out, (least, most)


def _outline(x: Floats, top: Floats, bottom: Floats) -> str:
    """Return the band between two curves; gaps break it."""
    known = np.isfinite(top)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    parts = []
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        there = zip(x[begin:end].tolist(), top[begin:end].tolist(), strict=True)
        back = zip(x[begin:end][::-1].tolist(), bottom[begin:end][::-1].tolist(), strict=True)
        points = [f"{one:.1f},{other:.1f}" for one, other in (*there, *back)]
        parts.append(f"M{' '.join(points)}Z")
    return "".join(parts)


def _thumbnails(days: Mapping[np.datetime64, CalendarDay]) -> dict[np.datetime64, Markup]:
    """Return small pictures of days without axes, on one scale: the size that most days keep within."""
    width, height = _SMALL
    sizes = {
        day: float(max(np.nanmax(one.high), -np.nanmin(one.low)))
        for day, one in days.items()
        if np.isfinite(one.low).any()
    }
    most = float(np.quantile(list(sizes.values()), _USUAL, method="higher")) if sizes else 0.0
    x = (np.arange(THUMBNAIL_BINS) + 0.5) * width / THUMBNAIL_BINS
    out = {}
    for day in sizes:
        scale = 0.5 * height / most if most > 0 else 0.0
        top, bottom = (
            np.clip(0.5 * height - scale * edge, 0.5, height - 0.5)
            for edge in (days[day].high, days[day].low)
        )
        curve = {"colour": COLOURS[0], "d": _outline(x, top, bottom)}
        out[day] = render("thumbnail.svg", curves=[curve], width=width, height=height)
    return out


def day_picture(
    title: str, part_of_day: Floats, panels: Sequence[Panel], flagged: npt.NDArray[np.bool_]
) -> str:
    """Return a picture of a day as SVG.

    Parameters
    ----------
    title : str
    part_of_day : ndarray, shape (time,)
        0 at its begin, 1 at its end.
    panels : sequence of Panel
        Drawn below each other, hours along all of them.
    flagged : ndarray of bool, shape (time,)
        Samples that are not to be used: a strip below the panels.
    """
    width, height = _PANEL
    drawn = []
    for place, panel in enumerate(panels):
        curves, (least, most) = _paths(part_of_day, panel, _PANEL_BINS, _PANEL)
        drawn.append(
            {
                "top": 40 + place * (height + 34),
                "title": f"{panel.title} ({panel.unit})",
                "curves": curves,
                "least": f"{least:.6g}",
                "most": f"{most:.6g}",
            }
        )
    _, worst = ranges(part_of_day, flagged.astype(np.float64), _PANEL_BINS)
    step = width / _PANEL_BINS
    marks = [f"{place * step:.1f}" for place in np.flatnonzero(worst > 0).tolist()]
    bottom = 40 + len(panels) * (height + 34)
    return str(
        render(
            "day.svg",
            title=title,
            panels=drawn,
            marks=marks,
            mark_width=f"{step:.1f}",
            bottom=bottom,
            width=width,
            height=height,
            margin=_MARGIN,
            hours=[(hour, f"{width * hour / 24:.1f}") for hour in range(0, 25, 3)],
        )
    )


@dataclass(frozen=True)
class ChangePanel:
    """Changes with time.

    Attributes
    ----------
    title, unit : str
    start, end : ndarray of datetime64, shape (span,)
        From when to when each holds.
    values : ndarray, shape (span,)
    sigma : ndarray, shape (span,), optional
        Half the height of the band about zero that a change within its errors stays in.
    """

    title: str
    unit: str
    start: npt.NDArray[np.datetime64]
    end: npt.NDArray[np.datetime64]
    values: Floats
    sigma: Floats | None = None


def changes_picture(title: str, panels: Sequence[ChangePanel]) -> str:
    """Return changes as an SVG, a panel below the other, all over the same time."""
    width, height = _PANEL
    first = min(panel.start.min() for panel in panels)
    last = max(panel.end.max() for panel in panels)
    drawn = []
    for place, panel in enumerate(panels):
        x, right = (width * ((at - first) / (last - first)) for at in (panel.start, panel.end))
        band = np.zeros(len(x)) if panel.sigma is None else np.nan_to_num(panel.sigma)
        # Values are seen whole; a band that is much wider is cut.
        size = float(np.nanmax(np.abs(panel.values), initial=0.0)) or 1.0
        most = 1.05 * max(size, min(float(band.max(initial=0.0)), 3 * size))
        least = -most if panel.sigma is not None or np.nanmin(panel.values) < 0 else 0.0

        def y(value: Floats, most: float = most, least: float = least) -> Floats:
            return np.asarray(height * (most - np.clip(value, least, most)) / (most - least))

        known = np.flatnonzero(np.isfinite(panel.values)).tolist()
        level, top, bottom = y(panel.values), y(band), y(-band)
        drawn.append(
            {
                "top": 50 + place * (height + 34),
                "title": f"{panel.title} ({panel.unit})" if panel.unit not in ("", "1") else panel.title,
                "curve": "".join(
                    f"M{x[at]:.1f},{level[at]:.1f}H{max(right[at], x[at] + 2):.1f}" for at in known
                ),
                "band": "".join(
                    f"M{x[at]:.1f},{top[at]:.1f}H{right[at]:.1f}V{bottom[at]:.1f}H{x[at]:.1f}z"
                    for at in np.flatnonzero(band > 0).tolist()
                ),
                "zero": f"{float(y(np.zeros(1))[0]):.1f}",
                "least": f"{least:.4g}",
                "most": f"{most:.4g}",
            }
        )
    return (
        str(
            render(
                "changes.svg",
                title=title,
                panels=drawn,
                bottom=50 + len(panels) * (height + 34),
                width=width,
                height=height,
                margin=_MARGIN,
                first=str(first.astype("datetime64[m]")),
                last=str(last.astype("datetime64[m]")),
            )
        )
        + "\n"
    )


def table_change_panels(found: TableChanges) -> list[ChangePanel]:
    """Return what changed from one calibration table to another: all parameters together, then each."""
    start, end = to_utc(found.start), to_utc(found.end)
    together = ChangePanel("all parameters together, rms over directions", "nT", start, end, found.field)
    panels = [together] if np.isfinite(found.field_rms()) else []
    for one in found.rows():
        at = found.parameters.index(one.parameter)
        change, sigma = found.change[:, at], found.sigma[:, at]
        panels.append(ChangePanel(one.parameter, one.unit, start, end, change, sigma))
    return panels


def calendar_page(title: str, what: str, days: Mapping[np.datetime64, CalendarDay]) -> str:
    """Return a page with the months of some days, a cell a day; `what` is what its thumbnails show."""
    thumbnails = _thumbnails(days)
    months = sorted({day.astype("datetime64[M]") for day in days})
    drawn = []
    for month in months:
        year, number = (int(part) for part in str(month).split("-"))
        weeks = [
            [
                {
                    "number": date.day,
                    "shown": days.get(np.datetime64(date, "D")),
                    "thumbnail": thumbnails.get(np.datetime64(date, "D"), ""),
                }
                if date.month == number
                else None
                for date in week
            ]
            for week in calendar.Calendar().monthdatescalendar(year, number)
        ]
        drawn.append({"name": f"{calendar.month_name[number]} {year}", "weeks": weeks})
    return str(render("calendar.html", title=title, what=what, months=drawn)) + "\n"


def by_day_picture(title: str, unit: str, days: Sequence[np.datetime64], values: Floats, level: float) -> str:
    """Return values of days as dots in an SVG, with a level as a line where it is a number.

    Parameters
    ----------
    days : sequence of datetime64[D]
        Rising.
    values : ndarray, shape (day,)
    level : float
    """
    width, height = _PANEL
    first, last = days[0], days[-1]
    span = max(int((last - first) / np.timedelta64(1, "D")), 1)
    known = values[np.isfinite(values)]
    most = 1.05 * max(float(known.max(initial=0.0)), level if np.isfinite(level) else 0.0) or 1.0
    dots = [
        (
            f"{width * float((day - first) / np.timedelta64(1, 'D')) / span:.1f}",
            f"{height * (1 - value / most):.1f}",
        )
        for day, value in zip(days, values.tolist(), strict=True)
        if np.isfinite(value)
    ]
    line = f"{height * (1 - level / most):.1f}" if np.isfinite(level) else ""
    return str(
        render(
            "by_day.svg",
            title=f"{title} ({unit})",
            dots=dots,
            line=line,
            first=str(first),
            last=str(last),
            most=f"{most:.3g}",
            width=width,
            height=height,
            margin=_MARGIN,
        )
    )
