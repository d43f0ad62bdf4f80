"""Verbs that judge and hand out results: ``compare`` and ``release``."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.pipeline import ComparisonOption, EndOption, NoPrefectOption, StartOption, run_flow
from inflight.cli.session import Session, verb
from inflight.errors import SettingsError, StorageError

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Workspace
    from inflight.tasks.pipelines.scalar import CompareReport
    from inflight.tasks.pipelines.states import DualCompareReport


def register(app: typer.Typer) -> None:
    """Add the verbs of this module."""
    verb(app, "compare")(compare)
    verb(app, "release")(release)


def compare(
    session: Session,
    *,
    start: StartOption = None,
    end: EndOption = None,
    comparison: ComparisonOption = "main",
    output: Annotated[Path | None, typer.Option(help="Where the page goes (default: reports/)")] = None,
    show: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Tell how well the calibrated instrument agrees with its reference, before and after."""
    workspace = session.open_workspace()
    report = compare_span(session, workspace, start=start, end=end, comparison=comparison, output=output)
    fields = report.as_json()
    show_fields = print_dual_comparison if fields.get("kind") == "dual" else print_comparison
    session.emit(fields, lambda console: show_fields(console, fields))
    if show and fields["path"]:
        import webbrowser

        webbrowser.open(Path(fields["path"]).resolve().as_uri())


def compare_span(
    session: Session,
    workspace: Workspace,
    *,
    start: str | None = None,
    end: str | None = None,
    comparison: str = "main",
    output: Path | None = None,
) -> CompareReport | DualCompareReport:
    """Compare and write the page, into the workspace's reports unless `output` says otherwise.

    A workspace that can only be read gets no page unless `output` names a place for it.

    Raises
    ------
    StorageError
        When the page cannot be written to `output`.
    """
    from inflight.flows import Span
    from inflight.tasks.analysis import compare as measure

    mission = workspace.mission()
    if comparison not in mission.comparisons:
        raise SettingsError(
            f"--comparison: mission {mission.mission!r} has no comparison {comparison!r}",
            remedy=f"choose one of {', '.join(mission.comparisons)}",
        )
    span = Span.model_validate({"start": start, "end": end}).as_text()
    name = "-".join(["compare", comparison, *filter(None, span)])
    page = page_path(output) if output else _page_path_if_writable(workspace.reports / name)
    catalog = session.open_catalog()
    with session.progress() as progress:
        return measure(catalog, mission, *span, comparison=comparison, output=page, progress=progress)


def page_path(path: Path) -> Path:
    """Return the path of a page, whose folder is made when it is not there."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(f"{path.parent} cannot be written")
    except OSError as error:
        raise StorageError(
            f"there is no place for the page: {error}", file=str(path), remedy="name another with --output"
        ) from error
    return path if path.suffix == ".html" else path.with_name(f"{path.name}.html")


def _page_path_if_writable(path: Path) -> Path | None:
    try:
        return page_path(path)
    except StorageError:
        return None


def print_comparison(console: Console, fields: dict[str, Any]) -> None:
    """Print residual before and after, what the data determine, where it still fails, and the page."""
    residual = fields["residual"]
    for name in ("before", "after"):
        rms, spread = residual[f"{name}_nT"], residual[f"{name}_less_mean_nT"]
        console.print(f"residual {name:<7} {rms:8.3f} nT rms, {spread:.3f} nT about its mean", style="bold")
    if residual["outliers"]:
        robust, outliers = residual["after"]["robust"], residual["outliers"]
        console.print(f"  its robust sigma {robust:8.3f} nT; the rms counts {outliers} outliers")
    if math.isfinite(residual["noise_floor_nT"]):
        console.print(f"noise floor      {residual['noise_floor_nT']:8.3f} nT")
    else:
        console.print("noise floor      unknown: every stretch of the residual has missing samples")
    determined = (
        ", ".join(name.rpartition(".")[2] for name in fields["parameters"]["determined"]) or "nothing"
    )
    console.print(f"  determined by these data: {determined}", soft_wrap=True, markup=False)
    for failing in fields["fails_where"]:
        console.print(f"  {failing['sentence']}", soft_wrap=True, markup=False)
    page = fields["path"] or "none, because the workspace cannot be written; --output names another place"
    console.print(f"  page: {page}", soft_wrap=True)


def print_dual_comparison(console: Console, fields: dict[str, Any]) -> None:
    """Print how far the field of two sensors steps at switchings, before and after, and what is left."""
    residual = fields["residual"]
    if residual["note"]:
        console.print(residual["note"], soft_wrap=True)
    else:
        console.print(f"{residual['what']} ({residual['switchings']} switchings):", soft_wrap=True)
        for name, label in (("before", "as measured"), ("after", "corrected"), ("noise_floor", "floor")):
            console.print(f"  {label:<12} {residual[f'{name}_nT']:8.3f} nT", style="bold")
    for told in fields["verdict"]["told"]:
        console.print(f"  {told}", soft_wrap=True, markup=False)
    for failing in fields["fails_where"]:
        console.print(f"  {failing['sentence']}", soft_wrap=True, markup=False)
    page = fields["path"] or "none, because the workspace cannot be written; --output names another place"
    console.print(f"  page: {page}", soft_wrap=True)


def release(
    session: Session,
    version: Annotated[str, typer.Argument(help="Version of the release, such as 1.0; never used twice.")],
    *,
    notes: Annotated[str, typer.Option(help="Text for the release notes.")] = "",
    destination: Annotated[Path | None, typer.Option(help="Folder (default: releases/)")] = None,
    no_prefect: NoPrefectOption = False,
) -> None:
    """Freeze what is published and copy it out with manifest and notes."""
    parameters = {"version": version, "notes": notes, "destination": destination}
    session.finish(run_flow(session, "release", parameters, workers=None, prefect=not no_prefect))
