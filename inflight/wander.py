"""How the daily parameters wander, held against what their own uncertainties allow.

An effect that is missing from the model drives the parameters that resemble it: their scatter from
day to day then exceeds their stated standard deviations.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import xarray as xr

#: The fewest days of a scatter.
_FEWEST = 3


@dataclass(frozen=True)
class Wander:
    """Scatter of one parameter over the days that determine it by themselves.

    Attributes
    ----------
    std, sigma : float
        Standard deviation over the days, and the rms of their stated ones, in `unit`.
    ratio : float
        std / sigma: about 1 when the model is complete.
    sigma_ratio : float
        Standard deviation of the ratio if it were 1.
    days : int
        How many days.
    """

    name: str
    unit: str
    std: float
    sigma: float
    ratio: float
    sigma_ratio: float
    days: int

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name."""
        return asdict(self)


def daily_wander(daily: xr.Dataset, start: int | None = None, end: int | None = None) -> list[Wander]:
    """Return the wander of each parameter of a daily calibration table.

    Parameters
    ----------
    daily : xarray.Dataset
        Table with dims interval, parameter: `value`, `sigma`, `determined`, `start`, `units`.
    start, end : int, optional
        Half-open TT2000 span of the intervals taken.

    Returns
    -------
    list of Wander
        In the table's order; NaN where fewer than three days determine a parameter.
    """
    begin = daily["start"].values
    inside = np.ones(begin.size, dtype=bool)
    inside &= begin >= start if start is not None else True
    inside &= begin < end if end is not None else True
    rows = own_estimates(daily.isel(interval=np.flatnonzero(inside)))
    return [_wander(rows.isel(parameter=index)) for index in range(daily.sizes["parameter"])]


def own_estimates(daily: xr.Dataset) -> xr.Dataset:
    """Return a table with each interval's own estimates where it holds values that are kept from others.

    A table of a turning sensor has them as `own`, `own_sigma`: see `inflight.tasks.spin_tables`.
    """
    if "own" not in daily:
        return daily
    told = np.isfinite(daily["own_sigma"].values)
    dims = daily["value"].dims
    return daily.assign(
        value=(dims, daily["own"].values),
        sigma=(dims, daily["own_sigma"].values),
        determined=(dims, told),
    )


def _wander(one: xr.Dataset) -> Wander:
    known = one["determined"].values & np.isfinite(one["sigma"].values) & np.isfinite(one["value"].values)
    days = int(known.sum())
    name, unit = str(one["parameter"].values), str(one["units"].values) if "units" in one else ""
    if days < _FEWEST:
        nan = float("nan")
        return Wander(name, unit, nan, nan, nan, nan, days)
    std = float(np.std(one["value"].values[known], ddof=1))
    sigma = float(np.sqrt(np.mean(one["sigma"].values[known] ** 2)))
    ratio = std / sigma if sigma > 0 else float("nan")
    return Wander(name, unit, std, sigma, ratio, float(1.0 / np.sqrt(2 * (days - 1))), days)
