"""Two pages on one workspace: each has its own view; what one begins the other sees."""

import threading

import panel as pn
import pytest

from inflight.explorer.page import Page
from inflight.explorer.products_view import ProductsView
from inflight.explorer.session import ExplorerSession

pytestmark = pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")


def text_of(view) -> str:
    return " ".join(str(one.object) for one in view.panel.select(pn.pane.HTML))


def test_pages_have_their_own_days_and_share_what_is_done(workspace, polls, monkeypatch):
    # Of what takes no time nothing would be told.
    monkeypatch.setattr("inflight.explorer.job_pane._QUIET_S", -1.0)
    session, stopper = ExplorerSession(workspace, workers=1), threading.Event()
    report = {"run": "", "days": {"done": 4, "unchanged": 0, "failed": 0}, "problems": [], "outputs": []}
    monkeypatch.setattr("inflight.explorer.work.InOwnProcess.__call__", lambda work, progress: report)
    try:
        pages = [Page(session), Page(session)]
        views = [next(one for one in page._views if isinstance(one, ProductsView)) for page in pages]
        pages[0]._first.value = pages[0]._last.value
        pages[0]._choose(keep=True)
        assert pages[0]._state.first == "2024-03-04"
        assert pages[1]._state.first == "2024-03-01"

        views[0].show(pages[0]._overview, pages[0]._days())
        first, second = (view._runs for view in views)
        first._begin_plan()
        first._plan_pane._job.wait(60)
        polls.run()
        assert "2024-03-04 to 2024-03-05: 0 days to do" in text_of(views[0])
        go_on = session.background.begin("what was begun before", lambda progress: stopper.wait(60))
        first._begin_work()
        # A page that is opened later finds the work under way, and sees it end.
        views[1].show(pages[1]._overview, pages[1]._days())
        polls.run()
        for view in views:
            assert "Reprocess 2024-03-04 to 2024-03-04: waiting" in text_of(view)
        assert "0 days to do" not in text_of(views[1])
        stopper.set()
        go_on.wait(60)
        session.begun[-1][1].wait(60)
        polls.run()
        for view in views:
            assert "4 days made" in text_of(view)
        assert second._stop.disabled
    finally:
        stopper.set()
        session.close()
