"""What one day of a turning sensor tells: its eight parameters, where they come from, and quiet averages."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.effects.spinning_sensor import SpinningSensor
from inflight.errors import CalibrationError, ModelError
from inflight.flags import UNUSABLE, Flag
from inflight.mission import Mission
from inflight.model import Model, ModelEffect
from inflight.spin.despin import despin
from inflight.spin.equation import NAMES, SPIN_RELATED, TwelveParameters
from inflight.spin.estimates import estimate_pairs
from inflight.spin.fit import spinning_entry
from inflight.spin.joint import JointEstimate, joint_estimate
from inflight.spin.layout import Exclusion, Layout, SubIntervals, lay_out
from inflight.spin.selection import UNKNOWN, spread_of
from inflight.tasks.calibrate import Job
from inflight.tasks.samples import load_samples
from inflight.time import SECOND, Int64, day_bounds

#: Averages over about so long, whole turns, are what zero levels are found of.
MEAN_S = 30.0
#: Sub-intervals share half; a day has two more than fit evenly, one at each end.
_SPARE = 4
#: A manoeuvre disturbs the spin for so long.
_AFTER_MANOEUVRE = 3600 * SECOND


def spin_day(
    cat: Catalog, mission: Mission, model: Model, day: np.datetime64, job: Job
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's estimates, and a report of what was used.

    Returns
    -------
    xarray.Dataset
        Along ``block`` (one): `value`, `sigma` (block, parameter), `covariance` (block, parameter, other) of
        the eight, jointly, in the units of the model, infinite where the day tells nothing; `estimate`,
        `uncertainty` (block, sub, parameter) of each sub-interval, with `sub_start`, `sub_end`; `mean`
        (block, mean, axis) nT, payload axes, over whole turns, with `mean_time`; `start`, `end` TT2000.

    Raises
    ------
    CalibrationError
        When the day's field does not turn with the phase, or too little of it is usable.
    """
    entry = require_spinning(model)
    samples = load_samples(cat, mission, model, day, list(job.needs), job.index, geometry=False, folded=False)
    start, end = day_bounds(day)
    present, known = ground_of(entry, (start + end) // 2)
    readings, good, _ = plain_readings(model, entry, samples)
    phase, stamps = np.asarray(samples["spin_phase"].values), np.asarray(samples["tt2000"].values)
    layout = lay_out(readings, phase, stamps, good, SubIntervals(), exclusions_of(mission, start, end))
    found = joint_estimate(readings, phase, stamps, layout, present, _free(entry, known))
    period = mission.periods["spin"] / SECOND
    dataset = _dataset(found, layout, (start, end), period)
    means = _means(found.parameters.correct(readings), phase, stamps, good, period, (start, end))
    usable = found.tones.usable
    report = {
        "coverage": float(good.sum() * np.median(np.diff(stamps)) / (end - start)),
        "used": int(usable.sum()),
        "sub_intervals": int(usable.size),
        "told": found.tones.told(),
        "phase": str(samples["spin_phase"].attrs.get("told", "")),
        "excess": found.excess.tolist(),
        "settled": found.settled,
    }
    return dataset.merge(means), report


def require_spinning(model: Model) -> ModelEffect:
    """Return the model's spinning sensor.

    Raises
    ------
    ModelError
        When there is none.
    """
    entry = spinning_entry(model)
    if entry is None:
        raise ModelError(
            f"model '{model.name}' has no effect 'spinning_sensor'", remedy="a spin comparison needs one"
        )
    return entry


def ground_of(entry: ModelEffect, tt2000: int) -> tuple[TwelveParameters, dict[str, float]]:
    """Return what the model knows of the twelve beforehand, and how well."""
    values, sigmas = [], {}
    kinds = SpinningSensor.parameters()
    for name in NAMES:
        key, _, axis = name.partition("[")
        index = (kinds[key].axes or ("",)).index(axis.rstrip("]"))
        told = entry.parameters[key]
        values.append(float(told.at(tt2000)[index]))
        stated = float(told.sigma[index, 0])
        sigmas[name] = stated if np.isfinite(stated) else kinds[key].sigma
    return TwelveParameters.of_values(values), sigmas


def _free(entry: ModelEffect, known: dict[str, float]) -> dict[str, float]:
    """Return what is put in as one more measurement; what the model holds fixed, as a sure one."""
    fixed = {name for name in SPIN_RELATED if not entry.parameters[name.partition("[")[0]].free}
    return {name: UNKNOWN[name] * 1e-9 if name in fixed else known[name] for name in SPIN_RELATED}


def plain_readings(
    model: Model, entry: ModelEffect, samples: xr.Dataset
) -> tuple[Floats, np.ndarray, xr.Dataset]:
    """Return readings as if the sensor's equation were all there is, (time, axis) nT, and which are good.

    The corrected samples they are made from come with them.

    Everything else the model knows is taken out: what stands before the equation, and fields.
    """
    corrected = model.correct(samples)
    field = np.asarray(corrected["field"].values, dtype=np.float64)
    values = entry.values(np.asarray(samples["tt2000"].values, dtype=np.int64))
    readings = entry.effect.disturb(field, corrected, values, entry.sensor)
    bad = np.uint32(UNUSABLE & ~Flag.CHANNEL_MISSING)
    good = ((samples["flag"].values & bad) == 0) & np.isfinite(readings).all(axis=1)
    return readings, good, corrected


def exclusions_of(mission: Mission, start: int, end: int) -> list[Exclusion]:
    """Return the spans of a mission's manoeuvres that touch [start, end), with the hour after each."""
    return [
        Exclusion(event.at, event.at + _AFTER_MANOEUVRE, "manoeuvre")
        for event in mission.events
        if event.kind in ("manoeuvre", "maneuver") and start - _AFTER_MANOEUVRE <= event.at < end
    ]


def _dataset(found: JointEstimate, layout: Layout, span: tuple[int, int], period: float) -> xr.Dataset:
    unknown = np.array([UNKNOWN[name] for name in SPIN_RELATED])
    spread = spread_of(np.where(np.isfinite(found.sigma), found.sigma, unknown))
    each = estimate_pairs(found.tones, spread)
    most = int(86_401.0 / period / (layout.settings.spins / layout.settings.blocks)) + _SPARE
    one, sub = ("block", "parameter"), ("block", "sub", "parameter")
    covariance = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    return xr.Dataset(
        {
            "value": (one, found.value[None]),
            "sigma": (one, found.sigma[None]),
            "covariance": (("block", "parameter", "other"), covariance[None]),
            "estimate": (sub, _padded(each.value, most)[None]),
            "uncertainty": (sub, _padded(each.uncertainty, most)[None]),
            "sub_start": (("block", "sub"), _padded(each.start, most)[None]),
            "sub_end": (("block", "sub"), _padded(each.end, most)[None]),
            "start": ("block", np.array([span[0]], dtype=np.int64), {"scale": "TT2000"}),
            "end": ("block", np.array([span[1]], dtype=np.int64), {"scale": "TT2000"}),
        }
    )


def _padded(values: np.ndarray, most: int) -> np.ndarray:
    """Return rows with empty ones behind them: a store's days are of one size."""
    empty = np.nan if values.dtype.kind == "f" else 0
    out = np.full((most, *values.shape[1:]), empty, dtype=values.dtype)
    out[: min(most, len(values))] = values[:most]
    return out


def _means(
    field: Floats, phase: Floats, stamps: Int64, good: np.ndarray, period: float, span: tuple[int, int]
) -> xr.Dataset:
    """Return means over whole turns in payload axes: (block, mean, axis) nT, and their times."""
    turns = max(1, round(MEAN_S / period))
    most = int(86_401.0 / period / turns) + _SPARE
    known = good & np.isfinite(phase)
    if not known.any():
        raise CalibrationError("no sample of the day has a phase", remedy="look at the day's sun pulses")
    payload = despin(field, phase)
    group = np.floor(np.where(known, phase, 0.0) / (2.0 * np.pi * turns)).astype(np.int64)
    group = np.where(known, group - group[known].min(), most)
    group = np.clip(group, 0, most)
    count = np.bincount(group[known], minlength=most + 1)[:most]
    usual = np.median(count[count > 0])
    whole = count > 0.9 * usual
    sums = np.stack([np.bincount(group[known], part[known], most + 1)[:most] for part in payload.T], axis=1)
    times = np.bincount(group[known], (stamps[known] - span[0]) / SECOND, most + 1)[:most]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(whole[:, None], sums / count[:, None], np.nan)
        middle = np.where(whole, times / count, -1.0)
    at = np.where(whole, span[0] + np.rint(np.nan_to_num(middle) * SECOND), 0).astype(np.int64)
    return xr.Dataset(
        {
            "mean": (("block", "mean_of", "axis"), mean[None], {"units": "nT", "frame": "payload"}),
            "mean_time": (("block", "mean_of"), at[None], {"scale": "TT2000"}),
        }
    )
