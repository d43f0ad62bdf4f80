"""Fixtures of more than one folder of tests."""

import gc
from pathlib import Path

import pytest
from tiny_mission import make_tiny_workspace


def pytest_collection_finish():
    """What is imported stays: Python need not look again and again which of it could go."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def tiny_workspace(tmp_path) -> Path:
    """A fresh workspace of the tiny mission with two delivered days, nothing ingested."""
    return make_tiny_workspace(tmp_path / "tiny")
