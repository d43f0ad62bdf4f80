"""The verb ``demo``: a simulated month through the whole chain, by the front door."""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from inflight.cli.pipeline import NoPrefectOption, WorkersOption, run_flow
from inflight.cli.results import compare_span, print_comparison
from inflight.cli.session import Session, verb
from inflight.cli.start import SIMULATED_MISSION, write_deliveries
from inflight.tasks import RunReport, print_report

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace

#: Where the demo goes when no workspace is named.
DEMO_FOLDER = Path("demo")
DEMO_START = "2005-01-01"


def register(app: typer.Typer) -> None:
    """Add the verb of this module."""
    verb(app, "demo")(demo)


def demo(
    session: Session,
    *,
    days: Annotated[int, typer.Option(min=1, help="Days to simulate.")] = 30,
    seed: Annotated[int, typer.Option(help="Same seed, same mission.")] = 1,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Simulate a month of a CHAMP-like mission and take it through the whole chain."""
    begun = time.monotonic()
    folder = DEMO_FOLDER if session.workspace == Path() else session.workspace
    session = Session(folder, session.json, session.debug)
    workspace = _workspace(folder)
    _say(session, f"1 of 4  simulating {days} days of day files in {workspace.data}")
    with session.progress() as progress:
        write_deliveries(
            workspace.data,
            {"start": DEMO_START, "days": days, "seed": seed},
            workers=workers,
            progress=progress,
        )
    reports = []
    for number, name, told in (
        (2, "ingest", "reading them into the archive"),
        (3, "reprocess", "calibrating every day and writing level-2 products"),
    ):
        _say(session, f"{number} of 4  {told}")
        reports.append(run_flow(session, name, {}, workers=workers, prefect=not no_prefect))
        if not session.json:
            print_report(reports[-1], session.console)
    _say(session, "4 of 4  comparing the vector instrument with the scalar one")
    _finish(session, workspace, reports[0].followed_by(reports[1], "demo"), time.monotonic() - begun)


def _workspace(folder: Path) -> Workspace:
    from inflight.catalog import Workspace

    exists = Workspace(folder).mission_file.exists()
    return Workspace.open(folder) if exists else Workspace.create(folder, SIMULATED_MISSION)


def _say(session: Session, text: str) -> None:
    if not session.json:
        session.console.print(text, style="bold")


def _finish(session: Session, workspace: Workspace, report: RunReport, seconds: float) -> None:
    compared = compare_span(session, workspace)
    fields = compared.as_json()
    page = workspace.relative(fields["path"])
    added = {"residual": fields["residual"], "path": page, "seconds": round(seconds, 1)}
    total = replace(report, outputs=[*report.outputs, page], extra=report.extra | added)

    def show(console: Console) -> None:
        print_comparison(console, compared)
        _print_next(console, workspace, seconds)

    session.emit(total.as_json(), show)
    if total.exit_code:
        raise typer.Exit(total.exit_code)


def _print_next(console: Console, workspace: Workspace, seconds: float) -> None:
    root = workspace.root
    # A newcomer who came by `make demo` has not activated the environment.
    program = "inflight" if shutil.which("inflight") else sys.argv[0]
    console.print(f"\nDone in {seconds:.0f} s. Products, tables and archive are in the catalog of {root}.")
    console.print("What to type next:")
    for command, told in (
        (f"{program} catalog list -w {root}", "what there is"),
        (f"{program} catalog show l2/field -w {root}", "day by day"),
        (f"{program} compare -w {root} --open", "the page with the plots"),
        (f"{program} diagnose -w {root}", "which physical effect is missing"),
        (f"{program} reprocess -w {root}", "again: finds nothing to do"),
        (f"{program} new template my-mission", "begin with measurements of your own"),
    ):
        console.print(f"  {command:<56} {told}", soft_wrap=True)
