"""The statistics of a day against a scalar instrument: samples, the nine-parameter fit, normal equations.

`fit_day` reads a day's samples and fits the nine parameters to them with `inflight.calibration.fit_block`
(Olsen et al. 2003, eq. 1); `calibrate_day` makes of it what is stored. Tables of windows and spans are solved
from sums of these normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import finite_rows
from inflight.calibration import (
    BlockFit,
    NormalEquations,
    ParameterPrior,
    empty_block,
    fit_block,
    reference_of,
    remove_other_effects,
    sub_block_count,
    usable_samples,
)
from inflight.errors import CalibrationError
from inflight.flags import UNUSABLE, Flag, count_flags
from inflight.mission_fit import held_products
from inflight.samples import FIELD_ROLES
from inflight.tasks.archive import Need, load_samples
from inflight.tasks.pipelines.base import Batch
from inflight.time import SECOND, day_bounds, other_cadence, usual_step


@dataclass(frozen=True)
class FittedDay:
    """A day's samples and its own fit.

    Attributes
    ----------
    samples : xarray.Dataset
    fit : BlockFit
    reference : Reference
        Parameters that the equations are expressed at.
    attributes : dict
        What the day's equations are stored with: comparison, model, cadence (ns) and filter.
    report : dict
        What was used and what came of it.
    """

    samples: xr.Dataset
    fit: BlockFit
    reference: ParameterPrior
    attributes: dict[str, Any]
    report: dict[str, Any]


def calibrate_day(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's normal equations with its fit, and a report of what was used.

    A day whose fields were measured and whose housekeeping was not has empty equations: it has no information
    on the parameters, and gets its product with those of the days around.

    Returns
    -------
    xarray.Dataset
        As `inflight.calibration.NormalEquations`, and the exact fit of the day: `fit` (block, column),
        `fit_covariance` (block, column, other), whose last column, the residual's, is NaN; `before` and
        `after` (block), nT; `used` (block), a number of samples; `held` (block, number, column), where
        numbers of the model have a sigma: products with one of each (`inflight.mission_fit.held_products`).
    dict
        As `FittedDay.report`.

    Raises
    ------
    CalibrationError
        As `fit_day`.
    """
    fitted = fit_day(batch, day)
    fit = fitted.fit
    equations = NormalEquations.from_fit(fit, fitted.reference, day_bounds(day), fitted.attributes)
    covariance = np.full((1, fit.value.size + 1, fit.value.size + 1), np.nan)
    covariance[0, :-1, :-1] = fit.covariance
    held = held_products(batch.model, fitted.samples, fit.value, fit.count)
    own_fit = {
        "fit": (("block", "column"), np.append(fit.value, np.nan)[None]),
        "fit_covariance": (("block", "column", "other"), covariance),
        "before": (("block",), np.array([fit.before])),
        "after": (("block",), np.array([fit.after])),
        "used": (("block",), np.array([fit.used], dtype=np.int64)),
    }
    if held.size:
        with_residual = np.append(held, np.zeros((len(held), 1)), axis=1)
        own_fit["held"] = (("block", "number", "column"), with_residual[None])
    return equations.dataset.assign(own_fit), fitted.report


def fit_day(batch: Batch, day: np.datetime64) -> FittedDay:
    """Read a day's samples and fit the nine parameters to them; nothing is fitted where only channels lack.

    The fit is expressed at the batch's reference, the model's own values without one.

    Raises
    ------
    CalibrationError
        When too few samples are usable, fewer than the settings' `min_coverage`, or the fit does not settle.
    """
    mission, model, job = batch.mission, batch.model, batch.job
    samples = load_samples(batch.cat, mission, model, day, list(job.needs), job.index, geometry=False)
    start, end = day_bounds(day)
    reference = prior = reference_of(model, (start + end) // 2)
    if batch.reference is not None:
        reference = ParameterPrior(np.asarray(batch.reference, dtype=np.float64), prior.sigma, prior.name)
    parts = remove_other_effects(model, samples)
    vector = mission.comparisons[model.comparison].instruments()["vector"]
    step = usual_step(np.asarray(samples["tt2000"].values), mission.instruments[vector].cadence)

    def coverage(rows: npt.NDArray[np.bool_]) -> float:
        return float(rows.sum() * step / (end - start))

    def is_enough(rows: npt.NDArray[np.bool_]) -> bool:
        return bool(rows.sum() > prior.value.size and coverage(rows) >= batch.settings.min_coverage)

    good = usable_samples(samples, *parts)
    # Samples with both fields, whatever other channels are missing.
    flag = samples["flag"].values & np.uint32(UNUSABLE & ~Flag.CHANNEL_MISSING)
    fields = [np.asarray(samples[role].values, dtype=np.float64) for role in ("vector", "scalar")]
    measured = (flag == 0) & finite_rows(fields[0]) & (fields[1] > 0)
    # A day in another range tells nothing of this one, and nothing is wrong with it.
    measured |= (samples["flag"].values & np.uint32(Flag.OTHER_RANGE) > 0) & (fields[1] > 0)
    if is_enough(good):
        fit = fit_block(*parts, good, reference, prior, sub_block_count(good.sum() * step / SECOND))
        residual = {"before_nT": fit.before, "after_nT": fit.after}
    elif is_enough(measured):
        fit, residual = empty_block(reference, prior), {}
    else:
        raise _too_few_samples(batch, day, samples, good, coverage(good))
    report = {
        "coverage": coverage(good) if fit.used else 0.0,
        "used": fit.used,
        "passes": fit.passes,
        **residual,
        "reference": reference.value.tolist(),
        "shared": batch.reference is not None,
        "strength_nT": float(np.nanmedian(parts[2][good] if fit.used else samples["scalar"].values)),
        "seconds": samples.sizes["time"] * step / SECOND,
    }
    attributes = {"comparison": model.comparison, "model": model.sha, "cadence_ns": step, "filter": "raw"}
    return FittedDay(samples, fit, reference, attributes, report)


def _too_few_samples(
    batch: Batch, day: np.datetime64, samples: xr.Dataset, good: npt.NDArray[np.bool_], coverage: float
) -> CalibrationError:
    """Return the error of a day with too few usable samples; it names the field with the fewest readings."""

    def readings(need: Need) -> int:
        values = samples[need.name].values.reshape(samples.sizes["time"], -1)
        return int((np.isfinite(values).all(axis=1) & values.any(axis=1)).sum())

    poorest = min((need for need in batch.job.needs if need.name in FIELD_ROLES), key=readings)
    source = batch.job.index.get(poorest, day)
    message = f"{coverage:.1%} of the day is usable, at least {batch.settings.min_coverage:.1%} is needed"
    remedy = "lower 'min_coverage' or exclude the day"
    if good.sum() <= 9:
        flags = count_flags(samples["flag"].values) or "a channel the model needs is missing"
        message = f"{int(good.sum())} of {good.size} samples are usable, nine parameters need more; {flags}"
        remedy = "look at the day's deliveries, or exclude the day"
        vector = batch.mission.comparisons[batch.model.comparison].instruments()["vector"]
        cadence = batch.mission.instruments[vector].cadence
        if apart := other_cadence(np.asarray(samples["tt2000"].values), cadence):
            remedy = f"{vector}'s {apart}; or exclude the day"
    return CalibrationError(
        message,
        remedy=remedy,
        file=", ".join(source.report.get("files", ()) if source is not None else ()),
        channel=f"{poorest.instrument}.{poorest.channel}",
        day=str(day),
    )
