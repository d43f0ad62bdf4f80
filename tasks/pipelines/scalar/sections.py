"""What published tables show: parameters with errors over days, the newest values, the zero level."""

from __future__ import annotations

from html import escape

import numpy as np
import xarray as xr

from inflight.catalog import Catalog
from inflight.figures import Section, html_table, parameter_figures
from inflight.tasks.pipelines.base import newest_table
from inflight.time import to_utc

#: Intervals of a table that are listed with their text; the newest.
_LISTED = 40

#: Tables that products take, the one to draw beside the daily values first.
_USED = ("window", "span")


def table_sections(cat: Catalog, comparison: str) -> list[Section]:
    """Return sections of the newest published tables of a scalar comparison; none when there are no tables.

    Raises
    ------
    CatalogError
        When a table is damaged.
    """
    out = _parameters(cat, comparison)
    zero = newest_table(cat, f"{comparison}-zero-level")
    if zero is not None:
        out.append(("Zero level", _zero_level(zero), []))
    return out


def _parameters(cat: Catalog, comparison: str) -> list[Section]:
    daily = newest_table(cat, f"{comparison}-daily")
    if daily is None:
        return []
    others = {kind: newest_table(cat, f"{comparison}-{kind}") for kind in _USED}
    kind, used = next(((name, table) for name, table in others.items() if table is not None), ("day", daily))
    told = [
        "<p>Circles are each day's own values with bars of one sigma; empty ones the day alone does not "
        f"determine. Lines are the table by {escape(kind)}.</p>",
        *_at_prior(daily),
    ]
    return [("Parameters over days", told, parameter_figures(daily, used)), ("Values", _values(used), [])]


def _at_prior(table: xr.Dataset) -> list[str]:
    """Return which parameters no interval determines."""
    known: list[bool] = np.any(table["determined"].values, axis=0).tolist()
    left = [_bare(name) for name, sure in zip(table["parameter"].values, known, strict=True) if not sure]
    if not left:
        return []
    return [
        f"<p>No day determines by itself: {escape(', '.join(left))}. What the table has of them is what was "
        "known before, or part of a combination that is determined.</p>"
    ]


def _values(table: xr.Dataset) -> list[str]:
    """Return values and errors of the newest intervals, one row a parameter."""
    recent = table.isel(interval=slice(-3, None))
    spans = [_span(recent, place) for place in range(recent.sizes["interval"])]
    rows = [
        (
            _bare(name),
            str(recent["units"].values[at]),
            *(_value(recent.isel(interval=place, parameter=at)) for place in range(len(spans))),
        )
        for at, name in enumerate(recent["parameter"].values)
    ]
    note = "The newest intervals of the table that products take; a dash where one does not determine it."
    return [html_table(("parameter", "unit", *spans), rows), f'<p class="quiet">{note}</p>']


def _value(cell: xr.Dataset) -> str:
    if not bool(cell["determined"]):
        return "-"
    return f"{float(cell['value']):.8g} ± {float(cell['sigma']):.2g}"


def _span(table: xr.Dataset, place: int) -> str:
    start, end = (str(to_utc(int(table[name].values[place] - less)))[:10] for name, less in _ENDS)
    return start if start == end else f"{start} to {end}"


#: Ends of an interval, and what to take off them to stay within their last day.
_ENDS = (("start", 0), ("end", 1))


def _zero_level(table: xr.Dataset) -> list[str]:
    """Return the offset along the spin axis, interval by interval, and what it rests on."""
    count = table.sizes["interval"]
    rows = [_zero_row(table, place) for place in range(max(0, count - _LISTED), count)]
    return [html_table(("interval", "nT", "method"), rows), *_reason(table)]


def _zero_row(table: xr.Dataset, place: int) -> tuple[str, str, str]:
    value, sigma = float(table["value"].values[place]), float(table["sigma"].values[place])
    known = np.isfinite(value) and np.isfinite(sigma)
    size = f"{value:.4g} ± {sigma:.2g}" if known else "cannot be told"
    return _span(table, place), size, str(table["method"].values[place])


def _reason(table: xr.Dataset) -> list[str]:
    """Return what the newest interval's value rests on, line by line as the methods tell it."""
    lines = str(table["reason"].values[-1]).splitlines()
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return [f'<p class="quiet">What the newest one rests on:</p><ul class="quiet">{items}</ul>']


def _bare(name: str) -> str:
    return str(name).split(".", 1)[-1]
