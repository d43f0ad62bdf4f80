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
    Tones,
    error_by_tones,
    field_uncertainty,
    make_spin_product,
    tones_of_turns,
)
from inflight.tasks.archive import SPIN_FAULTS, day_faults, load_samples, within_day
from inflight.tasks.pipelines.base import ProductBatch, rounded
from inflight.tasks.pipelines.spin.day import attitude_of, plain_readings, require_spinning
from inflight.tasks.pipelines.spin.orbit import eclipses_of
from inflight.time import SECOND, day_bounds, to_utc

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
    tones = _tones(bound, batch.preflight, samples, span)
    told = day_faults(samples, job.needs, job.index, day)
    if tones is not None:
        before, left, interval_ns = tones
        vector = next(need for need in job.needs if need.name == "vector")
        channel = f"{vector.instrument}.{vector.channel}"
        report |= {"before_nT": before.rms, "after_nT": left.rms, "floor_nT": left.floor}
        report["weight"] = float(left.weight.sum())
        told += _add_error_by_tones(product, left, interval_ns, span, channel)
    report["phase"] = str(samples["spin_phase"].attrs["told"])
    report[SPIN_FAULTS] = told
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


def _tones(
    bound: Model, raw: Model, samples: xr.Dataset, span: tuple[int, int]
) -> tuple[Tones, Tones, int] | None:
    """Return the spin tones of synthetic turns before and after calibration, and an interval's length, ns.

    As `inflight compare` measures them; None where nothing can be folded.
    """
    assert bound.layout is not None
    if bound.layout.folding is None:
        return None
    try:
        folded = fold_spins(samples, bound.layout.folding, span)
    except InflightError:
        return None
    before, after = rows_of(raw, folded), rows_of(bound, folded)
    weight = np.where(after.good, folded["weight"].values, 0.0)
    noise, sectors = np.asarray(folded["noise"].values), bound.layout.folding.sectors
    known, left = (tones_of_turns(one.residual, weight, noise, sectors) for one in (before, after))
    return known, left, bound.layout.folding.interval_ns


def _add_error_by_tones(
    product: xr.Dataset, left: Tones, interval_ns: int, span: tuple[int, int], channel: str
) -> list[dict[str, str]]:
    """Add to a product's uncertainty what still goes with the spin; return what is to be told of it.

    One value holds for a day and more: what changes within, or what the majority of the sub-intervals
    outvoted, is in no error of the parameters.
    """
    found = error_by_tones(left)
    at = np.clip((product["tt2000"].values - span[0]) // interval_ns, 0, len(found) - 1)
    added, stated = found[at], product["uncertainty"].values
    product["uncertainty"] = product["uncertainty"].copy(data=np.hypot(stated, added))
    there = np.isfinite(stated).all(axis=1)
    across, _, along = (np.sqrt(np.sum(added[there] ** 2, axis=0) / max(there.sum(), 1))).tolist()
    own = np.sqrt(np.sum(stated[there] ** 2, axis=0) / max(there.sum(), 1))
    if not (across > own[:2].min() or along > own[2]):
        return []
    hours = float(np.count_nonzero(found.any(axis=1)) * interval_ns / SECOND / 3600.0)
    message = (
        f"for {hours:.1f} h tones at the spin are left that nature does not explain: {across:.3f} nT rms "
        f"across the spin axis, {along:.3f} nT along it, more than the errors of the parameters"
    )
    remedy = (
        "see with 'inflight compare' and 'inflight diagnose' what they follow: an offset or a field of the "
        "spacecraft that changes, or waves at the spin; the uncertainty holds them"
    )
    return [{"channel": channel, "message": message, "remedy": remedy}]
