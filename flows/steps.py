"""The steps of each flow, written once.

`run_without_prefect` calls them, `inflight.flows.prefect_flows` wraps them.
Each takes a workspace and the parameters that the command line and a deployment name, and returns the fields
of a `RunReport` (of `diagnose`: with those of a `Diagnosis`) as JSON has them. How batches run is decided by
the runner (`inflight.flows.runner`). What several steps take means the same in all of them:

workspace : Path
    Folder of the mission.
start, end : date or None
    UTC days, half-open; None is all there is on that side: of the deliveries for `ingest`, of the archive for
    the others.
data : Path or None
    Folder of the delivered files; ``data`` in the workspace when None.
settings : ReprocessSettings or DiagnoseSettings
    How it is done.
workers : int or None
    Dask processes; the cores when None.
reason : str
    Why; kept with the runs in the catalog.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from inflight.catalog import Catalog, Workspace
from inflight.errors import InflightError
from inflight.flows.cluster import lazy_client
from inflight.flows.runner import runner
from inflight.flows.span import DateOrNone, DaySpan, month_span
from inflight.tasks import ReprocessSettings, RunReport, error_fields, problem, problem_of
from inflight.tasks.analysis import DiagnoseSettings

if TYPE_CHECKING:
    from distributed import Client

DEFAULT_SETTINGS = ReprocessSettings()
#: Each day's own parameters with the month's offset along the spin axis.
MONTHLY_SETTINGS = ReprocessSettings(table="daily")
DIAGNOSE_SETTINGS = DiagnoseSettings()
#: Of the processes of a backfill, unless it is asked for otherwise, as ``nice`` counts it.
BACKFILL_NICENESS = 10


def ingest(
    workspace: Path,
    data: Path | None = None,
    instruments: list[str] | None = None,
    start: DateOrNone = None,
    end: DateOrNone = None,
    workers: int | None = None,
    files: list[str] | None = None,
) -> dict[str, Any]:
    """Take delivered files into the archive; files already taken in cost nothing.

    Parameters
    ----------
    instruments : list of str, optional
        Only these; the other parameters are those of the module.
    files : list of str, optional
        Only these, by their paths below the folder.
    """
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with lazy_client(workers) as client:
        return _ingest_span(place, data, instruments, span, client, files).as_json()


def reprocess(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    workers: int | None = None,
    reason: str = "",
) -> dict[str, Any]:
    """Calibrate and write level-2 products of a span; days whose inputs did not change are left alone."""
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with lazy_client(workers) as client:
        return _reprocess_span(place, span, settings, client, reason).as_json()


def backfill(
    workspace: Path,
    start: dt.date,
    end: dt.date,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
    reason: str = "",
    niceness: Annotated[int, Field(ge=0, le=19)] = BACKFILL_NICENESS,
) -> dict[str, Any]:
    """Take in what was delivered late for a span, then reprocess the days whose inputs changed.

    The days of the result are those of the products; ``ingest`` in it reports what was taken in.

    Parameters
    ----------
    niceness : int
        How far its processes stand behind others of this machine: live days go before a backfill.
    """
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with lazy_client(workers, niceness) as client:
        report = _ingest_and_reprocess("backfill", place, (span, span), settings, data, client, reason)
    return report.as_json()


def monthly(
    workspace: Path,
    month: str | None = None,
    settings: ReprocessSettings = MONTHLY_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
) -> dict[str, Any]:
    """Close a calendar month; days whose inputs and offsets did not change are left alone.

    Parameters
    ----------
    month : str, optional
        ``YYYY-MM``; the last one that is over when absent.
    settings : ReprocessSettings
        What is not stated is as of `MONTHLY_SETTINGS`; the result is that of `backfill`.
    """
    span = month_span(month, dt.datetime.now(dt.UTC).date())
    stated = MONTHLY_SETTINGS.model_copy(update=settings.model_dump(exclude_unset=True))
    place, spans = Workspace.open(workspace), (span.with_neighbours(), span)
    with lazy_client(workers) as client:
        return _ingest_and_reprocess("monthly", place, spans, stated, data, client).as_json()


def diagnose(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: DiagnoseSettings = DIAGNOSE_SETTINGS,
    save: bool = False,
    search: bool = False,
    page: bool = True,
    workers: int | None = None,
) -> dict[str, Any]:
    """Find which effect is missing from the model; days that were read before cost nothing.

    Parameters
    ----------
    save : bool
        Save a version of the model for every effect that was found.
    search : bool
        Search though the last verdict may stand for the days since.
    page : bool
        Write the page of what a search found, too; that takes about a tenth of the search's time.
    """
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    with lazy_client(workers) as client:
        return _diagnose_span(place, span, settings, client, save=save, search=search, page=page)


def update(
    workspace: Path,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
    reason: str = "",
) -> dict[str, Any]:
    """Bring a mission up to date: take in what was delivered, reprocess what it changed, renew the verdict.

    The days of the result are those of the products; ``ingest`` in it reports what was taken in, and
    ``diagnosis`` is that of all days with the present model. A comparison that has no residual to search gets
    none, and where there is none for another reason, a problem says why.
    """
    place, every_day = Workspace.open(workspace), DaySpan()
    with lazy_client(workers) as client:
        spans = every_day, every_day
        report = _ingest_and_reprocess("update", place, spans, settings, data, client, reason)
        return _with_diagnosis(report, place, settings, client).as_json()


def release(
    workspace: Path,
    version: str,
    notes: str = "",
    destination: Path | None = None,
    formats: tuple[str, ...] = ("zarr",),
    maturity: Literal["quick-look", "preliminary", "definitive"] = "preliminary",
) -> dict[str, Any]:
    """Freeze the published collection under a version and copy it out with manifest and notes.

    Parameters
    ----------
    version : str
        Never used before in this workspace.
    notes : str
        Text for the release notes.
    destination : Path, optional
        Folder the release goes to; ``releases`` in the workspace when absent.
    formats : tuple of str
        ``zarr``, ``cdf`` and ``netcdf``.
    maturity : str
        Of the products; a definitive release takes approved tables only.
    """
    from inflight.tasks import make_release

    place = Workspace.open(workspace)
    report: RunReport = runner().run(
        "copy out", make_release, place, version, notes, destination, formats, maturity, runner().progress
    )
    return report.as_json()


#: What can be run by name, plainly or as a Prefect flow.
STEPS: dict[str, Callable[..., dict[str, Any]]] = {
    step.__name__: step for step in (ingest, reprocess, backfill, monthly, diagnose, update, release)
}


def report_if_idle(name: str, parameters: Mapping[str, Any]) -> RunReport | None:
    """Return the report of a step that has nothing to do; None when there is work, or only a run can tell.

    Parameters
    ----------
    name : str
        Of `STEPS`.
    parameters : mapping
        Of the step.

    Raises
    ------
    InflightError
        What the step itself would raise before it begins to work.
    """
    from pydantic import validate_call

    check = _IDLE_CHECKS.get(name)
    return None if check is None else validate_call(check)(**parameters)


def _ingest_if_idle(
    workspace: Path,
    data: Path | None = None,
    instruments: list[str] | None = None,
    start: DateOrNone = None,
    end: DateOrNone = None,
    workers: int | None = None,
    files: list[str] | None = None,
) -> RunReport | None:
    from inflight.tasks.archive import ingest_if_unchanged

    del workers
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    return ingest_if_unchanged(
        Catalog(place.root), place.mission(), data or place.data, instruments, *span.as_text(), files=files
    )


def _reprocess_if_idle(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    workers: int | None = None,
    reason: str = "",
) -> RunReport | None:
    from inflight.tasks.pipelines import reprocess_if_unchanged

    del workers, reason
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    return reprocess_if_unchanged(Catalog(place.root), place.mission(), *span.as_text(), settings=settings)


def _backfill_if_idle(
    workspace: Path,
    start: dt.date,
    end: dt.date,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
    reason: str = "",
    niceness: int = BACKFILL_NICENESS,
) -> RunReport | None:
    del reason, niceness, workers
    return _ingest_and_reprocess_if_idle("backfill", workspace, DaySpan(start=start, end=end), settings, data)


def _ingest_and_reprocess_if_idle(
    command: str, workspace: Path, span: DaySpan, settings: ReprocessSettings, data: Path | None
) -> RunReport | None:
    ingested = _ingest_if_idle(workspace, data, None, span.start, span.end)
    report = ingested and _reprocess_if_idle(workspace, span.start, span.end, settings)
    return ingested.followed_by(report, command) if ingested and report else None


def _diagnose_if_idle(
    workspace: Path,
    start: DateOrNone = None,
    end: DateOrNone = None,
    settings: DiagnoseSettings = DIAGNOSE_SETTINGS,
    save: bool = False,
    search: bool = False,
    page: bool = True,
    workers: int | None = None,
) -> RunReport | None:
    """Return the last diagnosis while nothing has changed; raise what a span without days would."""
    from inflight.tasks import current_model
    from inflight.tasks.analysis import diagnose_if_unchanged
    from inflight.tasks.archive import ArchiveIndex, needs_of, require_days

    del page, workers
    place, span = Workspace.open(workspace), DaySpan(start=start, end=end)
    cat, mission = Catalog(place.root), place.mission()
    needs = needs_of(mission, current_model(cat, mission, settings.comparison).model)
    require_days(ArchiveIndex.of(cat, needs), needs, *span.as_text())
    found = None if save or search else diagnose_if_unchanged(place, *span.as_text(), settings)
    return None if found is None else RunReport.from_json(found)


def _update_if_idle(
    workspace: Path,
    settings: ReprocessSettings = DEFAULT_SETTINGS,
    data: Path | None = None,
    workers: int | None = None,
    reason: str = "",
) -> RunReport | None:
    del reason, workers
    report = _ingest_and_reprocess_if_idle("update", workspace, DaySpan(), settings, data)
    place = Workspace.open(workspace)
    if report is None or not _is_searched(place, settings):
        return report
    from inflight.tasks.analysis import diagnose_if_unchanged

    found = diagnose_if_unchanged(place, None, None, _to_diagnose(settings))
    return None if found is None else replace(report, extra={**report.extra, "diagnosis": found})


#: What tells that a step has nothing to do, by its name and with its parameters.
_IDLE_CHECKS: dict[str, Callable[..., RunReport | None]] = {
    "ingest": _ingest_if_idle,
    "reprocess": _reprocess_if_idle,
    "backfill": _backfill_if_idle,
    "diagnose": _diagnose_if_idle,
    "update": _update_if_idle,
}


def _ingest_span(
    place: Workspace,
    data: Path | None,
    instruments: list[str] | None,
    span: DaySpan,
    client: Client,
    files: list[str] | None = None,
    reason: str = "",
) -> RunReport:
    """Index, read and write; the batches of days run on the client."""
    from inflight.tasks import ingest as ingest_files

    def take_in(client: Client) -> RunReport:
        return ingest_files(
            Catalog(place.root, reason=reason),
            place.mission(),
            data or place.data,
            instruments,
            *span.as_text(),
            client=client,
            progress=runner().progress,
            files=files,
        )

    return runner().run("take in", take_in, client)


def _reprocess_span(
    place: Workspace, span: DaySpan, settings: ReprocessSettings, client: Client, reason: str = ""
) -> RunReport:
    from inflight.tasks import reprocess as reprocess_days

    mapper = runner().mapper(client)
    cat = Catalog(place.root, reason=reason)
    return reprocess_days(
        cat,
        place.mission(),
        *span.as_text(),
        settings=settings,
        client=client,
        mapper=mapper,
        progress=runner().progress,
    )


def _ingest_and_reprocess(
    command: str,
    place: Workspace,
    spans: tuple[DaySpan, DaySpan],
    settings: ReprocessSettings,
    data: Path | None,
    client: Client,
    reason: str = "",
) -> RunReport:
    """Take in the first span and reprocess the second one; `command` names the report."""
    delivered, reprocessed = spans
    ingested = _ingest_span(place, data, None, delivered, client, reason=reason)
    report = _reprocess_span(place, reprocessed, settings, client, reason)
    return ingested.followed_by(report, command)


def _diagnose_span(
    place: Workspace,
    span: DaySpan,
    settings: DiagnoseSettings,
    client: Client,
    *,
    save: bool = False,
    search: bool = False,
    page: bool,
) -> dict[str, Any]:
    from inflight.tasks.analysis import Examined, diagnose_span

    progress, searched = runner().progress, list[tuple[Examined, Mapping[str, Any]]]()

    def keep(examined: Examined, asked: Mapping[str, Any]) -> None:
        searched.append((examined, asked))

    def find(client: Client) -> dict[str, Any]:
        how: Any = {"save": save, "search": search, "client": client, "progress": progress}
        return diagnose_span(place, *span.as_text(), settings, finished=keep if page else None, **how)

    def draw() -> None:
        # Figures take a third of a second to import: who writes no page need not wait.
        from inflight.tasks.analysis import page_of_diagnosis, write_report

        output = page_of_diagnosis(place, settings.comparison, *span.as_text())
        write_report(place, output, *searched[-1], progress)

    found = runner().run("search", find, client)
    if searched:
        # The verdict is kept, and told whatever becomes of its page.
        try:
            runner().run("page", draw)
        except Exception as error:
            found["problems"] = [_page_problem(error)]
    return found


def _page_problem(error: Exception) -> dict[str, str]:
    told = dict(error_fields(error))
    if isinstance(error, OSError):
        told |= {"message": str(error), "remedy": "make room in reports, then run inflight report"}
    message = f"the page of the diagnosis was not written: {told['message']}"
    return problem("partial", message, remedy=told["remedy"])


def _with_diagnosis(
    report: RunReport, place: Workspace, settings: ReprocessSettings, client: Client
) -> RunReport:
    """Return a report with the diagnosis of all days, or with the problem that there is none."""
    from inflight.tasks.analysis import diagnose_if_unchanged

    if not _is_searched(place, settings):
        return report
    asked = _to_diagnose(settings)
    try:
        found = diagnose_if_unchanged(place, None, None, asked)
        found = found or _diagnose_span(place, DaySpan(), asked, client, page=False)
    except InflightError as error:
        return replace(report, problems=[*report.problems, problem_of(error)])
    return replace(report, extra={**report.extra, "diagnosis": found})


def _is_searched(place: Workspace, settings: ReprocessSettings) -> bool:
    """Return whether the comparison that products are made with has a residual to search."""
    from inflight.tasks.analysis import sampled_comparisons

    return settings.comparison in sampled_comparisons(place.mission())


def _to_diagnose(settings: ReprocessSettings) -> DiagnoseSettings:
    return DiagnoseSettings(comparison=settings.comparison)
