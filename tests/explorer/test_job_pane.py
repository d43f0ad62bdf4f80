import threading

import panel as pn

from inflight.explorer import job_pane
from inflight.explorer.background import Background
from inflight.explorer.job_pane import JobPane


def test_a_result_is_shown_only_once_the_browser_has_the_page(monkeypatch):
    """What changes while a browser takes the page in may be lost on the way."""
    loaded, polls = [], []
    monkeypatch.setattr(pn.state, "onload", loaded.append)
    monkeypatch.setattr(pn.state, "add_periodic_callback", lambda poll, period: polls.append(poll))
    background = Background()
    pane = JobPane(background)
    pane.begin("sum", lambda progress: 1 + 1, lambda result: pn.pane.HTML(f"it is {result}"))
    assert len(loaded) == 1
    assert polls == []
    job = pane._job
    assert job.wait(60)
    loaded[0]()
    (poll,) = polls
    poll()
    assert pane.panel[1].objects[0].object == "it is 2"
    background.close()


def test_what_takes_long_follows_a_result_that_was_shown(monkeypatch):
    polls, followed = Polls(), []
    clock = [100.0]
    monkeypatch.setattr(job_pane.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(pn.state, "onload", lambda callback: callback())
    monkeypatch.setattr(pn.state, "add_periodic_callback", polls.add)
    background = Background()
    pane = JobPane(background)
    show = lambda result: pn.pane.HTML(f"it is {result}")  # noqa: E731
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
    background.close()


def test_what_follows_a_result_is_done_before_another_job_that_is_begun_meanwhile(monkeypatch):
    polls, followed = Polls(), []
    monkeypatch.setattr(pn.state, "onload", lambda callback: callback())
    monkeypatch.setattr(pn.state, "add_periodic_callback", polls.add)
    background = Background()
    pane = JobPane(background)
    show = lambda result: pn.pane.HTML(f"it is {result}")  # noqa: E731
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
    background.close()


def test_progress_is_shown_of_what_takes_long_only(monkeypatch):
    polls, clock, stopper = Polls(), [100.0], threading.Event()
    monkeypatch.setattr(job_pane.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(pn.state, "onload", lambda callback: callback())
    monkeypatch.setattr(pn.state, "add_periodic_callback", polls.add)
    background = Background()
    pane = JobPane(background)
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
    background.close()


class Polls:
    """The newest callback of a pane; `run` calls it unless it was stopped."""

    def __init__(self):
        self.callback, self.stopped = None, 0

    def add(self, callback, period):
        self.callback = callback
        return self

    def stop(self):
        self.callback, self.stopped = None, self.stopped + 1

    def run(self):
        if self.callback is not None:
            self.callback()
