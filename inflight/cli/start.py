"""Verbs that begin a workspace: ``new`` and ``simulate``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.session import Session, verb
from inflight.errors import SettingsError
from inflight.tasks import Progress

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.simulate import MissionSettings


#: The shipped mission that the simulator flies.
SIMULATED_MISSION = "champ"
#: The same with a second fluxgate: made with `new`, before it is simulated.
WITH_SECOND = "champ-two-fluxgates"
#: Missions of spinning spacecraft that are simulated.
SPINNING = ("themis", "imp8", "helios")
#: The one with two sensors on a boom and nothing else to hold them against.
TWO_SENSORS = "venus-express"


def register(app: typer.Typer) -> None:
    """Add the verbs of this module."""
    verb(app, "new")(new)
    verb(app, "simulate")(simulate)


def new(
    session: Session,
    mission: Annotated[
        str | None, typer.Argument(help="A shipped mission or a YAML file; without it, they are listed.")
    ] = None,
    folder: Annotated[Path | None, typer.Argument(help="Folder to make.", metavar="DIR")] = None,
) -> None:
    """Make a workspace for a mission."""
    from inflight.catalog import Workspace
    from inflight.tasks import RunReport

    if mission is None:
        return _list_missions(session)
    if folder is None:
        raise SettingsError(
            "the folder to make is missing", remedy=f"write: inflight new {mission} {Path(mission).stem}"
        )
    workspace = Workspace.create(folder, mission)
    report = RunReport("new", outputs=[str(workspace.mission_file)])
    session.emit(report.as_json(), lambda console: _print_made(console, workspace))
    return None


def _list_missions(session: Session) -> None:
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

    session.emit({"command": "new", "missions": items}, show)


def _print_made(console: Console, workspace: Workspace) -> None:
    for line in (
        f"{workspace.root} is ready.",
        f"  mission   {workspace.mission_file}",
        f"  data      {workspace.data}  (delivered files go here, or say ingest FOLDER)",
        f"\nNext: inflight ingest --workspace {workspace.root}",
    ):
        console.print(line, soft_wrap=True)


def simulate(
    session: Session,
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
    from inflight.tasks import RunReport
    from inflight.tasks.archive import SECOND_FLUXGATE

    workspace = Workspace(session.workspace)
    if not workspace.mission_file.exists():
        workspace = Workspace.create(session.workspace, SIMULATED_MISSION)
    _require_simulated(workspace)
    settings = {"start": start, "days": days, "seed": seed, "hide": hide or (), "without": without or ()}
    mission = workspace.mission().mission
    if SECOND_FLUXGATE in workspace.mission().instruments:
        settings |= {"second_fluxgate": True}
    if mission in SPINNING:
        settings |= {"craft": mission}
    with session.progress() as progress:
        written = write_deliveries(
            workspace.data, settings, mission=mission, workers=workers, progress=progress
        )
    report = RunReport(
        "simulate",
        days={"planned": days, "done": days},
        outputs=sorted({workspace.relative(path.parent) for path in written}),
        extra={"files": len(written)},
    )
    session.finish(report)


def _require_simulated(workspace: Workspace) -> None:
    """Refuse to put simulated files among the measurements of another mission."""
    named = workspace.mission().mission
    known = (SIMULATED_MISSION, WITH_SECOND, *SPINNING, TWO_SENSORS)
    if named not in known:
        raise SettingsError(
            f"{workspace.root} holds mission {named!r}; only {', '.join(map(repr, known))} are simulated",
            remedy="name a new folder with --workspace",
        )


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
    if mission in SPINNING:
        from inflight.simulate.spinning import SpinningSettings

        return SpinningSettings
    if mission == TWO_SENSORS:
        from inflight.simulate.dual import DualSettings

        return DualSettings
    from inflight.simulate import SimulationSettings

    return SimulationSettings
