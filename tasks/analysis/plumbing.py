"""Plumbing of an archive: some days are read, and `inflight.plumbing` asks what is wrong with them.

What was found is kept in the workspace's reports with a hash of all that it was made from: who compares or
diagnoses again, with an archive, a mission and a model that did not change, reads no samples for it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from inflight.catalog import Catalog
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.model import Model
from inflight.plumbing import PLUMBING_SETTINGS, Finding, Record, Survey, find_faults
from inflight.tasks.analysis.kept_diagnosis import hash_of_software, hashes_of_companions
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
from inflight.tasks.report import write_page
from inflight.time import DayLike

if TYPE_CHECKING:
    import xarray as xr


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
    needs, channels = needs_of(mission, model), channel_needs(mission)
    index = ArchiveIndex.of(cat, [*needs, *channels])
    days = evenly_spread(require_days(index, needs, start, end), PLUMBING_SETTINGS.days)
    path = Path(cat.workspace) / "reports" / f"plumbing-{comparison}.json"
    key = _key(cat, mission, model, index, days)
    kept = _kept(path, key)
    if kept is None:
        survey = read_survey(cat, mission, model, index, days)
        # A channel is judged by the model where it uses the channel.
        used = {channel for entry in model.effects for channel in entry.effect.channels} & set(
            survey.channels
        )
        samples = _thinned_samples(cat, mission, model, needs, index, days) if used else None
        kept = find_faults(survey, model, samples)
        with suppress(OSError):  # a workspace that can only be read keeps nothing
            write_page(path, Kept(made_from=key, found=kept).model_dump_json())
    return kept


class Kept(BaseModel):
    """What was found, and the hash of what it was made from."""

    made_from: str
    found: tuple[Finding, ...]


#: What finds faults.
_SOFTWARE = (
    "inflight",
    "inflight.effects",
    "inflight.model",
    "inflight.plumbing",
    "inflight.samples",
    "inflight.tasks.analysis",
    "inflight.tasks.archive",
)


def _kept(path: Path, key: str) -> tuple[Finding, ...] | None:
    """Return what was found before; None where nothing is kept, or of something else."""
    try:
        kept = Kept.model_validate_json(path.read_bytes())
    except (OSError, ValueError):
        return None
    return kept.found if kept.made_from == key else None


def _key(
    cat: Catalog, mission: Mission, model: Model, index: ArchiveIndex, days: Sequence[np.datetime64]
) -> str:
    """Return a hash of all that findings are made from: archive, mission, model and software."""
    archive = sorted([name, str(day), one.id, one.key] for (name, day), one in index.days.items())
    own = hashes_of_companions(cat, mission)
    made_of = [mission.text, own, model.name, model.text, archive, hash_of_software(_SOFTWARE)]
    return hashlib.sha256(json.dumps([made_of, list(map(str, days))]).encode()).hexdigest()


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
    cat: Catalog, mission: Mission, model: Model, index: ArchiveIndex, days: Sequence[np.datetime64]
) -> Survey:
    """Read the channels of some days at their own stamps."""
    comparison = model.comparison
    roles = set(mission.comparisons[comparison].instruments())
    return Survey(
        mission=mission,
        comparison=comparison,
        fields={
            need.name: record
            for need in needs_of(mission, model)
            if need.name in roles and (record := read_record(cat, mission, index, need, days))
        },
        channels={
            need.name: record
            for need in channel_needs(mission)
            if (record := read_record(cat, mission, index, need, days)) is not None
        },
    )


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
    import xarray as xr

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
