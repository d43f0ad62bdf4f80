"""What a window of days tells of two sensors: the table of states, and whether the correction helps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from inflight.catalog import Catalog
from inflight.dual.bands import gradiometer_correction
from inflight.dual.combined import combined_correction
from inflight.dual.correction import Correction
from inflight.dual.gradiometer import Gradiometer, fit_gradiometer
from inflight.dual.gradiometer_table import (
    correction_by_gradiometer,
    gradiometer_of,
    gradiometer_variables,
    has_gradiometer,
)
from inflight.dual.harm import SURE, Corrector, Judgement, judge
from inflight.dual.processing import process
from inflight.dual.product import readings_of
from inflight.dual.readings import Readings
from inflight.dual.table import from_dataset, to_dataset
from inflight.dual.training import Training, train
from inflight.errors import InflightError, SamplesError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.calibrate import Failure, failure_of
from inflight.tasks.channel_series import kept_readings
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples
from inflight.time import Int64

#: Bumped by hand when the numbers of the tables change.
STATES_VERSION = 1
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
        Of `inflight.dual.table.to_dataset`, with a gradiometer; variables `slope`, `slope_sigma`, `benefit`
        over `candidate` say what held-out stretches tell of each correction. Attributes `method`,
        `applied` (yes or no), `verdict`.
    """
    with threadpool_limits(1), kept_readings():
        try:
            readings = window_readings(cat, mission, model, days, needs, index)
            training = train(readings)
            found = judge(readings, candidates)
            return table_of(readings, training, found)
        except Exception as error:  # one window must not stop the others; its cause is recorded
            return failure_of(error)


def candidates(readings: Readings) -> Mapping[str, Corrector]:
    """Return the corrections that readings offer, by name; those that cannot be learnt are left out."""
    found: dict[str, Corrector] = {}
    with suppress(InflightError):
        gradiometer = fit_gradiometer(readings)
        found["gradiometer"] = partial(gradiometer_correction, gradiometer)
        training = train(readings)
        found["states"] = partial(_by_states, training)
        found["combined"] = partial(_by_both, training, gradiometer)
    return found


def _by_states(training: Training, readings: Readings) -> Correction:
    return process(readings, training)


def _by_both(training: Training, gradiometer: Gradiometer, readings: Readings) -> Correction:
    return combined_correction(readings, training, process(readings, training), gradiometer)


def window_readings(
    cat: Catalog,
    mission: Mission,
    model: Model,
    days: Sequence[np.datetime64],
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> Readings:
    """Return the readings of a window in spacecraft axes; days that cannot be read are left out.

    Raises
    ------
    SamplesError
        When no day can be read.
    """
    parts, last = [], None
    for day in days:
        try:
            samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
            parts.append(readings_of(model, samples)[0])
        except InflightError as error:
            last = error
    if not parts:
        raise last or SamplesError("no day of the window has both sensors", remedy="ingest both")
    joined = Readings(
        np.concatenate([one.stamps for one in parts]),
        np.concatenate([one.inboard for one in parts]),
        np.concatenate([one.outboard for one in parts]),
    )
    return thinned(joined, -(-len(joined) // _MOST))


def thinned(readings: Readings, size: int) -> Readings:
    """Return means of `size` neighbouring samples; means over a gap or a missing reading are left out."""
    if size <= 1:
        return readings
    count = len(readings) // size
    cut = slice(0, count * size)
    stamps = readings.stamps[cut].reshape(count, size)
    whole = stamps[:, -1] - stamps[:, 0] < (size + 1) * readings.step
    fields = [one[cut].reshape(count, size, 3).mean(axis=1) for one in (readings.inboard, readings.outboard)]
    middle: Int64 = stamps[:, 0] + (stamps[:, -1] - stamps[:, 0]) // 2
    return Readings(middle[whole], fields[0][whole], fields[1][whole])


def table_of(readings: Readings, training: Training, found: Judgement) -> xr.Dataset:
    """Return the table of a training and of what was said of its correction."""
    evidence = list(found.evidence.values())
    one = ("candidate",)
    table = to_dataset(training)
    if readings.good.any():
        gradiometer = gradiometer_variables(fit_gradiometer(readings), readings)
        table = table.merge(gradiometer).assign_attrs({**table.attrs, **gradiometer.attrs})
    applied = found.chosen != "none"
    return table.assign(
        slope=(one, np.array([each.slope for each in evidence])),
        slope_sigma=(one, np.array([each.sigma for each in evidence])),
        benefit=(one, np.array([each.benefit for each in evidence]), {"units": "nT2"}),
        candidate=(one, np.array([each.name for each in evidence], dtype="U32")),
    ).assign_attrs(
        method=found.chosen,
        applied="yes" if applied else "no",
        verdict=found.evidence[found.chosen].told if applied else found.correction.reason,
    )


def correction_of(table: xr.Dataset, readings: Readings) -> Correction:
    """Return what a table takes off a day's readings, by the method it chose.

    One that does not help is kept, and not applied. In states that the table does not know a gradiometer
    stands in when held-out stretches say that it helps by itself.
    """
    method, verdict = str(table.attrs["method"]), str(table.attrs["verdict"])
    if method == "gradiometer":
        return replace(correction_by_gradiometer(table, readings), reason=verdict)
    training = from_dataset(table)
    if method == "combined":
        return replace(_by_both(training, gradiometer_of(table), readings), reason=verdict)
    fallback = correction_by_gradiometer(table, readings) if gradiometer_helps(table) else None
    correction = process(readings, training, fallback=fallback)
    if str(table.attrs["applied"]) != "yes":
        return correction.withheld(verdict)
    return replace(correction, reason=verdict)


def gradiometer_helps(table: xr.Dataset) -> bool:
    """Return True when held-out stretches say beyond doubt that a table's gradiometer helps."""
    names = table["candidate"].values.tolist()
    if "gradiometer" not in names or not has_gradiometer(table):
        return False
    row = table.isel(candidate=names.index("gradiometer"))
    return bool(row["slope"] - SURE * row["slope_sigma"] > 0.5 and row["benefit"] > 0.0)
