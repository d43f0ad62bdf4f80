"""Disks that are full, read-only, gone or wrong: a clear error, nothing half-visible, a rerun completes."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from fault_cases import ARCHIVE, BATCH, DAYS, copied, view
from test_faults_killed import WORK, settled

from inflight.catalog import Catalog
from inflight.catalog.stores import open_store
from inflight.errors import IntegrityError


def mounted(folder: Path, *options: str) -> None:
    """Mount a file system on a folder, or skip the test with the reason why not."""
    folder.mkdir(parents=True, exist_ok=True)
    told = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True, check=False)
    if told.returncode != 0:
        pytest.skip(f"mounting is not permitted here ({told.stderr.strip()}); the size limit is tested")


@pytest.fixture
def small_disk(tmp_path):
    """A real file system of 24 MB."""
    mounted(tmp_path / "disk", "-t", "tmpfs", "-o", "size=24m", "tmpfs")
    yield tmp_path / "disk"
    subprocess.run(["umount", "-l", str(tmp_path / "disk")], check=True)


def leave(disk: Path, size: int) -> Path:
    """Fill a disk until so many bytes are left; return the file that takes the room."""
    status = os.statvfs(disk)
    ballast = disk / "ballast"
    ballast.write_bytes(b"\0" * (status.f_bavail * status.f_frsize - size))
    return ballast


def assert_refused(ended):
    """Assert that the error is the disk's, can pass, and says what to do."""
    assert ended.code == 1, ended
    assert ended.error["kind"] == "StorageError"
    assert ended.error["cause"] == "transient"
    assert "space" in ended.error["remedy"]


@pytest.mark.parametrize(
    ("work", "left"), [("ingest", 60_000), ("reprocess", 60_000), ("reprocess", 700_000)]
)
def test_a_full_disk_stops_a_run_and_after_freeing_it_completes(stage, states, views, small_disk, work, left):
    workspace = copied(states[WORK[work][0]], small_disk / "workspace")
    ballast = leave(small_disk, left)
    assert_refused(stage.run(work, workspace, batch_days=BATCH))
    assert view(workspace) == views[WORK[work][0]]
    ballast.unlink()
    assert not settled(stage, workspace, work, views)


@pytest.mark.parametrize("work", ["ingest", "reprocess"])
def test_a_file_size_limit_stops_a_run_in_the_same_way(stage, fresh, views, work):
    workspace = fresh(WORK[work][0])
    ended = stage.run(work, workspace, file_limit=6000, batch_days=BATCH)
    assert ended.code == 1, ended
    assert ended.error["kind"] == "StorageError"
    assert ended.error["remedy"]
    assert not settled(stage, workspace, work, views)


@pytest.mark.parametrize("work", ["ingest", "reprocess"])
def test_a_read_only_workspace_refuses_work_and_says_what_to_do(stage, states, views, tmp_path, work):
    workspace = tmp_path / "sealed"
    mounted(workspace, "--bind", str(states[WORK[work][0]]))
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", str(workspace)], check=True)
        ended = stage.run(work, workspace)
    finally:
        subprocess.run(["umount", "-l", str(workspace)], check=True)
    assert ended.code == 1
    assert ended.error["kind"] == "StorageError"
    assert "make the workspace writable" in ended.error["remedy"]
    assert view(states[WORK[work][0]]) == views[WORK[work][0]]


def test_deliveries_that_vanished_change_nothing_and_the_archive_stays(stage, fresh, views):
    workspace = fresh("taken_in")
    shutil.rmtree(workspace / "data")
    ended = stage.run("ingest", workspace, batch_days=BATCH)
    assert ended.code == 0
    assert ended.report["days"]["unchanged"] == 2 * len(DAYS)
    assert view(workspace) == views["taken_in"]
    assert not settled(stage, workspace, "reprocess", views)


def test_stores_that_vanished_are_each_named_and_reading_them_is_an_error(fresh):
    workspace = fresh("reprocessed")
    shutil.rmtree(workspace / "stores")
    catalog = Catalog(workspace)
    assert {"l1/turning", "l2/field", "tables/main-window"} <= {fault["item"] for fault in catalog.verify()}
    with pytest.raises(IntegrityError, match="cannot be opened"):
        catalog.read_day("l2/field", DAYS[0])


def damage(path: Path, seed: int) -> None:
    """Flip one bit of a file."""
    generator = np.random.default_rng(seed)
    content = bytearray(path.read_bytes())
    content[generator.integers(0, len(content))] ^= 1 << int(generator.integers(0, 8))
    path.chmod(0o644)
    path.write_bytes(content)


@pytest.mark.parametrize("dataset", [*ARCHIVE, "equations/main/base", "l2/field"])
def test_any_flipped_bit_of_a_chunk_is_found_and_never_read_as_numbers(fresh, dataset):
    workspace = fresh("reprocessed")
    catalog = Catalog(workspace)
    day = catalog.current(dataset, DAYS[1])
    row = day.rows[0] // catalog_chunk(workspace / day.segment)
    store = workspace / day.segment
    hit = DAYS[1]
    if dataset.startswith("equations/"):  # its days share a chunk
        row, hit = 0, "|".join(DAYS)
    in_rows = open_store(str(store)).in_rows
    chunks = sorted(path for path in store.glob(f"*/c.{row}*") if in_rows(path.parent.name))
    assert len(chunks) >= 3
    for seed, chunk in enumerate(chunks):
        whole = chunk.read_bytes()
        damage(chunk, seed)
        (fault,) = catalog.verify(dataset)
        assert fault["path"] == chunk.relative_to(workspace).as_posix()
        with pytest.raises(IntegrityError) as caught:
            catalog.read_day(dataset, DAYS[1])
        assert caught.value.day == DAYS[1]
        assert caught.value.channel == chunk.parent.name
        if chunk.parent.name != "tt2000":  # even spacing is known without a read
            with pytest.raises(IntegrityError, match=hit):
                catalog.open(dataset).load()
        chunk.write_bytes(whole)
    assert catalog.verify() == []


def catalog_chunk(store: Path) -> int:
    return open_store(str(store)).chunk


def test_a_damaged_day_of_the_archive_fails_alone_and_is_named(stage, fresh, views):
    workspace = fresh("taken_in")
    day = Catalog(workspace).current("l1/turning", DAYS[1])
    row = day.rows[0] // catalog_chunk(workspace / day.segment)
    damage(next((workspace / day.segment / "field").glob(f"c.{row}.*")), 0)
    report = stage.run("reprocess", workspace, batch_days=BATCH).report
    assert report["days"]["failed"] == 1
    (problem,) = report["problems"]
    assert problem["day"] == DAYS[1]
    assert "l1.turning" in problem["message"]
    assert problem["remedy"]


def test_two_reprocessings_at_once_both_end_and_leave_one_result(stage, fresh, views):
    workspace = fresh("taken_in")
    both = [stage.begin("reprocess", workspace, batch_days=BATCH) for _ in range(2)]
    ended = [stage.ended(pid) for pid in both]
    assert [one.code for one in ended] == [0, 0], [one.error for one in ended]
    assert settled(stage, workspace, "reprocess", views)


@pytest.mark.parametrize("trial", range(3))
def test_a_kill_at_a_random_moment_of_either(stage, fresh, views, trial):
    work = ("ingest", "reprocess")[trial % 2]
    workspace = fresh(WORK[work][0])
    pid = stage.begin(work, workspace, batch_days=BATCH)
    time.sleep(np.random.default_rng(trial).uniform(0.05, 0.5))
    os.kill(pid, signal.SIGKILL)
    in_time = stage.ended(pid).code == -signal.SIGKILL
    assert settled(stage, workspace, work, views) or in_time
