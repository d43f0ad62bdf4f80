"""Which physical effect is missing: plan, pass, search, verdict.

Takes a catalog, a mission and a span; makes a `Diagnosis` (`diagnose`). The steps are `plan_pass` (survey
the span, linearise the model, decide what is tried), `make_pass` (make or find the Gram blocks),
`begin_search` and `diagnosis_data` (what `inflight.diagnosis.run_search` takes). Who keeps what was found, or
draws it, takes the same steps with a workbench (`inflight.tasks.analysis.revise`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np

from inflight.catalog import Catalog
from inflight.design import BURST_SETTINGS
from inflight.diagnosis import (
    Diagnosis,
    DiagnosisData,
    Rules,
    Search,
    make_library,
    run_search,
    time_variable_columns,
)
from inflight.dual import JumpAttribution
from inflight.effects import channels_of, position_channel
from inflight.frames import GEOMETRY
from inflight.mission import Mission
from inflight.model import folding_of
from inflight.progress import Progress, silent
from inflight.tasks.analysis.gram_pass import (
    GRAM_VERSION,
    PASS_SETTINGS,
    Loaded,
    Origin,
    PassPlan,
    Survey,
    block_parts,
    cadence_for,
    find_switchings,
    load_grams,
    make_blocks,
    placebo_shifts,
    stretches_between,
    survey,
)
from inflight.tasks.analysis.native_estimate import NativeEstimator
from inflight.tasks.analysis.plumbing import faults_in_errors, faults_of
from inflight.tasks.analysis.settings import DiagnoseSettings
from inflight.tasks.archive import (
    ArchiveIndex,
    ChannelReader,
    Need,
    base_role,
    channel_needs,
    evenly_spread,
    needs_of,
    require_days,
    resolves_spin,
)
from inflight.tasks.batches import end_processes, give_back_memory
from inflight.tasks.models import VersionedModel, current_model
from inflight.tasks.pipelines import learns_states, trend_of_products
from inflight.threads import one_thread
from inflight.time import DAY, SECOND, DayLike, day_bounds


@dataclass(frozen=True, kw_only=True)
class PassResult:
    """A pass that has been made: what the search reads.

    `failed` are the days that are in no block, and why; `switched` are switchings that two sensors show.
    """

    plan: PassPlan
    used: VersionedModel
    survey: Survey
    loaded: Loaded
    context: str
    run: str
    failed: Mapping[np.datetime64, str]
    index: ArchiveIndex
    base: Need
    switched: JumpAttribution | None = None


def diagnose(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: DiagnoseSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find out which physical effect is missing from a mission's present model; the verdict is not kept.

    Parameters
    ----------
    start, end : UTC date, optional
        Half-open span of days; the whole archive when absent.
    client : distributed.Client, optional
        The pass runs on it.
    progress : callable, optional
        Called with (stage, done, total).

    Raises
    ------
    MissionError, ModelError, CatalogError, CalibrationError
        When there is nothing to work on, or the model does not fit the mission.
    """
    settings = settings or DiagnoseSettings()
    report_progress = progress or silent
    faults = faults_of(cat, mission, start, end, settings.comparison)
    with faults_in_errors(faults):
        made = make_pass(cat, mission, start, end, settings, client=client, progress=progress)
    search, data = begin_search(made, settings), diagnosis_data(made, mission)
    native = native_estimator(cat, mission, made, settings, client, report_progress)
    # Columns that join make new Gram blocks, gigabytes of them: nothing here may hold on to the first ones.
    del made
    found, _ = search_on_one_thread(search, data, native, report_progress)
    trend = trend_of_products(cat, settings.comparison, data.model.version, start, end)
    return found.after_plumbing(faults).with_products(trend)


class Examined(NamedTuple):
    """A finished search, and all that its page is made from: arguments of `diagnosis_sections`."""

    search: Search
    data: DiagnosisData
    found: Diagnosis
    settings: DiagnoseSettings
    #: Further lines of the page's ledger.
    facts: Mapping[str, Any]


def make_pass(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None,
    end: DayLike | None,
    settings: DiagnoseSettings,
    *,
    client: Any = None,
    progress: Progress | None = None,
    used: VersionedModel | None = None,
    narrow: Callable[[PassPlan], PassPlan] | None = None,
) -> PassResult:
    """Make or find the Gram blocks of a span and a model, by default the present one.

    Parameters
    ----------
    narrow : callable, optional
        Makes of the plan one of fewer columns; its Gram blocks are stored in a dataset of their own.
    """
    report_progress = progress or silent
    with one_thread():
        planned = plan_pass(cat, mission, settings, start, end, used, report_progress)
    plan = narrow(planned.plan) if narrow else planned.plan
    context = cat.save_context(mission.text, planned.used.model.name, planned.used.version, {})
    dataset = f"equations/{settings.comparison}/{'own' if narrow else 'library'}"

    def make() -> tuple[str, Mapping[np.datetime64, str], Loaded]:
        run, blocks, failed = make_blocks(
            cat,
            mission,
            plan,
            planned.index,
            planned.base,
            settings,
            context,
            dataset,
            client,
            report_progress,
        )
        # What follows needs the memory; where blocks are made again, other processes start.
        end_processes(client)
        loaded = load_grams(cat, plan, blocks, report_progress)
        give_back_memory()
        return run, failed, loaded

    run, failed, loaded = make()
    if loaded.outliers.share > BURST_SETTINGS.largest_share:
        # So much of a span is no outlier: the Gram blocks with it are stored apart from those without.
        plan, dataset = replace(plan, keep_bursts=True), f"{dataset}-bursts"
        run, failed, loaded = make()
    switched = find_switchings(mission, plan, loaded.series)
    if switched is not None:
        # Rows at switchings are left out, and the levels between those that nobody recorded are free.
        plan = replace(plan, stretches=stretches_between(switched, plan))
        dataset = f"{dataset}-stretches"
        run, failed, loaded = make()
    return PassResult(
        plan=plan,
        used=planned.used,
        survey=planned.survey,
        loaded=loaded,
        context=context,
        run=run,
        failed={day: failed[block[0]] for block in plan.blocks if block[0] in failed for day in block},
        index=planned.index,
        base=planned.base,
        switched=switched,
    )


@dataclass(frozen=True)
class PlannedPass:
    """A pass that is still to be made: what a worker is given, and the archive it reads."""

    plan: PassPlan
    index: ArchiveIndex
    base: Need
    used: VersionedModel
    survey: Survey


def plan_pass(
    cat: Catalog,
    mission: Mission,
    settings: DiagnoseSettings,
    start: DayLike | None = None,
    end: DayLike | None = None,
    used: VersionedModel | None = None,
    report_progress: Progress = silent,
) -> PlannedPass:
    """Survey the span, linearise the model, and decide what is tried.

    Raises
    ------
    CatalogError
        When the archive has no day of the span.
    """
    used = used or current_model(cat, mission, settings.comparison)
    needs = tuple(needs_of(mission, used.model))
    channels = channel_needs(mission)
    index = ArchiveIndex.of(cat, [*needs, *channels])
    days = require_days(index, needs, start, end)
    base = next(need for need in needs if need.name == base_role(mission, settings.comparison))
    folding = folding_of(mission, settings.comparison)
    first, last = index.get(base, days[0]), index.get(base, days[-1])
    assert first is not None
    assert last is not None
    # A short record ends with its samples, a longer one with its days.
    span = first.first_tt2000, last.last_tt2000 + base.cadence_ns
    if len(days) > PASS_SETTINGS.short_days or folding is not None:
        span = day_bounds(days[0])[0], day_bounds(days[-1])[1]
    # Bands and turns are lost on a coarser cadence.
    platform = folding is not None or mission.comparisons[settings.comparison].kind == "platform"
    native = max(need.cadence_ns for need in needs if need.channel == "field")
    native = native if folding is None else folding.cadence_ns
    cadence = native if platform else cadence_for(span[1] - span[0], native)
    if settings.cadence_s is not None and not platform:
        cadence = native * max(1, round(settings.cadence_s * SECOND / native))
    levels = learns_states(mission, settings.comparison)
    reader = ChannelReader(
        cat, mission, channels, index, cadence, span, settings.comparison, by_levels=levels
    )
    report_progress("survey", 0, 1)
    begun = Origin(
        model=sha256(f"{GRAM_VERSION} {used.model.text}".encode()).hexdigest(),
        mission=sha256(mission.text.encode()).hexdigest(),
        cadence_ns=cadence,
        first=str(days[0]),
        days=len(days),
        value=(),
        channels={},
        still=(),
        surveyed=_surveyed(index, [*needs, *channels], days),
    )
    known = _earlier_origin(cat, mission, settings.comparison, begun)
    found = survey(cat, mission, used.model, needs, index, days, reader, known)
    report_progress("survey", 1, 1)
    origin = known or replace(begun, value=found.value, channels=found.channels, still=found.still)
    plan = _plan(mission, found, needs, channels, days, span, cadence, origin)
    return PlannedPass(plan, index, base, used, found)


def _surveyed(index: ArchiveIndex, needs: Sequence[Need], days: Sequence[np.datetime64]) -> str:
    """Return what tells the days that a survey reads from others, and from other revisions of them."""
    some = evenly_spread(days, PASS_SETTINGS.surveyed_days)
    read = [record.id for need in needs for day in some if (record := index.get(need, day)) is not None]
    return sha256(" ".join(sorted(set(map(str, read)))).encode()).hexdigest()


def _earlier_origin(cat: Catalog, mission: Mission, comparison: str, begun: Origin) -> Origin | None:
    """Return what an earlier survey of the same record, or of one that has grown, found; None without one."""
    if mission.comparisons[comparison].kind != "scalar":
        return None
    for day in reversed(cat.days(f"equations/{comparison}/library", states=("published",))):
        text = cat.read(day, ["count"]).attrs.get("origin")
        found = Origin.of_json(text) if text else None
        return found if found is not None and found.holds_for(begun) else None
    return None


def _plan(
    mission: Mission,
    found: Survey,
    needs: Sequence[Need],
    channels: Sequence[Need],
    days: Sequence[np.datetime64],
    span: tuple[int, int],
    cadence: int,
    origin: Origin,
) -> PassPlan:
    orbit = mission.periods.get("orbit")
    length = span[1] - span[0]
    parts, width = block_parts(len(days), length, orbit)
    geometry = list(GEOMETRY) if position_channel(mission) else []
    vectors = [name for name, channel in channels_of(mission).items() if len(channel.axis_names) == 3]
    shifts = placebo_shifts(found, orbit, length)
    library = make_library(
        mission,
        found.model,
        found.channels,
        [*geometry, *vectors],
        shifts,
        found.base,
        (2.0 * cadence / SECOND, 0.5 * length / SECOND),
        found.fixed,
        frozenset(
            need.name for need in channels if resolves_spin(mission, found.model.comparison, need.cadence_ns)
        ),
    )
    for name in found.still:
        library.unscorable.append(
            {"name": name, "family": "unknown", "reason": "the channel does not change"}
        )
    # On a fixed grid: whatever comes before or after, a day is in the same block.
    grid = np.asarray(days, dtype="datetime64[D]").astype(np.int64) // width
    blocks = tuple(tuple(days[int(at)] for at in np.flatnonzero(grid == one)) for one in np.unique(grid))
    correlation_s = min(PASS_SETTINGS.correlation_time_s, length / SECOND / PASS_SETTINGS.correlation_spans)
    return PassPlan(
        model=found.model,
        library=library,
        needs=tuple(needs),
        channel_needs=tuple(channels),
        days=tuple(days),
        blocks=blocks,
        parts=parts,
        cadence_ns=cadence,
        span=span,
        correlation_time_s=correlation_s,
        channel_summaries=found.channels,
        origin=origin,
    )


def begin_search(made: PassResult, settings: DiagnoseSettings) -> Search:
    """Return the first state of a search over a pass: nothing taken yet."""
    raw = made.loaded.raw
    days = _groups_of_blocks(raw.start, DAY)
    if len(days) <= 2 and len(raw) >= 8:
        # A record of one or two days is calibrated anew in each of its quarters.
        days = [part.tolist() for part in np.array_split(np.arange(len(raw)), 4)]
    rules = Rules(draws=settings.draws, seed=settings.seed, rounds=settings.rounds)
    return Search.begin(
        raw,
        made.loaded.white,
        made.plan.library,
        intervals_of(made, settings),
        days,
        rules,
        time_variable=time_variable_columns(made.plan.library),
    )


def search_on_one_thread(
    search: Search, data: DiagnosisData, native: NativeEstimator, progress: Progress = silent
) -> tuple[Diagnosis, Search]:
    """Return what `run_search` does; its matrices are small, and threads would mostly wait for each other."""
    with one_thread():
        return run_search(search, data, native, progress)


def _groups_of_blocks(start: Any, width: int) -> list[list[int]]:
    """Return blocks by consecutive spans of a length, from the first block's start."""
    place = (start - start[0]) // width
    return [np.flatnonzero(place == one).tolist() for one in np.unique(place)]


def intervals_of(made: PassResult, settings: DiagnoseSettings) -> list[list[int]]:
    """Return the blocks of each calibration interval; all in one when nothing it fits is a block's own."""
    raw = made.loaded.raw
    own = [
        timed
        for term in made.plan.library.base
        for entry in made.used.model.effects
        if entry.name == term.entry.name
        for name, timed in entry.parameters.items()
        if name in term.parameters
    ]
    if own and not any(timed.time == "block" for timed in own):
        return [list(range(len(raw)))]
    groups = _groups_of_blocks(raw.start, settings.interval_days * DAY)
    # A short rest joins the interval before it.
    if len(groups) > 1 and len(groups[-1]) < 0.5 * len(groups[0]):
        rest = groups.pop()
        groups[-1] += rest
    return groups


def native_estimator(
    cat: Catalog,
    mission: Mission,
    made: PassResult,
    settings: DiagnoseSettings,
    client: Any,
    report_progress: Progress,
) -> NativeEstimator:
    """Return what estimates at the data's own cadence what a search over a pass takes."""
    return NativeEstimator(
        cat=cat,
        mission=mission,
        plan=made.plan,
        index=made.index,
        base=made.base,
        settings=settings,
        context=made.context,
        client=client,
        progress=report_progress,
    )


def diagnosis_data(made: PassResult, mission: Mission) -> DiagnosisData:
    """Return what a verdict needs in addition to the search."""
    return DiagnosisData(
        mission=mission,
        model=replace(made.used.model, version=made.used.version),
        linearised=made.plan.model,
        series=made.loaded.series,
        sums=dict(made.loaded.sums),
        cadence_s=made.plan.cadence_ns / SECOND,
        floor=made.loaded.floor,
        context_id=made.context,
        run=made.run,
        correlation_time_s=made.plan.correlation_time_s,
        outliers=made.loaded.outliers,
        switched=made.switched,
        lost=made.failed,
    )
