"""Calibration tables: the newest published ones, the edges of their intervals, what they are made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from inflight.catalog import Catalog, Day, TableRecord
from inflight.time import as_day

if TYPE_CHECKING:
    import xarray as xr

#: The first day of the grid of windows.
GRID_ORIGIN = np.datetime64("2000-01-01", "D")


def newest_record(cat: Catalog, name: str) -> TableRecord | None:
    """Return the record of the table of a name that was certified last and is whole; None without one."""
    records = [one for one in cat.tables(name) if one.certified and not one.damaged]
    return records[-1] if records else None


def newest_table(cat: Catalog, name: str) -> xr.Dataset | None:
    """Return the table of a name that was certified last and is whole; None without one."""
    record = newest_record(cat, name)
    return None if record is None else cat.table_by_id(record.id)


def newest_tables(cat: Catalog, comparison: str, names: Sequence[str]) -> dict[str, xr.Dataset]:
    """Return the newest tables of a comparison by name, those that there are."""
    found = {name: newest_table(cat, f"{comparison}-{name}") for name in names}
    return {name: table for name, table in found.items() if table is not None}


def window_edges(first: np.datetime64, last: np.datetime64, days: int) -> list[np.datetime64]:
    """Return the edges of the fixed grid of windows that covers the days first to last (inclusive)."""
    step = np.timedelta64(days, "D")
    begin = GRID_ORIGIN + ((as_day(first) - GRID_ORIGIN) // step) * step
    count = int((as_day(last) - begin) // step) + 1
    return [begin + index * step for index in range(count + 1)]


def month_edges(first: np.datetime64, last: np.datetime64) -> list[np.datetime64]:
    """Return the edges of the calendar months that hold the days first to last (inclusive)."""
    begin, end = (as_day(day).astype("datetime64[M]") for day in (first, last))
    months = np.arange(begin, end + np.timedelta64(2, "M"), dtype="datetime64[M]")
    return list(months.astype("datetime64[D]"))


def content_keys(days: Mapping[np.datetime64, Day]) -> list[str]:
    """Return the keys of days in order: what a table's own key is made from."""
    return [days[day].key for day in sorted(days)]
