"""Dask processes that are killed while they work, and a client killed while they go on."""

import os
import signal
import threading
import time

import pytest
from fault_cases import BATCH, assert_whole, view
from test_faults_killed import settled

from inflight.catalog import Catalog, Workspace
from inflight.errors import WorkerError
from inflight.flows import dask_client
from inflight.tasks.archive import ingest
from inflight.tasks.pipelines import ReprocessSettings, reprocess


@pytest.fixture(scope="module")
def client():
    with dask_client(2) as shared:
        yield shared


def still_running(dask_worker):
    return len(dask_worker.state.executing) + len(dask_worker.active_threads)


def asked_to_die(dask_worker):
    # `os.environ.get` itself would be sent with a copy of this process's environment.
    return os.environ.get("INFLIGHT_KILL_AT")


def worker_pids(client):
    return list(client.run(os.getpid).values())


@pytest.mark.parametrize("work", ["ingest", "reprocess"])
def test_a_worker_killed_in_the_middle_is_replaced_and_the_run_ends_as_if_undisturbed(
    client, stage, fresh, views, work
):
    before, after = {"ingest": ("redelivered", "taken_in"), "reprocess": ("taken_in", "reprocessed")}[work]
    workspace = fresh(before)
    mission, catalog = Workspace.open(workspace).mission(), Catalog(workspace)
    victim, killed = worker_pids(client)[0], threading.Event()

    def kill_once(stage_name, done, total):
        if stage_name != "index" and done >= 1 and not killed.is_set():
            killed.set()
            os.kill(victim, signal.SIGKILL)

    if work == "ingest":
        report = ingest(
            catalog, mission, workspace / "data", client=client, batch_days=BATCH, progress=kill_once
        )
    else:
        settings = ReprocessSettings(batch_days=BATCH)
        report = reprocess(catalog, mission, settings=settings, client=client, progress=kill_once)
    assert killed.is_set()
    assert report.exit_code == 0, report.problems
    assert view(workspace) == views[after]
    assert_whole(workspace)


def test_a_client_killed_while_its_workers_go_on_leaves_the_old_view(client, stage, fresh, views):
    workspace = fresh("taken_in")
    pid = stage.begin("reprocess", workspace, scheduler=client.scheduler.address, batch_days=BATCH)
    time.sleep(0.5)
    os.kill(pid, signal.SIGKILL)
    assert stage.ended(pid).code == -signal.SIGKILL
    assert view(workspace) == views["taken_in"]
    # A task whose client is gone is cancelled for the scheduler, but its process finishes what it began.
    deadline = time.monotonic() + 60
    while any(client.run(still_running).values()) and time.monotonic() < deadline:
        time.sleep(0.1)
    settled(stage, workspace, "reprocess", views)


def test_work_that_kills_every_worker_it_meets_fails_cleanly(stage, fresh, views, monkeypatch):
    import dask

    workspace = fresh("redelivered")
    mission, catalog = Workspace.open(workspace).mission(), Catalog(workspace)
    monkeypatch.setenv("INFLIGHT_KILL_AT", "segment_begun")
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), dask_client(1) as deadly:
        told = list(deadly.run(asked_to_die).values())
        assert told == ["segment_begun"]
        with pytest.raises(WorkerError, match="1 Dask processes") as caught:
            ingest(catalog, mission, workspace / "data", client=deadly, batch_days=BATCH)
    assert caught.value.cause == "transient"
    assert catalog.runs()[-1].cause == "transient"
    assert not settled(stage, workspace, "ingest", views)
