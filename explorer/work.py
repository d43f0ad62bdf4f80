"""Reprocessing, backfills and releases asked for on the page: planned, then done by a process of their own.

In go a `WorkRequest` and a workspace; out come `WorkPlan`, what ``--dry-run`` of the verb tells, and fields
of a `RunReport`. The work is done by another process (`InOwnProcess`), so that the page answers meanwhile and
the work can be stopped as by Ctrl-C: what is published stays as it was.
"""

from __future__ import annotations

import datetime as dt
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from inflight.catalog import Catalog, Workspace
from inflight.errors import InflightError, SettingsError, WorkerError
from inflight.flows import plan_lines, plan_span, run_without_prefect
from inflight.progress import Progress
from inflight.tasks import plan_release
from inflight.tasks.archive import ingest_if_unchanged

#: Seconds after which work that was stopped is killed.
_PATIENCE_S = 20.0


@dataclass(frozen=True)
class WorkRequest:
    """What is asked for: a verb with its options.

    Attributes
    ----------
    verb : {'reprocess', 'backfill', 'release'}
    start, end : str or None
        UTC days, half-open; of a reprocessing None is all there is on that side.
    settings : mapping
        Of `ReprocessSettings`.
    reason : str
        Why; of a release its notes.
    niceness : int
        How far the processes of a backfill stand behind others.
    version, formats, maturity
        Of a release, as `make_release` takes them.
    """

    verb: Literal["reprocess", "backfill", "release"]
    start: str | None = None
    end: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""
    niceness: int = 0
    version: str = ""
    formats: tuple[str, ...] = ("zarr",)
    maturity: str = "preliminary"

    @property
    def name(self) -> str:
        """What the page calls it."""
        if self.verb == "release":
            return f"Release {self.version}"
        last = str(dt.date.fromisoformat(self.end) - dt.timedelta(days=1)) if self.end else "the last day"
        return f"{self.verb.capitalize()} {self.start or 'from the first day'} to {last}"

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the step behind the verb, the workspace excepted."""
        if self.verb == "release":
            notes = {"version": self.version, "notes": self.reason}
            return {**notes, "formats": self.formats, "maturity": self.maturity}
        given = {"start": self.start, "end": self.end, "settings": dict(self.settings), "reason": self.reason}
        return given | ({"niceness": self.niceness} if self.verb == "backfill" else {})


@dataclass(frozen=True)
class WorkPlan:
    """What a request would do.

    Attributes
    ----------
    request : WorkRequest
    fields : mapping
        As `plan_span` or `plan_release`; empty when only the work itself can tell.
    lines : sequence of str
        The plan in words.
    objections : sequence of mapping
        What stands against it: the fields of an error each.
    """

    request: WorkRequest
    fields: Mapping[str, Any]
    lines: Sequence[str]
    objections: Sequence[Mapping[str, str]] = ()


def plan_work(workspace: Workspace, request: WorkRequest) -> WorkPlan:
    """Return what a request would do, as ``--dry-run`` of its verb; nothing is written.

    Raises
    ------
    SettingsError, CatalogError
        When an option is wrong, or nothing is there to be worked on.
    """
    if request.verb == "release":
        if not request.version.strip():
            raise SettingsError("a release needs a version", remedy="write one, such as 1.0")
        fields = plan_release(workspace, request.version, request.formats, request.maturity)
        return WorkPlan(request, fields, list(_release_lines(fields)), fields["objections"])
    if request.verb == "backfill" and not (request.start and request.end):
        raise SettingsError("a backfill needs its first and its last day", remedy="choose both")
    fields = plan_span(workspace, request.start, request.end, request.settings)
    lines = list(plan_lines(request.verb, request.start, request.end, fields))
    if not fields["cost"] and fields["days"]["planned"]:
        lines.append("  what it costs is known once a first run was made")
    lines += [f"  {first} to {last}  ({count} days)" for first, last, count in fields["batches"]]
    if request.verb == "backfill" and _has_deliveries(workspace, request):
        lines.append(
            "files were delivered that are not in the archive: they are taken in first, and may add days"
        )
    return WorkPlan(request, fields, lines)


def _has_deliveries(workspace: Workspace, request: WorkRequest) -> bool:
    """Return True when an ingest of the span would have something to do; no file is opened."""
    cat, span = Catalog(workspace.root), (request.start, request.end)
    return ingest_if_unchanged(cat, workspace.mission(), workspace.data, None, *span) is None


def _release_lines(fields: Mapping[str, Any]) -> Sequence[str]:
    parts, size = fields["parts"], sum(part["bytes"] for part in fields["parts"])
    lines = [
        f"release {fields['version']} ({fields['maturity']}): {sum(part['days'] for part in parts)} days in "
        f"{sum(part['files'] for part in parts)} files, {size / 1e6:.1f} MB, and {fields['tables']} "
        "calibration tables",
        *(
            f"  {part['dataset']}: {part['first']} to {part['last']}, {part['days']} days, {part['missing']} "
            f"missing; {part['format']}, {part['bytes'] / 1e6:.1f} MB"
            for part in parts
        ),
    ]
    if fields["previous"]:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(fields["changes"].items()))
        lines.append(f"days against release {fields['previous']}: {counts or 'all the same'}")
    if fields["next_version"]:
        lines.append(f"by the rule of versions the next one is {fields['next_version']}")
    return lines


class InOwnProcess:
    """Does one request in a process of its own; `log` has a line for each stage.

    Parameters
    ----------
    root : Path
        Of the workspace.
    request : WorkRequest
    workers : int, optional
        Dask processes; the cores when absent.
    """

    def __init__(self, root: Path, request: WorkRequest, workers: int | None) -> None:
        # A release copies: it takes no processes.
        processes = None if request.verb == "release" else workers
        self._arguments = (request.verb, root, request.parameters(), processes)
        self._process: Any = None
        self._stopped = threading.Event()
        self.request = request
        self.log: list[str] = []

    def __call__(self, progress: Progress) -> dict[str, Any]:
        """Do it and return the fields of its report.

        Raises
        ------
        InflightError
            What the step raised; `WorkerError` when its process ended without a word, or was stopped.
        """
        if self._stopped.is_set():
            raise self._interrupted()
        here = multiprocessing.get_context("spawn")
        receiver, sender = here.Pipe(duplex=False)
        self._process = here.Process(target=_run_step, args=(sender, os.getpid(), *self._arguments))
        self._process.start()
        sender.close()
        try:
            return self._follow(receiver, progress)
        finally:
            self._process.join()
            receiver.close()

    def stop(self) -> None:
        """Interrupt the work, as Ctrl-C does; what is published stays as it was."""
        self._stopped.set()
        process = self._process
        if process is None or not process.is_alive():
            return
        os.kill(process.pid, signal.SIGINT)
        killer = threading.Timer(_PATIENCE_S, process.kill)
        killer.daemon = True
        killer.start()

    def _follow(self, receiver: Connection, progress: Progress) -> dict[str, Any]:
        while True:
            try:
                kind, told = receiver.recv()
            except EOFError:
                break
            if kind == "progress":
                self._note(*told)
                progress(*told)
            elif kind == "done":
                return dict(told)
            else:
                raise told
        if self._stopped.is_set():
            raise self._interrupted()
        raise WorkerError(
            f"the process of '{self.request.name}' ended before the work did",
            remedy="look for what ended it, most often too little memory; the same goes on where it was",
        )

    def _note(self, stage: str, done: int, total: int) -> None:
        if done in (0, total):
            now = f"{dt.datetime.now(dt.UTC):%Y-%m-%d %H:%M:%S}"
            self.log.append(f"{now}  {stage}: {'begins' if done == 0 else 'done'}, {done} of {total}")

    def _interrupted(self) -> InflightError:
        return WorkerError(
            f"'{self.request.name}' was stopped; what is published is unchanged",
            remedy="Start again goes on where it was",
        )


def _run_step(
    sender: Connection, parent: int, verb: str, root: Path, parameters: dict[str, Any], workers: int | None
) -> None:
    """Do the work of a request in this process, and send its progress and its report."""
    # A page that a script began behind it was told to ignore interrupts, and so were its processes: this one
    # is stopped by them.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()

    def progress(stage: str, done: int, total: int) -> None:
        sender.send(("progress", (stage, done, total)))

    try:
        report = run_without_prefect(
            verb, Workspace.open(root), parameters, workers=workers, progress=progress
        )
        sender.send(("done", report.as_json()))
    except InflightError as error:
        sender.send(("error", error))
    except Exception as error:
        traceback.print_exc()
        sender.send(("error", RuntimeError(f"{type(error).__name__}: {error}")))
    except KeyboardInterrupt:
        pass
    finally:
        sender.close()


def _end_with(parent: int) -> None:
    """Interrupt this process when the one that began it is gone: nobody would see how it ends."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGINT)
