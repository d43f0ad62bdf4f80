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
from inflight.model import Model, TimedValue
from inflight.residual import residual_statistics
from inflight.tasks.archive import load_samples, substitute_missing, substitution_report, within_day
from inflight.tasks.pipelines.base import ProductBatch, rounded
from inflight.time import day_bounds, usual_step

#: Flags that do not lower the coverage.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.EXTRAPOLATED


def level2_day(
    batch: ProductBatch, day: np.datetime64, distribute: bool | None = None
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product and a report.

    Parameters
    ----------
    distribute : bool, optional
        See `inflight.calibration.product.level2`; the report then holds the spread of the residual, too.

    Returns
    -------
    xarray.Dataset
        As `inflight.calibration.product.level2`, rounded to the stored steps.
    dict
        Coverage, rms residual before and after (nT), samples, which effects had typical values in place of
        missing channels, and with `distribute` the ``spread`` that `inflight.mission_fit.day_statistics`
        measured; it is empty where the day has too little for it.
    """
    mission, model, job = batch.mission, batch.model, batch.job
    samples = load_samples(
        batch.cat, mission, model, day, list(job.needs), job.index, geometry=False, surroundings=True
    )
    start, end = day_bounds(day)
    own = within_day(np.asarray(samples["tt2000"].values), day)
    middle = (start + end) // 2
    parameters = day_parameters(batch.table, middle, reference_of(model, middle), (start, end))
    fitted, preflight, extra_variance = model.bind(batch.table), batch.preflight, None
    substituted: dict[str, Any] = {}
    typical = substitute_missing(batch.cat, mission, model, job.needs, job.index, day, samples)
    if typical is not None:
        extra_variance, scalar = typical.variance(fitted)
        if treated := typical.by_effect(model, own):
            sigma = float(np.sqrt(scalar[own][typical.lost[own]].mean()))
            substituted = substitution_report(treated, sigma)
        samples, fitted, preflight = typical.samples, typical.model(fitted), typical.model(preflight)
    product = level2(fitted, samples, parameters, preflight, extra_variance, distribute)
    product = rounded(product.isel(time=own))
    flag, residual = product["flag"].values, product["residual"].values
    good = flag & ~np.uint32(_HARMLESS) == 0
    step = usual_step(np.asarray(product["tt2000"].values), end - start)
    # The numbers as stored, of the samples that `compare_samples` takes: both give one residual.
    measured = (flag & np.uint32(UNUSABLE)) == 0
    after = residual_statistics(residual[measured])
    report = {
        "coverage": float(good.sum() * step / (end - start)),
        "before_nT": residual_statistics(product["residual_preflight"].values[measured]).rms,
        "after_nT": after.rms,
        "samples": after.count,
        **substituted,
    }
    if distribute is not None:
        direction = direction_of(product["field_sensor"].values)
        offset = float(sum(timed.at(middle)[2] for timed in z_offsets_of(fitted)))
        try:
            # What was taken off before is put back: the table of offsets must not depend on itself.
            uncorrected = residual + offset * direction[:, 2]
            spread = day_statistics(uncorrected, direction, start, end, good=measured)
            report["spread"] = {str(name): spread[name].values[0].tolist() for name in spread.data_vars}
            report["z_offset_nT"] = offset
        except CalibrationError:
            report["spread"] = {}
    held = [
        f"{timed.key}: table {timed.table_name} has no value, the nearest one is held"
        for entry in fitted.effects
        for timed in entry.tables.values()
        if timed.is_held_at(middle)
    ]
    if held:
        report["held_tables"] = held
    product.attrs |= {
        "mission": mission.mission,
        "acknowledgement": mission.acknowledgement,
        "day": str(day),
    }
    if fitted.empirical:
        product.attrs["empirical_effects"] = ", ".join(fitted.empirical)
    return product, report


def z_offsets_of(model: Model) -> list[TimedValue]:
    """Return the parameters of a model that take the daily offsets along z of the whole-mission fit."""
    return [
        timed
        for entry in model.effects
        for timed in entry.tables.values()
        if timed.table_name.startswith(f"{model.comparison}-z-offset")
    ]
