"""The pass: each day of the archive is read once and becomes Gram blocks, which answer all later questions.

Takes a `PassPlan` (the model at the values it is linearised at, the library, the blocks) and the archive;
makes, for every block, the Gram matrices of [calibration | model | candidates | residual], raw and
prewhitened, a coarse series for pictures and signatures, and sums over the native samples
(`block_grams`). `make_blocks` makes the blocks that are missing or whose inputs changed; `load_grams`
reads them.

Before the pass, `survey` reads a few days: where the residual is linearised and what each channel does;
`cadence_for`, `block_parts` and `placebo_shifts` say how the span is divided. After it, `find_switchings`
says what switches in a comparison of two sensors without housekeeping, and `stretches_between` the
stretches between.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from inflight.arrays import Floats
from inflight.calibration import (
    PARAMETER_GROUPS,
    ParameterPrior,
    comparison_grams,
    fit_block,
    fit_twelve,
    own_equation,
    prior_of_twelve,
    readings_of,
    remove_other_effects,
    usable_samples,
)
from inflight.catalog import Catalog, Day, idempotency_key
from inflight.design import (
    ChannelSummary,
    DesignRows,
    Library,
    OutlierReport,
    Term,
    coarsen,
    design_gram,
    design_matrix,
    sensor_matrices,
)
from inflight.diagnosis import Features, Series, Stretches, features_of, pack_blocks, thin_rows
from inflight.dual import JumpAttribution, attribute_jumps
from inflight.effects import SpinningSensor, VectorSensor, channels_of
from inflight.errors import CalibrationError, WorkerError
from inflight.frames import GEOMETRY, add_geometry
from inflight.lsq import FactoredGrams, GramArrays, GramBlocks, parts_of, prewhiten
from inflight.mission import Mission, sensors_of
from inflight.model import Model, ModelEffect, RowFilter, make_effect, rows_of
from inflight.progress import Progress, silent, tell_each
from inflight.residual import NoiseFloor, floor_of_rows, join_floors
from inflight.samples import FOLDING_VERSION, Folding, parse_channel
from inflight.tasks.analysis.settings import DiagnoseSettings
from inflight.tasks.archive import (
    INPUT_SETTINGS,
    ArchiveIndex,
    ChannelReader,
    DerivedChannels,
    Need,
    as_variables,
    evenly_spread,
    load_samples,
    orbit_of,
    replacement_value,
)
from inflight.tasks.batches import give_back_memory, iter_results
from inflight.tasks.pipelines import (
    Job,
    Outcome,
    learns_states,
    make_days,
    register_outcome,
    reuse_interrupted_days,
)
from inflight.time import DAY, SECOND, day_bounds


def floor_of_samples(residual: Floats, good: np.ndarray, stamps: np.ndarray) -> dict[str, float]:
    """Return the white level of a day's residual, all rows together, as sums of squares over its samples."""
    level = floor_of_rows(residual, good, stamps)
    if not np.isfinite(level.level_nT):
        return {"floor_samples": 0.0, "floor": 0.0, "floor_low": 0.0, "floor_high": 0.0}
    return {
        "floor_samples": float(level.samples),
        "floor": level.samples * level.level_nT**2,
        "floor_low": level.samples * level.low_nT**2,
        "floor_high": level.samples * level.high_nT**2,
    }


def floor_of_turns(samples: xr.Dataset, good: np.ndarray, sectors: int) -> dict[str, float]:
    """Return what nature leaves in a day's synthetic turns, by the scatter of the turns they are made of."""
    noise = np.asarray(samples["noise"].values)
    used = good & np.isfinite(noise) & (samples["weight"].values > 0)
    total = float(samples["weight"].values[used].sum())
    if not total > 0:
        return {"floor_samples": 0.0, "floor": 0.0, "floor_low": 0.0, "floor_high": 0.0}
    square = float(np.sum((samples["weight"].values * noise**2)[used])) / total
    # Two rows an interval with a sine and a cosine at two harmonics each.
    unsure = 2.0 * np.sqrt(2.0 / (8.0 * max(used.sum() / sectors, 1.0)))
    count = float(used.sum())
    return {
        "floor_samples": count,
        "floor": count * square,
        "floor_low": count * square * max(1.0 - unsure, 0.0),
        "floor_high": count * square * (1.0 + unsure),
    }


def floor_of_reports(reports: Sequence[Mapping[str, Any]]) -> NoiseFloor:
    """Return the white level of several blocks together."""
    known = [report for report in reports if report.get("floor_samples")]
    return join_floors(
        [
            NoiseFloor(
                float(np.sqrt(report["floor"] / report["floor_samples"])),
                float(np.sqrt(report["floor_low"] / report["floor_samples"])),
                float(np.sqrt(report["floor_high"] / report["floor_samples"])),
                int(report["floor_samples"]),
            )
            for report in known
        ]
    )


#: Raised by hand when the numbers of the Gram blocks change; it is part of their key.
GRAM_VERSION = 27


@dataclass(frozen=True, kw_only=True)
class PassSettings:
    """How a span is divided, and what a survey reads.

    Attributes
    ----------
    geometry_gaps : float
        Days lose the bins without geometry when these are at most this part of them; assumed.
    series_rows : int
        Rows of the series up to which it has those of the Gram blocks, so that columns can be made of it: a
        bound on memory.
    thinned_rows : int
        Rows at most of the series of a longer record, which are means of several: a bound on memory.
    placebos : int
        Channels that get a placebo (MISSING_EFFECT 2.1: about 20).
    surveyed_days, surveyed_samples : int
        Days a survey reads, evenly spread, and samples of each that enter its fit: a bound on time, assumed.
    target_blocks, most_blocks : int
        Blocks that a record should have, and blocks of a long one at most (MISSING_EFFECT 2.2: 200).
    correlation_time_s, correlation_spans : float
        Correlation time the prewhitened form assumes, s (MISSING_EFFECT 2.2: 600 s), and so many of them at
        least in a span; assumed.
    cadences : tuple of (float, float)
        The library's cadence for spans of up to so many days, s: what keeps a pass in minutes, measured by
        benchmarks/search.py.
    steady : float
        A channel whose values spread by less than this part of their size does not change: rounding.
    rows : int
        A short record is not thinned below so many rows; assumed.
    short_days : int
        The span of a record of no more days is what was measured, not whole days; assumed.
    grown : float
        A record that grew to so many times the days it had is surveyed anew: all its blocks are made again,
        which costs less than the days since; assumed.
    longest_stretch_s : int
        A stretch between unexplained switchings is divided into these, s: offsets wander by hours; assumed.
    """

    geometry_gaps: float = 0.3
    series_rows: int = 450_000
    thinned_rows: int = 225_000
    placebos: int = 16
    surveyed_days: int = 12
    surveyed_samples: int = 20_000
    target_blocks: int = 96
    most_blocks: int = 200
    correlation_time_s: float = 600.0
    correlation_spans: float = 50.0
    cadences: tuple[tuple[float, float], ...] = (
        (2.0, 10.0),
        (20.0, 10.0),
        (70.0, 20.0),
        (150.0, 30.0),
        (np.inf, 60.0),
    )
    steady: float = 1e-9
    rows: int = 5000
    short_days: int = 3
    grown: float = 1.25
    longest_stretch_s: int = 3 * 3600


PASS_SETTINGS = PassSettings()

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


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What the blocks of a record share, found when it was surveyed.

    A record that is still the same is not surveyed again, nor is a long one that has grown: days that come
    later join its blocks.

    Attributes
    ----------
    model, mission : str
        sha256 of the model's text, with the version of the blocks, and of the mission's.
    cadence_ns : int
        The library's.
    first, days : str, int
        First day of the record surveyed, and how many it had: placebos of its first days are from its end.
    value : tuple of float
        Values of the nine parameters the residual is linearised at; empty where none are fitted.
    channels : mapping of str to ChannelSummary
        As of `Survey`.
    still : tuple of str
    surveyed : str
        sha256 of the revisions of the days that were read.
    """

    model: str
    mission: str
    cadence_ns: int
    first: str
    days: int
    value: tuple[float, ...]
    channels: Mapping[str, ChannelSummary]
    still: tuple[str, ...]
    surveyed: str = ""

    def as_json(self) -> str:
        """Return the text that `of_json` reads."""
        return json.dumps(
            {**vars(self), "channels": {name: vars(one) for name, one in self.channels.items()}}
        )

    @classmethod
    def of_json(cls, text: str) -> Origin:
        """Return the origin that a store of blocks holds."""
        found = json.loads(text)
        channels = {name: ChannelSummary(**one) for name, one in found["channels"].items()}
        return cls(
            **{**found, "channels": channels, "value": tuple(found["value"]), "still": tuple(found["still"])}
        )

    def holds_for(self, other: Origin) -> bool:
        """Return True when a record that is as `other` says before its survey may go on from here."""
        same = ["model", "mission", "cadence_ns", "first"]
        if self.days <= PASS_SETTINGS.most_blocks:
            same += ["days", "surveyed"]
        return all(getattr(self, name) == getattr(other, name) for name in same) and (
            self.days <= other.days <= self.days * PASS_SETTINGS.grown
        )


@dataclass(frozen=True, kw_only=True)
class PassPlan:
    """All a worker needs to make Gram blocks; no database behind it.

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
    correlation_time_s : float
        Correlation time of the prewhitened form.
    channel_summaries : mapping of str to ChannelSummary
    origin : Origin
    keep_bursts : bool
        Bursts are counted and stay in.
    stretches : Stretches, optional
        Each has a level of its own: something nobody recorded switches between them.
    estimates : bool
        Only what estimates are made from is kept: no prewhitened form, no noise floor, and no series of more
        rows than columns can be made of.
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
    correlation_time_s: float
    channel_summaries: Mapping[str, ChannelSummary]
    origin: Origin
    keep_bursts: bool = False
    stretches: Stretches | None = None
    estimates: bool = False

    @property
    def scale(self) -> list[float]:
        """Physical size of one unit of each column."""
        return [one for term in self.library.all_terms for one in term.scale]

    @property
    def series_step(self) -> int:
        """Bins that become one row of the series."""
        if self.folding is not None:
            return 1
        rows = -(-(self.span[1] - self.span[0]) // self.cadence_ns)
        return 1 if rows <= PASS_SETTINGS.series_rows else -(-rows // PASS_SETTINGS.thinned_rows)

    @property
    def keeps_series(self) -> bool:
        """Whether blocks have a part of the series."""
        return not self.estimates or (self.folding is None and self.series_step == 1)

    @property
    def folding(self) -> Folding | None:
        """How samples were folded; None of a comparison that folds nothing."""
        return self.model.layout.folding if self.model.layout is not None else None

    @property
    def row_filter(self) -> RowFilter | None:
        """The filter residuals and columns go through."""
        return (
            self.folding
            or self.stretches
            or (self.model.layout.band if self.model.layout is not None else None)
        )

    @property
    def geometry(self) -> tuple[str, ...]:
        """What rows need of the geometry: those of the series all of it."""
        used = {part.channel for name in self.library.channels if name for part in parse_channel(name).parts}
        return tuple(name for name in GEOMETRY if name in used or not self.estimates)

    @property
    def base(self) -> list[str]:
        """The calibration's own columns."""
        return [name for term in self.library.base for name in term.columns]

    @property
    def fits(self) -> int:
        """Days of a block at most: each is calibrated anew."""
        return max(len(block) for block in self.blocks)

    @property
    def reach(self) -> int:
        """Days before its own that a day's columns are made from: placebos have other days."""
        return 2 + int(max(self.library.placebos.values(), default=0.0) * SECOND // DAY)

    def read_for(self, blocks: Sequence[np.datetime64]) -> list[np.datetime64]:
        """Return all days that blocks, named by their first day, are made from."""
        wanted = set(blocks)
        own = {day for block in self.blocks if block[0] in wanted for day in block}
        places = {
            place - step if place >= step else self.origin.days + place - step
            for place, day in enumerate(self.days)
            if day in own
            for step in range(self.reach + 1)
        }
        return [self.days[place] for place in sorted(places) if 0 <= place < len(self.days)]

    @property
    def key(self) -> str:
        """sha256 of everything but the archive that the Gram blocks are made from."""
        parts = {
            "version": GRAM_VERSION,
            "folding": [FOLDING_VERSION, self.folding.interval_ns] if self.folding else None,
            "model": self.model.text,
            "columns": self.library.columns,
            "shifts": dict(self.library.placebos),
            "parts": self.parts,
            "cadence": self.cadence_ns,
            "memory": self.correlation_time_s,
            # A short record ends with its samples; a day of a longer one is the same whatever follows.
            "span": self.span if len(self.days) <= PASS_SETTINGS.short_days else self.series_step,
            # Days that are delivered again, the same, change no other day's blocks.
            "origin": replace(self.origin, surveyed="").as_json(),
            "keep_bursts": self.keep_bursts,
            "estimates": [self.keeps_series, *self.channel_summaries] if self.estimates else False,
            "stretches": [self.stretches.edges, self.stretches.lost] if self.stretches else None,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def gram_batch(cat: Catalog, mission: Mission, plan: PassPlan, job: Job) -> Outcome:
    """Make the Gram blocks of a batch and write it as one segment; blocks go by their first day."""
    comparison, index = plan.model.comparison, job.index
    reader = ChannelReader(
        cat,
        mission,
        plan.channel_needs,
        index,
        plan.cadence_ns,
        plan.span,
        comparison,
        by_levels=learns_states(mission, comparison),
        # At the native cadence a day is large, and no placebo needs others.
        kept_days=min(plan.reach + 1, INPUT_SETTINGS.cached_days),
    )
    derived = DerivedChannels(
        reader, plan.days, plan.channel_summaries, plan.library.placebos, plan.origin.days
    )
    days_of = {block[0]: block for block in plan.blocks}

    outcome = make_days(cat, job, lambda day: block_grams(cat, mission, plan, index, derived, days_of[day]))
    if plan.estimates:
        # Days at the native cadence are large, and the search is held in memory beside them. From one to the
        # next the memory is used again: fetching it anew each time costs a sixth of all the work.
        give_back_memory()
    return outcome


def block_grams(
    cat: Catalog,
    mission: Mission,
    plan: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    days: Sequence[np.datetime64],
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the Gram blocks of some days (or of the blocks of a day), and sums over its samples."""
    # A day's rows are dropped before the next is read: at the native cadence they are large.
    raws, whites, sums, features, thinned = [], [], dict[str, Any](), None, []
    for day in days:
        raw, day_white, rows, more = day_grams(cat, mission, plan, index, derived, day)
        raws.append(raw)
        sums = {name: sums[name] + value for name, value in more.items()} if sums else dict(more)
        if not plan.keeps_series:
            del rows
            continue
        if day_white is not None:
            whites.append(day_white)
        recorded = derived.reader.day(day)
        if plan.estimates:
            rows = _with_sources(mission, rows, recorded)
        rows = _with_gaps(rows, recorded)
        if plan.series_step > 1 and rows.row_filter is None:
            base = design_matrix(plan.library.base, rows)
            rows = replace(rows, averaged={name: base[:, :, at] for at, name in enumerate(plan.base)})
        features = features or features_of(rows, _series_channels(plan))
        thinned.append(thin_rows(rows, features, plan.series_step))
    blocks = raws[0].merged(raws[1:], plan.fits)
    dataset = blocks.as_dataset().assign_attrs(cadence_ns=plan.cadence_ns, origin=plan.origin.as_json())
    if whites:
        own = whites[0].merged(whites[1:]).in_one_fit().as_dataset().rename(fit="white_fit")
        dataset = dataset.assign({f"white_{name}": own[name] for name in ("rest", "given") if name in own})
    if features is None:
        return dataset, sums
    series = _packed_series(plan, blocks, thinned)
    dataset["series"] = (("block", "sample", "feature"), series, {"features": features.as_json()})
    return dataset, sums


def _with_gaps(rows: DesignRows, recorded: Mapping[str, Floats]) -> DesignRows:
    """Return rows whose channels are NaN where they were not recorded."""
    # Variables, not data arrays: for dozens of channels a day xarray would align each with all.
    held = rows.samples.variables
    known = {
        name: held[name].copy(deep=False, data=values)
        for name, values in recorded.items()
        if name in held and held[name].shape == values.shape and not np.array_equal(held[name].values, values)
    }
    return replace(rows, samples=rows.samples.assign(known)) if known else rows


def _with_sources(mission: Mission, rows: DesignRows, recorded: Mapping[str, Floats]) -> DesignRows:
    """Return rows with the channels that others are derived from: columns are made again from the series."""
    absent = {name: values for name, values in recorded.items() if name not in rows.samples}
    return replace(rows, samples=rows.samples.assign(as_variables(mission, absent, None)))


def _series_channels(plan: PassPlan) -> list[str]:
    """Return the channels that the coarse series holds."""
    plain = [name for name in plan.library.channels if name and not set(name) & set("@~*")]
    return list(dict.fromkeys([*plan.channel_summaries, *plain, *GEOMETRY]))


def _packed_series(
    plan: PassPlan, raw: GramBlocks, thinned: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Return the coarse series of a block (or of the blocks of a day) as one array."""
    stamps = np.concatenate([part[0] for part in thinned])
    values = np.concatenate([part[1] for part in thinned])
    days = max(len(block) for block in plan.blocks)
    samples = -(-DAY // (plan.cadence_ns * plan.series_step)) * days // plan.parts + 2
    record = plan.span[1] - plan.span[0]
    samples = min(samples, record // (plan.cadence_ns * plan.series_step) + 2)
    return pack_blocks(stamps, values, [*raw.start.tolist(), int(raw.end[-1])], int(samples))


def day_grams(
    cat: Catalog,
    mission: Mission,
    plan: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    day: np.datetime64,
) -> tuple[FactoredGrams, FactoredGrams | None, DesignRows, dict[str, Any]]:
    """Return a day's blocks, raw and prewhitened (None of estimates), its rows, and sums over its samples."""
    rows, sums = day_rows(cat, mission, plan, index, derived, day)
    stamps = rows.samples["tt2000"].values
    edges = derived.reader.edges(day)
    bounds = [int(edges[0] + part * (edges[-1] - edges[0]) // plan.parts) for part in range(plan.parts + 1)]
    # The last bin of a day with a leap second reaches into the next day, which is a block's of its own.
    bounds[-1] = min(bounds[-1], day_bounds(day)[1])
    parts = parts_of(stamps, bounds)
    names, scale = (*plan.library.columns, "residual"), np.array([*plan.scale, 1.0])
    span = np.array(bounds[:-1], dtype=np.int64), np.array(bounds[1:], dtype=np.int64)
    if plan.estimates:
        # Of the model and what was found: few columns, of many rows, in double precision.
        gram = design_gram(plan.library.all_terms, rows, parts)
        count = np.array([rows.weight[part].sum() * rows.residual.shape[1] for part in parts])
        return FactoredGrams.of(GramArrays(names, gram, *span, count, scale), plan.base), None, rows, sums

    def blocks(columns: Floats, residual: Floats) -> FactoredGrams:
        return FactoredGrams.of_rows(names, columns, residual, rows.weight, parts, span, scale, plan.base)

    columns, residual = design_matrix(plan.library.all_terms, rows), rows.residual[:, :, None]
    raw = blocks(columns, residual)
    columns, residual = (
        prewhiten(one, rows.weight, stamps, plan.correlation_time_s) for one in (columns, residual)
    )
    prewhitened = blocks(columns, residual)
    return raw, prewhitened, rows, sums


def day_rows(
    cat: Catalog,
    mission: Mission,
    plan: PassPlan,
    index: ArchiveIndex,
    derived: DerivedChannels,
    day: np.datetime64,
) -> tuple[DesignRows, dict[str, Any]]:
    """Return a day's rows on the library's cadence, and sums over its native samples."""
    samples = load_samples(cat, mission, plan.model, day, list(plan.needs), index, geometry=False)
    native = rows_of(plan.model, samples)
    if plan.stretches is not None:
        lost = plan.stretches.is_lost(samples["tt2000"].values)
        native = replace(native, good=native.good & ~lost)
    if plan.folding is not None:
        # What a sensor reads that turns in the steady field: effects are linearised there.
        steady = samples.assign(vector=(samples["vector"].dims, native.field, samples["vector"].attrs))
        samples = samples.assign(vector=plan.model.disturb(steady)["vector"])
    start, end = day_bounds(day)
    geometry = _geometry(mission, derived.reader, day, samples, plan.geometry)
    there = {name: np.asarray(geometry[name].values) for name in GEOMETRY if name in geometry}
    values = derived.of_day(day, plan.library.channels, there)
    variables = as_variables(mission, values, geometry if there else None)
    edges = derived.reader.edges(day)
    matrices = sensor_matrices(plan.model, (start + end) // 2)
    recorded = derived.reader.day(day)
    rows, sums = coarsen(samples, native, edges, variables, matrices, recorded, plan.keep_bursts)
    rows = replace(rows, weight=np.where(_without_geometry(there, rows.weight > 0), 0.0, rows.weight))
    if plan.stretches is not None:
        # The residual is relative to its stretch; rows in none have no weight.
        stamps = rows.samples["tt2000"].values
        weight = np.where(plan.stretches.is_lost(stamps), 0.0, rows.weight)
        residual = np.nan_to_num(plan.stretches.keep(rows.residual, stamps, weight > 0))
        rows = replace(rows, residual=residual, weight=weight, row_filter=plan.stretches)
    if plan.estimates:
        return rows, sums
    if plan.folding is None:
        sums |= floor_of_samples(native.residual, native.good, samples["tt2000"].values)
    else:
        sums |= floor_of_turns(samples, native.good, plan.folding.sectors)
    return rows, sums


def _without_geometry(geometry: Mapping[str, Floats], used: np.ndarray) -> np.ndarray:
    """Return which bins have no geometry, when most have: a missing one must not pass for a shadow."""
    out = np.zeros(used.size, dtype=bool)
    for values in geometry.values():
        missing = ~np.isfinite(values.reshape(used.size, -1)).all(axis=1)
        if (missing & used).sum() <= PASS_SETTINGS.geometry_gaps * max(used.sum(), 1):
            out |= missing
    return out


def _geometry(
    mission: Mission, reader: ChannelReader, day: np.datetime64, samples: xr.Dataset, names: Sequence[str]
) -> xr.Dataset:
    """Return what is named of the geometry of a day's bins, from position and attitude."""
    if not names:
        return xr.Dataset()
    data = orbit_of(mission, reader, day)
    bins = data["tt2000"].size
    for role in ("vector", "outboard"):
        if role in samples:
            attrs = {"orientation": samples[role].attrs.get("orientation", (0.0, 0.0, 0.0, 1.0))}
            data[role] = xr.Variable(("time", "axis"), np.zeros((bins, 3)), attrs)
            break
    found = add_geometry(xr.Dataset(data), names)
    return found.drop_vars([name for name in ("position", "attitude", "vector", "outboard") if name in found])


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """Gram blocks of a span, series, sums and outliers.

    Attributes
    ----------
    read_white : callable
        Reads the prewhitened blocks: of some columns beside the calibration's, or with None of all. A search
        needs all; who changes a model needs the variance of a row, and neither unpacks nor holds the matrices
        of all columns.
    """

    raw: FactoredGrams
    read_white: Callable[[Collection[str] | None], FactoredGrams]
    series: Series
    sums: Mapping[str, float]
    floor: NoiseFloor
    outliers: OutlierReport

    @cached_property
    def white(self) -> FactoredGrams:
        """The prewhitened blocks of all columns."""
        return self.read_white(None)

    @cached_property
    def white_of_base(self) -> FactoredGrams:
        """The prewhitened blocks of the calibration's columns."""
        return self.white if "white" in vars(self) else self.read_white(())

    def with_raw(self, raw: FactoredGrams) -> Loaded:
        """Return the same with other blocks as they are; what was read of the prewhitened ones is kept."""
        other = replace(self, raw=raw)
        vars(other).update({name: blocks for name, blocks in vars(self).items() if name in _READ_LATER})
        return other


#: What `Loaded` reads when it is asked for.
_READ_LATER = ("white", "white_of_base")
#: Variables of every form of the blocks.
_BLOCKS = ("start", "end", "count")


def load_grams(cat: Catalog, plan: PassPlan, days: Sequence[Day], progress: Progress = silent) -> Loaded:
    """Read Gram blocks, in order of time."""
    names, scale = (*plan.library.columns, "residual"), np.array([*plan.scale, 1.0])
    ordered = sorted(days, key=lambda day: day.day)
    blocks = sum(day.count for day in ordered)
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    features: list[Features] = []

    given = ["given"] if plan.base else []

    def raw_parts() -> Iterator[xr.Dataset]:
        for day in tell_each(progress, "blocks", ordered):
            part = cat.read(day, [*_BLOCKS, "rest", *given, "begins", "series"])
            kept.append((part["series"].values, part["start"].values))
            features.append(Features.of_json(part["series"].attrs["features"]))
            yield part

    def white_parts() -> Iterator[xr.Dataset]:
        for day in tell_each(progress, "blocks", ordered):
            part = cat.read(day, [*_BLOCKS, "white_rest", *(f"white_{name}" for name in given)])
            part = part.rename({f"white_{name}": name for name in ("rest", *given)})
            yield part.assign(begins=(("block", "white_fit"), part["start"].values[:, None]))

    def read_white(columns: Collection[str] | None) -> FactoredGrams:
        white = FactoredGrams.read(white_parts(), blocks, names, scale, plan.base, columns)
        give_back_memory()
        return white

    raw = FactoredGrams.read(raw_parts(), blocks, names, scale, plan.base)
    series = _joined_series(plan, kept, features[0])
    sums = {
        name: sum(float(day.report[name]) for day in ordered)
        for name in ("count", "square", "inside", "spikes")
    }
    return Loaded(
        raw=raw,
        read_white=read_white,
        series=series,
        sums=sums,
        floor=floor_of_reports([day.report for day in ordered]),
        outliers=OutlierReport.of([day.report for day in ordered], plan.keep_bursts),
    )


def _joined_series(
    plan: PassPlan, parts: Sequence[tuple[np.ndarray, np.ndarray]], features: Features
) -> Series:
    """Return the series of the blocks of a plan; parts are packed values and starts."""
    packed, starts = (np.concatenate(one) for one in zip(*parts, strict=True))
    filled = {need.name: replacement_value(plan.channel_summaries, need.name) for need in plan.channel_needs}
    return replace(Series.of(packed, starts, features, filled), row_filter=plan.row_filter)


def load_estimate_grams(
    cat: Catalog, plan: PassPlan, days: Sequence[Day], progress: Progress = silent
) -> tuple[FactoredGrams, Series | None]:
    """Read the Gram blocks of a plan of estimates and its series, if it has one, in order of time."""
    names, scale = (*plan.library.columns, "residual"), np.array([*plan.scale, 1.0])
    ordered = sorted(days, key=lambda day: day.day)
    wanted = [*_BLOCKS, "rest", *(["given"] if plan.base else []), "begins"]
    wanted += ["series"] if plan.keeps_series else []
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    features: list[Features] = []

    def parts() -> Iterator[xr.Dataset]:
        for day in tell_each(progress, "blocks", ordered):
            part = cat.read(day, wanted)
            if plan.keeps_series:
                kept.append((part["series"].values, part["start"].values))
                features.append(Features.of_json(part["series"].attrs["features"]))
            yield part

    raw = FactoredGrams.read(parts(), sum(day.count for day in ordered), names, scale, plan.base)
    return raw, _joined_series(plan, kept, features[0]) if kept else None


def make_blocks(
    cat: Catalog,
    mission: Mission,
    plan: PassPlan,
    index: ArchiveIndex,
    base: Need,
    settings: DiagnoseSettings,
    context: str,
    dataset: str,
    client: Any,
    report_progress: Progress,
) -> tuple[str, list[Day], Mapping[np.datetime64, str]]:
    """Make the blocks that are missing or out of date; return the run, all blocks' days, and what failed.

    Blocks go by their first day; what failed by it, too, with the reason.
    """
    keys, parents = {}, {}
    for block in plan.blocks:
        sources = [
            source for day in block for source in index.sources([*plan.needs, *plan.channel_needs], day, base)
        ]
        unique = sorted({source.key for source in sources})
        keys[block[0]] = idempotency_key(dataset, block[0], 0, context, [plan.key, *unique])
        parents[block[0]] = tuple(sorted({source.id for source in sources}))
    there = {day.day: day for day in cat.days(dataset, states=("published",))}
    kept = {day: there[day] for day in keys if day in there and there[day].key == keys[day]}
    todo = [block[0] for block in plan.blocks if block[0] not in kept]
    if not todo:
        return "", [kept[day] for day in sorted(kept)], {}
    planned = {"days_planned": len(todo)}
    with cat.run("diagnose", {**settings.model_dump(), **planned}, context=context) as run:
        kept |= reuse_interrupted_days(run, dataset, keys, todo)
        todo = [day for day in todo if day not in kept]
        size = settings.batch_blocks
        batches = [tuple(todo[at : at + size]) for at in range(0, len(todo), size)]
        jobs = [
            Job(
                batch,
                {day: keys[day] for day in batch},
                {day: parents[day] for day in batch},
                index.around(plan.read_for(batch)),
                plan.needs,
                run.id,
                dataset,
            )
            for batch in batches
        ]
        report_progress("pass", 0, len(todo))
        done = 0
        failed: dict[np.datetime64, dict[str, str]] = {}
        for job, outcome in zip(
            jobs,
            iter_results(client, gram_batch, [(cat, mission, plan, job) for job in jobs]),
            strict=True,
        ):
            kept |= {day.day: day for day in register_outcome(run, dataset, outcome, failed)}
            done += len(job.days)
            report_progress("pass", done, len(todo))
        if not kept:
            raise WorkerError(
                f"no block of the span could be made; the first: {next(iter(failed.values()))['message']}",
                remedy="see the message; 'inflight compare' shows single days",
            )
        run.publish(supersede=True)
        reasons = {day: failure["message"] for day, failure in failed.items()}
        return run.id, [kept[day] for day in sorted(kept)], reasons


@dataclass(frozen=True)
class Survey:
    """What is known before the pass.

    Attributes
    ----------
    model : Model
        The present model at the values the residual is linearised at.
    base : tuple of Term
        What each calibration interval fits anew.
    fixed : tuple of Term
        Parameters of the vector sensor that the model holds fixed: candidates like any other.
    channels : dict of str to ChannelSummary
        Every channel of one number a time that changes.
    still : tuple of str
        Channels that do not change in the span.
    value : tuple of float
        Values of the nine parameters the residual is linearised at; empty where none are fitted.
    """

    model: Model
    base: tuple[Term, ...]
    fixed: tuple[Term, ...]
    channels: Mapping[str, ChannelSummary]
    still: tuple[str, ...]
    value: tuple[float, ...] = ()


def survey(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
    reader: ChannelReader,
    origin: Origin | None = None,
) -> Survey:
    """Read some days of the span: linearise the residual, summarise the channels.

    Parameters
    ----------
    origin : Origin, optional
        What an earlier survey of the record found; nothing is read then.

    Raises
    ------
    CalibrationError
        When no day has enough usable samples.
    """
    some = evenly_spread(days, PASS_SETTINGS.surveyed_days)
    known = None if origin is None else np.asarray(origin.value)
    fitted, base, fixed, value = _linearised(cat, mission, model, needs, index, some, known)
    if origin is not None:
        return Survey(fitted, base, fixed, origin.channels, origin.still, value)
    changing, still, kinds = {}, [], channels_of(mission)
    read = {day: reader.day(day) for day in some}
    for name in reader.scalars:
        values = np.concatenate([read[day][name] for day in some])
        finite = values[np.isfinite(values)]
        if finite.size < 2:
            still.append(name)
            continue
        low, high = np.quantile(finite, [0.05, 0.95])
        spread = float(high - low) or float(np.ptp(finite))
        if spread <= PASS_SETTINGS.steady * max(float(np.abs(finite).max()), 1e-300):
            still.append(name)
            continue
        changing[name] = ChannelSummary(
            float(finite.mean()), spread, 1.0 - finite.size / values.size, kinds[name].kind
        )
    return Survey(fitted, base, fixed, changing, tuple(still), value)


def _linearised(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
    known: Floats | None = None,
) -> tuple[Model, tuple[Term, ...], tuple[Term, ...], tuple[float, ...]]:
    """Return the model at its fitted nine parameters, the terms of these, and their values if any.

    `known` are these values from an earlier survey.
    """
    kind = mission.comparisons[model.comparison].kind
    if kind == "spin":
        return *_linearised_spin(cat, mission, model, needs, index, days), ()
    if kind == "platform":
        return model, (), (), ()
    if kind == "dual":
        # A matrix and a shift between two vector sensors: what their difference leaves to calibration.
        return model, (_calibration_term(mission, model, "inboard", "affine", ("matrix", "shift")),), (), ()
    if kind == "field_model":
        return _linearised_affine(cat, mission, model, needs, index, days, known)
    own = [entry for entry in model.effects if isinstance(entry.effect, VectorSensor)]
    if not own:
        term = _calibration_term(mission, model, "vector", "vector_sensor", PARAMETER_GROUPS)
        return model, (term,), (), ()
    middle = sum(day_bounds(days[len(days) // 2])) // 2
    prior = prior_of(own[0], middle)
    value = known if known is not None else _fitted_value(cat, mission, model, needs, index, days, prior)
    sigmas = dict(zip(PARAMETER_GROUPS, prior.sigma.reshape(-1, 3), strict=True))
    fitted = {
        part: replace(
            own[0].parameters[part],
            time="constant",
            value=three[:, None],
            sigma=own[0].parameters[part].sigma[:, :1],
            table=None,
        )
        for part, three in zip(PARAMETER_GROUPS, value.reshape(-1, 3), strict=True)
    }
    entry = replace(own[0], parameters={**own[0].parameters, **fitted})
    base = [
        Term(entry.name, entry, (part,), tuple(sigma.tolist()))
        for part, sigma in sigmas.items()
        if np.any(sigma > 0)
    ]
    fixed = [
        Term(entry.name, entry, (part,), (np.inf,) * 3)
        for part, sigma in sigmas.items()
        if not np.any(sigma > 0)
    ]
    effects = tuple(entry if one is own[0] else one for one in model.effects)
    return replace(model, effects=effects), tuple(base), tuple(fixed), tuple(value.tolist())


def _linearised_affine(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
    known: Floats | None,
) -> tuple[Model, tuple[Term, ...], tuple[Term, ...], tuple[float, ...]]:
    """Return the model at the matrix and shift that some days give, their terms, and their values."""
    own, middle = own_equation(model), sum(day_bounds(days[len(days) // 2])) // 2
    start, sigma = prior_of_twelve(model, middle)
    value = known
    if value is None:
        grams = []
        for day in days:
            samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
            reading, reference, good = readings_of(model, samples)
            nothing = np.zeros((len(reading), 3, 3))
            grams.append(comparison_grams(reading, reference, nothing, good, (start, sigma)))
        value = fit_twelve(np.concatenate(grams), start, sigma).value
    parts = {"matrix": slice(0, 9), "shift": slice(9, 12)}
    fitted = {
        part: replace(
            own.parameters[part],
            time="constant",
            value=value[places, None],
            sigma=own.parameters[part].sigma[:, :1],
            table=None,
        )
        for part, places in parts.items()
    }
    entry = replace(own, parameters={**own.parameters, **fitted})
    terms = [
        Term(entry.name, entry, (part,), tuple(sigma[places].tolist() if free else [np.inf] * size))
        for part, places in parts.items()
        for free, size in [(bool(np.any(sigma[places] > 0)), len(value[places]))]
    ]
    base = [term for term, places in zip(terms, parts.values(), strict=True) if np.any(sigma[places] > 0)]
    fixed = [term for term in terms if term not in base]
    effects = tuple(entry if one is own else one for one in model.effects)
    return replace(model, effects=effects), tuple(base), tuple(fixed), tuple(value.tolist())


def _fitted_value(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
    prior: ParameterPrior,
) -> Floats:
    """Return the nine parameters that fit some days, those at which the prior holds them otherwise."""
    parts = [_thinned_samples(cat, mission, model, day, needs, index) for day in days]
    whole = [np.concatenate(one) for one in zip(*parts, strict=True)]
    if whole[3].sum() < 2 * prior.value.size:
        raise CalibrationError(
            f"{int(whole[3].sum())} usable samples on {len(days)} days looked at",
            remedy="see 'inflight catalog gaps' and the flags of the deliveries",
        )
    if not np.any(prior.sigma > 0):
        return prior.value
    return fit_block(whole[0], whole[1], whole[2], whole[3], prior).value


def _linearised_spin(
    cat: Catalog,
    mission: Mission,
    model: Model,
    needs: Sequence[Need],
    index: ArchiveIndex,
    days: Sequence[np.datetime64],
) -> tuple[Model, tuple[Term, ...], tuple[Term, ...]]:
    """Return the model at its fitted parameters of the spin, and their terms."""
    from inflight.spin import fit_folded_samples, spinning_sensor_of  # compiled: others do not wait for it

    own = spinning_sensor_of(model)
    if own is None:
        sensors = sensors_of(mission, model.comparison)
        vector = next(iter(sensors.values()))
        extra = {"effect": "spinning_sensor", "name": "calibration", "sensor": vector.name}
        model = model.add(make_effect(extra, sensors))
    folded = [load_samples(cat, mission, model, day, list(needs), index, geometry=False) for day in days]
    model = fit_folded_samples(model, folded).model
    entry = spinning_sensor_of(model)
    assert entry is not None
    base, fixed = [], []
    for name in SpinningSensor.SPIN_RELATED:
        timed = entry.parameters[name]
        if timed.free:
            kinds = SpinningSensor.parameters()[name]
            known = np.where(np.isfinite(timed.sigma[:, 0]), timed.sigma[:, 0], kinds.sigma)
            base.append(Term(entry.name, entry, (name,), tuple(known.tolist())))
        else:
            fixed.append(Term(entry.name, entry, (name,), (np.inf,) * timed.parameter.size))
    return model, tuple(base), tuple(fixed)


def prior_of(entry: ModelEffect, tt2000: int) -> ParameterPrior:
    """Return values and prior sigmas of the nine parameters; 0 for those the model holds fixed."""
    timed = [entry.parameters[part] for part in PARAMETER_GROUPS]
    kinds = VectorSensor.parameters()
    sigma = [
        np.where(np.isfinite(one.sigma[:, 0]), one.sigma[:, 0], kinds[part].sigma)
        if one.free
        else np.zeros(3)
        for part, one in zip(PARAMETER_GROUPS, timed, strict=True)
    ]
    return ParameterPrior(
        np.concatenate([one.at(tt2000) for one in timed]), np.concatenate(sigma), entry.name
    )


def _calibration_term(
    mission: Mission, model: Model, role: str, effect: str, parameters: Sequence[str]
) -> Term:
    """Return free parameters of a calibration that the model has not itself, of the sensor of a role."""
    sensors = sensors_of(mission, model.comparison)
    sensor = next(sensor for sensor in sensors.values() if sensor.role == role)
    entry = make_effect({"effect": effect, "name": "calibration", "sensor": sensor.name}, sensors)
    size = sum(entry.effect.parameters()[name].size for name in parameters)
    return Term("calibration", entry, tuple(parameters), (np.inf,) * size)


def _thinned_samples(
    cat: Catalog,
    mission: Mission,
    model: Model,
    day: np.datetime64,
    needs: Sequence[Need],
    index: ArchiveIndex,
) -> tuple[Floats, Floats, Floats, np.ndarray]:
    samples = load_samples(cat, mission, model, day, list(needs), index, geometry=False)
    reading, additive, scalar = remove_other_effects(model, samples)
    good = usable_samples(samples, reading, additive, scalar)
    step = max(1, len(reading) // PASS_SETTINGS.surveyed_samples)
    additive = np.broadcast_to(additive, reading.shape)
    return reading[::step], additive[::step], scalar[::step], good[::step]


def cadence_for(span_ns: int, native_ns: int) -> int:
    """Return the library's cadence for a span: native when it is slow or the record short, nanoseconds."""
    usual = next(seconds for days, seconds in PASS_SETTINGS.cadences if span_ns <= days * DAY) * SECOND
    return native_ns * max(1, int(min(usual, span_ns / PASS_SETTINGS.rows) // native_ns))


def block_parts(days: int, span_ns: int, orbit_ns: int | None) -> tuple[int, int]:
    """Return parts of a day and days of a block.

    A block of a short span is a part of a day, of an orbit or more where one is known; of a long one,
    some days: a power of two of them, so that blocks stay where they are while a record grows.
    """
    if days > PASS_SETTINGS.most_blocks:
        return 1, 2 ** int(np.ceil(np.log2(days / PASS_SETTINGS.most_blocks)))
    day_ns = span_ns / days
    most = max(1, int(day_ns // orbit_ns)) if orbit_ns and day_ns > orbit_ns else 10**6
    return int(np.clip(-(-PASS_SETTINGS.target_blocks // days), 1, most)), 1


def placebo_shifts(found: Survey, orbit: int | None, length: int) -> dict[str, float]:
    """Return the shift of each placebo, s: a day or more and part of an orbit, or part of the record."""
    generator = np.random.default_rng(20_000)
    names = sorted(found.channels)
    chosen = (
        [
            names[place]
            for place in np.unique(np.linspace(0, len(names) - 1, PASS_SETTINGS.placebos).round().astype(int))
        ]
        if names
        else []
    )
    period = orbit or DAY
    out = {}
    for name in chosen:
        part = generator.uniform(0.15, 0.85)
        if length >= 4 * DAY and length >= 4 * period:
            shift = float((generator.integers(1, 3) * DAY + part * period) / SECOND)
        else:
            shift = generator.uniform(0.25, 0.75) * length / SECOND
        out[f"{name}~1"] = shift
    return out


def find_switchings(mission: Mission, plan: PassPlan, series: Series) -> JumpAttribution | None:
    """Return the switchings in the residual of a pass without stretches.

    Parameters
    ----------
    series : Series
        Of that pass; its residual is the difference of both sensors less what the model explains.

    Returns
    -------
    Switched or None
        None of another comparison than one of two sensors on one boom, or when there are none.
    """
    if not learns_states(mission, plan.model.comparison):
        return None
    from inflight.tasks.pipelines.two_sensor import housekeeping_channels  # compiled, as above

    residual = series["residual"].reshape(len(series.tt2000), -1)
    there = (series["weight"] > 0) & np.asarray(np.isfinite(residual).all(axis=1))
    names = [name for name in housekeeping_channels(mission) if name in series.channels]
    channels = {}
    for name in names:
        values = series[name].copy()
        if name in series.missing:
            values[series.missing[name]] = np.nan
        channels[name] = values[there]
    row_ns = series.step_s * SECOND
    cadence = {need.name: need.cadence_ns for need in plan.channel_needs}
    reach = {name: int(np.ceil(cadence[name] / row_ns)) + 1 for name in names}
    return attribute_jumps(series.tt2000[there], residual[there], channels, reach)


def stretches_between(found: JumpAttribution, plan: PassPlan) -> Stretches:
    """Return the stretches between switchings that no channel follows, and what belongs to none.

    A channel is late or early by some of its own cadence: around every switching the residual holds what
    the channel does not show, in proportion to the field that the calibration rests on. These rows are left
    out. Offsets wander by hours, which no scatter between blocks shows: no stretch is longer than some of
    them.
    """
    half = plan.cadence_ns * plan.series_step // 2
    lost = tuple(zip((found.last + half).tolist(), (found.first - half).tolist(), strict=True))
    step = PASS_SETTINGS.longest_stretch_s * SECOND
    regular = [at for day in plan.days for at in range(day_bounds(day)[0], day_bounds(day)[1], step)]
    middle = found.last + (found.first - found.last) // 2
    return Stretches(tuple(sorted({*regular, *middle[~found.follows].tolist()})), lost)
