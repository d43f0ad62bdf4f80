"""Each verb tells how far it is: every stage from its beginning to its end."""

import shutil
from contextlib import contextmanager

import pytest
from tiny_mission import TINY_START, deliver_tiny_day, make_tiny_workspace

from inflight.catalog import Catalog, Workspace
from inflight.cli import command
from inflight.tasks import ingest, make_release, reprocess

PLAIN = ("--no-prefect", "--workers", 1)


@pytest.fixture
def told(monkeypatch):
    """What commands tell of their progress: (stage, done, total)."""
    steps = []

    @contextmanager
    def progress(_):
        yield lambda *step: steps.append(step)

    monkeypatch.setattr(command.Command, "progress", progress)
    return steps


def ends_of(steps):
    """Return each stage with how many steps it has; it begins with none done, and ends with all."""
    out = {}
    for stage in dict.fromkeys(stage for stage, _, _ in steps):
        own = [(done, total) for name, done, total in steps if name == stage]
        assert own[0][0] == 0, stage
        assert own[-1][0] == own[-1][1], stage
        assert all(done <= total for done, total in own), stage
        out[stage] = own[-1][1]
    return out


def test_files_are_counted_over_all_instruments_while_they_are_read(inflight, told, tmp_path):
    root = make_tiny_workspace(tmp_path / "tiny", days=3)
    assert inflight("ingest", *PLAIN, "-w", root).code == 0
    assert [step for step in told if step[0] == "index"] == [
        *(("index", done, 3) for done in range(4)),
        *(("index", done, 6) for done in range(3, 7)),
    ]
    assert list(ends_of(told)) == ["index", "ingest"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three calibrated days of the tiny mission."""
    root = make_tiny_workspace(tmp_path_factory.mktemp("told") / "tiny", days=3)
    workspace, cat = Workspace.open(root), Catalog(root)
    ingest(cat, workspace.mission(), workspace.data)
    reprocess(cat, workspace.mission())
    return root


def test_a_reprocessing_tells_days_tables_and_their_intervals(inflight, told, made, tmp_path):
    root = tmp_path / "tiny"
    shutil.copytree(made, root)
    deliver_tiny_day(root / "data", "2024-03-04")
    assert inflight("ingest", *PLAIN, "-w", root).code == 0
    told.clear()
    assert inflight("reprocess", *PLAIN, "-w", root).code == 0
    found = ends_of(told)
    assert list(found) == ["calibrate", "statistics", "tables", "intervals", "produce"]
    assert found["statistics"] == 4
    assert found["tables"] == 3
    # The last table is that of the span.
    assert found["intervals"] == 1
    assert ("intervals", 3, 4) in told


VERBS = {
    ("compare", "--output", "compare.html"): {"compare": 3, "statistics": 3, "sections": 6},
    ("catalog", "verify"): {"verify": None},
    ("catalog", "repair", "--dry-run"): {"verify": None},
    ("release", "1.0", "--dry-run"): {"measure": 9},
    ("figures", "--only", "lag"): {"figures": None},
}


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_a_verb_tells_each_of_its_stages_to_the_end(inflight, told, made, tmp_path, verb):
    named = [tmp_path / one if one.endswith(".html") else one for one in verb]
    assert inflight(*named, "-w", made).code == 0
    found = ends_of(told)
    assert list(found) == list(VERBS[verb])
    assert all(found[stage] == count for stage, count in VERBS[verb].items() if count is not None)


def test_a_release_tells_what_it_writes_and_how_its_files_come_to_the_disk(made, tmp_path):
    root, told = tmp_path / "tiny", []
    shutil.copytree(made, root)
    workspace = Workspace.open(root)
    make_release(workspace, "1.0", progress=lambda *step: told.append(step))
    found = ends_of(told)
    stages = ["write", "tables", "compare", "statistics", "pictures", "manifest", "flush"]
    assert list(found) == stages
    assert found["write"] == 9
    assert found["pictures"] == 3
    assert found["manifest"] > 9
    # What changed since is read in the next one.
    told.clear()
    make_release(workspace, "1.1", progress=lambda *step: told.append(step))
    assert list(ends_of(told)) == stages


def test_changes_and_garbage_are_told(inflight, told, made, tmp_path):
    root = tmp_path / "tiny"
    shutil.copytree(made, root)
    make_release(Workspace.open(root), "1.0")
    deliver_tiny_day(root / "data", TINY_START, seed=1)
    for verb in ("ingest", "reprocess"):
        assert inflight(verb, *PLAIN, "-w", root).code == 0
    told.clear()
    assert inflight("catalog", "diff", "1.0", "-w", root).code == 0
    assert ends_of(told)["changes"] >= 1
    (root / "stores" / "lost").mkdir()
    (root / "stores" / "lost" / "one.zarr").mkdir()
    told.clear()
    assert inflight("catalog", "gc", "-w", root).code == 0
    assert ends_of(told) == {"measure": 1, "remove": 1}
