"""What the flips of a mission tell of its sensors and its spacecraft, as a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.mission import Mission
from inflight.model import Model
from inflight.spin.equation import NAMES
from inflight.tasks.flips import flips_of
from inflight.tasks.spin_tables import spin_table, zero_level_table
from inflight.time import utc_text
from inflight.zero_level.flipper import PARTS, Flipped, separate

#: Offsets along x and z among the twelve.
_X, _Z = NAMES.index("offset[1]"), NAMES.index("offset[3]")


def flipper_table(
    days: Sequence[xr.Dataset], model: Model, edges: Sequence[np.datetime64], mission: Mission
) -> xr.Dataset:
    """Return what each flip tells of sensors and spacecraft, from the positions before and after it.

    Parameters
    ----------
    days : sequence of Dataset
        As `inflight.tasks.spin_day.spin_day` makes them, in order of time.
    edges : sequence of datetime64[D]
        Of the positions: see `inflight.tasks.flips.cut_at_flips`.

    Returns
    -------
    xarray.Dataset
        dims interval (from a flip to the next), parameter (`inflight.zero_level.flipper.PARTS`): `value`,
        `sigma`, `covariance` nT, `units`, `start`, `end` TT2000. The offsets are those of the readings as
        delivered, pre-flight values not taken off.

    Raises
    ------
    CalibrationError
        When no flip has all four corrections.
    """
    zero = zero_level_table(days, model, edges)
    table = spin_table(days, model, edges, "positions", zero)
    rows, missing = [], []
    for at, flipped in flips_of(mission):
        before, after = _beside(table, at)
        if before is None or after is None:
            missing.append(f"{utc_text(at)}: no day on one side")
            continue
        plain, turned = (before, after) if flipped else (after, before)
        try:
            found = separate(*_corrections(plain, turned), _covariance(plain, turned))
        except CalibrationError as error:
            missing.append(f"{utc_text(at)}: {error.message}")
            continue
        rows.append((max(at, int(table["start"].values[0])), int(after["end"].values), found))
    if not rows:
        raise CalibrationError(
            f"no flip tells sensors and spacecraft apart: {'; '.join(missing)}",
            remedy="take a span with some days of wind in both positions",
        )
    return _table(rows, model)


def _beside(table: xr.Dataset, at: int) -> tuple[xr.Dataset | None, xr.Dataset | None]:
    """Return the rows of the positions before and after a flip; edges lie within half a day of it."""
    middle = (table["start"].values + table["end"].values) // 2
    before, after = np.flatnonzero(middle < at), np.flatnonzero(middle >= at)
    return (
        table.isel(interval=int(before[-1])) if before.size else None,
        table.isel(interval=int(after[0])) if after.size else None,
    )


def _corrections(plain: xr.Dataset, turned: xr.Dataset) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (C', C'') and (D', D''), nT; NaN for what remains at its ground value."""
    both = [np.where(one["determined"].values, one["value"].values, np.nan) for one in (plain, turned)]
    return (float(both[0][_Z]), float(both[1][_Z])), (float(both[0][_X]), float(both[1][_X]))


def _covariance(plain: xr.Dataset, turned: xr.Dataset) -> Floats:
    """Return the covariance of (C', C'', D', D''), nT^2; positions are independent of each other."""
    out = np.zeros((4, 4))
    for at, one in enumerate((plain, turned)):
        places = np.array([at, at + 2])
        out[np.ix_(places, places)] = one["covariance"].values[np.ix_([_Z, _X], [_Z, _X])]
    return out


def _table(rows: Sequence[tuple[int, int, Flipped]], model: Model) -> xr.Dataset:
    each, one = ("interval", "parameter"), ("interval",)
    # A flip's parts hold until the next one, whatever days its position has.
    ends = [*(later[0] for later in rows[1:]), rows[-1][1]]
    return xr.Dataset(
        {
            "value": (each, np.array([row[2].value for row in rows]), {"units": "nT"}),
            "sigma": (each, np.array([row[2].sigma for row in rows]), {"units": "nT"}),
            "covariance": ((*each, "other"), np.array([row[2].covariance for row in rows])),
            "told": (one, np.array([row[2].told() for row in rows], dtype=np.str_)),
            "units": ("parameter", np.array(["nT"] * len(PARTS), dtype="U8")),
            "start": (one, np.array([row[0] for row in rows], dtype=np.int64), {"scale": "TT2000"}),
            "end": (one, np.array(ends, dtype=np.int64), {"scale": "TT2000"}),
        },
        coords={"parameter": list(PARTS), "other": list(PARTS)},
        attrs={"comparison": model.comparison, "kind": "flipper", "model": model.sha},
    )
