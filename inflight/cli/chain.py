"""The verb ``chain``: what all days together told."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from inflight.cli.pipeline import ComparisonOption
from inflight.cli.results import page_path, print_summary, require_comparison
from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console


def register(app: typer.Typer) -> None:
    """Add the verb of this module."""
    verb(app, "chain")(chain)


def chain(
    session: Session,
    *,
    comparison: ComparisonOption = "main",
    html: Annotated[
        Path | None, typer.Option("--html", help="Write the page with every figure here.", show_default=False)
    ] = None,
    cross_talk: Annotated[
        str,
        typer.Option(
            "--cross-talk",
            metavar="PARAMETER",
            help="Tell what this one does to all others when it is ignored.",
            show_default=False,
        ),
    ] = "",
) -> None:
    """Tell what 'reprocess --table continuous' found: coefficients, trends, currents, what wanders.

    Of a spinning spacecraft: the twelve parameters, where each came from, and what each day decided.
    """
    from inflight.tasks.pipelines import tables_report

    workspace = session.open_workspace()
    mission, catalog = workspace.mission(), session.open_catalog()
    require_comparison(mission, comparison)
    page = page_path(html) if html else None
    report = tables_report(catalog, mission, comparison, page, cross_talk)
    fields = report.as_json()

    def show(console: Console) -> None:
        print_summary(console, report)
        where = fields["path"] or "none; --html FILE writes it with every figure"
        console.print(f"  page: {where}", soft_wrap=True, markup=False)

    session.emit(fields, show)
