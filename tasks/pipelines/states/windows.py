"""Windows of days of two sensors: which there are, their keys, and their tables joined in the order of time.

Windows are learnt from independently, then each goes on from one before it (`joined`), so that numbers of
states and the constant part of the field run on. A window whose days, mission and model are the same is not
learnt from again; a window that is learnt anew changes those behind it.
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
    Solved,
    UsedTable,
    record_failure,
    window_edges,
)
from inflight.tasks.pipelines.states.day import states_window
from inflight.tasks.pipelines.states.tables import OWN, Chain, chained_key, constant_of, joined, remarks_of
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
    """Return the key of what a window tells by itself: of readings, mission, model and algorithm."""
    told = [STATES, str(version), plan.context, *(plan.keys[day] for day in group)]
    return hashlib.sha256("".join(told).encode()).hexdigest()


@dataclass
class KnownTables:
    """The tables of states that the archive has, certified or left by a run that was ended.

    Attributes
    ----------
    joined : dict of str to TableRecord
        By the whole key.
    learnt : dict of str to TableRecord
        By the part of the key that tells a window's own inputs: what it tells by itself need not be
        learnt again, whatever it was joined to.
    """

    joined: dict[str, TableRecord] = field(default_factory=dict)
    learnt: dict[str, TableRecord] = field(default_factory=dict)

    @classmethod
    def of(cls, cat: Catalog, name: str) -> KnownTables:
        """Return those of a name; damaged ones are not known."""
        records = [one for one in cat.tables(name) if not one.damaged]
        return cls({one.key: one for one in records}, {one.key[:OWN]: one for one in records})


def solve_windows(work: Reprocessing, version: int) -> Solved:
    """Learn from each window and join them in order; what has not changed is neither done again.

    A window's table is staged as soon as those before it are: a run that is killed leaves what it has made
    to the next one.

    Parameters
    ----------
    version : int
        Of the algorithm.
    """
    cat, plan = work.cat, work.plan
    name = table_name(plan)
    known = KnownTables.of(cat, name)
    groups = windows(plan.days, plan.settings)
    keys = [window_key(plan, group, version) for group in groups]
    todo = [group for group, key in zip(groups, keys, strict=True) if key[:OWN] not in known.learnt]
    arguments = [
        (cat, work.mission, plan.model, group, plan.needs, plan.index.around(group)) for group in todo
    ]
    fresh: Iterator[xr.Dataset | Failure] = iter(work.mapper("calibrate", states_window, arguments))
    chain = Chain.before(cat, name, groups[0][0])
    used: dict[np.datetime64, UsedTable] = {}
    solved = Solved(model=plan.model, used=used, certify=[])
    for group, own in zip(groups, keys, strict=True):
        key = chained_key(own, chain.keys)
        learnt = known.learnt.get(own[:OWN])
        alone = next(fresh) if learnt is None else cat.table_by_id(learnt.id)
        if isinstance(alone, Failure):
            for day in group:
                record_failure(work.run, plan.product, day, alone, work.failed)
            continue
        bounds = day_bounds(group[0])[0], day_bounds(group[-1])[1]
        if key in known.joined:
            number, table = known.joined[key].id, cat.table_by_id(known.joined[key].id)
        else:
            table = joined(chain.tables, alone)
            parents = [source.id for day in group for source in plan.sources[day]]
            number = work.run.stage_table(
                name, table, start=bounds[0], end=bounds[1], parents=parents, key=key
            )
        if key not in known.joined or (None, *bounds) not in known.joined[key].certified:
            solved.certify.append((number, *bounds, None))
        used |= dict.fromkeys(group, UsedTable(number, (key,), table))
        chain.add(key, table)
    solved.remarks = remarks_of(used)
    return solved


def joined_steps(reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the rms steps of several days, each counted by its switchings; empty without a switching."""
    known = [one for one in reports if one.get("switchings") and one.get("before_nT") is not None]
    counts = np.array([one["switchings"] for one in known], dtype=np.float64)
    if not counts.sum():
        return {}
    out = {}
    for name in ("before_nT", "after_nT", "floor_nT"):
        values = np.array([np.nan if one[name] is None else one[name] for one in known], dtype=np.float64)
        good = np.isfinite(values)
        out[name] = (
            float(np.sqrt(counts[good] @ values[good] ** 2 / counts[good].sum())) if good.any() else np.nan
        )
    return out


def verdicts(tables: Mapping[np.datetime64, UsedTable]) -> list[dict[str, Any]]:
    """Return what each window's table says of itself: how many states, and whether the correction helps."""
    seen: dict[int, dict[str, Any]] = {}
    for day in sorted(tables):
        number, _, table = tables[day]
        told = seen.setdefault(
            number,
            {
                "table": number,
                "start": str(day),
                "states": int(table.sizes.get("state", 0)),
                "units": int(table.sizes.get("unit", 0)),
                "method": str(table.attrs.get("method", "")),
                "applied": str(table.attrs.get("applied", "")),
                "verdict": str(table.attrs.get("verdict", "")),
                "constant": constant_of(table),
            },
        )
        told["end"] = str(day + ONE_DAY)
    return list(seen.values())
