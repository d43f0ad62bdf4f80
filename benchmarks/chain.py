"""The whole chain of a mission: time and memory from archive to tables and products, and their floor."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

from benchmarks.archive import simulated_workspace
from benchmarks.pipeline import clone
from inflight.catalog import Catalog, Workspace
from inflight.flows import dask_client
from inflight.tasks.pipelines import ReprocessSettings, reprocess

#: The model that holds everything the simulator puts in.
MODEL = "champ-chain.yaml"


def whole_chain(days: int, keep: Path | None = None, workers: int = 2) -> list[str]:
    """Return lines: the chain over so many days at 1 Hz, its parts, its memory, and the floor.

    Parameters
    ----------
    keep : Path, optional
        Folder of the simulated archive, made once and kept.
    """
    with tempfile.TemporaryDirectory() as scratch:
        source = keep or Path(scratch) / "archive"
        simulated_workspace(source, days, "2000-08-01", model=MODEL)
        folder = Path(scratch) / "run"
        clone(source, folder)
        command = [sys.executable, "-m", "benchmarks.chain", str(folder), str(workers)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        measured = json.loads(done.stdout.strip().splitlines()[-1])
        floor = _floor(folder)
    stages = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in measured["stages"].items())
    return [
        f"the whole chain, {days} days at 1 Hz, {workers} processes: {measured['seconds']:.0f} s "
        f"({measured['seconds'] / days * 1e3:.0f} ms a day; {stages})",
        f"  3000 days at this pace: {measured['seconds'] / days * 50:.0f} min (aim 10)",
        f"  peak {measured['MiB']:.0f} MiB, largest worker {measured['worker_MiB']:.0f} MiB (aim 2048)",
        f"  reading the input and copying the output once, one process: {floor:.0f} s; "
        f"ratio {measured['seconds'] / floor:.1f} (aim 2)",
        f"  residual {measured['before_nT']:.2f} -> {measured['after_nT']:.4f} nT",
    ]


def _floor(folder: Path) -> float:
    """Return the seconds of reading every day of the archive, decoded, and of writing the products' bytes."""
    cat = Catalog(folder)
    begun = time.perf_counter()
    for name in Workspace.open(folder).mission().instruments:
        for day in cat.days(f"l1/{name}", states=("published",)):
            cat.read(day, with_time=False)
    read = time.perf_counter() - begun
    stores = sorted({day.segment for day in cat.days("l2/field", states=("published",))})
    begun = time.perf_counter()
    for store in stores:
        for path in sorted((folder / store).rglob("*")):
            if path.is_file():
                (folder / "copy").write_bytes(path.read_bytes())
    return read + time.perf_counter() - begun


def _child(folder: str, workers: str) -> None:
    mission, stages = Workspace.open(folder).mission(), {}
    begun = last = time.perf_counter()

    def tell(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.perf_counter()
        stages[stage] = stages.get(stage, 0.0) + (now - last if done else 0.0)
        last = now

    with dask_client(int(workers)) if int(workers) > 1 else nullcontext() as client:
        settings = ReprocessSettings(table="continuous")
        report = reprocess(Catalog(Path(folder)), mission, settings=settings, client=client, progress=tell)
    measured = {"seconds": time.perf_counter() - begun, "stages": stages}
    measured["MiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    measured["worker_MiB"] = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(json.dumps(measured | report.extra["residual"]))


if __name__ == "__main__":
    _child(*sys.argv[1:3])
