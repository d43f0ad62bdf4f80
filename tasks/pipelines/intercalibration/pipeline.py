"""The pipeline of two calibrated vector sensors: how they stand to each other, and no product."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.progress import Progress, silent, tell_each
from inflight.tasks.archive import ArchiveIndex
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import (
    Batch,
    Pipeline,
    Plan,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    Versions,
    equations_of,
    plan_days,
)
from inflight.tasks.pipelines.intercalibration.pair import NO_PRODUCT, RELATIONS, Pair
from inflight.tasks.pipelines.intercalibration.tables import calibration_errors
from inflight.time import DayLike, is_within

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section
    from inflight.tasks.pipelines.base import Report, TextLine

#: Days that the command line lists, the newest.
_LISTED = 15


class RelationPipeline(Pipeline):
    """How two calibrated vector sensors stand to each other, or how the boom between them bends.

    It compares the fields that both sensors' own comparisons made. It calibrates nothing and has no products.
    The statistics of a day are a few Gram matrices, or the bend, and the tables are algebra of these.
    """

    tag = "relation"
    versions = Versions(statistics=1, tables=2, products=0)
    has_products = False
    note = NO_PRODUCT

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for two vector sensors of which others calibrate at least one.

        `Pair.of` raises when a comparison is missing for the other one.
        """
        entry = mission.comparisons[settings.comparison]
        kinds = {relation.kind for relation in RELATIONS}
        others = (one.instruments()["vector"] for one in mission.comparisons.values() if one.kind in kinds)
        return entry.kind == "dual" and not set(entry.instruments().values()).isdisjoint(others)

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out which days have products of both sensors, and which of these are to be done.

        Raises
        ------
        MissionError
            When one of the sensors has no comparison that calibrates it.
        CatalogError
            When no day has the products of both.
        """
        pair = Pair.of(mission, settings.comparison)
        used = current_model(cat, mission, settings.comparison)
        first, second = (
            {day.day: day for day in cat.days(name, states=("published",)) if is_within(day.day, *span)}
            for name in pair.products
        )
        days = sorted(set(first) & set(second))
        if not days:
            raise CatalogError(
                f"no day has products of both '{pair.first}' and '{pair.second}'",
                remedy=f"run 'inflight reprocess' and 'inflight reprocess --comparison {pair.second}' first",
            )
        known = [one[day] for one in (first, second) for day in days]
        return plan_days(
            cat,
            mission,
            settings,
            used=used,
            equations=equations_of(settings.comparison),
            version=self.versions.statistics,
            index=ArchiveIndex({(day.dataset, day.day): day for day in known}),
            sources={day: (first[day], second[day]) for day in days},
        )

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the statistics of a day's two products; see `Relation.make_day`."""
        pair = Pair.of(batch.mission, batch.settings.comparison)
        sources = [batch.job.index.days[name, day] for name in pair.products]
        return pair.relation.make_day([batch.cat.read(source, pair.relation.read) for source in sources], day)

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables of the planned days; those that cannot be made have a note."""
        pair = Pair.of(work.mission, work.plan.settings.comparison)
        planned = {day: days[day] for day in work.plan.days if day in days}
        read = [work.cat.read(day) for day in tell_each(work.progress, "statistics", list(planned.values()))]
        keep = self.table_stager(work, planned)
        names = (pair.first, pair.second) if pair.relation.kind == "scalar" else ()
        errors = calibration_errors(work.cat, work.mission, names, list(planned.values()))
        makers = {name: partial(make, read, errors) for name, make in pair.relation.tables.items()}
        notes = keep.stage_possible(makers) if planned else {}
        return TablesToPublish(
            model=work.plan.model, used={}, certify=keep.certify, kept=tuple(keep.ids), notes=notes
        )

    def table_key(self, plan: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
        """Return the key of a table: a hash of the keys of the days it is made from."""
        inputs = [name, str(self.versions.tables), *(day.key for day in days.values())]
        return hashlib.sha256("".join(inputs).encode()).hexdigest()

    def outputs(self, plan: Plan, solved: TablesToPublish | None, made: int) -> list[str]:
        """Return the tables that could be made."""
        comparison = plan.settings.comparison
        return [f"tables/{comparison}-{name}" for name in solved.kept] if solved else []

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return why there is no product, and the tables that could not be made."""
        pair = Pair.of(work.mission, work.plan.settings.comparison)
        return {
            "note": pair.relation.note,
            "left_out": solved.notes if solved else {},
            "residual": {},
        }

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return how both sensors stand to each other, and which of the three disagrees."""
        from inflight.tasks.pipelines.base import TablesReport
        from inflight.tasks.pipelines.intercalibration.report import relation_report

        fields = relation_report(cat, mission, comparison, output)
        return TablesReport(fields, summary_lines(fields), output)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the sections of `report`; raises `CatalogError` when no table is published."""
        from inflight.tasks.pipelines.intercalibration.report import relation_parts

        return [(part.heading, part.text, part.plots) for part in relation_parts(cat, comparison)[1]]


def summary_lines(fields: Mapping[str, Any]) -> list[TextLine]:
    """Return how two vector sensors stand to each other, and which of the three disagrees."""
    from inflight.tasks.pipelines.base import TextLine, with_unit

    sections = fields["sections"]
    first, last = fields["span"]
    items = {name: section.get("items", []) for name, section in sections.items()}
    lines = [
        f"{one['name']} {with_unit(one['value'], one['sigma'], one['unit'])}"
        for one in items.get("relation", [])
    ]
    lines += [
        f"variance of the {one['sensor']} sensor {with_unit(one['variance'], one['sigma'], 'nT^2')}"
        for one in items.get("corners", [])
    ]
    lines += [
        f"{one['day']} bend {with_unit(one['value'], one['sigma'], one['unit'])}"
        for one in items.get("bending", [])[-_LISTED:]
    ]
    title = f"{fields['comparison']}: {fields['days']} days, {first} to {last}"
    return [TextLine(title, "bold"), *(TextLine(f"  {line}") for line in [*lines, fields["note"]])]
