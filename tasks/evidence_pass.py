"""Blocks of evidence of a span: those that are missing or out of date are made, the rest is kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day, idempotency_key
from inflight.errors import WorkerError
from inflight.mission import Mission
from inflight.tasks.archive_index import ArchiveIndex
from inflight.tasks.calibrate import Job
from inflight.tasks.delivery import each_result
from inflight.tasks.evidence import PassPlan, evidence_batch
from inflight.tasks.keeping import adopted_days, take_outcome
from inflight.tasks.needs import Need
from inflight.tasks.report import Progress

if TYPE_CHECKING:
    from inflight.tasks.diagnose import DiagnoseSettings


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
    tell: Progress,
) -> tuple[str, list[Day]]:
    """Make the blocks that are missing or out of date; return the run and all blocks' days."""
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
        return "", [kept[day] for day in sorted(kept)]
    with cat.run("diagnose", settings.model_dump(), context=context) as run:
        kept |= adopted_days(run, dataset, keys, todo)
        todo = [day for day in todo if day not in kept]
        size = settings.batch_blocks
        batches = [tuple(todo[at : at + size]) for at in range(0, len(todo), size)]
        jobs = [
            Job(batch, _of(keys, batch), _of(parents, batch), index, plan.needs, run.id, dataset)
            for batch in batches
        ]
        tell("pass", 0, len(todo))
        done = 0
        failed: dict[np.datetime64, dict[str, str]] = {}
        for job, outcome in zip(
            jobs,
            each_result(client, evidence_batch, [(cat, mission, plan, index, job) for job in jobs]),
            strict=True,
        ):
            kept |= {day.day: day for day in take_outcome(run, dataset, outcome, failed)}
            done += len(job.days)
            tell("pass", done, len(todo))
        if not kept:
            raise WorkerError(
                f"no block of the span could be made; the first: {next(iter(failed.values()))['message']}",
                remedy="see the message; 'inflight compare' shows single days",
            )
        run.publish(supersede=True)
        return run.id, [kept[day] for day in sorted(kept)]


def _of(told: Mapping[np.datetime64, Any], days: Sequence[np.datetime64]) -> dict[np.datetime64, Any]:
    return {day: told[day] for day in days}
