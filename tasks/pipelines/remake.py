"""An old version of products made again, with its own model, mission and tables, and compared byte by byte.

In goes the name of a collection (a release, ``model:2`` or ``v01.03``) and a span; out come its stores in a
folder of their own, under the names they have in the workspace, and whether they are equal. Everything is
taken from the lineage of each day: the revisions of the archive it was made from, the table, the text of
mission and model, the settings of its run. Nothing is published.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import groupby
from pathlib import Path

from inflight.calibration import LEARNT, held_table
from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.tasks.archive import ArchiveIndex
from inflight.tasks.batches import Mapper
from inflight.tasks.models import model_label, preflight_of, version_as_it_was
from inflight.tasks.pipelines.base import (
    Failure,
    Job,
    Pipeline,
    ProductBatch,
    ReprocessSettings,
    context_label,
    product_batch,
    product_needs,
    product_of,
    table_label,
)
from inflight.tasks.pipelines.registry import pipeline_of
from inflight.tasks.report import RunReport, problem
from inflight.time import DayLike, day_bounds, is_within


def remake_version(
    cat: Catalog,
    version: str,
    span: tuple[DayLike | None, DayLike | None],
    folder: Path,
    mapper: Mapper,
) -> RunReport:
    """Make the products of a collection again, and compare them with what was published.

    A store holds several days and is made whole: it comes along when one of its days lies in the span.

    Parameters
    ----------
    version : str
        As `Catalog.collection` takes it.
    span : tuple of UTC date or None
        Half-open; None is open.
    folder : Path
        Where the stores go; one that is there from before is replaced.
    mapper : Mapper

    Returns
    -------
    RunReport
        Its problems are the days that are not equal; extra field ``stores`` lists path and ``equal``.

    Raises
    ------
    CatalogError
        When there is no such version, or the lineage of a day does not suffice.
    """
    days = [day for day in cat.collection(version) if day.segment and is_within(day.day, *span)]
    if not days:
        raise CatalogError(
            f"version {version!r} has no product in the span",
            remedy="'inflight catalog list' and 'inflight model history' list versions",
        )
    stores = [next(group) for _, group in groupby(days, key=lambda day: day.segment)]
    stores = list({day.segment: day for day in stores}.values())
    arguments, expected = [], []
    for day in stores:
        sha256, together = cat.stored_together(day)
        expected.append((day.segment, sha256, together))
        shutil.rmtree(folder / day.segment, ignore_errors=True)
        arguments.append((*_batch(cat, together), folder))
    problems, listed, equal = [], [], 0
    outcomes = mapper("produce again", product_batch, arguments)
    for (path, sha256, together), outcome in zip(expected, outcomes, strict=True):
        made = outcome.segment
        same = made is not None and made.sha256 == sha256
        listed.append({"path": path, "equal": same, "days": [str(day.day) for day in together]})
        equal += len(together) if same else 0
        for day in () if same else together:
            failed = outcome.failures.get(day.day) or Failure(
                "repeatable",
                f"comes out with other bytes than {path}",
                "equal bytes need the packages that made it (software.txt of a release)",
            )
            problems.append(problem(failed.cause, failed.message, day=day.day, remedy=failed.remedy))
    planned = sum(len(together) for _, _, together in expected)
    counts = {"planned": planned, "done": equal, "unchanged": 0, "failed": planned - equal, "no_work": 0}
    return RunReport(
        "reprocess", "", "", counts, problems, [str(folder)], {"as_of": version, "stores": listed}
    )


def _batch(cat: Catalog, days: list[Day]) -> tuple[Pipeline, ProductBatch]:
    """Return what makes the days of one store again: they have context, settings and table in common."""
    edges = {day.id: [edge.parent for edge in cat.lineage(day) if edge.child == day.id] for day in days}
    run = next(run for run in cat.runs() if run.id == days[0].run)
    fields = ReprocessSettings.model_fields
    settings = ReprocessSettings(
        **{key: value for key, value in run.settings.items() if key in fields and value is not None}
    )
    context = cat.context(str(days[0].context))
    mission = Mission.parse(context.mission_text)
    base = version_as_it_was(cat, mission, context.model_name, context.model_version).model
    own = edges[days[0].id]
    numbers = (int(item[6:]) for item in own if item.startswith("table:"))
    number = next((one for one in numbers if one not in base.taken_tables), None)
    if number is None or days[0].dataset != product_of(settings.comparison):
        raise CatalogError(
            f"{days[0].dataset} of {days[0].day} was not made by a calibration table",
            remedy="only products are made again",
        )
    model, version = base, context.model_version
    for item in own:
        if item.startswith("model:"):
            name, _, text = item.removeprefix("model:").rpartition("@")
            version = int(text)
            model = replace(version_as_it_was(cat, mission, name, version).model, version=version)
    preflight = preflight_of(cat, mission, context.model_name, context.model_version)
    record = next(one for one in cat.tables() if one.id == number)
    table = cat.table_by_id(number)
    is_held = settings.use_table is not None or settings.context is not None
    if is_held and set(LEARNT) <= set(table.variables):
        table = held_table(table, day_bounds(days[0].day)[0], day_bounds(days[-1].day)[1])
    pipeline = pipeline_of(mission, settings.comparison, settings)
    channels = pipeline.extra_channels(mission, settings.comparison)
    needs = product_needs(mission, base, preflight, channels, pipeline.reach_s)
    sources = cat.days_by_id(item for parents in edges.values() for item in parents)
    index = ArchiveIndex(
        {(source.dataset, source.day): source for source in sources},
        max((need.days_before for need in needs), default=1),
        tuple(need for need in needs if need.replaceable),
    )
    job = Job(
        tuple(day.day for day in days),
        {day.day: day.key for day in days},
        {day.day: tuple(edges[day.id]) for day in days},
        index,
        needs,
        days[0].segment.split("/")[1],
        days[0].dataset,
    )
    batch = ProductBatch(
        cat=cat,
        mission=mission,
        model=model,
        job=job,
        settings=settings,
        table=table,
        preflight=preflight,
        table_name=table_label(record),
        model_name=model_label(model.name, version),
        context_name=context_label(settings.context, context.id) if settings.context else "",
    )
    return pipeline, batch
