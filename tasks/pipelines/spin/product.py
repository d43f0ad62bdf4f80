"""The level-2 product of a day of a spinning sensor: the despun field, made with the table that holds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from inflight.calibration import change_outside, outside_learnt
from inflight.errors import InflightError, ModelError
from inflight.flags import Flag
from inflight.model import Model, instrument_variance, rows_of
from inflight.samples import fold_spins
from inflight.spin import (
    PARAMETER_NAMES,
    CalibrationParameters,
    field_uncertainty,
    make_spin_product,
    tones_of_turns,
)
from inflight.tasks.archive import SPIN_FAULTS, day_faults, load_samples, within_day
from inflight.tasks.pipelines.base import ProductBatch, rounded
from inflight.tasks.pipelines.spin.day import attitude_of, plain_readings, require_spinning
from inflight.tasks.pipelines.spin.orbit import eclipses_of
from inflight.time import day_bounds, to_utc

#: A matrix for each of the twelve parameters: 1 where it meets itself.
_ONE_EACH = np.eye(12)[:, :, None] * np.eye(12)[:, None, :]
#: Flags of samples that count in the coverage.
_HARMLESS = (
    Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.PHASE_BRIDGED | Flag.EXTRAPOLATED
)


def spin_product(batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product (`inflight.spin.make_spin_product`) and a report.

    The report's residual is the rms of the spin tones of synthetic turns, before and after calibration.
    """
    cat, mission, model, table, job = batch.cat, batch.mission, batch.model, batch.table, batch.job
    samples = load_samples(
        cat,
        mission,
        model,
        day,
        list(job.needs),
        job.index,
        geometry=False,
        folded=False,
        surroundings=True,
    )
    own = within_day(np.asarray(samples["tt2000"].values), day)
    span = day_bounds(day)
    bound = model.bind(table)
    entry = require_spinning(bound)
    stamps = np.asarray(samples["tt2000"].values)
    readings, _, corrected = plain_readings(bound, entry, samples)
    attitude = attitude_of(cat, mission, model.comparison, job.needs, job.index, day, samples)
    free = np.array([entry.parameters[name.partition("[")[0]].free for name in PARAMETER_NAMES])
    uncertainty, flag = np.full_like(readings, np.nan), np.zeros(stamps.size, dtype=np.uint32)
    for part in _intervals_of(table, span):
        inside = slice(*np.searchsorted(stamps, part))
        row = _row_at(table, (part[0] + part[1]) // 2)
        twelve = CalibrationParameters.from_values(row["value"].values)
        covariance = np.asarray(row["covariance"].values)
        sigma = field_uncertainty(readings[inside], twelve, covariance)
        change = change_outside(row, table, part, row["parameter"].values.tolist())
        if change is not None:
            outside = outside_learnt(row, stamps[inside])
            flag[inside] |= (np.uint32(Flag.EXTRAPOLATED) * outside).astype(np.uint32)
            # Of all parameters together: each by itself, added up.
            each = change[:, None, None] ** 2 * _ONE_EACH
            parts = [field_uncertainty(readings[inside], twelve, one) for one in each]
            sigma = np.where(outside[:, None], np.hypot(sigma, np.sum(parts, axis=0)), sigma)
        if not np.all(row["determined"].values[free]):
            flag[inside] |= np.uint32(Flag.PRIOR_PARAMETERS)
        uncertainty[inside] = sigma
    field = np.asarray(corrected["field"].values, dtype=np.float64)
    uncertainty = np.sqrt(uncertainty**2 + instrument_variance(entry.sensor, field, stamps, mounting=False))
    # Nothing was learnt in eclipses.
    eclipses, _ = eclipses_of(cat, mission, model.comparison, job.needs, job.index, day)
    for one in eclipses:
        flag[slice(*np.searchsorted(stamps, [one.start, one.end]))] |= np.uint32(Flag.EXTRAPOLATED)
    product = make_spin_product(bound, corrected, uncertainty, attitude)
    product["flag"] = product["flag"] | flag
    product, samples = product.isel(time=own), samples.isel(time=own)
    good = product["flag"].values & ~np.uint32(_HARMLESS) == 0
    step = int(np.median(np.diff(product["tt2000"].values))) if product.sizes["time"] > 1 else 0
    report: dict[str, Any] = {
        "coverage": float(good.sum() * step / (span[1] - span[0])),
        "samples": int(good.sum()),
    }
    report |= _residual(bound, batch.preflight, samples, span)
    report["phase"] = str(samples["spin_phase"].attrs["told"])
    report[SPIN_FAULTS] = day_faults(samples, job.needs, job.index, day)
    product.attrs |= {"mission": mission.mission, "acknowledgement": mission.acknowledgement, "day": str(day)}
    return rounded(product), report


def _intervals_of(table: xr.Dataset, span: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the parts of a day between the edges of a table's intervals, TT2000."""
    edges = {*table["start"].values.tolist(), *table["end"].values.tolist()}
    inside = sorted(edge for edge in edges if span[0] < edge < span[1])
    return list(pairwise([span[0], *inside, span[1]]))


def _row_at(table: xr.Dataset, tt2000: int) -> xr.Dataset:
    """Return the interval of a table that holds an instant."""
    inside = np.flatnonzero((table["start"].values <= tt2000) & (tt2000 < table["end"].values))
    if not inside.size:
        raise ModelError(
            f"the calibration table holds nothing at {to_utc(tt2000)}",
            remedy="reprocess the span with its table",
        )
    return table.isel(interval=int(inside[-1]))


def _residual(bound: Model, raw: Model, samples: xr.Dataset, span: tuple[int, int]) -> dict[str, float]:
    """Return the weighted rms of the spin tones, before and after calibration, and the noise floor; nT.

    As `inflight compare` measures them; ``weight`` is what the day counts. Empty where nothing can be folded.
    """
    assert bound.layout is not None
    if bound.layout.folding is None:
        return {}
    try:
        folded = fold_spins(samples, bound.layout.folding, span)
    except InflightError:
        return {}
    before, after = rows_of(raw, folded), rows_of(bound, folded)
    weight = np.where(after.good, folded["weight"].values, 0.0)
    noise, sectors = np.asarray(folded["noise"].values), bound.layout.folding.sectors
    known = tones_of_turns(before.residual, weight, noise, sectors)
    left = tones_of_turns(after.residual, weight, noise, sectors)
    out = {"before_nT": known.rms, "after_nT": left.rms, "floor_nT": left.floor}
    return out | {"weight": float(left.weight.sum())}
