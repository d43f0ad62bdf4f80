"""What a workspace holds of its chain: the published days and the tables that belong together."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day, TableRecord
from inflight.errors import CatalogError, SettingsError
from inflight.estimators.epochs import join_epochs
from inflight.estimators.torquer_band import join_equations
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.chain_beside import BESIDE
from inflight.tasks.chain_parts import part_of
from inflight.tasks.models import preflight_model
from inflight.tasks.planning import equations_of, product_of
from inflight.tasks.reprocess_chain import LEFT_OUT, MADE_FROM, spread_offsets
from inflight.tasks.tables import newest_record
from inflight.time import day_bounds

#: Tables of the chain; ``window`` is that of another reprocessing, for comparison.
TABLES = (
    "continuous",
    "trend",
    "trend-choice",
    "own-fit",
    "torquer-band",
    "torquer-band-daily",
    "torquer-band-mean",
    "current-steps",
    "panels",
    "torquer-mean",
    "daily-after",
    "daily-temperature",
    "clock-faults",
    "periods",
    *BESIDE,
)
_REMEDY = "run 'inflight reprocess --table continuous' first"
#: Variables of a day that reports need: its parts and what its own fit left.
_OF_DAY = ("before", "after", "start", "end")


@dataclass(frozen=True)
class ChainResults:
    """The chain of a comparison, read once.

    Attributes
    ----------
    mission : Mission
    comparison : str
    model : Model
        With which the days were looked at: what was known before.
    fitted : Model
        With the values of the continuous fit.
    version : str
        Name and version of the fitted model.
    days : list of Day
        Published, in order.
    read : list of Dataset
        Theirs: parts, `before` and `after`.
    tables : dict of str to Dataset
    ids : dict of str to int
        Of the tables.
    left_out : dict of str to str
        Why a table is not there.
    reports : mapping of datetime64[D] to mapping
        Of the products that were made with the continuous fit.
    """

    mission: Mission
    comparison: str
    model: Model
    fitted: Model
    version: str
    days: list[Day]
    read: list[xr.Dataset]
    tables: dict[str, xr.Dataset]
    ids: dict[str, int]
    left_out: dict[str, str] = field(default_factory=dict)
    reports: Mapping[np.datetime64, Mapping[str, Any]] = field(default_factory=dict)

    def why(self, name: str) -> str:
        """Return why a table is not there."""
        return self.left_out.get(name) or f"table {self.comparison}-{name} is not there; {_REMEDY}"

    @cached_property
    def epochs(self) -> xr.Dataset | None:
        """Epochs of all days at which the first current steps; None without any."""
        parts = part_of(self.read, "epoch")
        return join_epochs(parts) if parts else None

    @cached_property
    def band(self) -> xr.Dataset | None:
        """Equations of the torquers' band of all days; None without torquers."""
        parts = part_of(self.read, "band")
        return join_equations(parts) if parts else None

    @property
    def span(self) -> list[str]:
        """First and last day."""
        return [str(self.days[0].day), str(self.days[-1].day)]


def chain_results(cat: Catalog, mission: Mission, comparison: str = "main") -> ChainResults:
    """Read what the last chain of a comparison published.

    Raises
    ------
    SettingsError
        When the mission has no such comparison.
    CatalogError
        When no chain was published for it.
    """
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}",
            remedy=f"choose one of {', '.join(mission.comparisons)}",
        )
    newest = _newest(cat, comparison, lambda table: True)
    if "continuous" not in newest:
        raise CatalogError(f"no chain of all days is published for comparison '{comparison}'", remedy=_REMEDY)
    made_from = newest["continuous"][1].attrs.get(MADE_FROM)
    held = _newest(cat, comparison, lambda table: table.attrs.get(MADE_FROM) == made_from)
    record = held["continuous"][0]
    days = [
        day
        for day in cat.days(equations_of(comparison, True), states=("published",))
        if record.start <= day_bounds(day.day)[0] < record.end
    ]
    days.sort(key=lambda day: day.day)
    if not days:
        raise CatalogError("the days of the published chain are gone", remedy=_REMEDY)
    tables = {name: table for name, (_, table) in held.items()}
    left_out: dict[str, str] = (
        json.loads(tables["trend"].attrs.get(LEFT_OUT, "{}")) if "trend" in tables else {}
    )
    ids = {name: one.id for name, (one, _) in held.items()}
    reports = _products(cat, comparison)
    for name in ("z-offset", "window"):
        _beside(cat, comparison, name, tables, ids, left_out)
    if "z-offset" not in tables:
        left_out["z-offset"] = _no_offsets(reports)
    model = _looked_with(cat, mission, comparison, days[0])
    version, fitted = _fitted(cat, mission, model)
    read = [_read(cat, day) for day in days]
    return ChainResults(
        mission, comparison, model, fitted, version, days, read, tables, ids, left_out, reports
    )


def _newest(
    cat: Catalog, comparison: str, chosen: Callable[[xr.Dataset], bool]
) -> dict[str, tuple[TableRecord, xr.Dataset]]:
    """Return the newest certified tables of the chain that are chosen."""
    found = {}
    for name in TABLES:
        for record in reversed(cat.tables(f"{comparison}-{name}")):
            if record.damaged or not record.certified:
                continue
            table = cat.table_by_id(record.id)
            if chosen(table):
                found[name] = (record, table)
                break
    return found


def _beside(
    cat: Catalog,
    comparison: str,
    name: str,
    tables: dict[str, xr.Dataset],
    ids: dict[str, int],
    left_out: dict[str, str],
) -> None:
    """Add a table that another step made, the newest certified one."""
    known = newest_record(cat, f"{comparison}-{name}")
    if known is not None:
        tables[name], ids[name] = cat.table_by_id(known.id), known.id
    elif name == "window":
        left_out[name] = (
            f"no table {comparison}-window to compare with; 'inflight reprocess --table window' makes one"
        )


def _products(cat: Catalog, comparison: str) -> dict[np.datetime64, Mapping[str, Any]]:
    """Return the reports of products; only those of the continuous fit tell the spread of their residual."""
    found = cat.days(product_of(comparison), states=("published",))
    return {day.day: day.report for day in found if day.report.get("spread")}


def _no_offsets(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> str:
    told = spread_offsets(reports)
    return told if isinstance(told, str) else "products were made anew since; reprocess makes the table"


def _read(cat: Catalog, day: Day) -> xr.Dataset:
    whole = cat.read(day)
    kept = [str(name) for name in whole.variables if "." in str(name) or name in _OF_DAY]
    return whole[[name for name in kept if name in whole.data_vars]]


def _looked_with(cat: Catalog, mission: Mission, comparison: str, day: Day) -> Model:
    """Return the model that the chain's days were made with."""
    sha = cat.read(day).attrs.get("model", "")
    start = preflight_model(cat, mission, comparison)
    for record in cat.models():
        if record.sha256 == sha:
            text = cat.model_text(record.name, record.version)[2]
            return Model.parse(text, mission, f"{record.name} version {record.version}", start.own)
    return start


def _fitted(cat: Catalog, mission: Mission, model: Model) -> tuple[str, Model]:
    name = f"{model.name}-continuous"
    known = [record for record in cat.models() if record.name == name]
    if not known:
        raise CatalogError(f"the fitted model {name!r} is not in the catalog", remedy=_REMEDY)
    version = known[-1].version
    text = cat.model_text(name, version)[2]
    return f"{name} version {version}", Model.parse(text, mission, f"{name} version {version}", model.own)
