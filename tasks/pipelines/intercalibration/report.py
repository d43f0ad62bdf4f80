"""Report of two vector sensors against each other: fields for the command line's JSON, and one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflight import __version__
from inflight.catalog import Catalog
from inflight.errors import CatalogError
from inflight.figures import (
    PARTS,
    html_page,
    html_table,
    relation_days_figure,
    relation_figure,
    sensor_variance_figure,
)
from inflight.mission import Mission
from inflight.tasks.pipelines.base import Part, newest_tables
from inflight.tasks.pipelines.intercalibration.pair import NO_PRODUCT, NO_PRODUCT_OF_BOOM, RELATIONS
from inflight.tasks.report import write_page
from inflight.time import day_of
from inflight.units import with_error

if TYPE_CHECKING:
    import xarray as xr


def relation_report(
    cat: Catalog, mission: Mission, comparison: str, output: Path | None = None
) -> dict[str, Any]:
    """Return the fields of a dual comparison's tables, and write the page when a path is given.

    Raises
    ------
    CatalogError
        When none is certified.
    """
    tables, parts = relation_parts(cat, comparison)
    # The table with one interval a day.
    bends = "bending" in tables
    note, daily = (NO_PRODUCT_OF_BOOM, tables["bending"]) if bends else (NO_PRODUCT, tables["relation-daily"])
    days = [str(one)[:10] for one in day_of(daily["start"].values[[0, -1]])]
    if output is not None:
        title = f"{mission.mission}: {comparison}, {days[0]} to {days[1]}"
        footer = f"{daily.sizes['interval']} days; inflight {__version__}. {mission.acknowledgement}"
        page = html_page(title, [(part.heading, part.text, part.plots) for part in parts], footer)
        write_page(output, page)
    return {
        "command": "chain",
        "comparison": comparison,
        "note": note,
        "span": days,
        "days": int(daily.sizes["interval"]),
        "tables": {name: f"{comparison}-{name}" for name in sorted(tables)},
        "sections": {part.key: part.fields | {"absent": part.absent} for part in parts},
        "path": str(output) if output else "",
    }


def relation_parts(cat: Catalog, comparison: str) -> tuple[dict[str, xr.Dataset], tuple[Part, ...]]:
    """Return the newest tables of a dual comparison, and the sections about them.

    Raises
    ------
    CatalogError
        When none is certified.
    """
    for relation in RELATIONS:
        tables = newest_tables(cat, comparison, tuple(relation.tables))
        if "relation-daily" in tables:
            return tables, (_relation(tables), _corners(tables))
        if "bending" in tables:
            return tables, (_bending(tables["bending"]),)
    raise CatalogError(
        f"no tables are published for comparison '{comparison}'",
        remedy=f"run 'inflight reprocess --comparison {comparison}' first",
    )


def _bending(table: xr.Dataset) -> Part:
    part = Part("bending", "How the boom bends")
    part.add_text(NO_PRODUCT_OF_BOOM[:1].upper() + NO_PRODUCT_OF_BOOM[1:] + ".")
    days = [str(one)[:10] for one in day_of(table["start"].values)]
    part.fields["items"] = [
        {"day": day, "value": float(np.rad2deg(value)), "sigma": float(np.rad2deg(sigma)), "unit": "deg"}
        for day, value, sigma in zip(
            days, table["value"].values[:, 0], table["sigma"].values[:, 0], strict=True
        )
    ]
    rows = [(one["day"], with_error(one["value"], one["sigma"])) for one in part.fields["items"]]
    part.text.append(html_table(("day", "bend ± sigma, deg"), rows))
    return part


def _relation(tables: Mapping[str, xr.Dataset]) -> Part:
    part = Part("relation", "How the two sensors stand to each other")
    part.add_text(NO_PRODUCT[:1].upper() + NO_PRODUCT[1:] + ".")
    whole, daily = tables.get("relation"), tables["relation-daily"]
    if whole is None:
        part.add_absent("Relation of all days", "too few days with both products")
    else:
        part.add_text(f"All days together leave {whole.attrs['rms_nT']:.4g} nT a component.")
        items = []
        for name, value, sigma in zip(
            *(whole[one].values.tolist() for one in ("parameter", "value", "sigma")), strict=True
        ):
            _, factor, unit = PARTS[name.partition("[")[0]]
            items.append({"name": name, "value": factor * value, "sigma": factor * sigma, "unit": unit})
        part.fields = {"items": items, "rms_nT": float(whole.attrs["rms_nT"])}
        rows = [
            (one["name"], with_error(one["value"], one["sigma"]), one["unit"]) for one in part.fields["items"]
        ]
        part.text.append(html_table(("", "value ± sigma", "unit"), rows))
        part.plots += [relation_figure(whole, name) for name in PARTS]
    part.plots += [relation_days_figure(daily, name) for name in ("rotation", "shift")]
    part.fields["scatter"] = {
        str(name): float(one)
        for name, one in zip(daily["parameter"].values, np.nanstd(daily["value"].values, axis=0), strict=True)
    }
    return part


def _corners(tables: Mapping[str, xr.Dataset]) -> Part:
    part = Part("corners", "Which of the three disagrees")
    table = tables.get("corners")
    if table is None:
        part.add_absent("Corners", "too few days with both products")
        return part
    names = [str(name) for name in table["sensor"].values]
    part.fields = {
        "items": [
            {"sensor": name, "variance": float(value), "sigma": float(sigma), "unit": "nT2"}
            for name, value, sigma in zip(names, table["value"].values, table["sigma"].values, strict=True)
        ],
        "closure_nT": float(table.attrs["closure_nT"]),
    }
    part.add_text(
        "Variance of each sensor's own error, when errors of different sensors are unrelated; what is the "
        f"same at both vector sensors counts as the scalar one's. The three residuals close to "
        f"{table.attrs['closure_nT']:.2g} nT."
    )
    rows = [(one["sensor"], with_error(one["variance"], one["sigma"])) for one in part.fields["items"]]
    part.text.append(html_table(("sensor", "variance ± sigma, nT^2"), rows))
    part.plots.append(sensor_variance_figure(table))
    return part
