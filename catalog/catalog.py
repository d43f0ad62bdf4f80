"""The catalog of one workspace: the only door to what is stored in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from inflight.catalog import contexts, provenance
from inflight.catalog.database import Database
from inflight.catalog.days import (
    DatabaseDays,
    days_by_id,
    hash_of_days,
    maturities,
    revisions_of_days,
    stored_together,
)
from inflight.catalog.descriptions import DatasetDescription, describe_dataset
from inflight.catalog.differences import NOW, DayChange, days_of_collection, measured_changes
from inflight.catalog.garbage import Garbage, collect_garbage
from inflight.catalog.lineage import LineageGraph, lineage_graph
from inflight.catalog.location import database_url, is_workspace, open_database
from inflight.catalog.opening import open_days, read_one_day, read_table, read_variable, stored_variables
from inflight.catalog.provenance import Edge, walk
from inflight.catalog.records import (
    CertificationAct,
    ContextRecord,
    Day,
    FileRecord,
    ModelRecord,
    NamedContext,
    ReleaseRecord,
    RunRecord,
    TableRecord,
    Validity,
)
from inflight.catalog.release import Documents, ReleasePlan, ReleaseRequest, freeze_release, plan_release
from inflight.catalog.release_folder import MARKER, NoDatabase, ReleaseFolder
from inflight.catalog.runs import (
    Run,
    RunRate,
    baseline_of,
    close_dead_runs,
    days_of_run,
    measured_rate,
    raise_baseline,
    run_counts,
    run_records,
    run_report,
)
from inflight.catalog.spans import Instant, TimeSpan, as_date, instant, parse_span
from inflight.catalog.upkeep import (
    Repair,
    find_faults,
    repair,
)
from inflight.catalog.validity import (
    Authority,
    approve_table,
    certification_acts,
    certify_table,
    decertify_table,
    table_records,
    valid_table,
)
from inflight.errors import CatalogError, StorageError
from inflight.progress import Progress, silent

if TYPE_CHECKING:
    import datetime as dt

    import xarray as xr
    from sqlalchemy import URL
    from sqlalchemy.orm import Session

    from inflight.mission import Mission

_FOLDERS = ("stores", "releases")


class Catalog:
    """What exists in a workspace, where it is valid and what made it.

    Opening migrates the database when needed and closes runs whose process is gone. Several
    processes may read while one writes; a second writer waits, in PostgreSQL only for one of the same
    dataset. A catalog can be pickled: it is opened where it arrives, once in a process.

    Of a release's folder, wherever it was copied to, the days can be read in the same words: `open`, `days`,
    `read_day`, `inventory`. Nothing is written into it.

    Parameters
    ----------
    workspace : path
        Folder that holds ``stores``, ``releases`` and ``catalog.db``, unless the catalog is in
        PostgreSQL (`inflight.catalog.location` says where); or a release's folder.
    create : bool
        Make a workspace that is not there yet.

    Raises
    ------
    CatalogError
        When there is no workspace and `create` is False, or its database is damaged or newer.

    Examples
    --------
    >>> import tempfile, numpy as np, xarray as xr
    >>> from inflight.time import day_bounds
    >>> start, end = day_bounds("2005-01-01")
    >>> times = np.arange(start, end, 3600 * 10**9)
    >>> samples = xr.Dataset({"tt2000": ("time", times), "field": ("time", np.zeros(24), {"units": "nT"})})
    >>> catalog = Catalog(tempfile.mkdtemp())
    >>> with catalog.run("example", {}) as run:
    ...     _ = run.stage("l1/scalar", samples, day="2005-01-01")
    ...     print([day.version for day in run.publish()])
    ['v01.00']
    >>> catalog.open("l1/scalar", slice("2005-01-01T06:00", "2005-01-01T12:00")).sizes["time"]
    6
    """

    def __init__(self, workspace: Path | str, create: bool = True, *, reason: str = "") -> None:
        self.workspace = Path(workspace).expanduser().resolve()
        self.reason = reason
        if not create and not is_workspace(self.workspace) and not (self.workspace / MARKER).exists():
            raise CatalogError(
                "this folder is no workspace", file=str(workspace), remedy="make one with 'inflight new'"
            )
        release = ReleaseFolder.find(self.workspace)
        if release is not None:
            self._days: DatabaseDays | ReleaseFolder = release
            self._database: Database = NoDatabase(release)
            return
        for folder in _FOLDERS:
            (self.workspace / folder).mkdir(parents=True, exist_ok=True)
        self._database = open_database(self.workspace)
        self._days = DatabaseDays(self._database)
        with suppress(StorageError):  # a full disk must not keep anyone from reading
            close_dead_runs(self.workspace, self._database)

    def __repr__(self) -> str:
        return f"Catalog({str(self.workspace)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _arrived, (str(self.workspace),)

    # --- runs and days -------------------------------------------------------------------------

    def run(self, kind: str, settings: Mapping[str, Any] | None = None, context: str | None = None) -> Run:
        """Return a run to be used in a ``with`` statement.

        Parameters
        ----------
        kind : str
            What is done, such as ``reprocess``.
        settings : mapping
            JSON-able; kept with the run.
        context : str or None
            Id of the context; it becomes a parent of all the run's days and tables.
        """
        why = {"reason": self.reason} if self.reason else {}
        return Run(self.workspace, self._database, kind, {**(settings or {}), **why}, context)

    def runs(self, kind: str | None = None, last: int | None = None) -> list[RunRecord]:
        """Return all runs, or the `last` ones, or those of one kind; oldest first, with state and cause."""
        return self._database.read(run_records, kind, last)

    def close_dead_runs(self) -> list[str]:
        """End the runs whose process is gone, as opening the catalog does; return their ids."""
        return close_dead_runs(self.workspace, self._database)

    def days_of_run(self, run: str) -> list[Day]:
        """Return the days of a run, whatever became of them, by dataset and day."""
        return self._database.read(days_of_run, run)

    def run_counts(self, runs: Sequence[str]) -> dict[str, dict[str, dict[str, int]]]:
        """Return how many days some runs have so far: run -> dataset -> state -> count."""
        return self._database.read(run_counts, runs)

    def rate(self, kind: str) -> RunRate | None:
        """Return how long the largest run of a kind took and how much it wrote; None when none made a day."""
        return self._database.read(measured_rate, kind)

    def run_report(self, run: str) -> Mapping[str, Any] | None:
        """Return the fields that a run kept when it was done (`Run.report`); None when there are none."""
        return self._database.read(run_report, run)

    def current(self, name: str, day: str | np.datetime64) -> Day | None:
        """Return the published revision of a day, or None; with an equal `key` there is no work to do."""
        return self._days.current(name, as_date(day))

    def days(
        self,
        name: str,
        time: TimeSpan = None,
        states: Iterable[str] | None = None,
        *,
        release: str | None = None,
    ) -> list[Day]:
        """Return one record for each day the catalog knows of, in order.

        Parameters
        ----------
        name : str
            Dataset; one that does not exist has no days.
        time : slice, day or None
            Days that the span touches.
        states : iterable of str
            Without it, the published revision of a day or else its newest record. With it, the newest
            record in one of these states that is not older than the published one.
        release : str
            The days that were frozen under this version.
        """
        return self._days.days(name, parse_span(time), states, release)

    def published(self, name: str) -> list[tuple[np.datetime64, str | None]]:
        """Return the published days of a dataset in order, and the context that made each.

        What is quick where `days`, which has all that is known of each, takes long.
        """
        return [(np.datetime64(day, "D"), context) for day, context in self._days.published(name)]

    def hash_of_days(self, names: Iterable[str]) -> str:
        """Return a hash of the days of some datasets: it changes when one is published, replaced or freed."""
        return self._database.read(hash_of_days, list(names))

    def revisions(self, name: str, time: TimeSpan = None) -> list[Day]:
        """Return every published revision of each day in a span, past ones too, the oldest first."""
        return self._database.read(revisions_of_days, name, parse_span(time))

    def collection(self, name: str, datasets: Sequence[str] = ("l2/*",)) -> list[Day]:
        """Return the days of a collection; its names are those of `differences`, and ``v01.03``.

        Raises
        ------
        CatalogError
            When there is no such release, or nothing was published with such a model.
        """
        return self._database.read(days_of_collection, name, datasets)

    def maturities(self, name: str) -> dict[str, str]:
        """Return the maturity of the days of a dataset that a release holds, by their ids."""
        return self._database.read(maturities, name)

    def days_by_id(self, ids: Iterable[str]) -> list[Day]:
        """Return the records of days by their lineage ids, whatever became of them; others are left out."""
        numbers = [int(item.partition(":")[2]) for item in ids if item.startswith("day:")]
        return self._database.read(days_by_id, numbers)

    def stored_together(self, day: Day) -> tuple[str, list[Day]]:
        """Return the sha256 of the manifest of a day's store, and all days in that store in order."""
        return self._database.read(stored_together, day.segment)

    def dataset_names(self) -> list[str]:
        """Return the names of all datasets in order; `inventory` describes each, which takes longer."""
        return self._days.names()

    def inventory(self, time: TimeSpan = None) -> list[dict[str, Any]]:
        """Describe each dataset: span, days, gaps, failures, versions, mean coverage, samples."""
        return self._days.inventory(parse_span(time))

    # --- reading -------------------------------------------------------------------------------

    def open(
        self,
        name: str,
        time: TimeSpan = None,
        variables: Iterable[str] | None = None,
        release: str | None = None,
        context: str | None = None,
    ) -> xr.Dataset:
        """Open a span of published days as one lazy Dataset.

        Parameters
        ----------
        name : str
            Dataset, such as ``l2/field``.
        time : slice, day or None
            Half-open: ``slice("2005-01-01", "2005-02-01")`` ends with January. Blocks belong to the span
            they start in.
        variables : iterable of str
            All of them when None; what dates the rows always comes along.
        release : str
            Read the frozen collection of this version.
        context : str
            Read the newest revisions made in this context.

        Returns
        -------
        xarray.Dataset
            Dask arrays of one chunk a day; `time` (datetime64[ns], UTC) and `tt2000`. Spans of more than
            16 million samples carry `time` as a lazy coordinate without an index.

        Raises
        ------
        CatalogError
            When dataset, release or variables are unknown, no day lies in the span, or units change in it.
        """
        span = parse_span(time)
        days = self._days.to_read(name, span, release, context)
        if not days:
            raise CatalogError(
                f"'{name}' has no published days in the span asked for", remedy="see 'inflight catalog list'"
            )
        return open_days(self.workspace, days, span, variables)

    def read_day(
        self,
        name: str,
        day: str | np.datetime64,
        variables: Iterable[str] | None = None,
        version: str | None = None,
    ) -> xr.Dataset:
        """Read one published day into memory, without dask; `version` (``v01.03``) reads a past revision.

        Raises
        ------
        CatalogError
            When the day or the variables are not there.
        IntegrityError
            When its store is damaged.
        """
        date = as_date(day)
        found = (
            self._days.current(name, date) if version is None else self._days.of_version(name, date, version)
        )
        if found is None:
            raise CatalogError(
                f"'{name}' has no {version or 'published revision'}",
                day=str(date),
                remedy="see 'inflight catalog list'",
            )
        return self.read(found, variables)

    def describe(self, name: str, release: str | None = None) -> DatasetDescription:
        """Describe the variables of a dataset over all its days, or those of a release.

        Raises
        ------
        CatalogError
            When it has no days, or none with samples in time.
        """
        days = self.days(name, states=("published",), release=release)
        if not days:
            raise CatalogError(f"'{name}' has no published days", remedy="see 'inflight catalog list'")
        return describe_dataset(self.workspace, days)

    def read(self, day: Day, variables: Iterable[str] | None = None, *, with_time: bool = True) -> xr.Dataset:
        """Read a day by its record; no database access. Without `with_time` it lacks ``time``, costs less."""
        _require_data(day)
        return read_one_day(self.workspace, day, variables, with_time)

    def variables_of(self, day: Day) -> tuple[str, ...]:
        """Return the names of what a day's store holds; no database access."""
        _require_data(day)
        return stored_variables(self.workspace, day)

    def read_variable(self, day: Day, name: str) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Read values and attributes of one variable of a day by its record, as plain ones.

        For code that reads some variables of thousands of days: a Dataset of them costs as much again.

        Raises
        ------
        CatalogError
            When the day has no data, or no such variable.
        IntegrityError
            When its store is damaged.
        """
        _require_data(day)
        return read_variable(self.workspace, day, name)

    # --- calibration tables --------------------------------------------------------------------

    def table(self, name: str, at: Instant, context: str | None = None) -> xr.Dataset:
        """Return the calibration table that holds at an instant, with its id as attribute ``table_id``.

        A table certified for the context goes before one the context pins, and that before one
        certified for any context; one that pins a name has no other table of it.

        Raises
        ------
        CatalogError
            When none holds then; the message lists the validities there are.
        """
        row, path = self._database.read(valid_table, name, instant(at), context)
        return read_table(self.workspace, path, row.id)

    def table_by_id(self, table_id: int) -> xr.Dataset:
        """Return a calibration table by its id, certified or not."""
        known = {record.id: record.segment for record in self.tables()}
        if table_id not in known:
            raise CatalogError(f"table {table_id} is not in the catalog; it has {sorted(known)}")
        return read_table(self.workspace, known[table_id], table_id)

    def tables(self, name: str | None = None) -> list[TableRecord]:
        """Return the records of all tables, or of one name, oldest first, with their validities."""
        return self._database.read(table_records, name)

    def certify(
        self,
        table_id: int,
        start: int,
        end: int,
        context: str | None = None,
        *,
        supersede: bool = False,
        author: str = "",
        reason: str = "",
    ) -> None:
        """State that a table holds in half-open TT2000 ``[start, end)``, for a context or for any (None).

        Author, reason and time are kept: `certification_acts`.

        Raises
        ------
        ValidityError
            When another table of the name holds in part of the span; the message names both. With
            `supersede` the older validities end instead, in the same transaction, but for days that a release
            has made with them.
        """
        authority = Authority(author.strip(), reason)
        self._database.write(certify_table, (table_id, start, end, context), authority, supersede=supersede)

    def decertify(
        self,
        table_id: int,
        start: int | None = None,
        end: int | None = None,
        context: str | None = None,
        *,
        author: str,
        reason: str,
    ) -> None:
        """State that a table does not hold in half-open TT2000 ``[start, end)`` any more; None is open.

        A validity that is cut in the middle is split. No other table takes its place.

        Raises
        ------
        ValidityError
            When the table does not hold there, or a release has days made with it.
        """
        authority = Authority(author.strip(), reason)
        self._database.write(decertify_table, table_id, start, end, context, authority)

    def certification_acts(
        self, name: str | None = None, until: dt.datetime | None = None
    ) -> list[CertificationAct]:
        """Return what was done to the validities of a table name or of all, oldest first, before an instant.

        `inflight.catalog.validity.validities` tells what they lead to.
        """
        return self._database.read(certification_acts, name, until)

    def approve(self, table_id: int, person: str, note: str = "") -> None:
        """Record that a person answers for a table: definitive releases take no other.

        Raises
        ------
        CatalogError
            When there is no such table, or no person is named.
        """
        self._database.write(approve_table, table_id, person, note)

    # --- models, contexts, files -----------------------------------------------------------------

    def save_model(
        self,
        name: str,
        text: str,
        parent: int | None = None,
        message: str = "",
        *,
        new_version: bool = False,
        change: Mapping[str, Any] | None = None,
    ) -> int:
        """Save a model and return its version; a known text returns the version it has, unless `new_version`.

        Parameters
        ----------
        change : mapping, optional
            What making it did to the residual (`ModelRecord.change`).
        """
        return self._database.write(provenance.save_model, name, text, parent, message, new_version, change)

    def model_text(self, name: str | None = None, version: int | None = None) -> tuple[str, int, str]:
        """Return ``(name, version, text)`` of a model: the latest version, of the latest model when None.

        Raises
        ------
        CatalogError
            When it is not there; the message lists those that are.
        """
        return self._database.read(provenance.model_text, name, version)

    def models(self) -> list[ModelRecord]:
        """Return the history of all models, oldest first."""
        return self._database.read(provenance.model_records)

    def save_context(
        self,
        mission_text: str,
        model_name: str,
        model_version: int,
        tables: Mapping[str, Sequence[Validity]],
    ) -> str:
        """Pin mission YAML, model version and which table is valid when; return the id, the sha256 of these.

        `tables`: name -> (table id, start, end) in half-open TT2000.
        """
        return self._database.write(
            provenance.save_context, mission_text, (model_name, model_version), tables
        )

    def context(self, context: str) -> ContextRecord:
        """Return what a context pins."""
        return self._database.read(provenance.context_record, context)

    def named_contexts(self, name: str | None = None) -> list[NamedContext]:
        """Return the context of each comparison that a name stands for, or those of all names.

        Raises
        ------
        CatalogError
            When there is no such name.
        """
        return self._database.read(contexts.named_contexts, name)

    def name_contexts(self, name: str, named: Iterable[NamedContext]) -> None:
        """Give contexts, one a comparison, a name; what it stands for does not change.

        Raises
        ------
        CatalogError
            When the name is taken.
        """
        self._database.write(contexts.name_contexts, name, list(named))

    def remove_context(self, name: str) -> None:
        """Forget the name of a context; what was made in it stays.

        Raises
        ------
        CatalogError
            When there is none, or a release holds days that were made in it.
        """
        self._database.write(contexts.remove_named_context, name)

    def releases_of_context(self, name: str) -> list[str]:
        """Return the versions of the releases that hold days made in a named context, oldest first."""
        ids = [one.context for one in self.named_contexts(name)]
        return self._database.read(contexts.releases_of, ids)

    def record_files(self, run: Run, files: Iterable[FileRecord]) -> None:
        """Record delivered files; `files` shows them once the run has published what was made from them.

        The `run` of the records is not read: the files belong to `run`.
        """
        self._database.write_to((), provenance.record_files, run.id, list(files))

    def files(self, instrument: str) -> dict[str, FileRecord]:
        """Return the delivered files already taken in, by path."""
        return self._database.read(provenance.file_records, instrument)

    def lineage(self, id: str | Day, up: bool = True) -> list[Edge]:
        """Return the edges from an id towards what it was made from (`up`), or what was made from it.

        Ids are ``day:12``, ``table:4``, ``file:<sha256>``, ``context:<sha256>`` and
        ``model:<name>@<version>``.
        """
        return self._database.read(walk, [id.id if isinstance(id, Day) else id], up=up)

    def lineage_graph(
        self, named: str | Day, direction: Literal["up", "down", "both"] = "both"
    ) -> LineageGraph:
        """Return what something was made from (``up``), what was made from it (``down``), or both, in words.

        Its methods ``text()`` and ``svg()`` show it.

        Parameters
        ----------
        named : str or Day
            ``l2/field@2005-01-10``, ``main-window:4``, the name of a delivered file, ``release:1.0``,
            ``model:2``, ``context:NAME``, or a lineage id; a dataset or table alone is all its days, or its
            newest table.

        Raises
        ------
        CatalogError
            When there is no such thing.
        """
        name = named.id if isinstance(named, Day) else named
        return self._database.read(lineage_graph, name, direction)

    # --- upkeep and releases -----------------------------------------------------------------------

    @property
    def baseline(self) -> int:
        """Release baseline, the XX of versions ``vXX.YY``."""
        return self._database.read(baseline_of)

    def set_baseline(self, baseline: int) -> None:
        """Begin a new release baseline; revisions of days begin again at 00 under it.

        Raises
        ------
        CatalogError
            When it is lower than the present one.
        """
        self._database.write(raise_baseline, baseline)

    def verify(self, name: str | None = None, progress: Progress = silent) -> list[dict[str, str]]:
        """Hash every store in use against its manifest; list ``{"item", "fault", "path"}``."""
        return self._database.read(find_faults, self.workspace, name, progress)

    def repair(self, dry_run: bool = False, progress: Progress = silent) -> list[Repair]:
        """Take what lies in damaged stores out of use, so that the next ingest and reprocess make it again.

        Its days are recorded as failed, its tables lose their validity, in one transaction; nothing is
        deleted and no whole store touched. `dry_run` only lists.
        """
        return repair(self.workspace, self._database, dry_run=dry_run, progress=progress)

    def gc(self, dry_run: bool = True, *, past: bool = False, progress: Progress = silent) -> list[Garbage]:
        """List, and remove unless `dry_run`, the stores nothing refers to.

        Parameters
        ----------
        dry_run : bool
        past : bool
            Also past revisions and tables that no release, no named context, no newest version and nothing
            that these were made from needs. Their records stay.
        progress : callable, optional
            Called with (stage, done, total).

        Raises
        ------
        CatalogError
            With `past`, when a run is under way.
        """
        return collect_garbage(self.workspace, self._database, dry_run=dry_run, past=past, progress=progress)

    def releases(self) -> list[ReleaseRecord]:
        """Return all releases, the oldest first."""
        return self._days.releases()

    def release(
        self,
        version: str,
        context: str | None = None,
        datasets: Sequence[str] = ("l1/*", "l2/*"),
        notes: str = "",
        destination: Path | str | None = None,
        *,
        formats: Sequence[str] = ("zarr",),
        mission: Mission | None = None,
        documents: Documents | None = None,
        maturity: str = "preliminary",
        progress: Progress = silent,
    ) -> Path:
        """Freeze the published days of some datasets as a release and copy it out.

        Parameters
        ----------
        version : str
            Such as ``1.0``; never given out twice. Files of a day are named ``v01.00`` after it.
        context : str or None
            Take the newest revisions made in it; datasets without contexts give their present ones.
        datasets : sequence of str
            Patterns, such as ``l2/*``.
        notes : str
            Text of RELEASE_NOTES.md.
        destination : path
            Folder in which one named after the version appears, by one rename; ``releases`` by default.
        formats : sequence of str
            ``zarr``, ``cdf`` (ISTP, a file a day) and ``netcdf`` (CF, a file a day).
        mission : Mission, optional
            What the files of a day say of themselves; CDF and NetCDF need its key ``release``.
        documents : callable, optional
            Called with the folder and a `ReleaseContents` before the manifest is written; writes what else
            goes with the data and returns lines for RELEASE_NOTES.md.
        maturity : str
            ``quick-look``, ``preliminary`` or ``definitive``: of its products; catalog, header and file name
            say so.
        progress : callable, optional
            Called with (stage, done, total).

        Raises
        ------
        CatalogError
            When the version exists, nothing matches, a day has no provenance, a day is missing
            without a recorded cause, or files lack keys of the mission YAML.
        """
        target = Path(destination) if destination is not None else self.workspace / "releases"
        request = ReleaseRequest(
            version=version,
            context=context,
            datasets=tuple(datasets),
            notes=notes,
            formats=tuple(formats),
            mission=mission,
            maturity=maturity,
        )
        return freeze_release(self.workspace, self._database, request, target, documents, progress)

    def differences(
        self,
        before: str,
        after: str = NOW,
        datasets: Sequence[str] = ("l1/*", "l2/*"),
        progress: Progress = silent,
    ) -> Iterator[DayChange]:
        """Yield the days that differ between two collections, with the sizes of their changes.

        Parameters
        ----------
        before, after : str
            Version of a release; ``model:2``, the newest products made with that version of the model; or
            ``now``, what is published.
        datasets : sequence of str
            Patterns, such as ``l2/*``.
        progress : callable, optional
            Called with ("changes", done, total).

        Raises
        ------
        CatalogError
            When there is no such release, or nothing was published with such a model.
        """
        old, new = self._database.read(_collections, (before, after), datasets)
        return measured_changes(self.workspace, old, new, progress)

    def plan_release(
        self,
        version: str,
        context: str | None = None,
        datasets: Sequence[str] = ("l1/*", "l2/*"),
        *,
        formats: Sequence[str] = ("zarr",),
        mission: Mission | None = None,
        maturity: str = "preliminary",
        progress: Progress = silent,
    ) -> ReleasePlan:
        """Return what a release would hold and what stands against it; nothing is written.

        The parameters are those of `release`.

        Raises
        ------
        CatalogError
            When nothing matches.
        """
        request = ReleaseRequest(
            version=version,
            context=context,
            datasets=tuple(datasets),
            formats=tuple(formats),
            mission=mission,
            maturity=maturity,
        )
        return plan_release(self.workspace, self._database, request, progress)


def _collections(session: Session, names: Iterable[str], datasets: Sequence[str]) -> list[list[Day]]:
    """Return the days of several collections, all as of one moment."""
    return [days_of_collection(session, name, datasets) for name in names]


def _require_data(day: Day) -> None:
    if not day.segment:
        raise CatalogError(f"'{day.dataset}' is {day.state} and has no data", day=str(day.day))


def _arrived(workspace: str) -> Catalog:
    """Return a catalog that came from another process; every task of a job brings one.

    A release's folder may have been exchanged for another one since: it is read again.
    """
    folder = Path(workspace)
    if not is_workspace(folder):
        return Catalog(folder, False)
    return _opened(workspace, database_url(folder))


@lru_cache(maxsize=16)
def _opened(workspace: str, address: URL) -> Catalog:
    """Return the catalog of a workspace; `address` is in the key: it may have moved since.

    Whether it is the folder's own is asked once; who writes is asked each time (`require_not_moved`).
    """
    del address
    return Catalog(workspace, False)
