"""The whole-mission fit as tables, and reading them back.

`fit_mission_tables` takes the statistics of all days (`mission_statistics`), fits everything the model lets
data move (`inflight.mission_fit.fit_mission`), and makes the tables that the days' parts allow; of a table
that cannot be made it keeps the reason. Products are made with the fitted model, whose scale factors are
functions of time, so that no day jumps against its neighbour. `read_mission_fit` reads the published days and
the tables that belong together, for reports.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import xarray as xr

from inflight.calibration import with_changes, with_learnt_spans
from inflight.catalog import Catalog, Day, Run
from inflight.errors import CalibrationError, CatalogError, InflightError, SamplesError, SettingsError
from inflight.mission import Mission
from inflight.mission_fit import (
    MissionFit,
    concat_epochs,
    continuous_table,
    daily_fits,
    fit_band,
    fit_mission,
    fit_spread_law,
    fit_step,
    robust_mean,
    scale_factor_rates,
    select_panel_model,
    torquer_lines,
)
from inflight.model import Model
from inflight.progress import Progress, silent, tell_each
from inflight.tasks.batches import give_back_memory
from inflight.tasks.models import model_label, preflight_model, version_of
from inflight.tasks.pipelines.base import (
    ALL_DAYS_STATISTICS,
    FITTED,
    MODEL,
    Plan,
    TablesToPublish,
    equations_of,
    newest_record,
    newest_tables,
    product_of,
)
from inflight.tasks.pipelines.mission_fit.day import (
    EQUATION_VARIABLES,
    StoredDays,
    equations_of_days,
    unpack_part,
)
from inflight.tasks.pipelines.mission_fit.tables import (
    AUXILIARY_TABLES,
    auxiliary_table_makers,
    daily_after,
    daily_temperatures,
    faults_table,
    node_times,
    own_fits,
    periods_of,
    spread_offsets,
    spread_statistics,
    stated_periods,
    torquer_band,
    torquer_mean,
)
from inflight.time import DayLike, Int64, as_day, day_bounds, to_tt2000

#: Attributes of tables: what all tables of one run share; and, of ``trend``, what could not be made and why.
FIT_KEY, SKIPPED = "made_from", "left_out"

#: Names of the tables, without the comparison.
TABLES = (
    "continuous",
    "trend",
    "trend-choice",
    "own-fit",
    "torquer-lines",
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

#: Variables of a day's own fit of nine parameters.
_OWN_FIT = ("fit", "fit_covariance", "after", "start", "end")


@dataclass
class MissionTables:
    """The fit of all days and its tables.

    Attributes
    ----------
    found : MissionFit
        The fit of everything to all days.
    tables : dict of str to Dataset
        By name without the comparison, of `TABLES`.
    skipped : dict of str to str
        Tables that could not be made, and why.
    """

    found: MissionFit
    tables: dict[str, xr.Dataset] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def required(self, name: str) -> xr.Dataset:
        """Return a table that another one is made from.

        Raises
        ------
        CalibrationError
            When it could not be made.
        """
        if name not in self.tables:
            raise CalibrationError(self.skipped[name], remedy="see the table it is made from")
        return self.tables[name]


def fit_mission_tables(
    cat: Catalog,
    mission: Mission,
    plan: Plan,
    days: Mapping[np.datetime64, Day],
    fit_key: str,
    progress: Progress = silent,
) -> MissionTables:
    """Fit all days together and make every table their parts allow.

    Parameters
    ----------
    fit_key : str
        What the tables of one fit have in common: readers must know which belong together.
    progress : callable
        Told of stages "statistics", days read, and "fit", tables made after the fit itself.

    Raises
    ------
    CalibrationError
        When the days do not suffice for the fit itself; tables that fail only say so.
    """
    stored = StoredDays(cat, [days[day] for day in sorted(days)])
    out, places = _fit_all_days(stored, plan, progress)
    give_back_memory()
    model, found = plan.model, out.found

    @cache
    def channels() -> list[xr.Dataset]:
        return stored.read_part("channel", "start", "end")

    def epochs() -> xr.Dataset:
        return concat_epochs(stored.rows_of("epoch"))

    # Neighbours take the same part of the days: one part at a time is in memory.
    makers: dict[str, Callable[[], xr.Dataset]] = {
        "torquer-lines": lambda: torquer_lines(
            [one for day in stored.read_part("spectrum") for one in unpack_part([day], "spectrum")]
        ),
        "torquer-band": lambda: fit_band(torquer_band(stored), by="day").table(),
        "torquer-band-daily": lambda: daily_fits(torquer_band(stored)),
        "torquer-band-mean": lambda: robust_mean(out.required("torquer-band-daily")),
        "current-steps": lambda: fit_step(epochs()).table(),
        "panels": lambda: select_panel_model(epochs(), node_times(epochs())).table(),
        "torquer-mean": lambda: torquer_mean(channels(), plan.settings.mean_days),
        "daily-after": lambda: daily_after(found.equations, found),
        "daily-temperature": lambda: daily_temperatures(mission, model, channels()),
        "clock-faults": lambda: faults_table(out.required("daily-after")),
        "periods": lambda: periods_of(out.required("daily-after"), stated_periods(mission)),
    }
    makers |= auxiliary_table_makers(mission, model, found.equations, stored.of(places), found)
    for name in tell_each(progress, "fit", list(makers)):
        try:
            out.tables[name] = makers[name]()
        except InflightError as error:
            out.skipped[name] = error.message
        give_back_memory()
    # Tables of older runs stay certified where this one has none.
    for table in out.tables.values():
        table.attrs[FIT_KEY] = fit_key
    out.tables["trend"].attrs[SKIPPED] = json.dumps(out.skipped)
    return out


def _fit_all_days(stored: StoredDays, plan: Plan, progress: Progress) -> tuple[MissionTables, Int64]:
    """Return the fit with the tables of its own, and the places of the days that it was made of."""
    settings, model = plan.settings, plan.model
    origin = None if settings.origin is None else int(to_tt2000(np.datetime64(settings.origin, "ns")))
    read = stored.read(*EQUATION_VARIABLES, *_OWN_FIT, progress=progress)
    equations, drift = equations_of_days(read)
    read = [day[list(_OWN_FIT)] for day in read]
    give_back_memory()
    is_fitted = equations.count > 0
    places = np.flatnonzero(is_fitted)
    found = fit_mission(equations.filled, model, settings.trend, origin, drift.of_blocks(places))
    noise = np.array([float(day["after"].values[0]) for day in read])
    # A day that could not be fitted is taken to be as noisy as the others.
    noise = np.where(is_fitted, noise, np.median(noise[places]))
    equations = drift.remove_drift(equations, scale_factor_rates(found.fit, equations))
    own = own_fits([read[place] for place in places], found, model)
    table = continuous_table(equations, found, model, noise)
    table = table.assign_attrs({MODEL: model.sha, FITTED: named_fit(model, found).sha})
    # All fitted days taught every row: between them the trend interpolates.
    first, last = table["start"].values[places[0]], table["end"].values[places[-1]]
    start, end = (np.full(len(read), at) for at in (first, last))
    out = MissionTables(found)
    # How much parameters change is told by the days' own: a trend has none of what it does not follow.
    out.tables["continuous"] = with_changes(with_learnt_spans(table, start, end), [own])
    out.tables["own-fit"] = own
    out.tables["trend"] = found.fit.table()
    if found.choice is not None:
        out.tables["trend-choice"] = found.choice.table()
    return out, places


def trend_of_products(
    cat: Catalog, comparison: str, version: int, start: DayLike | None = None, end: DayLike | None = None
) -> str:
    """Return the kind of trend that the scale factors of published products of a span follow.

    Empty where products of its first or last day take one value a window, are of another version of the
    model, or are none.
    """
    name = f"{comparison}-continuous"
    span = slice(*(None if one is None else str(as_day(one)) for one in (start, end)))
    days = cat.days(product_of(comparison), span, states=("published",))
    if not days or not cat.tables(name):
        return ""
    kinds = set()
    for day in (days[0], days[-1]):
        made_by = str(cat.read(day, ["tt2000"]).attrs.get("calibration_table", ""))
        known = cat.context(day.context) if day.context else None
        follows = made_by.startswith(f"{name}:") and known is not None and known.model_version == version
        kinds.add(str(cat.table(name, at=str(day.day)).attrs["trend"]) if follows else "constant")
    return kinds.pop() if len(kinds) == 1 and "constant" not in kinds else ""


def z_offset_law(
    cat: Catalog,
    days: Mapping[np.datetime64, Day],
    solved: TablesToPublish,
    reports: Mapping[np.datetime64, Mapping[str, Any]],
) -> xr.Dataset:
    """Return the law of the residual's spread, ``std^2(dB) = a Z0^2 + noise^2`` (Yin 2010, eq. 3.6).

    A day's Z0 is its own offset along z less the common one, and the one that the product had taken off.

    Parameters
    ----------
    days : mapping of datetime64[D] to Day
        Their statistics hold the days' own fits.
    solved : TablesToPublish
        With the table of the common fit.
    reports : mapping
        Of the products: see `spread_statistics`.

    Returns
    -------
    xarray.Dataset
        As `inflight.mission_fit.SpreadLaw.table`, and by ``day`` what was fitted: `offset`, `offset_sigma`
        (nT), `variance` (nT^2), `start`.

    Raises
    ------
    CalibrationError
        When too few days have both, or all the same offset.
    """
    told = {day: one for day, one in reports.items() if one.get("spread") and day in days}
    statistics, offset, sigma = spread_statistics(told), [], []
    for day in sorted(told):
        own = cat.read(days[day])[["fit", "fit_covariance"]].isel(block=0)
        common = solved.used[day].table
        row = int(np.searchsorted(common["start"].values, sum(day_bounds(day)) // 2, side="right")) - 1
        apart = float(own["fit"].values[8]) - float(common["value"].values[row, 8])
        offset.append(apart + float(told[day].get("z_offset_nT", 0.0)))
        sigma.append(float(np.sqrt(own["fit_covariance"].values[8, 8])))
    law = fit_spread_law(statistics, np.array(offset), np.array(sigma))
    return law.table().assign(
        offset=("day", np.array(offset), {"units": "nT"}),
        offset_sigma=("day", np.array(sigma), {"units": "nT"}),
        variance=("day", statistics["variance"].values, {"units": "nT2"}),
        start=("day", statistics["start"].values, {"scale": "TT2000"}),
    )


def named_fit(base: Model, found: MissionFit) -> Model:
    """Return the fitted model under the name that the catalog has it by."""
    return replace(found.model, name=f"{base.name}-continuous")


def save_fitted(cat: Catalog, base: Model, run: Run, found: MissionFit) -> Model:
    """Save the fitted model as a version of ``<model>-continuous`` and return it."""
    model = named_fit(base, found)
    version = cat.save_model(model.name, model.text, message=f"all days together, run {run.id}")
    return replace(model, version=version)


@dataclass(frozen=True)
class MissionFitResults:
    """The published fit of a comparison, read once.

    Attributes
    ----------
    mission : Mission
    comparison : str
    model : Model
        The model the days' statistics were made with: what was known before.
    fitted : Model
        With the values of the fit.
    version : str
        Name and version of the fitted model.
    stored : StoredDays
        The published days, in order.
    tables : dict of str to Dataset
        Those of `TABLES`; ``z-offset`` and its law, of the products; ``window``, of another reprocessing.
    skipped : dict of str to str
        Why a table is not there.
    reports : mapping of datetime64[D] to mapping
        Of the products that were made with the fit.
    """

    mission: Mission
    comparison: str
    model: Model
    fitted: Model
    version: str
    stored: StoredDays
    tables: dict[str, xr.Dataset]
    skipped: dict[str, str] = field(default_factory=dict)
    reports: Mapping[np.datetime64, Mapping[str, Any]] = field(default_factory=dict)

    def table(self, name: str) -> xr.Dataset:
        """Return a table.

        Raises
        ------
        SamplesError
            When it is absent; the message says why.
        """
        if name not in self.tables:
            raise SamplesError(self.why_absent(name))
        return self.tables[name]

    def why_absent(self, name: str) -> str:
        """Return why a table is absent."""
        return self.skipped.get(name) or f"table {self.comparison}-{name} is not there; {_REMEDY}"

    @property
    def days(self) -> list[Day]:
        """The records of the days."""
        return self.stored.days

    @cached_property
    def epochs(self) -> xr.Dataset | None:
        """Epochs of all days at which the first current steps; None without any."""
        parts = self.stored.rows_of("epoch")
        return concat_epochs(parts) if parts else None

    @property
    def span(self) -> list[str]:
        """First and last day."""
        return [str(self.days[0].day), str(self.days[-1].day)]


def read_mission_fit(cat: Catalog, mission: Mission, comparison: str = "main") -> MissionFitResults:
    """Read what the last whole-mission fit of a comparison published.

    Raises
    ------
    SettingsError
        When the mission has no such comparison.
    CatalogError
        When no whole-mission fit was published for it.
    """
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}",
            remedy=f"choose one of {', '.join(mission.comparisons)}",
        )
    newest = newest_record(cat, f"{comparison}-continuous")
    if newest is None:
        raise CatalogError(f"no fit of all days is published for comparison '{comparison}'", remedy=_REMEDY)
    days = [
        day
        for day in cat.days(equations_of(comparison, ALL_DAYS_STATISTICS), states=("published",))
        if newest.start <= day_bounds(day.day)[0] < newest.end
    ]
    days.sort(key=lambda day: day.day)
    if not days:
        raise CatalogError("the days of the published fit are gone", remedy=_REMEDY)
    tables = _tables_of_one_fit(cat, comparison)
    skipped: dict[str, str] = (
        json.loads(tables["trend"].attrs.get(SKIPPED, "{}")) if "trend" in tables else {}
    )
    # Only products of this fit have the spread of their residual in their report.
    products = cat.days(product_of(comparison), states=("published",))
    reports = {day.day: day.report for day in products if day.report.get("spread")}
    tables |= newest_tables(cat, comparison, ("z-offset", "z-offset-law", "window"))
    if "window" not in tables:
        skipped["window"] = (
            f"no table {comparison}-window to compare with; 'inflight reprocess --table window' makes one"
        )
    if "z-offset" not in tables:
        try:
            spread_offsets(reports)
            skipped["z-offset"] = "products were made anew since; reprocess makes the table"
        except InflightError as error:
            skipped["z-offset"] = error.message
    model, fitted, version = _models_of_fit(cat, mission, comparison, days[0])
    return MissionFitResults(
        mission=mission,
        comparison=comparison,
        model=model,
        fitted=fitted,
        version=version,
        stored=StoredDays(cat, days),
        tables=tables,
        skipped=skipped,
        reports=reports,
    )


def _tables_of_one_fit(cat: Catalog, comparison: str) -> dict[str, xr.Dataset]:
    """Return the newest certified tables of the newest fit, by name."""
    tables: dict[str, xr.Dataset] = {}
    for name in TABLES:
        for record in reversed(cat.tables(f"{comparison}-{name}")):
            if record.damaged or not record.certified:
                continue
            table = cat.table_by_id(record.id)
            # The first of the names is the fit itself, the newest there is.
            if not tables or table.attrs.get(FIT_KEY) == tables[TABLES[0]].attrs.get(FIT_KEY):
                tables[name] = table
                break
    return tables


def _models_of_fit(cat: Catalog, mission: Mission, comparison: str, day: Day) -> tuple[Model, Model, str]:
    """Return the model the days' statistics were made with, the fitted one, and its name and version.

    Raises
    ------
    CatalogError
        When the catalog has no fitted model.
    """
    start, records = preflight_model(cat, mission, comparison), cat.models()

    def parse(name: str, version: int) -> Model:
        return version_of(cat, mission, name, version, start.own).model

    sha = cat.read(day).attrs.get("model", "")
    used = next((record for record in records if record.sha256 == sha), None)
    model = start if used is None else parse(used.name, used.version)
    name = f"{model.name}-continuous"
    versions = [record.version for record in records if record.name == name]
    if not versions:
        raise CatalogError(f"the fitted model {name!r} is not in the catalog", remedy=_REMEDY)
    return model, parse(name, versions[-1]), model_label(name, versions[-1])
