"""A calibration table outside the span that it was learnt from: which samples lie there, and how uncertain.

A row of a table is learnt from the blocks with data in it: ``learnt_start`` to ``learnt_end``. Outside that
span a value is *held*, and its error is the row's own plus the parameter's change between the middle of the
span and the sample. How much a parameter changes is measured in the table itself: with its values ``p`` in
rows that are k rows apart,

    d(k) = rms of p[i + k] - p[i]

at the rms of their distances. No row's error is subtracted, so that the error of a slope goes along. k is 1,
2, 4, ... up to half the rows, so that every mean has as many pairs. Between these distances the square of d
is linear, from 0 at 0. Beyond the last of them, L, d grows as ``d(L) elapsed / L``: of changes that are alike
at all times (stationary increments) those over n L are at most n times as large as those over L, whatever
their correlation (Minkowski's inequality; a steady drift reaches it). For the same reason the parts that
parameters have in a component of the field are added up, not their squares: they may age by one cause, and a
few rows do not tell. A sensor that changes faster than it ever did while it was calibrated is not covered.

A table of fewer than three rows takes the changes of a finer one, such as those from day to day; where there
is none, what was known before flight: the prior's sigmas.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from inflight.arrays import Floats
from inflight.errors import CalibrationError
from inflight.time import Int64

if TYPE_CHECKING:
    import xarray as xr

#: Fewer learnt rows tell nothing of how much parameters change.
FEWEST_ROWS = 3

#: Variables that tell what a row was learnt from, and those that tell how much parameters change.
LEARNT, CHANGE = ("learnt_start", "learnt_end"), ("change_elapsed", "change")


def with_learnt_spans(table: xr.Dataset, start: Int64, end: Int64) -> xr.Dataset:
    """Return a table whose rows tell the span they were learnt from, TT2000; an empty one for none."""
    scale = {"scale": "TT2000"}
    spans = zip(LEARNT, (start, end), strict=True)
    return table.assign({name: ("interval", np.asarray(at, dtype=np.int64), scale) for name, at in spans})


def with_changes(table: xr.Dataset, measured_in: Sequence[xr.Dataset] | None = None) -> xr.Dataset:
    """Return a table that tells how much its parameters change.

    Parameters
    ----------
    table : xarray.Dataset
        dims interval, parameter: `value`, `learnt_start`, `learnt_end`.
    measured_in : sequence of xarray.Dataset, optional
        Tables of the same parameters: the first with rows enough tells the changes. `table` itself when
        absent.

    Returns
    -------
    xarray.Dataset
        With `change_elapsed` (lag), ns, and `change` (lag, parameter), rms change over it in the parameters'
        units; without them where no table has rows enough.
    """
    names = table["parameter"].values.tolist()
    for one in [table] if measured_in is None else measured_in:
        taught = one.isel(interval=_learnt(one)).sel(parameter=names)
        if taught.sizes["interval"] >= FEWEST_ROWS:
            elapsed, change = _changes(_middle(taught), np.asarray(taught["value"].values))
            return table.assign(
                change_elapsed=("lag", elapsed, {"units": "ns"}),
                change=(("lag", "parameter"), change),
            )
    return table


def _learnt(table: xr.Dataset) -> np.ndarray:
    return np.flatnonzero(table["learnt_end"].values > table["learnt_start"].values)


def _middle(table: xr.Dataset) -> Int64:
    return np.asarray(table["learnt_start"].values // 2 + table["learnt_end"].values // 2, dtype=np.int64)


def _changes(at: Int64, value: Floats) -> tuple[Int64, Floats]:
    """Return the rms distances (lag,), ns, and rms changes (lag, parameter) of rows."""
    steps = 2 ** np.arange(int(np.log2(len(at) // 2)) + 1)
    elapsed, change = [], []
    for step in steps:
        moved = value[step:] - value[:-step]
        apart = (at[step:] - at[:-step]).astype(np.float64)
        elapsed.append(np.sqrt(np.mean(apart**2)))
        change.append(np.sqrt(np.mean(moved**2, axis=0)))
    return np.rint(elapsed).astype(np.int64), np.array(change)


def expected_change(table: xr.Dataset, elapsed: float, names: Sequence[str]) -> Floats:
    """Return by how much parameters may have changed over a time, one sigma each; (parameter,).

    Parameters
    ----------
    table : xarray.Dataset
        As `with_changes` returns it.
    elapsed : float
        From the middle of the span that taught a row, ns, whatever its sign.
    names : sequence of str
        The parameters, in the order of the result.
    """
    elapsed = abs(elapsed)
    places = [table["parameter"].values.tolist().index(name) for name in names]
    if "change" not in table:
        return np.asarray(table["prior_sigma"].values[places], dtype=np.float64)
    known = np.concatenate([[0.0], table["change_elapsed"].values.astype(np.float64)])
    change = np.concatenate([np.zeros((1, len(places))), table["change"].values[:, places]])
    if elapsed >= known[-1]:
        return np.asarray(change[-1] * (elapsed / known[-1]))
    return np.sqrt([np.interp(elapsed, known, squares) for squares in change.T**2])


def change_outside(
    row: xr.Dataset, table: xr.Dataset, span: tuple[int, int], names: Sequence[str]
) -> Floats | None:
    """Return by how much parameters may have changed since a row was learnt; None within that span.

    Parameters
    ----------
    row, table : xarray.Dataset
        One interval of a table, and the table. Tables without `learnt_start` are taken to be learnt from all
        of their intervals; a row that nothing taught holds the prior, whose uncertainty it has.
    span : tuple of int
        Half-open TT2000 of the samples; their farthest one counts.
    names : sequence of str
        The parameters.

    Returns
    -------
    ndarray, shape (parameter,), or None
        One sigma.
    """
    if not set(LEARNT) <= set(row.variables):
        return None
    first, last = (int(row[name].values) for name in LEARNT)
    if last <= first or (first <= span[0] and span[1] <= last):
        return None
    middle = first // 2 + last // 2
    return expected_change(table, max(abs(end - middle) for end in span), names)


def outside_learnt(row: xr.Dataset, tt2000: Int64) -> np.ndarray:
    """Return which samples lie outside the span that taught a row; (time,) of bool."""
    if not set(LEARNT) <= set(row.variables):
        return np.zeros(tt2000.shape, dtype=bool)
    first, last = (int(row[name].values) for name in LEARNT)
    return np.asarray((last > first) & ((tt2000 < first) | (tt2000 >= last)))


def held_table(table: xr.Dataset, start: int, end: int) -> xr.Dataset:
    """Return a table that also has rows in TT2000 ``[start, end)`` where it had none.

    A new row has the values of the last learnt row before it, before all of them those of the first, with
    the span which that one was learnt from.

    Raises
    ------
    CalibrationError
        When data taught none of its rows, or it does not tell.
    """
    import xarray as xr

    known = _learnt(table) if set(LEARNT) <= set(table.variables) else np.array([], dtype=np.int64)
    if not known.size:
        raise CalibrationError(
            "the table does not tell what it was learnt from, or nothing taught it",
            remedy="make it anew: 'inflight reprocess' over the days that are to teach it",
        )
    begins, ends = (np.asarray(table[name].values, dtype=np.int64) for name in ("start", "end"))
    parts, at = [], start
    for place in range(len(begins) + 1):
        gap_end = min(int(begins[place]), end) if place < len(begins) else end
        if at < gap_end:
            before = known[known < place]
            row = table.isel(interval=[before[-1] if before.size else known[0]])
            bounds = {"start": at, "end": gap_end}
            parts.append(
                row.assign({name: (("interval",), [one], table[name].attrs) for name, one in bounds.items()})
            )
        if place < len(begins):
            parts.append(table.isel(interval=[place]))
            at = max(at, int(ends[place]))
    return xr.concat(
        parts, "interval", data_vars="minimal", coords="minimal", compat="override", join="exact"
    )
