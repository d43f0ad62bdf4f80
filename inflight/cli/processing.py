"""Verbs that move measurements on: ``ingest``, ``reprocess``, ``update`` and ``backfill``.

Each runs its Prefect flow, on the embedded server or on the one ``PREFECT_API_URL`` names, and with
``--no-prefect`` the same plain functions on the same Dask processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from inflight.cli.command import Command
from inflight.cli.diagnosis_text import print_diagnosis
from inflight.errors import CatalogError, SettingsError

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.mission import Mission
    from inflight.tasks import RunReport

StartOption = Annotated[
    str | None, typer.Option(help="First day, YYYY-MM-DD (default: all)", show_default=False)
]
EndOption = Annotated[
    str | None, typer.Option(help="Day after the last one, YYYY-MM-DD (default: all)", show_default=False)
]
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Dask processes (default: the cores)", show_default=False)
]
NoPrefectOption = Annotated[
    bool, typer.Option("--no-prefect", help="Run the plain functions, without a flow.")
]
TableOption = Annotated[
    Literal["daily", "window", "monthly", "span", "continuous"] | None,
    typer.Option(
        help="Table the products take; continuous fits everything to all days at once (default: window)",
        show_default=False,
    ),
]
TrendOption = Annotated[
    Literal["auto", "constant", "linear", "parabola", "log", "spline"] | None,
    typer.Option(help="Trend of the scale factors of --table continuous (default: auto)", show_default=False),
]
OriginOption = Annotated[
    str | None,
    typer.Option(help="Origin of a logarithmic trend, YYYY-MM-DD (default: fitted)", show_default=False),
]
WindowOption = Annotated[
    int | None, typer.Option(min=1, help="Days of a window (default: 15)", show_default=False)
]
CoverageOption = Annotated[
    float | None,
    typer.Option(min=0, max=1, help="Part of a day that must be usable (default: 0)", show_default=False),
]
ComparisonOption = Annotated[str, typer.Option(help="What is compared with what.")]
DetailsOption = Annotated[bool, typer.Option("--details", help="List everything that was found.")]
ReasonOption = Annotated[str, typer.Option(help="Why; kept with the runs: see 'catalog runs'.")]
BatchOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Days a batch; bounds the memory (default: 5 to 15, by length and cadence)",
        show_default=False,
    ),
]


#: What follows ingest, and what follows reprocess.
_NEXT_INGEST = "next: inflight reprocess"
_NEXT_REPROCESS = "next: inflight compare    (how well the products agree with the reference)"


def run_flow(
    command: Command, name: str, parameters: Mapping[str, Any], *, workers: int | None, prefect: bool
) -> RunReport:
    """Run a flow, or its plain function, with a progress bar a stage.

    Parameters
    ----------
    command : Command
        The command.
    name : str
        ``ingest``, ``reprocess``, ``update``, ``backfill``, ``diagnose`` or ``release``.
    parameters : mapping
        Of the flow, the workspace excepted.
    workers : int or None
        Dask processes.
    prefect : bool
        False runs the plain function.
    """
    workspace = command.open_workspace()  # a wrong folder is told before anything else is imported
    from inflight.flows import run_with_prefect, run_without_prefect

    run: Callable[..., RunReport] = run_with_prefect if prefect else run_without_prefect
    with command.progress() as progress:
        return run(name, workspace, parameters, workers=workers, progress=progress)


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that were given; the flow knows the defaults of the others."""
    return {name: value for name, value in options.items() if value is not None}


def ingest(
    command: Command,
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folder of delivered files, or the files (default: data in the workspace)",
            show_default=False,
        ),
    ] = None,
    *,
    data: Annotated[Path | None, typer.Option(help="The same, as an option.")] = None,
    instrument: Annotated[
        list[str] | None, typer.Option(help="Only this instrument; may be repeated.")
    ] = None,
    start: StartOption = None,
    end: EndOption = None,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Take delivered files into the archive; files already taken in cost nothing."""
    named = [*(paths or []), *([data] if data else [])]
    if absent := [path for path in named if not path.exists()]:
        raise SettingsError(
            f"there is neither a folder nor a file {absent[0]}",
            remedy="name the folder of the delivered files, or the files, or none for the workspace's own",
        )
    workspace = command.open_workspace()
    mission = workspace.mission()
    folder, files = _delivery(mission, named) if named else (workspace.data, None)
    given = {"data": folder if named else None, "instruments": instrument, "start": start, "end": end}
    report = run_flow(
        command, "ingest", _given(**given, files=files), workers=workers, prefect=not no_prefect
    )
    remarks = []
    for name, dataset in report.extra.get("datasets", {}).items():
        missing = {f"l1/{item['instrument']}" for item in report.problems if item.get("instrument")}
        if not dataset["days"] and name not in missing and files is None:
            patterns = " or ".join(map(repr, mission.files(name.removeprefix("l1/")).pattern or ()))
            remarks.append(f"{name}: no file of the span below {folder} matches {patterns}")
        if dataset["dropped"]:
            rows = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in dataset["dropped"].items())
            remarks.append(f"{name}: rows dropped: {rows}")
        remarks += [f"{name}: {note}" for note in dataset["notes"]]
    remarks += [_NEXT_INGEST] if report.days["done"] + report.days["unchanged"] else []
    command.finish(report, remarks, details)


def _delivery(mission: Mission, named: Sequence[Path]) -> tuple[Path, list[str] | None]:
    """Return the folder that patterns start from, and the files below it that were named; None is all."""
    from inflight.catalog.readers import folder_of_delivery

    if len(named) == 1 and named[0].is_dir():
        return named[0], None
    if folders := [path for path in named if path.is_dir()]:
        raise SettingsError(
            f"{folders[0]} is a folder, beside {len(named) - 1} others: one folder is ingested at a time",
            remedy="run the command once for each folder, or name files only",
        )
    places: dict[Path, Path] = {}
    for path in (one.resolve() for one in named):
        every = (folder_of_delivery(path, mission.files(name)) for name in mission.instruments)
        found = next((folder for folder in every if folder is not None), None)
        if found is None:
            patterns = [text for name in mission.instruments for text in mission.files(name).pattern or ()]
            raise SettingsError(
                f"{path}: no instrument's file pattern matches this file",
                remedy=f"the mission's patterns are {', '.join(patterns)}",
            )
        places[path] = found
    if len(set(places.values())) > 1:
        raise SettingsError(
            "the files lie in different folders: " + ", ".join(map(str, sorted(set(places.values())))),
            remedy="run the command once for each folder",
        )
    folder = next(iter(places.values()))
    return folder, [path.relative_to(folder).as_posix() for path in places]


def reprocess(
    command: Command,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = "main",
    table: TableOption = None,
    window_days: WindowOption = None,
    min_coverage: CoverageOption = None,
    batch_days: BatchOption = None,
    trend: TrendOption = None,
    origin: OriginOption = None,
    distribute: Annotated[
        bool,
        typer.Option(
            "--distribute",
            help="With --table continuous, take the slow part of the residual out of the field, which hides "
            "what the model does not know.",
        ),
    ] = False,
    use_table: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[:NUMBER]",
            help="Fit nothing: take this table of the catalog, such as main-span:12, as it is",
            show_default=False,
        ),
    ] = None,
    named_context: Annotated[
        str | None,
        typer.Option(
            "--context",
            metavar="NAME",
            help="Fit nothing: take mission file, model and tables of a named context ('catalog context')",
            show_default=False,
        ),
    ] = None,
    as_of: Annotated[
        str | None,
        typer.Option(
            metavar="VERSION",
            help="Make an old version again with its own model and tables, and compare it: a release (1.0), "
            "model:2 or v01.03; nothing is published",
            show_default=False,
        ),
    ] = None,
    destination: Annotated[
        Path | None,
        typer.Option(help="Folder for what --as-of makes (default: as-of/VERSION)", show_default=False),
    ] = None,
    reason: ReasonOption = "",
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Calibrate and write level-2 products of a span; days whose inputs did not change are left alone."""
    place = command.open_workspace()
    if as_of is not None:
        chosen = (
            table,
            window_days,
            min_coverage,
            batch_days,
            trend,
            origin,
            distribute or None,
            use_table,
            named_context,
        )
        if any(option is not None for option in chosen):
            raise SettingsError(
                f"--as-of {as_of} takes model, table and settings of that version",
                remedy="leave out all other options but --start, --end, --destination and --workers",
            )
        _remake(command, as_of, (start, end), destination, workers, details)
        return
    settings = _given(
        comparison=comparison,
        table=table,
        window_days=window_days,
        min_coverage=min_coverage,
        batch_days=batch_days,
        trend=trend,
        origin=origin,
        distribute=distribute or None,
        use_table=use_table,
        context=named_context,
    )
    parameters = _given(start=start, end=end, settings=settings, reason=reason or None)
    report = run_flow(command, "reprocess", parameters, workers=workers, prefect=not no_prefect)
    there = report.days["done"] + report.days["unchanged"]
    told = _remarks(command, place.mission(), settings, report)
    command.finish(report, [*told, *([_NEXT_REPROCESS] if there else [])], details)


def _remarks(
    command: Command, mission: Mission, settings: Mapping[str, Any], report: RunReport
) -> Sequence[str]:
    """Return what a person is told of the products that were made, such as what is left in them."""
    from inflight.tasks.pipelines import ReprocessSettings, pipeline_of, settings_of_context

    checked = ReprocessSettings.model_validate(settings)
    mission, checked = settings_of_context(command.open_catalog(), mission, checked)
    return list(pipeline_of(mission, checked.comparison, checked).remarks(report.extra))


def update(
    command: Command,
    *,
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of delivered files (default: data in the workspace)", show_default=False),
    ] = None,
    comparison: ComparisonOption = "main",
    reason: ReasonOption = "",
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Take in new files, reprocess the days they change, and renew the verdict: one run for all three."""
    settings = {"comparison": comparison}
    given = _given(data=data, settings=settings, reason=reason or None)
    report = run_flow(command, "update", given, workers=workers, prefect=not no_prefect)
    found = report.extra.get("diagnosis")

    def show_verdict(console: Console) -> None:
        if found is not None:
            print_diagnosis(console, found, details)

    told = _remarks(command, command.open_workspace().mission(), settings, report)
    command.finish(report, told, details, show_verdict)


def _remake(
    command: Command,
    version: str,
    span: tuple[str | None, str | None],
    destination: Path | None,
    workers: int | None,
    details: bool,
) -> None:
    """Make an old version again, and tell whether its bytes are equal."""
    from inflight.flows import lazy_client
    from inflight.tasks import batch_mapper
    from inflight.tasks.pipelines import remake_version

    catalog = command.open_catalog()
    folder = destination or catalog.workspace / "as-of" / version.replace(":", "-")
    with command.progress() as progress, lazy_client(workers) as client:
        report = remake_version(catalog, version, span, folder, batch_mapper(client, progress))
    stores = report.extra["stores"]
    equal = sum(one["equal"] for one in stores)
    command.finish(report, [f"{equal} of {len(stores)} stores have equal bytes"], details)


def backfill(
    command: Command,
    *,
    start: Annotated[str, typer.Option(help="First day, YYYY-MM-DD.")],
    end: Annotated[str, typer.Option(help="Day after the last one, YYYY-MM-DD.")],
    comparison: ComparisonOption = "main",
    batch_days: BatchOption = None,
    reason: ReasonOption = "",
    niceness: Annotated[
        int | None,
        typer.Option(min=0, max=19, help="How far it stands behind other work (default: 10)"),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print the plan, and what it would cost.")
    ] = False,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Take in and reprocess a past span: planned first, then only what is needed."""
    workspace = command.open_workspace()
    from inflight.flows import plan_lines, plan_span

    settings = _given(comparison=comparison, batch_days=batch_days)
    try:
        fields = plan_span(workspace, start, end, settings)
    except CatalogError:
        if dry_run:
            raise
        fields = None  # what is to be taken in may be all there is of the span

    def show_plan(console: Console) -> None:
        for line in plan_lines("backfill", start, end, fields) if fields else ():
            console.print(line, soft_wrap=True, markup=False)

    if not dry_run:
        if not command.json:
            show_plan(command.console)
        parameters = {
            "start": start,
            "end": end,
            "settings": settings,
            **_given(reason=reason or None, niceness=niceness),
        }
        report = run_flow(command, "backfill", parameters, workers=workers, prefect=not no_prefect)
        there = report.days["done"] + report.days["unchanged"]
        report = replace(report, extra={**report.extra, "plan": fields})
        command.finish(report, [_NEXT_REPROCESS] if there else [], details)
        return
    assert fields is not None

    def show(console: Console) -> None:
        show_plan(console)
        for first, last, count in fields["batches"]:
            console.print(f"  {first} to {last}  ({count} days)")

    command.emit({"command": "backfill", "dry_run": True, **fields}, show)
