"""What a table of states says against the delivery it was learnt from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

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
    """Return True when units, else the gradiometer, add more to the outer than to the inner sensor."""
    outer = np.asarray(table["unit_correction"].values)
    inner = outer + np.asarray(table["unit"].values)
    variance = np.einsum("uii->ui", np.asarray(table["unit_covariance"].values))
    clear = (np.abs(outer) > _CLEAR * np.sqrt(np.clip(variance, 0.0, None))).any(axis=1)
    if clear.any():
        sizes = [float(np.linalg.norm(one[clear])) for one in (outer, inner)]
    elif has_gradiometer(table) and str(table.attrs["method"]) == "gradiometer":
        matrix = gradiometer_of(table).matrix
        sizes = [float(np.linalg.norm(one)) for one in (matrix, matrix + np.eye(3))]
    else:
        return False
    return sizes[0] > _LARGER * sizes[1]


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
