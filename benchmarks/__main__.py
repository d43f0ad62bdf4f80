"""Print all benchmarks, or those named: see ``python -m benchmarks --help``."""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

_ALL = ["nine", "pipeline", "front", "search", "chain", "spin_fits", "spin_eight"]


def main() -> None:
    """Run the benchmarks named on the command line, or all."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    parser = argparse.ArgumentParser(description="Speed and memory of Inflight")
    parser.add_argument(
        "which",
        nargs="*",
        choices=[*_ALL, []],
        help="all when absent",
    )
    parser.add_argument("--keep", type=Path, help="folder of the simulated archive, made once and kept")
    parser.add_argument("--days", type=int, default=90, help="days of the archive")
    given = parser.parse_args()
    which = given.which or _ALL

    from benchmarks.archive import simulated_workspace
    from benchmarks.chain import whole_chain
    from benchmarks.nine import nine_parameters
    from benchmarks.pipeline import front_door, memory_and_speed
    from benchmarks.search import evidence_pass, ranking
    from benchmarks.spin_eight import spin_eight
    from benchmarks.spin_fits import spin_fit_ratios

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
        if "spin_fits" in which:
            print("\n".join(spin_fit_ratios()), flush=True)
        if "spin_eight" in which:
            print("\n".join(spin_eight()), flush=True)
        if "front" in which:
            print("\n".join(front_door()), flush=True)


if __name__ == "__main__":
    main()
