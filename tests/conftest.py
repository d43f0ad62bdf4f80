"""Fixtures of more than one folder of tests."""

import gc
from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace


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
