"""Verbs that judge and hand out results: ``compare`` and ``release``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from inflight.cli.pipeline import ComparisonOption, EndOption, NoPrefectOption, StartOption, run_flow
from inflight.cli.session import Session, verb
from inflight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.mission import Mission
    from inflight.tasks.pipelines import Report


def register(app: typer.Typer) -> None:
    """Add the verbs of this module."""
    verb(app, "compare")(compare)
    verb(app, "release")(release)


def compare(
    session: Session,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = "main",
    output: Annotated[Path | None, typer.Option(help="Where the page goes (default: reports/)")] = None,
    show: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Tell how well the calibrated instrument agrees with its reference, before and after."""
    workspace = session.open_workspace()
    report = compare_span(session, workspace, start=start, end=end, comparison=comparison, output=output)
    fields = report.as_json()
    session.emit(fields, lambda console: print_comparison(console, report))
    if show and fields["path"]:
        import webbrowser

        webbrowser.open(Path(fields["path"]).resolve().as_uri())


def compare_span(
    session: Session,
    workspace: Workspace,
    *,
    start: str | None = None,
    end: str | None = None,
    comparison: str = "main",
    output: Path | None = None,
) -> Report:
    """Compare and write the page, into the workspace's reports unless `output` says otherwise.

    A workspace that can only be read gets no page unless `output` names a place for it.

    Raises
    ------
    StorageError
        When the page cannot be written to `output`.
    """
    from inflight.flows import DaySpan
    from inflight.tasks.analysis import compare as measure

    mission = workspace.mission()
    require_comparison(mission, comparison)
    span = DaySpan.model_validate({"start": start, "end": end}).as_text()
    name = "-".join(["compare", comparison, *filter(None, span)])
    page = page_path(output) if output else _page_path_if_writable(workspace.reports / name)
    catalog = session.open_catalog()
    with session.progress() as progress:
        return measure(catalog, mission, *span, comparison=comparison, output=page, progress=progress)


def page_path(path: Path) -> Path:
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


def _page_path_if_writable(path: Path) -> Path | None:
    try:
        return page_path(path)
    except StorageError:
        return None


def require_comparison(mission: Mission, comparison: str) -> None:
    """Raise SettingsError unless the mission has a comparison of this name."""
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}",
            remedy=f"choose one of {', '.join(mission.comparisons)}",
        )


def print_summary(console: Console, report: Report) -> None:
    """Print what a person reads of a report."""
    for line in report.summary():
        console.print(line.text, style=line.style or None, soft_wrap=True, markup=False)


def print_comparison(console: Console, report: Report) -> None:
    """Print how well products agree before and after, where they still fail, and the page."""
    print_summary(console, report)
    page = report.path or "none, because the workspace cannot be written; --output names another place"
    console.print(f"  page: {page}", soft_wrap=True)


def release(
    session: Session,
    version: Annotated[str, typer.Argument(help="Version of the release, such as 1.0; never used twice.")],
    *,
    notes: Annotated[str, typer.Option(help="Text for the release notes.")] = "",
    destination: Annotated[Path | None, typer.Option(help="Folder (default: releases/)")] = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Freeze what is published and copy it out with manifest and notes."""
    parameters = {"version": version, "notes": notes, "destination": destination}
    session.finish(run_flow(session, "release", parameters, workers=None, prefect=not no_prefect))
