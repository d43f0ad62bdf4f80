"""Models, contexts and delivered files: what the numbers of a workspace rest on."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Mapping

from sqlalchemy import select
from sqlalchemy.orm import Session

from inflight.catalog.lineage import Edge, add_edges
from inflight.catalog.records import ContextRecord, FileRecord, ModelRecord, sha256_text
from inflight.catalog.schema import ContextRow, FileRow, ModelRow
from inflight.catalog.validity import require_tables
from inflight.errors import CatalogError


def save_model(
    session: Session, name: str, text: str, parent: int | None, message: str, new_version: bool = False
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
    created = dt.datetime.now(dt.UTC).isoformat(timespec="seconds")
    session.add(
        ModelRow(
            name=name,
            version=version,
            parent=parent,
            text=text,
            sha256=sha256,
            message=message,
            created=created,
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
    return [
        ModelRecord(
            name=row.name,
            version=row.version,
            parent=row.parent,
            message=row.message,
            sha256=row.sha256,
            created=row.created,
        )
        for row in session.scalars(select(ModelRow).order_by(ModelRow.id))
    ]


def save_context(
    session: Session, mission_text: str, model: tuple[str, int], tables: Mapping[str, int]
) -> str:
    """Save a context and its lineage; see `Catalog.save_context`."""
    name, version = model
    model_text(session, name, version)
    require_tables(session, list(tables.values()))
    context = sha256_text(json.dumps([mission_text, name, version, sorted(tables.items())]))
    if session.get(ContextRow, context) is None:
        session.add(
            ContextRow(
                id=context,
                mission_text=mission_text,
                model_name=name,
                model_version=version,
                tables=dict(tables),
            )
        )
        made_from = [f"model:{name}@{version}", *(f"table:{table}" for table in tables.values())]
        add_edges(session, (Edge(parent, f"context:{context}") for parent in made_from))
    return context


def context_record(session: Session, context: str) -> ContextRecord:
    """Return what a context pins; see `Catalog.context`."""
    row = session.get(ContextRow, context)
    if row is None:
        raise CatalogError(f"context {context[:12]!r} is not in the catalog", remedy="save it first")
    return ContextRecord(row.id, row.mission_text, row.model_name, row.model_version, row.tables)


def record_file(session: Session, run_id: str, record: FileRecord) -> None:
    """Record a delivered file for a run; it counts as taken in when the run publishes."""
    row = session.scalar(
        select(FileRow).where(
            FileRow.run_id == run_id, FileRow.instrument == record.instrument, FileRow.path == record.path
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
    return {
        row.path: FileRecord(
            instrument=row.instrument,
            path=row.path,
            sha256=row.sha256,
            size=row.size,
            mtime_ns=row.mtime_ns,
            days=tuple(row.days),
            report=row.report,
            run=row.run_id,
        )
        for row in rows
    }
