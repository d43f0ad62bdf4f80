"""The application: verbs put together, and the end of a command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from inflight import __version__
from inflight.cli import (
    browse,
    chain,
    demo,
    diagnose,
    explore,
    figures,
    models,
    pipeline,
    report,
    results,
    start,
)
from inflight.cli.session import EXIT_USAGE, DebugOption, JsonOption, Session, WorkspaceOption

app = typer.Typer(
    name="inflight",
    help="In-flight calibration of magnetometers: day files in, calibration tables and products out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done with days missing.",
)
for module in (start, pipeline, results, chain, diagnose, report, explore, models, browse, figures, demo):
    module.register(app)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"inflight {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
]


@app.callback()
def _common(
    context: typer.Context,
    workspace: WorkspaceOption = None,
    json: JsonOption = False,
    debug: DebugOption = False,
    version: VersionOption = False,
) -> None:
    before = Session()
    context.obj = Session(workspace or before.workspace, json, debug)


def main(arguments: list[str] | None = None) -> None:
    """Carry out one command line and leave with its exit code.

    Parameters
    ----------
    arguments : list of str, optional
        What follows ``inflight``; the process's own when absent.
    """
    given = sys.argv[1:] if arguments is None else arguments
    command = typer.main.get_command(app)
    try:
        code = command.main(given, prog_name="inflight", standalone_mode="--json" not in given)
    except typer.TyperException as error:
        Session(json=True).fail(_usage_fields(error))
        code = EXIT_USAGE
    sys.exit(code)


def _usage_fields(error: typer.TyperException) -> dict[str, str]:
    told = error.format_message() if hasattr(error, "format_message") else str(error)
    fields = {"kind": "UsageError", "message": told, "remedy": "inflight --help lists verbs and options"}
    return fields | {"file": "", "channel": "", "day": ""}
