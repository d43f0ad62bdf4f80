"""The pipeline of two sensors on one boom and nothing else: subtracts the field of states.

`StatesPipeline` names the steps in the order of a reprocessing: tables of windows (`windows.py`, `day.py`),
products (`day.py`) and comparison (`compare.py`). No statistics of days are kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.pipelines.base import (
    Pipeline,
    Plan,
    ProductBatch,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    UsedTable,
    Versions,
    product_key,
)
from inflight.time import DayLike

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section
    from inflight.tasks.pipelines.base import CompareResult, EarlierProducts, Report


class StatesPipeline(Pipeline):
    """States of the spacecraft found in the difference of two sensors, and their field subtracted.

    Each window of days is fitted by itself and then continues one before it; its table is certified, and
    every day is corrected with the table that holds (`inflight.dual`). No statistics of days are kept. The
    residual is the step of the outboard field where the spacecraft switches.
    """

    tag = "states"
    versions = Versions(statistics=3, tables=10, products=4)
    statistics = ""
    #: A switching is seen in what both sensors read before and after it: a record that was cut some samples
    #: from one had the wrong state there, by up to 2.5 nT in simulated ones.
    reach_s = 900.0
    learns_states = True

    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for two vector sensors on one boom, where nothing else calibrates either of them."""
        return mission.comparisons[settings.comparison].kind == "dual"

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done; raises `MissionError` when all days are to be fitted at once.

        A run is also made from the newest table of zero levels of its product.
        """
        from inflight.tasks.pipelines.two_sensor.constant import ZeroLevels

        self.refuse_continuous(
            settings,
            "states of two sensors follow no trend in time",
            "--table span learns the states from all days together; choose it, daily or window",
        )
        plan = super().make_plan(cat, mission, settings, span)
        levels = ZeroLevels.of(cat, mission, settings.comparison)
        if levels is None:
            return plan
        return replace(plan, recorded={**plan.recorded, "zero_level": levels.label})

    def days_to_do(self, cat: Catalog, plan: Plan) -> tuple[list[np.datetime64], list[np.datetime64]]:
        """Return the days whose products a run would make, and those it would leave alone.

        A window that is to be fitted changes those behind it: they are continued anew.
        """
        import xarray as xr

        from inflight.tasks.pipelines.two_sensor.constant import ZeroLevels, inputs_with_zero_level
        from inflight.tasks.pipelines.two_sensor.tables import TablesBefore, continued_key
        from inflight.tasks.pipelines.two_sensor.windows import StoredTables, table_name, window_key, windows

        name = table_name(plan)
        stored = StoredTables.of(cat, name)
        current = {day.day: day.key for day in cat.days(plan.product, states=("published",))}
        groups = windows(plan.days, plan.settings)
        before = TablesBefore.of_day(cat, name, groups[0][0])
        mission = Mission.parse(cat.context(plan.context).mission_text)
        levels = ZeroLevels.of(cat, mission, plan.settings.comparison)
        todo: list[np.datetime64] = []
        same: list[np.datetime64] = []
        for group in groups:
            key = continued_key(window_key(plan, group, self.versions.tables), before.keys)
            record = stored.continued.get(key)
            table = xr.Dataset() if record is None else cat.table_by_id(record.id)
            for day in group:
                inputs = (key,) if record is None else inputs_with_zero_level(levels, name, table, key, day)
                own = product_key(self, plan, day, UsedTable(0, inputs, table))
                (same if record is not None and current.get(day) == own else todo).append(day)
            if record is None:
                before.add_key(key)
            else:
                before.add(key, table)
        return todo, same

    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Fit each window of days, and continue the tables in order; see `solve_windows`.

        Where a comparison of kind ``zero_level`` has a table of this one's products, the constant part is
        that of its levels; see `with_zero_levels`.
        """
        from inflight.tasks.pipelines.two_sensor.constant import ZeroLevels, with_zero_levels
        from inflight.tasks.pipelines.two_sensor.windows import solve_windows, table_name

        solved = solve_windows(work, self.versions.tables)
        levels = ZeroLevels.of(work.cat, work.mission, work.plan.settings.comparison)
        return with_zero_levels(self, work, levels, table_name(work.plan), solved)

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the day's corrected field; see `states_day`."""
        from inflight.tasks.pipelines.two_sensor.day import states_day

        return states_day(batch, day)

    def outputs(self, plan: Plan, solved: TablesToPublish | None, made: int) -> list[str]:
        """Return the products and the table of states, where any day has a product."""
        from inflight.tasks.pipelines.two_sensor.windows import table_name

        return [plan.product, f"tables/{table_name(plan)}"] if made else []

    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the steps at switchings, the verdict of each window, and where the constant part changes.

        ``residual`` is the step of the outboard field where the spacecraft switches, rms of a component, as
        measured and corrected, and ``floor_nT`` that of the corrected field where nothing switches.
        """
        from inflight.tasks.pipelines.two_sensor.constant import constant_of_day
        from inflight.tasks.pipelines.two_sensor.tables import constant_changes
        from inflight.tasks.pipelines.two_sensor.windows import combine_steps, window_verdicts

        tables = solved.used if solved else {}
        plan, published = work.plan, work.cat.days(work.plan.product, states=("published",))
        return {
            "residual": combine_steps([day.report for day in published if day.day in plan.keys]),
            "windows": window_verdicts(tables),
            "constant_changes": constant_changes(
                {day: constant_of_day(used.table, day) for day, used in tables.items()}
            ),
        }

    def remarks(self, fields: Mapping[str, Any]) -> Iterator[str]:
        """Yield which windows are not corrected and why, and where the field may step."""
        from inflight.tasks.pipelines.two_sensor.constant import constant_remarks
        from inflight.tasks.pipelines.two_sensor.tables import constant_sentences

        for one in fields.get("windows", []):
            if one["applied"] != "yes":
                yield f"{one['start']} to {one['end']} is left as measured: {one['verdict']}"
        yield from constant_sentences(fields.get("constant_changes", []))
        yield from constant_remarks(fields.get("windows", []))

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
        """Measure the steps of the products where the spacecraft switches; see `compare_dual`."""
        from inflight.tasks.pipelines.two_sensor.compare import compare_dual

        return compare_dual(cat, mission, comparison, days, progress)

    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Refuse: `compare` shows the tables of states with their effect on the measurements."""
        raise CatalogError(
            f"'{comparison}' is told by the spacecraft's states: no table says how its sensors stand to each "
            "other",
            remedy="'inflight compare' shows states, units and what is left",
        )

    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return none: `compare` shows the tables of states with their effect on the measurements."""
        return []

    def units(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        start: DayLike | None = None,
        end: DayLike | None = None,
    ) -> list[dict[str, Any]] | None:
        """Return the units that switch, and the channels behind them; see `named_units`."""
        from inflight.tasks.pipelines.two_sensor.tables import named_units

        return named_units(cat, mission, comparison, start, end)
