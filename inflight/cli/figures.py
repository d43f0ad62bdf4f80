"""The verb ``figures``: the scorecard of published figures."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.command import Command, TextTable, text_table

if TYPE_CHECKING:
    from rich.console import Console

_COLOURS = {"reproduced": "green", "contradicted": "red", "not reproducible": "yellow", "needs data": "dim"}
#: Digits shown of what is printed, and of what is obtained; --json has all.
_PRINTED, _OBTAINED = 9, 6
#: Numbers of one figure shown before the rest is only counted.
_SHOWN = 3


def figures(
    command: Command,
    *,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this id, or all that begin with it; may be repeated.")
    ] = None,
    section: Annotated[str | None, typer.Option(help="Only this section, such as residual.")] = None,
) -> None:
    """Compare published figures with what the software obtains for them, now."""
    from inflight.scorecard import SECTIONS, run_scorecard

    with command.progress() as progress:
        results = [report.as_json() for report in run_scorecard(only or (), section, progress)]
    counts = _counts(results)

    def show(console: Console) -> None:
        for name, title in SECTIONS.items():
            of_section = [figure for figure in results if figure["section"] == name]
            if of_section:
                console.print(f"\n{title}", style="bold")
                console.print(_table(of_section))
        console.print()
        for name, verdicts in counts.items():
            text = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
            console.print(f"{sum(verdicts.values())} figures {name}: {text or 'none'}")
        console.print(
            "(d) derived, (i) recovered from injection, (m) measured, (n) needs the mission's data;"
        )
        console.print("* not printed by the source, but what theory or geometry makes one expect")

    command.emit({"command": "figures", "figures": results, "verdicts": counts}, show)


def _counts(results: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Count verdicts of figures that are printed, expected by theory, or recovered from injection.

    What was injected tests an estimator, whether its number is printed or not.
    """
    counts: dict[str, Counter[str]] = {"printed": Counter(), "expected": Counter(), "recovered": Counter()}
    for figure in results:
        injected = figure["basis"] == "recovered_from_injection"
        kind = "recovered" if injected else "printed" if figure["printed"] else "expected"
        counts[kind][figure["verdict"]] += 1
    return {kind: {name: count[name] for name in _COLOURS if count[name]} for kind, count in counts.items()}


def _table(results: list[dict[str, Any]]) -> TextTable:
    from rich.text import Text

    rows: list[tuple[str | Text, ...]] = []
    for figure in results:
        tolerance, injected = figure["tolerance"], figure["basis"] == "recovered_from_injection"
        is_range = isinstance(tolerance, dict)
        rows.append(
            (
                figure["id"],
                _number(figure["published"], _PRINTED) + ("" if figure["printed"] else " *"),
                _number(figure["obtained"]),
                f"{tolerance['low']:g} to {tolerance['high']:g}" if is_range else _number(tolerance),
                "" if figure["unit"] == "1" else figure["unit"],
                f"({'i' if injected else figure['basis'][0]})",
                Text(figure["verdict"], style=_COLOURS[figure["verdict"]]),
                figure["why"],
            )
        )
    return text_table(("figure", "published", "obtained", "tolerance", "unit", "", "verdict", "why"), rows)


def _number(value: Any, digits: int = _OBTAINED) -> str:
    if value is None:
        return "-"
    several = value if isinstance(value, list | tuple) else (value,)
    text = ", ".join(f"{each:.{digits}g}" for each in several[:_SHOWN])
    more = len(several) - _SHOWN
    return f"{text}, {more} more" if more > 0 else text
