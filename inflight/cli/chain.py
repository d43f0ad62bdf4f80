"""The verb ``chain``: what all days together told."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.pipeline import ComparisonOption
from inflight.cli.results import page_path
from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console


#: Parameters listed at most.
_MOST = 15


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
    from inflight.mission import dual_comparisons
    from inflight.tasks.pipelines.mission import chain_report
    from inflight.tasks.pipelines.relation import dual_report
    from inflight.tasks.pipelines.spin import spin_report

    workspace = session.open_workspace()
    page = page_path(html) if html else None
    if comparison in dual_comparisons(workspace.mission()):
        told = dual_report(session.open_catalog(), workspace.mission(), comparison, page)
        session.emit(told, lambda console: _print_dual(console, told))
        return
    entry = workspace.mission().comparisons.get(comparison)
    if entry is not None and entry.kind == "spin":
        told = spin_report(session.open_catalog(), workspace.mission(), comparison, page)
        session.emit(told, lambda console: _print_spin(console, told))
        return
    fields = chain_report(session.open_catalog(), workspace.mission(), comparison, page, cross_talk).as_json()
    session.emit(fields, lambda console: _print(console, fields))


def _print(console: Console, fields: Mapping[str, Any]) -> None:
    """Print residual, trend, what went far from what was known, what was found, and what is not told."""
    sections = fields["sections"]
    size = sections["residual"]
    first, last = fields["span"]
    console.print(f"{fields['model']}: {fields['days']} days, {first} to {last}", style="bold", markup=False)
    product = size["products_nT"]
    after = f", {product:.4g} nT in the products of all days together" if isfinite(product) else ""
    lines = [
        f"residual {size['before_nT']:.4g} nT before, {size['own_fit_nT']:.4g} nT with each day's own nine"
        f"{after}",
        f"scale factors: {sections['trend']['kind']}; {sections['trend'].get('told', 'no rivals compared')}",
        *_coefficients(sections["coefficients"]["items"]),
        *(sections["clock_faults"].get("told") or []),
    ]
    for line in lines:
        console.print(f"  {line}", soft_wrap=True, markup=False)
    for line in _asked(sections["cross_talk"].get("asked")):
        console.print(f"  {line}", soft_wrap=True, markup=False)
    for section in sections.values():
        for what, why in section["absent"].items():
            console.print(f"  not told: {what}: {why}", soft_wrap=True, markup=False, style="dim")
    page = fields["path"] or "none; --html FILE writes it with every figure"
    console.print(f"  page: {page}", soft_wrap=True, markup=False)


def _print_dual(console: Console, fields: Mapping[str, Any]) -> None:
    """Print how two vector sensors stand to each other, and which of the three disagrees."""
    sections = fields["sections"]
    first, last = fields["span"]
    title = f"{fields['comparison']}: {fields['days']} days, {first} to {last}"
    console.print(title, style="bold", markup=False)
    lines = [
        f"{one['name']} {one['value']:.6g} ± {one['sigma']:.2g} {one['unit']}"
        for one in sections["relation"].get("items", [])
    ]
    lines += [
        f"variance of the {one['sensor']} sensor {one['variance']:.4g} ± {one['sigma']:.2g} nT^2"
        for one in sections["corners"].get("items", [])
    ]
    lines += [fields["note"], f"page: {fields['path'] or 'none; --html FILE writes it with every figure'}"]
    for line in lines:
        console.print(f"  {line}", soft_wrap=True, markup=False)


def _print_spin(console: Console, fields: Mapping[str, Any]) -> None:
    """Print the twelve parameters with their origin, what days replaced, zero levels, and the phase."""
    sections = fields["sections"]
    first, last = fields["span"]
    console.print(f"{fields['comparison']}: {fields['days']} days, {first} to {last}", style="bold")
    lines = [
        f"{one['name']:<17} {one['value']:.6g} ± {one['sigma']:.2g} {one['unit']}, from {one['origin']}; "
        f"{one['decision'] or 'nothing decided'}: {one['reason']}"
        for one in sections["twelve"]["items"]
    ]
    lines.append(f"these remain at their ground values: {', '.join(sections['twelve']['ground']) or 'none'}")
    replaced = [
        one for one in sections["days"]["items"] if one["decision"] == "update" and one["day"] != first
    ]
    lines += [f"{one['day']} replaced {one['name']}: {one['reason']}" for one in replaced[-_MOST:]]
    lines += [f"drift of {name}: {one['sentence']}" for name, one in sections["zero_level"]["drift"].items()]
    lines += [f"{one['day']}: {one['told']}" for one in sections["phase"]["items"][-1:]]
    lines.append(f"page: {fields['path'] or 'none; --html FILE writes it with every figure'}")
    for line in lines:
        console.print(f"  {line}", soft_wrap=True, markup=False)


def _asked(told: Mapping[str, Any] | None) -> list[str]:
    """Return what one ignored cause does: everything else fitted, and the nine alone; largest first."""
    out = []
    for key, how in (("alone", "the nine fitted alone"), ("together", "everything else fitted")):
        rows = (told or {}).get(key)
        if told and rows:
            out.append(f"ignoring {told['ignored']} = {told['size']:g} {told['size_unit']}, {how}:")
            far = sorted(rows, key=lambda one: -abs(one["shift"]) / max(one["sigma"], 1e-300))
            out += [
                f"  {one['parameter']} {one['shift']:+.4g} ± {one['sigma']:.2g} {one['unit']}"
                for one in far[:_MOST]
            ]
    return out


def _coefficients(items: list[Mapping[str, Any]]) -> list[str]:
    known = sum(one["determined"] for one in items)
    out = [f"{len(items)} coefficients, {known} determined; beyond 3 sigma of what was known before:"]
    far = [one for one in items if abs(one["shift_sigma"] or 0.0) > 3.0]
    out += [
        f"  {one['name']} {one['value']:.6g} ± {one['sigma']:.2g} {one['unit']} ({one['shift_sigma']:+.1f})"
        for one in sorted(far, key=lambda one: -abs(one["shift_sigma"]))
    ]
    return (
        out
        if far
        else [out[0].replace("beyond 3 sigma of what", "none is beyond 3 sigma of what").rstrip(":")]
    )
