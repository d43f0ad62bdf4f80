"""Verbs about the model: ``model show``, ``diff`` and ``history``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.tasks import ModelHistory

model = typer.Typer(
    help="Look into the model: its effects, versions and what they change.", no_args_is_help=True
)

ComparisonOption = Annotated[str | None, typer.Option("--comparison", help="Comparison of the mission.")]
ModelArgument = Annotated[str, typer.Argument(help="Version (3), name, or both (champ-preflight:3).")]
#: Digits a value is shown with; --json has all.
_DIGITS = 9


def register(app: typer.Typer) -> None:
    """Add the verbs of this module."""
    app.add_typer(model, name="model")


@verb(model, "show")
def show_model(
    session: Session,
    named: Annotated[
        str | None, typer.Argument(metavar="[MODEL]", help="Version (3), name, or name:3.")
    ] = None,
    *,
    comparison: ComparisonOption = None,
) -> None:
    """Show the effects of a model in the order of correction, with values and uncertainties."""
    from inflight.model import parse_tree

    found = _versions(session, comparison).find(named)
    tree = parse_tree(found.text)
    message = found.record.message if found.record else ""

    def show(console: Console) -> None:
        made = f" (from version {found.fields['parent']})" if found.fields["parent"] else ""
        told = f": {message}" if message else ""
        console.print(f"{found.label}{made}{told}", soft_wrap=True, markup=False)
        console.print(
            _table(("effect", "sensor", "parameter", "value", "sigma", "unit", "time", "fit"), tree)
        )
        for entry in tree["effects"]:
            if "source" in entry:
                console.print(f"{entry['effect']} is the mission's own effect, source {entry['source']}")

    fields = found.fields | {"message": message}
    session.emit({"command": "model show", **fields, "model": tree}, show)


@verb(model, "diff")
def diff_models(
    session: Session,
    before: ModelArgument,
    after: Annotated[str | None, typer.Argument(help="The model in use when left out.")] = None,
    *,
    comparison: ComparisonOption = None,
) -> None:
    """Tell what one version of a model changes of another."""
    from inflight.model import changes, parse_tree

    versions = _versions(session, comparison)
    old, new = versions.find(before), versions.find(after)
    found = changes(parse_tree(old.text)["effects"], parse_tree(new.text)["effects"])

    def show(console: Console) -> None:
        console.print(f"{old.label} -> {new.label}")
        for change in found:
            console.print(f"  {change['sentence']}", soft_wrap=True, markup=False)
        if not found:
            console.print("  nothing differs")

    fields = {"command": "model diff", "from": old.fields, "to": new.fields, "changes": found}
    session.emit(fields, show)


@verb(model, "history")
def model_history(session: Session, *, comparison: ComparisonOption = None) -> None:
    """List the versions of the workspace's models: from what each was made, why and when."""
    items = _versions(session, comparison).items()

    def show(console: Console) -> None:
        if not items:
            console.print("No model has been used yet. Next: inflight reprocess")
            return
        console.print(_plain_table(("", "name", "version", "parent", "message", "created", "sha256"), items))

    session.emit({"command": "model history", "items": items}, show)


def _versions(session: Session, comparison: str | None) -> ModelHistory:
    from inflight.tasks import ModelHistory, comparison_of

    mission = session.open_workspace().mission()
    return ModelHistory(session.open_catalog(), mission, comparison_of(mission, comparison))


def _rows(tree: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield one row a component; effect and parameter stand in the first of theirs."""
    for entry in tree["effects"]:
        numbers = {key: part for key, part in entry.items() if isinstance(part, Mapping) and "value" in part}
        label, sensor = str(entry.get("name", entry["effect"])), str(entry.get("sensor", ""))
        if not numbers:
            yield (label, sensor, "", "", "", "", "", "")
        for key, part in numbers.items():
            fit = "free" if part.get("free") else "held"
            values = part["value"] if isinstance(part["value"], Mapping) else {"": part["value"]}
            sigmas = part.get("sigma")
            for axis, value in values.items():
                sigma = sigmas.get(axis) if isinstance(sigmas, Mapping) else sigmas
                name = f"{key}[{axis}]" if axis else key
                unit, time = str(part.get("unit", "")), str(part.get("time", "constant"))
                yield (label, sensor, name, _number(value), _number(sigma), unit, time, fit)
                label = sensor = ""


def _number(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_number(one) for one in value)
    return "" if value is None else f"{value:.{_DIGITS}g}"


def _table(columns: tuple[str, ...], tree: Mapping[str, Any]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold", justify="right" if name in ("value", "sigma") else "left")
    for row in _rows(tree):
        table.add_row(*(cell.replace("[", r"\[") for cell in row))
    return table


def _plain_table(columns: tuple[str, ...], items: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for item in items:
        shown = item | {"": "*" if item["used"] else "", "sha256": item["sha256"][:12]}
        shown["parent"] = "" if item["parent"] is None else item["parent"]
        table.add_row(*(str(shown[name]).replace("[", r"\[") for name in columns))
    return table
