"""What is kept of a run of the cases for later ones to stand beside; ``verdicts.json`` is the last kept."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from .run import Outcome

MARKS = {True: "[green]yes[/]", False: "[red]NO[/]", None: "[dim]-[/]"}


def verdict_of(outcome: Outcome) -> dict[str, Any]:
    """Return what is kept of a case for later runs to stand beside."""
    score, told = outcome.score, outcome.told or {}
    return {
        "name": outcome.name,
        "seed": outcome.seed,
        "verdict": score.verdict if score else "error",
        "taken": [effect["name"] for effect in told.get("effects") or []],
        "passed": score.passed if score else None,
        "confident_wrong": bool(score and score.confident_wrong),
        "seconds": round(outcome.diagnose_s, 1),
    }


def side_by_side(before: list[dict[str, Any]], now: list[dict[str, Any]]) -> Table:
    """Return verdicts, names and times of an earlier run of the cases beside those of this one.

    Parameters
    ----------
    before, now : list of dict
        Of `verdict_of`.
    """
    earlier = {(one["name"], one["seed"]): one for one in before}
    pairs = ("verdict", "taken", "passed", "confident wrong", "s")
    table = Table("case", "seed", *(f"{name}, {when}" for name in pairs for when in ("before", "now")))
    alike = 0
    for case in now:
        then = earlier.get((case["name"], case["seed"]))
        cells = [_cells(then) if then else ["not run"] * len(pairs), _cells(case)]
        alike += cells[0][:-1] == cells[1][:-1]
        row = [text for both in zip(*cells, strict=True) for text in both]
        table.add_row(case["name"], str(case["seed"]), *row)
    table.caption = f"{alike} of {len(now)} cases with the verdict and effects of the earlier run"
    return table


def _cells(case: dict[str, Any]) -> list[str]:
    """Return what `side_by_side` shows of a case."""
    wrong = "[red]YES[/]" if case["confident_wrong"] else "no"
    taken = ", ".join(case["taken"])
    return [case["verdict"], taken, MARKS[case["passed"]], wrong, f"{case['seconds']:.0f}"]
