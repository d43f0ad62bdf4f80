"""Windows of days of two sensors: which there are, their keys, and their tables in the order of time.

Each window is fitted by itself, then continues one before it (`continue_table`), so that numbers of states
and the constant part of the field run on. A window whose days, mission and model are the same is not fitted
again; a window that is fitted anew changes those behind it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, TableRecord
from inflight.tasks.pipelines.base import (
    ONE_DAY,
    Failure,
    Plan,
    Reprocessing,
    ReprocessSettings,
    TablesToPublish,
    UsedTable,
    is_certified,
    record_failure,
    window_edges,
)
from inflight.tasks.pipelines.two_sensor.constant import constant_of_day
from inflight.tasks.pipelines.two_sensor.day import states_window
from inflight.tasks.pipelines.two_sensor.tables import (
    OWN_KEY,
    TablesBefore,
    continue_table,
    continued_key,
    remarks_of,
)
from inflight.time import day_bounds

#: The table, by name without the comparison.
STATES = "states"


def windows(days: Sequence[np.datetime64], settings: ReprocessSettings) -> list[list[np.datetime64]]:
    """Return the days of each window that has any: days, windows of the fixed grid, or all together."""
    if settings.table == "span":
        return [list(days)]
    size = 1 if settings.table == "daily" else settings.window_days
    edges = window_edges(min(days), max(days), size)
    groups = [[day for day in days if low <= day < high] for low, high in pairwise(edges)]
    return [group for group in groups if group]


def table_name(plan: Plan) -> str:
    """Return the name of a plan's table of states."""
    return f"{plan.settings.comparison}-{STATES}"


def window_key(plan: Plan, group: Sequence[np.datetime64], version: int) -> str:
    """Return the key of a window by itself: of readings, mission, model and algorithm."""
    content = [STATES, str(version), plan.context, *(plan.keys[day] for day in group)]
    return hashlib.sha256("".join(content).encode()).hexdigest()


@dataclass
class StoredTables:
    """The tables of states that the catalog has, certified or staged by a run that was stopped.

    Attributes
    ----------
    continued : dict of str to TableRecord
        By the whole key.
    fitted : dict of str to TableRecord
        By the part of the key that depends on a window's own inputs: it need not be fitted again, whatever
        table it continued.
    """

    continued: dict[str, TableRecord] = field(default_factory=dict)
    fitted: dict[str, TableRecord] = field(default_factory=dict)

    @classmethod
    def of(cls, cat: Catalog, name: str) -> StoredTables:
        """Return those of a name that are not damaged."""
        records = [record for record in cat.tables(name) if not record.damaged]
        fitted = {record.key[:OWN_KEY]: record for record in records}
        return cls({record.key: record for record in records}, fitted)


def solve_windows(work: Reprocessing, version: int) -> TablesToPublish:
    """Fit each window, and continue the tables in order; what has not changed is not done again.

    A window's table is staged as soon as those before it are, so that the next run finds what a killed run
    has made.

    Parameters
    ----------
    version : int
        Of the algorithm.
    """
    cat, plan = work.cat, work.plan
    name = table_name(plan)
    stored = StoredTables.of(cat, name)
    groups = windows(plan.days, plan.settings)
    keys = [window_key(plan, group, version) for group in groups]
    todo = [group for group, key in zip(groups, keys, strict=True) if key[:OWN_KEY] not in stored.fitted]
    arguments = [
        (cat, work.mission, plan.model, group, plan.needs, plan.index.around(group)) for group in todo
    ]
    fitted: Iterator[xr.Dataset | Failure] = iter(work.mapper("calibrate", states_window, arguments))
    before = TablesBefore.of_day(cat, name, groups[0][0])
    used: dict[np.datetime64, UsedTable] = {}
    solved = TablesToPublish(model=plan.model, used=used, certify=[])
    for group, own in zip(groups, keys, strict=True):
        key = continued_key(own, before.keys)
        record = stored.fitted.get(own[:OWN_KEY])
        window = next(fitted) if record is None else cat.table_by_id(record.id)
        if isinstance(window, Failure):
            for day in group:
                record_failure(work.run, plan.product, day, window, work.failed)
            continue
        bounds = day_bounds(group[0])[0], day_bounds(group[-1])[1]
        same = stored.continued.get(key)
        if same is not None:
            number, table = same.id, cat.table_by_id(same.id)
        else:
            table = continue_table(before.tables, window)
            parents = [source.id for day in group for source in plan.sources[day]]
            number = work.run.stage_table(
                name, table, start=bounds[0], end=bounds[1], parents=parents, key=key
            )
        if same is None or not is_certified(same, bounds):
            solved.certify.append((number, *bounds, None))
        used |= dict.fromkeys(group, UsedTable(number, (key,), table))
        before.add(key, table)
    solved.remarks = remarks_of(used)
    return solved


def combine_steps(reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the rms steps of several days, each counted by its switchings; empty without a switching."""
    known = [report for report in reports if report.get("switchings") and report.get("before_nT") is not None]
    counts = np.array([report["switchings"] for report in known], dtype=np.float64)
    if not counts.sum():
        return {}
    out = {}
    for name in ("before_nT", "after_nT", "floor_nT"):
        values = np.array([np.nan if day[name] is None else day[name] for day in known], dtype=np.float64)
        good = np.isfinite(values)
        out[name] = (
            float(np.sqrt(counts[good] @ values[good] ** 2 / counts[good].sum())) if good.any() else np.nan
        )
    return out


def window_verdicts(tables: Mapping[np.datetime64, UsedTable]) -> list[dict[str, Any]]:
    """Return states, method and verdict of each window's table, as plain fields."""
    seen: dict[int, dict[str, Any]] = {}
    for day in sorted(tables):
        number, _, table = tables[day]
        fields = seen.setdefault(
            number,
            {
                "table": number,
                "start": str(day),
                "states": int(table.sizes.get("state", 0)),
                "units": int(table.sizes.get("unit", 0)),
                "method": str(table.attrs.get("method", "")),
                "applied": str(table.attrs.get("applied", "")),
                "verdict": str(table.attrs.get("verdict", "")),
                "constant": constant_of_day(table, day),
                "zero_level": str(table.attrs.get("zero_level", "")),
            },
        )
        fields["end"] = str(day + ONE_DAY)
    return list(seen.values())
