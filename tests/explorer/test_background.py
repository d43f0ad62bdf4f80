"""Long work beside the page: progress, results and errors of jobs."""

import threading

import pytest

from inflight.errors import CatalogError
from inflight.explorer.background import Background
from inflight.explorer.panes import progress


@pytest.fixture
def background():
    made = Background()
    yield made
    made.close()


def test_a_job_is_begun_at_once_and_tells_how_far_it_is(background):
    told, go_on = threading.Event(), threading.Event()

    def work(tell):
        tell("pass", 2, 8)
        told.set()
        assert go_on.wait(30)
        return "done"

    job = background.begin("Diagnosis", work)
    assert told.wait(30)
    assert not job.is_finished
    assert (job.stage, job.done, job.total) == ("pass", 2, 8)
    assert "2 of 8" in progress(job)
    go_on.set()
    assert job.wait(30)
    assert (job.result, job.error) == ("done", None)


def test_work_is_done_one_after_the_other(background):
    go_on, order = threading.Event(), []
    first = background.begin("first", lambda tell: (go_on.wait(30), order.append("first")))
    second = background.begin("second", lambda tell: order.append("second"))
    assert "waiting" in progress(second)
    go_on.set()
    assert second.wait(30)
    assert first.is_finished
    assert order == ["first", "second"]


def test_an_error_of_the_project_keeps_its_remedy(background):
    def work(tell):
        raise CatalogError(
            "no product is published", remedy="run 'inflight reprocess' first", day="2024-03-01"
        )

    job = background.begin("Tables", work)
    assert job.wait(30)
    assert job.error["kind"] == "CatalogError"
    assert job.error["remedy"] == "run 'inflight reprocess' first"
    assert job.error["day"] == "2024-03-01"


def test_a_defect_is_told_as_one_and_the_next_job_is_done(background):
    job = background.begin("Tables", lambda tell: {}["nothing"])
    after = background.begin("Tables", lambda tell: 7)
    assert after.wait(30)
    assert after.result == 7
    assert job.error["message"].startswith("unexpected error")
    assert "KeyError" in job.trace
