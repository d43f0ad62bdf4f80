"""Calibration tables as files that need no Zarr: CSV for a spreadsheet, CDF for the tools of the field.

In goes a table's Dataset; out comes one file. Bytes follow from the table alone.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.time import to_utc

if TYPE_CHECKING:
    import xarray as xr

#: Variables of a table that hold TT2000.
_TIMES = ("start", "end", "learnt_start", "learnt_end")
#: Dimensions of matrices between parameters: of a symmetric one half is written.
_SQUARE = ("parameter", "other")


def write_table_csv(path: Path, table: xr.Dataset) -> None:
    """Write one row an interval: when it is, then every number of it under its name.

    ``value[scale_factor[x]]`` is one parameter's value; ``start_utc`` and ``end_utc`` say in UTC what
    ``start`` and ``end`` say in TT2000; numbers that stand for words are written as these. What does not
    depend on the interval is repeated in each row; how much parameters change (along ``lag``) is left out.
    """
    rows = _row_dimension(table)
    columns: dict[str, list[Any]] = {}
    count = int(table.sizes[rows]) if rows else 1
    names = [name for name in map(str, table.data_vars) if "lag" not in table[name].dims]
    order = {name: place for place, name in enumerate(_TIMES)}
    for name in sorted(names, key=lambda one: (order.get(one, len(order)), one)):
        for label, values in _columns(name, table[name], rows, count):
            meanings = str(table[name].attrs.get("flag_meanings", "")).split()
            columns[label] = [meanings[value] for value in values] if meanings else values
            if name in _TIMES:
                columns[f"{label}_utc"] = [str(to_utc(np.int64(value))) for value in values]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def _row_dimension(table: xr.Dataset) -> str | None:
    """Return the dimension of a table whose entries are rows: its intervals, or else its first."""
    dims = [str(dim) for dim in table.dims]
    return "interval" if "interval" in dims else next(iter(dims), None)


def _columns(name: str, array: xr.DataArray, rows: str | None, count: int) -> Iterator[tuple[str, list[Any]]]:
    """Yield a variable's columns: label, and a value of each row."""
    values = array if rows in array.dims else array.expand_dims({rows or "row": count})
    values = values.transpose(rows or "row", ...)
    inner = [str(dim) for dim in values.dims[1:]]
    labels = [
        [str(one) for one in (array[dim].values if dim in array.coords else range(array.sizes[dim]))]
        for dim in inner
    ]
    for place in product(*(range(len(one)) for one in labels)):
        if tuple(inner) == _SQUARE and place[1] > place[0]:
            continue
        picked = ", ".join(one[at] for one, at in zip(labels, place, strict=True))
        column = np.moveaxis(values.values, 0, -1)[place]
        yield (f"{name}[{picked}]" if inner else name), column.tolist()


def write_table_cdf(path: Path, table: xr.Dataset) -> None:
    """Write a table as CDF: one record an interval, ``start`` and ``end`` as TT2000, names as labels."""
    from inflight.catalog.day_files import CDF_FILL, cdf_type, cdf_writer, filled, put_numbers, put_text

    rows = _row_dimension(table)
    with cdf_writer(path) as writer:
        title = {"TITLE": {0: "Calibration table"}, "Project": {0: str(table.attrs.get("mission", ""))}}
        writer.write_globalattrs(title)
        for name in sorted(map(str, table.variables)):
            array = table[name]
            along = bool(rows) and array.dims[:1] == (rows,)
            values = np.asarray(array.values)
            by = " and ".join(map(str, array.dims)) or "nothing"
            attributes = {
                "CATDESC": f"{name} of the calibration table, by {by}",
                "FIELDNAM": name,
                "UNITS": str(array.attrs.get("units", " ")),
                "VAR_TYPE": "support_data" if along else "metadata",
            }
            if values.dtype.kind not in "fiub":
                put_text(writer, name, values.astype(str), attributes, rows=along)
                continue
            if name in _TIMES:
                put_numbers(writer, name, 33, values.astype(np.int64), attributes, rows=along)
                continue
            if values.dtype.kind == "f":
                attributes["FILLVAL"] = values.dtype.type(CDF_FILL)
            put_numbers(writer, name, cdf_type(array).number, filled(array), attributes, rows=along)
