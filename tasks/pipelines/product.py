"""Level-2 products of one batch of days, with the calibration table that holds."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import xarray as xr

from inflight.calibration import day_parameters, level2, reference_of
from inflight.catalog import Catalog
from inflight.errors import CalibrationError
from inflight.flags import UNUSABLE, Flag
from inflight.frames import direction_of
from inflight.mission import Mission
from inflight.mission_fit import day_statistics
from inflight.model import Model
from inflight.residual import size_of
from inflight.tasks.archive import load_samples, stand_ins, treated_report
from inflight.tasks.pipelines.job import Job, Outcome, make_days
from inflight.tasks.pipelines.spin import spin_product
from inflight.time import day_bounds, usual_step

#: Bumped by hand when the numbers of the products change.
PRODUCT_VERSION = 4

#: Flags of samples that are as good as the rest for the eye that asks what is there.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS

#: Stored steps of product variables: a tenth of a picotesla, a micro-degree.
_RESOLUTION: dict[str, float] = {"nT": 1e-4, "deg": 1e-6}


def produce_batch(
    cat: Catalog,
    mission: Mission,
    model: Model,
    table: xr.Dataset,
    job: Job,
    raw: Model | None = None,
    distribute: bool | None = None,
) -> Outcome:
    """Make the products of a batch of days and write them as one segment.

    Parameters
    ----------
    cat : Catalog
        Only its workspace is used.
    model : Model
        What is corrected, in order.
    table : xarray.Dataset
        The calibration table whose values the model takes.
    raw : Model, optional
        What the residual before calibration is made with; the model itself when absent.
    distribute : bool, optional
        See `inflight.calibration.product.level2`; days then tell the spread of their residual, too.

    Returns
    -------
    Outcome
        The segment, and why days are not in it.
    """
    before = raw or model
    return make_days(
        cat, job, lambda day: produce_day(cat, mission, model, table, day, job, before, distribute)
    )


def produce_day(
    cat: Catalog,
    mission: Mission,
    model: Model,
    table: xr.Dataset,
    day: np.datetime64,
    job: Job,
    raw: Model,
    distribute: bool | None = None,
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product and a report: coverage, residual before and after, what stands in for what."""
    if model.layout is not None and model.layout.kind == "spin":
        product, told = spin_product(cat, mission, model, table, day, job, raw)
        return rounded(product), told
    samples = load_samples(cat, mission, model, day, list(job.needs), job.index, geometry=False)
    start, end = day_bounds(day)
    middle = (start + end) // 2
    parameters = day_parameters(table, middle, reference_of(model, middle))
    bound, widening = model.bind(table), None
    treated: dict[str, Any] = {}
    stand = stand_ins(cat, mission, model, job.needs, job.index, day, samples)
    if stand is not None:
        widening, scalar = stand.variance(bound)
        treated = treated_report(stand.treated(model), float(np.sqrt(scalar[stand.lost].mean())))
        samples, bound, raw = stand.samples, stand.model(bound), stand.model(raw)
    product = rounded(level2(bound, samples, parameters, raw, widening, distribute))
    good = product["flag"].values & ~np.uint32(_HARMLESS) == 0
    step = usual_step(np.asarray(product["tt2000"].values), end - start)
    # The numbers as stored, of the samples that `inflight.tasks.analysis.comparing` takes: both tell one
    # residual.
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
    product.attrs |= {"mission": mission.mission, "acknowledgement": mission.acknowledgement, "day": str(day)}
    return product, report


def spread_of(product: xr.Dataset, good: np.ndarray, span: tuple[int, int]) -> dict[str, Any]:
    """Return what a day's residual tells of an offset along z, as plain numbers; empty for too little."""
    direction = direction_of(product["field_sensor"].values)
    try:
        found = day_statistics(product["residual"].values, direction, *span, good=good)
    except CalibrationError:
        return {}
    return {str(name): found[name].values[0].tolist() for name in found.data_vars}


def rounded(product: xr.Dataset) -> xr.Dataset:
    """Round each variable to its stored step and say so, so that a store holds what a user reads."""
    rounded = {}
    for name, variable in product.data_vars.items():
        step = _RESOLUTION.get(str(variable.attrs.get("units", "")))
        if step is not None and variable.dtype.kind == "f":
            values = np.rint(variable.values / step)
            values /= round(1.0 / step)
            rounded[name] = (variable.dims, values, {**variable.attrs, "resolution": step})
    return product.assign(rounded)


def table_row_hash(table: xr.Dataset, tt2000: int) -> str:
    """Return the hash of what a table says of an instant; a product changes only when this does."""
    inside = np.flatnonzero((table["start"].values <= tt2000) & (tt2000 < table["end"].values))
    if inside.size == 0:
        return ""
    row = table.isel(interval=int(inside[-1]))
    digest = hashlib.sha256()
    for name in ("value", "covariance", "determined", "after"):
        if name not in row:
            continue
        digest.update(np.ascontiguousarray(row[name].values).tobytes())
    return digest.hexdigest()
