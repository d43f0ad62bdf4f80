"""The application: verbs put together, and the end of a command."""

from __future__ import annotations

import gc
import sys
from typing import Annotated

import typer

from inflight import __version__
from inflight.cli import catalog, diagnose, figures, models, processing, results, start
from inflight.cli.command import EXIT_USAGE, Command, DebugOption, JsonOption, WorkspaceOption, verb

#: New objects after which Python looks for dead cycles. Its own 700 cost a tenth of a command's time: imports
#: and figures make objects by the hundred thousand, hardly any of which die.
_OBJECTS_TO_COLLECT = 50_000

#: Verbs in the order that ``--help`` shows them.
VERBS = (
    start.new,
    start.simulate,
    processing.ingest,
    processing.reprocess,
    processing.backfill,
    results.compare,
    results.release,
    results.chain,
    diagnose.diagnose,
    diagnose.auto,
    diagnose.add,
    diagnose.drop,
    diagnose.refit,
    diagnose.set_,
    diagnose.undo,
    results.report,
    results.explore,
    figures.figures,
    start.demo,
)

app = typer.Typer(
    name="inflight",
    help="In-flight calibration of magnetometers: day files in, calibration tables and products out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done with days missing.",
)
app.add_typer(models.group, name="model")
app.add_typer(catalog.group, name="catalog")
for function in VERBS:
    verb(app, function.__name__.rstrip("_"))(function)


def _print_version(requested: bool) -> None:
    if requested:
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
    before = Command()
    context.obj = Command(workspace or before.workspace, json, debug)


def main(arguments: list[str] | None = None) -> None:
    """Carry out one command line and leave with its exit code.

    Parameters
    ----------
    arguments : list of str, optional
        What follows ``inflight``; the process's own when absent.
    """
    gc.set_threshold(_OBJECTS_TO_COLLECT)
    given = sys.argv[1:] if arguments is None else arguments
    group = typer.main.get_command(app)
    try:
        code = group.main(given, prog_name="inflight", standalone_mode="--json" not in given)
    except typer.TyperException as error:
        message = error.format_message() if hasattr(error, "format_message") else str(error)
        remedy = "inflight --help lists verbs and options"
        place = {"file": "", "channel": "", "day": ""}
        Command(json=True).fail({"kind": "UsageError", "message": message, "remedy": remedy, **place})
        code = EXIT_USAGE
    sys.exit(code)
