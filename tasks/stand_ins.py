"""What stands in for missing channels: typical values from the archive, read without the database."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day
from inflight.mission import Mission
from inflight.model import Model
from inflight.substitution import Substituted, Treated, Typical, missing_rows, substitute
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.needs import Need

#: Cause of a day that is there, though not all of it was measured.
PARTIAL = "partial"
_REMEDY = "ingest the missing housekeeping; until then the samples carry the flag channel_missing"


def stand_ins(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Iterable[Need],
    index: ArchiveIndex,
    day: np.datetime64,
    samples: xr.Dataset,
) -> Substituted | None:
    """Return a day's samples with typical values where channels of the model are missing; None if none is.

    Parameters
    ----------
    needs : iterable of Need
        Of the model; those that are `replaceable` have typical values.
    index : ArchiveIndex
        The days around, and those that `ArchiveIndex.typical_days` names.
    samples : xarray.Dataset
        The day's, as `inflight.tasks.samples.load_samples` returns them.
    """
    missing = missing_rows(model, samples)
    if not missing:
        return None
    wanted = [need for need in needs if need.name in missing]
    found = {
        need.name: typical_value(cat, need, index.typical_days(need, day), day)
        for need in wanted
        if need.replaceable
    }
    channels = {
        need.name: mission.instruments[need.instrument].channels[need.channel]
        for need in wanted
        if need.part is None
    }
    ranges = {
        name: told.range for name, told in channels.items() if told.range is not None and not told.axis_names
    }
    known = {name: one for name, one in found.items() if one is not None}
    return substitute(model, samples, known, ranges, missing)


def typical_value(cat: Catalog, need: Need, days: Iterable[Day], day: np.datetime64) -> Typical | None:
    """Return what a channel usually reads, from days of the archive; None when they do not tell."""
    known = list(days)
    if not known:
        return None
    read = [cat.read(one, [need.channel], dated=False) for one in known]
    values = np.concatenate([np.asarray(one[need.channel].values, dtype=np.float64) for one in read])
    stamps = np.concatenate([one["tt2000"].values for one in read])
    own = [one.day for one in known] == [day]
    return Typical.of(values, stamps, "the day" if own else " and ".join(str(one.day) for one in known))


def treated_report(treated: Mapping[str, Treated], scalar_nT: float) -> dict[str, Any]:
    """Return what a day's report says of stand-ins: by effect, and as the day's message.

    Parameters
    ----------
    scalar_nT : float
        By how much they make the scalar field uncertain, rms over the samples treated.
    """
    told = {
        name: {"samples": one.samples, "channels": list(one.channels), "instead": one.instead}
        for name, one in treated.items()
    }
    sentence = "; ".join(f"{name}: {one}" for name, one in treated.items())
    return {"stand_ins": told, "stand_ins_scalar_nT": scalar_nT, PARTIAL: sentence}


def partial_problems(days: Iterable[Day]) -> list[dict[str, str]]:
    """Return the entries of a run's problems for days whose products have stand-ins.

    Parameters
    ----------
    days : iterable of Day
        Products, as the catalog has them.
    """
    return [
        {
            "day": str(day.day),
            "channel": ", ".join(
                sorted({name for one in day.report["stand_ins"].values() for name in one["channels"]})
            ),
            "cause": PARTIAL,
            "remedy": _REMEDY,
            "message": str(day.report[PARTIAL]),
        }
        for day in days
        if day.report.get("stand_ins")
    ]
