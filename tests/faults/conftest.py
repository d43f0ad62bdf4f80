"""Workspaces in the states that faults befall, made once and copied for each test."""

import shutil
import tempfile
from pathlib import Path

import pytest
from fault_cases import BATCH, COUNT, copied, deliver, view
from fault_stage import Stage
from postgres_server import running_server
from tiny_mission import make_tiny_workspace

postgres_server = pytest.fixture(scope="session")(running_server)


@pytest.fixture(scope="session")
def stage():
    """Where processes that may be killed are begun."""
    running = Stage()
    yield running
    running.close()


@pytest.fixture(scope="session")
def memory(tmp_path_factory):
    """A folder in memory where there is one: a killed process loses nothing that it wrote, so that waiting
    for a disk, half of the time of a run this small, would prove nothing."""
    if not Path("/dev/shm").is_dir():
        yield tmp_path_factory.mktemp("faults")
        return
    folder = Path(tempfile.mkdtemp(prefix="inflight-faults-", dir="/dev/shm"))
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="session")
def states(stage, memory) -> dict[str, Path]:
    """A mission redelivered: `redelivered` shows the old archive and products, `taken_in` the new archive
    beside the old products, `reprocessed` everything new; no run of theirs was disturbed."""
    folder = memory / "states"
    redelivered = make_tiny_workspace(folder / "redelivered", COUNT)
    assert stage.run("ingest", redelivered, batch_days=BATCH).code == 0
    assert stage.run("reprocess", redelivered, batch_days=BATCH).code == 0
    deliver(redelivered, seed=1)
    taken_in = copied(redelivered, folder / "taken_in")
    assert stage.run("ingest", taken_in, batch_days=BATCH).code == 0
    reprocessed = copied(taken_in, folder / "reprocessed")
    assert stage.run("reprocess", reprocessed, batch_days=BATCH).code == 0
    return {"redelivered": redelivered, "taken_in": taken_in, "reprocessed": reprocessed}


@pytest.fixture(scope="session")
def views(states) -> dict[str, dict]:
    """What readers see in each of the states."""
    return {name: view(workspace) for name, workspace in states.items()}


@pytest.fixture
def fresh(states, memory):
    """Return a function that copies a workspace of `states` by name."""
    folder = Path(tempfile.mkdtemp(dir=memory))
    yield lambda name: copied(states[name], folder / name)
    shutil.rmtree(folder)
