"""Verbs that judge and hand out results: ``compare`` and ``release``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.pipeline import ComparisonOption, EndOption, NoPrefectOption, StartOption, run_flow
from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console


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
    from inflight.tasks.compare import compare as make_comparison

    workspace = session.open_workspace()
    report = make_comparison(
        session.open_catalog(), workspace.mission(), start, end, comparison=comparison, output=output
    )
    fields = report.as_json()
    session.emit(fields, lambda console: print_comparison(console, fields, workspace.relative(report.path)))
    if show:
        import webbrowser

        webbrowser.open(Path(report.path).resolve().as_uri())


def print_comparison(console: Console, fields: dict[str, Any], path: str) -> None:
    """Print residual before and after, the worst days and where it still fails."""
    residual = fields["residual"]
    console.print(f"residual before {_nanotesla(residual['before_nT'])}", style="bold")
    console.print(f"residual after  {_nanotesla(residual['after_nT'])}", style="bold")
    floor = residual.get("noise_floor_nT")
    if isinstance(floor, int | float):
        console.print(f"noise floor     {floor:.3f} nT")
    for failing in fields.get("fails_where", []):
        console.print(f"  {failing['sentence']}")
    console.print(f"  {path}", soft_wrap=True)


def _nanotesla(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {number:.3f} nT" for name, number in value.items() if number is not None)
    return f"{value:.3f} nT" if isinstance(value, int | float) else "unknown"


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
