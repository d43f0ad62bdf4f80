"""What a window of days tells of two sensors: the table of states, and whether the correction helps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from inflight.arrays import Floats
from inflight.catalog import Catalog
from inflight.dual.candidates import Candidates, correction_by_both
from inflight.dual.correction import Correction, no_correction
from inflight.dual.gradiometer import FORMS
from inflight.dual.gradiometer_table import (
    correction_by_gradiometer,
    gradiometer_of,
    gradiometer_variables,
    has_gradiometer,
)
from inflight.dual.harm import Judgement, judge
from inflight.dual.places import Body
from inflight.dual.processing import process
from inflight.dual.product import readings_of
from inflight.dual.readings import Readings
from inflight.dual.slow_part import WHOLE, Part, part_of_day, part_variables, partly
from inflight.dual.table import from_dataset, to_dataset
from inflight.errors import InflightError, SamplesError
from inflight.mission import DualComparison, Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.boom_readings import boom_samples
from inflight.tasks.calibrate import Failure, failure_of
from inflight.tasks.channel_series import kept_readings
from inflight.tasks.needs import AMBIENT, Need, ambient_of
from inflight.tasks.states_constant import constant_part, gradiometer_in_states, gradiometer_with_states
from inflight.tasks.states_remarks import with_remark
from inflight.time import Int64
from inflight.units import factor_and_offset

#: Bumped by hand when the numbers of the tables change.
STATES_VERSION = 8
#: Samples that are learnt from at most; of faster records means are taken.
_MOST = 3_000_000


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
        Of `inflight.dual.table.to_dataset`, with a gradiometer; variables `slope`, `slope_sigma`, `benefit`,
        `chance_of_harm` over `candidate` say what held-out stretches tell of each correction, `share` and
        `slower` which part of it is sure to help. Attributes
        `method`, `applied` (yes or no), `verdict`, `remark`.
    """
    with threadpool_limits(1), kept_readings():
        try:
            readings, ambient = window_readings(cat, mission, model, days, needs, index)
            candidates = Candidates(readings, body_of(mission, model.comparison), ambient=ambient)
            found = judge(readings, candidates.fit, candidates.expectations)
            return with_remark(table_of(candidates, found))
        except Exception as error:  # one window must not stop the others; its cause is recorded
            return failure_of(error)


def body_of(mission: Mission, comparison: str) -> Body | None:
    """Return where both sensors and the spacecraft's units are, m; None where the mission is silent."""
    told = mission.comparisons[comparison]
    if not isinstance(told, DualComparison) or told.body is None:
        return None
    roles = told.instruments()
    places = [mission.instruments[roles[role]].position for role in ("inboard", "outboard")]
    if any(place is None for place in places):
        return None
    factor, _ = factor_and_offset(mission.positions.unit, "m")
    sensors, middle, size = (
        np.asarray(one, dtype=np.float64) * factor for one in (places, told.body.middle, told.body.size)
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
    """Return the readings of a window in spacecraft axes; days that cannot be read are left out.

    Raises
    ------
    SamplesError
        When no day can be read.
    """
    parts, ambient, last = [], [], None
    for day in days:
        try:
            samples = boom_samples(cat, mission, model, day, needs, index)
            parts.append(readings_of(model, samples)[0])
            ambient.append(_ambient(mission, model.comparison, samples))
        except InflightError as error:
            last = error
    if not parts:
        raise last or SamplesError("no day of the window has both sensors", remedy="ingest both")
    joined = Readings(
        np.concatenate([one.stamps for one in parts]),
        np.concatenate([one.inboard for one in parts]),
        np.concatenate([one.outboard for one in parts]),
    )
    return thinned(joined, np.concatenate(ambient), -(-len(joined) // _MOST))


def _ambient(mission: Mission, comparison: str, samples: xr.Dataset) -> Floats:
    """Return the known ambient field of samples, (time, axis) nT, spacecraft axes; NaN where it is not."""
    (need,) = ambient_of(mission, comparison) or (None,)
    if need is None:
        return np.full((samples.sizes["time"], 3), np.nan)
    turn = Rotation.from_quat(mission.instruments[need.instrument].orientation)
    return np.asarray(turn.apply(np.asarray(samples[AMBIENT].values, dtype=np.float64)))


def thinned(readings: Readings, ambient: Floats, size: int) -> WindowReadings:
    """Return means of `size` neighbouring samples; means over a gap or a missing reading are left out."""
    told = ambient if np.isfinite(ambient).all(axis=1).any() else None
    if size <= 1:
        return WindowReadings(readings, told)
    count = len(readings) // size
    cut = slice(0, count * size)
    stamps = readings.stamps[cut].reshape(count, size)
    whole = stamps[:, -1] - stamps[:, 0] < (size + 1) * readings.step
    inboard, outboard, known = (
        one[cut].reshape(count, size, 3).mean(axis=1)[whole]
        for one in (readings.inboard, readings.outboard, ambient)
    )
    middle: Int64 = stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2
    return WindowReadings(Readings(middle[whole], inboard, outboard), None if told is None else known)


def table_of(candidates: Candidates, found: Judgement) -> xr.Dataset:
    """Return the table of what was learnt from a window and of what was said of its correction."""
    evidence = list(found.evidence.values())
    one = ("candidate",)
    table = to_dataset(candidates.training)
    chosen = found.chosen
    if candidates.gradiometers:
        form = candidates.gradiometers[chosen if chosen in FORMS else "matrix"]
        gradiometer = gradiometer_variables(form, candidates.readings)
        table = table.merge(gradiometer).assign_attrs({**table.attrs, **gradiometer.attrs})
    told = table.assign(
        slope=(one, np.array([each.slope for each in evidence])),
        slope_sigma=(one, np.array([each.sigma for each in evidence])),
        benefit=(one, np.array([each.benefit for each in evidence]), {"units": "nT2"}),
        chance_of_harm=(one, np.array([each.chance_of_harm for each in evidence]), {"units": "1"}),
        share=(one, np.array([each.part.share for each in evidence]), {"units": "1"}),
        slower=(one, np.array([each.part.seconds for each in evidence]), {"units": "s"}),
        share_away=(one, np.array([each.away for each in evidence]), {"units": "1"}),
        helps=(one, np.array([each.helps for each in evidence], dtype=np.int64)),
        candidate=(one, np.array([each.name for each in evidence], dtype="U32")),
    ).assign_attrs(
        method="gradiometer" if chosen in FORMS else chosen,
        applied="no" if chosen == "none" else "yes",
        verdict=found.correction.reason,
    )
    if chosen in FORMS:
        told = gradiometer_in_states(told, candidates.readings)
    part = found.evidence[chosen].part if chosen in found.evidence else WHOLE
    if part == WHOLE:
        return told
    whole = whole_correction(told, candidates.readings)
    return told.merge(part_variables(whole, candidates.readings, part, constant_part(told)))


def correction_of(table: xr.Dataset, readings: Readings) -> Correction:
    """Return what a table takes off a day's readings, by the method it chose and as much as is sure to help.

    One that does not help is kept, and not applied.
    """
    found = whole_correction(table, readings)
    method = str(table.attrs["method"])
    told = _told_of(table, str(table.attrs["gradiometer_form"]) if method == "gradiometer" else method)
    if not found.applied or told is None:
        return found
    part = Part(float(told["share"]), float(told["slower"]))
    slow, middle = part_of_day(table, found, readings, part, constant_part(table))
    return partly(found, part, float(told["share_away"]), slow, middle)


def whole_correction(table: xr.Dataset, readings: Readings) -> Correction:
    """Return the correction by the method that a table chose, all of it.

    In states that the table does not know a gradiometer stands in when held-out stretches say that it helps
    by itself.
    """
    method, verdict = str(table.attrs["method"]), str(table.attrs["verdict"])
    if method == "gradiometer":
        return replace(gradiometer_with_states(table, readings), reason=verdict)
    training = from_dataset(table)
    if not len(training):
        return no_correction(len(readings), verdict)
    if method == "combined":
        found = correction_by_both(readings, training, gradiometer_of(table))
        return replace(found, reason=verdict)
    fallback = correction_by_gradiometer(table, readings) if gradiometer_helps(table) else None
    found = process(readings, training, fallback=fallback)
    return replace(found, reason=verdict) if str(table.attrs["applied"]) == "yes" else found.withheld(verdict)


def _told_of(table: xr.Dataset, candidate: str) -> xr.Dataset | None:
    """Return what was said of one candidate; None where it was not tried."""
    names = table["candidate"].values.tolist()
    return table.isel(candidate=names.index(candidate)) if candidate in names else None


def gradiometer_helps(table: xr.Dataset) -> bool:
    """Return True when held-out stretches say that a table's gradiometer helps by itself."""
    if not has_gradiometer(table):
        return False
    told = _told_of(table, str(table.attrs.get("gradiometer_form")))
    return told is not None and bool(told["helps"])
