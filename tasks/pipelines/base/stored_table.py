"""Tables that the catalog has, taken by products as they are: nothing is fitted.

In go a reprocessing and a table's name, or the tables that a named context pins; out come the tables to
publish: the same ones, held over the days that they have no row for. Which samples they were not learnt from
is told by `inflight.calibration.extrapolation`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from inflight.calibration import LEARNT, held_table
from inflight.catalog import Catalog, TableRecord, Validity
from inflight.errors import CatalogError, did_you_mean
from inflight.model import Model
from inflight.tasks.models import find_table, model_label, version_of
from inflight.tasks.pipelines.base.job import Failure
from inflight.tasks.pipelines.base.planning import ReprocessSettings
from inflight.tasks.pipelines.base.publication import (
    Certificate,
    Reprocessing,
    TablesToPublish,
    UsedTable,
    record_failure,
    table_row_hash,
)
from inflight.time import day_bounds

if TYPE_CHECKING:
    import xarray as xr

#: Attributes of a table: hash of the model whose parameters it holds, and of the one fitted with it.
MODEL, FITTED = "model", "fitted_model"


def take_stored_table(work: Reprocessing, named: str) -> TablesToPublish:
    """Return the tables of a run whose products take a stored one.

    Raises
    ------
    CatalogError
        When there is no such table, or it was made with another version of the model.
    CalibrationError
        When it does not tell what it was learnt from.
    """
    cat, plan = work.cat, work.plan
    record = find_table(cat, named)
    table = cat.table_by_id(record.id)
    model = _model_of_table(work, record, table)
    start, end = day_bounds(plan.days[0])[0], day_bounds(plan.days[-1])[1]
    held = held_table(table, start, end)
    used = {day: _used(record, held, day, plan.settings.distribute) for day in plan.days}
    covered = any(
        context is None and first <= start and end <= last for context, first, last in record.certified
    )
    certify: list[Certificate] = [] if covered else [(record.id, start, end, None)]
    kept = record.name.removeprefix(f"{plan.settings.comparison}-")
    return TablesToPublish(model=model, used=used, certify=certify, kept=(kept,))


def take_pinned_tables(work: Reprocessing) -> TablesToPublish:
    """Return the tables of a run whose products take those of a named context, each where it is valid.

    A day on which the context has none fails. Nothing is certified.

    Raises
    ------
    CatalogError
        When the context has no table of the kind, or tables that were fitted with different models.
    """
    cat, plan = work.cat, work.plan
    tables = cat.context(plan.context).tables
    name = pinned_name(tables, plan.settings)
    if name not in tables:
        raise CatalogError(
            f"context {plan.settings.context!r} has no table {name!r}{did_you_mean(name, tables)}",
            remedy=f"choose another with --table: it has {', '.join(tables) or 'none'}",
        )
    used = pinned_tables(cat, tables[name], plan.days, plan.settings.distribute)
    records = {record.id: record for record in cat.tables(name)}
    models = {one.number: _model_of_table(work, records[one.number], one.table) for one in used.values()}
    if len({model.sha for model in models.values()}) > 1:
        raise CatalogError(
            f"tables {', '.join(f'{name}:{one}' for one in models)} were fitted with different models",
            remedy="take the days of one of them at a time: --start and --end",
        )
    for day in (day for day in plan.days if day not in used):
        why = f"context {plan.settings.context!r} has no {name} that is valid then"
        failure = Failure("repeatable", why, "make a context that has: 'inflight catalog context make'")
        record_failure(work.run, plan.product, day, failure, work.failed)
    model = next(iter(models.values()), plan.model)
    return TablesToPublish(model=model, used=used, certify=[])


def pinned_name(tables: Iterable[str], settings: ReprocessSettings) -> str:
    """Return the name of the table that products take: that of the settings' kind, or the only one."""
    name = f"{settings.comparison}-{settings.table}"
    known = list(tables)
    # A pipeline that learns states has one table, whatever kind is asked for.
    return known[0] if name not in known and len(known) == 1 else name


def pinned_tables(
    cat: Catalog, pinned: Sequence[Validity], days: Iterable[np.datetime64], distribute: bool
) -> dict[np.datetime64, UsedTable]:
    """Return the table that each day takes, of those that a context pins; days without one are left out."""
    number_of = {
        day: next((one for one, start, end in pinned if start <= sum(day_bounds(day)) // 2 < end), None)
        for day in days
    }
    records = {record.id: record for record in cat.tables()}
    used: dict[np.datetime64, UsedTable] = {}
    for number in sorted({one for one in number_of.values() if one is not None}):
        own = [day for day, one in number_of.items() if one == number]
        table = cat.table_by_id(number)
        if set(LEARNT) <= set(table.variables):
            table = held_table(table, day_bounds(min(own))[0], day_bounds(max(own))[1])
        used |= {day: _used(records[number], table, day, distribute) for day in own}
    return used


def _used(record: TableRecord, table: xr.Dataset, day: np.datetime64, distribute: bool) -> UsedTable:
    """Return a stored table as the product of a day takes it, with what of it matters on that day."""
    has_rows = "start" in table and table["start"].dims == ("interval",)
    of_table = table_row_hash(table, sum(day_bounds(day)) // 2) if has_rows else record.key
    fitted = table.attrs.get(FITTED)
    return UsedTable(record.id, (of_table, *((str(fitted), str(distribute)) if fitted else ())), table)


def _model_of_table(work: Reprocessing, record: TableRecord, table: xr.Dataset) -> Model:
    """Return the model to take a stored table with: the plan's, or the one that was fitted with the table.

    Raises
    ------
    CatalogError
        When the table was made with another model than the plan's.
    """
    plan = work.plan
    if table.attrs.get(MODEL, plan.model.sha) != plan.model.sha:
        label = model_label(plan.model.name, plan.used.version)
        raise CatalogError(
            f"table {record.name}:{record.id} was made with another model than {label}",
            remedy="choose a table of the model in use, or make one: 'inflight reprocess'",
        )
    if FITTED not in table.attrs:
        return plan.model
    for one in work.cat.models():
        if one.sha256 == table.attrs[FITTED]:
            found = version_of(work.cat, work.mission, one.name, one.version, plan.model.own)
            return replace(found.model, version=one.version)
    raise CatalogError(
        "the model that was fitted with the table is not in the catalog",
        remedy="make the table anew: 'inflight reprocess --table continuous'",
    )
