"""Provenance: models, contexts and delivered files, and what was made from what.

A *context* pins mission, model version and tables of a run. *Lineage* is a set of edges between ids such as
``day:12``, ``table:4``, ``file:<sha256>``, ``context:<sha256>`` and ``model:<name>@<version>``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, NamedTuple

from sqlalchemy import ColumnElement, insert, select
from sqlalchemy.orm import Session

from inflight.catalog.database import time_in_order
from inflight.catalog.records import ContextRecord, Day, FileRecord, ModelRecord, Validity, sha256_text
from inflight.catalog.schema import ContextRow, DatasetRow, DayRow, EdgeRow, FileRow, ModelRow, TableRow
from inflight.catalog.validity import require_tables
from inflight.errors import CatalogError

#: Databases bound the number of values in one statement.
_BATCH: Final = 500


def save_model(
    session: Session,
    name: str,
    text: str,
    parent: int | None,
    message: str,
    new_version: bool = False,
    change: Mapping[str, Any] | None = None,
) -> int:
    """Save a model file; see `Catalog.save_model`."""
    sha256 = sha256_text(text)
    versions = session.scalars(select(ModelRow).where(ModelRow.name == name).order_by(ModelRow.version)).all()
    known = {row.version for row in versions}
    if parent is not None and parent not in known:
        raise CatalogError(
            f"model '{name}' has no version {parent}", remedy=f"use one of {sorted(known) or 'none'}"
        )
    same = [row.version for row in versions if row.sha256 == sha256]
    if same and not new_version:
        return same[-1]
    version = max(known, default=0) + 1
    created = time_in_order(session, ModelRow.created).isoformat(timespec="seconds")
    session.add(
        ModelRow(
            name=name,
            version=version,
            parent=parent,
            text=text,
            sha256=sha256,
            message=message,
            created=created,
            change=None if change is None else dict(change),
        )
    )
    session.flush()
    return version


def model_text(session: Session, name: str | None, version: int | None) -> tuple[str, int, str]:
    """Return name, version and text of a model; see `Catalog.model_text`."""
    query = select(ModelRow).order_by(ModelRow.id.desc())
    if name is not None:
        query = query.where(ModelRow.name == name).order_by(None).order_by(ModelRow.version.desc())
    if version is not None:
        query = query.where(ModelRow.version == version)
    row = session.scalars(query.limit(1)).first()
    if row is None:
        known = ", ".join(f"{item.name} {item.version}" for item in model_records(session)) or "none"
        raise CatalogError(
            f"model {name or ''} version {version or 'latest'} is not in the catalog, which has: {known}",
            remedy="save it first",
        )
    return row.name, row.version, row.text


def model_records(session: Session) -> list[ModelRecord]:
    """Return the history of all models, oldest first."""
    rows = session.scalars(select(ModelRow).order_by(ModelRow.id))
    return [row.as_record(ModelRecord) for row in rows]


def save_context(
    session: Session, mission_text: str, model: tuple[str, int], tables: Mapping[str, Sequence[Validity]]
) -> str:
    """Save a context and its lineage; see `Catalog.save_context`."""
    name, version = model
    model_text(session, name, version)
    pinned = {table: [list(one) for one in spans] for table, spans in tables.items()}
    numbers = sorted({number for spans in pinned.values() for number, _, _ in spans})
    require_tables(session, numbers)
    context = sha256_text(json.dumps([mission_text, name, version, sorted(pinned.items())]))
    if session.get(ContextRow, context) is None:
        session.add(
            ContextRow(
                id=context,
                mission_text=mission_text,
                model_name=name,
                model_version=version,
                tables=pinned,
            )
        )
        made_from = [f"model:{name}@{version}", *(f"table:{number}" for number in numbers)]
        add_edges(session, (Edge(parent, f"context:{context}") for parent in made_from))
    return context


def context_record(session: Session, context: str) -> ContextRecord:
    """Return what a context pins; see `Catalog.context`."""
    row = session.get(ContextRow, context)
    if row is None:
        raise CatalogError(f"context {context[:12]!r} is not in the catalog", remedy="save it first")
    pinned = {
        name: tuple((int(one[0]), int(one[1]), int(one[2])) for one in row.tables[name])
        for name in row.tables
    }
    return row.as_record(ContextRecord, tables=pinned)


def record_files(session: Session, run_id: str, records: Iterable[FileRecord]) -> None:
    """Record delivered files for a run; they count as taken in when the run publishes."""
    for record in records:
        row = session.scalar(
            select(FileRow).where(
                FileRow.run_id == run_id,
                FileRow.instrument == record.instrument,
                FileRow.path == record.path,
            )
        )
        if row is None:
            row = FileRow(run_id=run_id, instrument=record.instrument, path=record.path)
            session.add(row)
        row.sha256, row.size, row.mtime_ns = record.sha256, record.size, record.mtime_ns
        row.days, row.report, row.taken = list(record.days), dict(record.report), False


def file_records(session: Session, instrument: str) -> dict[str, FileRecord]:
    """Return the files taken in for an instrument by path, each as it was last."""
    rows = session.scalars(
        select(FileRow).where(FileRow.instrument == instrument, FileRow.taken).order_by(FileRow.id)
    )
    return {row.path: row.as_record(FileRecord, days=tuple(row.days), run=row.run_id) for row in rows}


class Edge(NamedTuple):
    """`child` was made from `parent`."""

    parent: str
    child: str


def parent_ids(parents: Iterable[Day | str]) -> list[str]:
    """Return lineage ids of parents given as days or as ids."""
    return [parent.id if isinstance(parent, Day) else str(parent) for parent in parents]


def add_edges(session: Session, edges: Iterable[Edge]) -> None:
    """Record edges; those that are known already stay as they are."""
    new = dict.fromkeys(Edge(*edge) for edge in edges)
    children = list(dict.fromkeys(edge.child for edge in new))
    known = set(_edges(session, EdgeRow.child, children))
    rows = [edge._asdict() for edge in new if edge not in known]
    if rows:
        # In one statement: a table has an edge to every day it was made from.
        session.execute(insert(EdgeRow), rows)


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


def parent_names(session: Session, edges: Iterable[Edge], children: Iterable[str]) -> dict[str, list[str]]:
    """Return child -> what it was made from, in words that hold in any workspace: ``kind>name``, sorted.

    A day reads ``day>l1/fgm 2005-01-01 v01.00``, a file ``file>name sha256:...``, a table ``table>name key``
    and a context the model it pins, ``model>name@version``.
    """
    wanted = set(children)
    direct = [edge for edge in edges if edge.child in wanted]
    by_kind: dict[str, set[str]] = {}
    for edge in direct:
        kind, _, rest = edge.parent.partition(":")
        by_kind.setdefault(kind, set()).add(rest)
    words: dict[str, str] = {}
    for kind, found in by_kind.items():
        items = sorted(found)
        for first in range(0, len(items), _BATCH):
            words |= _words_of(session, kind, items[first : first + _BATCH])
    out: dict[str, set[str]] = {}
    for edge in direct:
        out.setdefault(edge.child, set()).add(words.get(edge.parent, edge.parent.replace(":", ">", 1)))
    return {child: sorted(names) for child, names in out.items()}


def _words_of(session: Session, kind: str, items: list[str]) -> dict[str, str]:
    if kind == "day":
        query = (
            select(DayRow.id, DatasetRow.name, DayRow.day, DayRow.baseline, DayRow.revision)
            .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
            .where(DayRow.id.in_(map(int, items)))
        )
        return {
            f"day:{id}": f"day>{name} {day} "
            + ("" if baseline is None else f"v{baseline:02d}.{revision:02d}")
            for id, name, day, baseline, revision in session.execute(query)
        }
    if kind == "file":
        files = select(FileRow.sha256, FileRow.path).where(FileRow.sha256.in_(items)).order_by(FileRow.id)
        return {f"file:{sha256}": f"file>{path} sha256:{sha256}" for sha256, path in session.execute(files)}
    if kind == "table":
        tables = select(TableRow.id, TableRow.name, TableRow.key).where(TableRow.id.in_(map(int, items)))
        return {f"table:{id}": f"table>{name} {key}".rstrip() for id, name, key in session.execute(tables)}
    if kind == "context":
        contexts = select(ContextRow).where(ContextRow.id.in_(items))
        return {
            f"context:{row.id}": f"model>{row.model_name}@{row.model_version}"
            for row in session.scalars(contexts)
        }
    return {}


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
