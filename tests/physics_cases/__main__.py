"""The score table: ``python -m tests.physics_cases --seeds 3 [--only NAME] [--jobs 2] [--json out]``."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table

from .run import Outcome, run_cases
from .scenarios import scenarios

MARKS = {True: "[green]yes[/]", False: "[red]NO[/]", None: "[dim]-[/]"}
COLUMNS = ("case", "seed", "hidden", "verdict", "named", "family", "channel", "coeff. pull", "lag", "period")
COLUMNS += ("held out / floor", "false", "confident wrong", "passed", "s")


def main() -> int:
    """Run the cases, print the table, return 0 when none is confidently wrong."""
    given = _arguments()
    names = given.only or list(scenarios())
    if unknown := set(names) - set(scenarios()):
        print(f"no case {', '.join(sorted(unknown))}; there are {', '.join(scenarios())}", file=sys.stderr)
        return 2
    if not given.simulate_only and importlib.util.find_spec("inflight.tasks.analysis.diagnosis") is None:
        print(
            "there is no inflight.tasks.analysis.diagnosis; --simulate-only makes the cases alone",
            file=sys.stderr,
        )
        return 2
    console, outcomes = Console(width=given.width), []
    seeds = list(range(given.first_seed, given.first_seed + given.seeds))
    for outcome in run_cases(names, seeds, given.jobs, not given.simulate_only, given.keep):
        outcomes.append(outcome)
        console.print(f"[dim]{_line(outcome)}[/]", highlight=False)
        if given.json:
            # After every case: a run of hours that is stopped has still told what it knew.
            told = {"summary": summary(outcomes), "cases": [one.as_json() for one in outcomes]}
            given.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    console.print(_timing_table(outcomes) if given.simulate_only else score_table(outcomes))
    told = summary(outcomes)
    console.print(json.dumps(told, indent=1))
    return int(bool(told["confident_wrong"] or told["errors"]))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.physics_cases", description=__doc__)
    parser.add_argument("--seeds", type=int, default=1, help="seeds of each case")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--only", action="append", metavar="NAME", help="this case; may be given again")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, help="write truths, diagnoses and scores here")
    parser.add_argument("--keep", type=Path, help="folder that keeps the workspaces")
    parser.add_argument("--simulate-only", action="store_true", help="make the cases, diagnose nothing")
    parser.add_argument("--width", type=int, default=None, help="of the table, characters")
    return parser.parse_args()


def _line(one: Outcome) -> str:
    """Return what is said of a case as soon as it is done."""
    said = last_line(one.error) or "made"
    if one.score:
        said = f"{one.score.verdict}, {'passed' if one.score.passed else 'failed'}"
        said += ", CONFIDENTLY WRONG" if one.score.confident_wrong else ""
    return f"{one.name} {one.seed}: {said}, {one.diagnose_s:.0f} s"


def last_line(text: str) -> str:
    """Return the last line of a traceback, which says what happened."""
    return text.rsplit("\n", 1)[-1]


def score_table(outcomes: list[Outcome]) -> Table:
    """Return a table with a row for each case."""
    table = Table(*COLUMNS, title="hidden effects and what was said of them")
    for one in outcomes:
        table.add_row(*_row(one))
    return table


def _row(one: Outcome) -> list[str]:
    hidden = ", ".join(effect["name"] for effect in one.truth["effects"]) or "nothing"
    found = one.score
    if found is None:
        told = last_line(one.error)[:60] or "not diagnosed"
        return [one.name, str(one.seed), hidden, f"[red]{told}[/]", *[""] * 10, f"{one.diagnose_s:.1f}"]
    effects = (one.told or {}).get("effects") or []
    named = ", ".join(f"{effect['family']}:{'+'.join(effect.get('channels') or [])}" for effect in effects)
    verdict = found.verdict if found.verdict_allowed else f"[red]{found.verdict}[/]"
    pull = MARKS[None] if found.pull is None else f"{found.pull:.1f} {MARKS[found.coefficients]}"
    floor = MARKS[None] if found.floor_ratio is None else f"{found.floor_ratio:.3f} {MARKS[found.floor]}"
    wrong = "[red]YES[/]" if found.confident_wrong else "no"
    answers = [MARKS[found.family], MARKS[found.channel], pull, MARKS[found.lag], MARKS[found.period], floor]
    end = [", ".join(found.false_additions), wrong, MARKS[found.passed], f"{one.diagnose_s:.1f}"]
    return [one.name, str(one.seed), hidden, verdict, named, *answers, *end]


def _timing_table(outcomes: list[Outcome]) -> Table:
    table = Table("case", "seed", "hidden", "days", "simulate ms/day", "write ms/day", title="cases made")
    for one in outcomes:
        sizes = [
            f"{effect['name']} ({1e3 * effect['retained_rms_nT']:.0f} pT left)"
            for effect in one.truth["effects"]
        ]
        spent = [f"{1e3 * seconds / one.days:.0f}" for seconds in (one.simulate_s, one.write_s)]
        table.add_row(one.name, str(one.seed), ", ".join(sizes) or "nothing", str(one.days), *spent)
    return table


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Return counts, and the names of what failed."""
    scored = [one.score for one in outcomes if one.score]
    nulls = [one.score for one in outcomes if one.score and not one.truth["effects"]]
    days = sum(one.days for one in outcomes) or 1
    return {
        "cases": len(outcomes),
        "passed": sum(one.passed for one in scored),
        "honest": sum(one.honest for one in scored),
        "confident_wrong": [f"{one.scenario}-{one.seed}" for one in scored if one.confident_wrong],
        "failed": [f"{one.scenario}-{one.seed}" for one in scored if not one.passed],
        "errors": [f"{one.name}-{one.seed}" for one in outcomes if one.error],
        "nulls": len(nulls),
        "nulls_with_additions": sum(bool(one.false_additions) for one in nulls),
        "simulate_ms_per_day": round(1e3 * sum(one.simulate_s for one in outcomes) / days, 1),
        "write_ms_per_day": round(1e3 * sum(one.write_s for one in outcomes) / days, 1),
        "diagnose_s": round(sum(one.diagnose_s for one in outcomes), 1),
    }


if __name__ == "__main__":
    sys.exit(main())
