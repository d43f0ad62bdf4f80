"""The pipeline of a vector sensor against a scalar instrument, by days, windows, months or one span."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Batch,
    Pipeline,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    Versions,
    month_edges,
    residual_of_days,
    window_edges,
)

if TYPE_CHECKING:
    import xarray as xr

    from inflight.calibration import NormalEquations
    from inflight.figures import Section
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Job, Report


class ScalarPipeline(Pipeline):
    """Nine parameters of a vector sensor from the field strength that a scalar instrument measures.

    Statistics of a day are its normal equations; tables of days, windows, months and the span are solved from
    their sums (`inflight.calibration`). The product is the calibrated field, its residual the difference of
    the field strengths.
    """

    tag = "scalar"
    versions = Versions(statistics=5, tables=7, products=9)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a scalar comparison, unless all days are to be fitted at once."""
        return mission.comparisons[settings.comparison].kind == "scalar" and settings.table != "continuous"

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's normal equations and its own fit; see `calibrate_day`."""
        from inflight.tasks.pipelines.scalar.day import calibrate_day

        return calibrate_day(batch, day)

    def linearise_at(
        self, work: Reprocessing, days: Mapping[np.datetime64, Day], last: Sequence[float] | None
    ) -> list[float] | None:
        """Return the solution of all days, when the equations' linearisation error there is too large."""
        from inflight.tasks.pipelines.scalar.tables import relinearise_at

        strength = float(np.median([day.report.get("strength_nT", 4e4) for day in days.values()]))
        value = relinearise_at(_equations(work, days), work.plan.model, strength, last)
        return None if value is None else value.tolist()

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the daily, window and whole-span tables, and the monthly one when it is asked for."""
        from inflight.tasks.pipelines.scalar.day import estimate_of
        from inflight.tasks.pipelines.scalar.tables import daily_table, keep_joined, window_table

        plan, stager = work.plan, self.table_stager(work, days)
        equations, model = _equations(work, days), plan.model
        keep_joined(work.cat, work.run, equations, list(days.values()))
        edges = {
            "window": window_edges(min(days), max(days), plan.settings.window_days),
            "span": [min(days), max(days) + ONE_DAY],
        }
        if plan.settings.table == "monthly":
            edges["monthly"] = month_edges(min(days), max(days))
        form = estimate_of(work.mission, plan.settings.comparison)
        finer = [stager.table("daily", partial(daily_table, equations, model, form, work.progress))]
        for name, bounds in edges.items():
            make = partial(window_table, equations, model, bounds, name, tuple(finer), form, work.progress)
            finer.insert(0, stager.table(name, make))
        return stager.solved(plan.settings.table, model)

    def rows_for(self, table: xr.Dataset, job: Job) -> xr.Dataset:
        """Return the intervals that hold for the days of a batch."""
        from inflight.calibration import rows_within

        return rows_within(table, *job.span)

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's calibrated field; see `level2_day`."""
        from inflight.tasks.pipelines.scalar.product import level2_day

        return level2_day(batch, day)

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the residual of the planned days."""
        return {"residual": residual_of_days(work) if solved else {}}

    def compare(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        days: Sequence[Day],
        span: slice,
        progress: Progress,
        client: Any = None,
        earlier: EarlierProducts | None = None,
    ) -> CompareResult[Any]:
        """Measure the residual of each sample; see `compare_samples`."""
        from inflight.tasks.pipelines.scalar.compare import compare_samples

        return compare_samples(cat, mission, comparison, days, span, progress, client, earlier)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Refuse: tables of days and windows are shown as `sections`, and by ``compare``."""
        raise CatalogError(
            f"tables of '{comparison}' by days and windows have no report of their own",
            remedy="'inflight compare' shows them; 'reprocess --table continuous' fits all days at once",
        )

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return parameters over days with errors, and their newest values."""
        from inflight.tasks.pipelines.scalar.sections import table_sections

        return table_sections(cat, comparison)


def _equations(work: Reprocessing, days: Mapping[np.datetime64, Day]) -> NormalEquations:
    """Return the equations of days: read once, though they are asked for where they are linearised, too."""
    from inflight.tasks.pipelines.scalar.tables import load_equations

    # Where the rows lie, not the days' ids: days linearised anew in a run keep theirs.
    these = frozenset((day.segment, day.rows) for day in days.values())
    if work.statistics is None or work.statistics[0] != these:
        work.statistics = these, load_equations(work.cat, list(days.values()), work.progress)
    return cast("NormalEquations", work.statistics[1])
