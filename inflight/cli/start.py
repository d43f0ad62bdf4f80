"""Verbs that begin a workspace: ``new``, ``simulate``, ``demo``: a hidden effect is found and added."""

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
from inflight.cli.diagnosis_text import only_moves_with
from inflight.cli.processing import NoPrefectOption, WorkersOption, run_flow
from inflight.cli.results import compare_span
from inflight.errors import SettingsError
from inflight.progress import Progress
from inflight.tasks import RunReport

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
#: Seconds between the demo's samples: the story is that of 1 s, in a third of the time.
DEMO_CADENCE = 5
#: What the demo hides: a heater's cable whose field is ten times the simulator's usual one. The currents that
#: its pre-flight model does not know either are left out, so that the story has one cause.
DEMO_HIDDEN = {
    "hide": ["heater"],
    "without": ["solar_array", "battery", "star_camera"],
    "overrides": {"heater_field": (0.5, 0.0, -1.0)},
}


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
    hide: Annotated[
        list[str] | None,
        typer.Option(help="Effect that only the truth names; a wrong name is answered with those there are."),
    ] = None,
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
    where = "" if workspace.root.resolve() == Path.cwd() else f" -w {workspace.root}"
    command.finish(report, [f"next: inflight ingest{where}"])


def write_deliveries(
    folder: Path,
    settings: Mapping[str, Any],
    *,
    mission: str = SIMULATED_MISSION,
    workers: int | None,
    progress: Progress,
) -> list[Path]:
    """Simulate day files of a mission into a folder; `settings` are those of its kind."""
    from inflight.flows import available_cores, start_early

    checked, workers = _settings_of(mission).model_validate(settings), workers or available_cores()
    if min(workers, checked.days) > 1:
        # What these processes are forks of imports while this one does; the flows of a demo go on with it.
        start_early()
    from inflight.tasks.archive import simulate as simulate_days

    return simulate_days(
        checked,
        folder,
        progress=lambda done, total: progress("simulate", done, total),
        workers=workers,
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
    folder: Annotated[
        Path | None,
        typer.Argument(help="Folder to make (default: demo)", metavar="[DIR]", show_default=False),
    ] = None,
    *,
    days: Annotated[int, typer.Option(min=1, help="Days to simulate.")] = 30,
    cadence: Annotated[int, typer.Option(help="Seconds between samples: 1, 2, 5 or 10.")] = DEMO_CADENCE,
    seed: Annotated[int, typer.Option(help="Same seed, same mission.")] = 1,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Simulate a month with an effect hidden in it; find it, add it, watch the error fall to the noise."""
    from inflight.catalog import Workspace

    begun = time.monotonic()
    folder = folder or (DEMO_FOLDER if command.workspace == Path() else command.workspace)
    command = Command(folder, command.json, command.debug)
    exists = Workspace(folder).mission_file.exists()
    workspace = Workspace.open(folder) if exists else Workspace.create(folder, SIMULATED_MISSION)
    if not exists:
        _state_cadence(workspace.mission_file, cadence)
        if not no_prefect:
            from inflight.flows import start_server_early

            # In a new workspace there is work for it.
            start_server_early(workspace)
    story = _Story(command)
    settings = {"start": DEMO_START, "days": days, "cadence": cadence, "seed": seed, **DEMO_HIDDEN}
    with command.progress() as progress:
        files = write_deliveries(workspace.data, settings, workers=workers, progress=progress)
    story.line(
        "simulate", f"{len(files)} day files of {days} days; one cause is hidden that the model does not know"
    )

    def flow(name: str, parameters: Mapping[str, Any] | None = None) -> RunReport:
        return run_flow(command, name, parameters or {}, workers=workers, prefect=not no_prefect)

    taken = flow("ingest")
    story.line("ingest", f"{_days_text(taken)} of {len(taken.extra['datasets'])} instruments in the archive")
    made = flow("reprocess")
    story.line("reprocess", f"{_days_text(made)} calibrated, level-2 products written")
    first = compare_span(command, workspace).as_json()
    story.line("compare", _fails_text(first))
    found = flow("diagnose", {"settings": {"comparison": "main"}}).extra
    why = only_moves_with(found, _followed(first))
    story.line("diagnose", found["headline"] + (f" Of what compare names, {why}." if why else ""))
    last, added = first, ""
    if (best := _first_addition(found)) is not None:
        added = best["name"]
        revision = _add(command, workspace, added, workers)
        version = revision["model"]["version"]
        story.line("add", f'"{added}": model version {version}, all else fitted anew')
        made = flow("reprocess")
        story.line("reprocess", f"{_days_text(made)} with the new model")
        last = compare_span(command, workspace).as_json()
        story.line("compare", _fall_text(last))
    seconds = time.monotonic() - begun
    page = workspace.relative(Path(last["path"]))
    facts = {
        "residual": last["residual"],
        "against": last["against"],
        "found": [entry["name"] for entry in found["entries"]],
        "verdict": found["verdict"],
        "added": added,
        "path": page,
        "seconds": round(seconds, 1),
    }
    total = taken.followed_by(made, "demo")
    total = replace(total, outputs=[*total.outputs, page], extra=total.extra | facts)
    command.emit(total.as_json(), lambda console: _print_next(console, workspace, page, found, seconds))
    if total.exit_code:
        raise typer.Exit(total.exit_code)


def _state_cadence(mission_file: Path, cadence: int) -> None:
    """State in the demo's mission file how far apart the samples are that are simulated each second."""
    text = mission_file.read_text(encoding="utf-8")
    mission_file.write_text(text.replace("cadence: 1 s", f"cadence: {cadence} s"), encoding="utf-8")


class _Story:
    """The demo's steps as lines, one each, numbered."""

    def __init__(self, command: Command) -> None:
        self._command, self._count = command, 0

    def line(self, verb: str, text: str) -> None:
        self._count += 1
        if not self._command.json:
            self._command.console.print(f"{self._count}  {verb:<10} {text}", soft_wrap=True, markup=False)


def _days_text(report: RunReport) -> str:
    count = report.days["done"] + report.days["unchanged"]
    return f"{count} days" + (f", {report.days['failed']} failed," if report.days["failed"] else "")


def _fails_text(compared: Mapping[str, Any]) -> str:
    """Return how much of the residual is more than noise, and what it follows."""
    residual = compared["residual"]
    text = (
        f"residual {residual['before_nT']:.1f} nT before calibration, "
        f"{residual['without_outliers_nT']:.3f} nT after; noise alone is {residual['noise_floor_nT']:.3f} "
        f"nT, so that {residual['above_floor_nT']:.2g} nT have a cause"
    )
    names = _followed(compared)
    more = f". They go with {' and '.join(names)}: causes, or what only moves with the cause" if names else ""
    return text + more


def _followed(compared: Mapping[str, Any]) -> list[str]:
    """Return the coordinates that a residual goes with most, strongest first."""
    return [one["coordinate"] for one in compared["fails_where"][:2]]


def _fall_text(compared: Mapping[str, Any]) -> str:
    """Return how the error fell with the effect that was added."""
    residual, before = compared["residual"], compared["against"]
    floor = residual["noise_floor_nT"]
    after = f"{residual['without_outliers_nT']:.4f} nT, noise {floor:.4f} nT"
    if before is None:
        return f"residual {after}"
    end = ". The residual is at its noise floor" if compared["at_noise_floor"] else ""
    return (
        f"residual {before['rms']:.4f} -> {after}: above the noise {before['above_floor']:.2g} -> "
        f"{residual['above_floor_nT']:.2g} nT{end}"
    )


def _first_addition(found: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the largest entry of a diagnosis that names its cause; None when these data name none."""
    if found.get("plumbing"):
        return None
    named = [one for one in found["entries"] if one["command"].startswith("inflight add")]
    return next((one for one in named if one["status"] in ("sure", "rivals")), None)


def _add(command: Command, workspace: Workspace, effect: str, workers: int | None) -> dict[str, Any]:
    from inflight.flows import lazy_client
    from inflight.tasks.analysis import open_workbench

    with command.progress() as progress, lazy_client(workers) as client:
        return open_workbench(workspace, client=client, progress=progress).add(effect).as_json()


def _print_next(
    console: Console, workspace: Workspace, page: str, found: Mapping[str, Any], seconds: float
) -> None:
    """Print what a newcomer may look at and type after the demo."""
    root = workspace.root
    # A newcomer who came by `make demo` has not activated the environment.
    program = "inflight" if shutil.which("inflight") else sys.argv[0]
    console.print(
        f"Done in {seconds:.0f} s. Before, after and noise on one page: {root / page}", soft_wrap=True
    )
    if found["verdict"] not in ("FOUND", "CONFOUNDED"):
        console.print(f"These data name no cause: {found['meaning']}.", soft_wrap=True, markup=False)
    console.print("What to type next:")
    for line, purpose in (
        (f"{program} diagnose -w {root}", "is anything left, and how sure is that"),
        (f"{program} report --open -w {root}", "figures of each cause: the data, and what it would make"),
        (f"{program} model history -w {root}", "what each version of the model took off"),
        (f"{program} explore -w {root}", "the same in the browser"),
        (f"{program} new template my-mission", "begin with measurements of your own"),
    ):
        console.print(f"  {line:<56} {purpose}", soft_wrap=True, markup=False)
