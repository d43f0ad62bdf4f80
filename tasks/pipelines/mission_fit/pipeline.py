"""The pipeline of the whole-mission fit: a vector sensor against a scalar instrument, all days at once.

Statistics of a day are made in `day.py`, tables in `fit.py` and `tables.py`, the report in `report.py`; the
product is that of the scalar pipeline, made with the fitted model.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.batches import end_processes
from inflight.tasks.pipelines.base import (
    ALL_DAYS_STATISTICS,
    Batch,
    Pipeline,
    Plan,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    Versions,
    content_keys,
    newest_record,
    residual_of_days,
)
from inflight.tasks.pipelines.scalar import ScalarPipeline

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Job, Report


#: Statistics of more days than these leave the processes that made them no room.
_MANY_DAYS = 1000


class MissionPipeline(Pipeline):
    """Everything the model lets data move, fitted to all days at once; scale factors follow a trend in time.

    The statistics of a day are wide normal equations, and what only its samples can tell: the torquers' band,
    currents that step, means of channels (Yin 2010; `inflight.mission_fit`). The fitted model is saved as a
    version of its own, and products are made with it, so that no day jumps against its neighbour.
    """

    tag = "mission"
    versions = Versions(statistics=5, tables=11, products=9)
    statistics = ALL_DAYS_STATISTICS
    #: Four periods of the filter of `inflight.calibration.product.distribute_residual`: beyond, its response
    #: is below 1e-5.
    reach_s = 320.0

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a scalar comparison whose days are to be fitted at once."""
        return mission.comparisons[settings.comparison].kind == "scalar" and settings.table == "continuous"

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return currents, torquers and the sensor's temperatures."""
        from inflight.tasks.pipelines.mission_fit.day import AuxiliaryChannels

        return AuxiliaryChannels.of(mission, comparison).names

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's wide equations with their parts; see `mission_statistics`."""
        from inflight.tasks.pipelines.mission_fit.day import mission_statistics

        return mission_statistics(batch, day)

    def unify_variables(self, days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        """Return days with the same variables; of a part a day lacks, no row counts."""
        from inflight.tasks.pipelines.mission_fit.day import unify_variables

        return unify_variables(days)

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Fit all days, stage the tables that their parts allow, and save the fitted model."""
        from inflight.tasks.pipelines.mission_fit.fit import fit_mission_tables, save_fitted

        plan, stager = work.plan, self.table_stager(work, days)
        fit_key = self.table_key(plan, "", days)[:16]
        if len(days) > _MANY_DAYS:
            # Their fit needs the memory; starting processes again costs some seconds.
            end_processes(work.client)
        result = fit_mission_tables(work.cat, work.mission, plan, days, fit_key, work.progress)
        for name in result.tables:
            stager.table(name, partial(result.required, name))
        model = save_fitted(work.cat, plan.model, work.run, result.found)
        return stager.solved(
            "continuous", model, result.skipped, inputs=[model.sha, str(plan.settings.distribute)]
        )

    def table_key(self, plan: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
        """Return the key of a table: a hash of the days' statistics and of the settings of the trend."""
        versions, settings = self.versions, plan.settings
        inputs = [
            name,
            str(versions.statistics),
            str(versions.tables),
            settings.trend,
            str(settings.origin),
            plan.context,
        ]
        return hashlib.sha256("".join([*content_keys(days), *inputs]).encode()).hexdigest()

    def rows_for(self, table: xr.Dataset, job: Job) -> xr.Dataset:
        """Return the rows of the days of a batch."""
        return ScalarPipeline().rows_for(table, job)

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's calibrated field; its report holds the spread of the residual, too."""
        from inflight.tasks.pipelines.scalar import level2_day

        return level2_day(batch, day, batch.settings.distribute)

    def finish(
        self,
        work: Reprocessing,
        days: Mapping[np.datetime64, Day],
        solved: TablesToPublish,
        reports: Mapping[np.datetime64, Mapping[str, Any]],
    ) -> None:
        """Stage the daily offsets from the spread of the products' residuals, and the law of the spread."""
        from inflight.tasks.pipelines.mission_fit.fit import z_offset_law
        from inflight.tasks.pipelines.mission_fit.tables import slope_offsets, spread_offsets

        stager = self.table_stager(work, days)
        makers = {
            "z-offset": lambda: spread_offsets(reports),
            "z-offset-slope": lambda: slope_offsets(reports),
            "z-offset-law": lambda: z_offset_law(work.cat, days, solved, reports),
        }
        solved.notes.update(stager.stage_possible(makers))
        solved.certify.extend(stager.certify)

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the residual, the fitted model, and the tables that could not be made."""
        if solved is None:
            return {"residual": {}}
        comparison = work.plan.settings.comparison
        form = getattr(work.mission.comparisons[comparison], "estimate", "exact")
        note = (
            f"comparisons.{comparison}.estimate: '{form}' makes tables of days, windows, months and spans; "
            "the fit of all days takes the exact equations"
        )
        return {
            "residual": residual_of_days(work),
            "model": {"name": solved.model.name, "version": solved.model.version},
            "left_out": solved.notes,
            "warnings": [note] if form != "exact" else [],
        }

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
        """Measure the residual of each sample, as for tables of days and windows."""
        return ScalarPipeline().compare(cat, mission, comparison, days, span, progress, client, earlier)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return the results of the fit, section by section; see `mission_fit_report`."""
        from inflight.tasks.pipelines.mission_fit.report import mission_fit_report

        return mission_fit_report(cat, mission, comparison, output, cause, progress)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the sections of `report` when a whole-mission fit was ever published; else none."""
        from inflight.tasks.pipelines.base import page_sections

        if newest_record(cat, f"{comparison}-continuous") is None:
            return []
        from inflight.tasks.pipelines.mission_fit.report import mission_fit_report

        return page_sections(mission_fit_report(cat, mission, comparison).parts)
