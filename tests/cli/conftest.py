"""Running the command line in this process."""

import json
from dataclasses import dataclass
from typing import Any

import pytest

from inflight.cli import main
from inflight.flows.cluster import SCHEDULER_VARIABLE, dask_client


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


@pytest.fixture(scope="session")
def scheduler():
    """The address of one scheduler with two Dask processes for all files of commands."""
    with dask_client(2) as client:
        yield str(client.scheduler.address)


@pytest.fixture(scope="module", autouse=True)
def shared_cluster(scheduler):
    """Let commands use processes that run, as a team with a scheduler has it; see `own_cluster`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(SCHEDULER_VARIABLE, scheduler)
        yield


@pytest.fixture
def own_cluster(monkeypatch):
    """Let commands start processes of their own, as they do on a machine by itself."""
    monkeypatch.delenv(SCHEDULER_VARIABLE)


@pytest.fixture
def inflight(capsys, monkeypatch):
    """Run one command line and return its exit code and what it printed."""
    # Wide and plain, so that assertions do not depend on the terminal the tests run in.
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")

    def run(*arguments: object) -> Outcome:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        return Outcome(int(left.value.code or 0), printed.out, printed.err)

    return run
