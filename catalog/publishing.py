"""Publication: one transaction moves the pointers of all days of a run."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sqlalchemy import func, select, tuple_, update
from sqlalchemy.orm import Session

from inflight.catalog.database import Database
from inflight.catalog.days import day_record
from inflight.catalog.faultpoints import fault_point
from inflight.catalog.manifest import manifest_sha256
from inflight.catalog.records import Day, version_text
from inflight.catalog.schema import CurrentRow, DatasetRow, DayRow, FileRow, SettingRow, StoreRow
from inflight.catalog.validity import Certification, certify_table
from inflight.errors import CatalogError, IntegrityError

#: Setting that holds the release baseline, the XX of ``vXX.YY``.
BASELINE_SETTING: Final = "baseline"

_Place = tuple[int, dt.date]


def publish_run(
    workspace: Path, database: Database, run_id: str, certify: Sequence[Certification], *, supersede: bool
) -> list[Day]:
    """Publish a run's verified days; see `Run.publish`."""
    with database.write() as session:
        fault_point("publish_begun")
        rows = session.execute(
            select(DayRow, StoreRow, DatasetRow.name)
            .join(StoreRow, StoreRow.id == DayRow.store_id)
            .join(DatasetRow, DatasetRow.id == DayRow.dataset_id)
            .where(DayRow.run_id == run_id, DayRow.state == "verified")
            .order_by(DatasetRow.name, DayRow.day)
        ).all()
        _check_stores(workspace, {store.path: store.sha256 for _, store, _ in rows})
        published = _move_pointers(session, run_id, [row for row, _, _ in rows])
        for certification in certify:
            certify_table(session, certification, supersede=supersede)
        # A delivered file counts as taken in only with the days that were made from it.
        session.execute(update(FileRow).where(FileRow.run_id == run_id).values(taken=True))
        session.flush()
        fault_point("publish_flushed")
    fault_point("published")
    return [day_record(row, name, store.path) for row, store, name in rows if row.id in published]


def baseline_of(session: Session) -> int:
    """Return the workspace's release baseline."""
    setting = session.get(SettingRow, BASELINE_SETTING)
    return int(setting.value) if setting else 1


def raise_baseline(session: Session, baseline: int) -> None:
    """Begin a new release baseline; see `Catalog.set_baseline`."""
    present = baseline_of(session)
    if baseline < present:
        raise CatalogError(f"baseline {baseline} is lower than the present {present}", remedy="raise it")
    session.merge(SettingRow(name=BASELINE_SETTING, value=str(baseline)))


def _check_stores(workspace: Path, manifests: dict[str, str]) -> None:
    for path, sha256 in manifests.items():
        if manifest_sha256(workspace / path) != sha256:
            raise IntegrityError(
                "the manifest is not the one that was verified", file=path, remedy="run again"
            )


def _move_pointers(session: Session, run_id: str, rows: Sequence[DayRow]) -> set[int]:
    """Give each row its version and make it the present one; return the ids of the published."""
    baseline = baseline_of(session)
    present = _present(session, run_id)
    revisions = _newest_revisions(session, run_id, baseline)
    published = set()
    for row in rows:
        place = (row.dataset_id, row.day)
        pointer, old = present.get(place, (None, None))
        if old is not None and row.key and row.key == old.key and old.baseline == baseline:
            row.state, row.cause = "no_work", "no_work"
            row.message = f"already published as {version_text(old.baseline, old.revision or 0)}"
            continue
        row.state, row.baseline, row.revision = "published", baseline, revisions.get(place, -1) + 1
        published.add(row.id)
        if pointer is None:
            session.add(CurrentRow(dataset_id=row.dataset_id, day=row.day, day_id=row.id))
        else:
            pointer.day_id = row.id
    return published


def _present(session: Session, run_id: str) -> dict[_Place, tuple[CurrentRow, DayRow]]:
    mine = select(DayRow.dataset_id, DayRow.day).where(DayRow.run_id == run_id)
    query = (
        select(CurrentRow, DayRow)
        .join(DayRow, DayRow.id == CurrentRow.day_id)
        .where(tuple_(CurrentRow.dataset_id, CurrentRow.day).in_(mine))
    )
    return {(pointer.dataset_id, pointer.day): (pointer, old) for pointer, old in session.execute(query)}


def _newest_revisions(session: Session, run_id: str, baseline: int) -> dict[_Place, int]:
    mine = select(DayRow.dataset_id, DayRow.day).where(DayRow.run_id == run_id)
    query = (
        select(DayRow.dataset_id, DayRow.day, func.max(DayRow.revision))
        .where(DayRow.baseline == baseline, tuple_(DayRow.dataset_id, DayRow.day).in_(mine))
        .group_by(DayRow.dataset_id, DayRow.day)
    )
    return {(dataset, day): revision or 0 for dataset, day, revision in session.execute(query)}
