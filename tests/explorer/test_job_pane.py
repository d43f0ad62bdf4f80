import threading

import panel as pn
import pytest

from inflight.explorer import job_pane
from inflight.explorer.background import Background
from inflight.explorer.job_pane import JobPane


@pytest.fixture
def pane():
    background = Background()
    yield JobPane(background)
    background.close()


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """Seconds that a pane reads, to be moved on."""
    seconds = [100.0]
    monkeypatch.setattr(job_pane.time, "monotonic", lambda: seconds[0])
    return seconds


def show(result):
    return pn.pane.HTML(f"it is {result}")


def test_a_result_is_shown_only_once_the_browser_has_the_page(pane, monkeypatch):
    """What changes while a browser takes the page in may be lost on the way."""
    loaded, polls = [], []
    monkeypatch.setattr(pn.state, "onload", loaded.append)
    monkeypatch.setattr(pn.state, "add_periodic_callback", lambda poll, period: polls.append(poll))
    pane.begin("sum", lambda progress: 1 + 1, show)
    assert len(loaded) == 1
    assert polls == []
    job = pane._job
    assert job.wait(60)
    loaded[0]()
    (poll,) = polls
    poll()
    assert pane.panel[1].objects[0].object == "it is 2"


def test_what_takes_long_follows_a_result_that_was_shown(pane, polls, clock):
    followed = []
    pane.begin("sum", lambda progress: 1 + 1, show, followed.append)
    assert pane._job.wait(60)
    polls.run()
    assert pane.panel[1].objects[0].object == "it is 2"
    polls.run()
    # The browser has not shown it yet.
    assert (followed, polls.stopped) == ([], 0)
    clock[0] += 1.0
    polls.run()
    assert (followed, polls.stopped) == ([2], 1)
    # What fails has nothing that follows.
    pane.begin("quotient", lambda progress: 1 / 0, show, followed.append)
    assert pane._job.wait(60)
    polls.run()
    polls.run()
    assert (followed, polls.stopped) == ([2], 2)


def test_what_follows_a_result_is_done_before_another_job_that_is_begun_meanwhile(pane, polls):
    followed = []
    pane.begin("sum", lambda progress: 1 + 1, show, followed.append)
    assert pane._job.wait(60)
    polls.run()
    assert followed == []
    pane.begin("product", lambda progress: [*followed, 2 * 3], show)
    assert followed == [2]
    assert pane._job.wait(60)
    assert pane._job.result == [2, 6]
    polls.run()
    polls.run()
    assert followed == [2]


def test_progress_is_shown_of_what_takes_long_only(pane, polls, clock):
    stopper = threading.Event()
    pane.begin("sum", lambda progress: stopper.wait(60), lambda result: pn.pane.HTML("done"))
    status = pane.panel[0]
    polls.run()
    assert not status.visible
    clock[0] += 1.0
    polls.run()
    assert status.visible
    assert "sum" in status.object
    stopper.set()
    assert pane._job.wait(60)
    polls.run()
    assert not status.visible
