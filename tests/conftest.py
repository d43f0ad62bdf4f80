"""Fixtures of more than one folder of tests."""

import gc
from collections import Counter
from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace


def pytest_ignore_collect(collection_path, config):
    """Where slow cases alone are asked for, files without any are not imported."""
    if config.option.markexpr == "slow" and collection_path.name.startswith("test_"):
        return "mark.slow" not in collection_path.read_text(encoding="utf-8") or None
    return None


#: Files of long cases that share nothing: each of their tests may go to any process.
CASES = ("tests/physics_cases/test_cases.py", "tests/dual/test_hard_cases.py")
#: Files of few tests that take long, though not so long that a quick run leaves them out.
FEW_AND_LONG = ("tests/web/test_explorer_page.py", "tests/faults/test_interruption.py")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give the tests of a file, which share what its fixtures make, to one process, and cases one by one."""
    if config.option.dist != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return nodeid if nodeid.startswith(CASES) else super()._split_scope(nodeid)

    # In the order of collection: `pytest_collection_modifyitems`.
    config.option.loadscopereorder = False
    return Scheduling(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Among processes, begin with files of long cases, then of many tests: none ends with a long one."""
    if not hasattr(config, "workerinput"):
        return
    counts = Counter(item.path for item in items)
    long = {
        item.path for item in items if item.get_closest_marker("slow") or item.nodeid.startswith(FEW_AND_LONG)
    }
    items.sort(key=lambda item: (item.path not in long, -counts[item.path], str(item.path)))


def pytest_collection_finish():
    """What is imported stays: Python need not look again and again which of it could go.

    Nor among what tests import later, which is most of what there is: it looks less often.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture
def tiny_workspace(tmp_path) -> Path:
    """A fresh workspace of the tiny mission with two delivered days, nothing ingested."""
    return make_tiny_workspace(tmp_path / "tiny")
