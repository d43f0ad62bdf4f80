"""Verbs about the model: ``model show``, ``diff`` and ``history``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from inflight.cli.session import Session, verb

if TYPE_CHECKING:
    from rich.console import Console

    from inflight.catalog import Catalog, ModelRecord

model = typer.Typer(
    help="Look into the model: its effects, versions and what they change.", no_args_is_help=True
)

ComparisonOption = Annotated[str | None, typer.Option("--comparison", help="Comparison of the mission.")]
ModelArgument = Annotated[str, typer.Argument(help="Version (3), name, or both (champ-preflight:3).")]
#: Digits a value is shown with; --json has all.
_DIGITS = 9


@dataclass(frozen=True)
class _Version:
    """A text of a model, and what the catalog knows of it."""

    name: str
    version: int
    text: str
    record: ModelRecord | None = None

    @property
    def fields(self) -> dict[str, Any]:
        """Name, version and parent; version and parent are None for a model not used yet."""
        parent = self.record.parent if self.record else None
        return {"name": self.name, "version": self.version or None, "parent": parent}

    @property
    def told(self) -> str:
        """How a person calls it."""
        return f"{self.name} version {self.version}" if self.version else f"{self.name}, not used yet"


class _Versions:
    """The models of a workspace; nothing is saved by looking at them."""

    def __init__(self, session: Session, comparison: str | None) -> None:
        from inflight.tasks.models import find_model

        self._cat: Catalog = session.open_catalog()
        mission = session.open_workspace().mission()
        used = find_model(self._cat, mission, _comparison(mission, comparison))
        self._records = {(record.name, record.version): record for record in self._cat.models()}
        self.used = self._version(used.model.name, used.version, used.text)

    def _version(self, name: str, version: int, text: str) -> _Version:
        return _Version(name, version, text, self._records.get((name, version)))

    def named(self, text: str | None) -> _Version:
        """Return the version a person names: its number, a name's newest, or ``name:number``."""
        from inflight.effects.naming import did_you_mean
        from inflight.errors import CatalogError

        if text is None:
            return self.used
        name, _, number = text.rpartition(":") if ":" in text else ("", "", text)
        if not number.isdigit():
            name, number = text, ""
        name = name or self.used.name
        known = [key for key in self._records if key[0] == name and number in ("", str(key[1]))]
        if not known:
            listed = [f"{one}:{version}" for one, version in self._records]
            names = [one for one, _ in self._records]
            raise CatalogError(
                f"there is no model {text!r}{did_you_mean(text, [*listed, *names])}",
                remedy=f"the catalog has {', '.join(listed) or 'none yet; reprocess saves the first'}",
            )
        return self._version(*self._cat.model_text(*known[-1]))

    def items(self) -> list[dict[str, Any]]:
        """Return every version, oldest first, with a mark at the one in use."""
        return [
            {
                "name": record.name,
                "version": record.version,
                "parent": record.parent,
                "message": record.message,
                "created": record.created,
                "sha256": record.sha256,
                "used": key == (self.used.name, self.used.version),
            }
            for key, record in self._records.items()
        ]


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
    from inflight.model.changes import tree_of

    found = _Versions(session, comparison).named(named)
    tree = tree_of(found.text)
    message = found.record.message if found.record else ""

    def show(console: Console) -> None:
        made = f" (from version {found.fields['parent']})" if found.fields["parent"] else ""
        told = f": {message}" if message else ""
        console.print(f"{found.told}{made}{told}", soft_wrap=True, markup=False)
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
    from inflight.model.changes import changes, tree_of

    versions = _Versions(session, comparison)
    old, new = versions.named(before), versions.named(after)
    found = changes(tree_of(old.text)["effects"], tree_of(new.text)["effects"])

    def show(console: Console) -> None:
        console.print(f"{old.told} -> {new.told}")
        for change in found:
            console.print(f"  {change['sentence']}", soft_wrap=True, markup=False)
        if not found:
            console.print("  nothing differs")

    fields = {"command": "model diff", "from": old.fields, "to": new.fields, "changes": found}
    session.emit(fields, show)


@verb(model, "history")
def model_history(session: Session, *, comparison: ComparisonOption = None) -> None:
    """List the versions of the workspace's models: from what each was made, why and when."""
    items = _Versions(session, comparison).items()

    def show(console: Console) -> None:
        if not items:
            console.print("No model has been used yet. Next: inflight reprocess")
            return
        console.print(_plain_table(("", "name", "version", "parent", "message", "created", "sha256"), items))

    session.emit({"command": "model history", "items": items}, show)


def _comparison(mission: Any, named: str | None) -> str:
    from inflight.effects.naming import did_you_mean
    from inflight.errors import SettingsError

    name = named or ("main" if "main" in mission.comparisons else next(iter(mission.comparisons), "main"))
    if name not in mission.comparisons:
        raise SettingsError(
            f"comparison: the mission has no {name!r}{did_you_mean(name, mission.comparisons)}",
            remedy=f"it has {', '.join(mission.comparisons) or 'none'}",
        )
    return name


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
