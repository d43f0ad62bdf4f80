import panel as pn

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
