"""The whole chain: speed of each stage, memory with many and few days, parallel against serial."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from inflight.catalog import Catalog, Workspace
from inflight.flows import dask_client
from inflight.simulate import SimulationSettings
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess


def clone(source: Path, target: Path) -> Catalog:
    """Copy a workspace, so that a run starts from the archive alone."""
    shutil.copytree(source, target, symlinks=True)
    return Catalog(target)


def measured_reprocess(folder: Path, days: int, workers: int, batch_days: int) -> dict[str, float]:
    """Run one reprocess in a process of its own; return seconds and the peak memory of its processes."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.pipeline", str(folder), str(days), str(workers), str(batch_days)],
        check=True,
        capture_output=True,
        text=True,
    )
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _child(folder: str, days: str, workers: str, batch_days: str) -> None:
    cat = Catalog(Path(folder))
    mission = Workspace.open(folder).mission()
    first = cat.days("l1/fgm", states=("published",))[0].day
    end = first + np.timedelta64(int(days), "D")
    settings = ReprocessSettings(batch_days=int(batch_days))
    with dask_client(int(workers)) if int(workers) > 1 else nullcontext() as client:
        begun = time.perf_counter()
        report = reprocess(cat, mission, first, end, settings, client=client)
        seconds = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    measured = {"seconds": seconds, "MiB": peak, "worker_MiB": children, "done": report.days["done"]}
    print(json.dumps(measured | report.extra["residual"]))


def memory_and_speed(source: Path, workers: int = 2) -> list[str]:
    """Return lines: 30 and 90 days, serial and on `workers` processes."""
    lines = ["reprocess of simulated days, archive to products, batches of 10 days"]
    with tempfile.TemporaryDirectory() as scratch:
        for days, processes in ((30, 1), (90, 1), (90, workers)):
            folder = Path(scratch) / f"{days}-{processes}"
            clone(source, folder)
            measured = measured_reprocess(folder, days, processes, 10)
            lines.append(
                f"  {days:3d} days, {processes} process(es): {measured['seconds']:6.1f} s, "
                f"{measured['seconds'] / days * 1e3:5.0f} ms/day, peak {measured['MiB']:5.0f} MiB "
                f"(largest worker {measured['worker_MiB']:.0f} MiB), "
                f"residual {measured['before_nT']:.2f} -> {measured['after_nT']:.3f} nT"
            )
        same = fingerprints(Path(scratch) / "90-1") == fingerprints(Path(scratch) / f"90-{workers}")
        lines.append(f"  {workers} processes and one give the same bytes: {'yes' if same else 'NO'}")
    return lines


def fingerprints(folder: Path) -> list[str]:
    """Return the manifest hashes of all products and equations of a workspace."""
    cat = Catalog(folder)
    found = []
    for name in ("equations/main/base", "l2/field"):
        segments = sorted({day.segment for day in cat.days(name, states=("published",))})
        found += [(folder / segment / "MANIFEST.sha256").read_text(encoding="utf-8") for segment in segments]
    return sorted(found)


def front_door(days: int = 10) -> list[str]:
    """Return lines: delivering, taking in and reprocessing days as CDF files."""
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace.create(Path(scratch) / "w", "champ")
        cat, mission = Catalog(workspace.root), workspace.mission()
        times = [time.perf_counter()]
        simulate(SimulationSettings(start="2005-01-01", days=days), workspace.data)
        times.append(time.perf_counter())
        ingest(cat, mission, workspace.data)
        times.append(time.perf_counter())
        reprocess(cat, mission)
        times.append(time.perf_counter())
    each = np.diff(times) / days * 1e3
    return [
        f"through the front door, {days} days of CDF files",
        f"  simulate and write {each[0]:6.0f} ms/day, ingest {each[1]:6.0f} ms/day, "
        f"reprocess {each[2]:6.0f} ms/day",
    ]


if __name__ == "__main__":
    _child(*sys.argv[1:5])
