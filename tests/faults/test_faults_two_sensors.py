"""Two sensors on one boom: serial and parallel runs leave the same bytes, and so does one that was killed."""

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from fault_cases import assert_whole, copied, view

from inflight.catalog import Catalog, Workspace
from inflight.simulate.dual import DualSettings
from inflight.tasks.archive import ingest, simulate
from inflight.tasks.pipelines import ReprocessSettings, reprocess

MISSION = Path(__file__).parents[2] / "missions" / "venus-express.yaml"
SHOWN = ("l2/field",)
CHOSEN = {"table": "daily", "batch_days": 1}
COUNT = 3
DAYS = np.datetime64("2006-05-14") + np.arange(COUNT)


class Recording:
    """A mapper that works on everything at once, finishes the last first, and keeps what was asked for."""

    def __init__(self):
        self.windows, self.products = [], []

    def __call__(self, stage, work, arguments):
        arguments = list(arguments)
        if stage == "calibrate":
            self.windows += [day for one in arguments for day in one[3]]
        else:
            self.products += [day for _, batch in arguments for day in batch.job.days]
        with ThreadPoolExecutor(2) as pool:
            futures = [pool.submit(work, *one) for one in reversed(arguments)]
            return [one.result() for one in reversed(futures)]


def rerun(workspace):
    """Reprocess once more, in this process; return what had to be done."""
    done = Recording()
    mission = Workspace.open(workspace).mission()
    report = reprocess(Catalog(workspace), mission, settings=ReprocessSettings(**CHOSEN), mapper=done)
    assert report.days["failed"] == 0
    return done


@pytest.fixture(scope="module")
def archived(memory):
    """Three days of both sensors in the archive, nothing learnt from them."""
    source = memory / "boom.yaml"
    text = MISSION.read_text(encoding="utf-8").replace("cadence: 1 s", "cadence: 8 s")
    source.write_text(text, encoding="utf-8")
    made = Workspace.create(memory / "boom", source)
    simulate(DualSettings(days=COUNT, seed=33, overrides={"cadence": 8.0}), made.data, workers=1)
    assert ingest(Catalog(made.root), made.mission(), made.data).days["failed"] == 0
    return made.root


@pytest.fixture(scope="module")
def serial(stage, archived, memory):
    """What readers see after a run that did one thing after the other, undisturbed."""
    workspace = copied(archived, memory / "serial")
    assert stage.run("reprocess", workspace, **CHOSEN).code == 0
    seen = view(workspace, SHOWN)
    assert sum(key[0] == "table" for key in seen) == COUNT
    return seen


def test_a_run_that_works_on_all_windows_at_once_leaves_the_same_bytes(archived, serial, tmp_path):
    workspace = copied(archived, tmp_path / "parallel")
    done = rerun(workspace)
    assert (len(done.windows), len(done.products)) == (COUNT, COUNT)
    assert view(workspace, SHOWN) == serial


@pytest.mark.parametrize(
    ("point", "windows", "products"),
    [
        # The second window's table is on disk and nobody knows it.
        ("manifest_written:2", 2, 3),
        # All windows are learnt from, the first product is on disk and nobody knows it.
        ("manifest_written:4", 0, 3),
        ("attach:3", 0, 1),
        ("publish_flushed", 0, 0),
        ("published", 0, 0),
    ],
)
def test_a_killed_run_shows_nothing_half_done_and_the_next_goes_on_from_it(
    stage, archived, serial, tmp_path, point, windows, products
):
    workspace = copied(archived, tmp_path / "killed")
    killed = stage.run("reprocess", workspace, kill_at=point, **CHOSEN)
    assert killed.code == -signal.SIGKILL, f"the point was not reached: {killed}"
    assert view(workspace, SHOWN) == (serial if point == "published" else {})
    assert_whole(workspace)
    done = rerun(workspace)
    assert done.windows == list(DAYS[COUNT - windows :])
    assert done.products == list(DAYS[COUNT - products :])
    assert view(workspace, SHOWN) == serial
    assert_whole(workspace)
