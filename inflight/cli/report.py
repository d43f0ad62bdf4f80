"""The verb ``report``: a diagnosis as one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.pipeline import EndOption, StartOption, WorkersOption
from inflight.cli.results import page_path
from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.tasks.analysis import DiagnoseSettings, DiagnosisReport


def register(app: typer.Typer) -> None:
    """Add the verb of this module."""
    verb(app, "report")(report)


def report(
    session: Session,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: Annotated[
        str | None, typer.Option(help="What is held against what (default: main).", show_default=False)
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Where the page goes (default: reports/)")] = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")] = False,
    workers: WorkersOption = None,
) -> None:
    """Show on one page what is missing from the model: where it fails, which effect, how the error falls.

    Without a span it is that of the last 'inflight diagnose'; what was measured is not read again.
    """
    workspace = session.open_workspace()
    made = report_span(session, workspace, start, end, comparison, output, workers)
    fields = made.as_json()
    session.emit(fields, lambda console: _print_report(console, fields))
    if show:
        import webbrowser

        webbrowser.open(made.path.resolve().as_uri())


def report_span(
    session: Session,
    workspace: Workspace,
    start: str | None = None,
    end: str | None = None,
    comparison: str | None = None,
    output: Path | None = None,
    workers: int | None = None,
) -> DiagnosisReport:
    """Diagnose a span, as the last diagnosis did unless it is said otherwise, and write the page.

    Raises
    ------
    StorageError
        When the page cannot be written.
    SettingsError, InflightError
        As `inflight.tasks.analysis.diagnosis_page.report`.
    """
    from inflight.flows import DaySpan, lazy_client
    from inflight.tasks.analysis import report as write_report

    mission = workspace.mission()
    name = comparison or ("main" if "main" in mission.comparisons else next(iter(mission.comparisons)))
    span, settings = _asked(workspace, name, DaySpan.model_validate({"start": start, "end": end}).as_text())
    page = page_path(output or workspace.reports / "-".join(["report", name, *filter(None, span)]))
    with session.progress() as progress, lazy_client(workers) as client:
        return write_report(
            session.open_catalog(), mission, page, *span, settings, client=client, progress=progress
        )


def _asked(
    workspace: Workspace, comparison: str, span: tuple[str | None, str | None]
) -> tuple[tuple[str | None, str | None], DiagnoseSettings]:
    """Return span and settings: those of the last diagnosis where nothing else is said."""
    from inflight.tasks.analysis import DiagnoseSettings, last_diagnosis, require_sampled

    require_sampled(workspace.mission(), comparison)
    asked: Mapping[str, Any] = (last_diagnosis(workspace, comparison) or {}).get("asked") or {}
    settings = DiagnoseSettings.model_validate(asked.get("settings") or {"comparison": comparison})
    if any(span):
        return span, settings
    return (asked.get("start"), asked.get("end")), settings


def _print_report(console: Console, fields: Mapping[str, Any]) -> None:
    console.print(fields["verdict"], style="bold", markup=False)
    console.print(f"  {fields['sentence']}", soft_wrap=True, markup=False)
    console.print(f"  page: {fields['path']}", soft_wrap=True, markup=False)
