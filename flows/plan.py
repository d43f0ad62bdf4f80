"""The plan of a backfill, made and shown before anything is done."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from inflight.catalog import Catalog, Workspace
from inflight.flows.span import DaySpan
from inflight.tasks.pipelines import ReprocessSettings, pipeline_of


def plan_span(workspace: Workspace, start: str, end: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return which days of a span a backfill would do, from the archive as it is.

    Parameters
    ----------
    workspace : Workspace
        Where.
    start, end : str
        UTC days, half-open.
    settings : mapping
        Of `ReprocessSettings`.

    Returns
    -------
    dict
        ``context``; ``days`` with the counts ``planned``, ``unchanged`` and ``no_work``; ``batches`` with
        first day, last day and number of days of each.
    """
    span = DaySpan.model_validate({"start": start, "end": end}).as_text()
    asked = ReprocessSettings.model_validate(settings)
    cat, mission = Catalog(workspace.root), workspace.mission()
    pipeline = pipeline_of(mission, asked.comparison, asked)
    planned = pipeline.make_plan(cat, mission, asked, span)
    days, unchanged = pipeline.days_to_do(cat, planned)
    todo = planned.in_batches(days)
    batches = [[str(batch[0]), str(batch[-1]), len(batch)] for batch in todo]
    return {
        "context": planned.context,
        "days": {
            "planned": len(days),
            "unchanged": len(unchanged),
            "no_work": len(planned.no_work),
        },
        "batches": batches,
    }
