"""A reprocessing, step by step: statistics of days, tables, products, and the report of the run.

In go a pipeline and a `Plan`, out comes a published run with its `RunReport`. `run_plan` does the same for
every pipeline. All batches of a stage are independent; the `Mapper` says where they run. When nothing has
changed since the last run of the same plan, `report_if_unchanged` says so without making anything.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day, RunRecord, idempotency_key
from inflight.mission import Mission
from inflight.model import Model
from inflight.progress import Progress, silent
from inflight.tasks.archive import spin_problems, substitution_problems
from inflight.tasks.batches import Mapper, give_back_memory, give_back_memory_at_times
from inflight.tasks.models import model_label
from inflight.tasks.pipelines.base.job import Batch, Outcome, ProductBatch, make_days
from inflight.tasks.pipelines.base.origins import context_label, origin_attributes, table_label
from inflight.tasks.pipelines.base.pipeline import Pipeline
from inflight.tasks.pipelines.base.planning import Plan, models_to_use
from inflight.tasks.pipelines.base.publication import (
    Reprocessing,
    TablesToPublish,
    UsedTable,
    register_outcome,
    reuse_interrupted_days,
)
from inflight.tasks.pipelines.base.stored_table import take_pinned_tables, take_stored_table
from inflight.tasks.report import RunReport, no_work_problems
from inflight.threads import one_thread

if TYPE_CHECKING:
    import xarray as xr

#: Passes of linearisation at most; each one squares the linearisation error.
_MOST_PASSES = 4


def run_plan(
    pipeline: Pipeline,
    cat: Catalog,
    mission: Mission,
    plan: Plan,
    mapper: Mapper,
    progress: Progress = silent,
    client: Any = None,
) -> RunReport:
    """Carry out a plan, publish it as one run, and return its report.

    The mapper's batches run on the client, where there is one.

    Raises
    ------
    InflightError
        When the tables of all days cannot be made; statistics of days remain for the next run.
    """
    planned = {"days_planned": len(pipeline.days_to_do(cat, plan)[0])}
    with cat.run("reprocess", {**plan.recorded, **planned}, context=plan.context) as run:
        work = Reprocessing(
            cat=cat, mission=mission, plan=plan, run=run, mapper=mapper, progress=progress, client=client
        )
        run.record_no_work(plan.product, plan.no_work)
        is_fitted = plan.settings.use_table is None and plan.settings.context is None
        if plan.settings.context is not None:
            statistics, solved = _Statistics(), take_pinned_tables(work)
        elif plan.settings.use_table is not None:
            statistics, solved = _Statistics(), take_stored_table(work, plan.settings.use_table)
        else:
            statistics = _make_statistics(pipeline, work) if pipeline.statistics else _Statistics()
            if pipeline.statistics and not statistics.days:
                return _report(pipeline, work, None, _Products())
            progress("tables", 0, 1)
            with one_thread():
                solved = pipeline.solve(work, statistics.days)
            work.statistics = None
            give_back_memory()
            tables = max(len(solved.kept), 1)
            progress("tables", tables, tables)
        made = (
            _make_products(pipeline, work, solved)
            if pipeline.has_products
            else _Products(statistics.fresh, plan.unchanged)
        )
        if is_fitted:
            with one_thread():
                pipeline.finish(work, statistics.days, solved, made.reports)
        run.publish(certify=solved.certify, supersede=True)
        report = _report(pipeline, work, solved, made)
        if not work.failed:
            run.report = {
                "plan": _hash_of_plan(pipeline, plan),
                "made": _hash_of_outputs(cat, plan),
                "report": report.as_json(),
            }
    return report


def last_run(cat: Catalog, comparison: str) -> RunRecord | None:
    """Return the last `reprocess` of a comparison that was done; None without any."""
    runs = [
        run
        for run in cat.runs("reprocess")
        if run.state == "done" and run.settings.get("comparison") == comparison
    ]
    return runs[-1] if runs else None


def report_if_unchanged(pipeline: Pipeline, cat: Catalog, plan: Plan) -> RunReport | None:
    """Return the report of a plan that has nothing to do; None when a run may make something.

    It has nothing to do when the last run of the comparison had the same plan and all its days, and all that
    it made is published as it left it.
    """
    run = last_run(cat, plan.settings.comparison)
    last = cat.run_report(run.id) if run else None
    if (
        not last
        or last["plan"] != _hash_of_plan(pipeline, plan)
        or last["made"] != _hash_of_outputs(cat, plan)
    ):
        return None
    found = RunReport.from_json(last["report"])
    days = {**found.days, "done": 0, "unchanged": found.days["done"] + found.days["unchanged"]}
    return replace(found, run="", days=days)


def _hash_of_plan(pipeline: Pipeline, plan: Plan) -> str:
    """Return a hash of all that a run is made from: days with their inputs, settings, model, algorithms."""
    versions = [pipeline.versions.statistics, pipeline.versions.tables, pipeline.versions.products]
    days = [[str(day), *plan.product_inputs(day)] for day in plan.keys]
    missing = [[str(day), reason] for day, reason in plan.no_work.items()]
    return _hash([pipeline.tag, versions, plan.context, plan.recorded, days, missing])


def _hash_of_outputs(cat: Catalog, plan: Plan) -> str:
    """Return a hash of what is published of a plan's days, and of the tables of its comparison."""
    days = [
        [day.id, day.key]
        for name in (plan.product, plan.equations)
        for day in cat.days(name, states=("published",))
        if day.day in plan.keys
    ]
    tables = [
        [record.id, record.key, record.damaged, record.certified]
        for record in cat.tables()
        if record.name.startswith(f"{plan.settings.comparison}-")
    ]
    return _hash([days, tables])


def _hash(content: Sequence[Any]) -> str:
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()


@dataclass
class _Statistics:
    """The statistics of all days with the plan's mission and model, and the days made in this run."""

    days: Mapping[np.datetime64, Day] = field(default_factory=dict)
    fresh: Sequence[np.datetime64] = ()


@dataclass
class _Products:
    """Days made in this run, days that are unchanged, and the reports of both."""

    done: Sequence[np.datetime64] = ()
    unchanged: Sequence[np.datetime64] = ()
    reports: Mapping[np.datetime64, Mapping[str, Any]] = field(default_factory=dict)


def _make_statistics(pipeline: Pipeline, work: Reprocessing) -> _Statistics:
    """Make the statistics of days until they are linearised near enough to their solution."""
    plan = work.plan
    published = work.cat.days(plan.equations, states=("published",))
    current = {day.day: day for day in published if plan.keys.get(day.day) == day.key}
    # Days outside the span that were made with the same mission and model.
    others = {day.day: day for day in published if day.day not in plan.keys and day.context == plan.context}
    fresh = _make_pass(pipeline, work, plan.batches, plan.reference)
    last: Sequence[float] | None = plan.reference
    for _ in range(_MOST_PASSES):
        with one_thread():
            every = others | current | fresh
            last = pipeline.linearise_at(work, every, last) if fresh else None
        if last is None:
            break
        batches = plan.statistics_batches([day for day in plan.days if day not in work.failed])
        fresh = _make_pass(pipeline, work, batches, last)
    return _Statistics(others | current | fresh, list(fresh))


def _make_pass(
    pipeline: Pipeline,
    work: Reprocessing,
    batches: Sequence[Sequence[np.datetime64]],
    reference: Sequence[float] | None,
) -> dict[np.datetime64, Day]:
    """Make and stage the statistics of batches of days; return the staged days."""
    plan, fresh = work.plan, {}
    if reference is None:
        # Statistics that a killed run linearised in a later pass differ in their bytes from those of an
        # undisturbed run: only those of the first pass are adopted.
        days = [day for batch in batches for day in batch]
        adopted = reuse_interrupted_days(work.run, plan.equations, plan.keys, days)
        fresh = {day: found for day, found in adopted.items() if not found.report.get("shared")}
    todo = [[day for day in batch if day not in fresh] for batch in batches]
    arguments = [
        (
            pipeline,
            Batch(
                cat=work.cat,
                mission=work.mission,
                model=plan.model,
                job=job,
                settings=plan.settings,
                reference=reference,
            ),
        )
        for job in work.jobs([batch for batch in todo if batch], plan.equations, plan.keys)
    ]
    for outcome in work.mapper("calibrate", statistics_batch, arguments):
        fresh |= {day.day: day for day in register_outcome(work.run, plan.equations, outcome, work.failed)}
    return fresh


def statistics_batch(pipeline: Pipeline, batch: Batch) -> Outcome:
    """Make the statistics of a batch of days in a worker, and write them as one segment."""
    outcome = make_days(batch.cat, batch.job, partial(pipeline.make_day, batch), pipeline.unify_variables)
    give_back_memory_at_times()
    return outcome


def product_batch(pipeline: Pipeline, batch: ProductBatch, folder: Path | None = None) -> Outcome:
    """Make the products of a batch of days in a worker, and write them as one segment.

    `folder` is the workspace unless given.
    """

    def make(day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        product, report = pipeline.make_product(batch, day)
        return product.assign_attrs(origin_attributes(pipeline, batch, day, report)), report

    outcome = make_days(batch.cat, batch.job, make, folder=folder)
    give_back_memory_at_times()
    return outcome


def product_key(pipeline: Pipeline, plan: Plan, day: np.datetime64, used: UsedTable) -> str:
    """Return the key of a day's product: a hash of its samples, the model, and what holds of the table."""
    inputs = [*plan.product_inputs(day), *used.inputs]
    return idempotency_key(plan.product, day, pipeline.versions.products, plan.context, inputs)


def _make_products(pipeline: Pipeline, work: Reprocessing, solved: TablesToPublish) -> _Products:
    """Make and stage the products whose samples, model or table changed."""
    cat, plan = work.cat, work.plan
    current = {day.day: day for day in cat.days(plan.product, states=("published",))}
    keys = {
        day: product_key(pipeline, plan, day, solved.used[day])
        for day in plan.days
        if day in solved.used and day not in work.failed
    }
    unchanged = [day for day, key in keys.items() if day in current and current[day].key == key]
    todo = sorted(keys.keys() - set(unchanged))
    adopted = reuse_interrupted_days(work.run, plan.product, keys, todo)
    todo = [day for day in todo if day not in adopted]
    _, preflight = models_to_use(cat, work.mission, plan.settings)
    context = plan.settings.context and context_label(plan.settings.context, plan.context)
    # The days of a batch have one table in common.
    names = {record.id: table_label(record) for record in cat.tables()}
    # A model that was fitted is one more thing that products are made from.
    fitted = solved.model.name != plan.model.name
    version = solved.model.version if fitted else plan.used.version
    lineage = [f"model:{solved.model.name}@{version}"] if fitted else []
    lineage += [f"table:{number}" for number in plan.model.taken_tables]
    arguments = []
    for number in sorted({solved.used[day].number for day in todo}):
        days = [day for day in todo if solved.used[day].number == number]
        for job in work.jobs(plan.product_batches(days), plan.product, keys):
            parents = {day: (*ids, f"table:{number}", *lineage) for day, ids in job.parents.items()}
            batch = ProductBatch(
                cat=cat,
                mission=work.mission,
                model=solved.model,
                job=replace(job, parents=parents),
                settings=plan.settings,
                table=pipeline.rows_for(solved.used[days[0]].table, job),
                preflight=preflight,
                table_name=names[number],
                model_name=model_label(solved.model.name, version),
                context_name=context or "",
            )
            arguments.append((pipeline, batch))
    done, reports = set(adopted), dict[np.datetime64, Mapping[str, Any]]()
    for outcome in work.mapper("produce", product_batch, arguments):
        fresh = register_outcome(work.run, plan.product, outcome, work.failed)
        done |= {day.day for day in fresh}
        reports |= {day.day: day.report for day in fresh}
    reports |= {day: current[day].report for day in unchanged}
    return _Products(sorted(done), unchanged, reports)


def _report(
    pipeline: Pipeline, work: Reprocessing, solved: TablesToPublish | None, made: _Products
) -> RunReport:
    plan = work.plan
    counts = {
        "planned": len(plan.days) + len(plan.no_work),
        "done": len(set(made.done) - set(work.failed)),
        "unchanged": len(made.unchanged),
        "failed": len(work.failed),
        "no_work": len(plan.no_work),
    }
    problems = [work.failed[day] for day in sorted(work.failed)]
    problems += [*(solved.remarks if solved else []), *no_work_problems(plan.no_work)]
    products, statistics = (
        [day for day in work.cat.days(name, states=("published",)) if day.day in plan.keys]
        for name in (plan.product, plan.equations)
    )
    problems += substitution_problems(products) + spin_problems([*products, *statistics])
    return RunReport(
        "reprocess",
        work.run.id,
        plan.context,
        counts,
        problems,
        pipeline.outputs(plan, solved, len(made.done) + len(made.unchanged)),
        pipeline.results(work, solved)
        | ({"warnings": told} if (told := _warnings(plan.model, products)) else {}),
    )


def _warnings(model: Model, products: Sequence[Day]) -> list[str]:
    """Return what to know of the products as a whole: of the model, and of tables that do not hold a day."""
    held: dict[str, list[str]] = {}
    for day in products:
        for one in day.report.get("held_tables") or ():
            held.setdefault(one, []).append(str(day.day))
    told = [
        f"{what} on {len(days)} days, {min(days)} to {max(days)}: its uncertainty there is that of a value "
        "that may have changed; 'inflight set' with the table's name takes the newest"
        for what, days in held.items()
    ]
    return [*([model.torquers_alone] if model.torquers_alone else []), *told]


def residual_of_days(work: Reprocessing) -> dict[str, float]:
    """Return the rms residual of the planned days before and after, nT, from the reports of their products.

    Days count by the weight that their reports state, else by their samples; empty when no day has any.
    """
    inside = [
        day for day in work.cat.days(work.plan.product, states=("published",)) if day.day in work.plan.keys
    ]
    told = [day.report for day in inside if day.report.get("samples") and "before_nT" in day.report]
    counted = "weight" if all("weight" in report for report in told) else "samples"
    reports = [(report[counted], report) for report in told]
    total = sum(count for count, _ in reports)
    if not total:
        return {}
    return {
        name: float(np.sqrt(sum(count * report[name] ** 2 for count, report in reports) / total))
        for name in ("before_nT", "after_nT")
    }
