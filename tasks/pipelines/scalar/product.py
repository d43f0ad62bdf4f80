"""The level-2 product of one day, with the calibration table that holds."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.calibration import day_parameters, level2, reference_of
from inflight.errors import CalibrationError
from inflight.flags import UNUSABLE, Flag
from inflight.frames import direction_of
from inflight.mission_fit import day_statistics
from inflight.residual import size_of
from inflight.tasks.archive import load_samples, substitute_missing, substitution_report
from inflight.tasks.pipelines.base import ProductBatch, rounded
from inflight.time import day_bounds, usual_step

#: Flags of samples that are as good as the rest for the eye that asks what is there.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS


def level2_day(
    batch: ProductBatch, day: np.datetime64, distribute: bool | None = None
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product and a report: coverage, residual before and after, what stands in for what.

    Parameters
    ----------
    distribute : bool, optional
        See `inflight.calibration.product.level2`; the report then holds the spread of the residual, too.
    """
    model, job = batch.model, batch.job
    samples = load_samples(batch.cat, batch.mission, model, day, list(job.needs), job.index, geometry=False)
    start, end = day_bounds(day)
    middle = (start + end) // 2
    parameters = day_parameters(batch.table, middle, reference_of(model, middle))
    bound, raw, widening = model.bind(batch.table), batch.preflight, None
    treated: dict[str, Any] = {}
    stand = substitute_missing(batch.cat, batch.mission, model, job.needs, job.index, day, samples)
    if stand is not None:
        widening, scalar = stand.variance(bound)
        treated = substitution_report(stand.by_effect(model), float(np.sqrt(scalar[stand.lost].mean())))
        samples, bound, raw = stand.samples, stand.model(bound), stand.model(raw)
    product = rounded(level2(bound, samples, parameters, raw, widening, distribute))
    good = product["flag"].values & ~np.uint32(_HARMLESS) == 0
    step = usual_step(np.asarray(product["tt2000"].values), end - start)
    # The numbers as stored, of the samples that `compare_samples` takes: both give one residual.
    measured = (product["flag"].values & np.uint32(UNUSABLE)) == 0
    after = size_of(product["residual"].values[measured])
    report = {
        "coverage": float(good.sum() * step / (end - start)),
        "before_nT": size_of(product["residual_preflight"].values[measured]).rms,
        "after_nT": after.rms,
        "samples": after.count,
        **treated,
    }
    if distribute is not None:
        report |= {"spread": spread_of(product, measured, (start, end))}
    product.attrs |= {
        "mission": batch.mission.mission,
        "acknowledgement": batch.mission.acknowledgement,
        "day": str(day),
    }
    return product, report


def spread_of(product: xr.Dataset, good: np.ndarray, span: tuple[int, int]) -> dict[str, Any]:
    """Return what a day's residual tells of an offset along z, as plain numbers; empty for too little."""
    direction = direction_of(product["field_sensor"].values)
    try:
        found = day_statistics(product["residual"].values, direction, *span, good=good)
    except CalibrationError:
        return {}
    return {str(name): found[name].values[0].tolist() for name in found.data_vars}
