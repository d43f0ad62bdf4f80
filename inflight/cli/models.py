"""Verbs about the model: ``model show``, ``diff`` and ``history``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.command import Command, text_table, verb
from inflight.cli.diagnosis_text import with_error

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.tasks import ModelHistory

group = typer.Typer(
    help="Look into the model: its effects, versions and what they change.", no_args_is_help=True
)

ComparisonOption = Annotated[str | None, typer.Option("--comparison", help="Comparison of the mission.")]
ModelArgument = Annotated[str, typer.Argument(help="Version (3), name, or both (champ-preflight:3).")]
#: Digits a value is shown with; --json has all.
_DIGITS = 9
#: Part of its sigma by which a number has moved that is worth a line.
_HARDLY = 0.01


@verb(group, "show")
def show_model(
    command: Command,
    named: Annotated[
        str | None, typer.Argument(metavar="[MODEL]", help="Version (3), name, or name:3.")
    ] = None,
    *,
    comparison: ComparisonOption = None,
) -> None:
    """Show the effects of a model in the order of correction, with values and uncertainties."""
    from inflight.model import parse_tree

    versions = _versions(command, comparison)
    found = versions.find(named)
    tree = _marked(parse_tree(found.text))
    used = versions.model(found)
    told, alone = used.told_by_difference, used.torquers_alone
    message = found.record.message if found.record else ""

    def show(console: Console) -> None:
        parent = f" (from version {found.fields['parent']})" if found.fields["parent"] else ""
        why = f": {message}" if message else ""
        console.print(f"{found.label}{parent}{why}", soft_wrap=True, markup=False)
        columns = ("effect", "sensor", "parameter", "value", "sigma", "unit", "time", "fit")
        if tree["effects"]:
            console.print(text_table(columns, _rows(tree), right=("value", "sigma")))
        else:
            console.print("the model has no effect: readings are taken as they are")
        for entry in tree["effects"]:
            if "source" in entry:
                console.print(f"{entry['effect']} is the mission's own effect, source {entry['source']}")
        if names := [entry.get("name", entry["effect"]) for entry in tree["effects"] if "empirical" in entry]:
            text = f"empirical, there for what they look like, cause not known: {', '.join(names)}"
            console.print(text, soft_wrap=True, markup=False)
        for line in (*_dipoles(tree), *(one for one in (told, alone) if one)):
            console.print(line, soft_wrap=True, markup=False)

    fields = found.fields | {"message": message, "told_by_difference": told, "torquers_alone": alone}
    command.emit({"command": "model show", **fields, "model": tree}, show)


@verb(group, "diff")
def diff_models(
    command: Command,
    before: ModelArgument,
    after: Annotated[str | None, typer.Argument(help="The model in use when left out.")] = None,
    *,
    comparison: ComparisonOption = None,
) -> None:
    """Show what one version of a model changes of another."""
    from inflight.model import changes, parse_tree

    versions = _versions(command, comparison)
    old, new = versions.find(before), versions.find(after)
    trees = parse_tree(old.text), parse_tree(new.text)
    found = changes(trees[0]["effects"], trees[1]["effects"])

    def show(console: Console) -> None:
        console.print(f"{old.label} -> {new.label}")
        was, now = (dict(_numbers(tree)) for tree in trees)
        moved = [name for name in was if name in now and was[name] != now[name]]
        for change in found:
            parameter, _, part = change["key"].partition(".")
            kind, _, axis = part.partition(".")
            number = f"{change['effect']}.{parameter}" + (f"[{axis}]" if axis else "")
            if kind not in ("value", "sigma") or number not in moved:
                console.print(f"  {change['sentence']}", soft_wrap=True, markup=False)
        told = [name for name in moved if not _hardly(was[name], now[name])]
        rows = [
            (name, *(" ± ".join(filter(None, _told(*one[name][:2]))) for one in (was, now)), now[name][2])
            for name in told
        ]
        if rows:
            console.print(text_table(("number", "before", "after", "unit"), rows, folded=("number",)))
        if hardly := len(moved) - len(told):
            console.print(f"{hardly} others moved by less than a hundredth of their sigma; --json lists all")
        if not found:
            console.print("  nothing differs")

    fields = {"command": "model diff", "from": old.fields, "to": new.fields, "changes": found}
    command.emit(fields, show)


@verb(group, "history")
def model_history(command: Command, *, comparison: ComparisonOption = None) -> None:
    """List the versions of the workspace's models: from what each was made, why and when."""
    items = _versions(command, comparison).items()

    def show(console: Console) -> None:
        if not items:
            console.print("No model has been used yet. Next: inflight reprocess")
            return
        columns = ("", "name", "version", "parent", "message", "residual, nT", "above floor, nT", "created")
        rows = []
        for item in items:
            change = item["change"] or {}
            shown = item | {"": "*" if item["used"] else "", "created": item["created"][:16]}
            shown["parent"] = "" if item["parent"] is None else item["parent"]
            # On days not used in the fit.
            for head, key in (("residual, nT", "held_out_nT"), ("above floor, nT", "above_floor_nT")):
                both = change.get(key)
                shown[head] = f"{both[0]:.4g} -> {both[1]:.4g}" if both else ""
            rows.append([str(shown[name]) for name in columns])
        console.print(text_table(columns, rows))
        for line in (
            "Each row says what that version did: rms before -> after on days not used in the fit, all else "
            "fitted anew both times; what 'inflight compare' prints is of the products as they were made.",
            "next: inflight model diff VERSION    (what it changed), or inflight undo",
        ):
            console.print(line, soft_wrap=True, markup=False)

    command.emit({"command": "model history", "items": items}, show)


def _versions(command: Command, comparison: str | None) -> ModelHistory:
    from inflight.tasks import ModelHistory, comparison_of

    mission = command.open_workspace().mission()
    return ModelHistory(command.open_catalog(), mission, comparison_of(mission, comparison))


def _marked(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a model's tree with ``empirical: true`` in every effect that names no cause."""
    from inflight.effects import known_effects

    shapes = {name for name, kind in known_effects().items() if kind.empirical}
    effects = [
        {**entry, "empirical": True} if entry.get("empirical") or entry["effect"] in shapes else entry
        for entry in tree["effects"]
    ]
    return {**tree, "effects": effects}


def _dipoles(tree: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each source that the other sensor sees, too."""
    for entry in tree["effects"]:
        if dipole := entry.get("dipole"):
            place = ", ".join(_number(one) for one in dipole["position"])
            yield (
                f"{entry.get('name', entry['effect'])}: a dipole at {place} m, each known to "
                f"{_number(dipole['sigma'])} m; the other sensor has its part of it"
            )


def _rows(tree: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield one row a component; effect and parameter stand in the first of theirs."""
    for entry in tree["effects"]:
        parts = {key: part for key, part in entry.items() if isinstance(part, Mapping)}
        numbers = {key: part for key, part in parts.items() if "value" in part or "time" in part}
        label, sensor = str(entry.get("name", entry["effect"])), str(entry.get("sensor", ""))
        if not numbers:
            yield (label, sensor, "", "", "", "", "", "")
        for key, part in numbers.items():
            if part.get("time") == "table":
                yield (label, sensor, key, str(part["table"]), "", str(part.get("unit", "")), "table", "held")
                label = sensor = ""
                continue
            fit, time = "free" if part.get("free") else "held", str(part.get("time", "constant"))
            for axis, value, sigma in _components(part):
                name = f"{key}[{axis}]" if axis else key
                yield (label, sensor, name, *_told(value, sigma), str(part.get("unit", "")), time, fit)
                label = sensor = ""


def _numbers(tree: Mapping[str, Any]) -> Iterator[tuple[str, tuple[Any, Any, str]]]:
    """Yield value, sigma and unit of each number of a model, by its name as `set` takes it."""
    for entry in tree["effects"]:
        label = str(entry.get("name", entry["effect"]))
        for key, part in entry.items():
            if not isinstance(part, Mapping) or "value" not in part:
                continue
            for axis, value, sigma in _components(part):
                name = f"{label}.{key}" + (f"[{axis}]" if axis else "")
                yield name, (value, sigma, str(part.get("unit", "")))


def _components(part: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield axis, value and sigma of each component of a parameter; one that has no axes has an empty one."""
    values = part["value"] if isinstance(part["value"], Mapping) else {"": part["value"]}
    sigmas = part.get("sigma")
    for axis, value in values.items():
        yield str(axis), value, sigmas.get(axis) if isinstance(sigmas, Mapping) else sigmas


def _hardly(was: tuple[Any, ...], now: tuple[Any, ...]) -> bool:
    """Return True when neither a value nor its sigma moved by a hundredth of the sigma that was."""
    numbers = (*was[:2], *now[:2])
    if not all(isinstance(one, float | int) for one in numbers) or not was[1] > 0:
        return False
    return all(abs(b - a) < _HARDLY * was[1] for a, b in zip(was[:2], now[:2], strict=True))


def _told(value: Any, sigma: Any) -> tuple[str, str]:
    """Return a value and its sigma with the digits that the sigma leaves; without one, all that is stated."""
    if isinstance(value, float | int) and isinstance(sigma, float | int) and sigma > 0:
        return with_error(float(value), float(sigma))
    return _number(value), _number(sigma)


def _number(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_number(each) for each in value)
    return "" if value is None else f"{value:.{_DIGITS}g}"
