"""Two sensors on one boom and nothing else: tables of the spacecraft's states, and the field without them.

Windows of days are learnt from independently, then joined in the order of time, and each leaves one certified
table; then every day is corrected with the table that holds. A day whose readings and table are the same
is left alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Run
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.tasks.pipelines.job import Failure, Job
from inflight.tasks.pipelines.planning import ONE_DAY, Plan, ReprocessSettings, plan
from inflight.tasks.pipelines.publication import adopted_days, take_failure, take_outcome
from inflight.tasks.pipelines.states.day import (
    KnownTables,
    product_key,
    states_batch,
    states_window,
    table_name,
    window_key,
    windows,
)
from inflight.tasks.pipelines.states.tables import (
    OWN,
    Chain,
    chained_key,
    constant_changes,
    constant_of,
    joined,
    remarks_of,
)
from inflight.tasks.report import RunReport, no_work_problems
from inflight.time import DayLike, day_bounds


@dataclass
class _Made:
    """What became of windows and days.

    Attributes
    ----------
    tables : dict of day to (id, key, Dataset)
        The table that holds on each day.
    failed : dict of day to problem
    certify : list of (id, start, end, context)
    """

    tables: dict[np.datetime64, tuple[int, str, xr.Dataset]] = field(default_factory=dict)
    failed: dict[np.datetime64, dict[str, str]] = field(default_factory=dict)
    certify: list[tuple[int, int, int, str | None]] = field(default_factory=list)


def reprocess_states(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None,
    end: DayLike | None,
    settings: ReprocessSettings,
    mapper: Callable[..., Any],
) -> RunReport:
    """Make tables of states and products; parameters and result as `reprocess`.

    The report's ``residual`` is the step of the outboard field where the spacecraft switches, rms of a
    component, as measured and corrected, and ``floor_nT`` that of the corrected field where nothing switches.

    Raises
    ------
    MissionError
        When the settings ask for a table that two sensors have not.
    CatalogError
        When the archive has no day of both sensors.
    """
    if settings.is_chain:
        raise MissionError(
            "a comparison of two sensors has no table 'continuous'", remedy="choose daily, window or span"
        )
    made = plan(cat, mission, start, end, settings)
    out = _Made()
    told = made.settings.model_dump() | {"start": str(made.days[0]), "end": str(made.days[-1] + ONE_DAY)}
    with cat.run("reprocess", told, context=made.context) as run:
        run.record_no_work(made.product, made.no_work)
        _tables(cat, mission, made, run, mapper, out)
        done, same = _products(cat, mission, made, run, mapper, out)
        run.publish(certify=out.certify, supersede=True)
    counts = {
        "planned": len(made.days) + len(made.no_work),
        "done": len(done),
        "unchanged": len(same),
        "failed": len(out.failed),
        "no_work": len(made.no_work),
    }
    problems = [out.failed[day] for day in sorted(out.failed)] + remarks_of(out.tables)
    problems += no_work_problems(made.no_work)
    outputs = [made.product, f"tables/{table_name(made)}"] if done or same else []
    constants = {day: constant_of(table) for day, (_, _, table) in out.tables.items()}
    extra = {
        "residual": residual_of(cat, made),
        "windows": verdicts(out.tables),
        "constant_changes": constant_changes(constants),
    }
    return RunReport("reprocess", run.id, made.context, counts, problems, outputs, extra)


def _tables(
    cat: Catalog, mission: Mission, made: Plan, run: Run, mapper: Callable[..., Any], out: _Made
) -> None:
    """Learn from each window and join them in order; what has not changed is neither done again.

    A window's table is staged as soon as those before it are: a run that is killed leaves what it has made
    to the next one.
    """
    name = table_name(made)
    known = KnownTables.of(cat, name)
    groups = windows(made.days, made.settings)
    keys = [window_key(made, group) for group in groups]
    todo = [group for group, key in zip(groups, keys, strict=True) if key[:OWN] not in known.learnt]
    arguments = [(cat, mission, made.model, group, made.needs, made.index.around(group)) for group in todo]
    fresh = iter(mapper("calibrate", states_window, arguments))
    chain = Chain.before(cat, name, groups[0][0])
    for group, own in zip(groups, keys, strict=True):
        key = chained_key(own, chain.keys)
        learnt = known.learnt.get(own[:OWN])
        alone = next(fresh) if learnt is None else cat.table_by_id(learnt.id)
        if isinstance(alone, Failure):
            _fail(run, made.product, group, alone, out)
            continue
        bounds = day_bounds(group[0])[0], day_bounds(group[-1])[1]
        if key in known.joined:
            number, table = known.joined[key].id, cat.table_by_id(known.joined[key].id)
        else:
            table = joined(chain.tables, alone)
            parents = [one for day in group for one in _sources(made, day)]
            number = run.stage_table(name, table, start=bounds[0], end=bounds[1], parents=parents, key=key)
        if key not in known.joined or (None, *bounds) not in known.joined[key].certified:
            out.certify.append((number, *bounds, None))
        out.tables |= dict.fromkeys(group, (number, key, table))
        chain.add(key, table)


def _sources(made: Plan, day: np.datetime64) -> list[str]:
    base = next(need for need in made.needs if need.name == made.base)
    return [source.id for source in made.index.sources(made.needs, day, base)]


def _fail(run: Run, product: str, days: Sequence[np.datetime64], failure: Failure, out: _Made) -> None:
    """Record the days of a window from which nothing was learnt."""
    for day in days:
        take_failure(run, product, day, failure, out.failed)


def _products(
    cat: Catalog, mission: Mission, made: Plan, run: Run, mapper: Callable[..., Any], out: _Made
) -> tuple[list[np.datetime64], list[np.datetime64]]:
    """Correct the days whose readings or table changed; return them and those left alone."""
    current = {day.day: day for day in cat.days(made.product, states=("published",))}
    keys = {day: product_key(made, day, key) for day, (_, key, _) in out.tables.items()}
    same = [day for day, key in keys.items() if day in current and current[day].key == key]
    todo = sorted(set(keys) - set(same))
    done = list(adopted_days(run, made.product, keys, todo))
    left = sorted(set(todo) - set(done))
    arguments = [(cat, mission, made.model, *one) for one in _jobs(made, run, left, keys, out)]
    for outcome in mapper("produce", states_batch, arguments):
        done += [day.day for day in take_outcome(run, made.product, outcome, out.failed)]
    return sorted(done), same


def _jobs(
    made: Plan, run: Run, todo: Sequence[np.datetime64], keys: Mapping[np.datetime64, str], out: _Made
) -> Iterator[tuple[xr.Dataset, Job]]:
    """Yield each batch of days with the one table that all its days take."""
    numbers = sorted({out.tables[day][0] for day in todo})
    for number in numbers:
        days = [day for day in todo if out.tables[day][0] == number]
        for batch in made.in_batches(days):
            parents = {day: (*_sources(made, day), f"table:{number}") for day in batch}
            job = Job(
                tuple(batch),
                {day: keys[day] for day in batch},
                parents,
                made.index.around(batch),
                made.needs,
                run.id,
                made.product,
            )
            yield out.tables[batch[0]][2], job


def residual_of(cat: Catalog, made: Plan) -> dict[str, float]:
    """Return the rms step at the switchings of all days before and after, and the floor."""
    inside = [day for day in cat.days(made.product, states=("published",)) if day.day in made.keys]
    return joined_steps([day.report for day in inside])


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


def verdicts(tables: Mapping[np.datetime64, tuple[int, str, xr.Dataset]]) -> list[dict[str, Any]]:
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
