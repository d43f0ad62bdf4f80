"""Parts of a chain's day side by side in one Dataset, and back again.

A part is a table of rows: segments, epochs, channels. Its numbers stand in two arrays a day, one of floats
and one of whole numbers, and an attribute says which columns are which variable: a store has a file for each
array of each day, and fifty small ones would take longer to write and to read than all they hold to compute.
Days of one store need arrays of one size: a part that has more rows on one day than on another is filled up,
and says how many it has.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import NormalEquations
from inflight.calibration.equations import RESIDUAL
from inflight.chain.within import DayDrift

#: The rows of each part, and the most of them that are kept.
ROWS = {"band": ("segment", 30), "epoch": ("epoch", 48), "channel": ("channel", 0), "beside": ("beside", 0)}
#: Array of a part by the kind of its numbers.
_ARRAYS = {"f": "number", "i": "stamp"}


def pack_parts(day: xr.Dataset, parts: Mapping[str, xr.Dataset | None]) -> xr.Dataset:
    """Return a day with its parts: variables ``part.number``, ``part.stamp`` (block, row, column).

    A part that is None leaves nothing behind. Rows beyond the most kept are spread evenly over the day.
    """
    made: dict[str, xr.Variable] = {}
    for name, part in parts.items():
        if part is None:
            continue
        dim, most = ROWS[name]
        chosen = _chosen(part.sizes[dim], most)
        kept = part.isel({dim: chosen})
        made[f"{name}.kept"] = xr.Variable("block", np.array([len(chosen)], dtype=np.int64))
        columns = {str(key): one for key, one in kept.variables.items() if one.dims[:1] == (dim,)}
        fixed = {str(key): one for key, one in kept.variables.items() if str(key) not in columns}
        text = {key: columns.pop(key) for key in list(columns) if columns[key].dtype.kind in "UO"}
        for kind, array in _ARRAYS.items():
            values = [
                one.values.reshape(len(chosen), -1) for one in columns.values() if one.dtype.kind == kind
            ]
            if values:
                whole = np.zeros(
                    (max(most, len(chosen)), sum(one.shape[1] for one in values)), values[0].dtype
                )
                whole[: len(chosen)] = np.concatenate(values, axis=1)
                made[f"{name}.{array}"] = xr.Variable(
                    ("block", f"{name}.row", f"{name}.{array}_column"), whole[None]
                )
        told = {
            "columns": {
                key: [one.dtype.kind, one.dims, one.shape[1:], one.attrs] for key, one in columns.items()
            },
            "fixed": {key: [one.dims, one.values.tolist(), one.attrs] for key, one in (fixed | text).items()},
            "coordinates": [str(key) for key in part.coords],
            "attributes": part.attrs,
        }
        day.attrs[f"{name}.layout"] = json.dumps(told, default=_plain)
    return day.assign(made)


def alike(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days with the same variables, as one store needs them: what a day lacks it has no rows of."""
    whole: dict[str, xr.Variable] = {}
    for day in days:
        whole |= {str(key): day[key].variable for key in day.variables if str(key) not in whole}
    blank = {key: xr.zeros_like(one) if "block" in one.dims else one for key, one in whole.items()}
    return [day.assign({key: one for key, one in blank.items() if key not in day.variables}) for day in days]


def part_of(days: Sequence[xr.Dataset], name: str) -> list[xr.Dataset]:
    """Return the rows of a part as its estimator made them: one Dataset for all days that are laid out alike.

    Where a part's rows are the same things on every day, as channels are, ask for one day at a time.
    """
    found: dict[str, list[xr.Dataset]] = {}
    for day in days:
        layout = day.attrs.get(f"{name}.layout")
        if layout is not None and f"{name}.kept" in day.variables and int(day[f"{name}.kept"].values[0]):
            found.setdefault(layout, []).append(day)
    return [_unpacked(json.loads(layout), some, name) for layout, some in found.items()]


def strips_of(days: Sequence[xr.Dataset]) -> list[xr.Dataset | None]:
    """Return of each day what was looked at beside the model; None where nothing was."""
    return [next(iter(part_of([day], "beside")), None) for day in days]


def means_of_channels(days: Sequence[xr.Dataset]) -> dict[str, Floats]:
    """Return mean, spread and number of readings of each channel; (day, 3) each, NaN where a day lacks it."""
    out: dict[str, Floats] = {}
    names: dict[str, list[str]] = {}
    for place, day in enumerate(days):
        layout = day.attrs.get("channel.layout")
        if layout is None or "channel.number" not in day.variables:
            continue
        if layout not in names:
            names[layout] = json.loads(layout)["fixed"]["channel"][1]
        for name, row in zip(names[layout], day["channel.number"].values[0], strict=True):
            out.setdefault(name, np.full((len(days), 3), np.nan))[place] = row
    return out


def equations_of_days(days: Sequence[xr.Dataset]) -> tuple[NormalEquations, DayDrift]:
    """Return the wide equations of days, which stand in order of time, and what drifts within them."""
    every = {
        name: np.concatenate([day[name].values for day in days])
        for name in ("gram", "drift", "reference", "start", "end", "count")
    }
    drift = DayDrift(every.pop("drift"))
    dims = {"gram": ("block", "column", "other"), "reference": ("block", "column")}
    first = days[0]
    variables = {
        name: (dims.get(name, ("block",)), values, first[name].attrs) for name, values in every.items()
    }
    # The scatter within days is not used where all days are fitted: between them there is more of it.
    nothing = np.broadcast_to(0.0, every["gram"].shape)
    joined = xr.Dataset(
        {**variables, "scatter": (dims["gram"], nothing), "scale": first["scale"]},
        coords={"column": first["column"].values, "other": first["other"].values},
        attrs=first.attrs,
    )
    assert str(joined["column"].values[-1]) == RESIDUAL
    return NormalEquations(joined), drift


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else np.asarray(value).tolist()


def _chosen(rows: int, most: int) -> np.ndarray:
    if not most or rows <= most:
        return np.arange(rows)
    return np.unique(np.linspace(0, rows - 1, most).astype(np.int64))


def _unpacked(layout: dict[str, Any], days: Sequence[xr.Dataset], name: str) -> xr.Dataset:
    """Return the rows of days of one layout."""
    kept = [int(day[f"{name}.kept"].values[0]) for day in days]
    whole = {
        kind: np.concatenate(
            [day[f"{name}.{array}"].values[0, :rows] for day, rows in zip(days, kept, strict=True)]
        )
        for kind, array in _ARRAYS.items()
        if f"{name}.{array}" in days[0].variables
    }
    own, used = {}, dict.fromkeys(whole, 0)
    for key, (kind, dims, shape, attrs) in layout["columns"].items():
        width = int(np.prod(shape, dtype=np.int64))
        part = whole[kind][:, used[kind] : used[kind] + width]
        used[kind] += width
        own[key] = xr.Variable(dims, part.reshape(-1, *shape), attrs)
    own |= {
        key: xr.Variable(dims, np.array(values), attrs)
        for key, (dims, values, attrs) in layout["fixed"].items()
    }
    coordinates = {key: own.pop(key) for key in layout["coordinates"]}
    return xr.Dataset(own, coordinates, layout["attributes"])
