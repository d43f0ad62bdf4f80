"""The protocol `Pipeline`: one way of calibrating a comparison.

Its methods in the order in which a reprocessing calls them:

1. `handles`: is this comparison of this mission its own?
2. `make_plan`: which days are there to do, and what is each made from?
3. `make_day`: what are the *statistics* of a day's samples (normal equations, estimates, Gram matrices)?
4. `solve`: which tables follow from the statistics of all days?
5. `make_product`: what is a day's field, with the table that is valid?
6. `compare`, `report`, `sections`: how well does it agree, and what is shown of the tables?

A pipeline holds no state: it is sent to worker processes by its name. To write one, copy
``docs/templates/pipeline.py`` and run `inflight.tasks.pipelines.check_pipeline` on it.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from inflight.catalog import Catalog, Day
from inflight.errors import MissionError
from inflight.mission import Mission
from inflight.progress import Progress, silent
from inflight.tasks.pipelines.base.job import Batch, Job, ProductBatch
from inflight.tasks.pipelines.base.planning import Plan, ReprocessSettings, equations_of, plan_archive_days
from inflight.tasks.pipelines.base.publication import Reprocessing, TableStager, TablesToPublish
from inflight.tasks.pipelines.base.tables import content_keys
from inflight.time import DayLike

if TYPE_CHECKING:
    import xarray as xr

    from inflight.figures import Section
    from inflight.tasks.pipelines.base.compare_report import CompareResult, Report
    from inflight.tasks.pipelines.base.compare_rows import EarlierProducts


@dataclass(frozen=True, kw_only=True)
class Versions:
    """Versions of a pipeline's algorithms, raised by hand when its numbers change.

    Each enters the idempotency keys of what it makes: what was published with an older version is made anew.

    Attributes
    ----------
    statistics : int
        Of what `Pipeline.make_day` makes.
    tables : int
        Of what `Pipeline.solve` makes of it.
    products : int
        Of what `Pipeline.make_product` makes; 0 for a pipeline without products.
    """

    statistics: int
    tables: int
    products: int


class Pipeline(ABC):
    """One way of calibrating a comparison.

    Attributes
    ----------
    tag : str
        Its name, as users and documents call it.
    versions : Versions
    statistics : str
        Name of the dataset of the days' statistics, ``equations/<comparison>/<statistics>``; empty for a
        pipeline whose tables are made from samples directly, and which has no `make_day`.
    has_products : bool
        Whether it makes calibrated fields.
    note : str
        Text in place of a product, for a pipeline without.
    learns_states : bool
        Whether it finds states of the spacecraft, between which the field of currents switches.
    reach_s : float
        How far the filters of its products reach into the neighbouring days, s; what effects look at comes
        on top (`inflight.effects.Effect.reach_s`).
    """

    tag: ClassVar[str]
    versions: ClassVar[Versions]
    statistics: ClassVar[str] = "base"
    has_products: ClassVar[bool] = True
    note: ClassVar[str] = ""
    learns_states: ClassVar[bool] = False
    reach_s: ClassVar[float] = 0.0

    # --- choosing ---------------------------------------------------------------------------------------

    @abstractmethod
    def handles(self, mission: Mission, settings: ReprocessSettings) -> bool:
        """Return True for a comparison of a mission that this pipeline calibrates.

        Parameters
        ----------
        mission : Mission
        settings : ReprocessSettings
            With a `comparison` that the mission has.
        """

    # --- what is read, and what has to be done ----------------------------------------------------------

    def extra_channels(self, mission: Mission, comparison: str) -> Sequence[str]:
        """Return the channels to read besides those the model needs, by name; none unless overridden."""
        del mission, comparison
        return ()

    def make_plan(
        self,
        cat: Catalog,
        mission: Mission,
        settings: ReprocessSettings,
        span: tuple[DayLike | None, DayLike | None],
    ) -> Plan:
        """Find out what has to be done for a half-open span of UTC days.

        Raises
        ------
        MissionError
            When the settings ask for what this pipeline does not have.
        CatalogError
            When there is no day to work on.
        """
        return plan_archive_days(
            cat,
            mission,
            settings,
            span,
            equations=equations_of(settings.comparison, self.statistics or "base"),
            version=self.versions.statistics,
            channels=self.extra_channels(mission, settings.comparison),
            reach_s=self.reach_s,
        )

    @staticmethod
    def refuse_continuous(settings: ReprocessSettings, why: str, remedy: str = "") -> None:
        """Raise `MissionError` where all days are to be fitted at once by a pipeline that fits no trend.

        Parameters
        ----------
        settings : ReprocessSettings
        why : str
            That no trend is fitted to what is calibrated here, as the start of a sentence.
        remedy : str, optional
            Which tables to choose; those of nearly all pipelines when absent.
        """
        if settings.table == "continuous":
            raise MissionError(
                f"comparisons.{settings.comparison}: {why}, so there is no table 'continuous'",
                remedy=remedy
                or "--table span fits all days together; daily, window and monthly show what changes",
            )

    def days_to_do(self, cat: Catalog, plan: Plan) -> tuple[list[np.datetime64], list[np.datetime64]]:
        """Return the days that a run would make, and those that are up to date.

        Whether a new table changes the products of other days is known when it is solved.
        """
        products = {day.day: day for day in cat.days(plan.product, states=("published",))}
        same = [
            day
            for day in plan.unchanged
            if not self.has_products or (day in products and products[day].context == plan.context)
        ]
        known = set(same)
        return [day for day in plan.days if day not in known], same

    # --- a day ------------------------------------------------------------------------------------------

    def make_day(self, batch: Batch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return the statistics of one day, along ``block``, and a report as plain numbers; runs in a worker.

        Raises
        ------
        InflightError
            When nothing can be made of the day; it is recorded as failed, with the reason.
        """
        raise NotImplementedError(f"pipeline '{self.tag}' keeps no statistics of days")

    def unify_variables(self, days: Sequence[xr.Dataset]) -> list[xr.Dataset]:
        """Return the statistics of a batch with variables of one size, as one store needs them."""
        return list(days)

    def linearise_at(
        self, work: Reprocessing, days: Mapping[np.datetime64, Day], last: Sequence[float] | None
    ) -> list[float] | None:
        """Return the parameters at which the statistics of all days are to be linearised anew; None for none.

        Parameters
        ----------
        work : Reprocessing
        days : mapping of datetime64[D] to Day
            As of `solve`.
        last : sequence of float or None
            Those of the last pass; None for each day's own.
        """
        del work, days, last
        return None

    # --- tables -----------------------------------------------------------------------------------------

    @abstractmethod
    def solve(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TablesToPublish:
        """Make the tables and stage those that are new.

        Parameters
        ----------
        work : Reprocessing
        days : mapping of datetime64[D] to Day
            The statistics of all days that were made with the plan's mission and model; empty for a pipeline
            that keeps none.

        Raises
        ------
        CalibrationError
            When no day has usable statistics.
        """

    def table_key(self, plan: Plan, name: str, days: Mapping[np.datetime64, Day]) -> str:
        """Return the key of a table: a hash of the statistics and settings it is made from."""
        inputs = [name, str(plan.settings.window_days), str(self.versions.tables), plan.context]
        return hashlib.sha256("".join([*content_keys(days), *inputs]).encode()).hexdigest()

    def table_stager(self, work: Reprocessing, days: Mapping[np.datetime64, Day]) -> TableStager:
        """Return what stages the tables of a run."""
        return TableStager(work=work, days=days, key_of=lambda name: self.table_key(work.plan, name, days))

    # --- products ---------------------------------------------------------------------------------------

    def rows_for(self, table: xr.Dataset, job: Job) -> xr.Dataset:
        """Return what of a table the products of a batch take: all of it unless overridden.

        It is sent to a worker with each batch and looked through for each day, and the whole table of a long
        mission takes megabytes. Products come out as with the whole one, byte for byte.
        """
        del job
        return table

    def make_product(self, batch: ProductBatch, day: np.datetime64) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return one day's level-2 product and a report as plain numbers; runs in a worker.

        Raises
        ------
        InflightError
            When there is no product of the day; it is recorded as failed, with the reason.
        """
        raise NotImplementedError(f"pipeline '{self.tag}' has no products")

    def finish(
        self,
        work: Reprocessing,
        days: Mapping[np.datetime64, Day],
        solved: TablesToPublish,
        reports: Mapping[np.datetime64, Mapping[str, Any]],
    ) -> None:
        """Make what needs the reports of the products; nothing unless overridden."""
        del work, days, solved, reports

    # --- the report of a run ----------------------------------------------------------------------------

    def outputs(self, plan: Plan, solved: TablesToPublish | None, made: int) -> list[str]:
        """Return the datasets and tables of a run; `made` days have products now."""
        del solved, made
        return [plan.product, f"tables/{plan.settings.comparison}-{plan.settings.table}"]

    @abstractmethod
    def results(self, work: Reprocessing, solved: TablesToPublish | None) -> dict[str, Any]:
        """Return the extra fields of a run's report; ``residual`` is rms before and after, nT.

        Parameters
        ----------
        work : Reprocessing
            Published, unless `solved` is None: then no day has statistics, and nothing was solved.
        """

    def remarks(self, fields: Mapping[str, Any]) -> Iterator[str]:
        """Yield remarks on a run as a whole, in sentences, from the extra fields of its report."""
        yield from fields.get("warnings") or ()
        for name, why in fields.get("left_out", {}).items():
            yield f"table '{name}' is not made: {why}"

    # --- what is shown ----------------------------------------------------------------------------------

    def compare(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        days: Sequence[Day],
        span: slice,
        progress: Progress,
        client: Any = None,
        earlier: EarlierProducts | None = None,
    ) -> CompareResult[Any]:
        """Measure the residual of products, before and after calibration, and what it follows.

        Parameters
        ----------
        days : sequence of Day
            The published products of the span, at least one.
        span : slice
            First day and the day after the last one, as text; None for an open end.
        client : dask Client, optional
            On whose processes many days may be read.
        earlier : EarlierProducts, optional
            Of another version of the model, to set beside these; not every kind of comparison does.
        """
        raise NotImplementedError(f"pipeline '{self.tag}' has no products")

    @abstractmethod
    def report(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        output: Path | None = None,
        cause: str = "",
        progress: Progress = silent,
    ) -> Report:
        """Return the report of the published tables, and write its page when a path is given.

        Parameters
        ----------
        cause : str
            A parameter or cause whose cross-talk with all others is to be in the report; pipelines without
            cross-talk ignore it.
        progress : callable, optional
            Called with (stage, done, total) by pipelines that need more than seconds for long missions.

        Raises
        ------
        CatalogError
            When no table is published.
        """

    @abstractmethod
    def sections(self, cat: Catalog, mission: Mission, comparison: str) -> list[Section]:
        """Return the newest published tables as sections of a page; none when there are no tables."""

    def units(
        self,
        cat: Catalog,
        mission: Mission,
        comparison: str,
        start: DayLike | None = None,
        end: DayLike | None = None,
    ) -> list[dict[str, Any]] | None:
        """Return the units of the spacecraft that switch, as plain fields; None for those that learn none."""
        del cat, mission, comparison, start, end
        return None
