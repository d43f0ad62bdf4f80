"""What published tables show: parameters with errors over days, and the newest values."""

from __future__ import annotations

import xarray as xr

from inflight.catalog import Catalog
from inflight.figures import Section, html_table, paragraph, parameter_figures
from inflight.tasks.pipelines.base import newest_table, newest_tables
from inflight.time import to_utc


def table_sections(cat: Catalog, comparison: str) -> list[Section]:
    """Return sections of the newest published tables of a scalar comparison; none when there are no tables.

    Raises
    ------
    CatalogError
        When a table is damaged.
    """
    daily = newest_table(cat, f"{comparison}-daily")
    if daily is None:
        return []
    # Of the tables that products take, the first is drawn beside the daily values.
    kind, used = next(iter(newest_tables(cat, comparison, ("window", "span")).items()), ("day", daily))
    text = [
        "Circles are each day's own values with bars of one sigma; empty ones the day alone does not "
        f"determine. Lines are the table by {kind}."
    ]
    never = daily["parameter"].values[~daily["determined"].values.astype(bool).any(axis=0)]
    if never.size:
        text.append(
            f"No day determines by itself: {', '.join(map(_bare, never))}. What the table has of them is "
            "what was known before, or part of a combination that is determined."
        )
    return [
        ("Parameters over days", text, parameter_figures(daily, used)),
        ("Values", _newest_values(used), []),
    ]


def _newest_values(table: xr.Dataset) -> list[str]:
    """Return values and errors of the newest intervals, one row a parameter."""
    recent = table.isel(interval=slice(-3, None))
    intervals = [recent.isel(interval=place) for place in range(recent.sizes["interval"])]
    head = ["parameter", "unit"]
    for one in intervals:
        # Half-open: the last instant is within the last day.
        first, last = (str(to_utc(int(tt2000)))[:10] for tt2000 in (one["start"], one["end"] - 1))
        head.append(first if first == last else f"{first} to {last}")
    rows = []
    for at, name in enumerate(recent["parameter"].values):
        cells = (one.isel(parameter=at) for one in intervals)
        texts = (
            f"{float(cell['value']):.8g} ± {float(cell['sigma']):.2g}" if bool(cell["determined"]) else "-"
            for cell in cells
        )
        rows.append((_bare(name), str(recent["units"].values[at]), *texts))
    note = "The newest intervals of the table that products take; a dash where one does not determine it."
    return [html_table(head, rows), paragraph(note, kind="quiet")]


def _bare(name: str) -> str:
    return str(name).split(".", 1)[-1]
