"""What a run stages and registers: outcomes of days, tables whose content is new, products as stored."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from inflight.arrays import Floats
from inflight.calibration import CHANGE, LEARNT, outside_learnt
from inflight.catalog import Catalog, Day, Run, TableRecord
from inflight.compiled import compiled
from inflight.errors import InflightError
from inflight.mission import Mission
from inflight.model import Model
from inflight.progress import Progress, silent
from inflight.tasks.batches import Mapper
from inflight.tasks.pipelines.base.job import Failure, Job, Outcome
from inflight.tasks.pipelines.base.planning import Plan
from inflight.tasks.report import problem
from inflight.time import day_bounds

if TYPE_CHECKING:
    import xarray as xr

#: A table to certify: its id, the span it holds for in TT2000, and the context (None for any).
Certificate = tuple[int, int, int, str | None]

#: Stored steps of product variables: a tenth of a picotesla, a micro-degree.
_RESOLUTION: dict[str, float] = {"nT": 1e-4, "deg": 1e-6}


@dataclass(kw_only=True)
class Reprocessing:
    """A reprocessing under way: what it has to do, where it writes, and the days that failed.

    Attributes
    ----------
    progress : callable
        Called with (stage, done, total); the mapper tells of batches itself.
    client : distributed.Client, optional
        The one that batches run on.
    failed : dict of datetime64[D] to dict
        Problems as `RunReport` lists them.
    statistics : tuple, optional
        Segments and rows of days, and what a pipeline read of these, until its tables are made.
    """

    cat: Catalog
    mission: Mission
    plan: Plan
    run: Run
    mapper: Mapper
    progress: Progress = silent
    client: Any = None
    failed: dict[np.datetime64, dict[str, str]] = field(default_factory=dict)
    statistics: tuple[frozenset[tuple[str, tuple[int, int]]], Any] | None = None

    def jobs(
        self, batches: Iterable[Sequence[np.datetime64]], dataset: str, keys: Mapping[np.datetime64, str]
    ) -> list[Job]:
        """Return the job of each batch of days; what a day is made from are its parents."""
        plan = self.plan
        beside = plan.neighbours if dataset == plan.product else {}
        return [
            Job(
                tuple(batch),
                {day: keys[day] for day in batch},
                {
                    day: tuple(source.id for source in (*plan.sources[day], *beside.get(day, ())))
                    for day in batch
                },
                plan.index.around(batch),
                plan.needs,
                self.run.id,
                dataset,
            )
            for batch in batches
        ]


class UsedTable(NamedTuple):
    """The table that the product of a day takes.

    Attributes
    ----------
    number : int
        Its id in the catalog.
    inputs : tuple of str
        What of it the product depends on; a product changes only when this does.
    table : xarray.Dataset
    """

    number: int
    inputs: tuple[str, ...]
    table: xr.Dataset


@dataclass(kw_only=True)
class TablesToPublish:
    """Tables of a run: the ones products take, and what is to be certified at publication.

    Attributes
    ----------
    model : Model
        What products are made with.
    used : mapping of datetime64[D] to UsedTable
        Of each day that gets a product.
    certify : list of (id, start, end, context)
    kept : tuple of str
        Names of the tables, without the comparison.
    notes : dict of str to str
        Tables that could not be made, and why.
    remarks : list of dict
        Remarks on the tables, as problems of days that are there all the same.
    """

    model: Model
    used: Mapping[np.datetime64, UsedTable]
    certify: list[Certificate]
    kept: tuple[str, ...] = ()
    notes: dict[str, str] = field(default_factory=dict)
    remarks: list[dict[str, str]] = field(default_factory=list)


@dataclass(kw_only=True)
class TableStager:
    """Stages tables whose content is new, and lists which to certify.

    Attributes
    ----------
    days : mapping of datetime64[D] to Day
        The statistics that tables are made from.
    key_of : callable
        Returns the key of a table by its name without the comparison: a hash of all it is made from.
    ids, tables : dict
        The tables so far, by name without the comparison.
    """

    work: Reprocessing
    days: Mapping[np.datetime64, Day]
    key_of: Callable[[str], str]
    ids: dict[str, int] = field(default_factory=dict)
    tables: dict[str, xr.Dataset] = field(default_factory=dict)
    certify: list[Certificate] = field(default_factory=list)

    def table(self, name: str, make: Callable[[], xr.Dataset]) -> xr.Dataset:
        """Return a table: the stored one with the same key, else made and staged."""
        cat, called = self.work.cat, f"{self.work.plan.settings.comparison}-{name}"
        self.work.progress("tables", len(self.tables), len(self.tables) + 1)
        key = self.key_of(name)
        known = [record for record in cat.tables(called) if record.key == key and not record.damaged]
        if known:
            table, self.ids[name] = cat.table_by_id(known[-1].id), known[-1].id
        else:
            table = make()
            start, end = self._bounds(table)
            self.ids[name] = self.work.run.stage_table(
                called, table, start=start, end=end, parents=list(self.days.values()), key=key
            )
        bounds = self._bounds(table)
        if not known or not is_certified(known[-1], bounds):
            self.certify.append((self.ids[name], *bounds, None))
        self.tables[name] = table
        return table

    def stage_possible(self, makers: Mapping[str, Callable[[], xr.Dataset]]) -> dict[str, str]:
        """Stage the tables that can be made; return why the others cannot."""
        notes = {}
        for name, make in makers.items():
            try:
                self.table(name, make)
            except InflightError as error:
                notes[name] = error.message
        if self.tables:
            self.work.progress("tables", len(self.tables), len(self.tables))
        return notes

    def solved(
        self, name: str, model: Model, notes: Mapping[str, str] | None = None, inputs: Sequence[str] = ()
    ) -> TablesToPublish:
        """Return the tables so far, one of which the products of all planned days take.

        Parameters
        ----------
        name : str
            Of that table.
        model : Model
            What products are made with.
        notes : mapping of str to str, optional
            Tables that could not be made, and why.
        inputs : sequence of str
            What else products depend on.
        """
        table = self.tables[name]
        days = list(self.work.plan.days)
        rows = table_row_hashes(table, [sum(day_bounds(day)) // 2 for day in days])
        used = {
            day: UsedTable(self.ids[name], (row, *inputs), table) for day, row in zip(days, rows, strict=True)
        }
        return TablesToPublish(
            model=model, used=used, certify=self.certify, kept=tuple(self.ids), notes=dict(notes or {})
        )

    def _bounds(self, table: xr.Dataset) -> tuple[int, int]:
        """Return the span a table holds for: its intervals', or that of all days."""
        if "start" in table and table["start"].dims == ("interval",):
            return int(table["start"].values[0]), int(table["end"].values[-1])
        return day_bounds(min(self.days))[0], day_bounds(max(self.days))[1]


def is_certified(record: TableRecord, bounds: tuple[int, int]) -> bool:
    """Return True for a table that a run leaves as certified as it is: a person may have decertified it."""
    return record.decertified or (None, *bounds) in record.certified


def table_row_hash(table: xr.Dataset, tt2000: int) -> str:
    """Return the hash of a table's row at an instant; a product changes only when this does."""
    return table_row_hashes(table, [tt2000])[0]


def table_row_hashes(table: xr.Dataset, instants: Sequence[int]) -> list[str]:
    """Return the hash of a table's row at each instant, empty where there is none; each row is read once."""
    start, end, times = table["start"].values, table["end"].values, np.array(instants, dtype=np.int64)
    # The last row that holds an instant; -1 is none.
    place = np.full(times.size, -1)
    for index, (first, last) in enumerate(zip(start, end, strict=True)):
        place[(first <= times) & (times < last)] = index
    hashes = [""] * times.size
    for index in np.unique(place[place >= 0]).tolist():
        row, here = table.isel(interval=index), np.flatnonzero(place == index)
        outside = outside_learnt(row, times[here])
        known = {beyond: _row_hash(row, extrapolated=beyond) for beyond in set(outside.tolist())}
        for at, beyond in zip(here.tolist(), outside.tolist(), strict=True):
            hashes[at] = known[beyond]
    return hashes


def _row_hash(row: xr.Dataset, *, extrapolated: bool) -> str:
    names = ["value", "covariance", "determined", "after", *LEARNT, *(CHANGE if extrapolated else ())]
    digest = hashlib.sha256()
    for name in names:
        if name in row:
            digest.update(np.ascontiguousarray(row[name].values).tobytes())
    return digest.hexdigest()


def reuse_interrupted_days(
    run: Run, dataset: str, keys: Mapping[np.datetime64, str], days: Iterable[np.datetime64]
) -> dict[np.datetime64, Day]:
    """Adopt the days that a killed run had made from the same inputs, and return them."""
    known = run.adoptable(dataset)
    adopted = {day: run.adopt(dataset, day, keys[day]) for day in days if (day, keys[day]) in known}
    return {day: found for day, found in adopted.items() if found is not None}


def register_outcome(
    run: Run, dataset: str, outcome: Outcome, failed: dict[np.datetime64, dict[str, str]]
) -> list[Day]:
    """Register an outcome with the run, add its failures to `failed`, and return the days made."""
    for day, failure in outcome.failures.items():
        record_failure(run, dataset, day, failure, failed)
    return run.attach(outcome.segment) if outcome.segment is not None else []


def record_failure(
    run: Run,
    dataset: str,
    day: np.datetime64,
    failure: Failure,
    failed: dict[np.datetime64, dict[str, str]],
) -> None:
    """Register with the run why a day could not be made, and add it to `failed`."""
    failed[day] = problem(
        failure.cause, failure.message, day=day, channel=failure.channel, remedy=failure.remedy
    )
    run.record(dataset, day, "failed", failure.cause, failure.message, {"problem": failed[day]})


def rounded(product: xr.Dataset) -> xr.Dataset:
    """Round each variable to its stored step, stated in its attributes: a store holds what a user reads."""
    variables = {}
    for name, variable in product.data_vars.items():
        step = _RESOLUTION.get(str(variable.attrs.get("units", "")))
        if step is not None and variable.dtype.kind == "f":
            values = _in_steps(variable.values.ravel(), step, round(1.0 / step)).reshape(variable.shape)
            variables[name] = (variable.dims, values, {**variable.attrs, "resolution": step})
    return product.assign(variables)


@compiled
def _in_steps(values: Floats, step: float, per_unit: int) -> Floats:  # pragma: no cover
    """Return values rounded to a step, of which so many make a unit, in one look at each."""
    out = np.empty_like(values)
    for place in range(values.size):
        out[place] = np.rint(values[place] / step) / per_unit
    return out
