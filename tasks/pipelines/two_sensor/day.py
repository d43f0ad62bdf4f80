"""Steps of the pipeline of two sensors on one boom: readings checked, table of a window, product of a day.

Before anything is fitted, readings that are no measurements are flagged (`two_sensor_samples`): a sensor that
is dead or not plugged in reads one value, and so does an axis that is stuck or saturated. The difference to
the other sensor is then the ambient field itself, and a gradiometer would take that off. `states_window`
makes the table of a window of days and decides on held-out stretches whether its correction helps
(`inflight.dual`); `states_day` corrects a day with the table that holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.dual import (
    FORMS,
    WHOLE,
    AppliedPart,
    Body,
    Candidates,
    Correction,
    HeldOutDecision,
    Readings,
    applied_part_to_dataset,
    choose_correction,
    correction_by_states,
    correction_by_states_and_gradiometer,
    correction_by_stored_gradiometer,
    dual_level2,
    gradiometer_from_dataset,
    gradiometer_to_dataset,
    has_gradiometer,
    no_correction,
    partial_correction,
    quiet_steps,
    quietest_width,
    readings_of,
    rms_of_steps,
    slow_part_of_day,
    steps_across,
    switchings,
    training_from_dataset,
    training_to_dataset,
)
from inflight.errors import InflightError, SamplesError
from inflight.flags import Flag
from inflight.mission import DualComparison, Mission
from inflight.model import Model, instrument_variance
from inflight.tasks.archive import (
    AMBIENT,
    ArchiveIndex,
    Need,
    ambient_of,
    cached_readings,
    load_samples,
    saturation_flags,
    within_day,
)
from inflight.tasks.pipelines.base import Failure, ProductBatch, failure_of, rounded
from inflight.tasks.pipelines.two_sensor.constant import report_before, without_constant
from inflight.tasks.pipelines.two_sensor.tables import (
    constant_part,
    gradiometer_in_states,
    gradiometer_with_states,
    with_remark,
)
from inflight.threads import one_thread
from inflight.time import SECOND, Int64, day_bounds, usual_step
from inflight.units import factor_and_offset


@dataclass(frozen=True, kw_only=True)
class TwoSensorSettings:
    """Numbers of the readings of two sensors before anything is fitted.

    Attributes
    ----------
    still_samples : int
        An axis that reads exactly the same for so many samples is still: noise does not do that. Assumed.
    moves : float
        It is flagged when the other sensor changes by more than so many of the smallest steps that the axis
        takes before and after. Assumed.
    parts : int
        The change of the other sensor is the range of means over so many parts of the time, which averages
        its noise. Assumed.
    seen_outboard : float
        Least part of the inboard sensor's changes that the outboard one sees: units are nearer to the former.
        Assumed.
    nearby_steps : int
        Steps before and after that show how small steps are: a sensor may change its range. Assumed.
    same : float
        Readings nearer than this part of the largest are the same: between two stamps they are computed.
        Derived from the precision of a double.
    largest_reading : float
        No sensor on a boom reads more, nT: a fill value that nobody declared. Assumed.
    most_samples : int
        Samples that a window is fitted to at most; of faster records means are taken. Assumed, for memory.
    """

    still_samples: int = 100
    moves: float = 5.0
    parts: int = 10
    seen_outboard: float = 0.05
    nearby_steps: int = 1000
    same: float = 1e-12
    largest_reading: float = 1e7
    most_samples: int = 3_000_000


TWO_SENSOR_SETTINGS = TwoSensorSettings()

_ROLES = ("inboard", "outboard")


def two_sensor_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: Sequence[Need],
    index: ArchiveIndex,
    surroundings: bool = False,
) -> xr.Dataset:
    """Return a day's samples of both sensors, readings that are no measurements flagged; see `load_samples`.

    Raises
    ------
    SamplesError
        When a sensor's day is not in the archive, or an axis of it reads one and the same value all day.
    """
    samples = load_samples(
        cat, mission, model, day, list(needs), index, geometry=False, surroundings=surroundings
    )
    values = {role: np.asarray(samples[role].values, dtype=np.float64) for role in _ROLES}
    flag = np.asarray(samples["flag"].values, dtype=np.uint32).copy()
    for role in _ROLES:
        with np.errstate(invalid="ignore"):
            wild = np.asarray((np.abs(values[role]) > TWO_SENSOR_SETTINGS.largest_reading).any(axis=1))
        flag[wild] |= np.uint32(Flag.OUT_OF_RANGE)
        values[role] = np.where(wild[:, None], np.nan, values[role])
    turns = {
        role: scipy.spatial.transform.Rotation.from_quat(samples[role].attrs["orientation"])
        for role in _ROLES
    }
    for role, other in (_ROLES, _ROLES[::-1]):
        need = next(need for need in needs if need.name == role)
        flag |= saturation_flags(values[role], mission.instruments[need.instrument].channels[need.channel])
        # In the axes of the sensor: it is one of these that sticks.
        seen = turns[role].inv().apply(turns[other].apply(values[other]))
        still = still_axes(
            values[role], seen * (TWO_SENSOR_SETTINGS.seen_outboard if role == "outboard" else 1.0)
        )
        read = np.isfinite(values[role]).all(axis=1)
        stuck = still[read].all(axis=0) if read.any() else np.zeros(3, dtype=bool)
        if stuck.any():
            along = "" if stuck.all() else f" along {'xyz'[int(np.argmax(stuck))]}, an axis of its own,"
            raise SamplesError(
                f"'{need.instrument}', the {role} sensor, reads one and the same value{along} while the "
                "other one's change",
                day=str(day),
                remedy="its readings are no measurements: leave the day's file out, or flag it ('good_when')",
            )
        flag[still.any(axis=1)] |= np.uint32(Flag.STILL)
    samples["flag"] = samples["flag"].copy(data=flag)
    return samples


def _refuse_stuck(
    still: npt.NDArray[np.bool_], values: Floats, role: str, name: str, day: np.datetime64
) -> None:
    read = np.isfinite(values).all(axis=1)
    stuck = still[read].all(axis=0) if read.any() else np.zeros(3, dtype=bool)
    if stuck.any():
        along = "" if stuck.all() else f" along {'xyz'[int(np.argmax(stuck))]}, an axis of its own,"
        raise SamplesError(
            f"'{name}', the {role} sensor, reads one and the same value{along} while the other one's change",
            day=str(day),
            remedy="its readings are no measurements: leave the day's file out, or flag it ('good_when')",
        )


def still_axes(values: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return where an axis of a sensor reads the very same for long while another sensor's changes.

    Parameters
    ----------
    values, other : ndarray, shape (time, axis)
        nT, at the same times and in the same axes, NaN where missing; of the other what both must see.

    Returns
    -------
    ndarray of bool, shape (time, axis)
    """
    out = np.zeros(values.shape, dtype=bool)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    if rows.size < TWO_SENSOR_SETTINGS.still_samples:
        return out
    for axis in range(values.shape[1]):
        own = values[rows, axis]
        steps = np.abs(np.diff(own))
        steps[steps <= TWO_SENSOR_SETTINGS.same * float(np.abs(own).max())] = 0.0
        edges = np.concatenate([[0], np.flatnonzero(steps) + 1, [rows.size]])
        for first, last in pairwise(edges.tolist()):
            if last - first < TWO_SENSOR_SETTINGS.still_samples:
                continue
            seen = other[rows[first:last], axis]
            seen = seen[np.isfinite(seen)]
            if seen.size < TWO_SENSOR_SETTINGS.parts:
                continue
            change = np.ptp([part.mean() for part in np.array_split(seen, TWO_SENSOR_SETTINGS.parts)])
            near = TWO_SENSOR_SETTINGS.nearby_steps
            around = steps[max(first - near, 0) : first], steps[last - 1 : last - 1 + near]
            taken = [part[part > 0.0] for part in around]
            smallest = max((float(part.min()) for part in taken if part.size), default=0.0)
            if change > TWO_SENSOR_SETTINGS.moves * smallest:
                out[rows[first:last], axis] = True
    return out


def states_window(
    cat: Catalog,
    mission: Mission,
    model: Model,
    days: Sequence[np.datetime64],
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> xr.Dataset | Failure:
    """Learn from a window of days; return its table, or why there is none.

    Returns
    -------
    Dataset
        Of `inflight.dual.tracking.training_to_dataset`, with a gradiometer. Over `candidate`: `slope`,
        `slope_sigma`, `benefit` (nT2) and `chance_of_harm` of each correction on held-out stretches, `share`
        and `slower` (s) of the part of it that helps with confidence. Attributes `method`, `applied` (yes or
        no), `verdict`, `remark`.
    """
    with one_thread(), cached_readings():
        try:
            readings, ambient = window_readings(cat, mission, model, days, needs, index)
            candidates = Candidates(readings, body_of(mission, model.comparison), ambient=ambient)
            found = choose_correction(readings, candidates.fit, candidates.priors)
            return with_remark(table_of(candidates, found))
        except Exception as error:  # one window must not stop the others; its cause is recorded
            return failure_of(error, f"{model.comparison} window {days[0]} {days[-1]}", cat.workspace)


def body_of(mission: Mission, comparison: str) -> Body | None:
    """Return the places of both sensors and of the spacecraft's units, m; None where they are not stated."""
    entry = mission.comparisons[comparison]
    if not isinstance(entry, DualComparison) or entry.body is None:
        return None
    roles = entry.instruments()
    places = [mission.instruments[roles[role]].position for role in _ROLES]
    if any(place is None for place in places):
        return None
    factor, _ = factor_and_offset(mission.positions.unit, "m")
    sensors, middle, size = (
        np.asarray(one, dtype=np.float64) * factor for one in (places, entry.body.middle, entry.body.size)
    )
    return Body(sensors, middle, 0.5 * size)


class WindowReadings(NamedTuple):
    """What both sensors read in a window, and the ambient field (time, axis) nT where it is known."""

    readings: Readings
    ambient: Floats | None


def window_readings(
    cat: Catalog,
    mission: Mission,
    model: Model,
    days: Sequence[np.datetime64],
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> WindowReadings:
    """Return the readings of a window in spacecraft axes; days that cannot be read are skipped.

    Raises
    ------
    SamplesError
        When no day can be read.
    """
    parts: list[Readings] = []
    ambient: list[Floats] = []
    last: InflightError | None = None
    monitor = next(iter(ambient_of(mission, model.comparison)), None)
    for day in days:
        try:
            samples = two_sensor_samples(cat, mission, model, day, needs, index)
            parts.append(readings_of(model, samples)[0])
        except InflightError as error:
            last = error
            continue
        field = np.full((samples.sizes["time"], 3), np.nan)
        if monitor is not None:
            turn = scipy.spatial.transform.Rotation.from_quat(
                mission.instruments[monitor.instrument].orientation
            )
            field = np.asarray(turn.apply(np.asarray(samples[AMBIENT].values, dtype=np.float64)))
        ambient.append(field)
    if not parts:
        raise last or SamplesError("no day of the window has both sensors", remedy="ingest both")
    stamps, inboard, outboard = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("stamps", "inboard", "outboard")
    )
    size = -(-stamps.size // TWO_SENSOR_SETTINGS.most_samples)
    return average_samples(Readings(stamps, inboard, outboard), np.concatenate(ambient), size)


def average_samples(readings: Readings, ambient: Floats, size: int) -> WindowReadings:
    """Return means of `size` neighbouring samples; means over a gap or a missing reading are skipped."""
    has_ambient = bool(np.isfinite(ambient).all(axis=1).any())
    if size <= 1:
        return WindowReadings(readings, ambient if has_ambient else None)
    count = len(readings) // size
    cut = slice(0, count * size)
    stamps = readings.stamps[cut].reshape(count, size)
    whole = stamps[:, -1] - stamps[:, 0] < (size + 1) * readings.step
    inboard, outboard, known = (
        one[cut].reshape(count, size, 3).mean(axis=1)[whole]
        for one in (readings.inboard, readings.outboard, ambient)
    )
    middle: Int64 = stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2
    return WindowReadings(Readings(middle[whole], inboard, outboard), known if has_ambient else None)


def table_of(candidates: Candidates, found: HeldOutDecision) -> xr.Dataset:
    """Return the table of a window: its training, its gradiometer, and the scores of all candidates."""
    scores = list(found.scores.values())
    one = ("candidate",)
    table = training_to_dataset(candidates.training)
    chosen = found.chosen
    if candidates.gradiometers:
        form = candidates.gradiometers[chosen if chosen in FORMS else "matrix"]
        gradiometer = gradiometer_to_dataset(form, candidates.readings)
        table = table.merge(gradiometer).assign_attrs({**table.attrs, **gradiometer.attrs})
    table = table.assign(
        slope=(one, np.array([each.slope for each in scores])),
        slope_sigma=(one, np.array([each.sigma for each in scores])),
        benefit=(one, np.array([each.benefit for each in scores]), {"units": "nT2"}),
        chance_of_harm=(one, np.array([each.risk for each in scores]), {"units": "1"}),
        share=(one, np.array([each.part.share for each in scores]), {"units": "1"}),
        slower=(one, np.array([each.part.seconds for each in scores]), {"units": "s"}),
        share_away=(one, np.array([each.slope_error for each in scores]), {"units": "1"}),
        helps=(one, np.array([each.helps for each in scores], dtype=np.int64)),
        candidate=(one, np.array([each.name for each in scores], dtype="U32")),
    ).assign_attrs(
        method="gradiometer" if chosen in FORMS else chosen,
        applied="no" if chosen == "none" else "yes",
        verdict=found.correction.reason,
    )
    if chosen in FORMS:
        table = gradiometer_in_states(table, candidates.readings)
    part = found.scores[chosen].part if chosen in found.scores else WHOLE
    if part == WHOLE:
        return table
    full = full_correction(table, candidates.readings)
    return table.merge(applied_part_to_dataset(full, candidates.readings, part, constant_part(table)))


def correction_of(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction of a day's readings by the method that a table chose, the part of it of low risk.

    A correction that does not help is kept, and not applied.
    """
    found = full_correction(table, readings)
    method = str(table.attrs["method"])
    score = _score_of(table, str(table.attrs["gradiometer_form"]) if method == "gradiometer" else method)
    if not found.applied or score is None:
        return found
    part = AppliedPart(float(score["share"]), float(score["slower"]))
    slow, middle = slow_part_of_day(table, found, readings, part, constant_part(table))
    return partial_correction(found, part, float(score["share_away"]), slow, middle)


def full_correction(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the whole correction by the method that a table chose.

    In states that the table does not know, a gradiometer is used when it helps by itself on held-out
    stretches.
    """
    method, verdict = str(table.attrs["method"]), str(table.attrs["verdict"])
    if method == "gradiometer":
        return replace(gradiometer_with_states(table, readings), reason=verdict)
    training = training_from_dataset(table)
    if not len(training):
        return no_correction(len(readings), verdict)
    if method == "combined":
        found = correction_by_states_and_gradiometer(readings, training, gradiometer_from_dataset(table))
        return replace(found, reason=verdict)
    fallback = correction_by_stored_gradiometer(table, readings) if gradiometer_helps(table) else None
    found = correction_by_states(readings, training, fallback=fallback)
    return replace(found, reason=verdict) if str(table.attrs["applied"]) == "yes" else found.withheld(verdict)


def _score_of(table: xr.Dataset, candidate: str) -> xr.Dataset | None:
    """Return the held-out scores of one candidate; None where it was not tried."""
    names = table["candidate"].values.tolist()
    return table.isel(candidate=names.index(candidate)) if candidate in names else None


def gradiometer_helps(table: xr.Dataset) -> bool:
    """Return True when a table's gradiometer helps by itself on held-out stretches."""
    if not has_gradiometer(table):
        return False
    score = _score_of(table, str(table.attrs.get("gradiometer_form")))
    return score is not None and bool(score["helps"])


#: Flags of samples that count in the coverage.
_HARMLESS = Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.NOT_CORRECTED


def states_day(batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return one day's product (`inflight.dual.product.dual_level2`) and a report.

    The report's residual is the rms step of the outboard field at the day's switchings, nT a component:
    as measured, corrected, and the floor, that of the corrected field where nothing switches.
    """
    mission, model, job = batch.mission, batch.model, batch.job
    samples = two_sensor_samples(batch.cat, mission, model, day, job.needs, job.index, surroundings=True)
    readings, flag = readings_of(model, samples)
    correction = correction_of(batch.table, readings)
    flag[~(correction.known & correction.applied)] |= np.uint32(Flag.NOT_CORRECTED)
    product = dual_level2(readings, correction, flag, model.comparison)
    field, sensor = np.asarray(product["field_spacecraft"].values), model.known_layout.sensor("outboard")
    product["uncertainty"].values[:] = np.sqrt(
        product["uncertainty"].values ** 2 + instrument_variance(sensor, field, readings.stamps)
    )
    product = without_constant(product.isel(time=within_day(readings.stamps, day)), batch.table, day)
    product = rounded(product)
    product.attrs |= {
        "mission": mission.mission,
        "acknowledgement": mission.acknowledgement,
        "day": str(day),
    }
    return product, product_report(product, day) | report_before(batch.table, day)


def product_report(product: xr.Dataset, day: np.datetime64) -> dict[str, Any]:
    """Return the report of a day's product as plain numbers; see `states_day`."""
    stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
    step = usual_step(stamps, SECOND)
    state = np.asarray(product["state"].values, dtype=np.int64)
    at = switchings(state, stamps, step)
    field = np.asarray(product["field_spacecraft"].values)
    width = quietest_width(field, at)
    begin, end = day_bounds(day)
    good = (product["flag"].values & ~np.uint32(_HARMLESS)) == 0
    steps = {
        "before_nT": rms_of_steps(steps_across(np.asarray(product["outboard"].values), at, width)),
        "after_nT": rms_of_steps(steps_across(field, at, width)),
        "floor_nT": rms_of_steps(quiet_steps(field, at, width)),
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
