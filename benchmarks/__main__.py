"""Print all benchmarks: nine, pipeline, front, search, chain (``python -m benchmarks --help``)."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path


def main() -> None:
    """Run the benchmarks named on the command line, or all."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description="Speed and memory of Inflight")
    parser.add_argument(
        "which",
        nargs="*",
        choices=["nine", "pipeline", "front", "search", "chain", []],
        help="all when absent",
    )
    parser.add_argument("--keep", type=Path, help="folder of the simulated archive, made once and kept")
    parser.add_argument("--days", type=int, default=90, help="days of the archive")
    given = parser.parse_args()
    which = given.which or ["nine", "pipeline", "front", "search", "chain"]

    from benchmarks.archive import simulated_workspace
    from benchmarks.chain import whole_chain
    from benchmarks.nine import nine_parameters
    from benchmarks.pipeline import front_door, memory_and_speed
    from benchmarks.search import evidence_pass, ranking

    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch) / "archive"
        if {"nine", "pipeline", "search"} & set(which):
            cat = simulated_workspace(folder, given.days)
        if "nine" in which:
            print("\n".join(nine_parameters(cat)), flush=True)
        if "pipeline" in which:
            print("\n".join(memory_and_speed(folder)), flush=True)
        if "search" in which:
            print("\n".join([*evidence_pass(cat), *ranking()]), flush=True)
        if "chain" in which:
            print("\n".join(whole_chain(given.days, folder.with_name(f"{folder.name}-chain"))), flush=True)
        if "front" in which:
            print("\n".join(front_door()), flush=True)


if __name__ == "__main__":
    main()
