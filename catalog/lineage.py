"""Lineage as a graph in plain words, both ways: what something was made from, and what was made from it.

In go a name that a person writes (`lineage_ids`) and the edges between ids that the catalog keeps
(`inflight.catalog.provenance`); out comes a `LineageGraph`, whose nodes are all things of one kind and name
(the days of a dataset, the files of an instrument), as text or as SVG.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final, Literal, NamedTuple

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from inflight.catalog.days import current_day, dataset_names, published_days
from inflight.catalog.provenance import Edge, walk
from inflight.catalog.records import version_text
from inflight.catalog.schema import (
    CertificationRow,
    ContextRow,
    CurrentRow,
    DatasetRow,
    DayRow,
    FileRow,
    ModelRow,
    NamedContextRow,
    ReleaseDayRow,
    ReleaseRow,
    TableRow,
)
from inflight.catalog.spans import Span, as_date
from inflight.errors import CatalogError
from inflight.time import to_utc

Side = Literal["up", "here", "down"]

#: Databases bound the number of values in one statement.
_BATCH: Final = 500
#: What the days of a dataset are, by the first part of its name.
_DAY_KINDS: Final = {
    "l1": "archive",
    "l2": "product",
    "equations": "normal equations",
    "comparison": "kept of a comparison",
}
#: What several things are called, by the kind of their ids.
_THINGS: Final = {
    "day": "days",
    "file": "files",
    "table": "tables",
    "context": "contexts",
    "model": "versions",
    "release": "releases",
}
#: Okabe and Ito's colours, darkened where text has them.
_COLOURS: Final = {
    "file": "#666666",
    "archive": "#00699e",
    "product": "#00785a",
    "calibration table": "#a84a00",
    "release": "#8a3f73",
}


@dataclass(frozen=True, kw_only=True)
class LineageItem:
    """One thing: its lineage id and its name in words; `in_use` is False for what something later replaced.

    `first` and `last` are the UTC days it is of, None where it is of none.
    """

    id: str
    name: str
    in_use: bool = True
    first: dt.date | None = None
    last: dt.date | None = None


@dataclass(frozen=True, kw_only=True)
class LineageNode:
    """All things of one kind and name on one side of what was asked for.

    Attributes
    ----------
    key : str
        Unique in the graph.
    kind : str
        What they are, in words: delivered files, archive, product, calibration table, release, ...
    title : str
        Their common name: the dataset, the instrument, the table; empty for contexts and releases.
    items : tuple of LineageItem
    side : {'up', 'here', 'down'}
        Made before what was asked for, that itself, or made from it.
    """

    key: str
    kind: str
    title: str
    items: tuple[LineageItem, ...]
    side: Side

    @property
    def heading(self) -> str:
        """Kind and title."""
        return f"{self.kind} {self.title}".strip()

    @property
    def text(self) -> str:
        """Which they are, in words."""
        return describe_items(self.items)


@dataclass(frozen=True, kw_only=True)
class LineageLink:
    """Things of the node `child` were made from things of the node `parent`.

    `parents` are those of them that were used, `children` those that were made.
    """

    parent: str
    child: str
    parents: tuple[LineageItem, ...]
    children: tuple[LineageItem, ...]


@dataclass(frozen=True, kw_only=True)
class LineageGraph:
    """What something was made from and what was made from it; `edges` are those of the catalog.

    `name` is what was asked for, in words.
    """

    name: str
    nodes: tuple[LineageNode, ...]
    links: tuple[LineageLink, ...]
    edges: tuple[Edge, ...]

    def text(self) -> str:
        """Return the graph as two indented lists: what it was made from, and what was made from it."""
        return "\n".join(_lines(self))

    def svg(self) -> str:
        """Return the graph as an SVG: inputs on the left, what was made from them on the right."""
        return _picture(self)


def describe_items(items: Sequence[LineageItem]) -> str:
    """Return in words which things of one kind and name these are."""
    if len(items) == 1:
        return items[0].name
    things = _THINGS.get(items[0].id.partition(":")[0], "things")
    text = f"{len(items)} {things}"
    if days := {item.first for item in items if item.first is not None}:
        last = max(item.last for item in items if item.last is not None)
        same = len(days) == len(items) or not items[0].id.startswith("day:")
        text = text if same else f"{len(items)} revisions of {len(days)} days"
        text += f", {min(days)} to {last}"
    else:
        text += (
            f": {items[0].name} … {items[-1].name}"
            if len(items) > 2
            else f": {items[0].name}, {items[1].name}"
        )
    used = sum(item.in_use for item in items)
    return text if used == len(items) else f"{text}; {used or 'none'} in use"


def lineage_graph(session: Session, named: str, direction: str) -> LineageGraph:
    """Return what something was made from (``up``), what was made from it (``down``), or ``both``."""
    ids, name = lineage_ids(session, named)
    edges: dict[Edge, None] = {}
    sides: dict[str, Side] = dict.fromkeys(ids, "here")
    for side in ("up", "down"):
        if direction not in (side, "both"):
            continue
        found = list(_walk(session, ids, up=side == "up"))
        edges |= dict.fromkeys(found)
        for edge in found:
            sides.setdefault(edge.parent if side == "up" else edge.child, side)
    known = _known_items(session, sides)
    groups: dict[tuple[Side, str, str], list[LineageItem]] = {}
    for item, side in sides.items():
        kind, title, record = known.get(item) or (
            "unknown",
            "not in the catalog",
            LineageItem(id=item, name=item),
        )
        groups.setdefault((side, kind, title), []).append(record)
    nodes = tuple(
        LineageNode(key=f"{side}:{kind}:{title}", kind=kind, title=title, items=_sorted(items), side=side)
        for (side, kind, title), items in groups.items()
    )
    return LineageGraph(name=name, nodes=nodes, links=tuple(_links(nodes, edges)), edges=tuple(edges))


def _links(nodes: Iterable[LineageNode], edges: Iterable[Edge]) -> Iterator[LineageLink]:
    place = {item.id: (node.key, item) for node in nodes for item in node.items}
    joined: dict[tuple[str, str], tuple[dict[str, LineageItem], dict[str, LineageItem]]] = {}
    for edge in edges:
        (parent, made_from), (child, made) = place[edge.parent], place[edge.child]
        if parent == child:  # a day made from the day before it
            continue
        parents, children = joined.setdefault((parent, child), ({}, {}))
        parents[edge.parent], children[edge.child] = made_from, made
    for (parent, child), (parents, children) in joined.items():
        yield LineageLink(
            parent=parent,
            child=child,
            parents=_sorted(parents.values()),
            children=_sorted(children.values()),
        )


def _sorted(items: Iterable[LineageItem]) -> tuple[LineageItem, ...]:
    return tuple(sorted(items, key=lambda item: (item.first or dt.date.min, _number(item.id), item.name)))


def _number(item: str) -> int:
    _, _, number = item.partition(":")
    return int(number) if number.isdigit() else 0


# --- what a person writes ---------------------------------------------------------------------------


def lineage_ids(session: Session, named: str) -> tuple[list[str], str]:
    """Return the lineage ids that a name stands for, and what that is in words.

    Parameters
    ----------
    named : str
        ``l2/field@2005-01-10`` (its present revision) or ``l2/field`` (all of them), ``main-window:4`` or
        ``main-window`` (its newest table), the name or path of a delivered file, ``model:2``,
        ``context:NAME``, ``release:1.0``, or a lineage id such as ``day:12``.

    Raises
    ------
    CatalogError
        When there is no such thing, or a file's name stands for several.
    """
    kind, _, rest = named.partition(":")
    finders: dict[str, Callable[[Session, str], list[str]]] = {
        "release": _releases_named,
        "model": _models_named,
        "context": _contexts_named,
        "file": _files_named,
    }
    if kind in ("day", "table") and rest.isdigit():
        ids = [named] if _known_items(session, [named]) else []
    elif kind in finders:
        ids = finders[kind](session, rest)
    else:
        ids = (
            _days_named(session, named) or _tables_named(session, kind, rest) or _files_named(session, named)
        )
    if not ids:
        raise CatalogError(
            f"the catalog knows no {named!r}",
            remedy="name a day as l2/field@2005-01-10, a table as main-window:4, a release as release:1.0, "
            "model:2, context:NAME, or a delivered file",
        )
    known = _known_items(session, ids)
    (kind, title, _), *_ = known.values()
    return ids, f"{title or kind}: {describe_items(_sorted(record for _, _, record in known.values()))}"


def _days_named(session: Session, named: str) -> list[str]:
    name, _, date = named.partition("@")
    if name not in dataset_names(session, [name]):
        return []
    if not date:
        return [day.id for day in published_days(session, name, Span(None, None), None)]
    try:
        day = as_date(date)
    except ValueError as error:
        raise CatalogError(f"{date!r} is no day", remedy="write it as 2005-01-10") from error
    found = current_day(session, name, day)
    return [] if found is None else [found.id]


def _tables_named(session: Session, name: str, number: str) -> list[str]:
    query = (
        select(TableRow.id).where(TableRow.name == name.removeprefix("tables/")).order_by(TableRow.id.desc())
    )
    if number:
        query = query.where(TableRow.id == (int(number) if number.isdigit() else -1))
    return [f"table:{one}" for one in session.scalars(query.limit(1))]


def _files_named(session: Session, named: str) -> list[str]:
    if re.fullmatch("[0-9a-f]{64}", named):
        return [f"file:{named}"] if session.scalar(select(FileRow.id).where(FileRow.sha256 == named)) else []
    if not named:
        return []
    found: dict[str, str] = {}
    for path, sha256 in session.execute(
        select(FileRow.path, FileRow.sha256)
        .where(FileRow.path.endswith(named, autoescape=True))
        .order_by(FileRow.id)
    ):
        if PurePath(path).parts[-len(PurePath(named).parts) :] == PurePath(named).parts:
            # One that was delivered again: the last one.
            found[path] = sha256
    if len(found) > 1:
        raise CatalogError(
            f"{len(found)} files are called {named!r}", remedy=f"one of {', '.join(sorted(found)[:5])}"
        )
    return [f"file:{sha256}" for sha256 in found.values()]


def _models_named(session: Session, named: str) -> list[str]:
    name, _, version = named.rpartition("@")
    query = select(ModelRow.name, ModelRow.version).where(
        ModelRow.version == (int(version) if version.isdigit() else -1)
    )
    if name:
        query = query.where(ModelRow.name == name)
    return [f"model:{one}@{number}" for one, number in session.execute(query)]


def _contexts_named(session: Session, named: str) -> list[str]:
    ids = session.scalars(select(NamedContextRow.context_id).where(NamedContextRow.name == named))
    found = list(dict.fromkeys(ids))
    if not found and re.fullmatch("[0-9a-f]{8,64}", named):
        found = list(session.scalars(select(ContextRow.id).where(ContextRow.id.startswith(named))))
    return [f"context:{one}" for one in found]


def _releases_named(session: Session, named: str) -> list[str]:
    found = session.scalar(select(ReleaseRow.version).where(ReleaseRow.version == named))
    return [] if found is None else [f"release:{found}"]


# --- edges ------------------------------------------------------------------------------------------


def _walk(session: Session, ids: Sequence[str], *, up: bool) -> Iterator[Edge]:
    """Yield all edges from ids to one side; those between a release and its days are among them."""
    start = list(ids)
    if up:
        for version in (one.partition(":")[2] for one in ids if one.startswith("release:")):
            held = session.scalars(
                select(ReleaseDayRow.day_id)
                .join(ReleaseRow, ReleaseRow.id == ReleaseDayRow.release_id)
                .where(ReleaseRow.version == version)
            )
            days = [f"day:{number}" for number in held]
            yield from (Edge(day, f"release:{version}") for day in days)
            start += days
        yield from walk(session, start, up=True)
        return
    edges = walk(session, start, up=False)
    yield from edges
    numbers = sorted(
        {int(one[4:]) for one in (*ids, *(edge.child for edge in edges)) if one.startswith("day:")}
    )
    for batch in _batches(numbers):
        held_by = (
            select(ReleaseDayRow.day_id, ReleaseRow.version)
            .join(ReleaseRow, ReleaseRow.id == ReleaseDayRow.release_id)
            .where(ReleaseDayRow.day_id.in_(batch))
            .order_by(ReleaseRow.id, ReleaseDayRow.day_id)
        )
        yield from (Edge(f"day:{day}", f"release:{version}") for day, version in session.execute(held_by))


def _batches(values: Sequence[Any]) -> Iterator[Sequence[Any]]:
    return (values[first : first + _BATCH] for first in range(0, len(values), _BATCH))


# --- names of ids -----------------------------------------------------------------------------------


class _Named(NamedTuple):
    """What a thing is, in words, the name it shares with others, and the thing."""

    kind: str
    title: str
    item: LineageItem


def _known_items(session: Session, ids: Iterable[str]) -> dict[str, _Named]:
    """Return what the ids are; those that the catalog does not know are left out."""
    by_kind: dict[str, list[str]] = {}
    for one in ids:
        kind, _, rest = one.partition(":")
        by_kind.setdefault(kind, []).append(rest)
    readers: dict[str, Callable[[Session, Sequence[str]], Iterator[_Named]]] = {
        "day": _named_days,
        "file": _named_files,
        "table": _named_tables,
        "context": _named_contexts,
        "model": _named_models,
        "release": _named_releases,
    }
    found: dict[str, _Named] = {}
    for kind, names in by_kind.items():
        for batch in _batches(names) if kind in readers else ():
            found |= {one.item.id: one for one in readers[kind](session, batch)}
    return found


def _named_days(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    query: Select[Any] = (
        select(DayRow.id, DatasetRow.name, DayRow.day, DayRow.baseline, DayRow.revision, CurrentRow.day_id)
        .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
        .outerjoin(CurrentRow, CurrentRow.day_id == DayRow.id)
        .where(DayRow.id.in_([int(one) for one in ids]))
    )
    for number, name, day, baseline, revision, current in session.execute(query):
        version = "not published" if baseline is None else version_text(baseline, revision)
        text = f"{day} {version}"
        yield _Named(
            _DAY_KINDS.get(name.partition("/")[0], "days"),
            name,
            LineageItem(
                id=f"day:{number}",
                name=text if current is not None else f"{text}, not in use any more",
                in_use=current is not None,
                first=day,
                last=day,
            ),
        )


def _named_files(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    query = select(FileRow).where(FileRow.sha256.in_(ids)).order_by(FileRow.id)
    for row in session.scalars(query):
        days = sorted(dt.date.fromisoformat(day) for day in row.days)
        item = LineageItem(
            id=f"file:{row.sha256}",
            name=PurePath(row.path).name,
            first=days[0] if days else None,
            last=days[-1] if days else None,
        )
        yield _Named("delivered files", row.instrument, item)


def _named_tables(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    numbers = [int(one) for one in ids]
    certified = set(
        session.scalars(select(CertificationRow.table_id).where(CertificationRow.table_id.in_(numbers)))
    )
    for row in session.scalars(select(TableRow).where(TableRow.id.in_(numbers))):
        first, last = (as_date(to_utc(edge)) for edge in (row.start, max(row.end - 1, row.start)))
        valid = row.id in certified
        name = f"table {row.id}, {first} to {last}"
        item = LineageItem(
            id=f"table:{row.id}",
            name=name if valid else f"{name}, not valid any more",
            in_use=valid,
            first=first,
            last=last,
        )
        yield _Named("calibration table", row.name, item)


def _named_contexts(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    names: dict[str, list[str]] = {}
    query = select(NamedContextRow.context_id, NamedContextRow.name).where(
        NamedContextRow.context_id.in_(ids)
    )
    for context, name in session.execute(query):
        names.setdefault(context, []).append(name)
    for row in session.scalars(select(ContextRow).where(ContextRow.id.in_(ids))):
        called = ", ".join(sorted(set(names.get(row.id, []))))
        text = f"mission file with model {row.model_name} {row.model_version} ({row.id[:8]})"
        item = LineageItem(id=f"context:{row.id}", name=f"{called}: {text}" if called else text)
        yield _Named("context", "", item)


def _named_models(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    names = {one.rpartition("@")[0] for one in ids}
    for row in session.scalars(select(ModelRow).where(ModelRow.name.in_(names)).order_by(ModelRow.id)):
        if f"{row.name}@{row.version}" in ids:
            item = LineageItem(id=f"model:{row.name}@{row.version}", name=f"version {row.version}")
            yield _Named("model", row.name, item)


def _named_releases(session: Session, ids: Sequence[str]) -> Iterator[_Named]:
    for row in session.scalars(select(ReleaseRow).where(ReleaseRow.version.in_(ids)).order_by(ReleaseRow.id)):
        item = LineageItem(id=f"release:{row.version}", name=f"{row.version} ({row.maturity})")
        yield _Named("release", "", item)


# --- text and picture -------------------------------------------------------------------------------


def _lines(graph: LineageGraph) -> Iterator[str]:
    place = {item.id: (node, item) for node in graph.nodes for item in node.items}
    yield graph.name
    for side, head in (("up", "made from"), ("down", "made from it")):
        if not any(node.side == side for node in graph.nodes):
            continue
        yield head
        near: dict[str, list[str]] = {}
        for edge in graph.edges:
            one, other = (edge.child, edge.parent) if side == "up" else (edge.parent, edge.child)
            if place[other][0].side == side:
                near.setdefault(one, []).append(other)
        shown: dict[str, set[str]] = {}
        for node in graph.nodes:
            if node.side == "here":
                yield from _branch(node.items, near, place, shown, 1)


def _branch(
    items: Iterable[LineageItem],
    near: Mapping[str, Sequence[str]],
    place: Mapping[str, tuple[LineageNode, LineageItem]],
    shown: dict[str, set[str]],
    depth: int,
) -> Iterator[str]:
    """Yield a line for each node next to some things, and below it the lines of what is next to that."""
    found: dict[str, tuple[LineageNode, dict[str, LineageItem]]] = {}
    for item in items:
        for other in near.get(item.id, ()):
            node, next_item = place[other]
            found.setdefault(node.key, (node, {}))[1][other] = next_item
    for key, (node, part) in found.items():
        before = shown.setdefault(key, set())
        repeated = part.keys() <= before and any(other in near for other in part)
        of = f" (of {len(node.items)})" if len(part) < len(node.items) else ""
        above = " (see above)" if repeated else ""
        yield f"{'  ' * depth}{node.heading}: {describe_items(_sorted(part.values()))}{of}{above}"
        if not part.keys() <= before:
            before.update(part)
            yield from _branch(part.values(), near, place, shown, depth + 1)


def _picture(graph: LineageGraph) -> str:
    from inflight.figures import Arrow, Box, graph_picture

    places = {node.key: at for at, node in enumerate(graph.nodes)}
    boxes = [
        Box(
            title=node.title or node.kind,
            kind=node.kind if node.title else "",
            text=node.text,
            colour=_COLOURS.get(node.kind, "#444444"),
            tip="\n".join([node.heading, *(item.name for item in node.items[:40])]),
            marked=node.side == "here",
        )
        for node in graph.nodes
    ]
    arrows = []
    for link in graph.links:
        parent = graph.nodes[places[link.parent]]
        part = len(link.parents) < len(parent.items)
        text = f"{len(link.parents)} of {len(parent.items)}" if part else ""
        arrows.append(Arrow(places[link.parent], places[link.child], text))
    return graph_picture(f"Lineage of {graph.name}", boxes, arrows)
