"""The pipeline of a sensor on a spinning spacecraft, calibrated by the spin itself.

`SpinPipeline` names the steps in the order of a reprocessing: statistics of a day (`day.py`), tables
(`tables.py`), products (`product.py`), comparison and report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.errors import CalibrationError, MissionError
from inflight.main_field import MainField
from inflight.mission import Mission
from inflight.model import Model
from inflight.progress import Progress, silent, tell_each
from inflight.spin import HELD
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Batch,
    Pipeline,
    Plan,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    Versions,
    month_edges,
    newest_table,
    residual_of_days,
    window_edges,
)
from inflight.time import DayLike

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Report, TextLine

#: Replaced parameters that the command line lists, the newest.
_LISTED = 15


class SpinPipeline(Pipeline):
    """Eight of twelve parameters from the tones that their errors make at the spin and at twice it.

    The statistics of a day are its joint estimate, that of each sub-interval, and quiet averages (Plaschke et
    al. 2019); the offset along the spin axis comes from many hours of natural fluctuations
    (`inflight.zero_level`). The product is the despun field; its residual is its spin tones.
    """

    tag = "spin"
    versions = Versions(statistics=5, tables=7, products=8)

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a spin comparison."""
        return mission.comparisons[settings.comparison].kind == "spin"

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done.

        Raises
        ------
        MissionError
            When all days are to be fitted at once, a field model has no file, or the pre-flight model lets it
            tell nothing.
        """
        self.refuse_continuous(settings, "no trend in time is fitted to spin tones")
        plan = super().make_plan(cat, mission, settings, span)
        entry = mission.comparisons[settings.comparison]
        if entry.kind == "spin" and entry.field_model is not None:
            MainField.of(entry.field_model.model, Path(cat.workspace))
            _require_a_parameter_to_tell(plan.model)
        return plan

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return the channel that tells eclipses; none where they are computed, or not asked for."""
        from inflight.tasks.pipelines.spin.orbit import COMPUTED

        entry = mission.comparisons[comparison]
        named = entry.eclipse if entry.kind == "spin" else None
        return () if named in (None, COMPUTED) else (named,)

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's estimates; see `spin_day`."""
        from inflight.tasks.pipelines.spin.day import spin_day

        return spin_day(batch, day)

    def unify_variables(self, days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        """Return days padded with empty sub-intervals and means; see `pad_days`."""
        from inflight.tasks.pipelines.spin.day import pad_days

        return pad_days(days)

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables: zero levels, each day, windows, months, the whole span.

        The offset along the spin axis needs many hours of solar wind: days and months use that of their
        calendar month, windows and the span those of the windows. No window holds two positions of a flipper.
        """
        from inflight.tasks.archive import flips_of, split_at_flips
        from inflight.tasks.pipelines.spin.tables import flipper_table, spin_table, zero_level_table

        if not any(day.report["used"] for day in days.values()):
            earliest = days[min(days)]
            raise CalibrationError(
                f"no day of the span tells anything of the sensor; {earliest.day}: "
                f"{earliest.report['phase']}; {earliest.report['told']}",
                remedy="look at the sun pulses or the angle, the stated spin period and the flags of the "
                "field",
            )
        plan, mission, keep = work.plan, work.mission, self.table_stager(work, days)
        settings, model, ordered = plan.settings, plan.model, sorted(days)
        read = [work.cat.read(days[day]) for day in tell_each(work.progress, "statistics", ordered)]
        first, last = ordered[0], ordered[-1]
        windows = split_at_flips(window_edges(first, last, settings.window_days), mission)
        months = split_at_flips(month_edges(first, last), mission)
        whole = split_at_flips([first, last + ONE_DAY], mission)
        along = partial(zero_level_table, read, model, progress=work.progress)
        by_window = keep.table("zero-level", partial(along, windows))
        by_month = keep.table("zero-level-monthly", partial(along, months))
        entry = mission.comparisons[settings.comparison]
        near_earth = entry.field_model if entry.kind == "spin" else None
        external = near_earth.external if near_earth else None
        makers = {
            "daily": ([*ordered, last + ONE_DAY], by_month),
            "window": (windows, by_window),
            "monthly": (months, by_month),
            "span": (whole, by_window),
        }
        for name, (bounds, zero) in makers.items():
            what = (model, bounds, name, zero, external, work.progress)
            keep.table(name, partial(spin_table, read, *what))
        flips = {"flipper": partial(flipper_table, read, model, whole, mission)} if flips_of(mission) else {}
        return keep.solved(settings.table, model, keep.stage_possible(flips))

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's despun field; see `spin_product`."""
        from inflight.tasks.pipelines.spin.product import spin_product

        return spin_product(batch, day)

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the residual of the planned days, and the tables that could not be made."""
        if solved is None:
            return {"residual": {}}
        return {"residual": residual_of_days(work)} | ({"left_out": solved.notes} if solved.notes else {})

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
        """Measure the tones of the products; see `compare_spin`."""
        from inflight.tasks.pipelines.spin.compare import compare_spin

        return compare_spin(cat, mission, comparison, days, progress)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return the twelve parameters, where each came from, and what each day decided."""
        from inflight.tasks.pipelines.base import TablesReport
        from inflight.tasks.pipelines.spin.report import spin_report

        fields = spin_report(cat, mission, comparison, output)
        return TablesReport(fields, summary_lines(fields), output)

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the sections of `report`, when all of its tables are published."""
        from inflight.tasks.pipelines.base import page_sections
        from inflight.tasks.pipelines.spin.tables import TABLES, SpinResults

        if any(newest_table(cat, f"{comparison}-{name}") is None for name in TABLES):
            return []
        from inflight.tasks.pipelines.spin.report import spin_table_parts

        return page_sections(spin_table_parts(SpinResults.of(cat, mission, comparison)))


def _require_a_parameter_to_tell(model: Model) -> None:
    from inflight.tasks.pipelines.spin.day import require_spinning

    entry = require_spinning(model)
    if not any(
        (one := entry.parameters[name.partition("[")[0]]).free and one.time == "block" for name in HELD
    ):
        raise MissionError(
            f"'field_model' is to tell {', '.join(HELD)}, and '{model.name}' holds all of them",
            file="mission.yaml",
            remedy="in the pre-flight model let those that it may tell be 'time: block', not 'free: false'",
        )


def summary_lines(fields: Mapping[str, Any]) -> list[TextLine]:
    """Return the twelve parameters with their origin, what days replaced, zero levels, and the phase."""
    from inflight.tasks.pipelines.base import TextLine, with_unit

    sections = fields["sections"]
    first, last = fields["span"]
    lines = [
        f"{one['name']:<17} {with_unit(one['value'], one['sigma'], one['unit'])}{_by_tones(one)}, "
        f"from {one['origin']}; "
        f"{f'{word}: ' if (word := one['decision']) else ''}{one['reason']}"
        for one in sections["twelve"]["items"]
    ]
    lines.append(f"these remain at their ground values: {', '.join(sections['twelve']['ground']) or 'none'}")
    replaced = [
        one for one in sections["days"]["items"] if one["decision"] == "update" and one["day"] != first
    ]
    lines += [f"{one['day']} replaced {one['name']}: {one['reason']}" for one in replaced[-_LISTED:]]
    lines += [f"drift of {name}: {one['sentence']}" for name, one in sections["zero_level"]["drift"].items()]
    lines += [f"{one['day']}: {one['told']}" for one in sections["phase"]["items"][-1:]]
    title = f"{fields['comparison']}: {fields['days']} days, {first} to {last}"
    return [TextLine(title, "bold"), *(TextLine(f"  {line}") for line in lines)]


def _by_tones(one: Mapping[str, Any]) -> str:
    """Return the error that tones alone have, where that of gains, rotation and third offset adds to it."""
    alone = one["conditional_sigma"]
    unit = "" if one["unit"] == "1" else f" {one['unit']}"
    return f" (± {alone:.1g}{unit} by the tones)" if alone < 0.7 * one["sigma"] else ""
