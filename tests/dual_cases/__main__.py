"""The table of random two-sensor cases: ``python -m tests.dual_cases --cases 300 --first-seed 1000``.

Seeds below 1000 are for development.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.table import Table

from .scenarios import FAMILIES
from .score import Score, score_seed

#: From this ratio of the errors after and before on a correction made a case worse.
WORSE = 1.02


def main() -> int:
    given = _arguments()
    seeds = range(given.first_seed, given.first_seed + given.cases)
    console = Console(width=given.width)
    scores = []
    for one in _scored(seeds, given.jobs, given.body):
        scores.append(one)
        if given.each:
            console.print(_line(one), highlight=False)
    for table in (family_table(scores), constants_table(scores)):
        console.print(table)
    numbers = summary(scores)
    console.print(json.dumps(numbers, indent=1))
    if given.json:
        whole = {"summary": numbers, "cases": [asdict(one) for one in scores]}
        given.json.write_text(json.dumps(whole, indent=1), encoding="utf-8")
    return int(bool(numbers["worse_by_2_percent"]))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.dual_cases", description=__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--each", action="store_true", help="print a line for each case")
    size = "size of the stated body over that of the true one; 0: no positions are stated"
    parser.add_argument("--body", type=float, default=1.0, help=size)
    parser.add_argument("--json", type=Path, help="write all scores here")
    parser.add_argument("--width", type=int, default=None, help="of the tables, characters")
    return parser.parse_args()


def _scored(seeds: Sequence[int], jobs: int, body_size: float) -> Iterable[Score]:
    work = partial(score_seed, body_size=body_size)
    if jobs == 1:
        yield from map(work, seeds)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(work, seeds)


def _line(one: Score) -> str:
    case = f"{one.seed} {one.family:8s} {one.ambient:15s} raw {one.raw:7.3f} corrected {one.corrected:7.3f}"
    error = f"error/sigma {one.error_over_sigma:4.1f}"
    return f"{case} ratio {one.ratio:.3f} {one.chosen:10s} {error} {one.seconds:4.1f} s"


def family_table(scores: Sequence[Score]) -> Table:
    """Return errors without their constants, by what makes the stray field."""
    columns = ("family", "cases", "improved", "left alone", "worse", "worse > 2 %", "median ratio")
    columns += ("median, applied", "largest", "median error / sigma")
    table = Table(*columns, title="error of the corrected over that of the raw reading, constants removed")
    groups = [(family, [one for one in scores if one.family == family]) for family in FAMILIES]
    strong = [one for one in scores if one.exceeds]
    groups += [("stray > noise", strong), ("stray < noise", [one for one in scores if not one.exceeds])]
    for name, group in [*groups, ("all", list(scores))]:
        if group:
            table.add_row(name, *_row(group))
    return table


def _row(group: Sequence[Score]) -> list[str]:
    ratio = np.array([one.ratio for one in group])
    applied = np.array([one.applied for one in group])
    errors = np.array([one.error_over_sigma for one in group if np.isfinite(one.error_over_sigma)])
    shares = [np.mean(ratio < 1.0), np.mean(~applied), np.mean(ratio > 1.0), np.mean(ratio > WORSE)]
    rest = [f"{np.median(ratio):.3f}", f"{np.median(ratio[applied]):.3f}" if applied.any() else "-"]
    rest += [f"{ratio.max():.3f}", f"{np.median(errors):.1f}" if errors.size else "-"]
    return [str(len(group)), *(f"{100 * share:.0f} %" for share in shares), *rest]


def constants_table(scores: Sequence[Score]) -> Table:
    """Return errors with their constants, which two sensors do not determine."""
    table = Table("", "cases", "improved", "worse > 2 %", "median ratio", title="constants left in")
    for name, group in (("stray > noise", [one for one in scores if one.exceeds]), ("all", list(scores))):
        if group:
            ratio = np.array([one.ratio_rms for one in group])
            better, worse = 100 * np.mean(ratio < 1.0), 100 * np.mean(ratio > WORSE)
            table.add_row(
                name, str(len(group)), f"{better:.0f} %", f"{worse:.0f} %", f"{np.median(ratio):.3f}"
            )
    return table


def summary(scores: Sequence[Score]) -> dict[str, object]:
    """Return the shares of improved, unchanged and worse cases, and the seeds of the worse ones."""
    strong = [one for one in scores if one.exceeds]
    chosen = [one.chosen for one in scores]
    return {
        "cases": len(scores),
        "improved_where_stray_exceeds_noise": _share([one.ratio < 1.0 for one in strong]),
        "left_alone": _share([not one.applied for one in scores]),
        "left_alone_where_stray_exceeds_noise": _share([not one.applied for one in strong]),
        "worse_by_2_percent": [one.seed for one in scores if one.ratio > WORSE],
        "largest_ratio": round(max(one.ratio for one in scores), 4),
        "chosen": {name: chosen.count(name) for name in sorted(set(chosen))},
        "seconds_a_case": round(float(np.mean([one.seconds for one in scores])), 2),
    }


def _share(values: Sequence[bool]) -> float:
    return round(float(np.mean(values)), 3) if values else float("nan")


if __name__ == "__main__":
    sys.exit(main())
