"""How time and memory grow with the mission: 30 to 3000 days, written into the archive directly.

At 1 Hz, or with a vector magnetometer of so many readings a second (`growth` with `vector_hz`). Floors and
naive ways are measured on some days of each archive and scaled (`benchmarks.rivals`).
"""

from __future__ import annotations

import datetime as dt
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.archive import simulated_workspace
from benchmarks.measured import Row, command, first_time, in_process, timed
from benchmarks.rivals import (
    Rivals,
    copy_file,
    decoded,
    files_of,
    measure_rivals,
    naive_ingest,
    start_up_floor,
)
from benchmarks.search import evidence_pass, native_pass
from inflight.catalog import Catalog, Workspace
from inflight.flows.cluster import WORKERS_ENVIRONMENT
from inflight.simulate import SimulationSettings
from inflight.tasks import Workbench
from inflight.tasks.archive import simulate
from inflight.threads import one_thread

#: What a mission of so many days has to stay below: (days, verb) -> s.
_AIMS = {(3000, "reprocess"): "600 s, 2048 MiB", (3000, "diagnose"): "900 s, 2048 MiB"}
#: Records of so many days are measured three times.
_REPEATED_UP_TO = 100
#: An effect of the library that none of the simulated missions has.
_EFFECT = "day_night"


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
        Records of so many days are reprocessed and diagnosed with one process, too.
    vector_hz : int
        Readings of the vector magnetometer a second; 0 is 1 Hz.
    """
    with tempfile.TemporaryDirectory() as scratch:
        for count in days:
            source = (keep or Path(scratch)) / f"archive-{count}{f'-{vector_hz}-Hz' if vector_hz else ''}"
            simulated_workspace(source, count, vector_hz=vector_hz)
            folder = Path(scratch) / f"{count}"
            shutil.copytree(source, folder, symlinks=True)
            processes = (1, 2) if count <= one_process_up_to else (2,)
            for row in _rows(folder, count, processes, new_day=not vector_hz):
                what = f"{count} days: {row.what}"
                yield replace(row, what=f"{vector_hz} Hz, {what}" if vector_hz else what)
            shutil.rmtree(folder)


def _rows(folder: Path, days: int, processes: Sequence[int], *, new_day: bool) -> Iterator[Row]:
    repeats = 3 if days <= _REPEATED_UP_TO else 1
    cat = Catalog(folder)
    made = list(_by_processes("reprocess", folder, processes, repeats))
    rivals = measure_rivals(cat)
    for row in made:
        yield replace(row, aim=_AIMS.get((days, "reprocess"), ""), **rivals.of_reprocess())
    yield from in_process(evidence_pass, folder, rivals, environment=WORKERS_ENVIRONMENT)
    for row in _by_processes("diagnose", folder, processes, repeats):
        yield replace(row, aim=_AIMS.get((days, "diagnose"), ""), **rivals.of_diagnose())
    again = rivals.of_diagnose() | start_up_floor()
    yield replace(command("diagnose again", ["diagnose"], folder, 3), aim="3 s", **again)
    if days <= _REPEATED_UP_TO:
        row = command("diagnose --search, its statistics there", ["diagnose", "--search"], folder, repeats)
        yield replace(row, aim="3 s", **again)
    yield from in_process(native_pass, folder, rivals.align / days, environment=WORKERS_ENVIRONMENT)
    # Before the model has other versions, of which no day is yet.
    if new_day:
        yield _new_day(folder, days, repeats, rivals)
    yield from (replace(row, **rivals.of_change()) for row in in_process(_loop, folder))
    yield from _loop_by_command(folder, rivals)
    yield replace(first_time("compare, first time", ["compare"], folder, repeats), **rivals.of_compare())
    yield replace(command("compare again", ["compare"], folder, repeats), **rivals.of_compare())
    yield from _kept(folder)
    # Statistics of another kind and other products: nothing of the first reprocess serves it.
    arguments = ["reprocess", "--table", "continuous"]
    row = first_time("reprocess, all days at once", arguments, folder, repeats)
    yield replace(row, aim=_AIMS.get((days, "reprocess"), ""), **rivals.of_reprocess())


def _by_processes(verb: str, folder: Path, processes: Sequence[int], repeats: int) -> Iterator[Row]:
    """Yield the rows of a verb with some numbers of processes; what the last one made stays."""
    for count in processes:
        what = f"{verb}, {count} process{'es' if count > 1 else ''}"
        arguments = [verb, "--workers", str(count)]
        yield first_time(what, arguments, folder, repeats, undone=count != processes[-1])


def _kept(folder: Path) -> Iterator[Row]:
    """Yield the rows of what is kept of a day beside its product, MB."""
    cat = Catalog(folder)
    names = [name for name in cat.dataset_names() if not name.startswith(("l1/", "l2/"))]
    days = len(cat.days("l2/field", states=("published",)))
    product = _stored(cat, "l2/field") / days / 1e6
    size = {name: _stored(cat, name) / days / 1e6 for name in names}
    size = {name: one for name, one in size.items() if one} | {"all statistics": sum(size.values())}
    for name, one in size.items():
        yield Row(what=f"{name} kept a day", amount=one, whole=product, unit="MB", aim="100 % of the product")


def _loop(folder: Path) -> list[Row]:
    """Return the rows of changes of the model, the statistics in memory."""
    workspace, spent = Workspace.open(folder), dict[str, list[float]]()
    with one_thread():
        bench = Workbench(Catalog(folder), workspace.mission())
        for _ in range(3):
            for name, work in (
                ("preview an effect", lambda: bench.preview(_EFFECT)),
                ("add an effect", lambda: bench.add(_EFFECT)),
                ("drop it", lambda: bench.drop(_EFFECT)),
            ):
                spent.setdefault(name, []).extend(timed(work))
            bench.add(_EFFECT)
            spent.setdefault("undo", []).extend(timed(bench.undo))
    return [Row(what=name, seconds=seconds, aim="0.5 s") for name, seconds in spent.items()]


def _loop_by_command(folder: Path, rivals: Rivals) -> Iterator[Row]:
    """Yield the rows of the same by the command line, which reads the statistics each time."""
    cat = Catalog(folder)
    blocks = cat.days("equations/main/library", states=("published",))
    some = blocks[:: max(1, len(blocks) // 8)]
    floor = decoded(cat, some) * len(blocks) / len(some)
    against = rivals.of_change() | {
        "floor_s": floor,
        "floor": "inflight add, drop: the statistics decoded; some days, one core",
    }
    added, dropped = [], []
    for _ in range(3):
        added.append(command("inflight add", ["add", _EFFECT], folder))
        dropped.append(command("inflight drop", ["drop", _EFFECT], folder))
    for rows in (added, dropped):
        seconds = [second for row in rows for second in row.seconds]
        most, peaks = max(row.MiB for row in rows), max(row.peaks for row in rows)
        yield replace(rows[-1], seconds=seconds, MiB=most, peaks=peaks, **against)


def _new_day(folder: Path, days: int, repeats: int, rivals: Rivals) -> Row:
    """Return the row of one more day, delivered as files: taken in, calibrated, and the verdict with it."""
    day = SimulationSettings().start + dt.timedelta(days=days)
    with tempfile.TemporaryDirectory() as scratch:
        new = Path(scratch) / "new"
        simulate(SimulationSettings(start=day, days=1), new, workers=1)
        floor, naive = (files_of(new, work, Path(scratch)) for work in (copy_file, naive_ingest))
        shutil.copytree(new, Workspace.open(folder).data, dirs_exist_ok=True)
    row = first_time("a new day, from file to verdict", ["update"], folder, repeats)
    return replace(row, aim="10 s", **rivals.of_update(floor, naive, days))


def _stored(cat: Catalog, name: str) -> int:
    """Return the bytes of a dataset's stores."""
    stores = {day.segment for day in cat.days(name, states=("published",)) if day.segment}
    found = (path for store in stores for path in (cat.workspace / store).rglob("*") if path.is_file())
    return sum(path.stat().st_size for path in found)
