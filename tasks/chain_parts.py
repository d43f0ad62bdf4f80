"""Parts of a chain's day side by side in one Dataset, and back again.

Days of one store need arrays of one size: a part that has more rows on one day than on another is filled
up, and says how many it has.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from inflight.calibration import NormalEquations

#: The dimension of each part that differs from day to day, and the most rows of it that are kept.
ROWS = {"band": ("segment", 30), "epoch": ("epoch", 48), "channel": ("channel", 0), "beside": ("beside", 0)}
_EQUATIONS = ("gram", "scatter", "reference", "start", "end", "count")


def pack_parts(day: xr.Dataset, parts: Mapping[str, xr.Dataset | None]) -> xr.Dataset:
    """Return a day with its parts: variables ``part.variable`` with dims block, ``part.dim``, ...

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
        for key, variable in kept.variables.items():
            made[f"{name}.{key}"] = _filled(variable, name, dim, most)
        day.attrs |= {f"{name}.{key}": value for key, value in part.attrs.items()}
    return day.assign(made)


def alike(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days with the same variables, as one store needs them: what a day lacks it has no rows of."""
    whole: dict[str, xr.Variable] = {}
    for day in days:
        whole |= {str(key): day[key].variable for key in day.variables if str(key) not in whole}
    blank = {key: xr.zeros_like(one) if "block" in one.dims else one for key, one in whole.items()}
    return [day.assign({key: one for key, one in blank.items() if key not in day.variables}) for day in days]


def part_of(days: Sequence[xr.Dataset], name: str) -> list[xr.Dataset]:
    """Return a part of each day that has it, as its estimator made it."""
    return [found for day in days if (found := _unpacked(day, name)) is not None]


def strips_of(days: Sequence[xr.Dataset]) -> list[xr.Dataset | None]:
    """Return of each day what was looked at beside the model; None where nothing was."""
    return [_unpacked(day, "beside") for day in days]


def equations_of_days(days: Sequence[xr.Dataset]) -> NormalEquations:
    """Return the wide equations of days, which stand in order of time."""
    rows = [day[list(_EQUATIONS)].drop_vars("scale", errors="ignore") for day in days]
    joined = xr.concat(rows, "block", join="exact", combine_attrs="override")
    return NormalEquations(joined.assign(scale=days[0]["scale"]))


def _chosen(rows: int, most: int) -> np.ndarray:
    if not most or rows <= most:
        return np.arange(rows)
    return np.unique(np.linspace(0, rows - 1, most).astype(np.int64))


def _filled(variable: xr.Variable, name: str, dim: str, most: int) -> xr.Variable:
    values = np.asarray(variable.values)
    dims = tuple(f"{name}.{one}" for one in variable.dims)
    if values.dtype.kind in "UO":
        # Names are the same on all days.
        return xr.Variable(dims, values, variable.attrs)
    if dim in variable.dims and most:
        place = variable.dims.index(dim)
        short = [(0, most - size) if at == place else (0, 0) for at, size in enumerate(values.shape)]
        values = np.pad(values, short)
    return xr.Variable(("block", *dims), values[None], variable.attrs)


def _unpacked(day: xr.Dataset, name: str) -> xr.Dataset | None:
    prefix = f"{name}."
    if f"{prefix}kept" not in day.variables:
        return None
    rows, (dim, most) = int(day[f"{prefix}kept"].values[0]), ROWS[name]
    if not rows:
        return None
    own = {}
    for key in map(str, day.variables):
        if key.startswith(prefix) and key != f"{prefix}kept":
            variable = day[key].variable
            variable = variable.isel(block=0) if "block" in variable.dims else variable
            dims = tuple(str(one)[len(prefix) :] for one in variable.dims)
            own[key[len(prefix) :]] = xr.Variable(dims, variable.values, variable.attrs)
    coordinates = {key: own.pop(key) for key in list(own) if own[key].dims == (key,)}
    told = {key[len(prefix) :]: value for key, value in day.attrs.items() if str(key).startswith(prefix)}
    found = xr.Dataset(own, coordinates, told)
    return found.isel({dim: slice(0, rows)}) if most else found
