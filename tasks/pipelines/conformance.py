"""`check_pipeline`: whether a class keeps what `reprocess`, `compare`, the verbs and the explorer rely on.

It takes a pipeline and, for the checks that need measurements, a small workspace with an archive. There it
makes a plan, a day, a whole run and the same run again, as `reprocess` does, and examines what was published.
All that fails is collected and listed at once, each time with what to mend.
"""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Workspace
from inflight.conformance import Faults
from inflight.mission import Mission
from inflight.progress import silent
from inflight.samples import base_channels
from inflight.tasks.archive import channels_by_name
from inflight.tasks.batches import batch_mapper
from inflight.tasks.pipelines.base import (
    Batch,
    Job,
    Pipeline,
    Plan,
    ProductBatch,
    ReprocessSettings,
    UsedTable,
    Versions,
    product_key,
    published_products,
    run_plan,
)
from inflight.tasks.report import RunReport, to_json
from inflight.time import day_bounds

_GUIDE = "docs/how-to/own-pipeline.md"


def check_pipeline(
    pipeline: Pipeline, workspace: Workspace | None = None, settings: ReprocessSettings | None = None
) -> None:
    """Check that a pipeline keeps its contract.

    Parameters
    ----------
    pipeline : Pipeline
        It need not be among `PIPELINES`.
    workspace : Workspace, optional
        With some days in its archive of a comparison that the pipeline handles: a copy, because tables and
        products are published in it. Without one, only the class itself is checked.
    settings : ReprocessSettings, optional
        Which comparison, and which table products take; the comparison ``main`` when absent.

    Raises
    ------
    ConformanceError
        Listing every check that failed, and what to mend.

    Examples
    --------
    >>> from inflight.tasks.pipelines import PIPELINES, check_pipeline
    >>> for pipeline in PIPELINES:
    ...     check_pipeline(pipeline)
    """
    faults = Faults()
    for check in (_describes_itself, _has_versions, _is_complete, _travels_to_workers):
        faults.collect(check, pipeline)
    if workspace is not None and not faults.found:
        case = _Case(pipeline, workspace, settings or ReprocessSettings())
        for check_case in (_handles_the_comparison, _names_known_channels, _keeps_keys, _makes_a_day):
            faults.collect(check_case, case)
        if not faults.found:
            for check_case in (_runs, _runs_again, _publishes_tables, _publishes_products, _is_shown):
                faults.collect(check_case, case)
    faults.require_none(f"pipeline {pipeline.tag!r}", _GUIDE)


# --- the class itself -----------------------------------------------------------------------------------


def _describes_itself(pipeline: Pipeline) -> Iterator[str]:
    kind = type(pipeline)
    known = {*dir(Pipeline), *Pipeline.__annotations__}
    if not (kind.__dict__.get("__doc__") or "").strip():
        yield "the class has no docstring; say what is measured against what, and what is kept of a day"
    if not isinstance(pipeline.tag, str) or not pipeline.tag.isidentifier():
        yield f"tag is {pipeline.tag!r}; give one word, as users will call it"
    for name, member in kind.__dict__.items():
        if (
            inspect.isfunction(member)
            and not name.startswith("_")
            and not inspect.getdoc(getattr(kind, name))
        ):
            yield f"{name} has no docstring"
        if not name.startswith("_") and name not in known:
            yield f"{name} is no member of Pipeline; give it a name that begins with an underscore"


def _has_versions(pipeline: Pipeline) -> Iterator[str]:
    versions: object = pipeline.versions
    if not isinstance(versions, Versions):
        yield f"versions is {versions!r}; give a Versions"
        return
    for name, least in (("statistics", 1), ("tables", 1), ("products", int(pipeline.has_products))):
        value = getattr(versions, name)
        if type(value) is not int or value < least:
            yield f"versions.{name} is {value!r}; give an integer, at least {least}"


def _is_complete(pipeline: Pipeline) -> Iterator[str]:
    kind = type(pipeline)
    required = {
        "make_day": bool(pipeline.statistics),
        "make_product": pipeline.has_products,
        "compare": pipeline.has_products,
    }
    for name, needed in required.items():
        own = getattr(kind, name) is not getattr(Pipeline, name)
        if needed != own:
            yield f"{name} is {'missing' if needed else 'never called'}: see 'statistics' and 'has_products'"
    if bool(pipeline.note) == pipeline.has_products:
        yield "note says what stands where a product would be: give one exactly when there are none"


def _travels_to_workers(pipeline: Pipeline) -> Iterator[str]:
    again = pickle.loads(pickle.dumps(pipeline))
    if type(again) is not type(pipeline) or vars(again):
        yield "it holds state; whatever a day needs comes with the batch"


# --- with measurements ----------------------------------------------------------------------------------


@dataclass
class _Case:
    """A pipeline and a workspace of its own."""

    pipeline: Pipeline
    workspace: Workspace
    settings: ReprocessSettings

    @cached_property
    def cat(self) -> Catalog:
        return Catalog(self.workspace.root)

    @cached_property
    def mission(self) -> Mission:
        return self.workspace.mission()

    @property
    def comparison(self) -> str:
        return self.settings.comparison

    def plan(self, pipeline: Pipeline | None = None) -> Plan:
        return (pipeline or self.pipeline).make_plan(self.cat, self.mission, self.settings, (None, None))

    def run(self, pipeline: Pipeline | None = None) -> RunReport:
        return run_plan(pipeline or self.pipeline, self.cat, self.mission, self.plan(), batch_mapper(None))

    def newer(self, part: str) -> Pipeline:
        """Return the pipeline with a version raised."""
        kind, versions = type(self.pipeline), self.pipeline.versions
        raised = replace(versions, **{part: getattr(versions, part) + 1})
        made: Pipeline = type(kind.__name__, (kind,), {"versions": raised})()
        return made


def _handles_the_comparison(case: _Case) -> Iterator[str]:
    for name in case.mission.comparisons:
        settings = case.settings.model_copy(update={"comparison": name})
        answer: object = case.pipeline.handles(case.mission, settings)
        if not isinstance(answer, bool):
            yield f"handles answers {answer!r} of comparison {name!r}; answer True or False"
        elif name == case.comparison and not answer:
            yield f"handles answers False of comparison {name!r}, on which it is to be tried"


def _names_known_channels(case: _Case) -> Iterator[str]:
    homes = channels_by_name(case.mission)
    for name in case.pipeline.extra_channels(case.mission, case.comparison):
        if name not in homes and not set(base_channels(name)) <= set(homes):
            yield f"extra_channels names {name!r}, which the mission has not"
    for need in case.plan().needs:
        if need.channel not in case.mission.instruments[need.instrument].channels:
            yield f"a plan needs {need.instrument}.{need.channel}, which the mission has not"


def _keeps_keys(case: _Case) -> Iterator[str]:
    plan = case.plan()
    if not plan.days:
        yield "a plan of the whole archive has no day"
    if plan.keys != case.plan().keys:
        yield "two plans of the same archive have different keys; keys must follow from their inputs"
    if set(plan.keys.values()) & set(case.plan(case.newer("statistics")).keys.values()):
        yield "raising versions.statistics changes no key; pass it to the plan"
    used = UsedTable(1, ("of the table",), xr.Dataset())
    if case.pipeline.has_products and plan.days:
        keys = {product_key(one, plan, plan.days[0], used) for one in (case.pipeline, case.newer("products"))}
        if len(keys) < 2:
            yield "raising versions.products changes no key of a product"


def _makes_a_day(case: _Case) -> Iterator[str]:
    plan = case.plan()
    if not case.pipeline.statistics or not plan.days:
        return
    day = plan.days[0]
    parents = {day: tuple(one.id for one in plan.sources[day])}
    job = Job((day,), plan.keys, parents, plan.index, plan.needs, "", plan.equations)
    batch = Batch(cat=case.cat, mission=case.mission, model=plan.model, job=job, settings=case.settings)
    made, report = case.pipeline.make_day(batch, day)
    if made.sizes.get("block") != 1:
        yield f"make_day gives {made.sizes.get('block', 0)} blocks; statistics of a day are one block"
    for name in ("start", "end"):
        if name not in made or made[name].dims != ("block",):
            yield f"make_day gives no {name} (block), TT2000"
    if {"start", "end"} <= set(made.variables):
        start, end = day_bounds(day)
        if not start <= int(made["start"].values[0]) < int(made["end"].values[0]) <= end:
            yield "start and end of the statistics are no part of the day"
    to_json(report)
    if len(case.pipeline.unify_variables([made])) != 1:
        yield "unify_variables gives another number of days than it was given"


def _runs(case: _Case) -> Iterator[str]:
    watched, other = _with_whole_tables(case.pipeline)
    report = case.run(watched)
    yield from (f"rows_for leaves out of the table what the product of {day} takes" for day in other)
    yield from (f"day {one['day']}: {one['message']}" for one in report.problems if one["cause"] == "bug")
    if not report.days["done"]:
        yield f"a run makes no day: {[one['message'] for one in report.problems][:3]}"
    if "residual" not in report.extra:
        yield "results gives no 'residual'; give an empty one where there is none"
    known = {f"tables/{one.name}" for one in case.cat.tables()}
    known |= set(case.cat.dataset_names())
    yield from (f"outputs names {one!r}, which is not there" for one in report.outputs if one not in known)
    remarks: list[object] = list(case.pipeline.remarks(report.as_json()))
    yield from (f"remarks gives {one!r}; give sentences" for one in remarks if not isinstance(one, str))


def _with_whole_tables(pipeline: Pipeline) -> tuple[Pipeline, list[np.datetime64]]:
    """Return a pipeline that makes products with the whole table, too; and the days that differ, once it has.

    The pipeline itself where that gives each batch the whole table.
    """
    kind: Any = type(pipeline)
    whole: list[tuple[xr.Dataset, xr.Dataset]] = []
    other: list[np.datetime64] = []
    if kind.rows_for is Pipeline.rows_for:
        return pipeline, other

    def rows_for(self: Pipeline, table: xr.Dataset, job: Job) -> xr.Dataset:
        rows: xr.Dataset = kind.rows_for(self, table, job)
        whole.append((rows, table))
        return rows

    def make_product(
        self: Pipeline, batch: ProductBatch, day: np.datetime64
    ) -> tuple[xr.Dataset, dict[str, Any]]:
        table = next(table for rows, table in whole if rows is batch.table)
        made, report = kind.make_product(self, batch, day)
        if not made.identical(kind.make_product(self, replace(batch, table=table), day)[0]):
            other.append(day)
        return made, report

    watching: Pipeline = type(kind.__name__, (kind,), {"rows_for": rows_for, "make_product": make_product})()
    return watching, other


def _runs_again(case: _Case) -> Iterator[str]:
    before = {one.id for one in case.cat.tables()}
    report = case.run()
    if report.days["done"]:
        yield f"the same run again makes {report.days['done']} days anew; keys must follow from their inputs"
    fresh = [one.name for one in case.cat.tables() if one.id not in before]
    if fresh:
        yield f"the same run again makes tables anew: {', '.join(fresh)}"
    todo, _ = case.pipeline.days_to_do(case.cat, case.plan())
    if todo:
        yield f"days_to_do names {len(todo)} days after a run that did all"


def _publishes_tables(case: _Case) -> Iterator[str]:
    mine = [one for one in case.cat.tables() if one.name.startswith(f"{case.comparison}-")]
    if not any(one.certified for one in mine):
        yield "no table is certified"
    for record in mine:
        table = case.cat.table_by_id(record.id)
        if "value" in table and "sigma" in table and table["value"].dims != table["sigma"].dims:
            yield f"{record.name}: value and sigma have different dims"
        if "value" not in table or not {"interval", "parameter"} <= set(table["value"].dims):
            continue
        for name in ("sigma", "start", "end", "units"):
            if name not in table:
                yield f"{record.name}: no variable {name!r} beside 'value'"
        if {"start", "end"} <= set(table.variables):
            start, end = table["start"].values, table["end"].values
            if (end <= start).any() or (start[1:] < end[:-1]).any():
                yield f"{record.name}: intervals are empty or overlap; each is half-open, in order of time"


def _publishes_products(case: _Case) -> Iterator[str]:
    if not case.pipeline.has_products:
        return
    for day in published_products(case.cat, case.comparison, slice(None, None)):
        product = case.cat.read(day, with_time=False)
        missing = [name for name in ("tt2000", "flag") if name not in product.variables]
        if missing:
            yield f"{day.day}: the product has no {missing[0]}"
            continue
        stamps = np.asarray(product["tt2000"].values, dtype=np.int64)
        start, end = day_bounds(day.day)
        if not (np.diff(stamps) > 0).all() or stamps[0] < start or stamps[-1] >= end:
            yield f"{day.day}: tt2000 does not ascend within the day"
        for variable, values in product.data_vars.items():
            if values.dtype.kind == "f" and "units" not in values.attrs:
                yield f"{day.day}: variable {variable!r} has no units; write '1' for a number without"
        for key in ("coverage", "samples"):
            if key not in day.report:
                yield f"{day.day}: the report of a product has no {key!r}"


def _is_shown(case: _Case) -> Iterator[str]:
    for heading, text, plots in case.pipeline.sections(case.cat, case.mission, case.comparison):
        if not heading or not (list(text) or list(plots)):
            yield f"section {heading!r} shows nothing"
    if not case.pipeline.has_products:
        return
    span = slice(None, None)
    days = published_products(case.cat, case.comparison, span)
    given = (case.cat, case.mission, case.comparison, days, span, silent, None, None)
    found = case.pipeline.compare(*given)
    fields: dict[str, Any] = found.report.as_json()
    to_json(fields)
    for name in ("command", "comparison", "residual", "fails_where", "path"):
        if name not in fields:
            yield f"the JSON of compare has no {name!r}"
    if not found.parts or not found.report.summary():
        yield "compare shows nothing"
