"""Verbs about a missing effect: ``diagnose`` and ``auto`` find it; ``add``, ``drop``, ``undo`` revise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.command import Command
from inflight.cli.diagnosis_text import differences_from_diagnosis, print_diagnosis, print_revision
from inflight.cli.processing import (
    DetailsOption,
    EndOption,
    NoPrefectOption,
    StartOption,
    WorkersOption,
    run_flow,
)
from inflight.errors import SettingsError

if TYPE_CHECKING:
    from inflight.tasks.analysis import Revision, Workbench

ComparisonOption = Annotated[
    str | None, typer.Option("--comparison", help="What is compared with what (default: main).")
]
CadenceOption = Annotated[
    float | None,
    typer.Option(
        min=0.001, help="Seconds of the search's samples (default: by the span)", show_default=False
    ),
]
RoundsOption = Annotated[
    int | None, typer.Option(min=0, help="Additions at most; 0 only ranks (default: 8)", show_default=False)
]
EmpiricalOption = Annotated[
    bool, typer.Option("--empirical", help="It is added for what it looks like: its cause is not known.")
]
EffectArgument = Annotated[
    str,
    typer.Argument(
        help="A candidate of 'diagnose', an effect, a channel, or an entry of a model: text or a YAML file."
    ),
]


def diagnose(
    command: Command,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = None,
    rounds: RoundsOption = None,
    cadence: CadenceOption = None,
    search: Annotated[
        bool, typer.Option("--search", help="Search anew, though the last verdict may stand for later days.")
    ] = False,
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Write the page that 'inflight report' opens, too.")
    ] = True,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Find which physical effect is missing from the model."""
    options = {"start": start, "end": end, "comparison": comparison, "rounds": rounds, "cadence_s": cadence}
    how = {"search": search, "page": page}
    _search(command, options, how, save=False, workers=workers, prefect=not no_prefect, details=details)


def auto(
    command: Command,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = None,
    rounds: RoundsOption = None,
    cadence: CadenceOption = None,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
    details: DetailsOption = False,
) -> None:
    """Find what is missing and add it, until nothing more is justified; a version for each effect."""
    options = {"start": start, "end": end, "comparison": comparison, "rounds": rounds, "cadence_s": cadence}
    _search(command, options, {}, save=True, workers=workers, prefect=not no_prefect, details=details)


def _search(
    command: Command,
    options: Mapping[str, Any],
    how: Mapping[str, Any],
    *,
    save: bool,
    workers: int | None,
    prefect: bool,
    details: bool,
) -> None:
    """Run the flow, or its plain function, and print the diagnosis."""
    given = {name: value for name, value in options.items() if value is not None}
    given["comparison"] = _comparison(command, given.get("comparison"))
    span: dict[str, Any] = {name: given.pop(name) for name in ("start", "end") if name in given}
    parameters: dict[str, Any] = {**span, **how, "settings": given, "save": save}
    report = run_flow(command, "diagnose", parameters, workers=workers, prefect=prefect)
    fields = {"command": report.command, "run": report.run, "context": report.context, **report.extra}
    if report.problems:
        fields["problems"] = report.problems
    command.emit(fields, lambda console: print_diagnosis(console, fields, details))


def _comparison(command: Command, named: str | None) -> str:
    """Return the comparison to work on: the one named, ``main``, or the only one; refuse others."""
    mission = command.open_workspace().mission()
    from inflight.tasks.analysis import require_sampled

    only = next(iter(mission.comparisons)) if len(mission.comparisons) == 1 else "main"
    name = named or only
    require_sampled(mission, name)
    return name


def add(
    command: Command,
    effect: EffectArgument,
    *,
    empirical: EmpiricalOption = False,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Put an effect into the model, fit everything anew, and save a new version."""
    entry = effect
    if effect.endswith((".yaml", ".yml")):
        try:
            entry = Path(effect).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            remedy = "name a file with one entry of a model, or write the entry itself"
            raise SettingsError(f"{effect}: {error}", remedy=remedy) from None
    _revise(command, comparison, workers, lambda bench: bench.add(entry, empirical=empirical), ("add", entry))


def drop(
    command: Command,
    effect: Annotated[str, typer.Argument(help="Name of an effect of the model: see 'model show'.")],
    *,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Take an effect out of the model, fit everything anew, and save a new version."""
    _revise(command, comparison, workers, lambda bench: bench.drop(effect), ("drop", effect))


def refit(
    command: Command,
    numbers: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NUMBER]...",
            help="Numbers that data may move as far as they like, such as temperature.linear; "
            "the others move within what the model states of them.",
        ),
    ] = None,
    *,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Fit the model's own numbers anew, and save a new version."""
    _revise(
        command,
        comparison,
        workers,
        lambda bench: bench.refit(*(numbers or ())),
        ("refit", *(numbers or ())),
    )


def set_(
    command: Command,
    settings: Annotated[
        list[str],
        typer.Argument(
            metavar="NUMBER=VALUE...",
            help="Numbers of the model and their new values: stray.lag=410s, temperature.reference=21.",
        ),
    ],
    *,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Give numbers of the model other values, fit everything else anew, and save a new version."""
    _revise(command, comparison, workers, lambda bench: bench.set_numbers(*settings), ("set", *settings))


def undo(command: Command, *, comparison: ComparisonOption = None, workers: WorkersOption = None) -> None:
    """Go back to the model before the last change; history keeps both."""
    _revise(command, comparison, workers, lambda bench: bench.undo(), ("undo",))


def _revise(
    command: Command,
    comparison: str | None,
    workers: int | None,
    change: Callable[[Workbench], Revision],
    asked: tuple[str, ...] = (),
) -> None:
    workspace = command.open_workspace()
    name = _comparison(command, comparison)
    from inflight.flows import lazy_client
    from inflight.tasks.analysis import last_diagnosis, open_workbench, require_change

    if asked:
        require_change(workspace, name, *asked)
    with command.progress() as progress, lazy_client(workers) as client:
        fields = change(open_workbench(workspace, name, client=client, progress=progress)).as_json()
    fields["told_with_others"] = differences_from_diagnosis(last_diagnosis(workspace, name), fields)
    command.emit(fields, lambda console: print_revision(console, fields))
