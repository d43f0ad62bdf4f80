"""One day of two sensors with the table of states that holds: the product, and what it tells of itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog
from inflight.dual.product import dual_level2, readings_of
from inflight.dual.residual_steps import quiet_steps, quietest_width, rms, steps_across, switchings
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.boom_readings import boom_samples
from inflight.tasks.calibrate import Job, Outcome, make_days
from inflight.tasks.produce import rounded
from inflight.tasks.states_constant import constant_of
from inflight.tasks.states_window import correction_of
from inflight.time import SECOND, day_bounds, usual_step

#: Bumped by hand when the numbers of the products change.
STATES_PRODUCT_VERSION = 2
#: Flags of samples that are as good as the rest for the eye that asks what is there.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.NOT_CORRECTED


def states_batch(cat: Catalog, mission: Mission, model: Model, table: xr.Dataset, job: Job) -> Outcome:
    """Make the products of a batch of days with one table, and write them as one segment."""
    return make_days(cat, job, lambda day: states_day(cat, mission, model, table, day, job))


def states_day(
    cat: Catalog, mission: Mission, model: Model, table: xr.Dataset, day: np.datetime64, job: Job
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product (`inflight.dual.product.dual_level2`) and a report.

    The report's residual is the rms step of the outboard field at the day's switchings, nT a component:
    as measured, corrected, and the floor, that of the corrected field where nothing switches.
    """
    samples = boom_samples(cat, mission, model, day, job.needs, job.index)
    readings, flag = readings_of(model, samples)
    correction = correction_of(table, readings)
    flag[~(correction.known & correction.applied)] |= np.uint32(Flag.NOT_CORRECTED)
    product = dual_level2(readings, correction, flag, model.comparison)
    product = rounded(product)
    product.attrs |= {
        "mission": mission.mission,
        "acknowledgement": mission.acknowledgement,
        "day": str(day),
        "constant": constant_of(table),
    }
    return product, report_of(product, day)


def report_of(product: xr.Dataset, day: np.datetime64) -> dict[str, Any]:
    """Return what a product tells of itself, as plain numbers."""
    stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
    step = usual_step(stamps, SECOND)
    state = np.asarray(product["state"].values, dtype=np.int64)
    at = switchings(state, stamps, step)
    field = np.asarray(product["field_spacecraft"].values)
    width = quietest_width(field, at)
    begin, end = day_bounds(day)
    good = (product["flag"].values & ~np.uint32(_HARMLESS)) == 0
    steps = {
        "before_nT": rms(steps_across(np.asarray(product["outboard"].values), at, width)),
        "after_nT": rms(steps_across(field, at, width)),
        "floor_nT": rms(quiet_steps(field, at, width)),
    }
    return {
        "coverage": float(good.sum() * step / (end - begin)),
        "samples": int(good.sum()),
        "switchings": len(at),
        "states": np.unique(state[state >= 0]).tolist(),
        "unknown_part": float(np.mean(state == -1)),
        "applied": str(product.attrs["applied"]),
        "method": str(product.attrs["method"]),
        "reason": str(product.attrs["reason"]),
        "constant": str(product.attrs["constant"]),
        **{name: value if np.isfinite(value) else None for name, value in steps.items()},
    }
