"""What a table of states says against the delivery it was learnt from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.dual.gradiometer_table import gradiometer_of, has_gradiometer

#: Said of sensors of which the outer one sees more of the spacecraft.
SWAPPED = "the sensor called outboard sees more of the spacecraft's field than the one called inboard"
_REMEDY = "look whether the mission's file has the two sensors exchanged"
#: A unit counts that moves the outboard sensor by so many errors, and the larger side is so much larger.
_CLEAR, _LARGER = 4.0, 1.5


def with_remark(table: xr.Dataset) -> xr.Dataset:
    """Return a table with attribute `remark`: empty, or what is strange about its readings."""
    return table.assign_attrs(remark=SWAPPED if _looks_swapped(table) else "")


def _looks_swapped(table: xr.Dataset) -> bool:
    """Return True when what switches adds more to the outer than to the inner sensor."""
    for outer, apart, covariance in _steps(table):
        inner = outer + apart
        variance = np.einsum("uii->ui", covariance)
        clear = (np.abs(outer) > _CLEAR * np.sqrt(np.clip(variance, 0.0, None))).any(axis=1)
        if clear.any():
            return float(np.linalg.norm(outer[clear])) > _LARGER * float(np.linalg.norm(inner[clear]))
    if has_gradiometer(table) and str(table.attrs["method"]) == "gradiometer":
        matrix = gradiometer_of(table).matrix
        return float(np.linalg.norm(matrix)) > _LARGER * float(np.linalg.norm(matrix + np.eye(3)))
    return False


def _steps(table: xr.Dataset) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Give what units, then states, add to the outer sensor and to the difference, and the error."""
    names = ("unit_correction", "unit", "unit_covariance"), ("correction", "centre", "covariance")
    for place, (outer, apart, covariance) in enumerate(names):
        value, difference = (np.asarray(table[one].values) for one in (outer, apart))
        if place and len(value):
            longest = int(np.argmax(table["seconds"].values))
            value, difference = value - value[longest], difference - difference[longest]
        yield value, difference, np.asarray(table[covariance].values)


def remarks_of(tables: Mapping[np.datetime64, tuple[int, str, xr.Dataset]]) -> list[dict[str, str]]:
    """Return the remarks of the tables that hold, as problems of days that are there all the same."""
    seen: dict[int, dict[str, Any]] = {}
    for day in sorted(tables):
        number, _, table = tables[day]
        if table.attrs.get("remark"):
            seen.setdefault(
                number,
                {
                    "day": str(day),
                    "channel": "",
                    "cause": "partial",
                    "remedy": _REMEDY,
                    "message": str(table.attrs["remark"]),
                },
            )
    return list(seen.values())
