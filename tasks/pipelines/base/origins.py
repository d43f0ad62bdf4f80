"""What a product was really made with, as its header says it: method, model, table, origin of coefficients.

In go what a worker was given and the day; out come the product's attributes. They name the table that was
used, also where it was chosen by hand, by its key, which holds in any workspace.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight.calibration import LEARNT, VALUE_ORIGINS
from inflight.catalog import TableRecord
from inflight.model import TimedValue, component_names
from inflight.tasks.pipelines.base.job import ProductBatch
from inflight.tasks.pipelines.base.pipeline import Pipeline
from inflight.time import day_bounds, utc_text

if TYPE_CHECKING:
    import xarray as xr

#: Digits of a key that name a table, or a context.
KEY_DIGITS = 12


def table_label(record: TableRecord) -> str:
    """Return how a header names a table: its name and the first digits of its key."""
    return f"{record.name}:{record.key[:KEY_DIGITS]}"


def context_label(name: str, context: str) -> str:
    """Return how a header names the context that a product was made in."""
    return f"{name}:{context[:KEY_DIGITS]}"


def origin_attributes(
    pipeline: Pipeline, batch: ProductBatch, day: np.datetime64, report: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the attributes of a day's product that say what it was made with.

    Returns
    -------
    dict
        ``calibration_method`` (pipeline, versions of its algorithms), ``calibration_model``,
        ``calibration_table`` (name:key, and what taught the row that holds), ``calibration_coefficients`` (a
        list: value at noon and where it is from), ``calibration_range`` of an instrument with several
        measuring ranges, ``calibration_context`` where one was named (name:id),
        ``exclusions`` that touch the day, and ``typical_values`` where channels were missing.
    """
    start, end = day_bounds(day)
    middle = (start + end) // 2
    row = _row_at(batch.table, middle)
    versions = pipeline.versions
    attributes: dict[str, Any] = {
        "calibration_method": f"{pipeline.tag}, statistics {versions.statistics}, tables {versions.tables}, "
        f"products {versions.products}",
        "calibration_model": batch.model_name,
        "calibration_table": f"{batch.table_name}{_taught(row, (start, end))}",
    }
    if row is not None and "estimate" in row:
        attributes["calibration_method"] += f", estimate {row['estimate'].item()}"
    comparison = batch.mission.comparisons[batch.model.comparison]
    if comparison.kind == "scalar" and comparison.range:
        attributes["calibration_range"] = comparison.range.words
    if batch.context_name:
        attributes["calibration_context"] = batch.context_name
    coefficients = [
        f"{name} = {value:.10g} {parameter.parameter.unit}: {origin}"
        for entry in batch.model.effects
        for parameter in entry.parameters.values()
        for name, value, origin in _coefficients(batch, row, parameter, middle)
    ]
    if coefficients:
        attributes["calibration_coefficients"] = coefficients
    excluded = [one.words for one in batch.mission.exclusions if one.start < end and start < one.end]
    if excluded:
        attributes["exclusions"] = excluded
    if report.get("partial"):
        attributes["typical_values"] = str(report["partial"])
    return attributes


def _row_at(table: xr.Dataset, tt2000: int) -> xr.Dataset | None:
    """Return the interval of a table that holds at an instant; None of a table that is one by itself."""
    if "start" not in table or table["start"].dims != ("interval",):
        return None
    inside = np.flatnonzero((table["start"].values <= tt2000) & (tt2000 < table["end"].values))
    return table.isel(interval=int(inside[-1])) if inside.size else None


def _taught(row: xr.Dataset | None, span: tuple[int, int]) -> str:
    """Return the span that taught a row, in words, and whether the day lies outside it."""
    if row is None or not set(LEARNT) <= set(row.variables):
        return ""
    first, last = (int(row[name].values) for name in LEARNT)
    if last <= first:
        return ", learnt from nothing: as before flight"
    outside = "" if first <= span[0] and span[1] <= last else ", extrapolated"
    return f", learnt {utc_text(first)[:10]} to {utc_text(last)[:10]}{outside}"


def _coefficients(
    batch: ProductBatch, row: xr.Dataset | None, parameter: TimedValue, tt2000: int
) -> list[tuple[str, float, str]]:
    """Return name, value and origin of each component of a parameter."""
    names = component_names(parameter.key, parameter.parameter)
    known = row["parameter"].values.tolist() if row is not None and "parameter" in row.coords else []
    if parameter.time == "block" and set(names) <= set(known):
        assert row is not None
        places = [known.index(name) for name in names]
        if "origin" in row:
            sources = [str(row["origin"].values[place]) for place in places]
        else:
            sources = [VALUE_ORIGINS[int(row["source"].values[place])] for place in places]
        values = row["value"].values[places].tolist()
        return [
            (name, value, f"table {batch.table_name}, {source}")
            for name, value, source in zip(names, values, sources, strict=True)
        ]
    values = np.atleast_1d(parameter.at(tt2000)).tolist()
    if parameter.time == "table":
        held = ", held beyond it" if parameter.is_held_at(tt2000) else ""
        return [
            (name, value, f"table {parameter.table_name}{held}")
            for name, value in zip(names, values, strict=True)
        ]
    return [(name, value, f"model {batch.model_name}") for name, value in zip(names, values, strict=True)]
