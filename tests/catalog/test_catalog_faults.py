"""Faults made for real: processes killed, disks full, writers and readers at one time."""

import errno
import multiprocessing
import os
import signal
import subprocess
import threading
import time

import numpy as np
import pytest
from catalog_cases import (
    GENERATION_DAYS,
    days_from,
    generation_seen,
    hold_a_run,
    publish,
    publish_generations,
    publish_seed,
    publish_until_told,
    samples,
    save_a_model,
    spawn,
    write_under_a_size_limit,
)
from store_cases import unfinished_stores

from inflight.catalog import Catalog, DayData, write_segment
from inflight.catalog.faultpoints import POINTS
from inflight.errors import StorageError

BOTH_DATABASES = True
RUN_POINTS = [point for point in POINTS if not point.startswith("release")]


def ended(process):
    process.join(timeout=60)
    return process.exitcode


def table_value(catalog):
    return float(catalog.table("offsets", 50)["value"].values[0, 0])


def assert_whole(catalog):
    assert [fault for fault in catalog.verify() if fault["item"] != "file:abc"] == []
    assert unfinished_stores(catalog.workspace) == []
    assert [run.state for run in catalog.runs() if run.state == "running"] == []


@pytest.mark.parametrize("point", [*RUN_POINTS, "segment_written:2", "manifest_written:3", "attach:2"])
def test_a_kill_at_any_named_point_shows_all_old_or_all_new_and_a_rerun_completes(
    catalog, reopened_after_death, point
):
    publish_seed(catalog, 0)
    killed = spawn(publish_generations, catalog.workspace, 1, 2, kill_at=point)
    assert ended(killed) == -signal.SIGKILL, "the point was not reached"
    reopened = reopened_after_death()
    expected = 1 if point == "published" else 0
    assert generation_seen(reopened) == expected
    assert table_value(reopened) == expected
    assert_whole(reopened)
    dead = reopened.runs()[-1]
    assert (dead.state, dead.cause) == ("failed", "transient")
    publish_seed(reopened, 1)
    assert generation_seen(reopened) == 1
    assert_whole(reopened)
    reopened.gc(dry_run=False)
    assert generation_seen(reopened) == 1


def test_a_rerun_adopts_what_the_killed_run_had_verified(catalog, reopened_after_death):
    publish_seed(catalog, 0)
    ended(spawn(publish_generations, catalog.workspace, 1, 2, kill_at="publish_begun"))
    reopened = reopened_after_death()
    left = reopened.runs()[-1].id
    publish_seed(reopened, 1)
    assert {left} == {day.segment.split("/")[1] for day in reopened.days("l2/field")}


@pytest.mark.parametrize("trial", range(5))
def test_a_kill_at_a_random_moment_shows_one_generation(catalog, reopened_after_death, trial):
    publish_seed(catalog, 0)
    mine, theirs = multiprocessing.Pipe()
    process = spawn(publish_generations, catalog.workspace, 1, 1000, theirs)
    assert mine.recv() == "ready"
    time.sleep(np.random.default_rng(trial).uniform(0.0, 0.7))
    process.kill()
    assert ended(process) == -signal.SIGKILL
    reopened = reopened_after_death()
    seen = generation_seen(reopened)
    assert table_value(reopened) == seen
    assert_whole(reopened)
    publish_seed(reopened, seen + 1)
    assert generation_seen(reopened) == seen + 1


def test_readers_see_one_generation_while_others_are_published(catalog):
    publish_seed(catalog, 0)
    mine, theirs = multiprocessing.Pipe()
    process = spawn(publish_until_told, catalog.workspace, theirs)
    seen, failures, deadline = set(), [], time.monotonic() + 60

    def read():
        while process.is_alive() and len(seen) < 4 and not failures and time.monotonic() < deadline:
            try:
                seen.add(generation_seen(Catalog(catalog.workspace, create=False)))
            except AssertionError as error:
                failures.append(error)

    readers = [threading.Thread(target=read) for _ in range(2)]
    for reader in readers:
        reader.start()
    for reader in readers:
        reader.join()
    mine.send("enough")
    assert ended(process) == 0
    last = mine.recv()
    assert failures == []
    assert len(seen) > 3, "the readers did not meet publications"
    assert generation_seen(catalog) == last


def test_two_writers_wait_for_each_other_and_no_revision_is_lost_or_reused(catalog):
    publish_seed(catalog, 0)
    writers = [spawn(publish_generations, catalog.workspace, first, first + 5) for first in (100, 200)]
    assert [ended(writer) for writer in writers] == [0, 0]
    for day in GENERATION_DAYS:
        seeds = [
            int(catalog.read_day("l2/field", day, ["seed"], version=f"v01.{revision:02d}")["seed"][0])
            for revision in range(11)
        ]
        assert sorted(seeds) == [0, *range(100, 105), *range(200, 205)]
    generation_seen(catalog)
    assert_whole(catalog)


def test_several_processes_may_create_a_workspace_at_once(workspace):
    makers = [spawn(save_a_model, workspace, f"text {number}") for number in range(4)]
    assert [ended(maker) for maker in makers] == [0] * 4
    assert [record.version for record in Catalog(workspace).models()] == [1, 2, 3, 4]


def test_a_live_run_of_another_process_is_left_alone(catalog):
    mine, theirs = multiprocessing.Pipe()
    process = spawn(hold_a_run, catalog.workspace, theirs)
    mine.recv()
    assert [run.state for run in Catalog(catalog.workspace).runs()] == ["running"]
    mine.send("end")
    assert ended(process) == 0
    assert [run.state for run in Catalog(catalog.workspace).runs()] == ["done"]


def test_a_run_of_another_host_is_not_judged_without_a_lease(tmp_path, monkeypatch):
    import socket

    catalog = Catalog(tmp_path)

    with monkeypatch.context() as elsewhere:
        elsewhere.setattr(socket, "gethostname", lambda: "another-host")
        catalog.run("far").__enter__()
    assert [run.state for run in Catalog(catalog.workspace).runs()] == ["running"]


def test_a_file_size_limit_while_writing_publishes_nothing(catalog):
    """The same error path as a full disk, on any system: the kernel refuses a write in the middle."""
    publish_seed(catalog, 0)
    mine, theirs = multiprocessing.Pipe()
    process = spawn(write_under_a_size_limit, catalog.workspace, theirs)
    cause, remedy = mine.recv()
    assert ended(process) == 0
    assert (cause, remedy[:10]) == ("transient", "free space")
    assert generation_seen(catalog) == 0
    assert unfinished_stores(catalog.workspace) == []
    assert not (catalog.workspace / "stores" / "run").exists()


@pytest.fixture
def small_disk(tmp_path):
    """A real file system of 6 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    told = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if told.returncode != 0:
        pytest.skip(
            f"mounting a small tmpfs is not permitted here ({told.stderr.strip()}); the size limit is tested"
        )
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder, leave):
    """Fill a disk until `leave` bytes are left."""
    status = os.statvfs(folder)
    size = status.f_bavail * status.f_frsize - leave
    (folder / "ballast").write_bytes(b"\0" * size)


def ingest(catalog, data, before_attach=lambda: None):
    with catalog.run("ingest") as run:
        segment = write_segment(catalog.workspace, run.id, "l1/fgm", data)
        before_attach()
        for day in days_from("2010-01-01", 400):
            run.record("l1/other", day, "failed", "bug", "x" * 1000)
        run.attach(segment)
        run.publish()


def test_a_full_disk_stops_the_write_and_a_rerun_after_freeing_completes(small_disk):
    catalog = Catalog(small_disk / "workspace")
    days = days_from("2005-01-01", 2)
    publish(catalog, "l1/fgm", days)
    before = catalog.days("l1/fgm")
    fill(small_disk, 200_000)
    with pytest.raises(StorageError) as caught:
        ingest(catalog, [DayData(day, samples(day, step_s=5)) for day in days])
    assert caught.value.cause == "transient"
    assert os.strerror(errno.ENOSPC) in str(caught.value)
    assert catalog.days("l1/fgm") == before
    assert unfinished_stores(catalog.workspace) == []
    (small_disk / "ballast").unlink()
    publish(catalog, "l1/fgm", days, seed=1)
    assert {day.version for day in catalog.days("l1/fgm")} == {"v01.01"}


def test_a_database_that_cannot_grow_loses_nothing(small_disk):
    """Full to the last byte, SQLite cannot even open its log; after freeing, everything is as it was."""
    catalog = Catalog(small_disk / "workspace")
    days = days_from("2005-01-01", 2)
    publish(catalog, "l1/fgm", days)
    before = catalog.days("l1/fgm")
    with pytest.raises(StorageError) as caught:
        ingest(catalog, [DayData(days[0], samples(days[0], seed=1))], lambda: fill(small_disk, 0))
    assert caught.value.cause == "transient"
    (small_disk / "ballast").unlink()
    reopened = Catalog(small_disk / "workspace")
    assert reopened.days("l1/fgm") == before
    publish(reopened, "l1/fgm", days, seed=1)
    assert {day.version for day in reopened.days("l1/fgm")} == {"v01.01"}
