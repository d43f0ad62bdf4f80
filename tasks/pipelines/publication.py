"""What a run keeps: what became of days, tables made only when their content is new, days of ended runs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day, Run
from inflight.model import Model
from inflight.tasks.pipelines.job import Failure, Outcome
from inflight.tasks.pipelines.mission import CHAIN_VERSION
from inflight.tasks.pipelines.planning import Plan
from inflight.tasks.pipelines.tables import TABLES_VERSION, content_keys
from inflight.time import day_bounds


@dataclass(frozen=True)
class SolvedTables:
    """Tables of a run: the one products take, and what is to be certified at publication.

    Attributes
    ----------
    model : Model
        What products are made with.
    notes : dict of str to str
        Tables that could not be made, and why.
    """

    used: xr.Dataset
    ids: dict[str, int]
    certify: list[tuple[int, int, int, str | None]]
    model: Model
    notes: dict[str, str] = field(default_factory=dict)


@dataclass
class TableKeeper:
    """Stages tables that are not there yet with the same content, and says which to certify."""

    cat: Catalog
    made: Plan
    run: Run
    days: Mapping[np.datetime64, Day]
    ids: dict[str, int] = field(default_factory=dict)
    certify: list[tuple[int, int, int, str | None]] = field(default_factory=list)

    def table(self, kind: str, make: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return a table, known or made and staged."""
        name, key = f"{self.made.settings.comparison}-{kind}", self._key(kind)
        known = [record for record in self.cat.tables(name) if record.key == key and not record.damaged]
        if known:
            table, self.ids[kind] = self.cat.table_by_id(known[-1].id), known[-1].id
        else:
            table = make()
            start, end = self._bounds(table)
            self.ids[kind] = self.run.stage_table(
                name, table, start=start, end=end, parents=list(self.days.values()), key=key
            )
        bounds = self._bounds(table)
        if not known or (None, *bounds) not in known[-1].certified:
            self.certify.append((self.ids[kind], *bounds, None))
        return table

    def _key(self, kind: str) -> str:
        made = self.made
        if made.settings.is_chain:
            return tables_key(made, kind, self.days)
        told = [kind, str(made.settings.window_days), str(TABLES_VERSION), made.context]
        return hashlib.sha256("".join([*content_keys(self.days), *told]).encode()).hexdigest()

    def _bounds(self, table: xr.Dataset) -> tuple[int, int]:
        """Return the span a table holds for: its intervals', or that of all days."""
        if "start" in table and table["start"].dims == ("interval",):
            return int(table["start"].values[0]), int(table["end"].values[-1])
        return day_bounds(min(self.days))[0], day_bounds(max(self.days))[1]


def adopted_days(
    run: Run, dataset: str, keys: Mapping[np.datetime64, str], days: Iterable[np.datetime64]
) -> dict[np.datetime64, Day]:
    """Take over the days that a killed run had made from the same inputs."""
    offered = run.adoptable(dataset)
    adopted = {}
    for day in days:
        found = run.adopt(dataset, day, keys[day]) if (day, keys[day]) in offered else None
        if found is not None:
            adopted[day] = found
    return adopted


def take_outcome(
    run: Run, dataset: str, outcome: Outcome, failed: dict[np.datetime64, dict[str, str]]
) -> list[Day]:
    """Register an outcome with the run; put failures among those known, and return the days made."""
    for day, failure in outcome.failures.items():
        take_failure(run, dataset, day, failure, failed)
    return run.attach(outcome.segment) if outcome.segment is not None else []


def take_failure(
    run: Run,
    dataset: str,
    day: np.datetime64,
    failure: Failure,
    failed: dict[np.datetime64, dict[str, str]],
) -> None:
    """Register why a day could not be made with the run; put it among the problems known."""
    run.record(dataset, day, "failed", failure.cause, failure.message)
    failed[day] = {
        "day": str(day),
        "channel": failure.channel,
        "cause": failure.cause,
        "remedy": failure.remedy,
        "message": failure.message,
    }


#: Bumped by hand when the numbers of the chain's tables change.
CHAIN_TABLES_VERSION = 5


def tables_key(made: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
    """Return what a table of the chain is made from, as one hash."""
    settings = made.settings
    told = [name, str(CHAIN_VERSION), str(CHAIN_TABLES_VERSION), settings.trend, str(settings.origin)]
    return hashlib.sha256("".join([*content_keys(days), *told, made.context]).encode()).hexdigest()
