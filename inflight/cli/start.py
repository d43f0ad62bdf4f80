"""Verbs that begin a workspace: ``new``, ``simulate`` and ``demo``, a simulated month through every step."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.command import Command
from inflight.cli.processing import NoPrefectOption, WorkersOption, run_flow
from inflight.cli.results import compare_span, print_comparison
from inflight.errors import SettingsError
from inflight.tasks import Progress, RunReport, print_report

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.simulate import MissionSettings


#: The shipped mission that the simulator flies.
SIMULATED_MISSION = "champ"
#: The same with a second fluxgate: made with `new`, before it is simulated.
SECOND_FLUXGATE_MISSION = "champ-two-fluxgates"
#: Missions of spinning spacecraft that are simulated.
SPINNING_MISSIONS = ("themis", "imp8", "helios")
#: The one with two sensors on a boom and no other reference.
TWO_SENSOR_MISSION = "venus-express"
#: Where the demo goes when no workspace is named.
DEMO_FOLDER = Path("demo")
DEMO_START = "2005-01-01"


def new(
    command: Command,
    mission: Annotated[
        str | None, typer.Argument(help="A shipped mission or a YAML file; without it, they are listed.")
    ] = None,
    folder: Annotated[Path | None, typer.Argument(help="Folder to make.", metavar="DIR")] = None,
) -> None:
    """Make a workspace for a mission."""
    from inflight.catalog import Workspace

    if mission is None:
        _list_missions(command)
        return
    if folder is None:
        raise SettingsError(
            "the folder to make is missing", remedy=f"write: inflight new {mission} {Path(mission).stem}"
        )
    workspace = Workspace.create(folder, mission)
    report = RunReport("new", outputs=[str(workspace.mission_file)])

    def show(console: Console) -> None:
        for line in (
            f"{workspace.root} is ready.",
            f"  mission   {workspace.mission_file}",
            f"  data      {workspace.data}  (delivered files go here, or say ingest FOLDER)",
            f"\nNext: inflight ingest --workspace {workspace.root}",
        ):
            console.print(line, soft_wrap=True)

    command.emit(report.as_json(), show)


def _list_missions(command: Command) -> None:
    from inflight.catalog import shipped_missions
    from inflight.mission import Mission

    shipped = shipped_missions()
    items = [
        {"name": name, "description": Mission.parse(path.read_text(encoding="utf-8"), str(path)).description}
        for name, path in shipped.items()
    ]

    def show(console: Console) -> None:
        for item in items:
            console.print(f"  {item['name']:<14} {' '.join(item['description'].split())}")
        console.print(
            "\nMake a workspace: inflight new NAME DIR. A mission of your own: inflight new template DIR"
        )

    command.emit({"command": "new", "missions": items}, show)


def simulate(
    command: Command,
    *,
    start: Annotated[str, typer.Option(help="First day, YYYY-MM-DD.")] = "2005-01-01",
    days: Annotated[int, typer.Option(min=1, help="Number of days.")] = 30,
    seed: Annotated[int, typer.Option(help="Same seed, same mission.")] = 1,
    hide: Annotated[list[str] | None, typer.Option(help="Effect that only the truth names.")] = None,
    without: Annotated[list[str] | None, typer.Option(help="Effect to leave out.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: the cores).")] = None,
) -> None:
    """Write day files like a real mission delivers, into the workspace's data folder.

    A folder that is no workspace becomes one of the simulated mission. A workspace of
    champ-two-fluxgates gets the files of a second fluxgate, too; one of themis, imp8 or helios those of a
    spinning spacecraft, and one of venus-express those of two sensors on one boom.
    """
    from inflight.catalog import Workspace
    from inflight.tasks.archive import SECOND_FLUXGATE

    workspace = Workspace(command.workspace)
    if not workspace.mission_file.exists():
        workspace = Workspace.create(command.workspace, SIMULATED_MISSION)
    mission, instruments = workspace.mission().mission, workspace.mission().instruments
    simulated = (SIMULATED_MISSION, SECOND_FLUXGATE_MISSION, *SPINNING_MISSIONS, TWO_SENSOR_MISSION)
    if mission not in simulated:
        # Simulated files must not come among the measurements of another mission.
        names = ", ".join(map(repr, simulated))
        raise SettingsError(
            f"{workspace.root} holds mission {mission!r}; only {names} are simulated",
            remedy="name a new folder with --workspace",
        )
    settings = {"start": start, "days": days, "seed": seed, "hide": hide or (), "without": without or ()}
    if SECOND_FLUXGATE in instruments:
        settings |= {"second_fluxgate": True}
    if mission in SPINNING_MISSIONS:
        settings |= {"craft": mission}
    with command.progress() as progress:
        written = write_deliveries(
            workspace.data, settings, mission=mission, workers=workers, progress=progress
        )
    report = RunReport(
        "simulate",
        days={"planned": days, "done": days},
        outputs=sorted({workspace.relative(path.parent) for path in written}),
        extra={"files": len(written)},
    )
    command.finish(report)


def write_deliveries(
    folder: Path,
    settings: Mapping[str, Any],
    *,
    mission: str = SIMULATED_MISSION,
    workers: int | None,
    progress: Progress,
) -> list[Path]:
    """Simulate day files of a mission into a folder; `settings` are those of its kind."""
    from inflight.flows import available_cores
    from inflight.tasks.archive import simulate as simulate_days

    return simulate_days(
        _settings_of(mission).model_validate(settings),
        folder,
        progress=lambda done, total: progress("simulate", done, total),
        workers=workers or available_cores(),
    )


def _settings_of(mission: str) -> type[MissionSettings]:
    """Return the settings of a simulated mission."""
    if mission in SPINNING_MISSIONS:
        from inflight.simulate.spinning import SpinningSettings

        return SpinningSettings
    if mission == TWO_SENSOR_MISSION:
        from inflight.simulate.dual import DualSettings

        return DualSettings
    from inflight.simulate import SimulationSettings

    return SimulationSettings


def demo(
    command: Command,
    *,
    days: Annotated[int, typer.Option(min=1, help="Days to simulate.")] = 30,
    seed: Annotated[int, typer.Option(help="Same seed, same mission.")] = 1,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Simulate a month of a CHAMP-like mission and take it through the whole chain."""
    from inflight.catalog import Workspace

    begun = time.monotonic()
    folder = DEMO_FOLDER if command.workspace == Path() else command.workspace
    command = Command(folder, command.json, command.debug)
    exists = Workspace(folder).mission_file.exists()
    workspace = Workspace.open(folder) if exists else Workspace.create(folder, SIMULATED_MISSION)

    def announce(text: str) -> None:
        if not command.json:
            command.console.print(text, style="bold")

    announce(f"1 of 4  simulating {days} days of day files in {workspace.data}")
    settings = {"start": DEMO_START, "days": days, "seed": seed}
    with command.progress() as progress:
        write_deliveries(workspace.data, settings, workers=workers, progress=progress)
    reports = []
    for number, name, doing in (
        (2, "ingest", "reading them into the archive"),
        (3, "reprocess", "calibrating every day and writing level-2 products"),
    ):
        announce(f"{number} of 4  {doing}")
        reports.append(run_flow(command, name, {}, workers=workers, prefect=not no_prefect))
        if not command.json:
            print_report(reports[-1], command.console)
    announce("4 of 4  comparing the vector instrument with the scalar one")
    compared = compare_span(command, workspace)
    seconds = time.monotonic() - begun
    fields = compared.as_json()
    page = workspace.relative(fields["path"])
    added = {"residual": fields["residual"], "path": page, "seconds": round(seconds, 1)}
    total = reports[0].followed_by(reports[1], "demo")
    total = replace(total, outputs=[*total.outputs, page], extra=total.extra | added)

    def show(console: Console) -> None:
        print_comparison(console, compared)
        _print_next(console, workspace, seconds)

    command.emit(total.as_json(), show)
    if total.exit_code:
        raise typer.Exit(total.exit_code)


def _print_next(console: Console, workspace: Workspace, seconds: float) -> None:
    """Print what a newcomer may type after the demo."""
    root = workspace.root
    # A newcomer who came by `make demo` has not activated the environment.
    program = "inflight" if shutil.which("inflight") else sys.argv[0]
    console.print(f"\nDone in {seconds:.0f} s. Products, tables and archive are in the catalog of {root}.")
    console.print("What to type next:")
    for command, purpose in (
        (f"{program} catalog list -w {root}", "what there is"),
        (f"{program} catalog show l2/field -w {root}", "day by day"),
        (f"{program} compare -w {root} --open", "the page with the plots"),
        (f"{program} diagnose -w {root}", "which physical effect is missing"),
        (f"{program} reprocess -w {root}", "again: finds nothing to do"),
        (f"{program} new template my-mission", "begin with measurements of your own"),
    ):
        console.print(f"  {command:<56} {purpose}", soft_wrap=True)
