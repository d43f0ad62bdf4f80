"""A month through the front door and every verb of the command line, against rivals of the same run."""

from __future__ import annotations

import datetime as dt
import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from benchmarks.measured import Row, command, first_time
from benchmarks.rivals import (
    copy_file,
    decoded,
    files_of,
    measure_rivals,
    naive_ingest,
    start_up,
    start_up_floor,
)
from inflight.catalog import Catalog, Workspace
from inflight.simulate import SimulationSettings
from inflight.tasks.archive import simulate

#: Asked of Prefect: at most so much of a run, or so many seconds, whichever is larger.
_PREFECT = "10 % or 3 s"
_FIRST = dt.date(2005, 1, 1)


def month(days: int = 30, repeats: int = 3) -> Iterator[Row]:
    """Yield the rows of a month at 1 Hz, 25 channels in 6 CDF files a day, with an effect hidden in it."""
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace.create(Path(scratch) / "w", "champ")
        empty = Workspace.create(Path(scratch) / "empty", "champ").root
        root = workspace.root
        simulate(SimulationSettings(start=_FIRST, days=days, hide=["day_night"]), workspace.data)
        little = start_up()
        for row in (
            command("inflight --help", ["--help"], root, repeats),
            command("a wrong folder", ["-w", "nowhere", "compare"], root, repeats, fails=True),
            command("an empty archive: diagnose", ["diagnose"], empty, repeats, fails=True),
        ):
            yield replace(row, aim="0.3 s" if row.what.endswith("--help") else "1 s", **little)
        yield from _ingest(workspace, Path(scratch), days, repeats)
        shown = command("catalog list", ["catalog", "list"], root, repeats)
        yield replace(shown, aim="1 s", **little)
        yield from _verbs(workspace, days, repeats)
        yield from _update(workspace, Path(scratch), days, repeats)


def _ingest(workspace: Workspace, scratch: Path, days: int, repeats: int) -> Iterator[Row]:
    """Yield the rows of taking files in, and of finding nothing new."""
    copied = files_of(workspace.data, copy_file, scratch / "copied")
    naive = files_of(workspace.data, naive_ingest, scratch / "naive")
    hashed = files_of(workspace.data, lambda path, _: hashlib.sha256(path.read_bytes()).digest(), scratch)
    shutil.rmtree(scratch / "copied")
    shutil.rmtree(scratch / "naive")
    against = {"naive_s": naive, "naive": "ingest: cdflib reads each file, xarray.to_zarr writes it"}
    row = first_time(f"ingest, {days} days", ["ingest"], workspace.root, repeats)
    floor = "ingest: cdflib reads the files, zarr writes the same arrays"
    yield replace(row, floor_s=copied, floor=floor, aim="2 floors + 2 s", **against)
    row = command("ingest, nothing new", ["ingest"], workspace.root, repeats)
    floor = "ingest, nothing new: sha256 of the files"
    yield replace(row, floor_s=hashed, floor=floor, aim="3 s", **against)


def _verbs(workspace: Workspace, days: int, repeats: int) -> Iterator[Row]:
    """Yield the rows of reprocess, compare and diagnose, and what Prefect costs of the first and the last."""
    root, cat = workspace.root, Catalog(workspace.root)
    plain = first_time(
        f"reprocess, {days} days, --no-prefect", ["reprocess", "--no-prefect"], root, repeats, undone=True
    )
    usual = first_time(f"reprocess, {days} days", ["reprocess"], root, repeats)
    rivals = measure_rivals(cat)
    yield replace(usual, aim="2 floors + 2 s", **rivals.of_reprocess())
    yield replace(plain, **rivals.of_reprocess())
    yield prefect_share("reprocess", usual, plain)
    nothing = command("reprocess, nothing to do", ["reprocess"], root, repeats)
    yield replace(nothing, aim="1.5 s", **rivals.of_reprocess() | start_up_floor())
    row = first_time("compare, first time", ["compare"], root, repeats)
    yield replace(row, aim="5 s", **rivals.of_compare())
    row = command("compare again", ["compare"], root, repeats)
    yield replace(row, aim="5 s", **rivals.of_compare())
    plain = first_time("diagnose, --no-prefect", ["diagnose", "--no-prefect"], root, repeats, undone=True)
    usual = first_time("diagnose, first time", ["diagnose"], root, repeats)
    yield replace(usual, **rivals.of_diagnose())
    yield replace(plain, **rivals.of_diagnose())
    yield prefect_share("diagnose", usual, plain)
    yield replace(
        command("diagnose again", ["diagnose"], root, repeats),
        aim="3 s",
        **rivals.of_diagnose() | start_up_floor(),
    )
    blocks = decoded(cat, cat.days("equations/main/library", states=("published",)))
    yield replace(
        first_time("diagnose --search again", ["diagnose", "--search"], root, repeats, undone=True),
        aim="3 s",
        **rivals.of_diagnose()
        | {"floor_s": blocks, "floor": "diagnose --search again: the statistics decoded"},
    )


def _update(workspace: Workspace, scratch: Path, days: int, repeats: int) -> Iterator[Row]:
    """Yield the rows of a new day, and what Prefect costs of it."""
    root, new = workspace.root, scratch / "new"
    simulate(SimulationSettings(start=_FIRST + dt.timedelta(days=days), days=1, hide=["day_night"]), new)
    floor, naive = (files_of(new, work, scratch) for work in (copy_file, naive_ingest))
    against = measure_rivals(Catalog(root)).of_update(floor, naive, days)
    shutil.copytree(new, workspace.data, dirs_exist_ok=True)
    plain = first_time("update, --no-prefect", ["update", "--no-prefect"], root, repeats, undone=True)
    usual = first_time("update: a new day, from file to verdict", ["update"], root, repeats)
    yield replace(usual, aim="10 s", **against)
    yield replace(plain, **against)
    yield prefect_share("update", usual, plain)


def prefect_share(verb: str, usual: Row, plain: Row) -> Row:
    """Return the row of what Prefect costs of a verb: the difference of medians with and without it, s."""
    cost = usual.median - plain.median
    return Row(what=f"{verb}: of it Prefect's", amount=cost, whole=usual.median, unit="s", aim=_PREFECT)
