"""kill -9 of real processes: readers see the old or the new, and the rerun ends as if undisturbed."""

import signal

import pytest
from fault_cases import BATCH, assert_whole, versions, view

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
WORK = {"ingest": ("redelivered", "taken_in"), "reprocess": ("taken_in", "reprocessed")}


def settled(stage, workspace, work, views):
    """Assert that readers see all old or all new, that the rerun completes and equals an undisturbed run."""
    before, after = (views[name] for name in WORK[work])
    seen = view(workspace)
    assert seen in (before, after), f"a mixture is visible: {versions(seen)}"
    assert_whole(workspace)
    rerun = stage.run(work, workspace, batch_days=BATCH)
    assert rerun.code == 0, rerun.error
    assert rerun.report["days"]["failed"] == 0
    found = view(workspace)
    different = [key for key in after if found.get(key) != after[key]]
    assert different == []
    assert found == after
    assert_whole(workspace)
    return seen == after


@pytest.mark.parametrize(
    ("work", "point"),
    [("ingest", point) for point in INGEST_POINTS] + [("reprocess", point) for point in REPROCESS_POINTS],
)
def test_a_kill_at_a_named_point_shows_old_or_new_and_the_rerun_equals_an_undisturbed_run(
    stage, fresh, views, work, point
):
    workspace = fresh(WORK[work][0])
    killed = stage.run(work, workspace, kill_at=point, batch_days=BATCH)
    assert killed.code == -signal.SIGKILL, f"the point was not reached: {killed}"
    published = settled(stage, workspace, work, views)
    assert published == (point == "published")
