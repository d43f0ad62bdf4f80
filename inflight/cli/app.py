"""The application: verbs put together, and the end of a command."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from inflight import __version__
from inflight.cli import catalog, contexts, diagnose, figures, models, processing, results, start
from inflight.cli.command import EXIT_USAGE, Command, DebugOption, JsonOption, WorkspaceOption, verb
from inflight.threads import OBJECTS_TO_COLLECT, ONE_THREAD_VARIABLES

#: Verbs by what a person wants, in the order that ``--help`` shows them, each with examples.
VERBS: dict[str, dict[Callable[..., None], tuple[str, ...]]] = {
    "Start": {
        start.demo: ("inflight demo", "inflight demo somewhere --days 10"),
        start.new: ("inflight new", "inflight new template my-mission", "inflight new champ my-champ"),
        start.simulate: ("inflight simulate -w my-champ --days 60", "inflight simulate --hide day_night"),
    },
    "Calibrate": {
        processing.ingest: (
            "inflight ingest",
            "inflight ingest /deliveries/2005",
            "inflight ingest fgm/champ_fgm_20050101_v01.cdf",
        ),
        processing.reprocess: (
            "inflight reprocess",
            "inflight reprocess --start 2005-01-01 --end 2005-02-01",
            "inflight reprocess --table continuous",
        ),
        processing.update: ("inflight update", "inflight update --data /deliveries"),
        processing.backfill: ("inflight backfill --start 2005-01-01 --end 2005-02-01 --dry-run",),
        results.chain: ("inflight chain --html chain.html",),
    },
    "Find what is missing": {
        results.compare: ("inflight compare --open", "inflight compare --against 1"),
        diagnose.diagnose: ("inflight diagnose", "inflight diagnose --start 2005-01-01 --end 2005-02-01"),
        diagnose.add: (
            'inflight add "channel_field(heater_current)"',
            "inflight add offset_step@2005-01-12",
            "inflight add effect.yaml",
        ),
        diagnose.drop: ("inflight drop channel_field_heater_current",),
        diagnose.refit: ("inflight refit temperature.linear",),
        diagnose.set_: ('inflight set "temperature.lag=100s"',),
        diagnose.undo: ("inflight undo",),
        diagnose.auto: ("inflight auto",),
    },
    "Look": {
        results.report: ("inflight report --open",),
        results.explore: ("inflight explore",),
        figures.figures: ("inflight figures",),
    },
    "Deliver": {
        results.release: (
            'inflight release 1.0 --notes "first release"',
            "inflight release 1.0 --format cdf --format netcdf --dry-run",
        ),
        results.serve: ("inflight serve", "inflight serve releases/1.0 --host 0.0.0.0 --port 8000"),
    },
}

app = typer.Typer(
    name="inflight",
    help="In-flight calibration of magnetometers: day files in, calibration tables and products out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done with days missing.",
)
for panel, verbs in VERBS.items():
    for function, examples in verbs.items():
        verb(app, function.__name__.rstrip("_"), panel, examples)(function)
app.add_typer(models.group, name="model", rich_help_panel="Look")
catalog.group.add_typer(contexts.group, name="context")
app.add_typer(catalog.group, name="catalog", rich_help_panel="Look")


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
    gc.set_threshold(OBJECTS_TO_COLLECT)
    # Numpy reads these once, when it is imported: no verb imports it before. Who sets one has it so.
    for name, threads in ONE_THREAD_VARIABLES.items():
        os.environ.setdefault(name, threads)
    # What there is at the end ends with the process: looking for cycles in it would take a second.
    atexit.register(gc.freeze)
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
