"""What a reprocessing has to do: which days' statistics are missing or out of date, and from what.

`ReprocessSettings` is what a user may choose; a `Plan` is made from it, the archive and the model in use.
Each planned day has a key, a hash of everything its statistics are made from: a day whose published
statistics carry the same key is not made anew.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from inflight.catalog import Catalog, Day, NamedContext, idempotency_key
from inflight.errors import CatalogError
from inflight.mission import Mission
from inflight.model import Model
from inflight.samples import PLAY_VERSION
from inflight.tasks.archive import (
    INPUT_SETTINGS,
    ArchiveIndex,
    Need,
    base_role,
    geometry_channels,
    needs_of,
    replaceable_needs,
    require_days,
    with_surroundings,
)
from inflight.tasks.models import (
    VersionedModel,
    as_first_saved,
    current_model,
    preflight_model,
    preflight_of,
    version_as_it_was,
)
from inflight.time import SECOND, DayLike, as_day, day_range

ONE_DAY = np.timedelta64(1, "D")
#: A record is cut into so many batches, as far as their length allows it.
_BATCHES = 20
#: Days of a batch.
_FEWEST_DAYS, _MOST_DAYS = 5, 15
#: Days of a batch of products at most, at one reading a second.
_MOST_DAYS_AT_1_HZ = 8


class ReprocessSettings(BaseModel):
    """What a user may choose of a reprocessing.

    Attributes
    ----------
    comparison : str
        Entry of the mission's `comparisons`.
    table : str
        Which table the products take: each day's own fit, windows of `window_days`, calendar months, one
        for the whole span, or ``continuous``: everything the model lets data move, fitted to all days at
        once, with scale factors that follow a trend in time.
    window_days : int
        Length of a window; windows lie on a fixed grid from 2000-01-01.
    batch_days : int, optional
        Days of one segment and one worker's task; it bounds the memory. When absent it follows from the
        number of days and the cadence: see `Plan.statistics_batches` and `Plan.product_batches`.
    min_coverage : float
        Part of a day that must be usable for a fit; with priors in place even little data does no harm.
    trend : str
        Of the scale factors in ``continuous``; ``auto`` compares them on held-out days.
    origin : date, optional
        Of a logarithmic trend; fitted when absent.
    mean_days : float
        Window of the torquers' running mean in ``continuous``, days.
    distribute : bool
        In ``continuous``, take the slow part of the residual out of the field (Yin 2010, eq. 3.7): the last
        step, which hides what the model does not have. Products state its size either way.
    use_table : str, optional
        A table that the catalog has, ``main-span`` (the newest) or ``main-span:12``: products take it as it
        is, and nothing is fitted. Days that it was not learnt from are flagged, with a wider uncertainty.
    context : str, optional
        A named context of the catalog: products take its mission file, model and tables, and what is not
        stated here as the run had it that it was made from; nothing is fitted.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    comparison: str = "main"
    table: Literal["daily", "window", "monthly", "span", "continuous"] = "window"
    window_days: int = Field(15, ge=1, le=3660)
    batch_days: int | None = Field(None, ge=1, le=60)
    min_coverage: float = Field(0.0, ge=0.0, le=1.0)
    trend: Literal["auto", "constant", "linear", "parabola", "log", "spline"] = "auto"
    origin: dt.date | None = None
    mean_days: float = Field(260.0, gt=0.0)
    distribute: bool = False
    use_table: str | None = None
    context: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _table_of_name(cls, given: Any) -> Any:
        """Take the kind of table from the name of the one to use: ``main-span`` is the span's."""
        if not isinstance(given, Mapping) or not given.get("use_table"):
            return given
        if given.get("context"):
            raise ValueError(f"context {given['context']!r} has tables of its own: leave out use_table")
        comparison = given.get("comparison", "main")
        kind = str(given["use_table"]).partition(":")[0].removeprefix(f"{comparison}-")
        if given.get("table", kind) != kind:
            raise ValueError(f"use_table {given['use_table']!r} is no table {given['table']!r}")
        return {**given, "table": kind}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a reprocessing has to do. To plan changes nothing but the registry of models.

    Attributes
    ----------
    settings : ReprocessSettings
    used : VersionedModel
        The model, with the version the catalog knows it by.
    context : str
        Id of mission, model and version in the catalog.
    equations : str
        Dataset of the days' statistics.
    needs : tuple of Need
        Series of the archive that a day's samples hold.
    index : ArchiveIndex
        The published days behind them.
    sources : mapping of datetime64[D] to sequence of Day
        What each planned day is made from.
    neighbours : mapping of datetime64[D] to sequence of Day
        What its product is made from besides: its filters and rates reach so far, those of its statistics end
        with the day.
    keys : mapping of datetime64[D] to str
        Hash of what each day's statistics are made from.
    published : mapping of datetime64[D] to Day
        The statistics that the catalog has, of any key.
    no_work : dict
        Days without a measurement to work on, and what is missing.
    recorded : dict
        The settings and the span, as the run's record states them.
    """

    settings: ReprocessSettings
    used: VersionedModel
    context: str
    equations: str
    needs: tuple[Need, ...]
    index: ArchiveIndex
    sources: Mapping[np.datetime64, Sequence[Day]]
    keys: Mapping[np.datetime64, str]
    published: Mapping[np.datetime64, Day]
    neighbours: Mapping[np.datetime64, Sequence[Day]] = field(default_factory=dict)
    no_work: Mapping[np.datetime64, str] = field(default_factory=dict)
    recorded: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The model to use."""
        return self.used.model

    @property
    def product(self) -> str:
        """Dataset of the products: the main comparison's are the mission's fields."""
        return product_of(self.settings.comparison)

    @property
    def days(self) -> list[np.datetime64]:
        """The planned days, in order."""
        return list(self.keys)

    @property
    def unchanged(self) -> list[np.datetime64]:
        """Days whose statistics are up to date; their products still follow the table."""
        known = {day: one.key for day, one in self.published.items()}
        return [day for day, key in self.keys.items() if known.get(day) == key]

    @property
    def batches(self) -> list[list[np.datetime64]]:
        """Days whose statistics are missing or out of date."""
        known = set(self.unchanged)
        return self.statistics_batches([day for day in self.keys if day not in known])

    @property
    def reference(self) -> list[float] | None:
        """Where published statistics of this context are linearised, so that new ones fit to them."""
        for day in self.unchanged:
            if self.published[day].report.get("shared"):
                return [float(value) for value in self.published[day].report["reference"]]
        return None

    def statistics_batches(self, days: Sequence[np.datetime64]) -> list[list[np.datetime64]]:
        """Return days in batches, one a worker's task and a segment of their statistics."""
        return self._in_batches(days, _MOST_DAYS)

    def product_batches(self, days: Sequence[np.datetime64]) -> list[list[np.datetime64]]:
        """Return days in batches, one a worker's task and a segment of their products.

        A batch holds the products of all its days before it writes them: 27 MB for each day of 1 Hz.
        """
        cadence = min((need.cadence_ns for need in self.needs if need.channel == "field"), default=SECOND)
        return self._in_batches(days, int(np.clip(_MOST_DAYS_AT_1_HZ * cadence // SECOND, 1, _MOST_DAYS)))

    def _in_batches(self, days: Sequence[np.datetime64], most: int) -> list[list[np.datetime64]]:
        """Return days in batches of the size that was chosen, or in some twenty of at most so many days.

        What begins and ends a batch takes as long as a good half of a day; a short record is shared by more
        processes in small ones.
        """
        size = self.settings.batch_days or int(np.clip(len(days) // _BATCHES, min(_FEWEST_DAYS, most), most))
        return [list(days[at : at + size]) for at in range(0, len(days), size)]

    def product_inputs(self, day: np.datetime64) -> list[str]:
        """Return what the samples of a day's product are made from, as parts of its key."""
        around = max((need.around_ns for need in self.needs), default=0)
        return [
            self.keys[day],
            *[f"around={around}"] * bool(around),
            *(one.key for one in self.neighbours.get(day, ())),
        ]


def plan_days(
    cat: Catalog,
    mission: Mission,
    settings: ReprocessSettings,
    *,
    used: VersionedModel,
    equations: str,
    version: int,
    index: ArchiveIndex,
    sources: Mapping[np.datetime64, Sequence[Day]],
    needs: tuple[Need, ...] = (),
    inputs: Sequence[str] = (),
) -> Plan:
    """Return the plan for days whose sources are known.

    Parameters
    ----------
    used : VersionedModel
    equations : str
        Dataset of the days' statistics.
    version : int
        Of the algorithm that makes them.
    sources : mapping
        What each day is made from, in order of time.
    inputs : sequence of str
        What else the statistics depend on.
    """
    if settings.context is None:
        context = cat.save_context(mission.text, used.model.name, used.version, {})
    else:
        context = member_of_context(cat, settings).context
    return Plan(
        settings=settings,
        used=used,
        context=context,
        equations=equations,
        needs=needs,
        index=index,
        sources=sources,
        keys={
            day: idempotency_key(equations, day, version, context, [*(one.key for one in found), *inputs])
            for day, found in sources.items()
        },
        published={day.day: day for day in cat.days(equations, states=("published",))},
        recorded=settings.model_dump(),
    )


def member_of_context(cat: Catalog, settings: ReprocessSettings) -> NamedContext:
    """Return what the named context of some settings stands for in their comparison.

    Raises
    ------
    CatalogError
        When there is none.
    """
    named = cat.named_contexts(str(settings.context))
    for one in named:
        if one.comparison == settings.comparison:
            return one
    known = ", ".join(one.comparison for one in named)
    raise CatalogError(
        f"context {settings.context!r} has nothing of comparison '{settings.comparison}'",
        remedy=f"choose {known}, or make another context",
    )


def settings_of_context(
    cat: Catalog, mission: Mission, settings: ReprocessSettings
) -> tuple[Mission, ReprocessSettings]:
    """Return the mission and the settings to work with: those given, unless they name a context.

    Raises
    ------
    CatalogError
        When there is no such context.
    """
    if settings.context is None:
        return mission, settings
    member = member_of_context(cat, settings)
    run = next(run for run in cat.runs("reprocess") if run.id == member.run)
    fields = {name: run.settings[name] for name in ReprocessSettings.model_fields if name in run.settings}
    chosen = {**fields, "use_table": None, **settings.model_dump(exclude_unset=True)}
    return Mission.parse(cat.context(member.context).mission_text), ReprocessSettings(**chosen)


def models_to_use(
    cat: Catalog, mission: Mission, settings: ReprocessSettings
) -> tuple[VersionedModel, Model]:
    """Return the model and the one from before flight: those in use, or those of the named context."""
    if settings.context is None:
        comparison = settings.comparison
        used = as_first_saved(cat, current_model(cat, mission, comparison))
        return used, preflight_model(cat, mission, comparison)
    pinned = cat.context(member_of_context(cat, settings).context)
    name, version = pinned.model_name, pinned.model_version
    return version_as_it_was(cat, mission, name, version), preflight_of(cat, mission, name, version)


def product_needs(
    mission: Mission, model: Model, preflight: Model, channels: Iterable[str] = (), reach_s: float = 0.0
) -> tuple[Need, ...]:
    """Return the series of the archive that a day's statistics and product are made from.

    Products tell the residual with the pre-flight model, too, whatever was dropped of it since. `reach_s` is
    `Pipeline.reach_s`.
    """
    before_flight = {channel for entry in preflight.effects for channel in entry.effect.channels}
    named = needs_of(mission, model, [*geometry_channels(mission), *channels, *before_flight])
    needs = with_surroundings(mission, (model, preflight), named, reach_s)
    return tuple(replaceable_needs(mission, model, needs))


def plan_archive_days(
    cat: Catalog,
    mission: Mission,
    settings: ReprocessSettings,
    span: tuple[DayLike | None, DayLike | None],
    *,
    equations: str,
    version: int,
    channels: Iterable[str] = (),
    reach_s: float = 0.0,
) -> Plan:
    """Find out which archive days of a half-open span of UTC days have to be worked on.

    Parameters
    ----------
    span : tuple of UTC date or None
        The archive's own span where an end is None.
    equations : str
        Dataset of the days' statistics.
    version : int
        Of the algorithm that makes them.
    channels : iterable of str
        Channels to read, beside those the model needs; those the mission has not are skipped.
    reach_s : float
        How far the filters of the product reach into the neighbouring days, s (`Pipeline.reach_s`).

    Raises
    ------
    CatalogError
        When the archive has no day in the span.
    """
    start, end = span
    used, preflight = models_to_use(cat, mission, settings)
    needs = product_needs(mission, used.model, preflight, channels, reach_s)
    # A day is also made from days around it; the farthest have typical values for a missing channel.
    after = INPUT_SETTINGS.typical_value_days if any(need.replaceable for need in needs) else 1
    before = max(after, *(need.days_before for need in needs))
    first = str(as_day(start) - before * ONE_DAY) if start is not None else None
    last = str(as_day(end) + after * ONE_DAY) if end is not None else None
    index = ArchiveIndex.of(cat, needs, slice(first, last))
    complete = require_days(index, needs, start, end)
    base = next(need for need in needs if need.name == base_role(mission, settings.comparison))
    has_play = any(need.part is not None and need.part.width for need in needs)
    by_itself = [replace(need, around_ns=0) for need in needs]
    sources = {day: index.sources(by_itself, day, base) for day in complete}
    reaching, neighbours = [need for need in needs if need.around_ns], {}
    for day, own in sources.items():
        known = {one.id for one in own}
        neighbours[day] = [one for one in index.sources(reaching, day, base) if one.id not in known]
    planned = plan_days(
        cat,
        mission,
        settings,
        used=used,
        equations=equations,
        version=version,
        index=index,
        sources=sources,
        needs=needs,
        inputs=[f"min_coverage={settings.min_coverage}", *[f"play={PLAY_VERSION}"] * has_play],
    )
    fields = [need for need in needs if need.channel == "field"]
    no_work = {}
    for day in day_range(start or complete[0], end or complete[-1] + ONE_DAY):
        if day not in planned.keys:
            absent = sorted({need.instrument for need in fields if index.get(need, day) is None})
            no_work[day] = f"no measurements of {', '.join(absent)}"
    recorded = {**planned.recorded, "start": str(complete[0]), "end": str(complete[-1] + ONE_DAY)}
    return replace(planned, neighbours=neighbours, no_work=no_work, recorded=recorded)


#: Name of the statistics of days that one fit of all days needs; those of tables of days are ``base``.
ALL_DAYS_STATISTICS = "chain"


def equations_of(comparison: str, statistics: str = "base") -> str:
    """Return the dataset of the days' statistics of a comparison, by the name a pipeline gives them."""
    return f"equations/{comparison}/{statistics}"


def product_of(comparison: str) -> str:
    """Return the dataset of a comparison's products: the main one's are the mission's fields."""
    return "l2/field" if comparison == "main" else f"l2/field-{comparison}"
