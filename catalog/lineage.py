"""Lineage: what was made from what, as edges between ids such as ``day:12`` and ``file:<sha256>``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session

from inflight.catalog.records import Day
from inflight.catalog.schema import ContextRow, DayRow, EdgeRow, FileRow, ModelRow, TableRow

#: Databases bound the number of values in one statement.
_BATCH: Final = 500


class Edge(NamedTuple):
    """`child` was made from `parent`."""

    parent: str
    child: str


def parent_ids(parents: Iterable[Day | str]) -> list[str]:
    """Return lineage ids of parents given as days or as ids."""
    return [parent.id if isinstance(parent, Day) else str(parent) for parent in parents]


def add_edges(session: Session, edges: Iterable[Edge]) -> None:
    """Record edges; those already there are left."""
    new = dict.fromkeys(Edge(*edge) for edge in edges)
    children = list(dict.fromkeys(edge.child for edge in new))
    known = set(_edges(session, EdgeRow.child, children))
    session.add_all(EdgeRow(parent=edge.parent, child=edge.child) for edge in new if edge not in known)


def walk(session: Session, ids: Iterable[str], *, up: bool) -> list[Edge]:
    """Return all edges reachable from `ids` towards their parents (`up`) or children, nearest first."""
    found: dict[Edge, None] = {}
    frontier = list(dict.fromkeys(ids))
    seen = set(frontier)
    while frontier:
        edges = _edges(session, EdgeRow.child if up else EdgeRow.parent, frontier)
        found |= dict.fromkeys(edges)
        frontier = list(dict.fromkeys((edge.parent if up else edge.child) for edge in edges))
        frontier = [item for item in frontier if item not in seen]
        seen.update(frontier)
    return list(found)


def unknown_ids(session: Session, ids: Iterable[str]) -> list[str]:
    """Return the lineage ids that name nothing in the catalog."""
    by_kind: dict[str, list[str]] = {}
    for item in dict.fromkeys(ids):
        by_kind.setdefault(item.partition(":")[0], []).append(item)
    return sorted(
        item for kind, items in by_kind.items() for item in set(items) - _known(session, kind, items)
    )


def _known(session: Session, kind: str, items: list[str]) -> set[str]:
    columns: dict[str, Any] = {
        "day": DayRow.id,
        "table": TableRow.id,
        "file": FileRow.sha256,
        "context": ContextRow.id,
    }
    if kind == "model":
        return {
            f"model:{name}@{version}"
            for name, version in session.execute(select(ModelRow.name, ModelRow.version))
        }
    if kind not in columns:
        return set()
    column, numbers = columns[kind], kind in {"day", "table"}
    values = [item.partition(":")[2] for item in items]
    keys: list[Any] = [int(value) for value in values if value.isdigit()] if numbers else values
    known: set[str] = set()
    for first in range(0, len(keys), _BATCH):
        batch = keys[first : first + _BATCH]
        known |= {f"{kind}:{value}" for value in session.scalars(select(column).where(column.in_(batch)))}
    return known


def _edges(session: Session, column: Any, ids: list[str]) -> list[Edge]:
    edges: list[Edge] = []
    for first in range(0, len(ids), _BATCH):
        condition: ColumnElement[bool] = column.in_(ids[first : first + _BATCH])
        rows = session.execute(select(EdgeRow.parent, EdgeRow.child).where(condition))
        edges += [Edge(parent, child) for parent, child in rows]
    return edges
