"""The main job: archive days become normal equations, calibration tables and level-2 products.

`reprocess` runs the whole chain; its stages are plain functions that a flow may chain itself. All
batches of a stage are independent: `Mapper` says where they run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from inflight.calibration import bend
from inflight.catalog import Catalog, Day, Run, idempotency_key
from inflight.mission import Mission, dual_comparisons, is_calibrated_apart
from inflight.tasks.archive import each_result, partial_problems, spin_problems
from inflight.tasks.pipelines.job import Job, Outcome
from inflight.tasks.pipelines.mission import (
    chain_arguments,
    chain_batch,
    chained,
    save_fitted,
    spread_offsets,
)
from inflight.tasks.pipelines.planning import ONE_DAY, Plan, ReprocessSettings, plan
from inflight.tasks.pipelines.product import PRODUCT_VERSION, produce_batch, table_row_hash
from inflight.tasks.pipelines.publication import SolvedTables, TableKeeper, adopted_days, take_outcome
from inflight.tasks.pipelines.relation import reprocess_dual
from inflight.tasks.pipelines.scalar import calibrate_batch
from inflight.tasks.pipelines.spin import solve_spin, spin_batch
from inflight.tasks.pipelines.states import reprocess_states
from inflight.tasks.pipelines.tables import (
    MOST_BEND,
    daily_table,
    load_equations,
    month_edges,
    relinearise_at,
    window_edges,
    window_table,
)
from inflight.tasks.report import Progress, RunReport, no_work_problems
from inflight.time import DayLike, day_bounds

#: Runs a function over the argument lists of independent batches and yields the outcomes in order:
#: (stage, function, argument lists).
Mapper = Callable[[str, Callable[..., Outcome], Sequence[tuple[Any, ...]]], Iterator[Outcome]]

#: Passes of linearisation at most; each one squares the bend that is left.
_MOST_PASSES = 4


@dataclass
class _Book:
    """What became of each day, over all stages."""

    done: set[np.datetime64] = field(default_factory=set)
    failed: dict[np.datetime64, dict[str, str]] = field(default_factory=dict)
    reports: dict[np.datetime64, Mapping[str, Any]] = field(default_factory=dict)


def _jobs(
    made: Plan, run: Run, days: Sequence[Sequence[np.datetime64]], dataset: str, keys: Any
) -> list[Job]:
    base = next(need for need in made.needs if need.name == made.base)
    return [
        Job(
            tuple(batch),
            {day: keys[day] for day in batch},
            {day: tuple(source.id for source in made.index.sources(made.needs, day, base)) for day in batch},
            made.index.around(batch),
            made.needs,
            run.id,
            dataset,
        )
        for batch in days
    ]


def calibrate(
    cat: Catalog,
    mission: Mission,
    made: Plan,
    run: Run,
    batches: Sequence[Sequence[np.datetime64]],
    reference: Sequence[float] | None,
    mapper: Mapper,
    book: _Book,
) -> dict[np.datetime64, Day]:
    """Make and stage the normal equations of batches of days; return the staged days."""
    fresh: dict[np.datetime64, Day] = {}
    if reference is None:
        # A run killed amid a later pass leaves equations linearised here and there, and one killed after
        # it does not tell how many it made: only the first pass gives the bytes of an undisturbed run.
        asked = [day for batch in batches for day in batch]
        adopted = adopted_days(run, made.equations, made.keys, asked)
        fresh = {day: found for day, found in adopted.items() if not found.report.get("shared")}
    left = [[day for day in batch if day not in fresh] for batch in batches]
    jobs = _jobs(made, run, [batch for batch in left if batch], made.equations, made.keys)
    step: Callable[..., Outcome] = calibrate_batch
    arguments: list[tuple[Any, ...]] = [
        (cat, mission, made.model, job, reference, made.settings.min_coverage) for job in jobs
    ]
    if made.settings.is_chain:
        step, arguments = chain_batch, chain_arguments(cat, mission, made, jobs)
    if made.is_spin:
        step, arguments = spin_batch, [(cat, mission, made.model, job) for job in jobs]
    for outcome in mapper("calibrate", step, arguments):
        fresh |= {day.day: day for day in take_outcome(run, made.equations, outcome, book.failed)}
    return fresh


def solve(cat: Catalog, made: Plan, run: Run, days: Mapping[np.datetime64, Day]) -> SolvedTables:
    """Make the daily, window and whole-span tables from the normal equations of all days.

    Tables whose content is that of the newest ones of their name are not made again.
    """
    settings, model = made.settings, made.model
    equations = load_equations(cat, list(days.values()))
    edges = window_edges(min(days), max(days), settings.window_days)
    whole = [min(days), max(days) + ONE_DAY]
    makers: dict[str, Callable[[], xr.Dataset]] = {
        "daily": partial(daily_table, equations, model),
        "window": partial(window_table, equations, model, edges, "window"),
        "span": partial(window_table, equations, model, whole, "span"),
    }
    if settings.table == "monthly":
        months = month_edges(min(days), max(days))
        makers["monthly"] = partial(window_table, equations, model, months, "monthly")
    keep = TableKeeper(cat, made, run, days)
    tables = {kind: keep.table(kind, make) for kind, make in makers.items()}
    return SolvedTables(tables[settings.table], keep.ids, keep.certify, model)


def solve_chain(cat: Catalog, made: Plan, run: Run, days: Mapping[np.datetime64, Day]) -> SolvedTables:
    """Fit all days at once; stage the tables of the chain, and save the fitted model."""
    result = chained(cat, made, days)
    keep = TableKeeper(cat, made, run, days)
    for name, table in result.tables.items():
        keep.table(name, partial(_itself, table))
    return SolvedTables(
        result.tables["continuous"],
        keep.ids,
        keep.certify,
        save_fitted(cat, made, run, result.found),
        result.left_out,
    )


def _solver(made: Plan, mission: Mission) -> Callable[..., SolvedTables]:
    """Return what makes the tables of a plan."""
    if made.is_spin:
        return partial(solve_spin, mission=mission)
    return solve_chain if made.settings.is_chain else solve


def _itself(table: xr.Dataset) -> xr.Dataset:
    return table


def produce(
    cat: Catalog, mission: Mission, made: Plan, run: Run, tables: SolvedTables, mapper: Mapper, book: _Book
) -> list[np.datetime64]:
    """Make and stage the products that the table changes; return the days that need none."""
    current = {day.day: day for day in cat.days(made.product, states=("published",))}
    keys, todo, same = {}, [], []
    for day in made.days:
        if day in book.failed:
            continue
        start, end = day_bounds(day)
        row = table_row_hash(tables.used, (start + end) // 2)
        chosen = [tables.model.sha, str(made.settings.distribute)] if made.settings.is_chain else []
        inputs = [made.keys[day], row, *chosen]
        keys[day] = idempotency_key(made.product, day, PRODUCT_VERSION, made.context, inputs)
        if day in current and current[day].key == keys[day]:
            same.append(day)
        else:
            todo.append(day)
    adopted = adopted_days(run, made.product, keys, todo)
    book.done |= set(adopted)
    todo = [day for day in todo if day not in adopted]
    parents = f"table:{tables.ids[made.settings.table]}"
    jobs = [
        replace(job, parents={day: (*ids, parents) for day, ids in job.parents.items()})
        for job in _jobs(made, run, made.in_batches(todo), made.product, keys)
    ]
    spread = made.settings.distribute if made.settings.is_chain else None
    arguments = [(cat, mission, tables.model, tables.used, job, made.model, spread) for job in jobs]
    for outcome in mapper("produce", produce_batch, arguments):
        fresh = take_outcome(run, made.product, outcome, book.failed)
        book.done |= {day.day for day in fresh}
        book.reports |= {day.day: day.report for day in fresh}
    book.reports |= {day: current[day].report for day in same}
    return same


def reprocess(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: ReprocessSettings | None = None,
    *,
    client: Any = None,
    progress: Progress | None = None,
    mapper: Mapper | None = None,
) -> RunReport:
    """Run the whole chain for the half-open span of UTC days; publish all of it, or nothing.

    Parameters
    ----------
    cat : Catalog
        The workspace's catalog.
    mission : Mission
        What was measured and what is held against what.
    start, end : UTC date, optional
        The archive's own span when absent.
    settings : ReprocessSettings, optional
        Choices; the defaults when absent.
    client : distributed.Client, optional
        Batches run on it; the result is the same byte for byte as without.
    progress : callable, optional
        Called with (stage, done, total).
    mapper : Mapper, optional
        Runs the batches instead of `client`.

    Returns
    -------
    RunReport
        Days by outcome; extra field ``residual`` with `before_nT` and `after_nT` over the span. Of a
        comparison of two vector sensors see `inflight.tasks.pipelines.relation.reprocess` when scalar
        sensors calibrate both, else `inflight.tasks.pipelines.states.reprocess`.

    Raises
    ------
    MissionError, ModelError, CatalogError
        When there is nothing to work on or the model does not fit the mission.
    """
    spread = mapper or _plain_mapper(client, progress or (lambda stage, done, total: None))
    chosen = settings or ReprocessSettings()
    if chosen.comparison in dual_comparisons(mission):
        apart = is_calibrated_apart(mission, chosen.comparison)
        run_dual = reprocess_dual if apart else reprocess_states
        return run_dual(cat, mission, start, end, chosen, spread)
    made = plan(cat, mission, start, end, settings)
    book = _Book()
    with cat.run("reprocess", made.settings.model_dump() | _span_of(made), context=made.context) as run:
        run.record_no_work(made.product, made.no_work)
        days = _equations(cat, mission, made, run, spread, book)
        if not days:
            return _report(cat, made, run, book, [], {"residual": {}})
        tables = _solver(made, mission)(cat, made, run, days)
        same = produce(cat, mission, made, run, tables, spread, book)
        if made.settings.is_chain:
            _keep_offsets(cat, made, run, days, tables, book.reports)
        run.publish(certify=tables.certify, supersede=True)
    return _report(cat, made, run, book, same, _told(cat, made, tables))


def _told(cat: Catalog, made: Plan, tables: SolvedTables) -> dict[str, Any]:
    """Return the extra fields of a report: residual, model of a chain, tables that could not be made."""
    extra: dict[str, Any] = {"residual": _residual(cat, made)}
    if made.settings.is_chain:
        extra["model"] = {"name": tables.model.name, "version": tables.model.version}
    if made.settings.is_chain or tables.notes:
        extra["left_out"] = tables.notes
    return extra


def _keep_offsets(
    cat: Catalog,
    made: Plan,
    run: Run,
    days: Mapping[np.datetime64, Day],
    tables: SolvedTables,
    reports: Mapping[np.datetime64, Mapping[str, Any]],
) -> None:
    """Stage the table of daily offsets that the products' residuals tell."""
    table = spread_offsets(reports)
    if isinstance(table, str):
        tables.notes["z-offset"] = table
        return
    keep = TableKeeper(cat, made, run, days)
    keep.table("z-offset", partial(_itself, table))
    tables.ids.update(keep.ids)
    tables.certify.extend(keep.certify)


def _equations(
    cat: Catalog, mission: Mission, made: Plan, run: Run, mapper: Mapper, book: _Book
) -> dict[np.datetime64, Day]:
    """Make equations until they are linearised near enough to their solution; return all days' equations."""
    published = cat.days(made.equations, states=("published",))
    kept = {day.day: day for day in published if made.keys.get(day.day) == day.key}
    # Days outside the span that were made with the same mission and model.
    beside = {day.day: day for day in published if day.day not in made.keys and day.context == made.context}
    fresh = calibrate(cat, mission, made, run, made.batches, made.reference, mapper, book)
    last = made.reference
    for _ in range(_MOST_PASSES):
        days = beside | kept | fresh
        # A day of the chain is linearised at its own fit, and one of the spin iterates to the end.
        if not fresh or made.settings.is_chain or made.is_spin:
            break
        equations = load_equations(cat, list(days.values()))
        strength = float(np.median([day.report.get("strength_nT", 4e4) for day in days.values()]))
        again = relinearise_at(equations, made.model, strength)
        # Days that are sure of their own fit stay linearised there: a pass at the same place moves nothing.
        if again is None or (last is not None and bend(again, np.asarray(last), strength) <= MOST_BEND):
            break
        last = again.tolist()
        batches = made.in_batches([day for day in made.days if day not in book.failed])
        fresh = calibrate(cat, mission, made, run, batches, last, mapper, book)
    return beside | kept | fresh


def _plain_mapper(client: Any, progress: Progress) -> Mapper:
    """Return a mapper that runs batches here, or on a Dask client."""

    def spread(
        stage: str, function: Callable[..., Outcome], arguments: Sequence[tuple[Any, ...]]
    ) -> Iterator[Outcome]:
        progress(stage, 0, len(arguments))
        for done, outcome in enumerate(each_result(client, function, arguments), start=1):
            progress(stage, done, len(arguments))
            yield outcome

    return spread


def _span_of(made: Plan) -> dict[str, str]:
    return {"start": str(made.days[0]), "end": str(made.days[-1] + ONE_DAY)}


def _residual(cat: Catalog, made: Plan) -> dict[str, Any]:
    """Return the rms residual of the span before and after, from the days' own reports."""
    inside = [day for day in cat.days(made.product, states=("published",)) if day.day in made.keys]
    reports = [(day.report["samples"], day.report) for day in inside if day.report.get("samples")]
    total = sum(count for count, _ in reports)
    if not total:
        return {}
    return {
        name: float(np.sqrt(sum(count * report[name] ** 2 for count, report in reports) / total))
        for name in ("before_nT", "after_nT")
    }


def _report(
    cat: Catalog, made: Plan, run: Run, book: _Book, same: Sequence[np.datetime64], extra: dict[str, Any]
) -> RunReport:
    counts = {
        "planned": len(made.days) + len(made.no_work),
        "done": len(book.done - set(book.failed)),
        "unchanged": len(same),
        "failed": len(book.failed),
        "no_work": len(made.no_work),
    }
    problems = [book.failed[day] for day in sorted(book.failed)]
    problems += no_work_problems(made.no_work)
    there = [day for day in cat.days(made.product, states=("published",)) if day.day in made.keys]
    told = [day for day in cat.days(made.equations, states=("published",)) if day.day in made.keys]
    problems += partial_problems(there) + spin_problems([*there, *told])
    return RunReport(
        "reprocess",
        run.id,
        made.context,
        counts,
        problems,
        [made.product, f"tables/{made.settings.comparison}-{made.settings.table}"],
        extra,
    )
