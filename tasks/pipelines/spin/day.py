"""A day of a spinning sensor: eight parameters, where spin axis and Sun stand, and averages over turns.

`spin_day` lays out sub-intervals of the day and estimates the eight parameters that the spin determines, in
each and jointly (Plaschke et al. 2019; `inflight.spin`). `attitude_of` gives the direction of the spin axis,
from what the mission states or a channel delivers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from inflight.arrays import Floats, finite_rows
from inflight.catalog import Catalog
from inflight.effects import SpinningSensor
from inflight.errors import CalibrationError, MissionError, ModelError, TooLittleError
from inflight.flags import UNUSABLE, Flag
from inflight.frames import FRAMES, sun_direction_gse, to_gse
from inflight.mission import Mission, SpinAxis, SpinComparison
from inflight.model import Model, ModelEffect
from inflight.samples import Series
from inflight.spin import (
    PARAMETER_NAMES,
    SPIN_RELATED,
    SUM_WIDTH,
    UNCALIBRATED_SIGMA,
    Attitude,
    BlockLayout,
    CalibrationParameters,
    Exclusion,
    PeriodCheck,
    SpinTones,
    SubIntervals,
    calibrate_by_selection,
    calibrate_farrell,
    check_period,
    cut_into_blocks,
    despin,
    estimate_jointly,
    estimate_pairs,
    fit_spins,
    initial_tones,
    measure_tones,
    spinning_sensor_of,
    sums_near_earth,
    uncertainty_of_pairs,
    variability_of_selected,
)
from inflight.tasks.archive import SPIN_AXIS, SPIN_FAULTS, ArchiveIndex, Need, channel_series, load_samples
from inflight.tasks.pipelines.base import Batch, Job
from inflight.tasks.pipelines.spin.orbit import eclipses_of, model_in_payload, perigees_of
from inflight.time import SECOND, Int64, day_bounds
from inflight.units import factor_and_offset


@dataclass(frozen=True, kw_only=True)
class SpinDaySettings:
    """Numbers of a day of a spinning sensor.

    Attributes
    ----------
    mean_s : float
        Zero levels are found of averages over about so long, in whole turns, s. Assumed: long against a turn,
        short against the 15 minutes of an interval of the zero level.
    full_mean : float
        Part of the usual readings that a mean needs at least. Assumed.
    after_manoeuvre_ns : int
        A manoeuvre disturbs the spin for so long, ns. Assumed: one hour.
    joined_ns : int
        Samples that are unusable for one reason are of one span when they are no further apart, ns. Assumed:
        one minute, longer than a turn, because a saturated sensor is so once a turn.
    longest_gap_ns : int
        The spin axis moves slowly: it is interpolated between two directions no further apart than this, or
        than three cadences, ns. Assumed: two hours.
    """

    mean_s: float = 30.0
    full_mean: float = 0.9
    after_manoeuvre_ns: int = 3600 * SECOND
    joined_ns: int = 60 * SECOND
    longest_gap_ns: int = 7200 * SECOND


SPIN_DAY_SETTINGS = SpinDaySettings()

_TT2000 = {"scale": "TT2000"}

_ESTIMATES, _MEANS = ("estimate", "uncertainty"), ("block", "mean_of", "axis")
_SUMS = ("block", "sum", "column", "column_of")

#: A sum of nothing: a store has no variable without a value.
_NO_SUM = np.zeros((1, SUM_WIDTH, SUM_WIDTH))

#: How an empty row reads.
_EMPTY = {
    **dict.fromkeys((*_ESTIMATES, "mean", "value", "sigma", "covariance"), np.nan),
    **dict.fromkeys(("sub_start", "sub_end", "mean_time", "start", "end", "near_earth"), 0),
}


def attitude_of(
    cat: Catalog,
    mission: Mission,
    comparison: str,
    needs: Sequence[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    samples: xr.Dataset,
) -> Attitude | None:
    """Return the directions of spin axis and Sun at samples; None where neither mission nor channel has it.

    Parameters
    ----------
    needs : sequence of Need
        With that of the axis, where a channel delivers it.
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
        axis = _stated_axis(stated, stamps)
    elif need is None:
        return None
    elif (series := channel_series(cat, need, day, index)) is not None:
        axis = _delivered_axis(series, need, mission, stamps)
    # Positions, km, gse, where they are known in a frame that can be turned.
    place: Floats | None = None
    position = samples.get("position")
    if position is not None and position.attrs.get("frame") in FRAMES:
        factor, _ = factor_and_offset(str(position.attrs.get("units", "km")), "km")
        values = np.asarray(position.values, dtype=np.float64) * factor
        place = to_gse(values, stamps, str(position.attrs["frame"]))
    return Attitude(axis, sun_direction_gse(stamps, place))


def _stated_axis(axes: Sequence[SpinAxis], stamps: Int64) -> Floats:
    """Return the axis, gse, as the mission's file has it; NaN before the first one."""
    out = np.full((stamps.size, 3), np.nan)
    by_start = {np.iinfo(np.int64).min if axis.since is None else axis.since: axis for axis in axes}
    for since, axis in sorted(by_start.items()):
        valid = stamps >= since
        direction = np.broadcast_to(_unit(np.array([axis.direction])), (int(valid.sum()), 3))
        out[valid] = to_gse(np.array(direction), stamps[valid], axis.frame)
    return out


def _delivered_axis(series: Series, need: Need, mission: Mission, stamps: Int64) -> Floats:
    """Return the axis, gse, interpolated between the readings of a channel; NaN where they are too rare."""
    channel = mission.instruments[need.instrument].channels[need.channel]
    frame, values = channel.frame or "", np.asarray(series.values, dtype=np.float64)
    if frame not in FRAMES or values.ndim != 2 or values.shape[1] not in (2, 3):
        raise MissionError(
            f"the spin axis has {values.shape[1] if values.ndim == 2 else 1} numbers in the frame {frame!r}",
            remedy=f"give a vector, or right ascension and declination, and a frame of {', '.join(FRAMES)}",
        )
    if values.shape[1] == 2:
        values = values * factor_and_offset(channel.unit, "deg")[0]
    times = series.stamps
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return np.full((stamps.size, 3), np.nan)
    times, axis = times[known], to_gse(_unit(values[known]), times[known], frame)
    between = np.stack([np.interp(stamps, times, component) for component in axis.T], axis=1)
    # The readings on both sides have to be near enough; beyond the first and the last one, that one.
    after = np.searchsorted(times, stamps)
    before, beyond = np.maximum(after - 1, 0), np.minimum(after, times.size - 1)
    inside = (after > 0) & (after < times.size)
    apart = np.where(inside, times[beyond] - times[before], 2 * np.abs(stamps - times[before]))
    near = apart <= max(SPIN_DAY_SETTINGS.longest_gap_ns, 3 * need.cadence_ns)
    return np.where(near[:, None], between, np.nan)


def _unit(directions: Floats) -> Floats:
    """Return unit vectors of vectors, or of right ascensions and declinations in degrees; (time, 3)."""
    if directions.shape[1] == 2:
        right, up = np.deg2rad(directions.T)
        return np.stack([np.cos(up) * np.cos(right), np.cos(up) * np.sin(right), np.sin(up)], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def spin_day(batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's estimates, and a report of what was used.

    Returns
    -------
    xarray.Dataset
        Along ``block`` (one; one a part where perigees cut the day): `value`, `sigma` (block, parameter),
        `covariance` (block, parameter, other) of
        the eight, jointly, in the units of the model, infinite without an estimate; `estimate`,
        `uncertainty` (block, sub, parameter) of each sub-interval, with `sub_start`, `sub_end`: as published,
        with the variability of selected estimates for what is held (sections 5.4, 5.5); `mean`
        (block, mean, axis) nT, payload axes, over whole turns, with `mean_time`; `near_earth`
        (block, sum, column, column_of), sums against a model of the Earth's field
        (`inflight.spin.sums_near_earth`), none where the comparison has no `field_model`; `start`, `end`
        TT2000.

    A day whose phase is not known, or of which too little is usable, has no estimates; its product is made
    with the parameters of the days around.

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
    prior, prior_sigma = ground_of(entry, (start + end) // 2)
    # What the model holds fixed enters as a measurement without error.
    fixed = {name for name in SPIN_RELATED if not entry.parameters[name.partition("[")[0]].free}
    measured = {
        name: UNCALIBRATED_SIGMA[name] * 1e-9 if name in fixed else prior_sigma[name] for name in SPIN_RELATED
    }
    readings, good, _ = plain_readings(model, entry, samples)
    stamps = np.asarray(samples["tt2000"].values)
    comparison = mission.comparisons[model.comparison]
    assert comparison.kind == "spin"
    orbit = (batch.cat, mission, model.comparison, job.needs, job.index, day)
    (eclipses, no_shadow), (cuts, no_perigee) = eclipses_of(*orbit), perigees_of(*orbit)
    near_earth, no_model = _near_earth(orbit, samples)
    excluded = [
        *exclusions_of(mission, start, end),
        *eclipses,
        *unusable_spans(samples["flag"].values, stamps),
    ]
    phase = samples["spin_phase"]
    faults = [one for one in (no_shadow, no_perigee, no_model) if one is not None]
    report: dict[str, Any] = {"phase": str(phase.attrs["told"]), "used": 0, "sub_intervals": 0}
    parts, told = [], []
    for span in pairwise([start, *cuts, end]):
        inside = slice(*np.searchsorted(stamps, span))
        there = None if near_earth is None else near_earth[inside]
        record = SpinRecord(readings[inside], phase.values[inside], stamps[inside], good[inside], there)
        try:
            found = record.estimate(comparison, prior, measured, excluded)
        except TooLittleError as error:
            told.append(error.message)
            faults.append(_fault(job, f"{_TELLS_NOTHING}: {error.message}", error.remedy))
            parts.append(_empty_estimates(prior, prior_sigma, span))
            continue
        report["used"] += int(found.tones.usable.sum())
        report["sub_intervals"] += int(found.tones.usable.size)
        report |= found.report
        told.append(found.tones.summary())
        means = _payload_means(record, found.parameters, phase.attrs["period_s"], span)
        parts.append(estimates_of(found, span).merge(means))
    report["told"] = "; ".join(told)
    report["coverage"] = 0.0
    if report["used"]:
        report["coverage"] = float(good.sum() * np.median(np.diff(stamps)) / (end - start))
        # The last part's values correct the field well enough to see it turn.
        check = _period_of_field(stamps, found.parameters.correct(readings), phase.values, good)
        if check is not None:
            report["period"] = check.summary()
            if not check.agrees:
                remedy = "see the stated spin period and the clock of its marks"
                faults.append(_fault(job, check.summary(), remedy))
    if faults:
        report[SPIN_FAULTS] = faults
    return xr.concat(_pad(parts), dim="block", combine_attrs="override"), report


def _near_earth(
    orbit: tuple[Catalog, Mission, str, Sequence[Need], ArchiveIndex, np.datetime64], samples: xr.Dataset
) -> tuple[Floats | None, dict[str, str] | None]:
    """Return what `model_in_payload` gives at samples; the attitude is asked for where a model is."""
    entry = orbit[1].comparisons[orbit[2]]
    if entry.kind != "spin" or entry.field_model is None:
        return None, None
    return model_in_payload(*orbit, np.asarray(samples["tt2000"].values), attitude_of(*orbit, samples))


#: What is said of a day, or a part of one, without a sub-interval of use.
_TELLS_NOTHING = "the day tells nothing of its sensor and has the table's parameters"


@dataclass(frozen=True)
class SpinRecord:
    """Readings (time, 3) nT, unwrapped phase, stamps and which are good; (time,).

    `model` is a model's field in payload axes, (time, 3) nT, NaN far from the Earth; None where none is
    asked for.
    """

    readings: Floats
    phase: Floats
    stamps: Int64
    good: np.ndarray
    model: Floats | None = None

    def estimate(
        self,
        entry: SpinComparison,
        prior: CalibrationParameters,
        measured: Mapping[str, float],
        excluded: Sequence[Exclusion] = (),
    ) -> SpinEstimate:
        """Return the eight parameters by what the comparison asks for.

        Parameters
        ----------
        prior, measured : CalibrationParameters and mapping of str to float
            What was known before, with its sigma by name: a measurement more.
        excluded : sequence of Exclusion

        Raises
        ------
        TooLittleError
            Without a sub-interval of use.
        CalibrationError
            When the field does not turn with the phase.
        """
        record = self.readings, self.phase, self.stamps
        layout = cut_into_blocks(*record, self.good, SubIntervals(), excluded)
        if entry.estimate == "joint":
            joint = estimate_jointly(*record, layout, prior, measured)
            return SpinEstimate(
                joint.value,
                joint.covariance,
                joint.tones,
                joint.parameters,
                {"excess": joint.excess.tolist(), "settled": joint.settled},
            )
        if entry.estimate == "selection":
            chosen = calibrate_by_selection(*record, layout, prior, measured)
            value, covariance = _with_prior(chosen.value, np.diag(chosen.sigma**2), prior, measured)
            report = {"settled": chosen.settled, "selected": list(chosen.reasons)}
        else:
            value, covariance, told = self._farrell(layout, prior)
            value, covariance = _with_prior(value, covariance, prior, measured)
            report = {"farrell": told}
        parameters = prior.changed(dict(zip(SPIN_RELATED, value.tolist(), strict=True)))
        tones = measure_tones(*record, layout, parameters)
        return SpinEstimate(value, covariance, tones, parameters, report)

    def _farrell(self, layout: BlockLayout, prior: CalibrationParameters) -> tuple[Floats, Floats, str]:
        """Return the eight of slope and intercept, beta and phi, and what was found, in words."""
        # Only what sub-intervals of use hold; also refuses a field that does not turn.
        tones = initial_tones(self.readings, self.phase, self.stamps, layout, prior)
        used = np.zeros(self.stamps.size, dtype=np.bool_)
        for low, high in zip(tones.start[tones.usable], tones.end[tones.usable], strict=True):
            used[slice(*np.searchsorted(self.stamps, [low, high + 1]))] = True
        fits = fit_spins(self.stamps, self.readings, self.phase, good=layout.good & used)
        _, _, _, gains = prior.factors()
        unit = np.diag(gains).copy()
        # Elevations are slopes in nT against nT: they need the gain ratio, which the first round gives.
        for _ in range(2):
            found = calibrate_farrell(
                fits, sensitivity=unit, spin_axis_zero=(prior.offset[2] * float(unit[2]), 0.0)
            )
            value, covariance = found.spin_related(unit)
            unit[:2] = prior.spin_plane_gain * np.array([value[0], 1.0 / value[0]])
        return value, covariance, found.summary()


@dataclass(frozen=True)
class SpinEstimate:
    """Values (8,) and covariance (8, 8) of a record, its tones, its parameters and a report."""

    value: Floats
    covariance: Floats
    tones: SpinTones
    parameters: CalibrationParameters
    report: Mapping[str, Any]


def _with_prior(
    value: Floats, covariance: Floats, prior: CalibrationParameters, measured: Mapping[str, float]
) -> tuple[Floats, Floats]:
    """Return values and covariance with what was known before; infinite variances tell nothing."""
    before = np.array([measured[name] for name in SPIN_RELATED]) ** -2.0
    known = np.isfinite(np.diag(covariance))
    information = np.diag(before)
    right = before * prior.spin_related()
    own = np.linalg.inv(covariance[np.ix_(known, known)])
    information[np.ix_(known, known)] += own
    right[known] += own @ value[known]
    together = np.linalg.inv(information)
    return np.asarray(together @ right), np.asarray(together)


def _fault(job: Job, message: str, remedy: str) -> dict[str, str]:
    """Return a fault of the field's channel, as the report of a day has it."""
    base = next(need for need in job.needs if need.name == "vector")
    return {"channel": f"{base.instrument}.{base.channel}", "message": message, "remedy": remedy}


def _period_of_field(stamps: Int64, field: Floats, phase: Floats, good: np.ndarray) -> PeriodCheck | None:
    """Return the spin's period by field and by phase; None for too few samples.

    Only the longest run of known phase is used: across a gap turns may be miscounted, which harms no fit and
    would look like another period.
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
    """Return the twelve parameters that the model states before flight, and their sigmas by name."""
    values, sigmas = [], {}
    kinds = SpinningSensor.parameters()
    for name in PARAMETER_NAMES:
        key, _, axis = name.partition("[")
        index = (kinds[key].axes or ("",)).index(axis.rstrip("]"))
        parameter = entry.parameters[key]
        values.append(float(parameter.at(tt2000)[index]))
        stated = float(parameter.sigma[index, 0])
        sigmas[name] = stated if np.isfinite(stated) else kinds[key].sigma
    return CalibrationParameters.from_values(values), sigmas


def plain_readings(
    model: Model, entry: ModelEffect, samples: xr.Dataset
) -> tuple[Floats, np.ndarray, xr.Dataset]:
    """Return readings with all of the model removed but the sensor's equation, and which of them are good.

    Returns
    -------
    readings : ndarray, shape (time, axis)
        nT: what the sensor would read of the corrected field, without the model's other effects.
    good : ndarray of bool, shape (time,)
    corrected : Dataset
        The samples corrected by the whole model, which the readings are made from.
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
        Exclusion(event.at, event.at + SPIN_DAY_SETTINGS.after_manoeuvre_ns, "manoeuvre")
        for event in mission.events
        if event.kind in ("manoeuvre", "maneuver")
        and start - SPIN_DAY_SETTINGS.after_manoeuvre_ns <= event.at < end
    ]


def unusable_spans(flag: npt.NDArray[np.uint32], stamps: Int64) -> list[Exclusion]:
    """Return the spans in which the phase jumps, and those in which the sensor is saturated.

    No sub-interval may hold one: the turns on both sides of a jump are not of one phase, and those of a
    saturated sensor lack their tops.
    """
    found = []
    jump = Flag.PHASE_JUMP | Flag.NO_PHASE
    for bits, reason in ((jump, "phase jump"), (Flag.SATURATED, "saturated")):
        at = np.flatnonzero((flag & np.uint32(bits)) == np.uint32(bits))
        apart = np.flatnonzero(np.diff(stamps[at]) > SPIN_DAY_SETTINGS.joined_ns) + 1
        runs = np.split(at, apart) if at.size else []
        found += [Exclusion(int(stamps[run[0]]), int(stamps[run[-1]]) + 1, reason) for run in runs]
    return found


def pad_days(days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """Return days padded with empty parts, sub-intervals and means: all of a store are of one size."""
    return _pad(days, ("block", "sub", "mean_of", "sum"))


def _pad(parts: Sequence[xr.Dataset], dims: Sequence[str] = ("sub", "mean_of", "sum")) -> list[xr.Dataset]:
    most = {name: max(one.sizes[name] for one in parts) for name in dims}
    return [
        one.pad({name: (0, most[name] - one.sizes[name]) for name in most}, constant_values=_EMPTY)
        for one in parts
    ]


def parts_of(days: Iterable[xr.Dataset]) -> list[xr.Dataset]:
    """Return the parts that perigees cut days into, in order of time, each with one block."""
    return [
        day.isel(block=[at])
        for day in days
        for at in np.flatnonzero(day["end"].values > day["start"].values).tolist()
    ]


def _empty_estimates(
    prior: CalibrationParameters, prior_sigma: dict[str, float], span: tuple[int, int]
) -> xr.Dataset:
    """Return a day without estimates: the prior's values and covariance, infinite sigma, no rows."""
    sigma = np.array([prior_sigma[name] for name in SPIN_RELATED])
    numbers, none = sigma.size, np.full((1, 0), 0, dtype=np.int64)
    parts: dict[str, Any] = {
        "value": (("block", "parameter"), prior.spin_related()[None]),
        "sigma": (("block", "parameter"), np.full((1, numbers), np.inf)),
        "covariance": (("block", "parameter", "other"), np.diag(sigma**2)[None]),
    }
    rows: dict[str, Any] = {
        name: (("block", "sub", "parameter"), np.zeros((1, 0, numbers))) for name in _ESTIMATES
    }
    rows |= {name: (("block", "sub"), none, dict(_TT2000)) for name in ("sub_start", "sub_end")}
    rows |= {"mean": (_MEANS, np.zeros((1, 0, 3)), {"units": "nT", "frame": "payload"})}
    rows |= {"near_earth": (_SUMS, _NO_SUM[None])}
    return xr.Dataset(parts | rows | {"mean_time": (_MEANS[:2], none, dict(_TT2000))} | _span_of(span))


def estimates_of(found: SpinEstimate, span: tuple[int, int]) -> xr.Dataset:
    """Return the estimate of a record and those of its sub-intervals; see `spin_day`."""
    variance = np.diag(found.covariance)
    sigma = np.sqrt(np.where(np.isfinite(variance), variance, np.inf))
    unknown = np.array([UNCALIBRATED_SIGMA[name] for name in SPIN_RELATED])
    known = np.where(np.isfinite(sigma), sigma, unknown)
    # Selected by what is known of the parameters held; their scatter is then the uncertainty published.
    each = estimate_pairs(found.tones, uncertainty_of_pairs(known))
    held = np.maximum(variability_of_selected(each, known), known)
    each = estimate_pairs(found.tones, uncertainty_of_pairs(held))
    one, sub = ("block", "parameter"), ("block", "sub", "parameter")
    covariance = np.where(np.isfinite(found.covariance), found.covariance, 0.0)
    return xr.Dataset(
        {
            "value": (one, found.value[None]),
            "sigma": (one, sigma[None]),
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


def _payload_means(
    record: SpinRecord, parameters: CalibrationParameters, period: float, span: tuple[int, int]
) -> xr.Dataset:
    """Return means over whole turns in payload axes, times, and sums against a model of the Earth's field.

    (block, mean, axis) nT, (block, mean) TT2000 and (block, sum, column, other).
    """
    payload = despin(parameters.correct(record.readings), record.phase)
    mean, at = _means_of_turns(record, payload, record.good, period, span)
    sums = _NO_SUM
    if record.model is not None and (near := record.good & finite_rows(record.model)).any():
        # Both fields over the same samples: a turn's field is bent near perigee.
        columns = np.concatenate([payload, record.model], axis=1)
        both, middle = _means_of_turns(record, columns, near, period, span)
        sums = np.concatenate([_NO_SUM, sums_near_earth(both[:, :3], both[:, 3:], middle, parameters)])
    return xr.Dataset(
        {
            "mean": (_MEANS, mean[None], {"units": "nT", "frame": "payload"}),
            "mean_time": (_MEANS[:2], at[None], dict(_TT2000)),
            "near_earth": (_SUMS, sums[None]),
        }
    )


def _means_of_turns(
    record: SpinRecord, columns: Floats, good: np.ndarray, period: float, span: tuple[int, int]
) -> tuple[Floats, Int64]:
    """Return means of columns over whole turns (mean, column), NaN for few samples, and their times."""
    phase, stamps = record.phase, record.stamps
    turns = max(1, round(SPIN_DAY_SETTINGS.mean_s / period))
    known = good & np.isfinite(phase)
    group = np.floor(np.where(known, phase, 0.0) / (2.0 * np.pi * turns)).astype(np.int64)
    group -= group[known].min()
    most = int(group[known].max()) + 1
    count = np.bincount(group[known], minlength=most + 1)[:most]
    usual = np.median(count[count > 0])
    whole = count > SPIN_DAY_SETTINGS.full_mean * usual
    sums = np.stack([np.bincount(group[known], part[known], most + 1)[:most] for part in columns.T], axis=1)
    times = np.bincount(group[known], (stamps[known] - span[0]) / SECOND, most + 1)[:most]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(whole[:, None], sums / count[:, None], np.nan)
        middle = np.where(whole, times / count, -1.0)
    at = np.where(whole, span[0] + np.rint(np.nan_to_num(middle) * SECOND), 0).astype(np.int64)
    return mean, at
