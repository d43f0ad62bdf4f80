"""What a workspace shows to its readers, to be compared before and after a fault."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import numpy as np
from store_cases import unfinished_stores
from tiny_mission import TINY_OFFSET, TINY_START, deliver_tiny_day

from inflight.catalog import Catalog

#: Days of the workspaces that are killed, and days of a batch: several segments, and several a stage.
COUNT, BATCH = 4, 2
DAYS = [str(day) for day in np.datetime64(TINY_START, "D") + np.arange(COUNT)]
PRODUCTS = ("equations/main/base", "l2/field")
#: What a diagnosis keeps of each day.
BLOCKS = "equations/main/library"
ARCHIVE = ("l1/absolute", "l1/turning")


def deliver(workspace: Path, seed: int) -> None:
    """Deliver all days, in another version of what was measured for each seed.

    The offsets drift so far from day to day that the days' equations need a second pass of linearisation.
    """
    for number, day in enumerate(DAYS):
        deliver_tiny_day(workspace / "data", day, seed, TINY_OFFSET + 60.0 * number)


def copied(workspace: Path, target: Path) -> Path:
    """Return a copy of a workspace; the times of its files stay, so no delivery looks new."""
    return Path(shutil.copytree(workspace, target, symlinks=True))


def view(workspace: Path, datasets=(*ARCHIVE, *PRODUCTS, BLOCKS), tables: bool = True) -> dict:
    """Return everything a reader sees, run and path names apart: for each day its version, key, report and
    the sha256 of its store's manifest; for each table its validities and manifest."""
    catalog = Catalog(workspace)
    seen: dict = {}
    for name in datasets:
        for day in catalog.days(name, states=["published"]):
            files = {e.parent for e in catalog.lineage(day) if e.parent.startswith("file:")}
            seen[name, str(day.day)] = (
                day.version,
                day.key,
                day.rows,
                dict(day.report),
                _manifest(workspace / day.segment),
                sorted(files),
            )
    for record in catalog.tables() if tables else ():
        for valid in record.certified:
            seen["table", record.name, *valid] = _manifest(workspace / record.segment)
    return seen


def versions(seen: dict) -> dict[str, set[str]]:
    """Return dataset -> versions that are visible in a view."""
    found: dict[str, set[str]] = {}
    for key, told in seen.items():
        if key[0] != "table":
            found.setdefault(key[0], set()).add(told[0])
    return found


def _manifest(store: Path) -> str:
    return hashlib.sha256((store / "MANIFEST.sha256").read_bytes()).hexdigest()


def assert_whole(workspace: Path) -> None:
    """Nothing in use is damaged, nothing half-made lies about, no run seems to be going on."""
    catalog = Catalog(workspace)
    assert catalog.verify() == []
    assert unfinished_stores(workspace) == []
    assert [run.id for run in catalog.runs() if run.state == "running"] == []
