"""Releases: a collection frozen in the catalog and copied out whole, as Zarr, ISTP CDF or CF NetCDF.

`freeze_release` collects days, tables and context, refuses what lacks provenance or a cause, writes the copy
with its manifest, and registers the release in one transaction that ends with the rename of its folder.
`plan_release` says what would go in and what stands against it, and writes nothing.

Equal published days give equal files: nothing in them tells when or where they were written.
`Generation_date` is the last UTC day of data in the release: the release cannot be older.
"""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import distributions
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from sqlalchemy import select
from sqlalchemy.orm import Session

from inflight.catalog.database import Database, time_in_order
from inflight.catalog.day_files import DayHeader, file_version, logical_file_id, write_cdf, write_netcdf
from inflight.catalog.days import (
    dataset_names,
    missing_days,
    published_days,
    released_days,
    status_of_days,
)
from inflight.catalog.differences import changed_days
from inflight.catalog.faultpoints import fault_point
from inflight.catalog.manifest import flush, flush_files, folder_bytes, write_manifest
from inflight.catalog.opening import read_one_day
from inflight.catalog.provenance import Edge, context_record, model_text, parent_names, unknown_ids, walk
from inflight.catalog.records import MATURITIES, ContextRecord, Day, DayData, TableRecord
from inflight.catalog.release_folder import MARKER, marker_text
from inflight.catalog.schema import ReleaseDayRow, ReleaseRow
from inflight.catalog.segments import write_segment, write_table
from inflight.catalog.spans import Span
from inflight.catalog.stores import open_store
from inflight.catalog.table_files import write_table_cdf, write_table_csv
from inflight.catalog.validity import table_records
from inflight.errors import CatalogError, IntegrityError, SettingsError, StorageError, did_you_mean
from inflight.mission import Mission
from inflight.progress import Progress, silent, tell_each
from inflight.time import to_utc, utc_text

#: Days of one released store: bounds the memory a release needs.
DAYS_PER_STORE: Final = 10
#: What a release can be written as; the first is what it is written as when nothing is said.
FORMATS: Final = ("zarr", "cdf", "netcdf")
_WRITERS: Final = {"cdf": (write_cdf, "cdf"), "netcdf": (write_netcdf, "nc")}
_WHOLE: Final = Span(None, None)


@dataclass(frozen=True, kw_only=True)
class ReleaseRequest:
    """What is asked for; `mission` says what the files of a day say of themselves."""

    version: str
    context: str | None = None
    datasets: tuple[str, ...] = ("l1/*", "l2/*")
    notes: str = ""
    formats: tuple[str, ...] = ("zarr",)
    mission: Mission | None = None
    maturity: str = "preliminary"

    def __post_init__(self) -> None:
        if self.maturity not in MATURITIES:
            raise SettingsError(
                f"{self.maturity!r} is no maturity{did_you_mean(self.maturity, MATURITIES)}",
                remedy=f"use {', '.join(MATURITIES)}",
            )
        if unknown := [name for name in self.formats if name not in FORMATS]:
            raise SettingsError(
                f"{unknown[0]!r} is no format of a release{did_you_mean(unknown[0], FORMATS)}",
                remedy=f"use {', '.join(FORMATS)}",
            )
        if not self.formats:
            raise SettingsError("a release needs a format", remedy=f"use {', '.join(FORMATS)}")

    @property
    def day_files(self) -> tuple[str, ...]:
        """The formats that are written as one file a day, each once."""
        return tuple(name for name in FORMATS if name in self.formats and name in _WRITERS)


@dataclass(frozen=True, kw_only=True)
class PreviousRelease:
    """The release before: its version and its days."""

    version: str
    days: tuple[Day, ...]


@dataclass(frozen=True, kw_only=True)
class ReleaseContents:
    """What goes into a release.

    Attributes
    ----------
    request : ReleaseRequest
    days, absent : tuple of Day
        Published days, and days between them that are not there.
    tables : tuple of TableRecord
    context : ContextRecord or None
    model : str
        Text of the context's model.
    parents : mapping
        Id of a day -> what it was made from.
    previous : PreviousRelease or None
        The last release before this one.
    used : mapping
        Id of a day -> ids of the calibration tables it was made with.
    models : mapping
        Id of a context -> model and version, such as ``champ-preflight@2``.
    """

    request: ReleaseRequest
    days: tuple[Day, ...]
    absent: tuple[Day, ...]
    tables: tuple[TableRecord, ...]
    context: ContextRecord | None
    model: str
    parents: Mapping[str, Sequence[str]]
    previous: PreviousRelease | None = None
    used: Mapping[str, Sequence[int]] = field(default_factory=dict)
    models: Mapping[str, str] = field(default_factory=dict)

    def changes(self) -> Counter[str]:
        """Return how many days were ``added``, ``removed`` and ``changed`` since the release before."""
        before = self.previous.days if self.previous else ()
        return Counter(one.kind for one in changed_days(before, self.days))

    def next_version(self) -> str:
        """Return the version that the rule gives: 1.0; a new first number when released days changed.

        Who has release 1.4 may add the days of 1.5 to it, but has to fetch 2.0 whole. Empty when the last
        release is not called by two numbers.
        """
        if self.previous is None:
            return "1.0"
        found = re.fullmatch(r"(\d+)\.(\d+)", self.previous.version)
        if found is None:
            return ""
        first, second = map(int, found.groups())
        count = self.changes()
        return f"{first + 1}.0" if count["changed"] or count["removed"] else f"{first}.{second + 1}"


#: Writes further documents into the folder of a release and returns lines for its notes.
Documents = Callable[[Path, ReleaseContents], Sequence[str]]


@dataclass(frozen=True, kw_only=True)
class ReleasePlan:
    """What a release would hold, and what stands against it.

    Attributes
    ----------
    version : str
    parts : list of dict
        By dataset and format: ``dataset``, ``format``, ``first``, ``last``, ``days``, ``missing``, ``files``
        and ``bytes``: of Zarr those of the workspace's own stores, of the others those before compression.
    tables : int
    objections : tuple of CatalogError
        The release is made when there is none.
    previous : str
        Version of the last release; empty before the first.
    changes : dict of str to int
        Days ``added``, ``removed`` and ``changed`` since.
    next_version : str
        What the rule of versions gives (`ReleaseContents.next_version`).
    """

    version: str
    parts: tuple[Mapping[str, Any], ...]
    tables: int
    objections: tuple[CatalogError, ...]
    previous: str = ""
    changes: Mapping[str, int] = field(default_factory=dict)
    next_version: str = ""


def plan_release(
    workspace: Path, database: Database, request: ReleaseRequest, progress: Progress = silent
) -> ReleasePlan:
    """Return what a release would hold; see `Catalog.plan_release`."""
    collection, objections = database.read(_considered, workspace, request)
    parts = _parts(workspace, collection, progress)
    return ReleasePlan(
        version=request.version,
        parts=parts,
        tables=len(collection.tables),
        objections=tuple(objections),
        previous=collection.previous.version if collection.previous else "",
        changes=dict(collection.changes()),
        next_version=collection.next_version(),
    )


def freeze_release(
    workspace: Path,
    database: Database,
    request: ReleaseRequest,
    destination: Path,
    documents: Documents | None = None,
    progress: Progress = silent,
) -> Path:
    """Freeze the published days of some datasets and copy them out; see `Catalog.release`."""
    collection, objections = database.read(_considered, workspace, request)
    if objections:
        raise objections[0]
    staged = destination / f".{request.version}-{uuid.uuid4().hex[:8]}"
    try:
        destination.mkdir(parents=True, exist_ok=True)
        _write_release(workspace, staged, collection, documents or _notes_of_absent, progress)
        fault_point("release_written")
        return database.write(_register, collection, staged, destination / request.version)
    except OSError as error:
        if isinstance(error, CatalogError):
            raise
        raise StorageError(
            f"release could not be written: {error}", remedy="free space and run again"
        ) from error
    finally:
        shutil.rmtree(staged, ignore_errors=True)


def _considered(
    session: Session, workspace: Path, request: ReleaseRequest
) -> tuple[ReleaseContents, list[CatalogError]]:
    """Return the collection of a request and everything that stands against it, the gravest first."""
    _refuse_bad_version(request.version)
    checks: list[Callable[[], object]] = [lambda: _refuse_known_version(session, request.version)]
    collection = _collect(session, request)
    edges = walk(session, [day.id for day in collection.days], up=True)
    checks += [
        lambda: _refuse_without_provenance(session, collection.days, edges),
        lambda: _refuse_without_cause(collection.absent),
    ]
    used: dict[str, list[int]] = {}
    for edge in edges:
        kind, _, number = edge.parent.partition(":")
        if kind == "table":
            used.setdefault(edge.child, []).append(int(number))
    named = sorted({day.context for day in collection.days if day.context is not None})
    contexts = [context_record(session, one) for one in named]
    models = {one.id: f"{one.model_name}@{one.model_version}" for one in contexts}
    collection = replace(collection, used=used, models=models)
    if request.maturity == "definitive":
        records = {record.id: record for record in table_records(session, None)}
        checks.append(lambda: _refuse_without_approval(collection, records))
    if request.day_files:
        parents = parent_names(session, edges, (day.id for day in collection.days))
        collection = replace(collection, parents=parents)
        checks += [
            lambda: _refuse_without_keys(request),
            lambda: file_version(request.version),
            lambda: _refuse_without_times(workspace, collection.days),
        ]
    objections = []
    for check in checks:
        try:
            check()
        except CatalogError as error:
            objections.append(error)
    return collection, objections


def _refuse_bad_version(version: str) -> None:
    if not re.fullmatch(r"[0-9A-Za-z][0-9A-Za-z.-]*", version):
        raise CatalogError(
            f"{version!r} is no release version", remedy="use digits, letters, '.' and '-', as in '1.0'"
        )


def _refuse_without_approval(collection: ReleaseContents, records: Mapping[int, TableRecord]) -> None:
    """Somebody answers for each table that the products of a definitive release took."""
    used = {number for numbers in collection.used.values() for number in numbers}
    open_ = [records[number] for number in sorted(used) if not records[number].approved]
    if open_:
        listed = ", ".join(f"{one.name}:{one.id}" for one in open_[:5])
        raise CatalogError(
            f"{len(open_)} tables of a definitive release are not approved, among them {listed}",
            remedy=f"inflight catalog approve {open_[0].name}:{open_[0].id} --by NAME, or another maturity",
        )


def _refuse_without_keys(request: ReleaseRequest) -> None:
    """Files state who made them of what, and how they may be used: the mission YAML has to say it."""
    named = " and ".join(request.day_files)
    if request.mission is None:
        raise CatalogError(f"files of format {named} need a mission", remedy="give the mission YAML's")
    if missing := request.mission.missing_release_keys():
        raise CatalogError(
            f"files of format {named} need keys that the mission YAML lacks: {', '.join(missing)}",
            remedy="put them into mission.yaml, and run again; 'inflight new template' shows them",
        )


def _refuse_without_times(workspace: Path, days: Sequence[Day]) -> None:
    for name, group in groupby(days, key=lambda day: day.dataset):
        if open_store(str(workspace / next(group).segment)).row_dim != "time":
            raise CatalogError(
                f"'{name}' has no samples in time to be a file",
                remedy="release it as zarr, or other datasets",
            )


def _refuse_without_cause(absent: Sequence[Day]) -> None:
    if unexplained := [day for day in absent if not day.cause]:
        listed = ", ".join(f"{day.dataset} {day.day} ({day.state})" for day in unexplained[:5])
        raise CatalogError(
            f"{len(unexplained)} missing days have no recorded cause, among them {listed}",
            remedy="process them again, or record why they are missing",
        )


def _parts(workspace: Path, collection: ReleaseContents, progress: Progress) -> tuple[dict[str, Any], ...]:
    """Return the days, files and bytes of each dataset in each format."""
    parts, measured = [], 0
    for name, group in groupby(collection.days, key=lambda day: day.dataset):
        days = list(group)
        common = {
            "dataset": name,
            "first": str(days[0].day),
            "last": str(days[-1].day),
            "days": len(days),
            "missing": sum(day.dataset == name for day in collection.absent),
        }
        stored = plain = stores = 0
        for segment, members in groupby(days, key=lambda day: day.segment):
            batch = list(members)
            progress("measure", measured, len(collection.days))
            measured += len(batch)
            store, rows = open_store(str(workspace / segment)), sum(day.count for day in batch)
            stored += folder_bytes(workspace / segment) * rows // max(1, sum(store.counts))
            stores += -(-len(batch) // DAYS_PER_STORE)
            plain += rows * sum(
                store.variables[item].decoded_dtype().itemsize * math.prod(store.variables[item].shape[1:])
                for item in store.variables
                if store.in_rows(item)
            )
        for form in collection.request.formats:
            sizes = (
                {"files": len(days), "bytes": plain}
                if form in _WRITERS
                else {"files": stores, "bytes": stored}
            )
            parts.append({**common, "format": form, **sizes})
    progress("measure", measured, measured)
    return tuple(parts)


def _refuse_known_version(session: Session, version: str) -> None:
    if session.scalar(select(ReleaseRow.id).where(ReleaseRow.version == version)) is not None:
        raise CatalogError(
            f"release {version} exists", remedy="a version is never reused: choose the next one"
        )


def _collect(session: Session, request: ReleaseRequest) -> ReleaseContents:
    context, patterns = request.context, request.datasets
    names = dataset_names(session, patterns)
    days: list[Day] = []
    absent: list[Day] = []
    for name in names:
        present = published_days(session, name, _WHOLE, None)
        if context is not None and any(day.context is not None for day in present):
            present = published_days(session, name, _WHOLE, context)
        days += present
        there = {day.day for day in present}
        recorded = [day for day in status_of_days(session, name, _WHOLE, None) if day.day not in there]
        known = {day.day for day in recorded}
        gaps = [
            Day(dataset=name, day=day, state="missing") for day in missing_days(present) if day not in known
        ]
        absent += sorted(recorded + gaps, key=lambda day: day.day)
    if not days:
        raise CatalogError(
            f"nothing is published that matches {' or '.join(patterns)}",
            remedy="first 'inflight ingest' and 'inflight reprocess'; see 'inflight catalog list'",
        )
    last = session.scalar(select(ReleaseRow).order_by(ReleaseRow.id.desc()).limit(1))
    previous = None
    if last is not None:
        # Days of datasets that were not asked for now are not gone.
        before = [
            day for day in released_days(session, last.version, None, _WHOLE) if day.dataset in set(names)
        ]
        previous = PreviousRelease(version=last.version, days=tuple(before))
    pinned = context_record(session, context) if context else None
    pinned_ids = {one[0] for spans in pinned.tables.values() for one in spans} if pinned else set()
    tables = [
        table
        for table in table_records(session, None)
        if table.id in pinned_ids or any(scope in {None, context} for scope, _, _ in table.certified)
    ]
    model = model_text(session, pinned.model_name, pinned.model_version)[2] if pinned else ""
    return ReleaseContents(
        request=request,
        days=tuple(days),
        absent=tuple(absent),
        tables=tuple(tables),
        context=pinned,
        model=model,
        parents={},
        previous=previous,
    )


def _refuse_without_provenance(session: Session, days: Sequence[Day], edges: Sequence[Edge]) -> None:
    """Every day, and every day it was made from, states what it was made from, and that is known."""
    with_parents = {edge.child for edge in edges}
    named = {*(day.id for day in days), *(edge.parent for edge in edges)}
    orphans = sorted(item for item in named if item.startswith("day:") and item not in with_parents)
    unknown = unknown_ids(session, named)
    if orphans or unknown:
        by_id = {day.id: f"{day.dataset} {day.day}" for day in days}
        listed = ", ".join(by_id.get(item, item) for item in [*orphans, *unknown][:5])
        raise CatalogError(
            f"{len(orphans) + len(unknown)} items lack provenance, among them {listed}",
            remedy="make these days again by a run that states their parents",
        )


def _write_release(
    workspace: Path, folder: Path, collection: ReleaseContents, documents: Documents, progress: Progress
) -> None:
    request = collection.request
    folder.mkdir()
    _write_days(workspace, folder, collection, progress)
    for table in tell_each(progress, "tables", collection.tables):
        _copy_table(workspace, folder, table)
    if (folder / "stores").exists():
        for part in (folder / "stores").iterdir():
            part.rename(folder / part.name)
        (folder / "stores").rmdir()
    ordered = sorted((*collection.days, *collection.absent), key=lambda day: (day.dataset, day.day))
    _write_csv(
        folder / "days.csv",
        (
            *("dataset", "day", "version", "coverage", "samples", "state", "cause", "message", "key"),
            *("model", "tables"),
        ),
        (
            (
                *(day.dataset, day.day, day.version, "" if day.coverage is None else f"{day.coverage:.6f}"),
                *(day.count, day.state, day.cause, day.message, day.key),
                collection.models.get(day.context or "", ""),
                " ".join(map(str, sorted(collection.used.get(day.id, ())))),
            )
            for day in ordered
        ),
    )
    _write_csv(
        folder / "tables.csv",
        (
            *("table", "name", "context", "valid_from", "valid_to", "valid_from_tt2000", "valid_to_tt2000"),
            *("key", "approved_by"),
        ),
        (
            (
                *(table.id, table.name, context or "", to_utc(start), to_utc(end), start, end, table.key),
                "; ".join(dict.fromkeys(person for person, _, _ in table.approved)),
            )
            for table in collection.tables
            for context, start, end in table.certified or ((table.context, table.start, table.end),)
        ),
    )
    if collection.context:
        (folder / "mission.yaml").write_text(collection.context.mission_text, "utf-8")
        (folder / "model.yaml").write_text(collection.model, "utf-8")
    (folder / "software.txt").write_text(_software(), "utf-8")
    if request.mission is not None and request.mission.exclusions:
        _write_csv(
            folder / "exclusions.csv",
            ("instrument", "start", "end", "author", "reason"),
            (
                (one.instrument, utc_text(one.start), utc_text(one.end), one.author, one.reason)
                for one in request.mission.exclusions
            ),
        )
    if request.mission is not None and not request.mission.missing_release_keys():
        (folder / "CITATION.cff").write_text(_citation(request.version, request.mission), "utf-8")
    notes = [f"# Release notes, {request.version}", "", request.notes.strip() or "No notes were given."]
    notes += ["", *documents(folder, collection)]
    (folder / "RELEASE_NOTES.md").write_text("\n".join(notes) + "\n", "utf-8")
    (folder / "README.md").write_text(_readme(collection, folder), "utf-8")
    (folder / MARKER).write_text(marker_text(request.version, request.mission, request.maturity), "utf-8")
    write_manifest(folder, progress)
    flush_files(folder, progress)


def _write_days(workspace: Path, folder: Path, collection: ReleaseContents, progress: Progress) -> None:
    """Write all days in every format."""
    request, written = collection.request, 0
    # Days of one segment can share a released store: their variables and units are equal.
    for _, group in groupby(collection.days, key=lambda day: (day.dataset, day.segment)):
        members = list(group)
        for first in range(0, len(members), DAYS_PER_STORE):
            batch = members[first : first + DAYS_PER_STORE]
            progress("write", written, len(collection.days))
            if "zarr" in request.formats:
                _copy_days(workspace, folder, batch, request.maturity)
            for day in batch if request.day_files else ():
                _write_day_files(workspace, folder, day, collection)
            written += len(batch)
    progress("write", written, written)


def _notes_of_absent(folder: Path, collection: ReleaseContents) -> list[str]:
    """Write no documents, and return what the notes say without any."""
    count = len(collection.absent)
    return [f"{count} days are missing; `days.csv` gives the cause of each."] if count else []


def _copy_table(workspace: Path, folder: Path, table: TableRecord) -> None:
    """Write a calibration table as Zarr, and as files that need none."""
    store, stem = open_store(str(workspace / table.segment)), f"{table.name}-{table.id}"
    dataset = store.dataset_of_day(0, list(store.variables), 0, 0)
    write_table(folder, "tables", stem, dataset, portable=True)
    for write, ending in ((write_table_csv, "csv"), (write_table_cdf, "cdf")):
        write(folder / "stores" / "tables" / f"{stem}.{ending}", dataset)


def _maturity_of(dataset: str, maturity: str) -> dict[str, str]:
    """Return what says how far a product is checked; what was delivered is as it is."""
    return {"maturity": maturity} if dataset.startswith("l2/") else {}


def _copy_days(workspace: Path, folder: Path, batch: Sequence[Day], maturity: str) -> None:
    """Write days again without the delta filter, and compare every value with the original."""
    contents = [
        read_one_day(workspace, day, None)
        .drop_vars("time", errors="ignore")
        .assign_attrs(version=day.version, **_maturity_of(day.dataset, maturity))
        for day in batch
    ]
    data = [
        DayData(day.day, dataset, day.key, report=day.report)
        for day, dataset in zip(batch, contents, strict=True)
    ]
    segment = write_segment(folder, "data", batch[0].dataset, data, portable=True)
    store = open_store(str(folder / segment.path))
    for index, (row, dataset) in enumerate(zip(segment.rows, contents, strict=True)):
        copied = store.dataset_of_day(index, list(store.variables), row.start, row.stop)
        if not copied.identical(dataset):
            raise IntegrityError(
                f"released copy of {batch[0].dataset} differs from the original",
                day=str(row.day),
                remedy="run 'inflight catalog verify'",
            )


def _write_day_files(workspace: Path, folder: Path, day: Day, collection: ReleaseContents) -> None:
    """Write one day in every format that has a file a day."""
    request = collection.request
    assert request.mission is not None  # `_refuse_without_keys` has seen to it
    version = file_version(request.version)
    released = {f"{item.dataset} {item.day} {item.version}": item for item in collection.days}
    parents = []
    for parent in collection.parents.get(day.id, ()):
        item = released.get(parent.removeprefix("day>"))
        parents.append(
            f"CDF>{logical_file_id(request.mission, item.dataset, item.day, version, request.maturity)}"
            if item
            else parent
        )
    header = DayHeader(
        mission=request.mission,
        dataset=day.dataset,
        day=day.day,
        version=version,
        day_version=day.version,
        generated=str(max(item.day for item in collection.days)).replace("-", ""),
        parents=tuple(parents),
        maturity=request.maturity,
    )
    dataset = read_one_day(workspace, day, None, dated=False)
    for form in request.day_files:
        target = folder / form / header.source / str(day.day)[:4]
        target.mkdir(parents=True, exist_ok=True)
        write, ending = _WRITERS[form]
        write(target / f"{header.stem}.{ending}", dataset, header)
        fault_point("release_file_written")


@cache
def _software() -> str:
    """Return the packages that made the release, one a line, as a requirements file has them."""
    found = {item.metadata["Name"]: item.version for item in distributions()}
    return "".join(f"{name}=={found[name]}\n" for name in sorted(found, key=str.lower))


def _citation(version: str, mission: Mission) -> str:
    keys = mission.release
    lines = {
        "cff-version": "1.2.0",
        "type": "dataset",
        "message": "If you use these data, cite them as below.",
        "title": mission.description,
        "version": version,
        "abstract": mission.acknowledgement,
        **({"doi": keys.doi} if keys.doi else {}),
        **({"url": keys.link} if keys.link else {}),
    }
    people = ["authors:", *(f"  - name: {json.dumps(name)}" for name in (keys.pi_name, keys.pi_affiliation))]
    # A JSON string is a YAML string.
    return "\n".join([*(f"{key}: {json.dumps(value)}" for key, value in lines.items()), *people]) + "\n"


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(rows)


_FORMAT_NOTES: Final = {
    "zarr": (
        "`data/` holds one Zarr v3 store for up to ten days of one dataset: row `i` of day `k` is row",
        "`k * chunk + i` of every variable with a time; `chunk`, `days` and `counts` stand in the",
        "attribute `inflight` of the store. Packed variables follow the CF convention (`scale_factor`,",
        "`_FillValue`). `tt2000` counts nanoseconds since 2000-01-01T12:00:00 Terrestrial Time; rows",
        "beyond a day's count are fill. In Python `inflight.catalog.Catalog(FOLDER).open(DATASET)` gives all",
        "days as one xarray Dataset; `inflight serve FOLDER` hands them out over HAPI.",
    ),
    "cdf": (
        "`cdf/<source>/<year>/` holds one ISTP CDF file for each day: `Epoch` is TT2000, labels and units",
        "stand with each variable, `Parents` names what a file was made from. In Python: `cdflib.CDF(FILE)`.",
    ),
    "netcdf": (
        "`netcdf/<source>/<year>/` holds one CF NetCDF-4 file for each day: `time` counts UTC seconds of the",
        "day, `tt2000` is exact. In Python: `xarray.open_mfdataset(FILES)`.",
    ),
}


#: What documents of a release hold, by the name of file or folder; listed where they are there.
_DOCUMENTS: Final = {
    "RELEASE_NOTES.md": "data, metadata, interface and known problems, against the release before",
    "changes.csv": "days and variables that changed since the release before, and by how much",
    "changes": "the same, drawn",
    "gaps.csv": "of each day of a product: gaps between samples, values that are missing, flags by kind",
    "missing.csv": "from when to when days, samples or values are missing, with cause or flags",
    "validation": "residual, noise floor, and what is left in the residual",
    "calendar": "a page a year with a thumbnail a day; click for the day",
    "exclusions.csv": "readings that no fit took, by whom and why; their samples are flagged",
    "CITATION.cff": "how to cite these data",
}

_VERSION_RULE: Final = (
    "Versions: the second number counts releases that only add days; the first counts those that change or",
    "take away days which were released before. Who has release 1.4 may add the days of 1.5 to it, but",
    "fetches 2.0 whole.",
)


def _readme(collection: ReleaseContents, folder: Path) -> str:
    lines = [
        f"# Release {collection.request.version}",
        "",
        f"Its products are {collection.request.maturity}.",
        "",
        *(line for form in FORMATS if form in collection.request.formats for line in _FORMAT_NOTES[form]),
        "`tables/` holds the calibration tables, each as Zarr, CSV and CDF; `tables.csv` says when each is",
        "valid (half-open).",
        "`days.csv` lists every day with version, coverage, the model and the tables it was made with and,",
        "where it is missing, why. `tables/NAME-NUMBER.csv` says of each parameter where it came from",
        "(`source`: prior, combination, data).",
        "`software.txt` lists the packages that made the release.",
        *(f"`{name}`: {what}." for name, what in _DOCUMENTS.items() if (folder / name).exists()),
        "Check the files with `sha256sum -c MANIFEST.sha256`.",
        "",
        *_VERSION_RULE,
        "",
        "| dataset | first day | last day | days | missing |",
        "|---|---|---|---|---|",
    ]
    for name, group in groupby(collection.days, key=lambda day: day.dataset):
        days = list(group)
        missing = sum(day.dataset == name for day in collection.absent)
        lines.append(f"| {name} | {days[0].day} | {days[-1].day} | {len(days)} | {missing} |")
    if collection.context:
        context = collection.context
        lines += [
            "",
            f"Model: {context.model_name} version {context.model_version} (`model.yaml`), "
            f"context `{context.id}`.",
        ]
    return "\n".join(lines) + "\n"


def _register(session: Session, collection: ReleaseContents, staged: Path, target: Path) -> Path:
    """Freeze the collection and rename its folder in one transaction, which ends with the rename."""
    created = time_in_order(session, ReleaseRow.created).isoformat(timespec="seconds")
    request = collection.request
    _refuse_known_version(session, request.version)
    row = ReleaseRow(
        version=request.version,
        context=request.context,
        notes=request.notes,
        path=str(target),
        created=created,
        maturity=request.maturity,
    )
    session.add(row)
    session.flush()
    days = (int(day.id.partition(":")[2]) for day in collection.days)
    session.add_all(ReleaseDayRow(release_id=row.id, day_id=day) for day in days)
    session.flush()
    # Renamed already when the database ended the transaction after it, and it is done once more.
    if staged.exists():
        if target.exists():
            # Left by a release that was killed between its rename and its commit; nothing else is removed.
            marker = target / MARKER
            stated = json.loads(marker.read_text("utf-8")) if marker.exists() else {}
            if stated.get("version") != request.version:
                raise CatalogError(
                    "the folder exists and is no release", file=str(target), remedy="move it away"
                )
            shutil.rmtree(target)
        staged.rename(target)
        flush(target.parent)
    fault_point("release_renamed")
    return target
