"""Fixtures of more than one folder of tests."""

import gc
from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace


def pytest_ignore_collect(collection_path, config):
    """Where slow cases alone are asked for, files without any are not imported."""
    if config.option.markexpr == "slow" and collection_path.name.startswith("test_"):
        return "mark.slow" not in collection_path.read_text(encoding="utf-8") or None
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """What the tests of a file share is made once: they run in one process.

    Slow cases share nothing and go one by one, unless their file says otherwise by a group of its own.
    """
    for item in items:
        if not (item.get_closest_marker("slow") or item.get_closest_marker("xdist_group")):
            item.add_marker(pytest.mark.xdist_group(item.nodeid.split("::")[0]))


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
