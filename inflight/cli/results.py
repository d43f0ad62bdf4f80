"""Verbs that show and hand out results: ``compare``, ``chain``, ``explore``, ``release``, ``serve`` ..."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from inflight.cli.command import Command
from inflight.cli.diagnosis_text import made_from_text, only_moves_with
from inflight.cli.processing import (
    ComparisonOption,
    EndOption,
    NoPrefectOption,
    StartOption,
    WorkersOption,
    run_flow,
)
from inflight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.mission import Mission
    from inflight.tasks.pipelines import Report


def compare(
    command: Command,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = "main",
    against: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="VERSION",
            help="Version of the model to set beside the present one (default: the one before)",
            show_default=False,
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Where the page goes (default: reports/)")] = None,
    show: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Tell how well the calibrated instrument agrees with its reference, before and after."""
    workspace = command.open_workspace()
    report = compare_span(
        command, workspace, start=start, end=end, comparison=comparison, output=output, against=against
    )
    fields = report.as_json()
    command.emit(fields, lambda console: print_comparison(console, report, workspace))
    if show and fields["path"]:
        import webbrowser

        webbrowser.open(Path(fields["path"]).resolve().as_uri())


def compare_span(
    command: Command,
    workspace: Workspace,
    *,
    start: str | None = None,
    end: str | None = None,
    comparison: str = "main",
    output: Path | None = None,
    against: int | None = None,
) -> Report:
    """Compare and write the page, into the workspace's reports unless `output` is given.

    While nothing has changed since the last comparison, that one is given back. A workspace that can only be
    read gets no page unless `output` names a place for it.

    Raises
    ------
    StorageError
        When the page cannot be written to `output`.
    """
    from inflight.flows import DaySpan
    from inflight.tasks.analysis import compare_if_unchanged

    mission = workspace.mission()
    _require_comparison(mission, comparison)
    span = DaySpan.model_validate({"start": start, "end": end}).as_text()
    name = "-".join(["compare", comparison, *filter(None, span)])
    try:
        page: Path | None = _page_path(output or workspace.reports / name)
    except StorageError:
        if output:
            raise
        page = None
    catalog = command.open_catalog()
    if unchanged := compare_if_unchanged(catalog, mission, *span, comparison, page, against):
        return unchanged
    from inflight.flows import lazy_client
    from inflight.tasks.analysis import compare as measure

    with command.progress() as progress, lazy_client() as client:
        return measure(
            catalog,
            mission,
            *span,
            comparison=comparison,
            output=page,
            progress=progress,
            client=client,
            against=against,
        )


def _page_path(path: Path) -> Path:
    """Return the path of a page, whose folder is made when it is not there."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(f"{path.parent} cannot be written")
    except OSError as error:
        raise StorageError(
            f"there is no place for the page: {error}", file=str(path), remedy="name another with --output"
        ) from error
    return path if path.suffix == ".html" else path.with_name(f"{path.name}.html")


def _require_comparison(mission: Mission, comparison: str) -> None:
    """Raise SettingsError unless the mission has a comparison of this name."""
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}",
            remedy=f"choose one of {', '.join(mission.comparisons)}",
        )


def _print_summary(console: Console, report: Report) -> None:
    """Print what a person reads of a report."""
    for line in report.summary():
        console.print(line.text, style=line.style or None, soft_wrap=True, markup=False)


def print_comparison(console: Console, report: Report, workspace: Workspace | None = None) -> None:
    """Print how well products agree before and after, where they still fail, the page, and the next step."""
    _print_summary(console, report)
    page = report.path or "none, because the workspace cannot be written; --output names another place"
    console.print(f"  page: {page}", soft_wrap=True)
    if workspace is not None:
        for text in _next_after_compare(workspace, report.as_json()):
            console.print(text, soft_wrap=True, markup=False)


def _next_after_compare(workspace: Workspace, fields: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the last diagnosis found, as far as it is of the same model, and what to type next.

    Products of a model that is no more in use are told as that, before anything is made of them.
    """
    from inflight.catalog import Catalog
    from inflight.diagnosis import SCALE_DRIFT
    from inflight.tasks import ModelHistory
    from inflight.tasks.analysis import last_diagnosis
    from inflight.tasks.pipelines import trend_of_products

    version = fields.get("model_version")
    if fields.get("kind") == "dual":
        yield "next: inflight diagnose    (the channel behind each unit), or inflight release VERSION"
        return
    if fields["command"] != "compare" or not version:
        return
    history = ModelHistory(Catalog(workspace.root), workspace.mission(), fields["comparison"])
    if not history.same(version, history.used.version):
        yield (
            f"these products are of model version {version}; in use is version {history.used.version}. "
            "next: inflight reprocess, then inflight compare"
        )
        return
    found = last_diagnosis(workspace, fields["comparison"])
    last = (found or {}).get("model", {}).get("version")
    if found is not None and history.same(last, version):
        yield f"the diagnosis of model version {last}: {found['headline']}"
        names = [one["coordinate"] for one in fields["fails_where"]]
        if not fields["at_noise_floor"] and (why := only_moves_with(found, names)):
            yield f"  {why}"
        trend = trend_of_products(Catalog(workspace.root), fields["comparison"], version)
        entries = [
            one for one in found["entries"] if one["command"] and not (trend and one["name"] == SCALE_DRIFT)
        ]
        if entries and fields["at_noise_floor"]:
            size, what = entries[0]["takes_off_nT"], entries[0]["command"]
            yield f"next: inflight release VERSION    (or, for the last {size:.2g} nT: {what})"
            return
        if entries:
            yield f"next: {entries[0]['command']}"
            return
        if fields["at_noise_floor"]:
            yield "next: inflight release VERSION"
            return
    if fields["at_noise_floor"]:
        yield "next: inflight release VERSION, or inflight diagnose for effects below a tenth of the noise"
    else:
        older = f" (the last one is of model version {last})" if last else ""
        yield f"next: inflight diagnose    (which effect makes this, and how sure that is){older}"


def release(
    command: Command,
    version: Annotated[str, typer.Argument(help="Version of the release, such as 1.0; never used twice.")],
    *,
    notes: Annotated[str, typer.Option(help="Text for the release notes.")] = "",
    destination: Annotated[Path | None, typer.Option(help="Folder (default: releases/)")] = None,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="zarr|cdf|netcdf",
            help="What it is written as; may be repeated (default: zarr)",
            show_default=False,
        ),
    ] = None,
    maturity: Annotated[
        Literal["quick-look", "preliminary", "definitive"],
        typer.Option(help="Of its products; definitive needs approved tables: 'inflight catalog approve'"),
    ] = "preliminary",
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only tell what would go in and what stands against it.")
    ] = False,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Freeze what is published and copy it out with manifest and notes."""
    chosen = tuple(dict.fromkeys(formats or ("zarr",)))
    workspace = command.open_workspace()
    if dry_run:
        from inflight.tasks import plan_release

        with command.progress() as progress:
            plan = plan_release(workspace, version, chosen, maturity, progress)
        command.emit(plan, lambda console: _print_plan(console, plan))
        if plan["objections"]:
            raise typer.Exit(1)
        return
    # What can be refused is, before any server starts.
    mission = workspace.mission()
    with command.progress() as progress:
        plan_of = command.open_catalog().plan_release
        found = plan_of(version, formats=chosen, mission=mission, maturity=maturity, progress=progress)
    if found.objections:
        raise found.objections[0]
    parameters = {"version": version, "notes": notes, "destination": destination, "formats": chosen}
    parameters["maturity"] = maturity
    report = run_flow(command, "release", parameters, workers=None, prefect=not no_prefect)
    command.finish(report, ["next: read the notes in this folder, and hand it out as it is"])


def _print_plan(console: Console, plan: Mapping[str, Any]) -> None:
    from rich.table import Table

    heads = ("dataset", "first day", "last day", "days", "missing", "format", "files", "MB")
    table = Table(*heads, box=None, pad_edge=False)
    for part in plan["parts"]:
        cells = [part[key] for key in ("dataset", "first", "last", "days", "missing", "format", "files")]
        table.add_row(*map(str, cells), f"{part['bytes'] / 1e6:.1f}")
    console.print(table)
    console.print(
        f"{plan['tables']} calibration tables; MB of cdf and netcdf are before compression", soft_wrap=True
    )
    if plan["previous"]:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(plan["changes"].items()))
        rule = f"; by the rule of versions the next one is {plan['next_version']}" * bool(
            plan["next_version"]
        )
        console.print(
            f"days against release {plan['previous']}: {counts or 'all the same'}{rule}", soft_wrap=True
        )
    for item in plan["objections"]:
        console.print(f"stands against it: {item['message']}; {item['remedy']}", soft_wrap=True, markup=False)
    if not plan["objections"]:
        console.print(f"nothing stands against release {plan['version']}")


def serve(
    command: Command,
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DIR]", help="Folder of a release (default: the workspace)", show_default=False
        ),
    ] = None,
    *,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 is all of them.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8080,
) -> None:
    """Serve released products to clients of HAPI (hapiclient, SPEDAS, Autoplot), read-only, until Ctrl-C."""
    from inflight.serve import Collection, Server

    source = folder or command.workspace
    collection = Collection.open(source)
    server = Server(collection, host, port)
    ids = [served.id for served in collection.datasets()]

    def ready(url: str) -> None:
        def show(console: Console) -> None:
            for line in (f"{url}  (Ctrl-C ends it)", *(f"  {id}" for id in ids)):
                console.print(line, soft_wrap=True, markup=False)

        command.emit({"command": "serve", "url": url, "source": str(source), "datasets": ids}, show)

    server.run(ready)


def chain(
    command: Command,
    *,
    comparison: ComparisonOption = "main",
    html: Annotated[
        Path | None, typer.Option("--html", help="Write the page with every figure here.", show_default=False)
    ] = None,
    cross_talk: Annotated[
        str,
        typer.Option(
            "--cross-talk",
            metavar="PARAMETER",
            help="Tell what this one does to all others when it is ignored.",
            show_default=False,
        ),
    ] = "",
) -> None:
    """Tell what 'reprocess --table continuous' found: coefficients, trends, currents, excess scatter.

    Of a spinning spacecraft: the twelve parameters, where each came from, and what each day decided. Of a
    comparison with a field model: scale factors, angles, mounting and offsets of the sensor.
    """
    from inflight.tasks.pipelines import tables_report

    workspace = command.open_workspace()
    mission, catalog = workspace.mission(), command.open_catalog()
    _require_comparison(mission, comparison)
    page = _page_path(html) if html else None
    with command.progress() as progress:
        progress("report", 0, 1)
        report = tables_report(catalog, mission, comparison, page, cross_talk, progress)
        progress("report", 1, 1)
    fields = report.as_json()

    def show(console: Console) -> None:
        _print_summary(console, report)
        where = fields["path"] or "none; --html FILE writes it with every figure"
        console.print(f"  page: {where}", soft_wrap=True, markup=False)
        console.print("next: inflight compare", soft_wrap=True, markup=False)

    command.emit(fields, show)


def report(
    command: Command,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: Annotated[
        str | None, typer.Option(help="What is compared with what (default: main).", show_default=False)
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Where the page goes (default: reports/)")] = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = False,
    workers: WorkersOption = None,
) -> None:
    """Show on one page what is missing from the model: where it fails, which effect, how the error falls.

    Without a span it is that of the last 'inflight diagnose', whose page is there unless something changed;
    what was measured is not read again.
    """
    workspace = command.open_workspace()
    mission = workspace.mission()
    from inflight.flows import DaySpan
    from inflight.tasks.analysis import (
        DiagnoseSettings,
        last_diagnosis,
        page_of_diagnosis,
        report_if_unchanged,
        require_sampled,
    )

    name = comparison or ("main" if "main" in mission.comparisons else next(iter(mission.comparisons)))
    span = DaySpan.model_validate({"start": start, "end": end}).as_text()
    require_sampled(mission, name)
    last: Mapping[str, Any] = (last_diagnosis(workspace, name) or {}).get("asked") or {}
    settings = DiagnoseSettings.model_validate(last.get("settings") or {"comparison": name})
    if not any(span):
        span = last.get("start"), last.get("end")
    page = output or page_of_diagnosis(workspace, name, *span)
    # What is there is opened where it lies, though nothing can be written.
    if output or not page.exists():
        page = _page_path(page)
    written = report_if_unchanged(workspace, page, *span, settings)
    if written is None:
        page = _page_path(page)
        from inflight.flows import lazy_client
        from inflight.tasks.analysis import report as diagnose_and_report

        with command.progress() as progress, lazy_client(workers) as client:
            how: Any = {"client": client, "progress": progress}
            written = diagnose_and_report(workspace, page, *span, settings, **how)
    fields = written.as_json()

    def show_report(console: Console) -> None:
        from inflight.diagnosis import HEADING

        console.print(dict(HEADING)[fields["verdict"]], style="bold", markup=False)
        for line in (
            f"  {fields['sentence']}",
            f"  {made_from_text(fields)}",
            f"  page: {fields['path']}",
            *[f"next: {one['command']}" for one in fields["entries"] if one["command"]][:1],
        ):
            console.print(line, soft_wrap=True, markup=False)

    command.emit(fields, show_report)
    if show:
        import webbrowser

        webbrowser.open(written.path.resolve().as_uri())


def explore(
    command: Command,
    *,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of this machine (default: a free one).")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print where the page is, open no browser.")
    ] = False,
    no_token: Annotated[
        bool,
        typer.Option("--no-token", help="Show the page to all users and programs of this machine."),
    ] = False,
    allow_code: Annotated[
        bool,
        typer.Option("--allow-code", help="Run the files of Python that the mission names as effects."),
    ] = False,
    workers: WorkersOption = None,
) -> None:
    """Explore the workspace in the browser: model against measurement, the missing effect, tables.

    Serves this machine alone, and there who has the token of the address, until Ctrl-C.
    """
    workspace = command.open_workspace()
    from inflight.explorer import Server

    server = Server(workspace, port, workers, with_token=not no_token, allow_code=allow_code)

    def ready(url: str) -> None:
        fields = {"command": "explore", "url": url, "workspace": str(workspace.root)}
        command.emit(fields, lambda console: console.print(f"{url}  (Ctrl-C ends it)", soft_wrap=True))
        if not (no_browser or command.json):
            import webbrowser

            webbrowser.open(url)

    server.run(ready)
