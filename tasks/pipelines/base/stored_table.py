"""A table that the catalog has, taken by products as it is: nothing is fitted.

In go a reprocessing and the table's name; out come the tables to publish: the same table, held over the days
that it has no row for. Which samples it was not learnt from is told by `inflight.calibration.extrapolation`.
"""

from __future__ import annotations

from dataclasses import replace

from inflight.calibration import held_table
from inflight.catalog import Catalog
from inflight.errors import CatalogError
from inflight.model import Model
from inflight.tasks.models import find_table, parse_model
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
            return replace(parse_model(cat, text, work.mission, label, base.own), version=record.version)
    raise CatalogError(
        "the model that was fitted with the table is not in the catalog",
        remedy="make the table anew: 'inflight reprocess --table continuous'",
    )
