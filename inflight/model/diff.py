"""What differs between two models, for a program and for a person; it needs their texts alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from inflight.errors import ModelError

Entry = Mapping[str, Any]

#: How a float is shown to a person; the structured change keeps all digits.
_DIGITS = 9


def parse_tree(text: str, source: str = "model.yaml") -> dict[str, Any]:
    """Return a model's YAML as plain mappings, lists, numbers and texts; no effect is made.

    Raises
    ------
    ModelError
        When the text is no YAML, or holds no list ``effects``.
    """
    try:
        tree = YAML(typ="safe").load(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f"line {mark.line + 1}: " if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise ModelError(
            f"{line}not YAML: {problem}", file=source, remedy="check indentation and quotes"
        ) from None
    if not isinstance(tree, dict) or not isinstance(tree.get("effects"), list):
        raise ModelError(
            "the file holds no list 'effects'",
            file=source,
            remedy="missions/models/champ-preflight.yaml shows one",
        )
    return tree


def name_of(entry: Entry) -> str:
    """Return the name of an effect's entry: its own, or the effect's."""
    return str(entry.get("name") or entry.get("effect", ""))


def changes(before: Sequence[Entry], after: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return what `after` has that `before` has not, and the other way round.

    Returns
    -------
    list of dict
        ``change`` (added, dropped, changed, moved), ``effect``, ``key`` (parameter or option; dotted
        down to what differs), ``from`` and ``to`` (None where there is none) and ``sentence``.
    """
    mine, theirs = ({name_of(entry): entry for entry in entries} for entries in (before, after))
    found = [_change_record("added", name, to=dict(theirs[name])) for name in theirs if name not in mine]
    found += [_change_record("dropped", name, was=dict(mine[name])) for name in mine if name not in theirs]
    for name in mine:
        if name in theirs:
            found += [
                _change_record("changed", name, key, was, to)
                for key, was, to in _differences(mine[name], theirs[name])
            ]
    # Effects that both have, in another order: the order is that of correction.
    kept, now = [name for name in mine if name in theirs], [name for name in theirs if name in mine]
    found += [
        _change_record("moved", name, was=kept.index(name) + 1, to=place + 1)
        for place, name in enumerate(now)
        if kept[place] != name
    ]
    return found


def _differences(before: Entry, after: Entry, place: str = "") -> list[tuple[str, Any, Any]]:
    found = []
    for key in [*before, *(key for key in after if key not in before)]:
        was, to = before.get(key), after.get(key)
        inner = f"{place}{key}"
        if was == to:
            continue
        if isinstance(was, Mapping) and isinstance(to, Mapping):
            found += _differences(was, to, f"{inner}.")
        else:
            found.append((inner, was, to))
    return found


def _change_record(
    change: str, effect: str, key: str = "", was: Any = None, to: Any = None
) -> dict[str, Any]:
    sentences = {
        "added": f"added {effect}",
        "dropped": f"dropped {effect}",
        "changed": f"changed {effect}.{key}: {_as_text(was)} -> {_as_text(to)}",
        "moved": f"moved {effect} from place {was} to {to}",
    }
    return {
        "change": change,
        "effect": effect,
        "key": key,
        "from": was,
        "to": to,
        "sentence": sentences[change],
    }


def _as_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.{_DIGITS}g}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_as_text(inner)}' for key, inner in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_as_text, value))}]"
    return "nothing" if value is None else str(value)
