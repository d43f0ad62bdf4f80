"""A day of a spinning sensor: eight parameters, where spin axis and Sun stand, and quiet averages.

`spin_day` lays out sub-intervals of the day and estimates the eight parameters that the spin determines, in
each and jointly (Plaschke et al. 2019; `inflight.spin`). `attitude_of` gives the direction of the spin axis,
from what the mission states or a channel delivers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.effects import SpinningSensor
from inflight.errors import CalibrationError, MissionError, ModelError, TooLittleError
from inflight.flags import UNUSABLE, Flag
from inflight.frames import FRAMES, sun_direction_gse, to_gse
from inflight.mission import Mission, SpinAxis
from inflight.model import Model, ModelEffect
from inflight.spin import (
    NAMES,
    SPIN_RELATED,
    UNCALIBRATED_SIGMA,
    Attitude,
    BlockLayout,
    CalibrationParameters,
    Exclusion,
    JointEstimate,
    PeriodCheck,
    SubIntervals,
    check_period,
    cut_into_blocks,
    despin,
    estimate_jointly,
    estimate_pairs,
    spinning_sensor_of,
    uncertainty_of_pairs,
)
from inflight.tasks.archive import SPIN_AXIS, SPIN_FAULTS, ArchiveIndex, Need, channel_series, load_samples
from inflight.tasks.pipelines.base import Batch, Job
from inflight.time import SECOND, Int64, day_bounds
from inflight.units import factor_and_offset

#: The axis moves slowly: between two directions no farther apart than this, or than three cadences, it is
#: carried along the straight line.
_LONGEST_GAP = 7200 * SECOND


def attitude_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    samples: xr.Dataset,
) -> Attitude | None:
    """Return where spin axis and Sun stand at samples; None where nothing states or tells the axis.

    Parameters
    ----------
    needs : sequence of Need
        With that of the axis, where a channel tells it.
    samples : xarray.Dataset
        `tt2000` (time); `position` (time, axis) with attributes `units` and `frame`, where it is known.

    Raises
    ------
    MissionError
        When the frame of a channel is none that can be turned.
    """
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    entry = mission.comparisons[comparison]
    stated = entry.spin_axis if entry.kind == "spin" else None
    need = next((one for one in needs if one.name == SPIN_AXIS), None)
    # All days of a store have the same variables: a day without directions has empty ones.
    axis: Floats = np.full((stamps.size, 3), np.nan)
    if isinstance(stated, list):
        axis = _stated(stated, stamps)
    elif need is None:
        return None
    elif (series := channel_series(cat, need, day, index, alone=False)) is not None:
        axis = _delivered(series, need, mission, stamps)
    return Attitude(axis, sun_direction_gse(stamps, _position(samples)))


def _stated(axes: Sequence[SpinAxis], stamps: Int64) -> Floats:
    """Return the axis, gse, as the mission's file has it; NaN before the first one."""
    out = np.full((stamps.size, 3), np.nan)
    for one in sorted(axes, key=_since):
        here = stamps >= _since(one)
        direction = np.broadcast_to(_unit(np.array([one.direction])), (int(here.sum()), 3))
        out[here] = to_gse(np.array(direction), stamps[here], one.frame)
    return out


def _since(axis: SpinAxis) -> int:
    return np.iinfo(np.int64).min if axis.since is None else axis.since


def _delivered(series: xr.DataArray, need: Need, mission: Mission, stamps: Int64) -> Floats:
    """Return the axis, gse, as a channel has it, between its readings; NaN where they are too rare."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    frame, values = channel.frame or "", np.asarray(series.values, dtype=np.float64)
    if frame not in FRAMES or values.ndim != 2 or values.shape[1] not in (2, 3):
        raise MissionError(
            f"the spin axis has {values.shape[1] if values.ndim == 2 else 1} numbers in the frame {frame!r}",
            remedy=f"give a vector, or right ascension and declination, and a frame of {', '.join(FRAMES)}",
        )
    if values.shape[1] == 2:
        values = values * factor_and_offset(channel.unit, "deg")[0]
    times = np.asarray(series["tt2000"].values, dtype=np.int64)
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return np.full((stamps.size, 3), np.nan)
    times, axis = times[known], to_gse(_unit(values[known]), times[known], frame)
    carried = np.stack([np.interp(stamps, times, one) for one in axis.T], axis=1)
    return np.where(_is_near(times, stamps, need.cadence_ns)[:, None], carried, np.nan)


def _is_near(times: Int64, stamps: Int64, cadence: int) -> np.ndarray:
    """Return which stamps lie between readings that are near enough, or beside one."""
    longest = max(_LONGEST_GAP, 3 * cadence)
    after = np.searchsorted(times, stamps)
    before, beyond = np.maximum(after - 1, 0), np.minimum(after, times.size - 1)
    inside = (after > 0) & (after < times.size)
    apart = np.where(inside, times[beyond] - times[before], 2 * np.abs(stamps - times[before]))
    return np.asarray(apart <= longest)


def _unit(directions: Floats) -> Floats:
    """Return unit vectors of vectors, or of right ascensions and declinations in degrees; (time, 3)."""
    if directions.shape[1] == 2:
        right, up = np.deg2rad(directions.T)
        return np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _position(samples: xr.Dataset) -> Floats | None:
    """Return the positions, km, gse; None where they are not known in a frame that can be turned."""
    position = samples.get("position")
    if position is None or position.attrs.get("frame") not in FRAMES:
        return None
    factor, _ = factor_and_offset(str(position.attrs.get("units", "km")), "km")
    stamps = np.asarray(samples["tt2000"].values, dtype=np.int64)
    place = np.asarray(position.values, dtype=np.float64) * factor
    return to_gse(place, stamps, str(position.attrs["frame"]))


#: Averages over about so long, whole turns, are what zero levels are found of.
MEAN_S = 30.0

#: A manoeuvre disturbs the spin for so long.
_AFTER_MANOEUVRE = 3600 * SECOND

#: Samples spoilt in one way are of one span when they are no further apart.
_APART = 60 * SECOND

#: How an empty row reads.
_ESTIMATES, _MEANS = ("estimate", "uncertainty"), ("block", "mean_of", "axis")

_TT2000 = {"scale": "TT2000"}

_EMPTY = {
    **dict.fromkeys((*_ESTIMATES, "mean"), np.nan),
    **dict.fromkeys(("sub_start", "sub_end", "mean_time"), 0),
}


def spin_day(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's estimates, and a report of what was used.

    Returns
    -------
    xarray.Dataset
        Along ``block`` (one): `value`, `sigma` (block, parameter), `covariance` (block, parameter, other) of
        the eight, jointly, in the units of the model, infinite where the day tells nothing; `estimate`,
        `uncertainty` (block, sub, parameter) of each sub-interval, with `sub_start`, `sub_end`; `mean`
        (block, mean, axis) nT, payload axes, over whole turns, with `mean_time`; `start`, `end` TT2000.

    A day whose field was measured, but of which nothing tells the phase, or too little is usable, tells
    nothing: it gets its product with the parameters of the days around.

    Raises
    ------
    CalibrationError
        When the day's field does not turn with the phase: the period or the pulses are wrong.
    """
    mission, model, job = batch.mission, batch.model, batch.job
    entry = require_spinning(model)
    samples = load_samples(
        batch.cat, mission, model, day, list(job.needs), job.index, geometry=False, folded=False
    )
    start, end = day_bounds(day)
    present, known = ground_of(entry, (start + end) // 2)
    readings, good, _ = plain_readings(model, entry, samples)
    phase, stamps = np.asarray(samples["spin_phase"].values), np.asarray(samples["tt2000"].values)
    excluded = [*exclusions_of(mission, start, end), *spoilt_spans(samples["flag"].values, stamps)]
    told = samples["spin_phase"].attrs
    report: dict[str, Any] = {"phase": str(told["told"]), "used": 0, "sub_intervals": 0}
    try:
        layout = cut_into_blocks(readings, phase, stamps, good, SubIntervals(), excluded)
        found = estimate_jointly(readings, phase, stamps, layout, present, _free(entry, known))
    except TooLittleError as error:
        lost = f"the day tells nothing of its sensor and has the table's parameters: {error.message}"
        report |= {"coverage": 0.0, "told": error.message, SPIN_FAULTS: [_fault(job, lost, error.remedy)]}
        return _nothing(present, known, (start, end)), report
    field = found.parameters.correct(readings)
    means = _means(field, phase, stamps, good, told["period_s"], (start, end))
    usable = found.tones.usable
    report |= {
        "coverage": float(good.sum() * np.median(np.diff(stamps)) / (end - start)),
        "used": int(usable.sum()),
        "sub_intervals": int(usable.size),
        "told": found.tones.summary(),
        "excess": found.excess.tolist(),
        "settled": found.settled,
    }
    rate = _rate(stamps, field, phase, good)
    if rate is not None:
        report["period"] = rate.summary()
        if not rate.agrees:
            report[SPIN_FAULTS] = [
                _fault(job, rate.summary(), "see the stated spin period and the clock of its marks")
            ]
    return _dataset(found, layout, (start, end)).merge(means), report


def _fault(job: Job, message: str, remedy: str) -> dict[str, str]:
    """Return what the run says of a day of the field's channel."""
    base = next(need for need in job.needs if need.name == "vector")
    return {"channel": f"{base.instrument}.{base.channel}", "message": message, "remedy": remedy}


def _rate(stamps: Int64, field: Floats, phase: Floats, good: np.ndarray) -> PeriodCheck | None:
    """Return the spin's period by field and phase where the phase is known longest; None for too little.

    Across a gap turns may be miscounted, which harms no fit and would look like another rate.
    """
    known = np.flatnonzero(np.isfinite(phase))
    pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    run = max(pieces, key=len)
    try:
        return check_period(stamps[run], field[run], phase[run], good=good[run])
    except CalibrationError:
        return None


def require_spinning(model: Model) -> ModelEffect:
    """Return the model's spinning sensor.

    Raises
    ------
    ModelError
        When there is none.
    """
    entry = spinning_sensor_of(model)
    if entry is None:
        raise ModelError(
            f"model '{model.name}' has no effect 'spinning_sensor'", remedy="a spin comparison needs one"
        )
    return entry


def ground_of(entry: ModelEffect, tt2000: int) -> tuple[CalibrationParameters, dict[str, float]]:
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
    return CalibrationParameters.from_values(values), sigmas


def _free(entry: ModelEffect, known: dict[str, float]) -> dict[str, float]:
    """Return what is put in as one more measurement; what the model holds fixed, as a sure one."""
    fixed = {name for name in SPIN_RELATED if not entry.parameters[name.partition("[")[0]].free}
    return {name: UNCALIBRATED_SIGMA[name] * 1e-9 if name in fixed else known[name] for name in SPIN_RELATED}


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


def spoilt_spans(flag: npt.NDArray[np.uint32], stamps: Int64) -> list[Exclusion]:
    """Return the spans in which the phase jumps, and those in which the sensor was full.

    No sub-interval may hold one: the turns on both sides of a jump are not of one phase, and those of a full
    sensor lack their tops.
    """
    found = []
    jump = Flag.PHASE_JUMP | Flag.NO_PHASE
    for bits, reason in ((jump, "phase jump"), (Flag.SATURATED, "saturated")):
        at = np.flatnonzero((flag & np.uint32(bits)) == np.uint32(bits))
        # Runs that lie nearer than blocks are long are one span: a full sensor is so once a turn.
        parts = np.split(at, np.flatnonzero(np.diff(stamps[at]) > _APART) + 1) if at.size else []
        found += [Exclusion(int(stamps[one[0]]), int(stamps[one[-1]]) + 1, reason) for one in parts]
    return found


def together(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days with empty rows behind their sub-intervals and means: a store's days are of one size."""
    most = {name: max(day.sizes[name] for day in days) for name in ("sub", "mean_of")}
    return [
        day.pad({name: (0, most[name] - day.sizes[name]) for name in most}, constant_values=_EMPTY)
        for day in days
    ]


def _nothing(present: CalibrationParameters, known: dict[str, float], span: tuple[int, int]) -> xr.Dataset:
    """Return a day that tells nothing: the values known before, with covariances that add nothing."""
    sigma = np.array([known[name] for name in SPIN_RELATED])
    numbers, none = sigma.size, np.full((1, 0), 0, dtype=np.int64)
    parts: dict[str, Any] = {
        "value": (("block", "parameter"), present.spin_related()[None]),
        "sigma": (("block", "parameter"), np.full((1, numbers), np.inf)),
        "covariance": (("block", "parameter", "other"), np.diag(sigma**2)[None]),
    }
    rows: dict[str, Any] = {
        name: (("block", "sub", "parameter"), np.zeros((1, 0, numbers))) for name in _ESTIMATES
    }
    rows |= {name: (("block", "sub"), none, dict(_TT2000)) for name in ("sub_start", "sub_end")}
    rows |= {"mean": (_MEANS, np.zeros((1, 0, 3)), {"units": "nT", "frame": "payload"})}
    return xr.Dataset(parts | rows | {"mean_time": (_MEANS[:2], none, dict(_TT2000))} | _span_of(span))


def _dataset(found: JointEstimate, layout: BlockLayout, span: tuple[int, int]) -> xr.Dataset:
    unknown = np.array([UNCALIBRATED_SIGMA[name] for name in SPIN_RELATED])
    spread = uncertainty_of_pairs(np.where(np.isfinite(found.sigma), found.sigma, unknown))
    each = estimate_pairs(found.tones, spread)
    one, sub = ("block", "parameter"), ("block", "sub", "parameter")
    covariance = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    return xr.Dataset(
        {
            "value": (one, found.value[None]),
            "sigma": (one, found.sigma[None]),
            "covariance": (("block", "parameter", "other"), covariance[None]),
            "estimate": (sub, each.value[None]),
            "uncertainty": (sub, each.uncertainty[None]),
            "sub_start": (("block", "sub"), each.start[None], dict(_TT2000)),
            "sub_end": (("block", "sub"), each.end[None], dict(_TT2000)),
        }
        | _span_of(span)
    )


def _span_of(span: tuple[int, int]) -> dict[str, Any]:
    both = zip(("start", "end"), span, strict=True)
    return {name: ("block", np.array([one], dtype=np.int64), dict(_TT2000)) for name, one in both}


def _means(
    field: Floats, phase: Floats, stamps: Int64, good: np.ndarray, period: float, span: tuple[int, int]
) -> xr.Dataset:
    """Return means over whole turns in payload axes: (block, mean, axis) nT, and their times."""
    turns = max(1, round(MEAN_S / period))
    known = good & np.isfinite(phase)
    payload = despin(field, phase)
    group = np.floor(np.where(known, phase, 0.0) / (2.0 * np.pi * turns)).astype(np.int64)
    group -= group[known].min()
    most = int(group[known].max()) + 1
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
            "mean": (_MEANS, mean[None], {"units": "nT", "frame": "payload"}),
            "mean_time": (_MEANS[:2], at[None], dict(_TT2000)),
        }
    )
