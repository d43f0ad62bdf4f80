"""Named contexts: a name for what each comparison pins, so that it can be made again and compared.

A context pins a mission's text, a model's version and which calibration table is valid when
(`inflight.catalog.provenance`); its id is the hash of these, so what a name stands for never changes. A name
has one context for each comparison of the mission.
"""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import delete, or_, select
from sqlalchemy.orm import Session

from inflight.catalog.database import time_in_order
from inflight.catalog.records import NamedContext
from inflight.catalog.schema import DayRow, NamedContextRow, ReleaseDayRow, ReleaseRow
from inflight.errors import CatalogError, did_you_mean


def named_contexts(session: Session, name: str | None = None) -> list[NamedContext]:
    """Return what names stand for, or one of them, in order of time and comparison.

    Raises
    ------
    CatalogError
        When there is no such name.
    """
    rows = session.scalars(
        select(NamedContextRow).order_by(
            NamedContextRow.created, NamedContextRow.name, NamedContextRow.comparison
        )
    ).all()
    found = [
        row.as_record(NamedContext, context=row.context_id, run=row.run_id)
        for row in rows
        if name in (None, row.name)
    ]
    if name is not None and not found:
        known = sorted({row.name for row in rows})
        raise CatalogError(
            f"there is no context {name!r}{did_you_mean(name, known)}",
            remedy=f"the catalog has {', '.join(known)}"
            if known
            else "make one: 'inflight catalog context make'",
        )
    return found


def name_contexts(session: Session, name: str, contexts: Iterable[NamedContext]) -> None:
    """Give contexts, one a comparison, a name; see `Catalog.name_contexts`."""
    if session.scalar(select(NamedContextRow.name).where(NamedContextRow.name == name).limit(1)):
        raise CatalogError(
            f"context {name!r} is there already, and what it stands for does not change",
            remedy="choose another name, or remove it first",
        )
    created = time_in_order(session, NamedContextRow.created).isoformat(timespec="seconds")
    for one in contexts:
        session.add(
            NamedContextRow(
                name=name,
                comparison=one.comparison,
                context_id=one.context,
                run_id=one.run,
                author=one.author,
                reason=one.reason,
                as_of=one.as_of,
                created=created,
            )
        )


def remove_named_context(session: Session, name: str) -> None:
    """Forget a name; see `Catalog.remove_context`."""
    named = named_contexts(session, name)
    if releases := releases_of(session, [one.context for one in named]):
        raise CatalogError(
            f"context {name!r} is what release {', '.join(releases)} was made in",
            remedy="it stays as long as the release does",
        )
    session.execute(delete(NamedContextRow).where(NamedContextRow.name == name))


def releases_of(session: Session, contexts: Iterable[str]) -> list[str]:
    """Return the versions of the releases that hold days made in some contexts, oldest first."""
    ids = list(contexts)
    held = (
        select(ReleaseRow.version)
        .join(ReleaseDayRow, ReleaseDayRow.release_id == ReleaseRow.id, isouter=True)
        .join(DayRow, DayRow.id == ReleaseDayRow.day_id, isouter=True)
        .where(or_(ReleaseRow.context.in_(ids), DayRow.context.in_(ids)))
        .group_by(ReleaseRow.id, ReleaseRow.version)
        .order_by(ReleaseRow.id)
    )
    return list(session.scalars(held))
