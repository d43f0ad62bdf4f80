"""A table that the catalog has, taken by products as it is: nothing is fitted.

In go a reprocessing and the table's name; out come the tables to publish: the same table, held over the days
that it has no row for. Which samples it was not learnt from is told by `inflight.calibration.extrapolation`.
"""

from __future__ import annotations

from dataclasses import replace

from inflight.calibration import held_table
from inflight.catalog import Catalog, TableRecord
from inflight.errors import CatalogError, did_you_mean
from inflight.model import Model
from inflight.tasks.pipelines.base.publication import (
    Certificate,
    Reprocessing,
    TablesToPublish,
    UsedTable,
    table_row_hash,
)
from inflight.time import day_bounds

#: Attributes of a table: hash of the model whose parameters it holds, and of the one fitted with it.
MODEL, FITTED = "model", "fitted_model"


def find_table(cat: Catalog, named: str) -> TableRecord:
    """Return the record of a table ``main-span:12``, or the newest one called ``main-span``.

    In place of the number stands the key, or its first digits, that the header of a product has.

    Raises
    ------
    CatalogError
        When there is none, or it is damaged.
    """
    name, _, number = named.partition(":")
    records = cat.tables(name)
    known = [
        one
        for one in records
        if (number in ("", str(one.id)) or (len(number) > 7 and one.key.startswith(number)))
        and not one.damaged
    ]
    if not known:
        numbers = ", ".join(f"{name}:{one.id}" for one in records)
        names = sorted({one.name for one in cat.tables()})
        raise CatalogError(
            f"there is no whole table {named!r}{did_you_mean(name, names)}",
            remedy=f"the catalog has {numbers or ', '.join(names) or 'none yet'}",
        )
    return known[-1]


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
    table, model = cat.table_by_id(record.id), plan.model
    if table.attrs.get(MODEL) != model.sha:
        raise CatalogError(
            f"table {record.name}:{record.id} was made with another model than {model.name} version "
            f"{plan.used.version}",
            remedy="choose a table of the model in use, or make one: 'inflight reprocess'",
        )
    further: tuple[str, ...] = ()
    if FITTED in table.attrs:
        model = _fitted_model(cat, model, str(table.attrs[FITTED]), work)
        further = (model.sha, str(plan.settings.distribute))
    start, end = day_bounds(plan.days[0])[0], day_bounds(plan.days[-1])[1]
    held = held_table(table, start, end)
    used = {
        day: UsedTable(record.id, (table_row_hash(held, sum(day_bounds(day)) // 2), *further), held)
        for day in plan.days
    }
    covered = any(
        context is None and first <= start and end <= last for context, first, last in record.certified
    )
    certify: list[Certificate] = [] if covered else [(record.id, start, end, None)]
    kept = record.name.removeprefix(f"{plan.settings.comparison}-")
    return TablesToPublish(model=model, used=used, certify=certify, kept=(kept,))


def _fitted_model(cat: Catalog, base: Model, sha: str, work: Reprocessing) -> Model:
    """Return the model that was fitted together with a table."""
    for record in cat.models():
        if record.sha256 == sha:
            text = cat.model_text(record.name, record.version)[2]
            label = f"{record.name} version {record.version}"
            return replace(Model.parse(text, work.mission, label, base.own), version=record.version)
    raise CatalogError(
        "the model that was fitted with the table is not in the catalog",
        remedy="make the table anew: 'inflight reprocess --table continuous'",
    )
