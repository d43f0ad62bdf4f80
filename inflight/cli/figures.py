"""The verb ``figures``: the scorecard of published figures."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_COLOURS = {"reproduced": "green", "contradicted": "red", "not reproducible": "yellow", "needs data": "dim"}
#: Digits shown of what is printed, and of what is obtained; --json has all.
_PRINTED, _OBTAINED = 9, 6
#: Numbers of one figure shown before the rest is only counted.
_SHOWN = 3


def register(app: typer.Typer) -> None:
    """Add the verb of this module."""
    verb(app, "figures")(figures)


def figures(
    session: Session,
    *,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this id, or all that begin with it; may be repeated.")
    ] = None,
    section: Annotated[str | None, typer.Option(help="Only this section, such as residual.")] = None,
) -> None:
    """Hold published figures against what the software obtains for them, now."""
    from inflight.scorecard import SECTIONS, run_scorecard

    found = [report.as_json() for report in run_scorecard(only or (), section)]
    counts = {name: _counts(found, name) for name in ("printed", "expected", "recovered")}

    def show(console: Console) -> None:
        for name, title in SECTIONS.items():
            of_section = [one for one in found if one["section"] == name]
            if of_section:
                console.print(f"\n{title}", style="bold")
                console.print(_table(of_section))
        console.print()
        for name, verdicts in counts.items():
            told = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
            console.print(f"{sum(verdicts.values())} figures {name}: {told or 'none'}")
        console.print(
            "(d) derived, (i) recovered from injection, (m) measured, (n) needs the mission's data;"
        )
        console.print("* not printed by the source, but what theory or geometry makes one expect")

    session.emit({"command": "figures", "figures": found, "verdicts": counts}, show)


def _counts(found: list[dict[str, Any]], kind: str) -> dict[str, int]:
    """How often each verdict was given to figures that are printed, expected by theory, or put in."""
    every = Counter(one["verdict"] for one in found if _kind(one) == kind)
    return {name: every[name] for name in _COLOURS if every[name]}


def _kind(one: dict[str, Any]) -> str:
    """What was put in proves an estimator, whether its number is printed or not."""
    if one["basis"] == "recovered_from_injection":
        return "recovered"
    return "printed" if one["printed"] else "expected"


def _table(found: list[dict[str, Any]]) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for name in ("figure", "published", "obtained", "tolerance", "unit", "", "verdict", "why"):
        table.add_column(name, overflow="fold")
    for one in found:
        table.add_row(
            one["id"],
            _number(one["published"], _PRINTED) + ("" if one["printed"] else " *"),
            _number(one["obtained"]),
            _tolerance(one["tolerance"]),
            "" if one["unit"] == "1" else one["unit"],
            f"({one['basis'][0] if one['basis'] != 'recovered_from_injection' else 'i'})",
            Text(one["verdict"], style=_COLOURS[one["verdict"]]),
            one["why"],
        )
    return table


def _number(value: Any, digits: int = _OBTAINED) -> str:
    if value is None:
        return "-"
    several = value if isinstance(value, list | tuple) else (value,)
    told = ", ".join(f"{one:.{digits}g}" for one in several[:_SHOWN])
    more = len(several) - _SHOWN
    return f"{told}, {more} more" if more > 0 else told


def _tolerance(value: Any) -> str:
    if isinstance(value, dict):
        return f"{value['low']:g} to {value['high']:g}"
    return _number(value)
