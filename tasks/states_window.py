"""What a window of days tells of two sensors: the table of states, and whether the correction helps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from inflight.catalog import Catalog
from inflight.dual.correction import Correction, no_correction
from inflight.dual.harm import Corrector, Judgement, judge
from inflight.dual.processing import process
from inflight.dual.product import readings_of
from inflight.dual.readings import Readings
from inflight.dual.training import Training, train
from inflight.errors import InflightError, SamplesError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.calibrate import Failure, failure_of
from inflight.tasks.channel_series import kept_readings
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples
from inflight.time import SECOND, Int64

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
        Of `Training.to_dataset`; variables `slope`, `slope_sigma`, `benefit` over `candidate` say what
        held-out stretches tell of each correction. Attributes `method`, `applied` (yes or no), `reason`.
    """
    with threadpool_limits(1), kept_readings():
        try:
            readings = window_readings(cat, mission, model, days, needs, index)
            training = train(readings)
            found = judge(readings, candidates)
        except Exception as error:  # one window must not stop the others; its cause is recorded
            return failure_of(error)
    return table_of(training, found)


def candidates(readings: Readings) -> Mapping[str, Corrector]:
    """Return the corrections that readings offer, by name; those that cannot be learnt are left out."""
    try:
        training = train(readings)
    except InflightError:
        return {}
    return {"states": lambda other: process(other, training)}


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


def table_of(training: Training, found: Judgement) -> xr.Dataset:
    """Return the table of a training and of what was said of its correction."""
    evidence = list(found.evidence.values())
    one = ("candidate",)
    applied = found.chosen != "none"
    return training.to_dataset().assign(
        slope=(one, np.array([each.slope for each in evidence])),
        slope_sigma=(one, np.array([each.sigma for each in evidence])),
        benefit=(one, np.array([each.benefit for each in evidence]), {"units": "nT2"}),
        candidate=(one, np.array([each.name for each in evidence], dtype="U32")),
    ).assign_attrs(
        method=found.chosen,
        applied="yes" if applied else "no",
        reason=found.evidence[found.chosen].told if applied else found.correction.reason,
    )


def correction_of(table: xr.Dataset, readings: Readings) -> Correction:
    """Return what a table takes off a day's readings; one that does not help is kept, and not applied."""
    training = Training.from_dataset(table)
    if not len(training):
        return no_correction(len(readings), str(table.attrs["reason"]))
    correction = process(readings, training)
    if table.attrs["applied"] != "yes":
        return correction.withheld(str(table.attrs["reason"]))
    return correction
