"""The pipeline of a vector sensor against nature: averages of days, zero levels, the field without them.

`ZeroLevelPipeline` takes an instrument, or the product of another comparison of it: of two sensors on a boom
the corrected field, whose constant part these levels are. That product may have had such a level taken off
already; it is put back first, so that both comparisons agree however often each is run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.calibration import change_outside, outside_learnt
from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, CatalogError
from inflight.flags import Flag
from inflight.mission import Mission, ZeroLevelComparison, sensors_of
from inflight.model import instrument_variance
from inflight.progress import Progress, silent, tell_each
from inflight.tasks.archive import ArchiveIndex, split_at_flips
from inflight.tasks.models import current_model
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Batch,
    Part,
    Pipeline,
    Plan,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesReport,
    TablesToPublish,
    Versions,
    equations_of,
    month_edges,
    newest_table,
    page_sections,
    plan_days,
    product_of,
    rounded,
    window_edges,
)
from inflight.tasks.pipelines.zero_level.day import (
    averaging_of,
    day_averages,
    product_variables,
    read_field,
    row_at,
    size_variation,
    zero_level_of,
)
from inflight.tasks.pipelines.zero_level.report import (
    ZeroLevelReport,
    combine_variations,
    describe_row,
    level_lines,
    method_rows,
    rows_as_json,
    step_rows,
    steps_as_json,
    variation_html,
)
from inflight.tasks.pipelines.zero_level.tables import (
    BEFORE_ZERO_LEVEL,
    NAMES,
    DayMeans,
    edges_of_constants,
    step_table,
    zero_level_table,
)
from inflight.tasks.report import write_page
from inflight.time import SECOND, DayLike, day_bounds, is_within, usual_step
from inflight.zero_level import AXES

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import LazySection, Section
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Report

#: Flags of samples that count in the coverage.
_HARMLESS = (
    Flag.LEAP_SECOND | Flag.NO_ATTITUDE | Flag.PRIOR_PARAMETERS | Flag.EXTRAPOLATED | Flag.NOT_CORRECTED
)


class ZeroLevelPipeline(Pipeline):
    """Three offsets of a vector sensor from what natural fluctuations of the field do not do.

    The statistics of a day are averages of its readings, over whole turns where the spacecraft spins
    (Hedgecock's rule). Tables have the joint estimate of the methods with the test of each one's assumption
    (`inflight.zero_level`). The product is the field without the zero level; its residual the variation of
    the field's size in intervals in which the field turns.
    """

    tag = "zero_level"
    versions = Versions(statistics=1, tables=2, products=1)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a comparison of a vector sensor with nature."""
        return mission.comparisons[settings.comparison].kind == "zero_level"

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done; a day of a product is made of that product alone.

        Raises
        ------
        MissionError
            When all days are to be fitted at once.
        CatalogError
            When there is no day to work on.
        """
        self.refuse_continuous(
            settings,
            "no trend in time is fitted to zero levels",
            "--table span takes all days together; daily, window and monthly show what changes",
        )
        product = zero_level_of(mission, settings.comparison).product
        if product is None:
            return super().make_plan(cat, mission, settings, span)
        days = {
            day.day: replace(day, key=str(day.report.get(BEFORE_ZERO_LEVEL, day.key)))
            for day in cat.days(product_of(product), states=("published",))
            if is_within(day.day, *span)
        }
        if not days:
            raise CatalogError(
                f"no day has a product of '{product}'",
                remedy=f"run 'inflight reprocess --comparison {product}' first",
            )
        return plan_days(
            cat,
            mission,
            settings,
            used=current_model(cat, mission, settings.comparison),
            equations=equations_of(settings.comparison),
            version=self.versions.statistics,
            index=ArchiveIndex({(day.dataset, day.day): day for day in days.values()}),
            sources={day: (days[day],) for day in sorted(days)},
        )

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's averages: `mean` (block, mean, axis) nT, `mean_time` (block, mean).

        Raises
        ------
        CalibrationError
            When no sample of the day is usable.
        """
        read = read_field(batch, day)
        rule = averaging_of(batch.mission, zero_level_of(batch.mission, batch.settings.comparison))
        made = day_averages(read, rule, day_bounds(day))
        used = int(np.isfinite(made["mean"].values).all(axis=2).sum())
        return made, {"used": used, "basis": read.basis, "constant": read.constant}

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables of days, windows, months and the span, and that of steps where it is asked for.

        No window holds two positions of a flipper, or two constant parts of the product it is made from.
        """
        plan, mission, keep = work.plan, work.mission, self.table_stager(work, days)
        entry, ordered = zero_level_of(mission, plan.settings.comparison), sorted(days)
        if not ordered:
            raise CalibrationError("no day has usable averages", remedy="look at the problems of the days")
        means = [
            DayMeans.of(work.cat.read(days[day]), days[day].report)
            for day in tell_each(work.progress, "statistics", ordered)
        ]
        attributes = {"comparison": plan.settings.comparison, "model": plan.model.sha, "kind": "zero_level"}
        first, after = ordered[0], ordered[-1] + ONE_DAY
        how: Any = {"attributes": attributes, "made": {}, "progress": work.progress}
        make = partial(zero_level_table, means, entry, **how)
        daily = keep.table("daily", partial(make, [*ordered, after]))
        windows = {
            "window": window_edges(first, ordered[-1], plan.settings.window_days),
            "monthly": month_edges(first, ordered[-1]),
            "span": [first, after],
        }
        for name, edges in windows.items():
            bounds = edges_of_constants(means, split_at_flips(edges, mission))
            keep.table(name, partial(make, bounds, daily=daily))
        average = averaging_of(mission, entry).length / SECOND
        steps = {"steps": partial(step_table, means, entry, average, attributes)} if entry.step else {}
        return keep.solved(plan.settings.table, plan.model, keep.stage_possible(steps))

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's field without the zero level, with the uncertainty of both, and a report."""
        read, table, span = read_field(batch, day), batch.table, day_bounds(day)
        row = row_at(table, sum(span) // 2)
        value, known = np.asarray(row["value"].values), row["determined"].values.astype(bool)
        covariance = np.asarray(row["covariance"].values)
        outside, change = outside_learnt(row, read.tt2000), change_outside(row, table, span, NAMES)
        variance = np.broadcast_to(np.diag(covariance), read.field.shape) + read.sigma**2
        if change is not None:
            variance = np.where(outside[:, None], variance + change**2, variance)
        flag = np.where(outside, read.flag | np.uint32(Flag.EXTRAPOLATED), read.flag)
        entry = zero_level_of(batch.mission, batch.settings.comparison)
        if not known[[AXES.index(axis) for axis in entry.axes]].all():
            flag = flag | np.uint32(Flag.PRIOR_PARAMETERS)
        calibrated = read.field - value
        if entry.product is None:  # a product has it in its own uncertainty
            sensor = sensors_of(batch.mission, batch.settings.comparison)[entry.vector]
            mounting = read.orientation is not None
            variance = variance + instrument_variance(sensor, calibrated, read.tt2000, mounting=mounting)
        product = rounded(product_variables(read, calibrated, np.sqrt(variance), flag)).assign_attrs(
            mission=batch.mission.mission,
            acknowledgement=batch.mission.acknowledgement,
            day=str(day),
            comparison=batch.settings.comparison,
            zero_level_nT=value.tolist(),
            zero_level=describe_row(row, entry),
        )
        good = (flag & ~np.uint32(_HARMLESS)) == 0
        step = usual_step(read.tt2000, 1)
        report: dict[str, Any] = {
            "coverage": float(good.sum() * step / (span[1] - span[0])),
            "samples": int(good.sum()),
            "zero_level": str(product.attrs["zero_level"]),
        }
        return product, report | size_variation(read, entry, averaging_of(batch.mission, entry), value)

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the variation of the field's size, each window's level, and bad averages."""
        published = work.cat.days(work.plan.product, states=("published",))
        reports = [day.report for day in published if day.day in work.plan.keys]
        entry = zero_level_of(work.mission, work.plan.settings.comparison)
        out: dict[str, Any] = {
            "residual": combine_variations(reports) if solved else {},
            "averaging": averaging_of(work.mission, entry).warnings,
        }
        if solved is None:
            return out
        tables = {used.number: used.table for used in solved.used.values()}
        out["zero_levels"] = [one for table in tables.values() for one in rows_as_json(table, entry)]
        return out | ({"left_out": solved.notes} if solved.notes else {})

    def remarks(self, fields: Mapping[str, Any]) -> Iterator[str]:
        """Yield which zero levels could not be told and why, and averages that are not over whole turns."""
        yield from fields.get("averaging", ())
        for one in fields.get("zero_levels", ()):
            if one["not_determined"]:
                axes = " and ".join(one["not_determined"])
                span = f"{one['start']} to {one['end']}"
                yield f"{span}: the zero level along {axes} is not told: {one['reason']}"
        yield from super().remarks(fields)

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
    ) -> CompareResult[ZeroLevelReport]:
        """Return the variation of the field's size before and after, and the zero levels with their tests."""
        from inflight.tasks.pipelines.base import CompareResult

        entry = zero_level_of(mission, comparison)
        used = str(cat.read(days[-1], ["flag"]).attrs["calibration_table"]).partition(":")[0]
        table = newest_table(cat, used)
        levels = [] if table is None else rows_as_json(table, entry)
        report = ZeroLevelReport(comparison, [{"day": str(day.day), **day.report} for day in days], levels)
        title = f"{mission.mission}: zero level, {days[0].day} to {days[-1].day}"
        parts: list[LazySection] = [("Variation of the size", lambda: ([variation_html(report)], []))]
        parts += [
            (heading, partial(lambda text, plots: (text, plots), text, plots))
            for heading, text, plots in self.sections(cat, mission, comparison, progress)
        ]
        return CompareResult(report, title, parts)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return zero levels, methods and tests of the newest tables, and write their page when asked."""
        entry, table = zero_level_of(mission, comparison), newest_table(cat, f"{comparison}-window")
        if table is None:
            raise CatalogError(
                f"no tables are published for comparison '{comparison}'",
                remedy=f"run 'inflight reprocess --comparison {comparison}' first",
            )
        if output is not None:
            from inflight.figures import html_page

            title = f"{mission.mission}: zero level of {entry.vector}"
            sections = self.sections(cat, mission, comparison, progress)
            write_page(output, html_page(title, sections, mission.acknowledgement))
        levels = rows_as_json(table, entry)
        steps = newest_table(cat, f"{comparison}-steps") if entry.step else None
        fields = {"comparison": comparison, "zero_levels": levels, "steps": steps_as_json(steps)}
        return TablesReport(fields, level_lines(comparison, levels), output)

    def sections(
        self, cat: Catalog, mission: Mission, comparison: str, progress: Progress = silent
    ) -> list[Section]:
        """Return zero levels, what each method says, and the tests of their assumptions."""
        table = newest_table(cat, f"{comparison}-window")
        if table is None:
            return []
        entry, daily = zero_level_of(mission, comparison), newest_table(cat, f"{comparison}-daily")
        steps = newest_table(cat, f"{comparison}-steps") if entry.step else None
        makers = [
            partial(_levels, table, daily, entry),
            partial(_methods, table, entry),
            partial(_assumptions, table),
            *([] if steps is None else [partial(_steps, steps, entry)]),
        ]
        return page_sections([make() for make in tell_each(progress, "sections", makers)])


def _levels(table: xr.Dataset, daily: xr.Dataset | None, entry: ZeroLevelComparison) -> Part:
    """Return the zero level of each window, and those of days beside them."""
    from inflight.figures import html_table, parameter_figures

    part = Part("zero_level", "Zero levels")
    head = ("from", "to", *AXES, "methods")
    rows = [
        (one["start"], one["end"], *(one["sentence"][axis] for axis in AXES), one["method"])
        for one in rows_as_json(table, entry)
    ]
    part.text.append(html_table(head, rows))
    part.plots = [] if daily is None else list(parameter_figures(daily, table))
    return part


def _methods(table: xr.Dataset, entry: ZeroLevelComparison) -> Part:
    """Return what each method says by itself."""
    from inflight.figures import html_table, zero_methods_figure

    part = Part("methods", "Each method by itself")
    last = table.isel(interval=-1)
    part.text.append(html_table(("method", "intervals", *AXES, "remarks"), method_rows(last)))
    told = table.assign(sigma=table["sigma"].where(table["determined"], np.inf))
    part.plots = [
        zero_methods_figure(told.isel(parameter=AXES.index(axis)), f"Zero level along {axis} by method")
        for axis in entry.axes
    ]
    return part


def _assumptions(table: xr.Dataset) -> Part:
    """Return the tests of what the methods assume, in the last window."""
    from inflight.figures import bullet_list

    part = Part("assumptions", "What the methods assume")
    last = table.isel(interval=-1)
    sentences = [str(one) for one in last["assumption_text"].values if str(one)]
    part.text.append(bullet_list(sentences) if sentences else str(last["reason"].values))
    return part


def _steps(steps: xr.Dataset, entry: ZeroLevelComparison) -> Part:
    """Return the zero levels of steps of some hours."""
    from inflight.figures import html_table

    assert entry.step is not None
    part = Part("steps", f"Steps of {entry.step / (3600 * SECOND):g} h")
    part.add_text("Results by themselves, too uncertain to correct a field with.")
    part.text.append(html_table(("from", *AXES), step_rows(steps)))
    return part
