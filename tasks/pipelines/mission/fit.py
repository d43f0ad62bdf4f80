"""The whole-mission fit: all days at once, the tables of what they witness, and reading both back.

`chained` takes the statistics of all days (`chain_day`), fits everything the model lets data move
(`inflight.mission_fit.fit_mission`), and makes every table that their parts allow; a table that cannot be
made only says why. Products are made with the fitted model, whose scale factors are functions of time, so
that no day jumps against its neighbour. `chain_results` reads the published days and the tables that belong
together.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from inflight.catalog import Catalog, Day, Run, TableRecord
from inflight.errors import CalibrationError, CatalogError, InflightError, SamplesError, SettingsError
from inflight.mission import Mission
from inflight.mission_fit import (
    MissionFit,
    concat_band_equations,
    concat_epochs,
    continuous_table,
    daily_fits,
    filled_running_mean,
    fit_band,
    fit_mission,
    fit_step,
    offsets_from_spread,
    residual_noise,
    robust_mean,
    scale_factor_rates,
    select_panel_model,
)
from inflight.model import Model
from inflight.tasks.models import preflight_model
from inflight.tasks.pipelines.base import Plan, equations_of, newest_record, product_of
from inflight.tasks.pipelines.mission.day import equations_of_days, means_of_channels, unpack_part
from inflight.tasks.pipelines.mission.tables import (
    AUXILIARY_TABLES,
    auxiliary_table_makers,
    daily_after,
    daily_temperatures,
    faults_table,
    node_times,
    periods_of,
    stated_periods,
)
from inflight.time import day_bounds, day_of, to_tt2000

#: Days whose spread tells what the noise alone makes of it, at least.
_FEWEST_DAYS = 5

#: Name of the dataset of the days' statistics.
STATISTICS = "chain"

#: Attributes of tables: what all of one run are made from; and, of ``trend``, what could not be made and why.
FIT_KEY, SKIPPED = "made_from", "left_out"


@dataclass
class MissionTables:
    """What the chain made of all days.

    Attributes
    ----------
    found : Continuous
        The fit of everything to all days.
    tables : dict of str to Dataset
        By name without the comparison: ``continuous``, ``trend`` and what was witnessed.
    skipped : dict of str to str
        Tables that could not be made, and why.
    """

    found: MissionFit
    tables: dict[str, xr.Dataset] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)


def fit_mission_tables(
    cat: Catalog, mission: Mission, plan: Plan, days: Mapping[np.datetime64, Day], fit_key: str
) -> MissionTables:
    """Fit all days together and make every table their parts allow.

    Parameters
    ----------
    fit_key : str
        What the tables of one fit have in common: readers must know which belong together.

    Raises
    ------
    CalibrationError
        When the days do not suffice for the fit itself; tables that fail only say so.
    """
    ordered = [days[day] for day in sorted(days)]
    read = [cat.read(day) for day in ordered]
    settings, model = plan.settings, plan.model
    origin = None if settings.origin is None else int(to_tt2000(np.datetime64(settings.origin, "ns")))
    every, drift = equations_of_days(read)
    full = np.flatnonzero(every.dataset["count"].values > 0)
    found = fit_mission(every.filled, model, settings.trend, origin, drift.of_blocks(full))
    noise = np.array([float(day["after"].values[0]) for day in read])
    # A day that could not be fitted is taken to be as noisy as the others.
    noise = np.where(every.dataset["count"].values > 0, noise, np.median(noise[full]))
    out = MissionTables(found)
    every = drift.remove_drift(every, scale_factor_rates(found.fit, every))
    out.tables["continuous"] = continuous_table(every, found, model, noise)
    out.tables["trend"] = found.fit.table()
    if found.choice is not None:
        out.tables["trend-choice"] = found.choice.table()
    out.tables["own-fit"] = _own_fits([read[place] for place in full], found)
    makers: dict[str, Callable[[], xr.Dataset]] = {
        "torquer-band": lambda: fit_band(_band(read), by="day").table(),
        "torquer-band-daily": lambda: daily_fits(_band(read)),
        "torquer-band-mean": lambda: robust_mean(_made(out, "torquer-band-daily")),
        "current-steps": lambda: fit_step(concat_epochs(unpack_part(read, "epoch"))).table(),
        "panels": lambda: _panels(read),
        "torquer-mean": lambda: _torquer_mean(read, settings.mean_days),
        "daily-after": lambda: daily_after(found.equations, found),
        "daily-temperature": lambda: daily_temperatures(mission, model, read),
        "clock-faults": lambda: faults_table(_made(out, "daily-after")),
        "periods": lambda: periods_of(_made(out, "daily-after"), stated_periods(mission)),
    }
    some = [read[place] for place in full]
    makers |= auxiliary_table_makers(mission, model, found.equations, some, found)
    for name, make in makers.items():
        try:
            out.tables[name] = make()
        except InflightError as error:
            out.skipped[name] = error.message
    # Tables of older runs stay certified where this one has none.
    for table in out.tables.values():
        table.attrs[FIT_KEY] = fit_key
    out.tables["trend"].attrs[SKIPPED] = json.dumps(out.skipped)
    return out


def _made(out: MissionTables, name: str) -> xr.Dataset:
    if name not in out.tables:
        raise CalibrationError(out.skipped[name], remedy="see the table it is made from")
    return out.tables[name]


def _own_fits(read: Sequence[xr.Dataset], found: MissionFit) -> xr.Dataset:
    """Return each day's own nine parameters: what is left to wander beside the continuous ones."""
    each = ("interval", "parameter")
    names = list(found.fit.trends)[:9]
    covariance = np.concatenate([day["fit_covariance"].values for day in read])
    return xr.Dataset(
        {
            "value": (each, np.concatenate([day["fit"].values for day in read])),
            "sigma": (each, np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))),
            "covariance": ((*each, "other"), covariance),
            "after": ("interval", np.concatenate([day["after"].values for day in read])),
            "units": ("parameter", np.array([found.fit.units[name] for name in names], dtype="U8")),
            "start": ("interval", np.concatenate([day["start"].values for day in read])),
            "end": ("interval", np.concatenate([day["end"].values for day in read])),
        },
        coords={"parameter": names, "other": names},
    )


def _band(read: Sequence[xr.Dataset]) -> xr.Dataset:
    parts = unpack_part(read, "band")
    if not parts:
        raise SamplesError(
            "no day has a stretch of torquer currents at a cadence that holds their band",
            remedy="see the missing days of the torquers' channel",
        )
    return concat_band_equations(parts)


def _panels(read: Sequence[xr.Dataset]) -> xr.Dataset:
    epochs = concat_epochs(unpack_part(read, "epoch"))
    return select_panel_model(epochs, node_times(epochs)).table()


def _torquer_mean(read: Sequence[xr.Dataset], window: float) -> xr.Dataset:
    """Return the running mean of the torquer currents, A."""
    told = {
        name: one for name, one in means_of_channels(read).items() if name.endswith(("[x]", "[y]", "[z]"))
    }
    if len(told) != 3:
        raise SamplesError("no day has torquer currents", remedy="see the missing days of their channel")
    value = np.stack([one[:, 0] for one in told.values()], axis=1)
    count = np.min([one[:, 2] for one in told.values()], axis=0)
    known = np.isfinite(count)
    start = np.concatenate([day["start"].values for day in read])
    days = day_of(start).astype("datetime64[D]").astype(np.int64)
    return (
        filled_running_mean(days[known], value[known], count[known], window=window)
        .table()
        .assign_attrs(window_days=window)
    )


def spread_offsets(reports: Mapping[np.datetime64, Mapping[str, Any]]) -> xr.Dataset | str:
    """Return the daily offsets along z from the spread of the products' residual, or why there are none.

    The days' reports hold what `inflight.mission_fit.z_offset.day_statistics` made of them.
    """
    told = [reports[day]["spread"] for day in sorted(reports) if reports[day].get("spread")]
    if len(told) < _FEWEST_DAYS:
        return f"{len(told)} days tell the spread of their residual, {_FEWEST_DAYS} needed"
    each = {"covariance": ("interval", "statistic", "other"), "start": ("interval",), "end": ("interval",)}
    each |= dict.fromkeys(("direction_mean", "direction_square"), ("interval", "axis"))
    statistics = xr.Dataset(
        {name: (each.get(name, ("interval",)), np.array([one[name] for one in told])) for name in told[0]}
    )
    try:
        return offsets_from_spread(statistics, *residual_noise(statistics)).table()
    except InflightError as error:
        return error.message


def save_fitted(cat: Catalog, base: Model, run: Run, found: MissionFit) -> Model:
    """Save the fitted model as a version of ``<model>-continuous`` and return it."""
    model = replace(found.model, name=f"{base.name}-continuous")
    version = cat.save_model(model.name, model.text, message=f"all days together, run {run.id}")
    return replace(model, version=version)


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
    *AUXILIARY_TABLES,
)

_REMEDY = "run 'inflight reprocess --table continuous' first"

#: Variables of a day that reports need: its parts and what its own fit left.
_OF_DAY = ("before", "after", "start", "end")


@dataclass(frozen=True)
class MissionFitResults:
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
    skipped : dict of str to str
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
    skipped: dict[str, str] = field(default_factory=dict)
    reports: Mapping[np.datetime64, Mapping[str, Any]] = field(default_factory=dict)

    def why(self, name: str) -> str:
        """Return why a table is not there."""
        return self.skipped.get(name) or f"table {self.comparison}-{name} is not there; {_REMEDY}"

    @cached_property
    def epochs(self) -> xr.Dataset | None:
        """Epochs of all days at which the first current steps; None without any."""
        parts = unpack_part(self.read, "epoch")
        return concat_epochs(parts) if parts else None

    @cached_property
    def band(self) -> xr.Dataset | None:
        """Equations of the torquers' band of all days; None without torquers."""
        parts = unpack_part(self.read, "band")
        return concat_band_equations(parts) if parts else None

    @property
    def span(self) -> list[str]:
        """First and last day."""
        return [str(self.days[0].day), str(self.days[-1].day)]


def read_mission_fit(cat: Catalog, mission: Mission, comparison: str = "main") -> MissionFitResults:
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
    made_from = newest["continuous"][1].attrs.get(FIT_KEY)
    held = _newest(cat, comparison, lambda table: table.attrs.get(FIT_KEY) == made_from)
    record = held["continuous"][0]
    days = [
        day
        for day in cat.days(equations_of(comparison, STATISTICS), states=("published",))
        if record.start <= day_bounds(day.day)[0] < record.end
    ]
    days.sort(key=lambda day: day.day)
    if not days:
        raise CatalogError("the days of the published chain are gone", remedy=_REMEDY)
    tables = {name: table for name, (_, table) in held.items()}
    left_out: dict[str, str] = (
        json.loads(tables["trend"].attrs.get(SKIPPED, "{}")) if "trend" in tables else {}
    )
    ids = {name: one.id for name, (one, _) in held.items()}
    # Only products of the continuous fit tell the spread of their residual.
    products = cat.days(product_of(comparison), states=("published",))
    reports = {day.day: day.report for day in products if day.report.get("spread")}
    for name in ("z-offset", "window"):
        _beside(cat, comparison, name, tables, ids, left_out)
    if "z-offset" not in tables:
        told = spread_offsets(reports)
        anew = "products were made anew since; reprocess makes the table"
        left_out["z-offset"] = told if isinstance(told, str) else anew
    model = _looked_with(cat, mission, comparison, days[0])
    version, fitted = _fitted(cat, mission, model)
    read = [_read(cat, day) for day in days]
    return MissionFitResults(
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
