"""A workspace with a hidden field, calibrated, to be looked at."""

import shutil

import panel as pn
import pytest
from heated_mission import make_heated_workspace

from inflight.catalog import Catalog, Workspace
from inflight.tasks.analysis import diagnose_span
from inflight.tasks.pipelines import reprocess


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory) -> Workspace:
    """Four days with the field of a heater that no model knows, diagnosed; copied, never changed."""
    made = make_heated_workspace(tmp_path_factory.mktemp("calibrated") / "heated")
    reprocess(Catalog(made.root), made.mission())
    diagnose_span(made, "2024-03-01", "2024-03-05")
    return made


@pytest.fixture
def workspace(calibrated, tmp_path) -> Workspace:
    shutil.copytree(calibrated.root, tmp_path / "copy")
    return Workspace.open(tmp_path / "copy")


class Polls:
    """What a page wants to be called for now and then; `run` calls all of it once, `stopped` counts."""

    def __init__(self):
        self.callbacks, self.stopped = [], 0

    def add(self, callback, period):
        self.callbacks.append(callback)
        return Poll(self, callback)

    def run(self):
        for one in list(self.callbacks):
            one()


class Poll:
    """One of them, until it is stopped."""

    def __init__(self, polls, callback):
        self.polls, self.callback = polls, callback

    def stop(self):
        self.polls.callbacks.remove(self.callback)
        self.polls.stopped += 1


@pytest.fixture
def polls(monkeypatch) -> Polls:
    """What is called now and then of a page that a browser has taken in."""
    made = Polls()
    monkeypatch.setattr(pn.state, "onload", lambda callback: callback())
    monkeypatch.setattr(pn.state, "add_periodic_callback", made.add)
    return made
