"""The score table: ``python -m tests.physics_cases [--seeds 3] [--only NAME] [--json FILE]``."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rich.console import Console
from rich.table import Table

from inflight.cli.command import Command

from .run import Outcome, run_cases
from .scenarios import scenarios
from .score import is_named
from .verdicts import MARKS, side_by_side, verdict_of

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
    console, outcomes = Console(width=given.width) if given.width else Command().console, []
    seeds = list(range(given.first_seed, given.first_seed + given.seeds))
    for outcome in run_cases(names, seeds, given.jobs, not given.simulate_only, given.keep):
        outcomes.append(outcome)
        console.print(f"[dim]{_line(outcome)}[/]", highlight=False)
        if given.json:
            # After every case: a run of hours that is stopped has still told what it knew.
            told = {"summary": summary(outcomes), "cases": [one.as_json() for one in outcomes]}
            given.json.write_text(json.dumps(told, indent=1), encoding="utf-8")
    console.print(_timing_table(outcomes) if given.simulate_only else score_table(outcomes))
    if not given.simulate_only:
        console.print(family_table(outcomes))
    verdicts = [verdict_of(one) for one in outcomes]
    if given.against:
        console.print(side_by_side(json.loads(given.against.read_text(encoding="utf-8")), verdicts))
    if given.verdicts:
        lines = ",\n".join(json.dumps(one) for one in verdicts)
        given.verdicts.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
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
    parser.add_argument("--verdicts", type=Path, help="write what a later run can be held against here")
    parser.add_argument("--against", type=Path, help="verdicts of an earlier run, shown beside these")
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


def family_table(outcomes: list[Outcome]) -> Table:
    """Return what each family of candidates adds to what is found, and what it costs to try."""
    counts = {name: Counter[str]() for name in ("candidates", "right", "wrong", "rival", "leading")}
    told_cases = [(one.truth, one.told) for one in outcomes if one.told]
    for truth, told in told_cases:
        tried = [one for one in told["candidates"] if not one["placebo"]]
        family = {one["name"]: one["family"] for one in tried}
        counts["candidates"].update(family.values())
        counts["leading"].update(one["family"] for one in tried[:1])
        for effect in told["effects"]:
            right = any(is_named(true, effect, told) for true in truth["effects"])
            counts["right" if right else "wrong"][effect["family"]] += 1
        rivals = {name for effect in told["effects"] for name in effect.get("rivals") or ()}
        counts["rival"].update(family[name] for name in rivals if name in family)
    headings = (
        "family",
        "candidates a case",
        "taken, right",
        "taken, wrong",
        "named as a rival",
        "ranked first",
    )
    table = Table(*headings, title="what each family adds")
    for name in sorted(set().union(*counts.values()), key=lambda one: (-counts["right"][one], one)):
        shown = (counts[column][name] for column in ("right", "wrong", "rival", "leading"))
        table.add_row(name, f"{counts['candidates'][name] / len(told_cases):.1f}", *map(str, shown))
    return table


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
