"""Sections of a chain's report on the torquers, and on the offsets that the products' residual tells."""

from __future__ import annotations

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.estimators.secular import WINDOW, CarriedMean, remanent_field
from inflight.estimators.z_offset import OffsetsFromSpread
from inflight.figures.chain import band_level_figure
from inflight.figures.torquers import carried_mean_figures, coefficient_figures
from inflight.figures.z_offset import offsets_figure
from inflight.tasks.chain_results import ChainResults
from inflight.tasks.chain_sections import Part, matrix_table
from inflight.time import Int64, to_utc


def torquers(found: ChainResults) -> Part:
    """The band of the torquers' modulation before and after, the matrix, and the running mean of currents."""
    part = Part("torquers", "Magneto-torquers")
    matrix, equations = found.tables.get("torquer-band"), found.band
    if matrix is None or equations is None:
        part.lack("Matrix from the band at 20 s", found.why("torquer-band"))
    else:
        _matrix(part, matrix, equations)
    daily, mean = found.tables.get("torquer-band-daily"), found.tables.get("torquer-band-mean")
    if daily is None or mean is None:
        part.lack(
            "Matrix of each day", found.why("torquer-band-daily" if daily is None else "torquer-band-mean")
        )
    else:
        part.plots += coefficient_figures(daily, mean)
    running = found.tables.get("torquer-mean")
    if running is None:
        part.lack("Running mean of the currents", found.why("torquer-mean"))
    else:
        _running(part, running)
    return part


def _matrix(part: Part, matrix: xr.Dataset, equations: xr.Dataset) -> None:
    value, sigma = matrix["value"].values, matrix["sigma"].values
    day, before, after = band_levels(equations, value)
    axes = [str(name) for name in matrix["axis"].values]
    size = [float(np.sqrt(np.mean(one**2))) for one in (before, after)]
    part.fields["matrix"] = {
        "value": value,
        "sigma": sigma,
        "for_scalar": -value,
        "unit": "nT/A",
        "at": "difference",
        "band_before_nT": size[0],
        "band_after_nT": size[1],
    }
    part.say(
        "What the torquers' matrices lack, vector less scalar sensor, nT/A, by the band around the "
        "modulation's 20 s alone. When the vector sensor's matrix is right, its negative is added to the "
        f"scalar sensor's. The band holds {size[0]:.3g} nT before and {size[1]:.3g} nT with it."
    )
    columns = [f"coil {one}" for one in matrix["coil"].values]
    part.text.append(matrix_table("field along", axes, columns, value, sigma))
    part.plots.append(band_level_figure(day, before, after))


def band_levels(equations: xr.Dataset, value: Floats) -> tuple[Int64, Floats, Floats]:
    """Return days' starts and the residual's level in the band before and after a matrix; nT a sample.

    Parameters
    ----------
    equations : xarray.Dataset
        Of `band_equations`.
    value : ndarray, shape (3, 3)
        nT/A, axis by coil.
    """
    gram, rows = equations["gram"].values, equations["rows"].values
    step = np.append(-value.reshape(-1), 1.0)
    after = np.einsum("i,tij,j->t", step, gram, step)
    day, which = np.unique(equations["day"].values, return_inverse=True)
    count = np.maximum(np.bincount(which, weights=rows), 1.0)
    sums = [np.bincount(which, weights=one) for one in (gram[:, -1, -1], after)]
    first = np.array([equations["start"].values[which == index].min() for index in range(day.size)])
    before, left = (np.sqrt(np.maximum(one, 0.0) / count) for one in sums)
    return first, before, left


def _running(part: Part, table: xr.Dataset) -> None:
    days = to_utc(table["start"].values).astype("datetime64[D]").astype(np.int64)
    arrays = {name: table[name].values for name in ("value", "sigma", "coverage", "state", "daily")}
    mean = CarriedMean(day=days, window=float(table.attrs.get("window_days", WINDOW)), **arrays)
    last = int(np.argmax(mean.coverage))
    part.fields["running_mean"] = {
        "sentence": mean.sentence,
        "coverage": [float(mean.coverage.min()), float(mean.coverage.max())],
        "best_day_A": mean.value[last],
        "best_day_sigma_A": mean.sigma[last],
    }
    part.say(
        f"{mean.sentence}; the window is covered by {mean.coverage.min():.0%} to {mean.coverage.max():.0%}."
    )
    part.plots += carried_mean_figures(mean, remanent_field(mean))


def offsets(found: ChainResults) -> Part:
    """Daily offsets along z from the spread of the products' residual."""
    part = Part("offsets_from_spread", "Offsets from the spread of the residual")
    table = found.tables.get("z-offset")
    if table is None:
        part.lack("Offsets of each day", found.why("z-offset"))
        return part
    name = str(table["parameter"].values[0])
    columns = {
        key: table[key].values[:, 0] for key in ("value", "sigma", "wrong_sign", "slope", "sigma_slope")
    }
    seen, nan = table["determined"].values[:, 0].astype(bool), np.full(table.sizes["interval"], np.nan)
    told = OffsetsFromSpread(
        nan,
        nan,
        **columns,
        seen=seen,
        start=table["start"].values,
        end=table["end"].values,
        axis=name.rsplit("[", maxsplit=1)[-1].rstrip("]"),
    )
    part.fields = {
        "days": int(seen.size),
        "seen": int(seen.sum()),
        "rms_nT": float(np.sqrt(np.mean(told.value**2))),
        "slope_rms_nT": float(np.sqrt(np.mean(told.slope**2))),
    }
    part.say(
        f"On {seen.sum()} of {seen.size} days the spread of the products' residual is above its noise "
        f"(hollow marks: the others); the offsets it tells are {part.fields['rms_nT']:.3g} nT rms, those of "
        f"the slope {part.fields['slope_rms_nT']:.3g} nT. A spread has no sign: it takes the slope's."
    )
    part.plots.append(offsets_figure(told))
    return part
