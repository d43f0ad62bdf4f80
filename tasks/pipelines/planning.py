"""What a reprocessing has to do: which days' equations are missing or out of date, and from what."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from inflight.catalog import Catalog, Day, idempotency_key
from inflight.errors import CatalogError, MissionError
from inflight.mission import Mission
from inflight.model import Model
from inflight.tasks.archive import (
    INPUTS,
    ArchiveIndex,
    Need,
    base_role,
    geometry_channels,
    needs_of,
    replaceable_needs,
)
from inflight.tasks.models import UsedModel, current_model
from inflight.tasks.pipelines.mission import CHAIN_VERSION, Witnesses
from inflight.tasks.pipelines.scalar import EQUATIONS_VERSION
from inflight.time import DayLike, as_day, day_range, is_within

ONE_DAY = np.timedelta64(1, "D")


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
    batch_days : int
        Days of one segment and one worker's task; it bounds the memory.
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
        step, which hides what the model does not know. Products tell its size either way.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    comparison: str = "main"
    table: Literal["daily", "window", "monthly", "span", "continuous"] = "window"
    window_days: int = Field(15, ge=1, le=3660)
    batch_days: int = Field(10, ge=1, le=60)
    min_coverage: float = Field(0.0, ge=0.0, le=1.0)
    trend: Literal["auto", "constant", "linear", "parabola", "log", "spline"] = "auto"
    origin: dt.date | None = None
    mean_days: float = Field(260.0, gt=0.0)
    distribute: bool = False

    @property
    def is_chain(self) -> bool:
        """True when all days are fitted at once."""
        return self.table == "continuous"


@dataclass(frozen=True)
class Plan:
    """What a reprocessing has to do; made without changing anything but the registry of models.

    Attributes
    ----------
    batches : list of list of datetime64[D]
        Days whose normal equations are missing or out of date.
    unchanged : list of datetime64[D]
        Days whose normal equations are up to date; their products still follow the table.
    no_work : dict
        Days without a measurement to work on, and what is missing.
    """

    settings: ReprocessSettings
    used: UsedModel
    context: str
    needs: tuple[Need, ...]
    index: ArchiveIndex
    days: list[np.datetime64]
    keys: Mapping[np.datetime64, str]
    batches: list[list[np.datetime64]]
    unchanged: list[np.datetime64]
    no_work: Mapping[np.datetime64, str]
    reference: list[float] | None
    base: str

    @property
    def model(self) -> Model:
        """The model to use."""
        return self.used.model

    @property
    def equations(self) -> str:
        """Dataset of the normal equations."""
        return equations_of(self.settings.comparison, self.settings.is_chain)

    @property
    def product(self) -> str:
        """Dataset of the products: the main comparison's are the mission's fields."""
        return product_of(self.settings.comparison)

    @property
    def is_spin(self) -> bool:
        """True when the spin calibrates the sensor."""
        return self.model.layout is not None and self.model.layout.kind == "spin"

    def in_batches(self, days: Sequence[np.datetime64]) -> list[list[np.datetime64]]:
        """Return days in batches, one a worker's task and a segment."""
        size = self.settings.batch_days
        return [list(days[at : at + size]) for at in range(0, len(days), size)]


def plan(
    cat: Catalog,
    mission: Mission,
    start: DayLike | None = None,
    end: DayLike | None = None,
    settings: ReprocessSettings | None = None,
) -> Plan:
    """Find out what has to be done for the half-open span of UTC days.

    Parameters
    ----------
    start, end : UTC date, optional
        The archive's own span when absent.

    Raises
    ------
    MissionError
        When the mission has no such comparison, or one of kind platform.
    CatalogError
        When the archive has no day in the span.
    """
    settings = settings or ReprocessSettings()
    _check_comparison(mission, settings.comparison)
    if settings.is_chain and mission.comparisons[settings.comparison].kind == "spin":
        raise MissionError(
            "a spin comparison has no table 'continuous'", remedy="choose daily, window, monthly or span"
        )
    used = current_model(cat, mission, settings.comparison)
    seen = Witnesses.of(mission, settings.comparison).names if settings.is_chain else ()
    wanted = needs_of(mission, used.model, [*geometry_channels(mission), *seen])
    needs = tuple(replaceable_needs(mission, used.model, wanted))
    index = ArchiveIndex.of(cat, needs, _with_neighbours(start, end, needs))
    there = [day for day in index.with_all(needs) if is_within(day, start, end)]
    if not there:
        raise CatalogError(
            "the archive has no day of the span on which every instrument measured",
            remedy="ingest the files first; 'inflight catalog list' shows what is there",
        )
    asked = day_range(start or there[0], end or there[-1] + ONE_DAY)
    context = cat.save_context(mission.text, used.model.name, used.version, {})
    base = next(need for need in needs if need.name == base_role(mission, settings.comparison))
    equations = equations_of(settings.comparison, settings.is_chain)
    keys = {
        day: _key(
            equations, day, context, [source.key for source in index.sources(needs, day, base)], settings
        )
        for day in there
    }
    published = {day.day: day for day in cat.days(equations, states=("published",))}
    todo = [day for day in there if day not in published or published[day].key != keys[day]]
    size = settings.batch_days
    return Plan(
        settings,
        used,
        context,
        needs,
        index,
        there,
        keys,
        [todo[at : at + size] for at in range(0, len(todo), size)],
        [day for day in there if day not in set(todo)],
        {day: _missing(index, needs, day) for day in asked if day not in keys},
        _reference(published, there, keys),
        base.name,
    )


def equations_of(comparison: str, chain: bool = False) -> str:
    """Return the dataset of a comparison's normal equations: the nine's, or those of the whole chain."""
    return f"equations/{comparison}/{'chain' if chain else 'base'}"


def product_of(comparison: str) -> str:
    """Return the dataset of a comparison's products: the main one's are the mission's fields."""
    return "l2/field" if comparison == "main" else f"l2/field-{comparison}"


def _check_comparison(mission: Mission, name: str) -> None:
    fit = [known for known, entry in mission.comparisons.items() if entry.kind in ("scalar", "spin", "dual")]
    if name not in fit:
        raise MissionError(
            f"'{name}' is no scalar, spin or dual comparison of mission '{mission.mission}'",
            remedy=f"choose one of {', '.join(fit) or 'none: the mission has none'}",
        )


def _with_neighbours(start: DayLike | None, end: DayLike | None, needs: Sequence[Need]) -> slice:
    """Return the days a span is made from; the farthest stand in for a channel that a day has not."""
    beside = INPUTS.stand_in_days if any(need.replaceable for need in needs) else 1
    before = max(beside, *(need.days_before for need in needs)) * ONE_DAY
    return slice(
        str(as_day(start) - before) if start is not None else None,
        str(as_day(end) + beside * ONE_DAY) if end is not None else None,
    )


def _key(
    dataset: str, day: np.datetime64, context: str, sources: Sequence[str], settings: ReprocessSettings
) -> str:
    inputs = [*sources, f"min_coverage={settings.min_coverage}"]
    version = CHAIN_VERSION if settings.is_chain else EQUATIONS_VERSION
    return idempotency_key(dataset, day, version, context, inputs)


def _missing(index: ArchiveIndex, needs: Sequence[Need], day: np.datetime64) -> str:
    gone = sorted(
        {need.instrument for need in needs if need.channel == "field" and index.get(need, day) is None}
    )
    return f"no measurements of {', '.join(gone)}"


def _reference(
    published: Mapping[np.datetime64, Day], days: Sequence[np.datetime64], keys: Mapping[np.datetime64, str]
) -> list[float] | None:
    """Return where published equations of this context are linearised, so that new ones fit to them."""
    for day in days:
        if day in published and published[day].key == keys[day] and published[day].report.get("shared"):
            return [float(value) for value in published[day].report["reference"]]
    return None
