"""How two calibrated vector sensors stand to each other over a mission, from the products of both.

Each day leaves a few Gram matrices (`inflight.mission_fit.two_fluxgates`), and the tables are algebra of
these: the relation of all days and of each day, and which of the three sensors disagrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.flags import UNUSABLE
from inflight.mission_fit import CLUSTER_S, corner_moments, corners_of, relation_grams, relation_of
from inflight.time import DAY, SECOND, day_bounds

#: Clusters of a day at most: two orbits each, and one cut at either end.
MOST_CLUSTERS = int(DAY / SECOND / CLUSTER_S) + 2


def whole_relation(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the relation of all days together."""
    return relation_of(*_grams(read)).table()


def dual_day(products: Sequence[xr.Dataset], day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return what a day's two products say of each other, and a report.

    Returns
    -------
    xarray.Dataset
        `gram` (block, cluster, column, other) and `rows` (block, cluster) of `relation_grams`, `moments`
        (block, cluster, moment) of `corner_moments`, empty clusters last; `closure` (block) nT.

    Raises
    ------
    CalibrationError
        When a day has too few samples of both.
    """
    used = [one.isel(time=(one["flag"].values & np.uint32(UNUSABLE)) == 0) for one in products]
    first, second = xr.align(*used, join="inner")
    fields = [np.asarray(one["field_spacecraft"].values, dtype=np.float64) for one in (first, second)]
    main, other = (np.asarray(one["residual"].values, dtype=np.float64) for one in (first, second))
    stamps = np.asarray(first["tt2000"].values, dtype=np.int64)
    gram, rows = relation_grams(fields[0], fields[1], stamps)
    along = np.linalg.norm(fields[0], axis=1) - np.linalg.norm(fields[1], axis=1)
    closure = float(np.sqrt(np.nanmean((main - other - along) ** 2)))
    moments = corner_moments(main, other, stamps)
    begin, end = day_bounds(day)
    found = xr.Dataset(
        {
            "gram": (("block", "cluster", "column", "other"), _filled(gram)[None], {"units": "nT2"}),
            "rows": (("block", "cluster"), _filled(rows)[None]),
            "moments": (("block", "cluster", "moment"), _filled(moments)[None]),
            "closure": ("block", np.array([closure]), {"units": "nT"}),
            "start": ("block", np.array([begin], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("block", np.array([end], dtype=np.int64), {"scale": "TT2000"}),
        }
    )
    return found, {"samples": int(stamps.size), "rms_nT": relation_of(gram, rows).rms}


def _filled(values: Floats) -> Floats:
    """Return clusters (cluster, ...) with empty ones behind them: a store's days are of one size."""
    return np.concatenate([values, np.zeros((MOST_CLUSTERS - len(values), *values.shape[1:]))])


def _grams(read: Sequence[xr.Dataset]) -> tuple[Floats, Floats]:
    gram, rows = (np.concatenate([day[name].values[0] for day in read]) for name in ("gram", "rows"))
    return gram[rows > 0], rows[rows > 0]


def daily_relations(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the relation of each day by itself; dims interval, parameter: `value`, `sigma`, `units`."""
    tables = [relation_of(*_grams([day])).table() for day in read]
    each = ("interval", "parameter")
    return xr.Dataset(
        {
            "value": (each, np.stack([one["value"].values for one in tables])),
            "sigma": (each, np.stack([one["sigma"].values for one in tables])),
            "rms": ("interval", np.array([one.attrs["rms_nT"] for one in tables]), {"units": "nT"}),
            "units": tables[0]["units"],
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": tables[0]["parameter"].values},
    )


def corner_table(read: Sequence[xr.Dataset]) -> xr.Dataset:
    """Return the variance of each of the three sensors' own error, nT^2; see `corners_of`."""
    closure = float(np.sqrt(np.mean(np.concatenate([day["closure"].values for day in read]) ** 2)))
    moments = np.concatenate([day["moments"].values[0] for day in read])
    return corners_of(moments[moments[:, 0] > 0], closure=closure).table()
