"""The pipeline of the whole-mission fit: a vector sensor against a scalar instrument, all days at once."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day
from inflight.figures import Section
from inflight.mission import Mission
from inflight.tasks.pipelines.base import (
    Batch,
    CompareResult,
    Pipeline,
    Plan,
    ProductBatch,
    Report,
    Reprocessing,
    ReprocessSettings,
    Solved,
    TablesReport,
    TextLine,
    Versions,
    content_keys,
    newest_record,
    page_sections,
    residual_of_days,
)
from inflight.tasks.pipelines.mission.day import AuxiliaryChannels, mission_statistics, unify_variables
from inflight.tasks.pipelines.mission.fit import STATISTICS, fit_mission_tables, save_fitted, spread_offsets
from inflight.tasks.pipelines.scalar import ScalarPipeline, level2_day
from inflight.tasks.report import Progress

#: Parameters listed at most.
_MOST = 15


class MissionPipeline(Pipeline):
    """Everything the model lets data move, fitted to all days at once; scale factors follow a trend in time.

    A day leaves wide normal equations and what only its samples can witness: the torquers' band, currents
    that step, means of channels (Yin 2010; `inflight.mission_fit`). The fitted model is saved as a version of
    its own, and products are made with it, so that no day jumps against its neighbour.
    """

    tag = "mission"
    versions = Versions(statistics=3, tables=5, products=4)
    statistics = STATISTICS

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a scalar comparison whose days are to be fitted at once."""
        return mission.comparisons[settings.comparison].kind == "scalar" and settings.table == "continuous"

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return currents, torquers and the sensor's temperatures."""
        return AuxiliaryChannels.of(mission, comparison).names

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's wide equations with the parts beside them; see `chain_day`."""
        return mission_statistics(batch, day)

    def unify_variables(self, days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        """Return days with the same variables; what a day lacks it has no rows of."""
        return unify_variables(days)

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> Solved:
        """Fit all days, stage the tables that their parts allow, and save the fitted model."""
        plan, keep = work.plan, self.table_stager(work, days)
        result = fit_mission_tables(work.cat, work.mission, plan, days, self.table_key(plan, "", days)[:16])
        for name, table in result.tables.items():
            keep.table(name, partial(_itself, table))
        model = save_fitted(work.cat, plan.model, work.run, result.found)
        chosen = [model.sha, str(plan.settings.distribute)]
        return keep.solved("continuous", model, result.skipped, chosen)

    def table_key(self, plan: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
        """Return the key of a table: a hash of the days' statistics and of the trend asked for."""
        versions, settings = self.versions, plan.settings
        told = [
            name,
            str(versions.statistics),
            str(versions.tables),
            settings.trend,
            str(settings.origin),
            plan.context,
        ]
        return hashlib.sha256("".join([*content_keys(days), *told]).encode()).hexdigest()

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's calibrated field; its report holds the spread of the residual, too."""
        return level2_day(batch, day, batch.settings.distribute)

    def finish(
        self,
        work: Reprocessing,
        days: Mapping[np.datetime64, Day],
        solved: Solved,
        reports: Mapping[np.datetime64, Mapping[str, Any]],
    ) -> None:
        """Stage the table of daily offsets that the spread of the products' residuals tells."""
        table = spread_offsets(reports)
        if isinstance(table, str):
            solved.notes["z-offset"] = table
            return
        keep = self.table_stager(work, days)
        keep.table("z-offset", partial(_itself, table))
        solved.certify.extend(keep.certify)

    def results(self, work: Reprocessing, solved: Solved | None) -> dict[str, Any]:
        """Return the residual, the fitted model, and the tables that could not be made."""
        if solved is None:
            return {"residual": {}}
        return {
            "residual": residual_of_days(work),
            "model": {"name": solved.model.name, "version": solved.model.version},
            "left_out": solved.notes,
        }

    def compare(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        days: Sequence[Day],
        span: slice,
        progress: Progress,
    ) -> CompareResult[Any]:
        """Measure the residual of each sample, as for tables of days and windows."""
        return ScalarPipeline().compare(cat, mission, comparison, days, span, progress)

    def report(
        self, cat: Catalog, mission: Mission, comparison: str, output: Path | None = None, cause: str = ""
    ) -> Report:
        """Return what all days together told, section by section; see `chain_report`."""
        from inflight.tasks.pipelines.mission.report import mission_fit_report

        fields = mission_fit_report(cat, mission, comparison, output, cause).as_json()
        return TablesReport(fields, summary_lines(fields), output)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the sections of `report` when all days were ever fitted at once; else none."""
        if newest_record(cat, f"{comparison}-continuous") is None:
            return []
        from inflight.tasks.pipelines.mission.report import mission_fit_report

        return page_sections(mission_fit_report(cat, mission, comparison).parts)


def _itself(table: xr.Dataset) -> xr.Dataset:
    return table


def summary_lines(fields: Mapping[str, Any]) -> list[TextLine]:
    """Return residual, trend, what went far from what was known, what was found, and what is not told."""
    sections = fields["sections"]
    size = sections["residual"]
    first, last = fields["span"]
    product = size["products_nT"]
    after = f", {product:.4g} nT in the products of all days together" if isfinite(product) else ""
    lines = [
        f"residual {size['before_nT']:.4g} nT before, {size['own_fit_nT']:.4g} nT with each day's own nine"
        f"{after}",
        f"scale factors: {sections['trend']['kind']}; {sections['trend'].get('told', 'no rivals compared')}",
        *_coefficients(sections["coefficients"]["items"]),
        *(sections["clock_faults"].get("told") or []),
        *_cross_talk(sections["cross_talk"].get("asked")),
    ]
    absent = [
        f"  not told: {what}: {why}"
        for section in sections.values()
        for what, why in section["absent"].items()
    ]
    title = f"{fields['model']}: {fields['days']} days, {first} to {last}"
    return [
        TextLine(title, "bold"),
        *(TextLine(f"  {line}") for line in lines),
        *(TextLine(line, "dim") for line in absent),
    ]


def _cross_talk(told: Mapping[str, Any] | None) -> list[str]:
    """Return what one ignored cause does: everything else fitted, and the nine alone; largest first."""
    out = []
    for key, how in (("alone", "the nine fitted alone"), ("together", "everything else fitted")):
        rows = (told or {}).get(key)
        if told and rows:
            out.append(f"ignoring {told['ignored']} = {told['size']:g} {told['size_unit']}, {how}:")
            far = sorted(rows, key=lambda one: -abs(one["shift"]) / max(one["sigma"], 1e-300))
            out += [
                f"  {one['parameter']} {one['shift']:+.4g} ± {one['sigma']:.2g} {one['unit']}"
                for one in far[:_MOST]
            ]
    return out


def _coefficients(items: list[Mapping[str, Any]]) -> list[str]:
    known = sum(one["determined"] for one in items)
    head = f"{len(items)} coefficients, {known} determined;"
    far = [one for one in items if abs(one["shift_sigma"] or 0.0) > 3.0]
    if not far:
        return [f"{head} none is beyond 3 sigma of what was known before"]
    return [
        f"{head} beyond 3 sigma of what was known before:",
        *(
            f"  {one['name']} {one['value']:.6g} ± {one['sigma']:.2g} {one['unit']} "
            f"({one['shift_sigma']:+.1f})"
            for one in sorted(far, key=lambda one: -abs(one["shift_sigma"]))
        ),
    ]
