"""How time and memory grow with the mission: 30 to 3000 days, written into the archive directly.

At 1 Hz, or with a vector magnetometer of so many readings a second (`growth` with `vector_hz`).
"""

from __future__ import annotations

import datetime as dt
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.archive import simulated_workspace
from benchmarks.measured import Row, command, timed
from benchmarks.search import evidence_pass
from inflight.catalog import Catalog, Workspace
from inflight.simulate import SimulationSettings
from inflight.tasks import Workbench
from inflight.tasks.archive import simulate
from inflight.threads import one_thread

#: What a mission of so many days has to stay below: (days, verb) -> s.
_AIMS = {(3000, "reprocess"): "600 s, 2048 MiB", (3000, "diagnose, first time"): "900 s, 2048 MiB"}


def growth(
    days: Sequence[int], keep: Path | None = None, one_process_up_to: int = 100, vector_hz: int = 0
) -> Iterator[Row]:
    """Yield the rows of each length of the record, as they are measured.

    Parameters
    ----------
    days : sequence of int
    keep : Path, optional
        Folder of the simulated archives, made once and kept.
    one_process_up_to : int
        Records of so many days are reprocessed with one process, too.
    vector_hz : int
        Readings of the vector magnetometer a second; 0 is 1 Hz.
    """
    with tempfile.TemporaryDirectory() as scratch:
        for count in days:
            source = (keep or Path(scratch)) / f"archive-{count}{f'-{vector_hz}-Hz' if vector_hz else ''}"
            simulated_workspace(source, count, vector_hz=vector_hz)
            for row in _rows(source, Path(scratch), count, one_process_up_to, vector_hz):
                yield replace(row, what=f"{vector_hz} Hz, {row.what}") if vector_hz else row


def _rows(source: Path, scratch: Path, days: int, one_process_up_to: int, vector_hz: int) -> Iterator[Row]:
    for processes in (1, 2):
        if processes == 1 and days > one_process_up_to:
            continue
        folder = scratch / f"{days}-{processes}"
        shutil.copytree(source, folder, symlinks=True)
        arguments = ["reprocess", "--workers", str(processes)]
        row = command(f"{days} days: reprocess, {processes} process(es)", arguments, folder)
        yield replace(row, aim=_AIMS.get((days, "reprocess"), "") if processes == 2 else "")
        if processes == 1:
            shutil.rmtree(folder)
    size = _stored(folder, "l2/field") / days
    yield replace(evidence_pass(Catalog(folder)), aim="0.3 s")
    row = command(f"{days} days: diagnose, first time", ["diagnose"], folder)
    yield replace(row, aim=_AIMS.get((days, "diagnose, first time"), ""))
    yield command(f"{days} days: diagnose again", ["diagnose"], folder)
    kept = _stored(folder, "equations/main/library") / days
    print(f"{days} days: statistics {kept / 1e6:.2f} MB a day, product {size / 1e6:.2f} MB a day", flush=True)
    # Before the model has other versions, of which no day is yet.
    if not vector_hz:
        yield _new_day(folder, days)
    yield from _loop(folder, days)
    yield command(f"{days} days: compare", ["compare"], folder)
    # Statistics of another kind and other products: nothing of the first reprocess serves it.
    row = command(f"{days} days: reprocess, all days at once", ["reprocess", "--table", "continuous"], folder)
    yield replace(row, aim=_AIMS.get((days, "reprocess"), ""))
    shutil.rmtree(folder)


def _loop(folder: Path, days: int) -> Iterator[Row]:
    """Yield the rows of adding and dropping an effect, the statistics in memory."""
    workspace = Workspace.open(folder)
    with one_thread():
        bench = Workbench(Catalog(folder), workspace.mission())
        added, dropped = [], []
        for _ in range(3):
            added += timed(lambda: bench.add("day_night"))
            dropped += timed(bench.undo)
    yield Row(what=f"{days} days: add an effect", seconds=added, aim="0.5 s")
    yield Row(what=f"{days} days: undo", seconds=dropped, aim="0.5 s")


def _new_day(folder: Path, days: int) -> Row:
    """Return the row of one more day, delivered as files: taken in, calibrated, and the verdict with it."""
    day = SimulationSettings().start + dt.timedelta(days=days)
    simulate(SimulationSettings(start=day, days=1), Workspace.open(folder).data, workers=1)
    row = command(f"{days} days: a new day, from file to verdict", ["update"], folder)
    return replace(row, aim="10 s")


def _stored(folder: Path, name: str) -> int:
    """Return the bytes of a dataset's stores."""
    stores = {day.segment for day in Catalog(folder).days(name, states=("published",))}
    return sum(
        path.stat().st_size for store in stores for path in (folder / store).rglob("*") if path.is_file()
    )
