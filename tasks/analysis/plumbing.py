"""Plumbing of an archive: some days are read, and `inflight.plumbing` asks what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.model import Model
from inflight.plumbing import PLUMBING_SETTINGS, Finding, Record, Survey, find_faults
from inflight.tasks.archive import (
    ArchiveIndex,
    Need,
    channel_needs,
    evenly_spread,
    load_samples,
    needs_of,
    require_days,
)
from inflight.tasks.models import current_model
from inflight.time import DayLike


def check_plumbing(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    comparison: str = "main",
    model: Model | None = None,
) -> tuple[Finding, ...]:
    """Return faults of units, clocks, axes and channels in an archive, by some of its days.

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    model : Model, optional
        Whose coefficients judge channels; the present one when absent.

    Raises
    ------
    CatalogError
        When the archive has no day of the span.
    """
    model = model or current_model(cat, mission, comparison).model
    survey, samples = read_survey(cat, mission, start, end, model)
    return find_faults(survey, model, samples)


def faults_of(
    cat: Catalog, mission: Mission, start: DayLike | None, end: DayLike | None, comparison: str
) -> list[dict[str, Any]]:
    """Return the fields of each fault, as the command line prints them: what a diagnosis begins with."""
    return [dict(one.as_json()) for one in check_plumbing(cat, mission, start, end, comparison)]


@contextmanager
def faults_in_errors(faults: Sequence[Mapping[str, Any]]) -> Iterator[None]:
    """Make faults the remedy of an error: data so wrong may leave nothing to search in."""
    try:
        yield
    except InflightError as error:
        if faults:
            error.remedy = " ".join(f"{one['sentence']}." for one in faults)
        raise


def read_survey(
    cat: Catalog, mission: Mission, start: DayLike | None, end: DayLike | None, model: Model
) -> tuple[Survey, xr.Dataset | None]:
    """Read some days: channels at their own stamps, and samples where the model uses any of these."""
    comparison = model.comparison
    needs, channels = needs_of(mission, model), channel_needs(mission)
    index = ArchiveIndex.of(cat, [*needs, *channels])
    days = require_days(index, needs, start, end)
    some = evenly_spread(days, PLUMBING_SETTINGS.days)
    roles = set(mission.comparisons[comparison].instruments())
    survey = Survey(
        mission=mission,
        comparison=comparison,
        fields={
            need.name: record
            for need in needs
            if need.name in roles and (record := read_record(cat, mission, index, need, some))
        },
        channels={
            need.name: record
            for need in channels
            if (record := read_record(cat, mission, index, need, some)) is not None
        },
    )
    used = {channel for entry in model.effects for channel in entry.effect.channels} & set(survey.channels)
    return survey, _thinned_samples(cat, mission, model, needs, index, some) if used else None


def read_record(
    cat: Catalog, mission: Mission, index: ArchiveIndex, need: Need, days: Sequence[np.datetime64]
) -> Record | None:
    """Return a channel on some days, at its own stamps and as archived; None when none of them has it."""
    stamps, values = [], []
    for day in days:
        source = index.get(need, day)
        if source is not None:
            data = cat.read(source, [need.channel], with_time=False)
            stamps.append(np.asarray(data["tt2000"].values, dtype=np.int64))
            values.append(np.asarray(data[need.channel].values, dtype=np.float64))
    if not sum(part.size for part in stamps) > 1:
        return None
    return Record(
        name=need.name,
        instrument=need.instrument,
        channel=need.channel,
        entry=mission.instruments[need.instrument].channels[need.channel],
        cadence_ns=need.cadence_ns,
        stamps=np.concatenate(stamps),
        values=np.concatenate(values),
    )


def _thinned_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
) -> xr.Dataset | None:
    """Return thinned samples of some days; None where they cannot be made."""
    if mission.comparisons[model.comparison].kind not in ("scalar", "dual"):
        return None
    parts = []
    for day in days:
        try:
            samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
        except InflightError:
            # What is wrong with the day, the calibration tells.
            continue
        step = max(1, samples.sizes["time"] * len(days) // PLUMBING_SETTINGS.rows)
        parts.append(samples.isel(time=slice(None, None, step)))
    return xr.concat(parts, "time", combine_attrs="override") if parts else None
