"""Pipeline: spin.

Level-2 products of a turning sensor, with the calibration table that holds.

The spin's part of a reprocessing: batches of days, and the tables of all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day, Run
from inflight.errors import CalibrationError, InflightError, ModelError
from inflight.flags import Flag
from inflight.mission import Mission
from inflight.model import Model, ModelEffect, rows_of
from inflight.samples import fold
from inflight.spin import NAMES, CalibrationParameters, make_spin_product
from inflight.tasks.archive import FAULTS, cut_at_flips, day_faults, flips_of, load_samples
from inflight.tasks.pipelines.job import Job, Outcome, make_days
from inflight.tasks.pipelines.planning import ONE_DAY, Plan
from inflight.tasks.pipelines.publication import SolvedTables, TableKeeper
from inflight.tasks.pipelines.spin.day import (
    attitude_of,
    plain_readings,
    require_spinning,
    spin_day,
    together,
)
from inflight.tasks.pipelines.spin.tables import flipper_table, spin_table, zero_level_table
from inflight.tasks.pipelines.tables import month_edges, window_edges
from inflight.time import day_bounds, to_utc

#: Flags of samples that are as good as the rest for the eye that asks what is there.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.PHASE_BRIDGED


def spin_product(
    cat: Catalog, mission: Mission, model: Model, table: xr.Dataset, day: np.datetime64, job: Job, raw: Model
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product of a turning sensor and a report.

    The report's residual is that of the synthetic turns: what still goes with the spin, before and after.
    """
    samples = load_samples(cat, mission, model, day, list(job.needs), job.index, geometry=False, folded=False)
    span = day_bounds(day)
    bound = model.bind(table)
    entry = require_spinning(bound)
    twelve, covariance = _holding(table, (span[0] + span[1]) // 2)
    readings, _, corrected = plain_readings(bound, entry, samples)
    attitude = attitude_of(cat, mission, model.comparison, job.needs, job.index, day, samples)
    product = make_spin_product(bound, corrected, readings, twelve, covariance, attitude)
    if not _settled(table, entry, (span[0] + span[1]) // 2):
        product["flag"] = product["flag"] | np.uint32(Flag.PRIOR_PARAMETERS)
    good = product["flag"].values & ~np.uint32(_HARMLESS) == 0
    step = int(np.median(np.diff(product["tt2000"].values))) if product.sizes["time"] > 1 else 0
    report: dict[str, Any] = {
        "coverage": float(good.sum() * step / (span[1] - span[0])),
        "samples": int(good.sum()),
    }
    report |= _tones(bound, raw, samples, span)
    report["phase"] = str(samples["spin_phase"].attrs["told"])
    report[FAULTS] = day_faults(samples, job.needs, job.index, day)
    product.attrs |= {"mission": mission.mission, "acknowledgement": mission.acknowledgement, "day": str(day)}
    return product, report


def _settled(table: xr.Dataset, entry: ModelEffect, tt2000: int) -> bool:
    """Return True when a table has a measured value of everything that the model leaves free."""
    free = np.array([entry.parameters[name.partition("[")[0]].free for name in NAMES])
    return bool(np.all(_row(table, tt2000)["determined"].values[free]))


def _holding(table: xr.Dataset, tt2000: int) -> tuple[CalibrationParameters, np.ndarray]:
    """Return the twelve that a table has for an instant, and their covariance."""
    row = _row(table, tt2000)
    assert row.sizes["parameter"] == len(NAMES)
    return CalibrationParameters.of_values(row["value"].values), np.asarray(row["covariance"].values)


def _row(table: xr.Dataset, tt2000: int) -> xr.Dataset:
    """Return the interval of a table that holds an instant."""
    inside = np.flatnonzero((table["start"].values <= tt2000) & (tt2000 < table["end"].values))
    if not inside.size:
        raise ModelError(
            f"the calibration table holds nothing at {to_utc(tt2000)}",
            remedy="reprocess the span with its table",
        )
    return table.isel(interval=int(inside[-1]))


def _tones(bound: Model, raw: Model, samples: xr.Dataset, span: tuple[int, int]) -> dict[str, float]:
    """Return the weighted rms of what goes with the spin, before and after calibration, and its floor; nT."""
    assert bound.layout is not None
    if bound.layout.folding is None:
        return {}
    try:
        folded = fold(samples, bound.layout.folding, span)
    except InflightError:
        return {}
    out = {}
    for name, model in (("before_nT", raw), ("after_nT", bound)):
        rows = rows_of(model, folded)
        weight = np.where(rows.good, folded["weight"].values, 0.0)
        square = np.sum(weight[:, None] * np.nan_to_num(rows.residual) ** 2)
        out[name] = float(np.sqrt(square / max(2.0 * weight.sum(), 1e-300)))
    noise = np.nan_to_num(folded["noise"].values)
    out["floor_nT"] = float(np.sqrt(np.sum(weight * noise**2) / max(weight.sum(), 1e-300)))
    return out


def spin_batch(cat: Catalog, mission: Mission, model: Model, job: Job) -> Outcome:
    """Make what each day of a batch tells, and write it as one segment."""
    return make_days(cat, job, lambda day: spin_day(cat, mission, model, day, job), together)


def solve_spin(
    cat: Catalog, made: Plan, run: Run, days: Mapping[np.datetime64, Day], *, mission: Mission
) -> SolvedTables:
    """Make the tables of a spin comparison: zero levels, each day, windows, months, the whole span.

    The offset along the spin axis takes many hours of wind: days and months have that of their calendar
    month, windows and the span those of the windows. No window holds two positions of a flipper.

    Raises
    ------
    CalibrationError
        When no day tells anything.
    """
    if not any(day.report["used"] for day in days.values()):
        earliest = days[min(days)]
        raise CalibrationError(
            f"no day of the span tells anything of the sensor; {earliest.day}: {earliest.report['phase']}; "
            f"{earliest.report['told']}",
            remedy="look at the sun pulses or the angle, the stated spin period and the flags of the field",
        )
    settings, model = made.settings, made.model
    ordered = sorted(days)
    read = [cat.read(days[day]) for day in ordered]
    first, last = ordered[0], ordered[-1]
    windows = cut_at_flips(window_edges(first, last, settings.window_days), mission)
    months = cut_at_flips(month_edges(first, last), mission)
    whole = cut_at_flips([first, last + ONE_DAY], mission)
    keep = TableKeeper(cat, made, run, days)
    by_window = keep.table("zero-level", partial(zero_level_table, read, model, windows))
    by_month = keep.table("zero-level-monthly", partial(zero_level_table, read, model, months))
    makers = {
        "daily": ([*ordered, last + ONE_DAY], by_month),
        "window": (windows, by_window),
        "monthly": (months, by_month),
        "span": (whole, by_window),
    }
    tables = {
        kind: keep.table(kind, partial(spin_table, read, model, bounds, kind, zero))
        for kind, (bounds, zero) in makers.items()
    }
    notes = {}
    if flips_of(mission):
        try:
            keep.table("flipper", partial(flipper_table, read, model, whole, mission))
        except CalibrationError as error:
            notes["flipper"] = error.message
    return SolvedTables(tables[settings.table], keep.ids, keep.certify, model, notes)
