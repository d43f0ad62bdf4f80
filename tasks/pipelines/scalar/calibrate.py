"""The statistics of a day against a scalar instrument: samples, the nine-parameter fit, normal equations.

The fit is `inflight.calibration.fit_block` (nine parameters: Olsen et al. 2003, eq. 1); its normal equations
are what tables of windows and spans are added up from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    BlockFit,
    NormalEquations,
    Reference,
    empty_block,
    fit_block,
    reference_of,
    remove_other_effects,
    sub_block_count,
    usable_samples,
)
from inflight.errors import CalibrationError
from inflight.flags import UNUSABLE, Flag, count_flags
from inflight.samples import FIELD_ROLES
from inflight.tasks.archive import Need, load_samples
from inflight.tasks.pipelines.base import Batch, Job
from inflight.time import SECOND, day_bounds, usual_step


@dataclass(frozen=True)
class FittedDay:
    """A day's samples and its own fit.

    Attributes
    ----------
    samples : xarray.Dataset
    fit : BlockFit
    at : Reference
        What the equations are expressed at.
    step : int
        Usual spacing of the samples, ns.
    report : dict
        What was used and what came of it.
    """

    samples: xr.Dataset
    fit: BlockFit
    at: Reference
    step: int
    report: dict[str, Any]


def calibrate_day(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's normal equations with its fit, and a report of what was used.

    A day whose fields were measured and whose housekeeping was not leaves empty equations: it tells
    nothing of the parameters, and gets its product with those of the days around.

    Raises
    ------
    CalibrationError
        As `fit_day`.
    """
    done = fit_day(batch, day)
    attributes = {
        "comparison": batch.model.comparison,
        "model": batch.model.sha,
        "cadence_ns": done.step,
        "filter": "raw",
    }
    equations = NormalEquations.from_fit(done.fit, done.at, day_bounds(day), attributes)
    return equations.dataset.assign(fit_variables(done.fit)), done.report


def fit_day(batch: Batch, day: np.datetime64) -> FittedDay:
    """Read a day's samples and fit the nine parameters to them; nothing is fitted where only channels lack.

    The fit is expressed at the batch's reference, the model's own values without one.

    Raises
    ------
    CalibrationError
        When too few samples are usable, fewer than the settings' `min_coverage`, or the fit does not settle.
    """
    begun = _Begun.of(batch, day)
    least = batch.settings.min_coverage
    return begun.without_fit() if begun.lacks_channels(least) else begun.fitted(least)


@dataclass(frozen=True)
class _Begun:
    """A day's samples before the fit, what other effects add removed; `step` in ns."""

    job: Job
    day: np.datetime64
    samples: xr.Dataset
    prior: Reference
    at: Reference
    parts: tuple[Floats, Floats, Floats]
    good: np.ndarray[Any, np.dtype[np.bool_]]
    step: int
    shared: bool

    @classmethod
    def of(cls, batch: Batch, day: np.datetime64) -> _Begun:
        mission, model, job, reference = batch.mission, batch.model, batch.job, batch.reference
        samples = load_samples(batch.cat, mission, model, day, list(job.needs), job.index, geometry=False)
        start, end = day_bounds(day)
        prior = reference_of(model, (start + end) // 2)
        at = (
            prior
            if reference is None
            else Reference(np.asarray(reference, dtype=np.float64), prior.sigma, prior.name)
        )
        parts = remove_other_effects(model, samples)
        cadence = mission.instruments[mission.comparisons[model.comparison].instruments()["vector"]].cadence
        step = usual_step(np.asarray(samples["tt2000"].values), cadence)
        good = usable_samples(samples, *parts)
        return cls(job, day, samples, prior, at, parts, good, step, reference is not None)

    def lacks_channels(self, min_coverage: float) -> bool:
        """Return True when the fields suffice for a fit, and only missing channels forbid it."""
        least = self.prior.value.size
        flag = self.samples["flag"].values & np.uint32(UNUSABLE & ~Flag.CHANNEL_MISSING)
        fields = [np.asarray(self.samples[role].values, dtype=np.float64) for role in ("vector", "scalar")]
        there = (flag == 0) & np.isfinite(fields[0].sum(axis=1)) & (fields[1] > 0)
        enough = there.sum() > least and self._coverage(there) >= min_coverage
        return bool(enough and (self.good.sum() <= least or self._coverage(self.good) < min_coverage))

    def fitted(self, min_coverage: float) -> FittedDay:
        """Fit the day; raises as `fit_day`."""
        coverage, prior = self._coverage(self.good), self.prior
        _require(self.good, coverage, min_coverage, len(prior.value), self.job, self.samples, self.day)
        sub_blocks = sub_block_count(self.good.sum() * self.step / SECOND)
        fit = fit_block(*self.parts, self.good, self.at, prior, sub_blocks)
        return self._told(fit, coverage, {"before_nT": fit.before, "after_nT": fit.after})

    def without_fit(self) -> FittedDay:
        """Return the day as one that tells nothing."""
        return self._told(empty_block(self.at, self.prior), 0.0, {})

    def _told(self, fit: BlockFit, coverage: float, residual: dict[str, float]) -> FittedDay:
        scalar = self.parts[2][self.good] if fit.used else self.samples["scalar"].values
        report = {
            "coverage": coverage,
            "used": fit.used,
            "passes": fit.passes,
            **residual,
            "reference": self.at.value.tolist(),
            "shared": self.shared,
            "strength_nT": float(np.nanmedian(scalar)),
            "seconds": self.samples.sizes["time"] * self.step / SECOND,
        }
        return FittedDay(self.samples, fit, self.at, self.step, report)

    def _coverage(self, rows: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
        start, end = day_bounds(self.day)
        return float(rows.sum() * self.step / (end - start))


def _require(
    good: np.ndarray[Any, np.dtype[np.bool_]],
    coverage: float,
    min_coverage: float,
    parameters: int,
    job: Job,
    samples: xr.Dataset,
    day: np.datetime64,
) -> None:
    """Raise `CalibrationError` when a day has too few usable samples."""
    if good.sum() <= parameters:
        told = count_flags(samples["flag"].values) or "a channel the model needs is missing"
        raise CalibrationError(
            f"{int(good.sum())} of {good.size} samples are usable, nine parameters need more; {told}",
            remedy="look at the day's deliveries, or exclude the day",
            **_poorest(job, samples, day),
        )
    if coverage < min_coverage:
        raise CalibrationError(
            f"{coverage:.1%} of the day is usable, at least {min_coverage:.1%} is needed",
            remedy="lower 'min_coverage' or exclude the day",
            **_poorest(job, samples, day),
        )


def _poorest(job: Job, samples: xr.Dataset, day: np.datetime64) -> dict[str, str]:
    """Return channel and files of the field that has the fewest readings of a day, as an error names them."""
    fields = [need for need in job.needs if need.name in FIELD_ROLES]
    count = samples.sizes["time"]

    def readings(need: Need) -> int:
        values = samples[need.name].values.reshape(count, -1)
        return int((np.isfinite(values).all(axis=1) & values.any(axis=1)).sum())

    poorest = min(fields, key=readings)
    source = job.index.get(poorest, day)
    files = source.report.get("files", ()) if source is not None else ()
    return {
        "file": ", ".join(files),
        "channel": f"{poorest.instrument}.{poorest.channel}",
        "day": str(day),
    }


def fit_variables(fit: BlockFit) -> dict[str, tuple[tuple[str, ...], np.ndarray[Any, Any]]]:
    """Return the exact fit of the block beside its equations; the residual's column is empty."""
    width = fit.value.size + 1
    covariance = np.full((1, width, width), np.nan)
    covariance[0, :-1, :-1] = fit.covariance
    return {
        "fit": (("block", "column"), np.append(fit.value, np.nan)[None]),
        "fit_covariance": (("block", "column", "other"), covariance),
        "before": (("block",), np.array([fit.before])),
        "after": (("block",), np.array([fit.after])),
        "used": (("block",), np.array([fit.used], dtype=np.int64)),
    }
