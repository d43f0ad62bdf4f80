"""kill -9 of real processes: readers see the old or the new, and the rerun ends as if undisturbed."""

import signal

import pytest
from fault_cases import BATCH, assert_whole, copied, versions, view

INGEST_POINTS = ["attach:2", "manifest_written:4", "publish_begun", "publish_flushed", "published"]
# Two passes of equations (stores 1 to 4), three tables (5 to 7), two stores of products (8 and 9).
REPROCESS_POINTS = [
    "attach:3",
    "attach:4",
    "manifest_written:6",
    "attach:6",
    "publish_flushed",
    "published",
]
# Four blocks, a day each.
DIAGNOSE_POINTS = ["attach:3", "publish_flushed", "published"]
WORK = {
    "ingest": ("redelivered", "taken_in"),
    "reprocess": ("taken_in", "reprocessed"),
    "diagnose": ("reprocessed", "diagnosed"),
}
OPTIONS = {
    "ingest": {"batch_days": BATCH},
    "reprocess": {"batch_days": BATCH},
    "diagnose": {"batch_blocks": 1},
}


@pytest.fixture(scope="module")
def verdict(stage, states, views, memory) -> dict:
    """The verdict of a diagnosis that was not disturbed; what readers see after it becomes a view."""
    workspace = copied(states["reprocessed"], memory / "diagnosed")
    told = stage.run("diagnose", workspace, **OPTIONS["diagnose"])
    assert told.code == 0, told.error
    assert ["pass", 0, 4] in told.report["told"]
    views["diagnosed"] = view(workspace)
    return told.report


def settled(stage, workspace, work, views):
    """Assert that readers see all old or all new, that the rerun completes and equals an undisturbed run."""
    return seen_and_told(stage, workspace, work, views)[0]


def seen_and_told(stage, workspace, work, views):
    """Do as `settled`; return whether readers saw the new, and the report of the rerun."""
    before, after = (views[name] for name in WORK[work])
    seen = view(workspace)
    assert seen in (before, after), f"a mixture is visible: {versions(seen)}"
    assert_whole(workspace)
    rerun = stage.run(work, workspace, **OPTIONS[work])
    assert rerun.code == 0, rerun.error
    assert rerun.report.get("days", {"failed": 0})["failed"] == 0
    found = view(workspace)
    different = [key for key in after if found.get(key) != after[key]]
    assert different == []
    assert found == after
    assert_whole(workspace)
    return seen == after, rerun.report


@pytest.mark.parametrize(
    ("work", "point"),
    [("ingest", point) for point in INGEST_POINTS] + [("reprocess", point) for point in REPROCESS_POINTS],
)
def test_a_kill_at_a_named_point_shows_old_or_new_and_the_rerun_equals_an_undisturbed_run(
    stage, fresh, views, work, point
):
    workspace = fresh(WORK[work][0])
    killed = stage.run(work, workspace, kill_at=point, **OPTIONS[work])
    assert killed.code == -signal.SIGKILL, f"the point was not reached: {killed}"
    published = settled(stage, workspace, work, views)
    assert published == (point == "published")


@pytest.mark.parametrize("point", DIAGNOSE_POINTS)
def test_a_diagnosis_that_was_killed_goes_on_with_the_blocks_it_had_and_tells_the_same(
    stage, fresh, views, verdict, point
):
    workspace = fresh("reprocessed")
    killed = stage.run("diagnose", workspace, kill_at=point, **OPTIONS["diagnose"])
    assert killed.code == -signal.SIGKILL, f"the point was not reached: {killed}"
    published, report = seen_and_told(stage, workspace, "diagnose", views)
    assert published == (point == "published")
    still_to_make = max((total for step, done, total in report["told"] if step == "pass"), default=0)
    assert still_to_make == {"attach:3": 2}.get(point, 0)
    of_the_run = {"run", "told"}
    assert {key: told for key, told in report.items() if key not in of_the_run} == {
        key: told for key, told in verdict.items() if key not in of_the_run
    }
