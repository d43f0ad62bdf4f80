"""Verbs about a missing effect: ``diagnose`` and ``auto`` find it; ``add``, ``drop``, ``undo`` revise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.pipeline import EndOption, NoPrefectOption, StartOption, WorkersOption, run_flow
from inflight.cli.session import Session, verb
from inflight.errors import SettingsError

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.tasks.analysis import Revision, Workbench

ComparisonOption = Annotated[
    str | None, typer.Option("--comparison", help="What is held against what (default: main).")
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
EffectArgument = Annotated[
    str,
    typer.Argument(
        help="A candidate of 'diagnose', an effect, a channel, or an entry of a model: text or a YAML file."
    ),
]


def register(app: typer.Typer) -> None:
    """Add the verbs of this module."""
    for function in (diagnose, auto, add, drop, undo):
        verb(app, function.__name__)(function)


def diagnose(
    session: Session,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = None,
    rounds: RoundsOption = None,
    cadence: CadenceOption = None,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Find which physical effect is missing from the model."""
    asked = {"start": start, "end": end, "comparison": comparison, "rounds": rounds, "cadence_s": cadence}
    fields = _search(session, asked, save=False, workers=workers, prefect=not no_prefect)
    _emit_diagnosis(session, fields)


def auto(
    session: Session,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = None,
    rounds: RoundsOption = None,
    cadence: CadenceOption = None,
    workers: WorkersOption = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Find what is missing and add it, until nothing more is justified; a version for each effect."""
    asked = {"start": start, "end": end, "comparison": comparison, "rounds": rounds, "cadence_s": cadence}
    fields = _search(session, asked, save=True, workers=workers, prefect=not no_prefect)
    _emit_diagnosis(session, fields)


def _search(
    session: Session, asked: Mapping[str, Any], *, save: bool, workers: int | None, prefect: bool
) -> dict[str, Any]:
    """Run the flow, or its plain function, and return the diagnosis."""
    given = {name: value for name, value in asked.items() if value is not None}
    given["comparison"] = _comparison(session, given.get("comparison"))
    span: dict[str, Any] = {name: given.pop(name) for name in ("start", "end") if name in given}
    parameters: dict[str, Any] = {**span, "settings": given, "save": save}
    report = run_flow(session, "diagnose", parameters, workers=workers, prefect=prefect)
    return {"command": report.command, "run": report.run, "context": report.context, **report.extra}


def _comparison(session: Session, named: str | None) -> str:
    """Return the comparison to work on: the one named, ``main``, or the only one; wrong ones are refused."""
    from inflight.tasks.analysis import require_sampled

    mission = session.open_workspace().mission()
    only = next(iter(mission.comparisons)) if len(mission.comparisons) == 1 else "main"
    name = named or only
    require_sampled(mission, name)
    return name


def _emit_diagnosis(session: Session, fields: dict[str, Any]) -> None:
    from inflight.cli.telling import print_diagnosis

    session.emit(fields, lambda console: print_diagnosis(console, fields))


def add(
    session: Session,
    effect: EffectArgument,
    *,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Put an effect into the model, fit everything anew, and save a new version."""
    wanted = _entry_text(effect)
    _revise(session, comparison, workers, lambda bench: bench.add(wanted))


def drop(
    session: Session,
    effect: Annotated[str, typer.Argument(help="Name of an effect of the model: see 'model show'.")],
    *,
    comparison: ComparisonOption = None,
    workers: WorkersOption = None,
) -> None:
    """Take an effect out of the model, fit everything anew, and save a new version."""
    _revise(session, comparison, workers, lambda bench: bench.drop(effect))


def undo(session: Session, *, comparison: ComparisonOption = None, workers: WorkersOption = None) -> None:
    """Go back to the model before the last change; history keeps both."""
    _revise(session, comparison, workers, lambda bench: bench.undo())


def _entry_text(effect: str) -> str:
    """Return the text of a YAML file that is named, else what was typed."""
    if not effect.endswith((".yaml", ".yml")):
        return effect
    try:
        return Path(effect).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(
            f"{effect}: {error}", remedy="name a file with one entry of a model, or write the entry itself"
        ) from None


def _revise(
    session: Session, comparison: str | None, workers: int | None, change: Callable[[Workbench], Revision]
) -> None:
    from inflight.cli.telling import print_revision
    from inflight.flows import lazy_client
    from inflight.tasks.analysis import open_workbench

    name = _comparison(session, comparison)
    workspace = session.open_workspace()
    with session.progress() as progress, lazy_client(workers) as client:
        told = change(open_workbench(workspace, name, client=client, progress=progress)).as_json()

    def show(console: Console) -> None:
        print_revision(console, told)

    session.emit(told, show)
