"""The pass: one look at every day of the archive makes the evidence that all later questions are put to.

A worker turns some days into Gram matrices of [calibration | model | candidates | residual] and a
coarse series for pictures and signatures. Days whose inputs did not change are not looked at again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.catalog import Catalog, Day
from inflight.comparison import RowFilter, rows_of
from inflight.diagnosis.bursts import Outliers
from inflight.diagnosis.coarse import coarsen
from inflight.diagnosis.columns import Rows, design, turns_of
from inflight.diagnosis.evidence import Evidence
from inflight.diagnosis.gram import gram_of, parts_of, prewhiten
from inflight.diagnosis.library import Library, Told
from inflight.diagnosis.series import Features, Series, features_of, pack_blocks, thin
from inflight.diagnosis.stretches import Stretches
from inflight.folding import FOLDING_VERSION, Folding
from inflight.geometry import GEOMETRY, add_geometry
from inflight.mission import Mission
from inflight.model import Model
from inflight.noise import NoiseFloor
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.calibrate import Job, Outcome, make_days
from inflight.tasks.channels import ChannelReader, DerivedChannels, as_variables, orbit_of, stands_in
from inflight.tasks.evidence_floor import floor_of_samples, floor_of_turns, joined_floors
from inflight.tasks.needs import Need
from inflight.tasks.samples import load_samples
from inflight.time import DAY, SECOND, day_bounds

#: Bumped by hand when the numbers of the evidence change.
EVIDENCE_VERSION = 14
#: Days lose the bins without geometry when these are at most this part of them.
_GEOMETRY_GAPS = 0.3
#: Rows of the series are at least so far apart in long records, seconds.
_SERIES_S, _LONG_DAYS = 60.0, 100


#: Sums over the native samples that the reports of blocks hold.
SUMS = (
    "count",
    "square",
    "inside",
    "spikes",
    "burst_samples",
    "floor_samples",
    "floor",
    "floor_low",
    "floor_high",
)


@dataclass(frozen=True)
class PassPlan:
    """All a worker needs to make evidence; no database behind it.

    Attributes
    ----------
    model : Model
        At the values the residual is linearised at.
    library : Library
    needs, channel_needs : tuple of Need
        Series of the model's samples, and every channel of the mission.
    days : tuple of datetime64[D]
        The whole span.
    blocks : tuple of tuple of datetime64[D]
        Days of each block, or single days that hold several.
    parts : int
        Blocks of a day.
    cadence_ns : int
    span : tuple of int
        TT2000 of the record.
    memory_s : float
        Correlation time of the prewhitened form.
    told : mapping of str to Told
    keep_bursts : bool
        Bursts are counted and stay in.
    stretches : Stretches, optional
        Each has a level of its own: something nobody recorded switches between them.
    """

    model: Model
    library: Library
    needs: tuple[Need, ...]
    channel_needs: tuple[Need, ...]
    days: tuple[np.datetime64, ...]
    blocks: tuple[tuple[np.datetime64, ...], ...]
    parts: int
    cadence_ns: int
    span: tuple[int, int]
    memory_s: float
    told: Mapping[str, Told]
    keep_bursts: bool = False
    stretches: Stretches | None = None

    @property
    def scale(self) -> list[float]:
        """Physical size of one unit of each column."""
        return [one for term in self.library.all_terms for one in term.scale]

    @property
    def series_step(self) -> int:
        """Bins that become one row of the series."""
        if self.folding is not None:
            return 1
        wanted = _SERIES_S if len(self.days) > _LONG_DAYS else 0.0
        return max(1, round(wanted * SECOND / self.cadence_ns))

    @property
    def folding(self) -> Folding | None:
        """How samples were folded; None of a comparison that folds nothing."""
        return self.model.layout.folding if self.model.layout is not None else None

    @property
    def kept(self) -> RowFilter | None:
        """The filter residuals and columns go through."""
        return (
            self.folding
            or self.stretches
            or (self.model.layout.band if self.model.layout is not None else None)
        )

    @property
    def within_blocks(self) -> bool:
        """True when blocks hold several days, so that days are calibrated while they are made."""
        return any(len(block) > 1 for block in self.blocks)

    @property
    def key(self) -> str:
        """sha256 of everything but the archive that the evidence is made from."""
        told = {
            "version": EVIDENCE_VERSION,
            "folding": [FOLDING_VERSION, self.folding.interval_ns] if self.folding else None,
            "model": self.model.text,
            "columns": self.library.columns,
            "shifts": dict(self.library.placebos),
            "parts": self.parts,
            "cadence": self.cadence_ns,
            "memory": self.memory_s,
            "span": self.span,
            "means": {name: one.mean for name, one in self.told.items()},
            "keep_bursts": self.keep_bursts,
            "stretches": [self.stretches.edges, self.stretches.lost] if self.stretches else None,
        }
        return hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()


def evidence_batch(cat: Catalog, mission: Mission, made: PassPlan, index: ArchiveIndex, job: Job) -> Outcome:
    """Make the evidence of a batch of blocks and write it as one segment; blocks go by their first day."""
    reader = ChannelReader(
        cat, mission, made.channel_needs, index, made.cadence_ns, made.span, made.model.comparison
    )
    derived = DerivedChannels(reader, made.days, made.told, made.library.placebos)
    days_of = {block[0]: block for block in made.blocks}
    return make_days(
        cat,
        job,
        lambda day: block_evidence(cat, mission, made, index, derived, days_of[day]),
    )


def block_evidence(
    cat: Catalog,
    mission: Mission,
    made: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    days: Sequence[np.datetime64],
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the evidence of a block of days (or of the blocks of a day), and sums over its samples."""
    found = [_day_evidence(cat, mission, made, index, derived, day) for day in days]
    raw, white, _, sums = found[0]
    total = dict(sums)
    for more_raw, more_white, _, more in found[1:]:
        raw, white = _summed(raw, more_raw), _summed(white, more_white)
        total = {name: total[name] + more[name] for name in total}
    kept = [_as_recorded(one[2], derived.reader.day(day)) for one, day in zip(found, days, strict=True)]
    series, features = _series(made, raw, kept)
    dataset = raw.as_dataset().assign(gram_white=white.as_dataset()["gram"])
    dataset["series"] = (("block", "sample", "feature"), series, {"features": features.as_json()})
    if made.within_blocks:
        names = [name for term in made.library.base for name in term.columns]
        inside = [one[0].absorbed(names, [range(len(one[0]))], np.zeros(len(names))) for one in found]
        within = inside[0]
        for more_raw in inside[1:]:
            within = _summed(within, more_raw)
        packed = within.as_dataset()["gram"].rename(entry="entry_within")
        dataset = dataset.assign(gram_within=packed)
    return dataset.assign_attrs(cadence_ns=made.cadence_ns), total


def _as_recorded(rows: Rows, recorded: Mapping[str, Floats]) -> Rows:
    """Return rows whose channels are missing where they were not recorded; a series tells where that was."""
    samples = {
        name: rows.samples[name].copy(data=values)
        for name, values in recorded.items()
        if name in rows.samples and rows.samples[name].shape == values.shape
    }
    return replace(rows, samples=rows.samples.assign(samples))


def _series(made: PassPlan, raw: Evidence, rows: Sequence[Rows]) -> tuple[np.ndarray, Features]:
    """Return the coarse series of a block (or of the blocks of a day), and what it holds."""
    plain = [name for name in made.library.channels if name and not set(name) & set("@~*")]
    channels = list(dict.fromkeys([*made.told, *plain, *GEOMETRY]))
    features = features_of(rows[0], channels)
    thinned = [thin(one, features, made.series_step) for one in rows]
    stamps = np.concatenate([one[0] for one in thinned])
    values = np.concatenate([one[1] for one in thinned])
    days = max(len(block) for block in made.blocks)
    samples = -(-DAY // (made.cadence_ns * made.series_step)) * days // made.parts + 2
    record = made.span[1] - made.span[0]
    samples = min(samples, record // (made.cadence_ns * made.series_step) + 2)
    return pack_blocks(stamps, values, [*raw.start.tolist(), int(raw.end[-1])], int(samples)), features


def _summed(one: Evidence, other: Evidence) -> Evidence:
    return one.joined([other]).merged([range(len(one) + len(other))])


def _day_evidence(
    cat: Catalog,
    mission: Mission,
    made: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    day: np.datetime64,
) -> tuple[Evidence, Evidence, Rows, dict[str, Any]]:
    rows, sums = day_rows(cat, mission, made, index, derived, day)
    columns = design(made.library.all_terms, rows)
    stamps = rows.samples["tt2000"].values
    edges = derived.reader.edges(day)
    cuts = [int(edges[0] + part * (edges[-1] - edges[0]) // made.parts) for part in range(made.parts + 1)]
    parts = parts_of(stamps, cuts)
    residual = rows.residual[:, :, None]
    white = [prewhiten(values, rows.weight, stamps, made.memory_s) for values in (columns, residual)]
    count = np.array([rows.weight[part].sum() * residual.shape[1] for part in parts])
    names = (*made.library.columns, "residual")
    common = (
        np.array(cuts[:-1], dtype=np.int64),
        np.array(cuts[1:], dtype=np.int64),
        count,
        np.array([*made.scale, 1.0]),
    )
    return (
        Evidence(names, gram_of(columns, residual, rows.weight, parts), *common),
        Evidence(names, gram_of(white[0], white[1], rows.weight, parts), *common),
        rows,
        sums,
    )


def day_rows(
    cat: Catalog,
    mission: Mission,
    made: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    day: np.datetime64,
) -> tuple[Rows, dict[str, Any]]:
    """Return a day's rows on the library's cadence, and sums over its native samples."""
    samples = load_samples(cat, mission, made.model, day, list(made.needs), index, geometry=False)
    native = rows_of(made.model, samples)
    if made.stretches is not None:
        lost = made.stretches.is_lost(samples["tt2000"].values)
        native = replace(native, good=native.good & ~lost)
    if made.folding is not None:
        # What a sensor reads that turns in the steady field: effects are linearised there.
        steady = samples.assign(vector=(samples["vector"].dims, native.field, samples["vector"].attrs))
        samples = samples.assign(vector=made.model.disturb(steady)["vector"])
    start, end = day_bounds(day)
    geometry = _geometry(mission, derived.reader, day, samples)
    there = {name: np.asarray(geometry[name].values) for name in GEOMETRY if name in geometry}
    values = derived.on(day, made.library.channels, there)
    variables = as_variables(mission, values, geometry if there else None)
    edges = derived.reader.edges(day)
    turn = turns_of(made.model, (start + end) // 2)
    recorded = derived.reader.day(day)
    rows, sums = coarsen(samples, native, edges, variables, turn, recorded, made.keep_bursts)
    rows = replace(rows, weight=np.where(_lost(there, rows.weight > 0), 0.0, rows.weight))
    if made.stretches is not None:
        rows = _in_stretches(rows, made.stretches)
    if made.folding is None:
        sums |= floor_of_samples(native.residual, native.good, samples["tt2000"].values)
    else:
        sums |= floor_of_turns(samples, native.good, made.folding.sectors)
    return rows, sums


def _in_stretches(rows: Rows, stretches: Stretches) -> Rows:
    """Return rows whose residual is relative to its stretch; those in none weigh nothing."""
    stamps = rows.samples["tt2000"].values
    weight = np.where(stretches.is_lost(stamps), 0.0, rows.weight)
    residual = np.nan_to_num(stretches.keep(rows.residual, stamps, weight > 0))
    return replace(rows, residual=residual, weight=weight, kept=stretches)


def _lost(geometry: Mapping[str, Floats], used: np.ndarray) -> np.ndarray:
    """Return which bins have no geometry, when most have: what is not there must not pass for a shadow."""
    out = np.zeros(used.size, dtype=bool)
    for values in geometry.values():
        missing = ~np.isfinite(values.reshape(used.size, -1)).all(axis=1)
        if (missing & used).sum() <= _GEOMETRY_GAPS * max(used.sum(), 1):
            out |= missing
    return out


def _geometry(mission: Mission, reader: ChannelReader, day: np.datetime64, samples: xr.Dataset) -> xr.Dataset:
    """Return what position and attitude say of a day's bins."""
    data = orbit_of(mission, reader, day)
    bins = data["tt2000"].size
    for role in ("vector", "outboard"):
        if role in samples:
            attrs = {"orientation": samples[role].attrs.get("orientation", (0.0, 0.0, 0.0, 1.0))}
            data[role] = xr.Variable(("time", "axis"), np.zeros((bins, 3)), attrs)
            break
    found = add_geometry(xr.Dataset(data))
    return found.drop_vars([name for name in ("position", "attitude", "vector", "outboard") if name in found])


@dataclass(frozen=True)
class Loaded:
    """The evidence of a span: raw, prewhitened, within-day when it was made apart, the series, outliers."""

    raw: Evidence
    white: Evidence
    within: Evidence | None
    series: Series
    sums: Mapping[str, float]
    floor: NoiseFloor
    outliers: Outliers


def load_evidence(cat: Catalog, made: PassPlan, days: Sequence[Day]) -> Loaded:
    """Read the evidence of blocks, in order of time."""
    names = (*made.library.columns, "residual")
    scale = np.array([*made.scale, 1.0])
    ordered = sorted(days, key=lambda day: day.day)
    parts = [cat.read(day) for day in ordered]
    raw = [Evidence.of(part, names, scale) for part in parts]
    white = [Evidence.of(part, names, scale, "gram_white") for part in parts]
    within = None
    if made.within_blocks:
        base = {name for term in made.library.base for name in term.columns}
        kept = [place for place, name in enumerate(names) if name not in base]
        left = tuple(names[place] for place in kept)
        apart = [Evidence.of(part, left, scale[kept], "gram_within") for part in parts]
        within = apart[0].joined(apart[1:])
    packed = np.concatenate([part["series"].values for part in parts])
    starts = np.concatenate([part["start"].values for part in parts])
    features = Features.of_json(parts[0]["series"].attrs["features"])
    filled = {need.name: stands_in(made.told, need.name) for need in made.channel_needs}
    series = Series.of(packed, starts, features, filled)
    sums = {
        name: sum(float(day.report[name]) for day in ordered)
        for name in ("count", "square", "inside", "spikes")
    }
    return Loaded(
        raw[0].joined(raw[1:]),
        white[0].joined(white[1:]),
        within,
        replace(series, kept=made.kept),
        sums,
        joined_floors([day.report for day in ordered]),
        Outliers.of([day.report for day in ordered], made.keep_bursts),
    )
