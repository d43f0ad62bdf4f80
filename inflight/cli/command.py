"""What every verb shares: the common options, progress, output and the way errors end a command.

Standard output carries the result alone (one JSON object with ``--json``); progress goes to the
standard error stream, and only where a person watches it.
"""

from __future__ import annotations

import functools
import inspect
import os
import signal
import sys
import textwrap
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.errors import SettingsError, WorkspaceError
from inflight.progress import Progress, silent
from inflight.tasks import as_settings_error, error_fields, location_of

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    from inflight.catalog import Catalog, Workspace
    from inflight.tasks import RunReport

WorkspaceOption = Annotated[
    Path | None,
    typer.Option("--workspace", "-w", help="Folder of the mission (default: .)", show_default=False),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
DebugOption = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]

EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 1, 2, 130
#: Columns of a table that no terminal shows.
PIPED_WIDTH = 200


@dataclass(frozen=True)
class Command:
    """One command being carried out.

    Parameters
    ----------
    workspace : Path
        The folder to work in; it is not read yet.
    json, debug : bool
        The options of the same names.
    """

    workspace: Path = Path()
    json: bool = False
    debug: bool = False

    def open_workspace(self) -> Workspace:
        """Return the workspace; a folder that is none raises `WorkspaceError`."""
        from inflight.catalog import Workspace

        return Workspace.open(self.workspace)

    def open_catalog(self) -> Catalog:
        """Return the catalog of the workspace; a folder that is none raises `WorkspaceError`."""
        from inflight.catalog import Catalog

        return Catalog(self.open_workspace().root, create=True)

    @property
    def console(self) -> Console:
        """Where results for a person go."""
        from rich.console import Console

        # Into a file or a pipe, lines stay whole: a path folded over three lines is found by no search.
        has_width = sys.stdout.isatty() or "COLUMNS" in os.environ
        return Console(highlight=False, width=None if has_width else PIPED_WIDTH)

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Yield a function ``(stage, done, total)``: a bar a stage with its rate, elapsed and remaining time.

        Where standard error is no terminal, a long stage writes a line now and then; with ``--json`` nothing.
        """
        if self.json:
            yield silent
            return
        if not sys.stderr.isatty():
            yield _ProgressLines()
            return
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.progress import Progress as Bars

        class Rate(TextColumn):
            """How many of a stage are done in a second."""

            def render(self, task: Any) -> Any:
                self.text_format = f"{task.speed:.1f}/s" if task.speed and task.total > 1 else ""
                return super().render(task)

        columns = (
            TextColumn("{task.description:<12}"),
            BarColumn(),
            MofNCompleteColumn(),
            Rate(""),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        with Bars(*columns, console=Console(stderr=True)) as bars:
            tasks: dict[str, Any] = {}

            def show(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=total)
                elif not done:
                    bars.reset(tasks[stage])
                bars.update(tasks[stage], completed=done, total=total)

            yield show

    def emit(self, fields: Mapping[str, Any], show: Callable[[Console], None]) -> None:
        """Print a result: the fields with ``--json``, else whatever `show` prints."""
        if self.json:
            from inflight.tasks import to_json

            print(to_json(fields))
        else:
            show(self.console)

    def finish(
        self,
        report: RunReport,
        remarks: Iterable[str] = (),
        details: bool = False,
        then: Callable[[Console], None] | None = None,
    ) -> None:
        """Print a run's report, and remarks on it for a person; end the command with its exit code.

        With `details` every finding is listed, those of one kind, too. `then` prints what else a person is
        told.
        """
        from inflight.tasks import print_report

        def show(console: Console) -> None:
            print_report(report, console, details)
            for remark in remarks:
                console.print(f"  {remark}", soft_wrap=True, markup=False)
            if then is not None:
                then(console)

        self.emit(report.as_json(), show)
        if report.exit_code:
            raise typer.Exit(report.exit_code)

    def fail(self, fields: Mapping[str, str]) -> None:
        """Print an error: an object with ``--json``, else one red paragraph with its remedy."""
        if self.json:
            from inflight.tasks import to_json

            print(to_json({"error": fields}))
            return
        from rich.console import Console
        from rich.text import Text

        place = location_of(fields)
        console = Console(stderr=True, highlight=False, soft_wrap=True)
        console.print(Text(f"{place}: {fields['message']}" if place else fields["message"], style="red"))
        if fields.get("remedy"):
            console.print(Text(f"What to do: {fields['remedy']}"))


class _ProgressLines:
    """Progress as lines, for logs: one as soon as a stage's rate is known, then at most four a minute.

    A stage of a single step has no rate: its line says that it runs.
    """

    def __init__(self) -> None:
        self._stage, self._done, self._begun, self._next = "", 0, 0.0, 0.0
        self._said = set[str]()

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        # A stage may begin again: of another table, or of another pass.
        begins = stage != self._stage or done < self._done
        self._stage, self._done = stage, done
        if begins:
            self._begun, self._next = now, now + _FIRST_LINE_S
            if not done and total == 1 and stage not in self._said:
                # One step, of which nothing is known before it ends: that it runs is all there is to say.
                self._said.add(stage)
                print(f"{stage}: running", file=sys.stderr, flush=True)
        if now < self._next or not 0 < done < total:
            return
        self._next = now + _LINE_EVERY_S
        rate = done / (now - self._begun)
        left = (total - done) / rate
        print(f"{stage}: {done} of {total}, {rate:.2g}/s, {left:.0f} s left", file=sys.stderr, flush=True)


#: Seconds after which a stage writes its first line where there is no terminal, and between two lines.
_FIRST_LINE_S, _LINE_EVERY_S = 2.0, 15.0


@dataclass(frozen=True)
class TextTable:
    """A table without lines that breaks no word: names, times and commands stay whole in any window.

    Where the rows do not fit, first the headings are folded, then the cells that may be; where not even
    single words fit, each row becomes a paragraph of ``heading: cell``.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str | Text, ...], ...]
    right: frozenset[str]
    folded: frozenset[str]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | Text | Padding]:
        """Yield the table, or the paragraphs that take its place in a narrow window."""
        cells = [
            [str(row[at]) if at < len(row) else "" for row in self.rows] for at in range(len(self.columns))
        ]
        natural = [max(map(len, cell), default=0) for cell in cells]
        least = [
            max(map(_longest_word, cell), default=0) if name in self.folded else width
            for name, cell, width in zip(self.columns, cells, natural, strict=True)
        ]
        room = options.max_width - 2 * (len(self.columns) - 1)
        if sum(max(width, len(name)) for name, width in zip(self.columns, natural, strict=True)) <= room:
            yield self._table(self.columns, least)
            return
        heads = [
            "\n".join(textwrap.wrap(name, max(width, _longest_word(name), 1), break_long_words=False))
            for name, width in zip(self.columns, natural, strict=True)
        ]
        least = [max(width, _longest_word(head)) for width, head in zip(least, heads, strict=True)]
        for gap in (2, 1):
            if sum(least) + gap * (len(self.columns) - 1) <= options.max_width:
                yield self._table(heads, least, gap)
                return
        for row in self.rows:
            yield from self._paragraph(row)

    def _table(self, heads: Sequence[str], least: Sequence[int], gap: int = 2) -> Table:
        from rich.table import Table

        table = Table(box=None, pad_edge=False, padding=(0, 1, 0, gap - 1))
        for name, head, width in zip(self.columns, heads, least, strict=True):
            table.add_column(
                head,
                justify="right" if name in self.right else "left",
                overflow="fold",
                no_wrap=name not in self.folded,
                min_width=width,
            )
        for row in self.rows:
            table.add_row(*map(_as_text, row))
        return table

    def _paragraph(self, row: Sequence[str | Text]) -> Iterator[Text | Padding]:
        """Yield the first cell of a row, and below it the others with their headings."""
        from rich.padding import Padding
        from rich.text import Text

        first, *others = [
            Text(f"{name}: " if name else "") + cell if (cell := _as_text(part)).plain else Text()
            for name, part in zip(self.columns, row, strict=False)
        ]
        if first.plain:
            yield first
        if parts := [part for part in others if part.plain]:
            yield Padding(Text(", ").join(parts), (0, 0, 0, 2))


def _as_text(cell: str | Text) -> Text:
    from rich.text import Text

    return Text(cell) if isinstance(cell, str) else cell


def _longest_word(text: str) -> int:
    return max(map(len, text.split()), default=0)


def text_table(
    columns: Sequence[str],
    rows: Iterable[Iterable[str | Text]],
    *,
    right: Sequence[str] = (),
    folded: Sequence[str] | None = None,
) -> TextTable:
    """Return a table without lines; cells are shown as they are, without markup.

    Parameters
    ----------
    columns : sequence of str
        Headings.
    rows : iterable of iterable of str
        Cells.
    right : sequence of str
        Columns set flush right.
    folded : sequence of str, optional
        Columns whose cells may be folded between words; all when absent.
    """
    foldable = frozenset(columns if folded is None else folded)
    return TextTable(tuple(columns), tuple(map(tuple, rows)), frozenset(right), foldable)


def exit_code_of(error: Exception) -> int:
    """Return 2 for errors of the person who typed the command, 1 for everything else."""
    wrong_usage = isinstance(as_settings_error(error), SettingsError | WorkspaceError)
    return EXIT_USAGE if wrong_usage else EXIT_FAILED


def run_verb(command: Command, work: Callable[[], None]) -> None:
    """Run a verb; turn whatever it raises into a message and an exit code.

    An `InflightError` is printed as it is. Anything else is a defect of the software and reported as
    one, with the traceback when ``--debug`` asks for it. After Ctrl-C any error counts as the
    interruption: the embedded server and the Dask processes receive it, too, and may end first.
    """
    interrupted = threading.Event()
    with _noting_interruption(interrupted):
        try:
            work()
        except (typer.Exit, typer.Abort, typer.TyperException):
            raise
        except (Exception, KeyboardInterrupt) as error:
            if command.debug:
                traceback.print_exc()
            if interrupted.is_set() or not isinstance(error, Exception):
                command.fail(_INTERRUPTED)
                raise typer.Exit(EXIT_INTERRUPTED) from None
            command.fail(error_fields(error))
            raise typer.Exit(exit_code_of(error)) from None


@contextmanager
def _noting_interruption(interrupted: threading.Event) -> Iterator[None]:
    """Set the event when Ctrl-C is pressed, whatever becomes of the exception it raises."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


_INTERRUPTED = {
    "kind": "Interrupted",
    "message": "interrupted; what is published is unchanged",
    "remedy": "the same command goes on where it was",
    "file": "",
    "channel": "",
    "day": "",
}


def verb(
    app: typer.Typer, name: str, panel: str | None = None, examples: Sequence[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function ``(command, ...)`` as a verb that also takes the common options.

    The options are accepted before and behind the verb; behind wins. Typer reads parameters from
    the signature, so the common ones are appended to it here, once. `panel` is the group the verb stands in.
    """
    epilog = "\n\n".join(["Examples:", *examples]) if examples else None

    def register(function: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(function, eval_str=True).parameters.values())[1:]

        @functools.wraps(function)
        def invoke(
            *, context: typer.Context, workspace: Path | None, json: bool, debug: bool, **arguments: Any
        ) -> None:
            before: Command = context.obj or Command()
            command = Command(workspace or before.workspace, json or before.json, debug or before.debug)
            run_verb(command, lambda: function(command, **arguments))

        parameters = [_parameter("context", typer.Context), *own, *_COMMON]
        parameters = [item.replace(kind=inspect.Parameter.KEYWORD_ONLY) for item in parameters]
        invoke.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        invoke.__annotations__ = {item.name: item.annotation for item in parameters}
        # A line of the source ends no line of the help: its window has another width.
        paragraphs = inspect.cleandoc(function.__doc__ or "").split("\n\n")
        text = "\n\n".join(" ".join(one.split()) for one in paragraphs)
        app.command(name, help=text, rich_help_panel=panel, epilog=epilog)(invoke)
        return function

    return register


def _parameter(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


_COMMON = (
    _parameter("workspace", WorkspaceOption, None),
    _parameter("json", JsonOption, False),
    _parameter("debug", DebugOption, False),
)
