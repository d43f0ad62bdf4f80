"""From native samples to the library's cadence: bins of good samples, spikes and bursts left out.

Means of bins keep every linear statement: the mean residual is the same function of the mean columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import median_filter

from inflight.arrays import Floats
from inflight.calibration.robust import TO_SIGMA
from inflight.comparison import Rows as NativeRows
from inflight.diagnosis.bursts import bursts, is_signal, told_of
from inflight.diagnosis.columns import Rows
from inflight.geometry import direction_of
from inflight.time import GAP, SECOND, Int64

#: A sample is a spike when it is this many sigma from the median of its neighbours, sigma being that of the
#: record or of the samples around, whichever is larger.
_SPIKE, _NEIGHBOURS, _AROUND = 7.0, 9, 61
#: A bin needs this part of the usual number of good samples.
_LEAST = 0.3
#: Gaps of a channel up to so many bins are bridged by a straight line.
_BRIDGE = 10


def grid(first: int, last: int, cadence_ns: int) -> Int64:
    """Return the edges of the bins that cover the half-open span from `first` to `last`; TT2000."""
    count = max(1, -(-(last - first) // cadence_ns))
    return first + cadence_ns * np.arange(count + 1, dtype=np.int64)


def bin_means(
    values: Floats, stamps: Int64, edges: Int64, good: npt.NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return means (bin, ...) and counts (bin,) of the good samples in each bin; NaN where there is none."""
    # Stamps rise, so that a bin is a run of samples: sums of runs cost one look at the values.
    starts = np.searchsorted(stamps, edges)
    inside = slice(int(starts[0]), int(starts[-1]))
    used = good[inside]
    count, flat = used.astype(np.float64), values[inside].reshape(used.size, -1)
    if not used.all():
        flat = np.where(used[:, None], flat, 0.0)
    total = _sums_of_runs(flat, starts - starts[0])
    number = _sums_of_runs(count[:, None], starts - starts[0])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / number
    return mean.reshape(edges.size - 1, *values.shape[1:]), number[:, 0]


def _sums_of_runs(values: Floats, starts: Int64) -> Floats:
    """Return the sums of rows (time, column) from each start to the next; (run, column), 0 for none."""
    out = np.zeros((starts.size - 1, values.shape[1]))
    filled = np.flatnonzero(np.diff(starts))
    if filled.size:
        out[filled] = np.add.reduceat(values, starts[filled], axis=0)
    return out


def spikes(residual: Floats) -> npt.NDArray[np.bool_]:
    """Return which samples stand out from their neighbours; (time,) of a residual (time, row).

    The measure is local, so that no effect, however large, is taken for an outlier, nor a lively hour
    for a series of them.
    """
    if len(residual) < _NEIGHBOURS:
        return np.zeros(len(residual), dtype=bool)
    filled = np.where(np.isfinite(residual), residual, 0.0)
    known = np.asarray(np.isfinite(residual).all(axis=1))
    return np.asarray(np.any([_stands_out(row, known) for row in filled.T], axis=0))


def _stands_out(row: Floats, known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which samples of one row (time,) stand out from their neighbours.

    On a slope every sample is the median of its neighbours: what is noise there, second differences tell.
    """
    off = np.abs(row - median_filter(row, size=_NEIGHBOURS, mode="nearest"))
    bend = np.zeros(row.size)
    bend[1:-1] = np.abs(row[1:-1] - 0.5 * (row[:-2] + row[2:])) * np.sqrt(2.0 / 3.0)
    sigma = np.full(row.size, 1e-6)
    for size in (off, bend):
        usual = np.median(size[known]) if known.any() else 1.0
        around = median_filter(size, size=min(_AROUND, row.size), mode="nearest")
        sigma = np.maximum(sigma, TO_SIGMA * np.maximum(usual, around))
    return np.asarray(off > _SPIKE * sigma)


def channel_on(values: Floats, stamps: Int64, edges: Int64, cadence_ns: int) -> Floats:
    """Put a channel on the bins: means where it is faster, straight lines where it is slower; (bin, ...)."""
    width = int(edges[1] - edges[0])
    flat = np.asarray(values, dtype=np.float64)
    good = np.asarray(np.isfinite(flat.reshape(len(flat), -1)).all(axis=1))
    if not good.any():
        return np.full((edges.size - 1, *flat.shape[1:]), np.nan)
    if cadence_ns <= width:
        return bridged(bin_means(flat, stamps, edges, good)[0])
    centre = edges[:-1] + width // 2
    own, told = stamps[good], flat[good].reshape(int(good.sum()), -1)
    after = np.clip(np.searchsorted(own, centre), 1, max(own.size - 1, 1))
    near = np.minimum(np.abs(centre - own[after - 1]), np.abs(own[np.minimum(after, own.size - 1)] - centre))
    out = np.stack([np.interp(centre, own, column) for column in told.T], axis=-1)
    out[near > GAP * cadence_ns] = np.nan
    return out.reshape(edges.size - 1, *flat.shape[1:])


def bridged(values: Floats) -> Floats:
    """Return the series with its short gaps bridged by straight lines; (bin, ...)."""
    flat = values.reshape(len(values), -1).copy()
    known = np.isfinite(flat).all(axis=1)
    if known.all() or not known.any():
        return values
    place, own = np.arange(len(flat)), np.flatnonzero(known)
    after = np.clip(np.searchsorted(own, place), 0, own.size - 1)
    before = np.clip(after - 1, 0, None)
    short = ~known & (own[after] > place) & (own[before] < place) & (own[after] - own[before] <= _BRIDGE + 1)
    for column in flat.T:
        column[short] = np.interp(place[short], own, column[own])
    return flat.reshape(values.shape)


def coarsen(
    samples: xr.Dataset,
    rows: NativeRows,
    edges: Int64,
    channels: Mapping[str, xr.Variable],
    turn: Mapping[str, Floats],
    recorded: Mapping[str, Floats] | None = None,
    keep_bursts: bool = False,
) -> tuple[Rows, dict[str, Any]]:
    """Put a day's rows on the library's bins.

    Parameters
    ----------
    samples : xarray.Dataset
        Native samples the rows were made from.
    rows : inflight.comparison.Rows
    edges : ndarray of int64
        Of the bins.
    channels : mapping of str to Variable
        Channels and geometry that stand on the bins already.
    turn : mapping
        See `inflight.diagnosis.columns.Rows`.
    recorded : mapping of str to ndarray, optional
        Every channel of the mission as it was recorded, on the bins: what goes with one is no outlier.
    keep_bursts : bool
        Count bursts and leave them in.

    Returns
    -------
    Rows, dict
        The rows, and sums over the native samples: ``count``, ``square`` of the residual, ``inside``,
        the scatter within bins, of one row, nT^2, ``spikes``; and of `inflight.diagnosis.bursts.told_of`.
    """
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    usable = rows.good & np.isfinite(rows.residual).all(axis=1)
    single, burst, told = _outliers(rows, usable, stamps, edges, recorded or {})
    out = single if keep_bursts else single | burst
    good = usable & ~out
    residual, count = bin_means(rows.residual, stamps, edges, good)
    usual = max(1.0, round((edges[1] - edges[0]) / SECOND / rows.step_s))
    weight = np.where(count >= _LEAST * usual, np.minimum(count / usual, 1.0), 0.0)
    if "weight" in samples:
        of_samples = np.asarray(samples["weight"].values, dtype=np.float64)
        weight = np.where(weight > 0, weight * bin_means(of_samples, stamps, edges, good)[0], 0.0)
    seen = weight > 0
    directions = {
        name: bin_means(np.asarray(one), stamps, edges, good)[0] for name, one in rows.directions.items()
    }
    residual = np.where(seen[:, None], residual, 0.0)
    square = float(np.sum(rows.residual[good] ** 2))
    inside = square - float(
        np.sum(count[:, None] * np.where(count[:, None] > 0, np.nan_to_num(residual), 0.0) ** 2)
    )
    sums = {
        "count": float(good.sum()),
        "square": square,
        # A row's own, as all other sizes are.
        "inside": max(inside, 0.0) / rows.residual.shape[1],
        "spikes": float((usable & single).sum()),
    } | told
    binned = _binned(samples, rows, edges, channels, good)
    return Rows(binned, residual, directions, turn, weight, rows.kept), sums


def _binned(
    samples: xr.Dataset,
    rows: NativeRows,
    edges: Int64,
    channels: Mapping[str, xr.Variable],
    good: npt.NDArray[np.bool_],
) -> xr.Dataset:
    """Return readings and field on the bins, beside the channels that stand there already."""
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    data: dict[str, xr.Variable] = dict(channels)
    data["tt2000"] = xr.Variable("time", edges[:-1] + (edges[1] - edges[0]) // 2)
    for role in ("vector", "scalar", "inboard", "outboard"):
        if role in samples:
            data[role] = xr.Variable(
                samples[role].dims, bin_means(samples[role].values, stamps, edges, good)[0]
            )
    field, _ = bin_means(rows.field, stamps, edges, good)
    data["field"] = xr.Variable(("time", "axis"), field, {"units": "nT"})
    data["field_direction"] = xr.Variable(("time", "axis"), direction_of(field), {"units": "1"})
    return xr.Dataset(data)


def _outliers(
    rows: NativeRows,
    usable: npt.NDArray[np.bool_],
    stamps: Int64,
    edges: Int64,
    recorded: Mapping[str, Floats],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
    """Return which samples are spikes and which in bursts; (time,), no sample in both, and words on these."""
    none = np.zeros(len(stamps), dtype=bool)
    if rows.kept is not None:
        # What went through a filter has no wild samples left.
        return none, none, told_of([], stamps, none)
    single = spikes(np.where(usable[:, None], rows.residual, np.nan))
    every = bursts(rows.residual, stamps, usable & ~single)
    wild = [one for one in every if not is_signal(one, every, rows, stamps, recorded, edges)]
    burst = none.copy()
    for one in wild:
        burst[one.first : one.last] = True
    return single & ~burst, burst, told_of(wild, stamps, usable)
